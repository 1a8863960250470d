"""README and docs: their links lead somewhere, and the commands they show exist."""

import re
import tomllib

import numpy as np
from docs.check.looking import page_faults
from docs.check.pages import ROOT, all_pages, read_page
from tests.support.rigs import load_published_rig
from tests.support.scenes import COPPER, make_scene

from polysight.acquisition import ScanCommand
from polysight.cli.serve import SCAN_COMMANDS
from polysight.materials import check_labels, read_labels
from polysight.radar.usb import PRODUCT, VENDOR
from polysight.results import NoResult
from polysight_shared.errors import PolysightError
from polysight_shared.faults import EXPLANATIONS, PiFault
from polysight_simulators.scene import decode_scene, simulate


def test_links_of_all_pages_lead_somewhere_and_their_commands_exist():
    faults = [fault for path in all_pages() for fault in page_faults(read_page(path))]
    assert not faults, "\n".join(faults)


def test_every_page_is_found_from_the_index():
    linked = {(ROOT / "docs" / t.partition("#")[0]).resolve() for _, t in read_page(ROOT / "docs/README.md").links}
    pages = {p for folder in ("how-to", "spec", "decisions") for p in (ROOT / "docs" / folder).glob("*.md")}
    assert not {p.name for p in pages - linked}


def test_fault_numbers_and_exit_statuses_are_documented():
    text = (ROOT / "docs/how-to/when-it-goes-wrong.md").read_text(encoding="utf-8")
    for fault in PiFault:
        explanation = EXPLANATIONS[fault]
        line = f"* **{int(fault)}**: {explanation.problem} ({explanation.cause}): {explanation.remedy}"
        assert line in " ".join(text.split())
    kinds = {PolysightError, NoResult, *PolysightError.__subclasses__()}
    # 130 is that of a program that Ctrl-C ended: 128 + the number of SIGINT.
    expected_statuses = {kind.exit_status for kind in kinds} | {0, 130}
    documented_statuses = set(map(int, re.findall(r"^\| (\d+) \|", text.split("## Messages")[0], re.MULTILINE)))
    assert documented_statuses == expected_statuses


def test_every_request_to_a_scan_is_documented():
    page = (ROOT / "docs/how-to/live-view.md").read_text(encoding="utf-8")
    assert all(f"control/{command}" in page for command in ScanCommand)
    assert list(ScanCommand) == [*SCAN_COMMANDS]


def test_the_drawing_shows_the_rig_file_and_the_sketch():
    drawing = (ROOT / "docs/images/wiring.svg").read_text(encoding="utf-8")
    rig = tomllib.loads((ROOT / "instrument.toml").read_text(encoding="utf-8"))
    pin = dict(re.findall(r"PIN_(\w+) = (\d+)", (ROOT / "arduino_stage/board.h").read_text(encoding="ascii")))
    assert f"GPIO {rig['pi']['trigger_in']} (" in drawing
    assert f"GPIO {rig['pi']['sync_out'][0]} (" in drawing
    assert f"D{pin['TRIGGER']} trigger" in drawing
    for name in ("LEFT", "RIGHT", "X"):
        assert f"D{pin[name + '_PUL']}/D{pin[name + '_DIR']}" in drawing
    assert f"D{pin['ENABLE']}  enable" in drawing
    for board in rig["boards"]:
        assert f">{board['name']}  " in drawing
        assert "DCA1000EVM  ." + board["card_address"].rpartition(".")[2] in drawing
        assert board["host_address"] in drawing


def test_what_the_installation_writes_is_what_the_programs_want():
    text = (ROOT / "docs/how-to/install.md").read_text(encoding="utf-8")
    rig = tomllib.loads((ROOT / "instrument.toml").read_text(encoding="utf-8"))
    rights = (ROOT / "host/rights.sh").read_text(encoding="utf-8")
    assert "host/rights.sh" in text
    assert f'ATTR{{idVendor}}=="{VENDOR:04x}", ATTR{{idProduct}}=="{PRODUCT:04x}"' in rights
    assert f"net.core.rmem_max = {rig['card']['receive_buffer_bytes']}" in rights
    assert {board["host_address"] for board in rig["boards"]} == {re.findall(r"addresses ([\d.]+)/24", text)[0]}
    assert f"cd {rig['pi']['key_dir'].removesuffix('/keys')}\n" in (ROOT / "docs/how-to/bring-up.md").read_text()
    assert rig["pi"]["key_dir"] in text


def test_the_label_file_that_is_shown_can_be_learnt_from(tmp_path):
    (block,) = [b for b in read_page(ROOT / "docs/spec/labels.md").blocks if b.language == "json"]
    (tmp_path / "labels.json").write_text(block.text, encoding="utf-8")
    axis_m = np.linspace(-0.1, 0.1, 101)
    boxes = check_labels(read_labels(tmp_path / "labels.json"), axis_m, axis_m)
    assert [boxes.specimen(name) for name in boxes.boxes] == [None, "board 7", "2"]
    assert (boxes.metal, boxes.by_hand) == ("copper", True)


def test_the_python_blocks_about_imaging_run(tmp_path, monkeypatch):
    """They use packages that are not part of the public interface, whose names may change without notice."""
    simulate(
        load_published_rig(), decode_scene(make_scene(COPPER, columns=4, rows=3), "test"), tmp_path / "scans" / "points"
    )
    monkeypatch.chdir(tmp_path)
    blocks = [block for block in read_page(ROOT / "docs/how-to/imaging.md").blocks if block.info == ("python", "run")]
    assert len(blocks) > 1
    for block in blocks:
        exec(compile(block.text, f"imaging.md:{block.line}", "exec"), {})
