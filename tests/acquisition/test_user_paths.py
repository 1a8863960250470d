"""The folder that a user names: scan, resume, validate and process take every form of its path."""

from pathlib import Path

import pytest
from tests.support.rigs import load_published_rig
from tests.support.scenes import COPPER, make_scene

from polysight.acquisition import StopRequest, resume_scan, run_scan
from polysight.cli.main import main
from polysight.store import ScanFolder
from polysight_simulators.scene import decode_scene, simulate

# Forms of the path of the folder "a scan" in the current folder `out`: by its parent, through a link, and absolute.
FORMS = ["../out/a scan", "./../out/./a scan", "a scan/../a scan/", "../out/link/a scan", "{tmp}/out/../out/a scan"]


@pytest.fixture
def home(tmp_path, monkeypatch) -> Path:
    """The folder in which commands are run, with a link to it next to `a scan`."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "link").symlink_to(out)
    monkeypatch.chdir(out)
    return out


@pytest.mark.parametrize("form", FORMS)
def test_a_scan_is_recorded_resumed_and_validated(rig, home, tmp_path, form):
    if "/../a scan" in form:
        (home / "a scan").mkdir()
    path = Path(form.format(tmp=tmp_path))
    stop = StopRequest()
    assert run_scan(rig.instrument, path, stop=stop, on_row=lambda _: stop.request()).exit_status == "abort"
    assert resume_scan(path).exit_status == "success"
    assert main(["validate", form.format(tmp=tmp_path)]) == 0
    assert list(ScanFolder.load(home / "a scan").rows()) == [0, 1, 2, 3]


@pytest.mark.parametrize("form", FORMS)
def test_a_scan_is_processed(home, tmp_path, form):
    scene = decode_scene(make_scene(COPPER, columns=4, rows=4), "t")
    simulate(load_published_rig(), scene, home / "a scan")
    assert main(["image", form.format(tmp=tmp_path), "--out", str(tmp_path / "made")]) == 0
