"""`polysight plan`: exit status, text and JSON; noise and standstill from options and from a scan (`--like`)."""

import json
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
# A plan of a few minutes.
SMALL = ["--columns", "40", "--rows", "30"]
# The scan in which noise and times are measured; chosen.
PULSES = 8
ROWS = 2
COLUMNS = 12
# Its direct path over the noise of a chirp.
SNR_DB = 12.0
# Seconds from a row's last trigger to the first one of the next row.
GAP_S = 20.0
# Signal to noise of a position with 16 chirps over that of one.
GAIN_OF_16_CHIRPS_DB = 12.04
# A plan that is not possible, or none.
NOT_POSSIBLE = 1


def test_text_and_json_have_the_same_plan(capsys):
    assert main(["plan", *RIG, *SMALL]) == 0
    words = capsys.readouterr().out
    assert main(["plan", *RIG, *SMALL, "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert f"{numbers['columns']} x {numbers['rows']} positions" in words
    # The total is one of the values: the others add up to it.
    assert sum(numbers["time_s"].values()) == pytest.approx(2 * numbers["time_s"]["total"])
    assert "simulated" in words
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
    assert float(shown_time) * unit_s == pytest.approx(total_s, rel=0.02)


@pytest.mark.parametrize(("options", "aliases"), [(SMALL, False), (["--columns", "60", "--rows", "60"], True)])
def test_aliases_of_tilted_surfaces_are_reported_only_for_visible_tilts(capsys, options, aliases):
    plan = ["plan", *RIG, *options, *(("--step-y-mm", "8") if aliases else ())]
    assert main([*plan, "--json"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    limits = zip(numbers["alias_tilt_deg"], numbers["visible_normals_deg"], strict=True)
    within = [alias for alias, tilt in limits if alias < tilt]
    assert bool(within) == aliases
    assert main(plan) == 0
    words = capsys.readouterr().out
    assert ("phases alias" in words) == aliases
    assert all(f"beyond {alias:.0f} degrees" in words for alias in within)


@pytest.mark.parametrize(
    ("options", "status"),
    [
        ([*SMALL, "--speed-mm-s", "100"], NOT_POSSIBLE),
        (["--minutes", "0.5"], NOT_POSSIBLE),
        (["--width-mm", "5000"], ConfigError.exit_status),
        (["--step-x-mm", "5e-324"], ConfigError.exit_status),
    ],
    ids=["refused plan", "no plan", "broken rule", "endless steps"],
)
def test_a_plan_that_is_impossible_fails(options, status):
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
def test_a_value_that_is_not_a_quantity_is_a_usage_error(option):
    # argparse ends the program with 2.
    with pytest.raises(SystemExit) as ended:
        main(["plan", *RIG, *option])
    assert ended.value.code == 2


def test_the_lines_of_a_plan_make_the_rig_file_that_plan(capsys, tmp_path):
    """The printed values, inserted into the rig file, give the plan's figures without options."""
    arguments = [*SMALL, "--accel-mm-s2", "345", "--object-distance-mm", "480", "--width-mm", "120"]
    minutes = ["--minutes", "3", "--count", "1"]
    assert main(["plan", *RIG, *arguments, *minutes]) == 0
    lines = capsys.readouterr().out.rpartition("all that differ:\n\n")[2]
    assert main(["plan", *RIG, *arguments, *minutes, "--json"]) == 0
    proposed = json.loads(capsys.readouterr().out)["plans"][0]
    table = tomllib.loads(RIG_FILE.read_text())
    changed = tomllib.loads(lines)
    for section, keys in changed.items():
        assert all(table[section].get(key) != value for key, value in keys.items())
        table[section] |= keys
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(table))
    assert {"accel_mm_s2", "speed_mm_s"} <= set(changed["stage"])
    assert changed["geometry"] == {"object_distance_mm": 480.0}
    rig = ["--config", str(tmp_path / "rig.toml")]
    assert main(["plan", *rig, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == proposed


# --- noise and standstill of an earlier scan ---


@pytest.fixture(scope="module")
def scan(rig, tmp_path_factory):
    """A scan of known noise, made without a Pi."""
    folder = tmp_path_factory.mktemp("like") / "scan"
    scene = decode_scene({"name": "quiet", "disturbances": {"ideal": True, "direct_snr_db": SNR_DB}}, "test")
    return simulate(PlanChanges(columns=COLUMNS, rows=ROWS, pulses=PULSES).apply(rig), scene, folder)


def add_events_of_a_pi(scan, rig, gap_s: float) -> None:
    """Add events of a Pi to the scan, with `gap_s` seconds from a row's last trigger to the next one's first."""
    facts = load_facts(scan)
    facts[0]["pi"] = {"release": "test"}
    (scan / MANIFEST).write_bytes(b"".join(manifest.encode_line(fact) for fact in facts))
    (scan / EVENTS).unlink(missing_ok=True)
    events = EventWriter(scan / EVENTS)
    t = 0.0
    seq = 0
    for row in plan_raster(PlanChanges(columns=COLUMNS, rows=ROWS).apply(rig).grid):
        for point in range(row.points):
            seq = seq + 1
            ns = round(t * 1e9)
            events.append(
                Capture(
                    scan_id="quiet", seq=seq, t_mono_ns=ns, row_index=row.index, take=1, point=point,
                    column=row.column(point), edge_ns=ns, first_pulse_ns=ns, last_pulse_ns=ns, pulses=PULSES,
                    width_max_ns=1, jitter_ns=1,
                )
            )  # fmt: skip
            t += gap_s if point == row.points - 1 else 0.1
    events.sync()
    events.close()


@pytest.fixture
def read_plan(capsys):
    def plan(*more: object) -> dict:
        arguments = ["plan", *RIG, "--rows", "30", "--pulses", "16", "--json", *more]
        assert main(list(map(str, arguments))) == 0
        return json.loads(capsys.readouterr().out)

    return plan


def test_noise_and_standstill_are_measured_in_the_scan(scan, rig, read_plan):
    without = read_plan()
    like_scan = read_plan("--like", scan)
    # Chosen: noise measured in 24 positions is known to some tenths of a decibel.
    assert like_scan["position_snr_db"] == pytest.approx(SNR_DB + GAIN_OF_16_CHIRPS_DB, abs=0.7)
    assert "simulated scan quiet" in like_scan["noise_source"]
    assert abs(without["position_snr_db"] - like_scan["position_snr_db"]) > 5
    # The scan was made without a Pi and has no times: those of the plan are kept.
    assert like_scan["time_s"]["standstill"] == without["time_s"]["standstill"]

    # With events of a Pi, what a gap between two rows takes beyond the motion is the standstill of each of 30 rows.
    small = PlanChanges(columns=COLUMNS, rows=ROWS, pulses=PULSES).apply(rig)
    grid = small.grid
    stage = small.stage
    ramps_s = row_motion_s(grid, stage) - (COLUMNS - 1) * grid.step_x_mm / stage.speed_mm_s
    motion_s = ramps_s + turn_s(grid, stage) + tail_s(small)
    add_events_of_a_pi(scan, rig, GAP_S)
    assert read_plan("--like", scan)["time_s"]["standstill"] == pytest.approx(30 * (GAP_S - motion_s))


def test_a_scan_without_rows_has_no_noise(scan, tmp_path):
    empty_scan = ScanFolder.load(scan)
    empty = ScanFolder.create(tmp_path / "empty", empty_scan.instrument, empty_scan.plan, simulated=True)
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        measure_noise(empty)


def test_noise_is_measured_in_a_scan_with_two_antennas(tmp_path):
    two = make_rig_with(antennas={"rx_mm": load_rig_table()["antennas"]["rx_mm"][:2]})
    scene = make_scene(EVERYWHERE, columns=COLUMNS, rows=ROWS, pulses=PULSES, disturbances={"direct_snr_db": SNR_DB})
    scan = simulate(two, decode_scene(scene, "test"), tmp_path / "scan")
    assert measure_noise(ScanFolder.load(scan)).direct_snr_db == pytest.approx(SNR_DB, abs=0.7)


def test_options_override_the_scan(scan, rig, read_plan):
    add_events_of_a_pi(scan, rig, GAP_S)
    values = read_plan("--like", scan, "--snr-db", "3", "--row-overhead-s", "0.5")
    assert values["position_snr_db"] == pytest.approx(3 + GAIN_OF_16_CHIRPS_DB, abs=0.01)
    # 30 rows of half a second.
    assert values["time_s"]["standstill"] == pytest.approx(15.0)


def test_without_a_plan_more_time_is_advised_only_where_it_helps(capsys):
    plan = ["plan", *RIG, "--columns", "40", "--rows", "30", "--minutes"]
    assert main([*plan, "0.5"]) == NOT_POSSIBLE
    enough = re.search(r"--minutes (\d+) are enough", capsys.readouterr().err)[1]
    assert main([*plan, enough]) == 0
    capsys.readouterr()
    # The steps themselves have aliases in this scene.
    coarse = ["--step-y-mm", "12", "--scene-mm", "300,300"]
    assert main([*plan, "30", *coarse]) == NOT_POSSIBLE
    message = capsys.readouterr().err
    assert "more time does not help" in message
    assert "--step-y-mm" in message


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(89, "89 s"), (90, "1.5 min"), (5994, "99.9 min"), (6000, "1.67 h"), (7200, "2.00 h")],
)
def test_a_duration_has_the_unit_that_keeps_its_digits_few(seconds, text):
    assert _format_duration(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"), [(1e6, "1 MB"), (999e6, "999 MB"), (1e9, "1.00 GB"), (2.5e12, "2500.00 GB")]
)
def test_an_amount_of_data_is_in_megabytes_or_gigabytes(count, text):
    assert _format_bytes(count) == text


def test_the_shortest_period_is_that_of_the_radars_in_whole_tens_of_microseconds(rig):
    # Idle 100 us, ramp 128.5 us, 300 us between two frames, and a margin of 200 us for the trigger
    assert shortest_period_us(rig) == 730
    longer = make_rig_with(radar={"idle_us": 110.0})
    assert shortest_period_us(longer) == shortest_period_us(rig) + 10


def test_figures_of_a_burst_are_those_of_its_chirps(capsys):
    options = [*SMALL, "--speed-mm-s", "40", "--pulses", "10", "--period-us", "2000", "--json"]
    assert main(["plan", *RIG, *options]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["burst_ms"] == pytest.approx(20)
    assert numbers["between_positions_ms"] == pytest.approx(50)
    # From the first chirp to the last one
    assert numbers["burst_travel_mm"] == pytest.approx(9 * 2e-3 * 40)
    assert main(["plan", *RIG, *options[:-1]]) == 0
    words = capsys.readouterr().out
    assert "a burst fills 40% of the time" in words
    assert "10 chirps a position, 2000 us apart" in words
    assert "78 x 58 mm" in words
    assert "raw data   98 MB of 2 boards" in words
