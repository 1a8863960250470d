"""`polysight plan`: exit status, text and JSON, and what it measures in an earlier scan (`--like`).

In the earlier scan it measures the noise and the time that the stage stands still between two rows.
"""

import json
import math
import re
import tomllib

import pytest
import tomli_w
from tests.support.paths import RIG_FILE
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_rig_table, make_rig_with
from tests.support.scenes import EVERYWHERE, make_scene
from tests.support.store.facts import load_facts

from polysight.cli.main import main
from polysight.planning import PlanChanges, row_motion_s
from polysight.planning.forecast import tail_s, turn_s
from polysight.planning.plan_command import _format_bytes, _format_duration, measure_noise, shortest_period_us
from polysight.store import manifest
from polysight.store.logs import EventWriter
from polysight.store.scan_folder import EVENTS, MANIFEST, ScanFolder
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.messages import Capture
from polysight_shared.raster import plan_raster
from polysight_simulators.scene import decode_scene, simulate

RIG = ["--config", str(RIG_FILE)]
SHORT_SCAN = ["--columns", "40", "--rows", "30"]
# The earlier scan, in which noise and times are measured.
PULSES = 8
ROWS = 2
COLUMNS = 12
# Power of the direct path over that of the noise of a chirp.
SNR_DB = 12.0
# Seconds from a row's last trigger to the first one of the next row.
GAP_S = 20.0
GAIN_OF_16_CHIRPS_DB = 10 * math.log10(16)
# Exit status if the plan is not possible, and if there is none.
NOT_POSSIBLE = 1


