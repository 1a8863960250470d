"""Rows of one scan have one coordinate system: a Pi with another [stage] is refused, at the start and when resuming."""

from __future__ import annotations

import msgspec
import pytest

from polysight.host.acquisition.control import StopRequest
from polysight.host.acquisition.ready import STAGE_NOT_REPORTED
from polysight.host.acquisition.scan import resume_scan, run_scan
from polysight.host.store.scan_folder import ScanFolder
from polysight.shared.error_codes import ErrorCode
from tests.support.refusals import refused


@pytest.mark.parametrize("key", ["steps_per_mm", "centre_x_mm", "centre_y_mm", "backlash_mm", "accel_mm_s2"])
def test_a_pi_that_places_rows_elsewhere_is_refused_before_a_folder_is_made(rig, tmp_path, key):
    own = rig.instrument.stage.placement_settings[key]
    rig.pi.stage = {**rig.pi.stage, key: own + 0.5}
    with refused(ErrorCode.STAGE_DIFFERS, key, f"{own:g}", f"{own + 0.5:g}"):
        run_scan(rig.instrument, tmp_path / "s")
    assert not (tmp_path / "s").exists()
    assert rig.pi.commands[-1:] == rig.pi.commands[:1], "nothing but Hello was asked"


def test_resuming_after_the_pis_rig_file_changed_is_refused_and_mended_by_its_old_one(rig, tmp_path):
    stop, right = StopRequest(), rig.pi.stage
    run_scan(rig.instrument, tmp_path / "s", on_row=lambda _: stop.request(), stop=stop)
    scan = ScanFolder.load(tmp_path / "s")
    assert scan.facts("scan_started")[0]["pi"]["stage"] == right == rig.instrument.stage.placement_settings
    rows, facts = list(scan.rows()), len(scan.content.facts)
    assert not scan.complete
    rig.pi.stage = {**right, "centre_x_mm": right["centre_x_mm"] + 5}
    with refused(ErrorCode.STAGE_DIFFERS, "centre_x_mm", 400, 405):
        resume_scan(tmp_path / "s")
    scan.reload()
    assert (list(scan.rows()), len(scan.content.facts)) == (rows, facts), "nothing was written"
    rig.pi.stage = right
    assert resume_scan(tmp_path / "s").folder.complete
    scan.reload()
    assert scan.facts("scan_resumed")[0]["pi"] == {"release": "t", "firmware": "t", "backend": "fake", "stage": right}


def test_a_pi_that_does_not_report_its_stage_is_a_warning(rig, tmp_path):
    """A Pi of an older release: the wire's version is the same."""
    rig.pi.stage = {}
    result = run_scan(rig.instrument, tmp_path / "s")
    assert result.exit_status == "success"
    assert STAGE_NOT_REPORTED in result.warnings


def test_settings_that_do_not_place_rows_may_differ(rig):
    stage = rig.instrument.stage
    same = msgspec.structs.replace(stage, port="elsewhere", speed_mm_s=stage.speed_mm_s / 2, heartbeat_ms=2000)
    assert same.placement_settings == stage.placement_settings


def test_a_scan_begun_without_comparison_resumes_with_a_warning(rig, tmp_path):
    """Its rows lie where that Pi had them; refusing it would have them put elsewhere."""
    stop, right = StopRequest(), rig.pi.stage
    rig.pi.stage = {}
    run_scan(rig.instrument, tmp_path / "s", on_row=lambda _: stop.request(), stop=stop)
    again = StopRequest()
    assert STAGE_NOT_REPORTED in resume_scan(tmp_path / "s", on_row=lambda _: again.request(), stop=again).warnings
    rig.pi.stage = {**right, "centre_x_mm": right["centre_x_mm"] + 5}
    result = resume_scan(tmp_path / "s")
    assert result.folder.complete
    assert any("not compared" in w and "centre_x_mm" in w for w in result.warnings)
