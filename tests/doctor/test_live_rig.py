"""The doctor on the processes of the simulated rig: a healthy rig, then one fault after another.

Law: only the check of the broken hop fails, checks that depend on it are skipped, and all others still run.
"""

import dataclasses
import json
import time

import pytest
from tests.support.calibration import make_board_filter, make_filter_file
from tests.support.doctor.case import QUICK
from tests.support.doctor.live_rig import answer_as_pi
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
from polysight_shared.faults import PiFault
from polysight_shared.messages import WIRE_VERSION, BeginRun, HelloReply
from polysight_shared.raster import plan_raster
from polysight_simulators.builds import sketch_compiler

# The published burst, as a scan by another host.
PULSES = 16
PERIOD_US = 1500
WIDTH_US = 1


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
    assert status == 0
    assert document["ok"] is True
    assert document["simulated"] is True
    assert {n for n, f in findings.items() if f["verdict"] not in ("ok", "warning")} == set()
    # The doctor moves the stage past 8 positions, and then sends 64 pulses.
    assert findings["trigger line"]["facts"]["edges"] == 8
    assert findings["pulses"]["facts"]["pulses"] == 64
    assert findings["radar RH"]["facts"]["frames"] == 64
    # Both programs have the clock of this machine: a difference is the delay of the answer, at most a minute.
    assert abs(findings["pi clock"]["facts"]["offset_s"]) < 60
    # The mean of 64 chirps with trigger clocks of 5 ns has a standard error of 0.4 ns; the limit is seven of these.
    assert abs(findings["trigger skew"]["facts"]["skew_ns"]) < 3


def test_nothing_moves_and_no_pulse_is_sent_by_default(live):
    def read_position_and_state():
        with live.connect_to_pi() as pi:
            status = pi.status()
            return status.x_mm, status.y_mm, status.state

    position_before = read_position_and_state()
    findings = live.run_doctor(pulse=False)
    assert read_position_and_state() == position_before
    assert_failed(findings)
    assert {n for n, f in findings.items() if f.level == "note"} == {
        "trigger line", "pulses", "radar RH", "radar RV", "level RH", "level RV", "direct path RH", "direct path RV",
        "trigger skew",
    }  # fmt: skip


def test_a_pi_whose_clock_is_an_hour_slow_is_an_error(live):
    hour_ns = 3_600_000_000_000
    system = dataclasses.replace(QUICK, wall_ns=lambda: time.time_ns() + hour_ns)
    findings = live.run_doctor(system=system)
    assert_failed(findings, "pi clock")
    # The clock is read some seconds after the question at most.
    assert findings["pi clock"].facts["offset_s"] == pytest.approx(-3600, abs=10)


def test_a_pi_that_hangs_fails_alone_and_the_cards_are_still_checked(live):
    with live.stop_process("polysight-pi"):
        findings = live.run_doctor(pulse=True)
    assert_failed(findings, "pi")
    assert list_skipped(findings, "pi") == [
        "pi clock", "rig is free", "stage", "trigger line", "pulses", "radar RH", "radar RV", "level RH", "level RV",
        "direct path RH", "direct path RV", "trigger skew",
    ]  # fmt: skip
    assert findings["card RH"].level == "ok"


def test_a_card_that_is_mute_fails_alone_and_the_other_is_still_checked(live):
    with live.stop_process("--boards RV"):
        findings = live.run_doctor(pulse=True)
    assert_failed(findings, "card RV")
    assert list_skipped(findings, "card RV") == ["buffer RV", "radar RV", "level RV", "direct path RV", "trigger skew"]
    # The last check of the other board was run.
    assert findings["direct path RH"].level == "ok"


def test_a_receive_buffer_that_is_too_small_is_an_error(live):
    # Room for two packets.
    variant = live.write_variant(lambda table: table["card"].update(receive_buffer_bytes=4096))
    findings = live.run_doctor(variant)
    assert_failed(findings, "buffer RH", "buffer RV")


def test_a_sync_in_wire_that_is_cut_is_an_error_of_both_radars(live):
    with live.cut(live.instrument.pi.sync_out[0]):
        findings = live.run_doctor(pulse=True)
    assert_failed(findings, "radar RH", "radar RV")
    # The Pi sends its pulses, and cannot detect that they do not arrive.
    assert findings["pulses"].level == "ok"


