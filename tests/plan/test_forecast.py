"""Laws of a plan's noise, motion and aliases, each compared with an independent computation."""

import re

import msgspec
import numpy as np
import pytest
from tests.support.refusals import expect_refusal
from tests.support.rigs import make_programmed_rig, make_rig_with

from polysight.imaging import ImageBuilder, PhaseSlope, backproject, compute_field_limits
from polysight.imaging.geometry import Antennas
from polysight.imaging.resolution import describe_board
from polysight.planning import Noise, PlanChanges, forecast, propose
from polysight.planning.forecast import (
    describe_aperture,
    fills_whole_packets,
    find_warnings,
    predict_burst,
    predict_noise,
    tail_s,
)
from polysight.planning.plan_command import describe
from polysight_shared.config import Instrument
from polysight_shared.errors import ErrorCode
from polysight_shared.geometry import specular_midpoint_m

LIGHT_M_PER_S = 299792458.0


def test_a_plan_without_changes_is_that_of_the_rig_file(rig):
    assert PlanChanges().apply(rig) == rig


def test_a_new_step_keeps_the_aperture(rig):
    changed = PlanChanges(step_x_mm=6.0, step_y_mm=4.0).apply(rig).grid
    assert (changed.columns - 1) * 6.0 == pytest.approx(698, abs=3)
    assert (changed.rows - 1) * 4.0 == pytest.approx(398, abs=2)


@pytest.mark.parametrize(
    "changes", [PlanChanges(width_mm=900.0), PlanChanges(speed_mm_s=100.0, pulses=2, width_mm=760.0)]
)
def test_a_plan_whose_rows_exceed_the_travel_is_refused_by_the_rig_file_s_rule(rig, changes):
    with expect_refusal(
        ErrorCode.VALUE_INVALID, "grid.columns", "stage.travel_x_mm", "polysight plan --help"
    ) as refusal:
        changes.apply(rig)
    # No file holds these numbers.
    assert "correct" not in refusal.value.remedy


def test_noise_falls_with_chirps_and_positions(rig):
    noise_of_one = predict_noise(PlanChanges(pulses=4).apply(rig), Noise(0.0, ""))
    four = predict_noise(PlanChanges(pulses=16).apply(rig), Noise(0.0, ""))
    assert four.position_db - noise_of_one.position_db == pytest.approx(10 * np.log10(4))
    assert four.image_db - noise_of_one.image_db == pytest.approx(10 * np.log10(4))
    assert noise_of_one.direct_phase_rad / four.direct_phase_rad == pytest.approx(2.0)
    half = predict_noise(PlanChanges(step_y_mm=4.0).apply(rig), Noise(0.0, ""))
    assert predict_noise(rig, Noise(0.0, "")).image_db - half.image_db == pytest.approx(
        10 * np.log10(200 / 101), abs=0.05
    )


def test_image_noise_is_that_of_a_weighted_sum(rig):
    """Noise through taper and window, summed as the imager sums, relative to a point's sum."""
    small = PlanChanges(columns=16, rows=12).apply(rig)
    aperture, taper = describe_aperture(small)
    rng = np.random.default_rng(1)
    rx = len(aperture.antennas.rx_m)
    samples = slice(*small.chirp.linear_samples)
    window = np.hanning(samples.stop - samples.start + 2)[1:-1]
    weight = taper[None, :, :, None] * window
    # 3 dB a chirp
    noise_power = 10 ** (-3 / 10) / small.burst.pulses
    trials = []
    for _ in range(60):
        shape = (rx, *taper.shape, window.size)
        noise = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) * np.sqrt(noise_power / 2)
        trials.append((weight * noise).sum())
    measured = 20 * np.log10((weight.sum() * rx) / np.sqrt(np.mean(np.abs(trials) ** 2)))
    assert predict_noise(small, Noise(3.0, "")).image_db == pytest.approx(measured, abs=1.5)


