"""Single checks of this machine, and the order of all checks."""

import dataclasses
from pathlib import Path

import msgspec
import pytest
import tomli_w
from tests.support.calibration import make_filter_file
from tests.support.doctor.case import QUICK, RIG, make_context
from tests.support.rigs import make_programmed_rig

from polysight.calibration.files import write_calibration
from polysight.capture.card import CardSurvey
from polysight.capture.network import route_interface
from polysight.cli.main import main
from polysight.doctor import checks, context
from polysight.doctor.checks import CHECKS, run_checks
from polysight.doctor.context import CheckContext, DoctorOptions, LoadResult, System, error, measure_receivers, ok
from polysight.doctor.rig_checks import (
    check_buffer,
    check_calibration,
    check_disk,
    check_host_clock,
    check_keys,
    check_network,
    check_receivers,
    check_time,
)
from polysight_shared.findings import Finding
from polysight_shared.messages import GPIOD, WIRES, HelloReply
from polysight_shared.sockets import HOST_KEYS
from polysight_shared.tables import to_builtins


@pytest.mark.parametrize("broken", ["nonsense = 1\n", 'name = "x"\n', "[[[\n", None])
def test_a_bad_rig_file_is_the_first_and_only_error(tmp_path, broken, capsys):
    path = tmp_path / "rig.toml"
    if broken is not None:
        path.write_text(broken)
    found_an_error = 1
    assert main(["doctor", "--config", str(path), "--no-pulse"]) == found_an_error
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("error       config")
    skipped = [line for line in lines if line.startswith("not checked")]
    # The checks of the rig file and of this machine's clock were run.
    assert len(skipped) == len(CHECKS) - 2
    assert all("config" in line for line in skipped)
    assert "config" in lines[-1]


def test_a_burst_that_does_not_fit_between_two_points_is_an_error(tmp_path):
    # At 200 mm/s, ten times the published speed, the stage passes a point every 10 ms; a burst takes 24 ms.
    rig = make_programmed_rig(stage={"speed_mm_s": 200.0, "accel_mm_s2": 2000.0})
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(to_builtins(rig)))
    with CheckContext(DoctorOptions(path), QUICK) as context:
        finding = next(run_checks(context))
    assert (finding.where, finding.level) == ("config", "error")


def run_check_by_name(context, name):
    """Run the check with this name; return the level of its finding."""
    check = next(c for c in CHECKS if c.name == name)
    return checks._run_check(check, context, board=None).level


def test_simulated_calibration_is_refused_on_a_real_rig(tmp_path):
    path = write_calibration(make_filter_file(), tmp_path)
    context = make_context(make_programmed_rig(calibration={"hpf": str(path)}))
    hello = HelloReply(pi_release="", firmware="", backend=WIRES, state="homed", scan_id="", last_seq=0)
    assert check_calibration(dataclasses.replace(context, hello=hello)).level == "ok"
    real = msgspec.structs.replace(hello, backend=GPIOD)
    assert run_check_by_name(dataclasses.replace(context, hello=real), "calibration") == "error"
    rig_without_file = make_programmed_rig(calibration={"hpf": "/nowhere.toml"})
    assert run_check_by_name(make_context(rig_without_file), "calibration") == "error"


@pytest.mark.parametrize(
    ("system", "verdict"),
    [
        (System(wall_ns=lambda: 0), "error"),
        (System(clock_is_synchronised=lambda: False), "warning"),
        (System(clock_is_synchronised=lambda: None), "ok"),
    ],
)
def test_a_lost_clock_is_an_error_and_an_unsynchronised_one_a_warning(system, verdict):
    assert check_host_clock(make_context(system=system)).level == verdict


