"""Before a row: homing fails with the Pi's own reason, and the disk space checked is that of the rows."""

from __future__ import annotations

import shutil
from types import SimpleNamespace
from typing import Any

import pytest

from polysight.host.acquisition import ready
from polysight.host.acquisition.control import StopRequest
from polysight.host.acquisition.ready import check_disk, make_ready
from polysight.host.doctor.check_host import check_time
from polysight.host.plan.forecast import forecast
from polysight.shared.error_codes import ErrorCode
from polysight.shared.faults import PiFault
from polysight.shared.stage_line import HOMING_TIMEOUT_S
from tests.support.refusals import refused


class HomingPi:
    """Homes forever; fails after `limit_s` with a reason, as the Pi does."""

    def __init__(self, limit_s: float) -> None:
        self.now, self._limit_s = 0.0, limit_s
        self._began: float | None = None
        self.event_socket = SimpleNamespace(poll=self._poll)

    def _poll(self, _: int) -> None:
        self.now += 1.0

    def monotonic(self) -> float:
        return self.now

    def home(self) -> None:
        self._began = self.now + 10.0  # accepted, and begun later

    def status(self) -> SimpleNamespace:
        told = {"homed": False, "scan_id": "", "fault": 0, "reason": ""}
        if self._began is None:
            return SimpleNamespace(**told | {"state": "idle"})
        if self.now > self._began + self._limit_s:
            lost = {"fault": int(PiFault.STAGE_LOST), "reason": f"not homed after {self._limit_s} s"}
            return SimpleNamespace(**told | {"state": "fault"} | lost)
        return SimpleNamespace(**told | {"state": "homing"})

    def events(self) -> list:
        return []


@pytest.mark.parametrize(("limit_s", "reason"), [(HOMING_TIMEOUT_S, "not homed after"), (1e9, "'homing'")])
def test_homing_that_fails_or_never_ends_is_an_error_with_the_pis_reason(monkeypatch, limit_s, reason):
    pi: Any = HomingPi(limit_s)
    monkeypatch.setattr(ready, "time", pi)
    with refused(ErrorCode.STAGE_NOT_READY, reason):
        make_ready(pi, StopRequest(), lambda *_: None)


def test_pi_and_host_have_the_same_homing_timeout():
    from polysight.pi_controller import machine, stage

    assert machine.TIMEOUTS_S["homing"] == stage.MOTION_TIMEOUT_S == HOMING_TIMEOUT_S < ready._HOMING_TIMEOUT_S


@pytest.mark.parametrize("rows", [1, 3, 4])
def test_disk_space_checked_is_that_of_the_rows(make_instrument, tmp_path, monkeypatch, rows):
    """The law of sizes: rows x boards that are recorded x what one board sends; the same in plan, doctor and scan."""
    rig = make_instrument(free_disk_bytes=1000)
    assert len(rig.recorded) == 2
    need = rows * 2 * rig.grid.columns * rig.burst.pulses * rig.frame_bytes
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=need + 1000))
    check_disk(tmp_path, rig, rows)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=need + 999))
    with refused(ErrorCode.DISK_FULL, rows):
        check_disk(tmp_path, rig, rows)


def test_plan_and_doctor_tell_the_size_of_a_scan(make_instrument):
    rig = make_instrument()
    assert forecast(rig).raw_bytes == rig.scan_bytes == rig.grid.rows * rig.recorded_row_bytes
    bench: Any = SimpleNamespace(rig=rig)
    assert check_time(bench).facts["bytes"] == rig.scan_bytes
