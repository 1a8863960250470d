"""Before the first row: homing, disk space, a Pi with the same [stage]; after the last: lost steps."""

import shutil
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts

from polysight.acquisition import ready
from polysight.acquisition.control import StopRequest
from polysight.acquisition.pi_client import MOVING, PiClient
from polysight.acquisition.ready import STAGE_NOT_REPORTED, check_between_rows, check_disk, make_ready
from polysight.acquisition.scan import resume_scan, run_scan
from polysight.doctor.rig_checks import check_time
from polysight.planning.forecast import forecast
from polysight.store.scan_folder import ScanFolder
from polysight_shared.errors import ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.messages import StatusReply
from polysight_shared.stage_line import HOMING_TIMEOUT_S


class HomingPi:
    """A Pi that homes without end, or fails after `limit_s` with a reason. It also replaces the clock, `time`."""

    def __init__(self, limit_s: float) -> None:
        self.now = 0.0
        self._limit_s = limit_s
        self._began: float | None = None
        self.event_socket = SimpleNamespace(poll=self._poll)

    def _poll(self, _: int) -> None:
        self.now += 1.0

    def monotonic(self) -> float:
        return self.now

    def home(self) -> None:
        # The command is accepted, and homing begins later.
        self._began = self.now + 10.0

    def status(self) -> SimpleNamespace:
        answer = {"homed": False, "scan_id": "", "fault": 0, "reason": ""}
        if self._began is None:
            return SimpleNamespace(**answer | {"state": "idle"})
        if self.now > self._began + self._limit_s:
            stage_lost = {"fault": int(PiFault.STAGE_LOST), "reason": f"not homed after {self._limit_s} s"}
            return SimpleNamespace(**answer | {"state": "fault"} | stage_lost)
        return SimpleNamespace(**answer | {"state": "homing"})

    def events(self) -> list:
        return []


ENDLESS_S = 1e9


@pytest.mark.parametrize(("limit_s", "reason"), [(HOMING_TIMEOUT_S, "not homed after"), (ENDLESS_S, "'homing'")])
def test_homing_that_fails_or_never_ends_is_an_error_with_the_pis_reason(monkeypatch, limit_s, reason):
    pi: Any = HomingPi(limit_s)
    monkeypatch.setattr(ready, "time", pi)
    with expect_refusal(ErrorCode.STAGE_NOT_READY, reason):
        make_ready(pi, StopRequest(), lambda *_: None)


@pytest.mark.parametrize(("state", "times_sent"), [("idle", 2), ("ready", 2), ("homing", 1)])
def test_a_home_command_without_a_reply_is_sent_again_unless_the_stage_homes(state, times_sent):
    """A stage that is still `ready` has not begun to home: its lost steps would be those of an earlier homing."""
    sent = []
    pi: Any = SimpleNamespace(_owner="",
        _timeout_s=1.0, _send_once=lambda *given: sent.append(given), _ask=lambda *given: sent.append(given),
        status=lambda: SimpleNamespace(state=state),
    )  # fmt: skip
    PiClient.home(pi)
    assert len(sent) == times_sent


@pytest.mark.parametrize(
    ("state", "homed", "is_ready"),
    [
        ("ready", True, True),
        ("ready", False, False),
        # A stage that moves has lost no position; the next row waits for it.
        *((moving, False, True) for moving in MOVING),
        ("idle", True, False),
        ("homed", True, False),
        ("fault", True, False),
    ],
)
def test_between_rows_a_stage_that_must_be_homed_needs_a_person(state, homed, is_ready):
    status = StatusReply(
        state=state, homed=homed, x_mm=0.0, y_mm=0.0, scan_id="s", row_index=-1, take=0, points=0, pulses=0, last_seq=0,
        fault=0, reason="",
    )  # fmt: skip
    if is_ready:
        check_between_rows(status, "s", first=False)
    else:
        with expect_refusal(ErrorCode.STAGE_NOT_READY):
            check_between_rows(status, "s", first=False)
        # Before the first row it is homed, also out of a fault.
        check_between_rows(status, "s", first=True)


def test_pi_and_host_agree_on_the_homing_timeout_and_the_host_waits_longer():
    from polysight_pi import rules, stage

    assert rules.TIMEOUTS_S["homing"] == stage.MOTION_TIMEOUT_S == HOMING_TIMEOUT_S < ready._HOMING_TIMEOUT_S


@pytest.mark.parametrize("rows", [1, 3, 4])
def test_disk_space_checked_is_that_of_the_rows(make_instrument, tmp_path, monkeypatch, rows):
    """Rows x recorded boards x bytes of a board's row; plan, doctor and scan use the same size."""
    rig = make_instrument(free_disk_bytes=1000)
    assert len(rig.recorded) == 2
    needed_bytes = rows * 2 * rig.grid.columns * rig.burst.pulses * rig.frame_bytes
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=needed_bytes + 1000))
    check_disk(tmp_path, rig, rows)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=needed_bytes + 999))
    with expect_refusal(ErrorCode.DISK_FULL, rows):
        check_disk(tmp_path, rig, rows)


def test_plan_and_doctor_show_the_size_of_a_scan(make_instrument):
    rig = make_instrument()
    assert forecast(rig).raw_bytes == rig.scan_bytes == rig.grid.rows * rig.recorded_row_bytes
    bench: Any = SimpleNamespace(rig=rig)
    assert check_time(bench).facts["bytes"] == rig.scan_bytes