@pytest.mark.parametrize(("mode", "verdict"), [(0o600, "ok"), (0o640, "warning"), (None, "error")])
@pytest.mark.parametrize("public_mode", [0o600, 0o644])
def test_the_secret_key_must_be_there_and_for_its_user_alone(tmp_path, public_mode, mode, verdict):
    """`mode` is that of the secret key; None: there are no keys."""
    if mode is not None:
        for name, mode_of_key in zip(HOST_KEYS, (public_mode, mode), strict=True):
            (tmp_path / name).touch(mode_of_key)
            # The process's umask may have removed bits.
            (tmp_path / name).chmod(mode_of_key)
    # Keys are needed only for a Pi on another computer; 192.0.2.1 is reserved for documentation.
    pi = {"command_address": "tcp://192.0.2.1:5601", "event_address": "tcp://192.0.2.1:5602", "key_dir": str(tmp_path)}
    assert check_keys(make_context(make_programmed_rig(pi=pi))).level == verdict


def test_the_kernel_reports_if_its_clock_is_synchronised():
    assert context.clock_is_synchronised() in (True, False, None)


def test_a_full_disk_is_an_error_and_a_slow_one_an_error_or_warning(tmp_path):
    """A disk must be as fast as the scan's data, and should be twice as fast."""
    # No disk has 2^60 bytes free.
    rig_with_huge_reserve = make_programmed_rig(limits={"free_disk_bytes": 1 << 60})
    assert check_disk(make_context(rig_with_huge_reserve, tmp_path)).level == "error"
    small_rig = make_programmed_rig(limits={"free_disk_bytes": 0}, grid={"rows": 2})
    scan_bytes_s = check_disk(make_context(small_rig, tmp_path)).facts["scan_bytes_s"]
    folder_to_make = tmp_path / "not" / "yet"
    for factor, verdict in ((0.5, "error"), (1.5, "warning"), (3.0, "ok")):
        system = System(write_speed=lambda _folder, speed=factor * scan_bytes_s: speed)
        assert check_disk(make_context(small_rig, folder_to_make, system)).level == verdict


def test_the_disk_probe_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(context, "_PROBE_BYTES", 2 << 20)
    assert context.write_speed(tmp_path) > 0
    assert list(tmp_path.iterdir()) == []


def test_the_published_scan_takes_two_hours(tmp_path):
    finding = check_time(make_context(RIG, tmp_path))
    # 200 rows of 350 points, 2 mm apart, at 20 mm/s: 35 s, and about 3 s to slow down, turn and start again.
    assert finding.facts["seconds"] == pytest.approx(200 * 38, rel=0.05)
    # Two receivers, 70,000 positions, and 64 KiB of samples at each.
    assert finding.facts["bytes"] == 2 * 70_000 * 65_536


def make_kernel_root(tmp_path, mtu=1500, speed=1000, lost=0):
    """A file system with sysfs and procfs of one interface, with the subnet 192.168.33.0/24.

    `mtu` is the largest packet, bytes; `speed` the link's, Mbit/s (-1: unknown); `lost` counts received packets that
    were dropped.
    """
    net = tmp_path / "sys/class/net/eth7"
    (net / "statistics").mkdir(parents=True)
    for name, value in (("mtu", mtu), ("speed", speed), ("statistics/rx_missed_errors", lost)):
        (net / name).write_text(f"{value}\n")
    (tmp_path / "proc/net").mkdir(parents=True)
    # Addresses are hexadecimal with the last byte first: 0021A8C0 is 192.168.33.0.
    route = "Iface Destination Gateway Flags RefCnt Use Metric Mask MTU Window IRTT\n"
    route += "eth7 0021A8C0 00000000 0001 0 0 0 00FFFFFF 0 0 0\n"
    (tmp_path / "proc/net/route").write_text(route)
    assert route_interface("192.168.33.181", tmp_path) == "eth7"
    return System(root=tmp_path)


@pytest.mark.parametrize(
    ("interface", "verdict"),
    [
        ({}, "ok"),
        ({"mtu": 1400}, "warning"),
        ({"speed": 100}, "warning"),
        ({"lost": 7}, "warning"),
        ({"speed": -1}, "ok"),
    ],
)
def test_an_unsuitable_network_interface_is_a_warning_and_unknown_values_are_ok(tmp_path, interface, verdict):
    finding = check_network(make_context(RIG, system=make_kernel_root(tmp_path, **interface)), RIG.by_name("RH"))
    assert finding.level == verdict
    assert "eth7" in finding.what