def test_text_and_json_have_the_same_plan(capsys):
    assert main(["plan", *RIG, *SHORT_SCAN]) == 0
    text = capsys.readouterr().out
    assert main(["plan", *RIG, *SHORT_SCAN, "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert f"{numbers['columns']} x {numbers['rows']} positions" in text
    times_s = numbers["time_s"]
    total_s = times_s.pop("total")
    assert sum(times_s.values()) == pytest.approx(total_s)
    assert "simulated" in text
    assert "simulated" in numbers["noise_source"]


@pytest.mark.parametrize(
    ("options", "unit", "unit_s"),
    [
        (["--columns", "30", "--rows", "3"], "s", 1),
        (["--columns", "40", "--rows", "30"], "min", 60),
        (["--columns", "200", "--rows", "400", "--step-y-mm", "1"], "h", 3600),
    ],
)
def test_a_duration_is_printed_in_seconds_minutes_or_hours(capsys, options, unit, unit_s):
    assert main(["plan", *RIG, *options, "--json"]) == 0
    total_s = json.loads(capsys.readouterr().out)["time_s"]["total"]
    assert main(["plan", *RIG, *options]) == 0
    shown_time, shown_unit = re.search(r"^time +([\d.]+) (\w+),", capsys.readouterr().out, re.MULTILINE).groups()
    assert shown_unit == unit
    # A duration has two digits at least.
    assert float(shown_time) * unit_s == pytest.approx(total_s, rel=0.02)


@pytest.mark.parametrize(
    ("options", "has_aliases"),
    [(SHORT_SCAN, False), (["--columns", "60", "--rows", "60", "--step-y-mm", "8"], True)],
)
def test_aliases_of_tilted_surfaces_are_reported_only_if_surfaces_of_that_tilt_are_visible(
    capsys, options, has_aliases
):
    plan = ["plan", *RIG, *options]
    assert main([*plan, "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    # Along x and y: the tilt from which on phases alias, and the largest tilt at which a surface is seen.
    visible_aliases_deg = []
    for alias_deg, visible_deg in zip(numbers["alias_tilt_deg"], numbers["visible_normals_deg"], strict=True):
        if alias_deg < visible_deg:
            visible_aliases_deg.append(alias_deg)
    assert bool(visible_aliases_deg) == has_aliases
    assert main(plan) == 0
    text = capsys.readouterr().out
    assert ("phases alias" in text) == has_aliases
    for alias_deg in visible_aliases_deg:
        assert f"beyond {alias_deg:.0f} degrees" in text


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ([*SHORT_SCAN, "--speed-mm-s", "100"], NOT_POSSIBLE),
        (["--minutes", "0.5"], NOT_POSSIBLE),
        (["--width-mm", "5000"], ConfigError.exit_status),
        (["--step-x-mm", "5e-324"], ConfigError.exit_status),
    ],
    ids=["too fast for the burst", "too little time", "wider than the travel", "no width of a step"],
)
def test_the_exit_status_of_an_impossible_plan_is_not_0(options, status):
    assert main(["plan", *RIG, *options]) == status


@pytest.mark.parametrize(
    "option",
    [
        ("--minutes", "5e-324"),
        ("--snr-db", "nan"),
        ("--snr-db", "1e308"),
        ("--row-overhead-s", "-1"),
        ("--row-overhead-s", "1e300"),
        ("--scene-mm", "170,inf"),
        ("--scene-mm", "1e300,170"),
    ],
)
def test_a_value_that_is_infinite_not_a_number_or_far_too_large_or_small_is_a_usage_error(option):
    with pytest.raises(SystemExit) as exit_info:
        main(["plan", *RIG, *option])
    assert exit_info.value.code == ConfigError.exit_status


def test_the_lines_printed_for_the_rig_file_give_the_plan_without_options(capsys, tmp_path):
    options = [*SHORT_SCAN, "--accel-mm-s2", "345", "--object-distance-mm", "480", "--width-mm", "120"]
    options += ["--minutes", "3", "--count", "1"]
    assert main(["plan", *RIG, *options]) == 0
    _, _, lines = capsys.readouterr().out.rpartition("all that differ:\n\n")
    assert main(["plan", *RIG, *options, "--json"]) == 0
    (proposed,) = json.loads(capsys.readouterr().out)["plans"]
    table = tomllib.loads(RIG_FILE.read_text())
    changed = tomllib.loads(lines)
    for section, keys in changed.items():
        for key, value in keys.items():
            assert table[section].get(key) != value
            table[section][key] = value
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(table))
    assert {"accel_mm_s2", "speed_mm_s"} <= set(changed["stage"])
    assert changed["geometry"] == {"object_distance_mm": 480.0}
    rig = ["--config", str(tmp_path / "rig.toml")]
    assert main(["plan", *rig, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == proposed


# --- noise and standstill measured in an earlier scan ---


@pytest.fixture(scope="module")
def scan(rig, tmp_path_factory):
    """The folder of a simulated scan with known noise. No Pi took part, so that it has no times."""
    folder = tmp_path_factory.mktemp("like") / "scan"
    scene = decode_scene({"name": "quiet", "disturbances": {"ideal": True, "direct_snr_db": SNR_DB}}, "test")
    scanned_rig = PlanChanges(columns=COLUMNS, rows=ROWS, pulses=PULSES).apply(rig)
    return simulate(scanned_rig, scene, folder)


def add_events_of_a_pi(scan, rig, gap_s: float) -> None:
    """Add trigger times to the scan, with `gap_s` seconds from a row's last trigger to the next one's first."""
    facts = load_facts(scan)
    first_fact, *_ = facts
    first_fact["pi"] = {"release": "test"}
    (scan / MANIFEST).write_bytes(b"".join(manifest.encode_line(fact) for fact in facts))
    (scan / EVENTS).unlink(missing_ok=True)
    events = EventWriter(scan / EVENTS)
    time_s = 0.0
    seq = 0
    for row in plan_raster(PlanChanges(columns=COLUMNS, rows=ROWS).apply(rig).grid):
        for point in range(row.points):
            seq += 1
            time_ns = round(time_s * 1e9)
            capture = Capture(
                scan_id="quiet",
                seq=seq,
                t_mono_ns=time_ns,
                row_index=row.index,
                take=1,
                point=point,
                column=row.column(point),
                edge_ns=time_ns,
                first_pulse_ns=time_ns,
                last_pulse_ns=time_ns,
                pulses=PULSES,
                width_max_ns=1,
                jitter_ns=1,
            )
            events.append(capture)
            is_last_of_row = point == row.points - 1
            time_s += gap_s if is_last_of_row else 0.1
    events.sync()
    events.close()


@pytest.fixture
def read_plan(capsys):
    """Function that returns the plan for 30 rows and 16 chirps a position with further options."""

    def plan(*options: object) -> dict:
        arguments = ["plan", *RIG, "--rows", "30", "--pulses", "16", "--json", *options]
        assert main(list(map(str, arguments))) == 0
        return json.loads(capsys.readouterr().out)

    return plan


def test_the_noise_of_the_plan_is_that_measured_in_the_earlier_scan(scan, read_plan):
    plan_of_rig_file = read_plan()
    plan = read_plan("--like", scan)
    # The noise is measured in 24 positions, to some tenths of a decibel.
    assert plan["position_snr_db"] == pytest.approx(SNR_DB + GAIN_OF_16_CHIRPS_DB, abs=0.7)
    assert "simulated scan quiet" in plan["noise_source"]
    assert abs(plan_of_rig_file["position_snr_db"] - plan["position_snr_db"]) > 5
    # The scan has no times: those of the rig file are used.
    assert plan["time_s"]["standstill"] == plan_of_rig_file["time_s"]["standstill"]


def test_the_standstill_is_the_time_between_rows_that_motion_does_not_explain(scan, rig, read_plan):
    earlier_rig = PlanChanges(columns=COLUMNS, rows=ROWS, pulses=PULSES).apply(rig)
    grid = earlier_rig.grid
    stage = earlier_rig.stage
    ramps_s = row_motion_s(grid, stage) - (COLUMNS - 1) * grid.step_x_mm / stage.speed_mm_s
    motion_s = ramps_s + turn_s(grid, stage) + tail_s(earlier_rig)
    add_events_of_a_pi(scan, rig, GAP_S)
    rows_planned = 30
    standstill_s = read_plan("--like", scan)["time_s"]["standstill"]
    assert standstill_s == pytest.approx(rows_planned * (GAP_S - motion_s))


def test_in_a_scan_without_rows_no_noise_can_be_measured(scan, tmp_path):
    full_scan = ScanFolder.load(scan)
    empty_scan = ScanFolder.create(tmp_path / "empty", full_scan.instrument, full_scan.plan, simulated=True)
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        measure_noise(empty_scan)


def test_noise_is_measured_in_a_scan_with_two_receive_antennas(tmp_path):
    first_two_antennas = load_rig_table()["antennas"]["rx_mm"][:2]
    rig = make_rig_with(antennas={"rx_mm": first_two_antennas})
    scene = make_scene(EVERYWHERE, columns=COLUMNS, rows=ROWS, pulses=PULSES, disturbances={"direct_snr_db": SNR_DB})
    scan = simulate(rig, decode_scene(scene, "test"), tmp_path / "scan")
    # Here 0.1 dB less (measured).
    assert measure_noise(ScanFolder.load(scan)).direct_snr_db == pytest.approx(SNR_DB, abs=0.7)


def test_options_override_what_was_measured_in_the_earlier_scan(scan, rig, read_plan):
    add_events_of_a_pi(scan, rig, GAP_S)
    values = read_plan("--like", scan, "--snr-db", "3", "--row-overhead-s", "0.5")
    assert values["position_snr_db"] == pytest.approx(3 + GAIN_OF_16_CHIRPS_DB, abs=0.01)
    rows_planned = 30
    assert values["time_s"]["standstill"] == pytest.approx(rows_planned * 0.5)


def test_if_there_is_no_plan_more_time_is_advised_only_if_it_helps(capsys):
    plan = ["plan", *RIG, *SHORT_SCAN, "--minutes"]
    assert main([*plan, "0.5"]) == NOT_POSSIBLE
    enough_minutes = re.search(r"--minutes (\d+) are enough", capsys.readouterr().err)[1]
    assert main([*plan, enough_minutes]) == 0
    capsys.readouterr()
    # Steps so wide that a scene of this size has aliases.
    wide_steps = ["--step-y-mm", "12", "--scene-mm", "300,300"]
    assert main([*plan, "30", *wide_steps]) == NOT_POSSIBLE
    message = capsys.readouterr().err
    assert "more time does not help" in message
    assert "--step-y-mm" in message


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(89, "89 s"), (90, "1.5 min"), (5994, "99.9 min"), (6000, "1.67 h"), (7200, "2.00 h")],
)
def test_a_duration_is_written_with_few_digits_in_seconds_minutes_or_hours(seconds, text):
    assert _format_duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"), [(1e6, "1 MB"), (999e6, "999 MB"), (1e9, "1.00 GB"), (2.5e12, "2500.00 GB")]
)
def test_an_amount_of_data_is_in_megabytes_or_gigabytes(count, text):
    assert _format_bytes(count) == text