def test_the_loss_by_motion_is_that_of_the_sum_over_the_pulses(rig):
    moving = PlanChanges(speed_mm_s=100.0, period_us=1200.0).apply(rig)
    burst = predict_burst(moving)
    antennas = Antennas.from_rig(moving, moving.receivers[0])
    middle = np.array(specular_midpoint_m(moving, moving.receivers[0]))
    # The middle of the 192 linear samples.
    frequency_hz = moving.chirp.first_sample_hz + moving.chirp.hz_per_sample * 96
    # The 16 pulses of the first column, 1.2 ms apart at 100 mm/s.
    first_column_m = -(moving.grid.columns - 1) / 2 * 2e-3
    x_m = first_column_m + 100e-3 * 1.2e-3 * (np.arange(16) - 7.5)
    from_stage = middle - np.outer(x_m, [1, 0, 0])
    away_tx = from_stage - antennas.tx_m
    away_rx = from_stage - antennas.rx_m[0]
    path_m = np.linalg.norm(away_tx, axis=1) + np.linalg.norm(away_rx, axis=1)
    phases = np.exp(2j * np.pi * frequency_hz * path_m / LIGHT_M_PER_S)
    loss_db = -20 * np.log10(abs(np.mean(phases)))
    # From the first pulse to the last: 15 x 1.2 ms.
    assert burst.travel_mm == pytest.approx(1.8)
    assert burst.travel_wavelengths == pytest.approx(1.8e-3 * frequency_hz / LIGHT_M_PER_S)
    assert burst.duration_ms == pytest.approx(16 * 1.2)
    # A step of 2 mm takes 20 ms, of which the burst fills 19.2.
    assert burst.between_ms == pytest.approx(20.0)
    assert burst.duty == pytest.approx(0.96)
    # Chosen: the forecast takes the change of the path as linear over the burst.
    assert burst.edge_loss_db == pytest.approx(loss_db, rel=0.2)


@pytest.mark.parametrize("axis", [0, 1])
def test_ghosts_are_at_the_same_place_as_in_a_backprojected_image(rig, axis):
    """A point seen from a line of positions: the strongest response away from it is at the alias-free distance."""
    # Steps so wide that ghosts lie within some decimetres; chosen.
    if axis == 0:
        step_mm = 16.0
        changes = PlanChanges(step_x_mm=step_mm, columns=30)
    else:
        step_mm = 8.0
        changes = PlanChanges(step_y_mm=step_mm, rows=30)
    free_m = compute_field_limits(changes.apply(rig)).alias_free_mm[axis] / 1e3
    # Ghosts are nearest at the highest frequency, that of the last of the 192 linear samples.
    f = np.array([rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * 192])
    slope = PhaseSlope(rig, axis)
    a = Antennas.from_rig(rig, rig.receivers[0])
    # From the middle of the aperture's middle half the object and its ghost lie symmetrically.
    middle = np.array(specular_midpoint_m(rig, rig.receivers[0]))
    unit = np.eye(3)[axis]
    offsets = np.outer((np.arange(5) - 2) * step_mm / 1e3, unit)
    point = middle - free_m / 2 * unit

    def path(voxel):
        return sum(np.linalg.norm(voxel - p - offsets, axis=1) for p in (a.tx_m, a.rx_m[0]))

    samples = np.exp(2j * np.pi * np.outer(path(point), f) / LIGHT_M_PER_S)
    # Distances from the point at which a ghost is looked for.
    places = np.linspace(0.5, 1.6, 441) * free_m
    voxels = point + np.outer(places, unit)
    reference = np.full(len(offsets), 0.0)
    image = np.abs(backproject(samples, f, a.tx_m + offsets, a.rx_m[0] + offsets, voxels, reference))
    ghost = places[int(np.argmax(image))]
    assert image.max() > 0.8 * len(offsets)
    assert slope.slope(ghost - free_m / 2, float(f[0])) > slope.slope(-free_m / 2, float(f[0]))
    # Chosen: five positions have a broad response, and the forecast is for the worst place of the aperture.
    assert ghost == pytest.approx(free_m, rel=0.3)


def test_the_predicted_resolution_is_that_of_quality_json(rig):
    small = PlanChanges(columns=60, rows=40, step_x_mm=8.0, step_y_mm=6.0).apply(rig)
    board = next(iter(ImageBuilder(small).boards.values()))
    board.valid[:] = True
    measured = describe_board(board)
    predicted = forecast(small).response
    assert measured.point_width_mm == pytest.approx(predicted.width_mm, abs=2e-3)
    assert measured.point_limit_mm == pytest.approx(predicted.limit_mm, abs=2e-3)
    assert measured.point_paper_mm == pytest.approx(predicted.paper_mm, abs=2e-3)


