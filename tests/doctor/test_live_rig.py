"""The doctor on the simulated rig's own processes: a healthy rig, then one fault after another.

Law: just the hop that is broken is wrong, what lies behind it says so, and what does not depend on it is still tried.
"""

import dataclasses
import json
import time

import pytest

from polysight.host.acquisition.scan import run_scan
from polysight.host.calibration.files import BoardFilter, FilterFile, SourceScan, header, write_calibration
from polysight.host.cli.main import main
from polysight.host.doctor.bench import System
from polysight.host.doctor.receiver_load import Held
from polysight.host.pipeline import Pipeline
from polysight.host.store.scan_folder import ScanFolder
from polysight.host.store.validation import validate
from polysight.shared.config import load_instrument
from polysight.shared.errors import PolysightError
from polysight.shared.messages import BeginRun
from polysight.shared.raster import plan_raster

QUICK = System(
    write_speed=lambda _folder: 200e6, held=lambda _rig, rates: ([Held(r, r, 9, 0) for r in rates], "any core")
)


def only_wrong(findings, *names):
    """These checks are wrong, and no others."""
    assert [n for n, f in findings.items() if f.verdict == "error"] == list(names), findings


def behind(findings, cause):
    """Checks that were not tried because of this one."""
    return [n for n, f in findings.items() if f.verdict == "not checked" and f.found == f"{cause} failed"]


def test_a_healthy_rig_is_ok_to_the_last_hop(live, capsys):
    status = main(["doctor", "--config", str(live.config), "--out", str(live.folder), "--move", "--json"])
    told = json.loads(capsys.readouterr().out)
    found = {f["check"]: f for f in told["findings"]}
    assert (status, told["ok"], told["simulated"]) == (0, True, True)
    assert {n for n, f in found.items() if f["verdict"] not in ("ok", "warning")} == set()
    assert found["trigger line"]["facts"]["edges"] == 8
    assert found["radar RH"]["facts"]["frames"] == found["pulses"]["facts"]["pulses"] == 64
    assert abs(found["pi clock"]["facts"]["offset_s"]) < 60
    assert abs(found["trigger skew"]["facts"]["skew_ns"]) < 3


def test_nothing_moves_and_nothing_is_pulsed_unless_asked_for(live):
    def place():
        with live.pi() as pi:
            status = pi.status()
            return status.x_mm, status.y_mm, status.state

    before = place()
    found = live.doctor(pulse=False)
    assert place() == before
    only_wrong(found)
    assert {n for n, f in found.items() if f.verdict == "not checked"} == {
        "trigger line", "pulses", "radar RH", "radar RV", "level RH", "level RV", "direct path RH", "direct path RV",
        "trigger skew",
    }  # fmt: skip


def test_the_pis_clock_is_off(live):
    found = live.doctor(system=dataclasses.replace(QUICK, wall_ns=lambda: time.time_ns() + 3_600_000_000_000))
    only_wrong(found, "pi clock")
    assert found["pi clock"].facts["offset_s"] == pytest.approx(-3600, abs=10)


def test_a_pi_that_hangs(live):
    with live.stopped("polysight-pi"):
        found = live.doctor(pulse=True)
    only_wrong(found, "pi")
    assert "did not answer" in found["pi"].found
    assert behind(found, "pi") == [
        "pi clock", "rig is free", "stage", "trigger line", "pulses", "radar RH", "radar RV", "level RH", "level RV",
        "direct path RH", "direct path RV", "trigger skew",
    ]  # fmt: skip
    assert found["card RH"].verdict == "ok"


def test_a_card_that_is_mute(live):
    with live.stopped("--boards RV"):
        found = live.doctor(pulse=True)
    only_wrong(found, "card RV")
    assert behind(found, "card RV") == ["buffer RV", "radar RV", "level RV", "direct path RV", "trigger skew"]
    assert found["direct path RH"].verdict == "ok"  # the other board is looked at to its end


def test_a_card_at_another_address(live):
    def elsewhere(table):
        table["boards"][1]["card_address"] = table["boards"][1]["card_address"].rpartition(".")[0] + ".77"

    found = live.doctor(live.variant(elsewhere))
    only_wrong(found, "card RH")
    assert ".77:" in found["card RH"].found
    assert "address" in found["card RH"].why


