"""The doctor on the processes of the simulated rig: a healthy rig, then one fault after another.

Law: only the check of the broken hop fails, checks that depend on it are skipped, and all others still run.
"""

import dataclasses
import json
import time

import pytest
from tests.support.calibration import filter_file, read_board_filter
from tests.support.doctor.case import QUICK
from tests.support.doctor.live_rig import answering
from tests.support.processes import wait_for
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts

from polysight.acquisition.scan import run_scan
from polysight.calibration.files import write_calibration
from polysight.doctor.checks import run_doctor
from polysight.doctor.context import DoctorOptions
from polysight.pipeline import Pipeline
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared import __version__
from polysight_shared.config import load_instrument
from polysight_shared.errors import ErrorCode
from polysight_shared.messages import WIRE_VERSION, BeginRun, HelloReply
from polysight_shared.raster import plan_raster
from polysight_simulators.builds import sketch_compiler


def assert_failed(findings, *names):
    """These checks failed, and no others."""
    assert [n for n, f in findings.items() if f.level == "error"] == list(names), findings


def list_skipped(findings, cause):
    """Checks that were skipped because this one failed."""
    return [n for n, f in findings.items() if f.level == "note" and f.what == f"{cause} failed"]


def test_all_checks_of_a_healthy_rig_pass(live, capsys):
    status = run_doctor(DoctorOptions(live.config, live.folder, move=True), as_json=True, system=QUICK)
    document = json.loads(capsys.readouterr().out)
    findings = {f["check"]: f for f in document["findings"]}
    assert [f for f in document["findings"] if f["verdict"] == "error"] == []
    assert (status, document["ok"], document["simulated"]) == (0, True, True)
    assert {n for n, f in findings.items() if f["verdict"] not in ("ok", "warning")} == set()
    assert findings["trigger line"]["facts"]["edges"] == 8
    assert findings["radar RH"]["facts"]["frames"] == findings["pulses"]["facts"]["pulses"] == 64
    assert abs(findings["pi clock"]["facts"]["offset_s"]) < 60
    assert abs(findings["trigger skew"]["facts"]["skew_ns"]) < 3


def test_nothing_moves_and_no_pulse_is_sent_by_default(live):
    def read_place():
        with live.connect_to_pi() as pi:
            status = pi.status()
            return status.x_mm, status.y_mm, status.state

    place_before = read_place()
    findings = live.run_doctor(pulse=False)
    assert read_place() == place_before
    assert_failed(findings)
    assert {n for n, f in findings.items() if f.level == "note"} == {
        "trigger line", "pulses", "radar RH", "radar RV", "level RH", "level RV", "direct path RH", "direct path RV",
        "trigger skew",
    }  # fmt: skip


def test_the_pis_clock_is_off(live):
    findings = live.run_doctor(system=dataclasses.replace(QUICK, wall_ns=lambda: time.time_ns() + 3_600_000_000_000))
    assert_failed(findings, "pi clock")
    assert findings["pi clock"].facts["offset_s"] == pytest.approx(-3600, abs=10)


def test_a_pi_that_hangs(live):
    with live.stop_process("polysight-pi"):
        findings = live.run_doctor(pulse=True)
    assert_failed(findings, "pi")
    assert list_skipped(findings, "pi") == [
        "pi clock", "rig is free", "stage", "trigger line", "pulses", "radar RH", "radar RV", "level RH", "level RV",
        "direct path RH", "direct path RV", "trigger skew",
    ]  # fmt: skip
    assert findings["card RH"].level == "ok"


def test_a_card_that_is_mute(live):
    with live.stop_process("--boards RV"):
        findings = live.run_doctor(pulse=True)
    assert_failed(findings, "card RV")
    assert list_skipped(findings, "card RV") == ["buffer RV", "radar RV", "level RV", "direct path RV", "trigger skew"]
    # The other board is checked to its end
    assert findings["direct path RH"].level == "ok"


def test_a_receive_buffer_that_is_too_small(live):
    findings = live.run_doctor(live.write_variant(lambda table: table["card"].update(receive_buffer_bytes=4096)))
    assert_failed(findings, "buffer RH", "buffer RV")


def test_a_sync_in_wire_that_is_cut(live):
    with live.cut(live.instrument.pi.sync_out[0]):
        findings = live.run_doctor(pulse=True)
    assert_failed(findings, "radar RH", "radar RV")
    # The Pi cannot detect it
    assert findings["pulses"].level == "ok"