@pytest.mark.parametrize("key", ["steps_per_mm", "centre_x_mm", "centre_y_mm", "backlash_mm", "accel_mm_s2"])
def test_a_pi_with_other_stage_settings_is_refused_before_a_folder_is_made(rig, tmp_path, key):
    own_value = rig.instrument.stage.placement_settings[key]
    rig.pi.placement_settings = {**rig.pi.placement_settings, key: own_value + 0.5}
    with expect_refusal(ErrorCode.STAGE_DIFFERS, key, f"{own_value:g}", f"{own_value + 0.5:g}"):
        run_scan(rig.instrument, tmp_path / "s")
    assert not (tmp_path / "s").exists()
    # The only command was Hello.
    assert len(rig.pi.commands) <= 1


def test_resuming_with_another_rig_file_on_the_pi_is_refused_until_it_has_the_old_one(rig, tmp_path):
    stop = StopRequest()
    right = rig.pi.placement_settings
    run_scan(rig.instrument, tmp_path / "s", on_row=lambda _: stop.request(), stop=stop)
    scan = ScanFolder.load(tmp_path / "s")
    assert load_facts(scan, "scan_started")[0]["pi"]["stage"] == right == rig.instrument.stage.placement_settings
    rows = list(scan.rows())
    facts = len(load_facts(scan))
    assert not scan.complete
    rig.pi.placement_settings = {**right, "centre_x_mm": right["centre_x_mm"] + 5}
    with expect_refusal(ErrorCode.STAGE_DIFFERS, "centre_x_mm", 400, 405):
        resume_scan(tmp_path / "s")
    scan.reload()
    # Nothing was written.
    assert (list(scan.rows()), len(load_facts(scan))) == (rows, facts)
    rig.pi.placement_settings = right
    assert resume_scan(tmp_path / "s").folder.complete
    scan.reload()
    assert load_facts(scan, "scan_resumed")[0]["pi"] == {
        "release": "t",
        "firmware": "t",
        "backend": "fake",
        "stage": right,
    }


def test_a_pi_that_does_not_report_its_stage_is_a_warning(rig, tmp_path):
    """A Pi of an older release, with the same version of the protocol."""
    rig.pi.placement_settings = {}
    result = run_scan(rig.instrument, tmp_path / "s")
    assert result.exit_status == "success"
    assert STAGE_NOT_REPORTED in result.warnings


def test_settings_that_do_not_place_rows_may_differ(rig):
    stage = rig.instrument.stage
    same = msgspec.structs.replace(stage, port="elsewhere", speed_mm_s=stage.speed_mm_s / 2, heartbeat_ms=2000)
    assert same.placement_settings == stage.placement_settings


def test_a_scan_begun_without_comparison_resumes_with_a_warning(rig, tmp_path):
    """The earlier rows were placed with that Pi's settings; only the same settings continue them."""
    stop = StopRequest()
    right = rig.pi.placement_settings
    rig.pi.placement_settings = {}
    run_scan(rig.instrument, tmp_path / "s", on_row=lambda _: stop.request(), stop=stop)
    second_stop = StopRequest()
    resumed = resume_scan(tmp_path / "s", on_row=lambda _: second_stop.request(), stop=second_stop)
    assert STAGE_NOT_REPORTED in resumed.warnings
    rig.pi.placement_settings = {**right, "centre_x_mm": right["centre_x_mm"] + 5}
    result = resume_scan(tmp_path / "s")
    assert result.folder.complete
    assert any("not compared" in w and "centre_x_mm" in w for w in result.warnings)


def start_scan(rig, folder, **stage):
    """Run a scan with these settings of [stage]; return its result and its `scan_ended`."""
    replace = msgspec.structs.replace
    result = run_scan(replace(rig.instrument, stage=replace(rig.instrument.stage, **stage)), folder)
    return result, load_facts(folder, "scan_ended")[-1]


@pytest.mark.parametrize(
    ("lost_mm", "is_warned"), [((0.0, 0.0), False), ((0.03, -0.04), False), ((-0.05, 0.0), True), ((0.0, -1.2), True)]
)
def test_lost_steps_are_in_the_manifest_and_large_ones_are_a_warning(rig, tmp_path, lost_mm, is_warned):
    rig.pi.lost_steps_mm = lost_mm
    result, ended = start_scan(rig, tmp_path / "s")
    assert (result.exit_status, rig.pi.homings) == ("success", 2)
    assert ended["lost_mm"] == list(lost_mm)
    assert any(f"{lost_mm[1]:.3f} mm in y" in w for w in result.warnings) == is_warned


def test_a_stage_without_switches_is_not_homed_again(rig, tmp_path):
    result, ended = start_scan(rig, tmp_path / "s", home_after_scan=False)
    assert (result.exit_status, rig.pi.homings) == ("success", 1)
    assert "lost_mm" not in ended


def test_homing_that_fails_after_the_last_row_ends_no_scan(rig, tmp_path):
    rig.pi.failing_homings = {2}
    result, ended = start_scan(rig, tmp_path / "s")
    assert result.exit_status == ended["exit_status"] == "success"
    assert "lost_mm" not in ended
    assert any("switch was not found" in w for w in result.warnings)
    assert ScanFolder.load(tmp_path / "s").complete


def test_the_stage_is_homed_after_a_scan_only_if_that_has_recorded_its_last_row(rig, tmp_path):
    """An operator who stopped the scan expects no motion, and a complete scan needs none."""
    stop = StopRequest()

    def after_the_first(progress):
        if progress.phase == "committed":
            stop.request()

    assert run_scan(rig.instrument, tmp_path / "s", progress=after_the_first, stop=stop).exit_status == "abort"
    assert rig.pi.homings == 1
    assert resume_scan(tmp_path / "s").exit_status == "success"
    homings = rig.pi.homings
    assert "lost_mm" in load_facts(tmp_path / "s", "scan_ended")[-1]
    assert resume_scan(tmp_path / "s").exit_status == "success"
    assert rig.pi.homings == homings