def test_a_receive_buffer_that_is_too_small(live):
    found = live.doctor(live.variant(lambda table: table["card"].update(receive_buffer_bytes=4096)))
    only_wrong(found, "buffer RH", "buffer RV")
    assert "receive_buffer_bytes" in found["buffer RH"].remedy


def test_a_sync_in_wire_that_is_cut(live):
    with live.cut(live.instrument.pi.sync_out[0]):
        found = live.doctor(pulse=True)
    only_wrong(found, "radar RH", "radar RV")
    assert found["pulses"].verdict == "ok"  # the Pi cannot know
    assert "not streaming" in found["radar RH"].why


def test_a_scan_that_runs_is_left_alone(live):
    rig = live.instrument
    run = BeginRun(scan_id="another", plan=plan_raster(rig.grid), pulses=16, period_us=1500, width_us=1, speed_mm_s=20)
    with live.pi() as pi:
        pi.begin_run(run)
        found = live.doctor(pulse=True, move=True)
        with pytest.raises(PolysightError, match="run another is begun"):
            pi.pulse(16, 1500, 1)
        pi.end_run("another", "abort", "test")
    only_wrong(found, "rig is free")
    assert {"card RH", "card RV", "pulses", "trigger line"} <= set(behind(found, "rig is free"))


def test_a_pulse_the_radars_cannot_take_is_refused_by_the_pi(live):
    with live.pi() as pi:
        with pytest.raises(PolysightError, match="period"):
            pi.pulse(16, 100, 1)
        with pytest.raises(PolysightError, match="width"):
            pi.pulse(16, 1500, 5)
        assert pi.pulse(3, 1500, 1).pulses == 3


def test_a_scan_keeps_the_calibration_it_was_taken_with(live):
    board = BoardFilter([180.5, 355.0], [1.0, 2.0], [175.0, 350.0], 100.0, 1900.0, 640, 0.05)
    other = BoardFilter([172.5, 347.0], [1.0, 2.0], [175.0, 350.0], 100.0, 1900.0, 640, 0.05)
    sources = [SourceScan("sweep", "scans/sweep", True, 6)]
    path = write_calibration(
        FilterFile(**header("hpf", sources), boards={"RH": board, "RV": other}), live.folder / "calibration"
    )

    def small(table):
        table["calibration"] = {"hpf": str(path)}
        table["grid"] |= {"rows": 2, "columns": 3}

    config = live.variant(small)
    live.home()
    scan = run_scan(load_instrument(config), live.folder / "scan").folder
    path.unlink()
    fact = scan.facts("scan_started")[0]["calibration"]
    assert fact == {
        "hpf": {"file": f"calibration/{path.name}", "crc32": fact["hpf"]["crc32"], "copied_from": str(path)}
    }
    assert validate(scan.path) == []
    pipeline = Pipeline(ScanFolder.load(scan.path))
    assert pipeline.synchroniser.setups["RH"].equaliser.model.corners_hz == (180.5e3, 355e3)
    assert pipeline.synchroniser.setups["RV"].equaliser.model.corners_hz == (172.5e3, 347e3)


def test_a_trigger_wire_that_is_cut(live):
    with live.cut(live.instrument.pi.trigger_in):
        found = live.doctor(move=True)
    try:
        only_wrong(found, "trigger line")
        assert found["trigger line"].facts["edges"] == 0
        assert "stuck" in found["trigger line"].why
    finally:
        live.home()


def test_a_stage_that_is_silent(live):
    try:
        with live.stopped("--trigger-line" if _stage_is_compiled() else "polysight.simulators.stage"):
            with live.pi() as pi:
                _wait(lambda: pi.status().state == "fault")
            found = live.doctor(move=True)
        only_wrong(found, "stage")
        assert found["stage"].facts["fault"] == 101
        assert behind(found, "stage") == ["trigger line"]
        assert found["card RV"].verdict == "ok"
    finally:
        live.home()


def _stage_is_compiled():
    """Whether the stage is the sketch itself, not its Python stand-in."""
    from polysight.simulators.builds import sketch_compiler

    return sketch_compiler() is not None


def _wait(condition, limit_s=60.0):
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)