def test_the_published_plan_is_possible_and_takes_two_hours(rig):
    published = forecast(rig)
    assert published.possible
    assert {warning.where for warning in published.warnings} == {"idle", "card", "IF"}
    assert not forecast(PlanChanges(columns=20, rows=20, speed_mm_s=100.0).apply(rig)).possible
    assert published.time.minutes == pytest.approx(120, rel=0.06)
    assert published.raw_bytes == 2 * 200 * 350 * 16 * 4096
    assert published.noise.position_db == pytest.approx(17.5, abs=0.1)


@pytest.mark.parametrize(
    ("changes", "topic", "value", "refused"),
    [
        # 16 pulses of 1.5 ms do not fit into the 20 ms of a step.
        (PlanChanges(speed_mm_s=100.0), "burst", "20", True),
        (PlanChanges(speed_mm_s=120.0, pulses=2), "speed", "100 mm/s", True),
        (PlanChanges(step_x_mm=2.001, pulses=2), "step x", "2.001 mm", True),
        (PlanChanges(step_y_mm=8.0), "aliasing", "in y", False),
        (PlanChanges(height_mm=200.0), "aperture", "in y", False),
        (PlanChanges(speed_mm_s=40.0, step_x_mm=4.0, pulses=120, period_us=800.0), "motion", "wavelengths", False),
        (PlanChanges(speed_mm_s=40.0), "speed", "40 mm/s", False),
        (PlanChanges(period_us=500.0), "radar", "inter-frame time", False),
        (PlanChanges(), "IF", "start_offset_hz", False),
        (PlanChanges(), "card", "marks its end", False),
        (PlanChanges(pulses=13), "card", "no short packet", False),
    ],
)
def test_a_plan_with_a_fault_has_one_warning_about_it(rig, changes, topic, value, refused):
    warnings = find_warnings(changes.apply(rig), Noise())
    matching_warnings = [w for w in warnings if w.where == topic and value in w.what]
    assert [w.level == "error" for w in matching_warnings] == [refused], warnings
    assert [w.level for w in warnings] == sorted(w.level for w in warnings)


def list_notes(rig: Instrument, topic: str, scene_mm: tuple[float, float] | None = None) -> list[str]:
    """Texts of the warnings about one topic."""
    return [w.what for w in find_warnings(rig, Noise(), scene_mm) if w.where == topic]


@pytest.mark.parametrize(
    ("topic", "at_the_limit", "beyond"),
    [
        # The stage reaches 20,000 steps/s, at 200 steps/mm.
        ("speed", PlanChanges(speed_mm_s=100.0, pulses=2), PlanChanges(speed_mm_s=101.0, pulses=2)),
        # The limit is that chirps fill half of the time: 50 of 1 ms in the 100 ms of a step.
        ("idle", PlanChanges(pulses=50, period_us=1000.0), PlanChanges(pulses=49, period_us=1000.0)),
        # A single pulse is not idle between pulses, but measures no noise.
        ("idle", PlanChanges(pulses=1), PlanChanges(pulses=2)),
        ("burst", PlanChanges(pulses=2), PlanChanges(pulses=1)),
        ("burst", PlanChanges(pulses=66), PlanChanges(pulses=67)),
    ],
)
def test_a_warning_begins_beyond_its_limit(rig, topic, at_the_limit, beyond):
    texts = [list_notes(changes.apply(rig), topic) for changes in (at_the_limit, beyond)]
    # That a stage is faster than the published one is another note, which both have.
    within, too_far = ([text for text in notes if "published" not in text] for notes in texts)
    assert not within
    assert len(too_far) == 1