def test_the_shortest_period_is_that_of_the_radars_in_whole_tens_of_microseconds(rig):
    # Idle time, ramp, time between two frames, and a margin for the trigger.
    shortest_us = 100 + 128.5 + 300 + 200
    assert shortest_period_us(rig) == 10 * math.ceil(shortest_us / 10)
    rig_with_longer_idle_time = make_rig_with(radar={"idle_us": 100 + 10.0})
    assert shortest_period_us(rig_with_longer_idle_time) == shortest_period_us(rig) + 10


def test_duration_and_travel_of_a_burst_follow_from_its_chirps_and_the_speed(capsys):
    pulses = 10
    period_ms = 2.0
    speed_mm_s = 40.0
    step_mm = 2.0
    options = [*SHORT_SCAN, "--speed-mm-s", "40", "--pulses", "10", "--period-us", "2000"]
    assert main(["plan", *RIG, *options, "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["burst_ms"] == pytest.approx(pulses * period_ms)
    assert numbers["between_positions_ms"] == pytest.approx(1e3 * step_mm / speed_mm_s)
    # From the first chirp to the last one.
    assert numbers["burst_travel_mm"] == pytest.approx((pulses - 1) * 1e-3 * period_ms * speed_mm_s)
    assert main(["plan", *RIG, *options]) == 0
    text = capsys.readouterr().out
    assert "a burst fills 40% of the time" in text
    assert "10 chirps a position, 2000 us apart" in text
    assert "78 x 58 mm" in text
    assert "raw data   98 MB of 2 boards" in text
