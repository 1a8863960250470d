"""Each check of this machine alone, and the order of the walk."""

import dataclasses
from pathlib import Path

import msgspec
import pytest
import tomli_w

from polysight.host.calibration.files import BoardFilter, FilterFile, SourceScan, header, write_calibration
from polysight.host.capture.network import route_interface
from polysight.host.cli.main import main
from polysight.host.doctor import bench as kernel
from polysight.host.doctor.bench import Bench, Finding, System, Wanted, error, ok
from polysight.host.doctor.check_capture import check_network
from polysight.host.doctor.check_host import check_config, check_disk, check_receivers, check_time
from polysight.host.doctor.receiver_load import Held, measure
from polysight.host.doctor.walk import CHECKS, _try, walk
from polysight.shared.messages import GPIOD, GPIOMEM, WIRES, HelloReply
from polysight.shared.tables import to_builtins
from tests.support.doctor.case import QUICK, RIG, bench_of
from tests.support.rigs import programmed_rig

# --- the command ---


def test_to_move_is_to_pulse(capsys):
    """Each point of the row that moves is a burst: asking for neither and one at once is refused."""
    assert main(["doctor", "--config", str(RIG), "--move", "--no-pulse"]) != 0
    assert "leave one of them out" in capsys.readouterr().err


# --- the rig file ---


@pytest.mark.parametrize("broken", ["nonsense = 1\n", 'name = "x"\n', "[[[\n", None])
def test_a_bad_rig_file_is_the_first_and_only_error(tmp_path, broken, capsys):
    path = tmp_path / "rig.toml"
    if broken is not None:
        path.write_text(broken)
    assert main(["doctor", "--config", str(path), "--no-pulse"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("error       config")
    told = [line for line in lines if line.startswith("not checked")]
    assert len(told) == len(CHECKS) - 2  # all but the rig file and this machine's clock
    assert all(line.endswith("config failed") for line in told)
    assert lines[-1].endswith("begin with config")


def test_a_burst_that_does_not_fit_between_two_points(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(to_builtins(programmed_rig(stage={"speed_mm_s": 200.0, "accel_mm_s2": 2000.0}))))
    with Bench(Wanted(path), QUICK) as bench:
        found = {f.check: f for f in walk(bench)}
    assert found["config"].verdict == "error"
    assert "burst of 16" in found["config"].found


@pytest.mark.parametrize(
    ("backend", "verdict"), [(WIRES, "ok"), (GPIOD, "error"), (GPIOMEM, "error")], ids=["simulated", "gpiod", "gpiomem"]
)
def test_calibration_files(tmp_path, backend, verdict):
    board = BoardFilter([180.5, 355.0], [1.0, 2.0], [175.0, 350.0], 100.0, 1900.0, 640, 0.05)
    file = FilterFile(**header("hpf", [SourceScan("s", "scans/s", True, 6)]), boards={"RH": board, "RV": board})
    bench = bench_of(programmed_rig(calibration={"hpf": str(write_calibration(file, tmp_path))}))
    bench.hello = HelloReply(pi_release="", firmware="", backend=backend, state="homed", scan_id="", last_seq=0)
    found = walk_one(bench, "calibration")
    assert (found.verdict, "simulated" in found.found) == (verdict, verdict == "error")
    assert walk_one(bench_of(programmed_rig(calibration={"hpf": "/nowhere.toml"})), "calibration").verdict == "error"


def walk_one(bench, name):
    """One check alone, its errors turned into findings as the walk does."""
    return _try(next(c for c in CHECKS if c.name == name), bench, None)


# --- this machine ---


def test_a_clock_that_was_lost(tmp_path):
    found = next(
        f for f in walk(Bench(Wanted(tmp_path / "none"), System(wall_ns=lambda: 0))) if f.check == "host clock"
    )
    assert found.verdict == "error"
    found = [
        f
        for f in walk(Bench(Wanted(tmp_path / "none"), System(clock_is_synchronised=lambda: False)))
        if f.check == "host clock"
    ]
    assert found[0].verdict == "warning"
    assert kernel.clock_is_synchronised() in (True, False, None)


def test_a_disk_that_is_full_and_one_that_is_slow(tmp_path):
    full = programmed_rig(limits={"free_disk_bytes": 1 << 60})
    assert "too full" in check_disk(bench_of(full, tmp_path)).why
    needed = check_disk(bench_of(programmed_rig(limits={"free_disk_bytes": 0}, grid={"rows": 2}), tmp_path)).facts[
        "scan_bytes_s"
    ]
    for factor, verdict in ((0.5, "error"), (1.5, "warning"), (3.0, "ok")):
        slow = System(write_speed=lambda _f, speed=factor * needed: speed)
        small = programmed_rig(limits={"free_disk_bytes": 0}, grid={"rows": 2})
        assert check_disk(bench_of(small, tmp_path / "not" / "yet", slow)).verdict == verdict


def test_the_disk_probe_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel, "_PROBE_BYTES", 2 << 20)
    assert kernel.write_speed(tmp_path) > 0
    assert list(tmp_path.iterdir()) == []


def test_the_published_scan_takes_two_hours(tmp_path):
    found = check_time(bench_of(RIG, tmp_path))
    assert found.facts["seconds"] == pytest.approx(200 * 38, rel=0.05)  # 35 s a row, and its ends
    assert found.facts["bytes"] == 2 * 70_000 * 65_536


def kernel_root(tmp_path, mtu=1500, speed=1000, lost=0):
    """What the kernel shows of one interface whose subnet is 192.168.33.0/24."""
    net = tmp_path / "sys/class/net/eth7"
    (net / "statistics").mkdir(parents=True)
    for name, value in (("mtu", mtu), ("speed", speed), ("statistics/rx_missed_errors", lost)):
        (net / name).write_text(f"{value}\n")
    (tmp_path / "proc/net").mkdir(parents=True)
    route = "Iface Destination Gateway Flags RefCnt Use Metric Mask MTU Window IRTT\n"
    route += "eth7 0021A8C0 00000000 0001 0 0 0 00FFFFFF 0 0 0\n"
    (tmp_path / "proc/net/route").write_text(route)
    assert route_interface("192.168.33.181", tmp_path) == "eth7"
    return System(root=tmp_path)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ({}, ""),
        ({"mtu": 1400}, "mtu 1500"),
        ({"speed": 100}, "gigabit"),
        ({"lost": 7}, "ethtool -S"),
        ({"speed": -1}, ""),
    ],
)
def test_a_network_interface_that_does_not_suit_a_card(tmp_path, kind, words):
    found = check_network(bench_of(RIG, system=kernel_root(tmp_path, **kind)), RIG.by_name("RH"))
    assert found.verdict == ("warning" if words else "ok")
    assert words in found.remedy
    assert "eth7" in found.found


