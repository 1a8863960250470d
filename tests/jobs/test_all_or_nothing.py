"""A command writes its files completely or not at all, even if the disk is full, it is killed, or power is lost.

Each operation on the disk fails in one of the runs. After each such run the command is repeated, and succeeds.
"""

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.support.products import PIXEL, write_judged_products
from tests.support.store.faulty_disk import FaultyDisk, Killed

import polysight.catalogue
import polysight.report
from polysight.cli.main import main
from polysight.materials import SIMULATED_LIBRARY, Library
from polysight.products import exports
from polysight_shared.errors import PolysightError

Command = Callable[[Path], int]


def run(*words: str) -> Command:
    """Return a function that runs a command in a folder, whose path replaces % in the words."""
    return lambda folder: main([word.replace("%", str(folder)) for word in words])


def save_library(folder: Path) -> int:
    """The end of `polysight train`."""
    library = Library.load(SIMULATED_LIBRARY)
    Library(library.entries[:4], {}, "new").save(folder / "one" / "library.npz")
    return 0


# Commands on the products `one` and `two` in a folder.
BOXES = ("--box", "sheet=-40,-10,-30,10", "--box", "oak=0,0,10,10", "--metal", "sheet")
EXPORTS = ("--csv", "--mat", "--netcdf")
COMMANDS = {
    "label": run("label", "%/one", *BOXES),
    "label again": run("label", "%/two", "--box", "sheet=-40,-10,-30,10"),
    "note": run("note", "%/one", "--text", "oak, second board", "--tag", "oak"),
    "export": run("export", "%/one", *EXPORTS, "--out", "%/one/export"),
    "compare": run("compare", "%/one", "%/two", "--png", "%/one/difference.png"),
    "train": save_library,
}


@pytest.fixture(scope="module")
def scan_before(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("before")
    for name in ("one", "two"):
        write_judged_products(folder / name, "good")
    assert main(["label", str(folder / "two"), "--box", "plate=20,0,30,10", "--metal", "plate"]) == 0
    return folder


@pytest.fixture(autouse=True)
def quick(monkeypatch) -> None:
    """Figures are not drawn or compressed again for every fault."""
    monkeypatch.setattr(polysight.report, "label_figure", lambda *_: PIXEL)
    comparison = SimpleNamespace(png=PIXEL)
    monkeypatch.setattr(polysight.catalogue, "draw_comparison", lambda *_: comparison)
    for pack in ("pack_netcdf", "pack_mat"):
        monkeypatch.setattr(exports, pack, lambda _: b"packed")


def read_visible_files(folder: Path) -> dict[str, bytes]:
    """Return the contents of files that are not hidden, by their path."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.name.startswith(".")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("fault", ["full", "short", "killed", "killed within", "worst power cut"])
def test_everything_or_nothing_is_written_and_the_command_can_be_repeated(scan_before, tmp_path, name, fault):
    command = COMMANDS[name]
    whole_scan = Path(shutil.copytree(scan_before, tmp_path / "whole"))
    with FaultyDisk(whole_scan)() as disk:
        assert command(whole_scan) == 0
    old = read_visible_files(scan_before)
    new = read_visible_files(whole_scan)
    assert old.keys() != new.keys() or old != new
    # The last file that is renamed to its name is the one that counts: with it the command is complete.
    last_rename = [step.split()[1] for step in disk.done if step.startswith("rename")][-1]
    (deciding_file,) = [name for name in new if name.endswith(f"/{last_rename}") and new[name] != old.get(name)]
    for position in range(1, len(disk.done) + 1):
        folder = Path(shutil.copytree(scan_before, tmp_path / f"{position}"))
        try:
            with FaultyDisk(folder, fault, position)():
                status = command(folder)
        except (Killed, OSError, PolysightError):
            status = 1
        remaining = read_visible_files(folder)
        is_complete = remaining == new
        if status == 0:
            assert is_complete, (position, disk.done[position - 1])
        # A command that fails, and is not killed, removes its unfinished files.
        if fault in ("full", "short"):
            assert not list(folder.rglob(".*.part"))
        if not is_complete:
            # A picture may be new already, but it does not count until that file is replaced.
            assert remaining.get(deciding_file) == old.get(deciding_file), (position, disk.done[position - 1])
        assert command(folder) == 0, (position, disk.done[position - 1])
        assert read_visible_files(folder) == new
