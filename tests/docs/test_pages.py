"""README and the pages in docs: links, commands, numbers and code on them agree with the files and programs."""

import re
import signal
import tomllib
from pathlib import PurePosixPath

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


def test_links_of_all_pages_have_a_target_and_their_commands_exist():
    faults = []
    for path in all_pages():
        faults += page_faults(read_page(path))
    assert not faults, "\n".join(faults)


def test_the_index_has_a_link_to_every_page():
    linked_pages = set()
    for _, target in read_page(ROOT / "docs/README.md").links:
        path, _, _ = target.partition("#")
        linked_pages.add((ROOT / "docs" / path).resolve())
    pages = set()
    for folder in ("how-to", "spec", "decisions"):
        pages |= set((ROOT / "docs" / folder).glob("*.md"))
    assert pages - linked_pages == set()


def test_fault_numbers_and_exit_statuses_are_documented():
    text = (ROOT / "docs/how-to/when-it-goes-wrong.md").read_text(encoding="utf-8")
    for fault in PiFault:
        explanation = EXPLANATIONS[fault]
        line = f"* **{int(fault)}**: {explanation.problem} ({explanation.cause}): {explanation.remedy}"
        assert line in " ".join(text.split())
    kinds_of_error = {PolysightError, NoResult, *PolysightError.__subclasses__()}
    success = 0
    interrupted = 128 + signal.SIGINT
    expected_statuses = {kind.exit_status for kind in kinds_of_error} | {success, interrupted}
    table_of_statuses, _ = text.split("## Messages of a scan")
    documented_statuses = {int(number) for number in re.findall(r"^\| (\d+) \|", table_of_statuses, re.MULTILINE)}
    assert documented_statuses == expected_statuses


def test_every_request_to_a_scan_is_documented():
    page = (ROOT / "docs/how-to/live-view.md").read_text(encoding="utf-8")
    for command in ScanCommand:
        assert f"control/{command}" in page
    assert list(SCAN_COMMANDS) == list(ScanCommand)


def test_the_drawing_of_the_wiring_has_the_pins_and_addresses_of_the_rig_file_and_the_stage_s_program():
    drawing = (ROOT / "docs/images/wiring.svg").read_text(encoding="utf-8")
    rig = tomllib.loads((ROOT / "instrument.toml").read_text(encoding="utf-8"))
    board_file = (ROOT / "arduino_stage/board.h").read_text(encoding="ascii")
    pin = dict(re.findall(r"PIN_(\w+) = (\d+)", board_file))
    assert f"GPIO {rig['pi']['trigger_in']} (" in drawing
    assert f"GPIO {rig['pi']['sync_out'][0]} (" in drawing
    assert f"D{pin['TRIGGER']} trigger" in drawing
    for name in ("LEFT", "RIGHT", "X"):
        assert f"D{pin[name + '_PUL']}/D{pin[name + '_DIR']}" in drawing
    # In the drawing two spaces follow the name of a pin or board: `D7  enable`, `RH  receives`.
    assert f"D{pin['ENABLE']}  enable" in drawing
    for board in rig["boards"]:
        _, _, last_byte_of_address = board["card_address"].rpartition(".")
        # A text of the drawing stands between <text ...> and </text>: the name of the board is its first word.
        assert f">{board['name']}  " in drawing
        assert f"DCA1000EVM  .{last_byte_of_address}" in drawing
        assert board["host_address"] in drawing


def test_the_installation_sets_the_addresses_rights_and_limits_that_the_programs_use():
    text = (ROOT / "docs/how-to/install.md").read_text(encoding="utf-8")
    rig = tomllib.loads((ROOT / "instrument.toml").read_text(encoding="utf-8"))
    rights = (ROOT / "host/rights.sh").read_text(encoding="utf-8")
    assert "host/rights.sh" in text
    assert f'ATTR{{idVendor}}=="{VENDOR:04x}", ATTR{{idProduct}}=="{PRODUCT:04x}"' in rights
    assert f"net.core.rmem_max = {rig['card']['receive_buffer_bytes']}" in rights
    host_address = re.search(r"addresses ([\d.]+)/24", text)[1]
    assert {board["host_address"] for board in rig["boards"]} == {host_address}
    key_folder = PurePosixPath(rig["pi"]["key_dir"])
    assert str(key_folder) in text
    # The folder `keys` is in the folder of the settings. In that folder the program of the Pi is checked.
    assert key_folder.name == "keys"
    bring_up = (ROOT / "docs/how-to/bring-up.md").read_text()
    assert f"cd {key_folder.parent}\n" in bring_up


def test_the_example_of_a_label_file_is_valid(tmp_path):
    (block,) = [block for block in read_page(ROOT / "docs/spec/labels.md").blocks if block.language == "json"]
    (tmp_path / "labels.json").write_text(block.text, encoding="utf-8")
    axis_m = np.linspace(-0.1, 0.1, 101)
    boxes = check_labels(read_labels(tmp_path / "labels.json"), axis_m, axis_m)
    # The specimen of oak is under the key `specimens` of the example, and that of oak#2 in the name of its box.
    specimens = {name: boxes.specimen(name) for name in boxes.boxes}
    assert specimens == {"copper": None, "oak": "board 7", "oak#2": "2"}
    assert boxes.metal == "copper"
    assert boxes.by_hand is True


def test_the_python_code_on_the_page_about_imaging_runs(tmp_path, monkeypatch):
    """The code uses internal packages, whose names may change: then the page has to change, too."""
    scene = decode_scene(make_scene(COPPER, columns=4, rows=3), "test")
    simulate(load_published_rig(), scene, tmp_path / "scans" / "points")
    monkeypatch.chdir(tmp_path)
    blocks = [block for block in read_page(ROOT / "docs/how-to/imaging.md").blocks if block.info == ("python", "run")]
    assert len(blocks) > 1
    for block in blocks:
        exec(compile(block.text, f"imaging.md:{block.line}", "exec"), {})