def test_a_scan_in_progress_is_not_disturbed(live):
    rig = live.instrument
    run = BeginRun(
        scan_id="another",
        plan=plan_raster(rig.grid),
        pulses=PULSES,
        period_us=PERIOD_US,
        width_us=WIDTH_US,
        speed_mm_s=20,
    )
    with live.connect_to_pi() as pi:
        pi.begin_run(run)
        findings = live.run_doctor(pulse=True, move=True)
        with expect_refusal(ErrorCode.REFUSED_BY_PEER, "another"):
            pi.pulse(PULSES, PERIOD_US, WIDTH_US)
        pi.end_run("another", "abort", "test")
    assert_failed(findings, "rig is free")
    assert {"card RH", "card RV", "pulses", "trigger line"} <= set(list_skipped(findings, "rig is free"))


def test_a_scan_keeps_the_calibration_it_was_taken_with(live):
    # RH has the corners of `make_filter_file`, 180.5 and 355.25 kHz.
    filters = make_filter_file(rv=make_board_filter(first_khz=172.5, second_khz=347.0))
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


def test_a_trigger_wire_that_is_cut_is_an_error_without_edges(live):
    with live.cut(live.instrument.pi.trigger_in):
        findings = live.run_doctor(move=True)
    try:
        assert_failed(findings, "trigger line")
        assert findings["trigger line"].facts["edges"] == 0
    finally:
        # The fault that the Pi reported lasts until the next homing.
        live.home()


def test_a_silent_stage_fails_alone_and_the_cards_are_still_checked(live):
    # The stage is the compiled sketch, which alone has this option, or its Python stand-in.
    word_in_command = "--trigger-line" if sketch_compiler() else "polysight_simulators.stage"
    try:
        with live.stop_process(word_in_command):
            with live.connect_to_pi() as pi:
                wait_for(lambda: pi.status().state == "fault", "the fault")
            findings = live.run_doctor(move=True)
        assert_failed(findings, "stage")
        assert findings["stage"].facts["fault"] == PiFault.STAGE_LOST
        assert list_skipped(findings, "stage") == ["trigger line"]
        assert findings["card RV"].level == "ok"
    finally:
        live.home()


# --- a fake Pi at the real socket ---


def make_hello_reply(**changes):
    """The reply of a homed Pi of this release, with `changes`."""
    values = {"pi_release": __version__, "firmware": __version__, "backend": "gpiod", "state": "homed"}
    return HelloReply(**{**values, "scan_id": "", "last_seq": 0, "t_unix_ns": 0, **changes})


def test_a_pi_of_this_release_is_ok(deaf_rig):
    with answer_as_pi(deaf_rig.instrument, make_hello_reply()):
        findings = deaf_rig.run_doctor()
    assert findings["pi"].level == "ok"
    assert findings["stage"].level == "ok"
    assert findings["rig is free"].level == "ok"
    # Its reply has the time 0: such a Pi does not say what its clock shows.
    assert findings["pi clock"].level == "note"
    assert [n for n, f in findings.items() if f.level == "error"] == ["card RH", "card RV"]


@pytest.mark.parametrize(
    ("changes", "version", "check", "skips"),
    [
        ({"pi_release": "0.0.9"}, WIRE_VERSION, "pi", "stage"),
        # Any version of the wire but this release's.
        ({}, "2.0", "pi", "stage"),
        ({"firmware": "0.0.7"}, WIRE_VERSION, "stage", "trigger line"),
        ({"firmware": ""}, WIRE_VERSION, "stage", "trigger line"),
    ],
    ids=["release", "wire version", "sketch", "no sketch"],
)
def test_a_pi_of_another_release_is_an_error(deaf_rig, changes, version, check, skips):
    with answer_as_pi(deaf_rig.instrument, make_hello_reply(**changes), version):
        findings = deaf_rig.run_doctor()
    assert findings[check].level == "error"
    assert all(value in findings[check].what for value in changes.values())
    assert skips in list_skipped(findings, check)
