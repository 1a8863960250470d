"""Commands for notes, tags, lists and raw data of scans do the same as the operator's page."""

import json
import os
import shutil
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec import UNSET
from msgspec.structs import replace
from tests.support.page.live_view import open_control
from tests.support.products import write_judged_products
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig
from tests.support.scenes import COPPER, make_scene

from polysight.catalogue import NOTES_FILE, Notes, probe, read_notes
from polysight.cli.main import build_parser, main
from polysight.jobs import scans
from polysight.results import ComplexNumber
from polysight.store import MANIFEST, manifest
from polysight_shared.errors import ConfigError, DataError, ErrorCode, ScanError
from polysight_simulators.scene import decode_scene, simulate


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder with a small simulated scan and with made-up products."""
    simulate(load_published_rig(), decode_scene(make_scene(COPPER, columns=4, rows=3), "t"), tmp_path / "scans" / "one")
    write_judged_products(tmp_path / "scans" / "two", "good")
    return tmp_path / "scans"


def run_command(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """Run a command that must succeed; return its output."""
    capsys.readouterr()
    assert main([str(word) for word in words]) == 0
    return capsys.readouterr().out


def test_scans_are_listed_and_found_by_their_notes_and_tags(root, capsys):
    options = ("--text", "Eiche, zweites Brett", "--tag", "oak", "--tag", "new")
    run_command(capsys, "note", root / "one", *options)
    assert read_notes(root / "one") == Notes("Eiche, zweites Brett", ("oak", "new"))
    assert "oak" in run_command(capsys, "note", root / "one", "--untag", "new")
    assert read_notes(root / "one").tags == ("oak",)
    rows = json.loads(run_command(capsys, "scans", root, "--json"))["scans"]
    assert {row["name"]: row["state"] for row in rows} == {"one": "finished", "two": "products"}
    # The size is that of a scan's files.
    assert all(row["bytes"] > 1000 for row in rows)
    for option, value, name in (("--tag", "oak", "one"), ("--find", "BRETT", "one"), ("--find", "pet", "two")):
        rows = json.loads(run_command(capsys, "scans", root, "--json", option, value))["scans"]
        assert [row["name"] for row in rows] == [name]
    assert "2 scans" in run_command(capsys, "scans", root)


def test_names_and_tags_reach_the_terminal_without_control_and_direction_marks(root, capsys):
    write_judged_products(root / ("long" * 40), "good")
    (root / "two" / "operator.json").write_text(json.dumps({"notes": "a\u202eb\x1b[31m", "tags": ["t\u200fag\x07"]}))
    materials = root / "two" / "materials.json"
    materials.write_text(materials.read_text().replace("PET", "P\u202eET"))
    for words in (["scans", root], ["note", root / "two"], ["probe", root / "two", "0,0"]):
        text = run_command(capsys, *words)
        assert all(c.isprintable() or c == "\n" for c in text), ascii(text)
    lines = run_command(capsys, "scans", root).splitlines()
    # The long name of one scan does not make the lines of the others longer than a usual terminal is wide.
    assert max(len(line) for line in lines if not line.startswith("long")) < 120


def test_a_command_reaches_a_running_scan_and_is_refused_without_one(root, capsys):
    with open_control(root / "one") as stop:
        assert "pause" in run_command(capsys, "ask", root / "one", "pause")
        assert stop.paused
    assert main(["ask", str(root / "one"), "pause"]) == ScanError.exit_status
    assert "polysight resume" in capsys.readouterr().err


def test_results_at_a_place_and_of_two_scans_are_printed(root, capsys, tmp_path):
    text = run_command(capsys, "probe", root / "two", "0,0")
    assert "|H|" in text
    place = json.loads(run_command(capsys, "probe", root / "two", "0,0", "--json"))
    assert place["referenced"] is True
    shutil.copytree(root / "two", root / "three")
    assert "0.0 %" in run_command(capsys, "compare", root / "two", root / "three", "--png", tmp_path / "d.png")
    assert (tmp_path / "d.png").read_bytes().startswith(b"\x89PNG")
    comparison = json.loads(run_command(capsys, "compare", root / "two", root / "three", "--json"))
    assert comparison["significant_share"] == 0


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("probe one 0,0", ErrorCode.FILE_MISSING),
        ("compare one two", ErrorCode.FILE_MISSING),
        ("probe two 900,0", ErrorCode.VALUE_INVALID),
        ("scans nowhere", ErrorCode.FILE_MISSING),
        ("note nowhere", ErrorCode.FILE_MISSING),
        ("ask nowhere stop", ErrorCode.FILE_MISSING),
    ],
)
def test_folders_and_places_that_do_not_exist_are_refused(root, monkeypatch, command, code):
    monkeypatch.chdir(root)
    args = build_parser().parse_args(command.split())
    with expect_refusal(code):
        args.run(args)


def test_a_patch_that_is_the_metal_reference_is_probed_as_such(root, capsys):
    materials = root / "two" / "materials.json"
    content = json.loads(materials.read_text())
    content["segments"][0]["outline_mm"] = [[-50.0, -20.0], [-20.0, -20.0], [-20.0, 20.0], [-50.0, 20.0]]
    materials.write_text(json.dumps(content))
    assert "in patch 1: the metal reference" in run_command(capsys, "probe", root / "two", "-35,0")


def test_compare_says_where_its_picture_is(root, capsys, tmp_path):
    assert main(["compare", str(root / "two"), str(root / "two"), "--png", str(tmp_path / "d.png")]) == 0
    assert f"picture: {tmp_path / 'd.png'}" in capsys.readouterr().err
    assert (tmp_path / "d.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("folder", ["", "empty"])
def test_notes_of_a_folder_that_is_not_a_scan_are_refused(root, folder):
    """Notes in such a folder would not be shown by any list."""
    (root / "empty").mkdir()
    args = build_parser().parse_args(["note", str(root / folder), "--text", "oak"])
    with expect_refusal(ErrorCode.FILE_MISSING, root / folder):
        args.run(args)
    assert not (root / folder / NOTES_FILE).exists()


@pytest.mark.parametrize("option", ["--text", "--tag", "--untag"])
def test_a_text_that_is_not_utf_8_is_refused_and_changes_no_notes(root, capsys, option):
    """A terminal of another encoding gives such bytes; they cannot be stored."""
    options = ("--text", "oak", "--tag", "new")
    run_command(capsys, "note", root / "one", *options)
    with pytest.raises(SystemExit) as ended:
        main(["note", str(root / "one"), option, os.fsdecode(b"gr\xfcn")])
    assert ended.value.code == ConfigError.exit_status
    assert "UTF-8" in capsys.readouterr().err
    assert read_notes(root / "one") == Notes("oak", ("new",))


def test_a_rounded_zero_has_no_sign(root, capsys, monkeypatch):
    result = probe(root / "two", 0, 0)
    zero = ComplexNumber(-0.0, -0.0)
    at_zero = replace(result, place_mm=(-0.0, 0.0), h_db=-0.0, v_db=-0.0, p=zero)
    monkeypatch.setattr(scans, "probe", lambda *_: at_zero)
    lines = run_command(capsys, "probe", root / "two", "0,0").splitlines()
    assert lines[0].startswith("x 0 mm, y 0 mm")
    assert lines[1] == "|H| 0 dB, |V| 0 dB"
    assert lines[2].startswith("P = 0 + 0j ")


def test_a_single_scan_is_counted_in_the_singular(root, capsys):
    assert "\n1 scan under" in run_command(capsys, "scans", root, "--find", "one")


def test_no_tag_of_commands_at_the_same_time_is_lost(root):
    tags_of_threads = [[f"{letter}{number}" for number in range(4)] for letter in "abcd"]
    all_are_ready = threading.Barrier(len(tags_of_threads))

    def add_tags(tags: list[str]) -> None:
        all_are_ready.wait()
        for tag in tags:
            scans.note(root / "one", None, [tag], [])

    threads = [threading.Thread(target=add_tags, args=(tags,)) for tags in tags_of_threads]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(read_notes(root / "one").tags) == sorted(tag for tags in tags_of_threads for tag in tags)


@pytest.mark.parametrize(
    "command", ["report one", "process one --out one/products", "process one --out ./one/products/"]
)
def test_products_of_a_running_scan_are_not_written_by_another_command(root, monkeypatch, command):
    """Otherwise the scan's own processing would find the folder in use at its end, and fail."""
    monkeypatch.chdir(root)
    args = build_parser().parse_args(command.split())
    with (root / "one" / MANIFEST).open("rb") as recorded:
        manifest.lock_file(recorded)
        with expect_refusal(ErrorCode.BUSY, "polysight preview one"):
            args.run(args)
    assert not (root / "one" / "products").exists()


@pytest.mark.parametrize(
    ("digests", "is_complete"),
    [({"RH": ["a"], "RV": ["b"]}, True), ({"RH": ["a"]}, False), ({}, False)],
    ids=["both boards", "one board", "none"],
)
def test_processed_rows_are_proven_by_the_digests_of_all_their_boards(monkeypatch, tmp_path, digests, is_complete):
    """Products of an earlier release have no digests; raw data is deleted only if every board's are known."""
    boards = {name: SimpleNamespace(raw_crc32=digests.get(name, UNSET)) for name in ("RH", "RV")}
    products = SimpleNamespace(folder=tmp_path, images=None, quality=SimpleNamespace(boards=boards))
    monkeypatch.setattr(scans, "read_products", lambda _: products)
    if is_complete:
        assert scans.find_processed_digests(tmp_path) == digests
    else:
        with pytest.raises(DataError, match="does not state from which data it was made"):
            scans.find_processed_digests(tmp_path)