# --- the walk ---


def test_every_need_is_a_check_before_it():
    known = set()
    for check in CHECKS:
        assert set(check.needs) | set(check.unless) <= known
        known.add(check.name)


def outcome(wrong):
    """The walk with every check replaced: those named are wrong, all others ok."""

    def run(check):
        def answer(bench: Bench, board=None) -> Finding:
            if check.name == "config":
                bench.given = msgspec.structs.replace(RIG, name="x")
            title = check.name if board is None else f"{check.name} {board.name}"
            return error("broken", "", "") if title in wrong else ok("fine")

        return dataclasses.replace(check, run=answer)

    return [run(check) for check in CHECKS]


@pytest.mark.parametrize(
    ("wrong", "untried"),
    [
        (
            "pi",
            {
                "pi clock",
                "rig is free",
                "stage",
                "trigger line",
                "pulses",
                "radar",
                "level",
                "direct path",
                "trigger skew",
            },
        ),
        ("stage", {"trigger line"}),
        ("card RH", {"buffer RH", "radar RH", "level RH", "direct path RH", "trigger skew"}),
        ("disk", set()),
        ("direct path RV", {"trigger skew"}),
    ],
)
def test_only_what_depends_on_a_broken_hop_is_left_out(monkeypatch, wrong, untried):
    monkeypatch.setattr("polysight.host.doctor.walk.CHECKS", outcome({wrong}))
    found = {f.check: f for f in walk(Bench(Wanted(Path("x"))))}
    left_out = {n for n, f in found.items() if f.verdict == "not checked"}
    both = {f"{n} {b}" for n in untried for b in ("RH", "RV")}
    assert left_out == {n for n in found if n in untried or n in both}
    assert {found[n].found for n in left_out} <= {f"{wrong} failed"}


def test_help_has_an_example(capsys):
    with pytest.raises(SystemExit):
        main(["doctor", "--help"])
    assert "example:" in capsys.readouterr().out


def test_config_is_read_from_the_file(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(to_builtins(RIG)))
    bench = Bench(Wanted(path))
    assert check_config(bench).verdict == "ok"
    assert bench.rig == RIG


@pytest.mark.parametrize(("lost", "verdict"), [((0, 0, 0), "ok"), ((0, 0, 50), "ok"), ((0, 5, 50), "warning")])
def test_receivers_must_hold_what_the_card_sends_at_its_pace(tmp_path, lost, verdict):
    """What only the fastest card would lose is told, and no fault of this rig's machine."""
    held = System(held=lambda _rig, some: ([Held(r, r, 100, n) for r, n in zip(some, lost, strict=True)], "nice -5"))
    finding = check_receivers(bench_of(programmed_rig(), tmp_path, held))
    assert finding.verdict == verdict
    assert "50.0 % lost" in finding.found if lost[2] else "nothing lost" in finding.found
    assert verdict == "ok" or "rights.sh" in finding.remedy


def test_the_receivers_are_measured_with_packets():
    held, scheduling = measure(programmed_rig(), [500.0], seconds=0.2)
    assert scheduling
    assert [(h.wanted, h.sent) for h in held] == [(500.0, 200)]
    assert 0 <= held[0].lost <= held[0].sent
    assert held[0].reached > 0