def test_what_a_warning_advises_is_enough_and_just_enough(rig):
    too_fast = PlanChanges(speed_mm_s=100.0)
    (text,) = list_notes(too_fast.apply(rig), "burst")
    speed, pulses = re.search(r"at most ([\d.]+) mm/s, or at most (\d+) pulses", text).groups()
    for factor, is_possible in ((0.999, True), (1.01, False)):
        assert bool(list_notes(PlanChanges(speed_mm_s=float(speed) * factor).apply(rig), "burst")) != is_possible
    assert not list_notes(PlanChanges(speed_mm_s=100.0, pulses=int(pulses)).apply(rig), "burst")
    assert list_notes(PlanChanges(speed_mm_s=100.0, pulses=int(pulses) + 1).apply(rig), "burst")
    (text,) = list_notes(rig, "idle")
    # 16 pulses of 1.5 ms in 100 ms
    assert "for 76% of a row" in text
    assert "up to 66 pulses" in text
    wide = PlanChanges(step_y_mm=8.0)
    (text,) = list_notes(wide.apply(rig), "aliasing")
    step = float(re.search(r"at most ([\d.]+) mm,", text)[1])
    assert not list_notes(PlanChanges(step_y_mm=step).apply(rig), "aliasing")
    assert list_notes(PlanChanges(step_y_mm=step + 0.2).apply(rig), "aliasing")


def test_notes_of_the_field_count_from_the_edge_of_the_scene(rig):
    field = compute_field_limits(PlanChanges(step_y_mm=8.0, height_mm=200.0).apply(rig))
    image_mm = rig.image.rows * rig.image.pixel_mm
    wide = PlanChanges(step_y_mm=8.0, height_mm=200.0).apply(rig)
    ghost_mm = field.alias_free_mm[1]
    good_mm = 200.0 - 2 * field.mirror_zone_mm[1]
    # An object at one edge of the scene, and its ghost at the other edge of the image
    for topic, limit_mm in (("aliasing", 2 * ghost_mm - image_mm), ("aperture", good_mm)):
        assert not list_notes(wide, topic, (50.0, limit_mm - 0.1))
        (text,) = list_notes(wide, topic, (50.0, limit_mm + 0.1))
        assert "in y" in text
        assert f"{limit_mm + 0.1:.0f} mm" in text
    (text,) = list_notes(wide, "aliasing", (50.0, 150.0))
    assert f"ghosts {ghost_mm:.0f} mm" in text
    assert f"needs {(150 + image_mm) / 2:.0f} mm" in text
    (text,) = list_notes(wide, "aperture", (50.0, 150.0))
    assert f"200 mm in y images {good_mm:.0f} mm" in text
    assert f"({field.mirror_zone_mm[1]:.0f} mm of margin" in text


def test_the_note_about_an_unknown_if_ends_with_the_start_offsets(rig):
    (text,) = list_notes(rig, "IF")
    # The radars start within 5 ns of each other, in which a ramp of 38.8 MHz/us rises by 194 kHz.
    assert "margin of 194 kHz" in text
    assert not list_notes(make_programmed_rig(), "IF")
    # An IF above the sample rate of 2.15 MHz.
    assert list_notes(make_programmed_rig(3e6), "IF")


def test_the_wait_for_last_packets_is_that_of_all_rows(rig):
    (text,) = list_notes(rig, "card")
    assert f"{tail_s(rig) * 200 / 60:.1f} min" in text


@pytest.mark.parametrize("samples", [90, 91])
def test_a_frame_of_at_least_one_packet_is_possible(samples):
    """16 bytes a sample, 1456 bytes a packet."""
    short = make_rig_with(chirp={"samples": samples, "linear_samples": [0, 64]})
    assert any("is smaller than a packet" in text for text in list_notes(short, "card")) == (samples < 91)


def test_a_deviation_of_a_step_from_motor_steps_is_refused_along_both_axes(rig):
    for axis in ("x", "y"):
        assert not list_notes(PlanChanges(**{f"step_{axis}_mm": 2.005}).apply(rig), f"step {axis}")
        (text,) = list_notes(PlanChanges(**{f"step_{axis}_mm": 2.0025}).apply(rig), f"step {axis}")
        assert "2.0025 mm" in text
        assert "400.5 motor steps" in text


def test_proposals_keep_the_time_and_are_possible(rig):
    plans = propose(rig, 30.0, count=2)
    assert len(plans) == 2
    assert [p.noise.image_db for p in plans] == sorted((p.noise.image_db for p in plans), reverse=True)
    for plan in plans:
        assert plan.possible
        assert plan.time.minutes <= 30.0
        assert plan.burst.duty <= 0.95
        assert plan.rig.grid.columns * plan.rig.burst.pulses <= 65535
        assert not [w for w in plan.warnings if w.where in ("aliasing", "motion")]
    # More time never gives a worse image.
    assert propose(rig, 60.0, count=1)[0].noise.image_db > plans[0].noise.image_db