def test_every_need_is_a_check_before_it():
    checked = set()
    for check in CHECKS:
        assert set(check.needs) | set(check.unless) <= checked
        checked.add(check.name)


def replace_checks(failing):
    """All checks replaced: the one with this title fails, the others are ok."""

    def replace_check(check):
        def run(context, board=None):
            if check.name == "config":
                context.loaded_rig = RIG
            title = check.name if board is None else f"{check.name} {board.name}"
            return error("broken", "", "") if title == failing else ok("fine")

        return dataclasses.replace(check, run=run)

    return tuple(map(replace_check, CHECKS))


@pytest.mark.parametrize(
    ("failing", "skipped"),
    [
        ("stage", {"trigger line"}),
        ("card RH", {"buffer RH", "radar RH", "level RH", "direct path RH", "trigger skew"}),
        ("disk", set()),
        ("direct path RV", {"trigger skew"}),
    ],
)
def test_only_checks_that_depend_on_a_failed_one_are_skipped(monkeypatch, failing, skipped):
    monkeypatch.setattr(checks, "CHECKS", replace_checks(failing))
    findings = {f.where: f for f in run_checks(CheckContext(DoctorOptions(Path("x"))))}
    assert {name for name, f in findings.items() if f.level == "note"} == skipped
    assert all(failing in findings[name].what for name in skipped)


@pytest.mark.parametrize(("lost", "verdict"), [((0, 0, 0), "ok"), ((0, 0, 50), "ok"), ((0, 5, 50), "warning")])
def test_receivers_must_keep_up_with_the_configured_rate_of_the_cards(tmp_path, lost, verdict):
    """Loss at a rate that only faster cards reach is shown, but is not a fault.

    `lost` are packets of 100 at each of the three rates that are measured; this rig's cards do not reach the third.
    """

    def measure(_rig, rates):
        results = [
            LoadResult(wanted=rate, reached=rate, sent=100, lost=packets)
            for rate, packets in zip(rates, lost, strict=True)
        ]
        return results, "nice -5"

    finding = check_receivers(make_context(make_programmed_rig(), tmp_path, System(measure_receivers=measure)))
    assert finding.level == verdict
    assert ("50.0 %" in finding.what) == bool(lost[2])


def test_the_receivers_are_measured_with_packets_at_each_rate():
    rig = make_programmed_rig()
    packets_per_s = [500.0, 1000.0]
    seconds = 0.2
    results, scheduling = measure_receivers(rig, packets_per_s, seconds)
    assert scheduling
    assert [r.wanted for r in results] == packets_per_s
    # Each of the two receivers is sent this many.
    assert [r.sent for r in results] == [len(rig.recorded) * rate * seconds for rate in packets_per_s]
    assert all(r.reached > 0 for r in results)
    # If packets of the second record were taken for leftovers of the first, all of them would be lost.
    assert results[1].lost < results[0].sent


@pytest.mark.parametrize(
    ("buffer", "receiver", "verdict"),
    [
        ("ok", "ok", "ok"),
        ("warning", "ok", "warning"),
        ("ok", "warning", "warning"),
        ("error", "warning", "error"),
        ("note", "error", "error"),
    ],
)
def test_a_card_is_captured_unless_its_reception_has_an_error(buffer, receiver, verdict):
    """A scan continues with a smaller buffer than requested, and so do the following checks."""
    board = RIG.by_name("RH")
    hops = [Finding(receiver, "receiver", where="receiver"), Finding(buffer, "buffer", where="buffer")]
    context = make_context()
    context.surveys = {"RH": CardSurvey(board, "2.8", hops)}
    assert check_buffer(context, board).level == verdict
    assert context.usable_cards == (set() if verdict == "error" else {"RH"})