def test_a_scan_in_progress_is_not_disturbed(live):
    rig = live.instrument
    run = BeginRun(scan_id="another", plan=plan_raster(rig.grid), pulses=16, period_us=1500, width_us=1, speed_mm_s=20)
    with live.connect_to_pi() as pi:
        pi.begin_run(run)
        findings = live.run_doctor(pulse=True, move=True)
        with expect_refusal(ErrorCode.REFUSED_BY_PEER, "another"):
            pi.pulse(16, 1500, 1)
        pi.end_run("another", "abort", "test")
    assert_failed(findings, "rig is free")
    assert {"card RH", "card RV", "pulses", "trigger line"} <= set(list_skipped(findings, "rig is free"))


def test_a_scan_keeps_the_calibration_it_was_taken_with(live):
    filters = filter_file(rv=read_board_filter(172.5, 347.0))
    path = write_calibration(filters, live.folder / "calibration")

    def shorten_scan(table):
        table["calibration"] = {"hpf": str(path)}
        table["grid"] |= {"rows": 2, "columns": 3}

    config = live.write_variant(shorten_scan)
    live.home()
    scan = run_scan(load_instrument(config), live.folder / "scan").folder
    path.unlink()
    fact = load_facts(scan, "scan_started")[0]["calibration"]
    assert fact == {
        "hpf": {"file": f"calibration/{path.name}", "crc32": fact["hpf"]["crc32"], "copied_from": str(path)}
    }
    assert validate(scan.path) == []
    pipeline = Pipeline(ScanFolder.load(scan.path))
    assert pipeline.synchroniser.setups["RH"].equaliser.model.corners_hz == (180.5e3, 355.25e3)
    assert pipeline.synchroniser.setups["RV"].equaliser.model.corners_hz == (172.5e3, 347e3)


def test_a_trigger_wire_that_is_cut(live):
    with live.cut(live.instrument.pi.trigger_in):
        findings = live.run_doctor(move=True)
    try:
        assert_failed(findings, "trigger line")
        assert findings["trigger line"].facts["edges"] == 0
    finally:
        live.home()


def test_a_stage_that_is_silent(live):
    try:
        with live.stop_process("--trigger-line" if sketch_compiler() else "polysight_simulators.stage"):
            with live.connect_to_pi() as pi:
                wait_for(lambda: pi.status().state == "fault", "the fault")
            findings = live.run_doctor(move=True)
        assert_failed(findings, "stage")
        assert findings["stage"].facts["fault"] == 101
        assert list_skipped(findings, "stage") == ["trigger line"]
        assert findings["card RV"].level == "ok"
    finally:
        live.home()


# --- a fake Pi at the real socket ---


def reply(**changes):
    values = {"pi_release": __version__, "firmware": __version__, "backend": "gpiod", "state": "homed"}
    return HelloReply(**{**values, "scan_id": "", "last_seq": 0, "t_unix_ns": 0, **changes})


def test_a_pi_of_this_release_is_ok(deaf_rig):
    with answering(deaf_rig.instrument, reply()):
        findings = deaf_rig.run_doctor()
    assert findings["pi"].level == findings["stage"].level == findings["rig is free"].level == "ok"
    assert findings["pi clock"].level == "note"
    assert [n for n, f in findings.items() if f.level == "error"] == ["card RH", "card RV"]


@pytest.mark.parametrize(
    ("changes", "version", "check", "skips"),
    [
        ({"pi_release": "0.0.9"}, WIRE_VERSION, "pi", "stage"),
        ({}, "2.0", "pi", "stage"),
        ({"firmware": "0.0.7"}, WIRE_VERSION, "stage", "trigger line"),
        ({"firmware": ""}, WIRE_VERSION, "stage", "trigger line"),
    ],
    ids=["release", "wire version", "sketch", "no sketch"],
)
def test_a_pi_of_another_release_is_an_error(deaf_rig, changes, version, check, skips):
    with answering(deaf_rig.instrument, reply(**changes), version):
        findings = deaf_rig.run_doctor()
    assert findings[check].level == "error"
    assert all(value in findings[check].what for value in changes.values())
    assert skips in list_skipped(findings, check)
