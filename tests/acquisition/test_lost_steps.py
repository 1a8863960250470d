"""After the last row the stage finds its switches again, and what the drives have lost is told."""

from __future__ import annotations

import msgspec
import pytest

from polysight.host.acquisition.control import StopRequest
from polysight.host.acquisition.scan import resume_scan, run_scan
from polysight.host.store.scan_folder import ScanFolder


def scanned(rig, folder, **stage):
    """The result, and the last `scan_ended`."""
    replace = msgspec.structs.replace
    result = run_scan(replace(rig.instrument, stage=replace(rig.instrument.stage, **stage)), folder)
    return result, ScanFolder.load(folder).facts("scan_ended")[-1]


@pytest.mark.parametrize(("lost_mm", "told"), [((0.0, 0.0), False), ((0.03, -0.04), False), ((0.0, -1.2), True)])
def test_what_was_lost_is_in_the_manifest_and_what_matters_is_a_warning(rig, tmp_path, lost_mm, told):
    rig.pi.lost_mm = lost_mm
    result, ended = scanned(rig, tmp_path / "s")
    assert (result.exit_status, rig.pi.homings) == ("success", 2)
    assert ended["lost_mm"] == list(lost_mm)
    assert any(f"{lost_mm[1]:.3f} mm in y" in w for w in result.warnings) == told


def test_a_stage_without_switches_is_not_homed_again(rig, tmp_path):
    result, ended = scanned(rig, tmp_path / "s", home_after_scan=False)
    assert (result.exit_status, rig.pi.homings, "lost_mm" in ended) == ("success", 1, False)


def test_homing_that_fails_after_the_last_row_ends_no_scan(rig, tmp_path):
    rig.pi.home_fails = {2}
    result, ended = scanned(rig, tmp_path / "s")
    assert (result.exit_status, ended["exit_status"], "lost_mm" in ended) == ("success", "success", False)
    assert any("switch was not found" in w for w in result.warnings)
    assert ScanFolder.load(tmp_path / "s").complete


def test_only_a_scan_that_has_all_its_rows_is_homed_after(rig, tmp_path):
    """Who stopped it expects no more motion; and a scan that is whole already moves nothing."""
    stop = StopRequest()

    def after_the_first(progress):
        if progress.phase == "committed":
            stop.request()

    assert run_scan(rig.instrument, tmp_path / "s", progress=after_the_first, stop=stop).exit_status == "abort"
    assert rig.pi.homings == 1
    assert resume_scan(tmp_path / "s").exit_status == "success"
    homings = rig.pi.homings
    assert "lost_mm" in ScanFolder.load(tmp_path / "s").facts("scan_ended")[-1]
    assert resume_scan(tmp_path / "s").exit_status == "success"
    assert rig.pi.homings == homings