def test_a_proposed_burst_of_several_frames_of_chirps_travels_at_most_half_a_wavelength(rig):
    burst = msgspec.structs.replace(rig.burst, pulses=4, chirps=4, chirp_us=143.0, period_us=10_000.0)
    rig = msgspec.structs.replace(
        rig, burst=burst, stage=msgspec.structs.replace(rig.stage, speed_mm_s=100.0, travel_speed_mm_s=120.0)
    )
    plans = [plan for minutes in (8.0, 12.0) for plan in propose(rig, minutes, count=25, scene_mm=(1.0, 1.0))]
    assert plans
    assert max(plan.burst.travel_wavelengths for plan in plans) <= 0.5


@pytest.mark.parametrize(
    "changes", [PlanChanges(pulses=13), PlanChanges(columns=91), PlanChanges(pulses=1, columns=91)]
)
def test_a_row_of_whole_packets_is_advised_a_number_of_pulses_only_if_it_has_an_end_mark(rig, changes):
    rig = changes.apply(rig)
    (text,) = [w.what for w in find_warnings(rig, Noise()) if "no short packet" in w.what]
    advised = re.search(r"(\d+) pulses a position have an end mark", text)
    assert (advised is not None) == (not fills_whole_packets(rig, rig.burst.pulses + 1))
    assert advised is None or not fills_whole_packets(rig, int(advised[1]))


# TI's table: delay between two packets (us), and the rate that a card reaches with it (Mbit/s).
@pytest.mark.parametrize(("delay_us", "mbit_s"), [(5, 706), (10, 545), (25, 325), (50, 193)])
@pytest.mark.parametrize("share_of_rate", [0.95, 1.05])
def test_frames_that_come_faster_than_a_card_sends_them_are_noted(rig, delay_us, mbit_s, share_of_rate):
    burst = msgspec.structs.replace(rig.burst, pulses=4, chirps=16, chirp_us=20.0)
    card = msgspec.structs.replace(rig.card, packet_delay_us=delay_us)
    rig = msgspec.structs.replace(rig, burst=burst, card=card)
    period_us = 8 * rig.frame_bytes / mbit_s / share_of_rate
    rig = msgspec.structs.replace(rig, burst=msgspec.structs.replace(burst, period_us=period_us))
    notes = [w for w in find_warnings(rig, Noise()) if w.what.startswith("a card needs")]
    assert bool(notes) == (share_of_rate > 1)


def test_too_little_time_has_no_plan(rig):
    assert propose(rig, 1.0) == []


def test_a_burst_of_one_pulse_with_many_chirps_is_kept(rig):
    """It fits at five times the published speed."""
    burst = msgspec.structs.replace(rig.burst, pulses=1, chirps=16, chirp_us=143.0, period_us=2800.0)
    rig = msgspec.structs.replace(
        rig, burst=burst, stage=msgspec.structs.replace(rig.stage, speed_mm_s=100.0, travel_speed_mm_s=120.0)
    )
    planned = forecast(rig)
    assert planned.possible
    assert "burst" not in [w.where for w in planned.warnings]
    for proposal in propose(rig, minutes=60.0):
        assert proposal.rig.burst == burst


@pytest.mark.parametrize(
    ("changes", "unresolved"),
    [(PlanChanges(columns=2, rows=2), "xy"), (PlanChanges(width_mm=5.0, step_x_mm=7.0), "x"), (PlanChanges(), "")],
)
def test_an_aperture_that_resolves_nothing_has_a_warning_instead_of_figures(rig, changes, unresolved):
    planned = forecast(changes.apply(rig))
    warnings = [warning for warning in planned.warnings if warning.where == "resolution"]
    assert len(warnings) == len(unresolved)
    assert all(f"resolves nothing in {axis}" in w.what for axis, w in zip(unresolved, warnings, strict=True))
    line = next(line for line in describe(planned).splitlines() if line.startswith("resolution"))
    assert line.count("none") == 2 * len(unresolved)
