"""The forecast for a planned scan (noise, loss by motion, aliases, resolution, time), its warnings and proposals.

Noise, loss, aliases and resolution are compared with independent computations.
"""

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
    width_mm = (rig.grid.columns - 1) * rig.grid.step_x_mm
    height_mm = (rig.grid.rows - 1) * rig.grid.step_y_mm
    grid = PlanChanges(step_x_mm=6.0, step_y_mm=4.0).apply(rig).grid
    # To within half a step.
    assert (grid.columns - 1) * 6.0 == pytest.approx(width_mm, abs=6.0 / 2)
    assert (grid.rows - 1) * 4.0 == pytest.approx(height_mm, abs=4.0 / 2)


@pytest.mark.parametrize(
    "changes", [PlanChanges(width_mm=900.0), PlanChanges(speed_mm_s=100.0, pulses=2, width_mm=760.0)]
)
def test_a_plan_whose_rows_exceed_the_travel_is_refused_by_the_rig_file_s_rule(rig, changes):
    with expect_refusal(
        ErrorCode.VALUE_INVALID, "grid.columns", "stage.travel_x_mm", "polysight plan --help"
    ) as refusal:
        changes.apply(rig)
    # The numbers come from options: there is no file to correct.
    assert "correct" not in refusal.value.remedy


def test_noise_falls_with_chirps_and_positions(rig):
    chirp_noise = Noise(0.0, "")
    with_4_chirps = predict_noise(PlanChanges(pulses=4).apply(rig), chirp_noise)
    with_16_chirps = predict_noise(PlanChanges(pulses=16).apply(rig), chirp_noise)
    assert with_16_chirps.position_db - with_4_chirps.position_db == pytest.approx(10 * np.log10(16 / 4))
    assert with_16_chirps.image_db - with_4_chirps.image_db == pytest.approx(10 * np.log10(16 / 4))
    assert with_4_chirps.direct_phase_rad / with_16_chirps.direct_phase_rad == pytest.approx(np.sqrt(16 / 4))
    # With twice the step in y there are 101 rows instead of 200. The weights of the aperture then differ a little.
    all_rows = predict_noise(rig, chirp_noise)
    half_of_the_rows = predict_noise(PlanChanges(step_y_mm=4.0).apply(rig), chirp_noise)
    assert all_rows.image_db - half_of_the_rows.image_db == pytest.approx(10 * np.log10(200 / 101), abs=0.05)


def test_image_noise_is_that_of_a_weighted_sum(rig):
    """Noise of samples with the imager's weights is summed as by the imager, and compared with the sum of an echo."""
    snr_of_a_chirp_db = 3.0
    small = PlanChanges(columns=16, rows=12).apply(rig)
    aperture, taper = describe_aperture(small)
    rng = np.random.default_rng(1)
    rx = len(aperture.antennas.rx_m)
    first_sample, end_sample = small.chirp.linear_samples
    # A Hann window without the zeros at its ends.
    window = np.hanning(end_sample - first_sample + 2)[1:-1]
    weight = taper[None, :, :, None] * window
    noise_power = 10 ** (-snr_of_a_chirp_db / 10) / small.burst.pulses
    trials = []
    for _ in range(60):
        shape = (rx, *taper.shape, window.size)
        noise = (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) * np.sqrt(noise_power / 2)
        trials.append((weight * noise).sum())
    sum_of_an_echo = weight.sum() * rx
    rms_of_noise = np.sqrt(np.mean(np.abs(trials) ** 2))
    image_snr_db = 20 * np.log10(sum_of_an_echo / rms_of_noise)
    # The power of 60 random sums has a standard error of 13 %, 0.5 dB.
    assert predict_noise(small, Noise(snr_of_a_chirp_db, "")).image_db == pytest.approx(image_snr_db, abs=1.5)


def test_the_loss_by_motion_is_that_of_the_sum_over_the_pulses(rig):
    speed_mm_s = 100.0
    period_s = 1.2e-3
    pulses = 16
    step_mm = 2.0
    moving_rig = PlanChanges(speed_mm_s=speed_mm_s, period_us=1e6 * period_s).apply(rig)
    burst = predict_burst(moving_rig)
    # From the first pulse to the last.
    travel_mm = speed_mm_s * (pulses - 1) * period_s
    # The middle of the 192 linear samples.
    frequency_hz = moving_rig.chirp.first_sample_hz + moving_rig.chirp.hz_per_sample * 192 / 2
    assert burst.travel_mm == pytest.approx(travel_mm)
    assert burst.travel_wavelengths == pytest.approx(1e-3 * travel_mm * frequency_hz / LIGHT_M_PER_S)
    burst_s = pulses * period_s
    step_s = step_mm / speed_mm_s
    assert burst.duration_ms == pytest.approx(1e3 * burst_s)
    assert burst.between_ms == pytest.approx(1e3 * step_s)
    assert burst.duty == pytest.approx(burst_s / step_s)

    # Paths to the middle of the scene at the pulses of the first column, where the path changes fastest.
    board = moving_rig.receivers[0]
    antennas = Antennas.from_rig(moving_rig, board)
    scene_m = np.array(specular_midpoint_m(moving_rig, board))
    first_column_m = -(moving_rig.grid.columns - 1) / 2 * 1e-3 * step_mm
    pulse_times_s = (np.arange(pulses) - (pulses - 1) / 2) * period_s
    x_m = first_column_m + 1e-3 * speed_mm_s * pulse_times_s
    scene_from_stage_m = scene_m - np.outer(x_m, [1, 0, 0])
    tx_distance_m = np.linalg.norm(scene_from_stage_m - antennas.tx_m, axis=1)
    rx_distance_m = np.linalg.norm(scene_from_stage_m - antennas.rx_m[0], axis=1)
    phasors = np.exp(2j * np.pi * frequency_hz * (tx_distance_m + rx_distance_m) / LIGHT_M_PER_S)
    loss_db = -20 * np.log10(abs(np.mean(phasors)))
    # The forecast takes the change of the path as linear over the burst: it is 12 % less (measured).
    assert burst.edge_loss_db == pytest.approx(loss_db, rel=0.2)


@pytest.mark.parametrize(
    ("axis", "step_mm", "changes"),
    # Steps so wide that ghosts are some decimetres from the object.
    [(0, 16.0, PlanChanges(step_x_mm=16.0, columns=30)), (1, 8.0, PlanChanges(step_y_mm=8.0, rows=30))],
    ids=["x", "y"],
)
def test_a_ghost_is_at_the_same_distance_from_its_object_as_in_a_backprojected_image(rig, axis, step_mm, changes):
    """A ghost, an alias of the wide steps, is the strongest response away from a point seen from five positions."""
    ghost_distance_m = compute_field_limits(changes.apply(rig)).alias_free_mm[axis] / 1e3
    # Ghosts are nearest at the highest frequency, that of the last of the 192 linear samples.
    frequency_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * 192
    board = rig.receivers[0]
    antennas = Antennas.from_rig(rig, board)
    direction = np.eye(3)[axis]
    positions_m = np.outer((np.arange(5) - 2) * step_mm / 1e3, direction)
    # The middle of the scene is half-way between the object and its ghost.
    object_m = np.array(specular_midpoint_m(rig, board)) - ghost_distance_m / 2 * direction

    tx_m = antennas.tx_m + positions_m
    rx_m = antennas.rx_m[0] + positions_m
    path_m = np.linalg.norm(object_m - tx_m, axis=1) + np.linalg.norm(object_m - rx_m, axis=1)
    samples = np.exp(2j * np.pi * frequency_hz * path_m / LIGHT_M_PER_S)[:, None]
    distances_m = np.linspace(0.5, 1.6, 441) * ghost_distance_m
    voxels_m = object_m + np.outer(distances_m, direction)
    no_reference_m = np.zeros(len(positions_m))
    image = np.abs(backproject(samples, np.array([frequency_hz]), tx_m, rx_m, voxels_m, no_reference_m))
    imaged_distance_m = distances_m[int(np.argmax(image))]
    # The object itself has the sum of the positions, 5.
    assert image.max() > 0.8 * len(positions_m)
    slope = PhaseSlope(rig, axis)
    slope_at_ghost = slope.slope(imaged_distance_m - ghost_distance_m / 2, frequency_hz)
    slope_at_object = slope.slope(-ghost_distance_m / 2, frequency_hz)
    assert slope_at_ghost > slope_at_object
    # The response of five positions is broad: its maximum is 6 % farther in x, and 0 % in y (measured).
    assert imaged_distance_m == pytest.approx(ghost_distance_m, rel=0.3)


def test_the_predicted_resolution_is_that_of_quality_json(rig):
    small = PlanChanges(columns=60, rows=40, step_x_mm=8.0, step_y_mm=6.0).apply(rig)
    board = next(iter(ImageBuilder(small).boards.values()))
    board.valid[:] = True
    measured = describe_board(board)
    predicted = forecast(small).response
    # Values in quality.json are rounded to micrometres.
    assert measured.point_width_mm == pytest.approx(predicted.width_mm, abs=2e-3)
    assert measured.point_limit_mm == pytest.approx(predicted.limit_mm, abs=2e-3)
    assert measured.point_paper_mm == pytest.approx(predicted.paper_mm, abs=2e-3)


def test_the_published_plan_is_possible_and_takes_two_hours(rig):
    published = forecast(rig)
    assert published.possible
    assert {warning.where for warning in published.warnings} == {"idle", "card", "IF"}
    # The paper says about two hours.
    assert published.time.minutes == pytest.approx(120, rel=0.06)
    boards = 2
    chirp_bytes = 256 * 4 * 4
    assert published.raw_bytes == boards * 200 * 350 * 16 * chirp_bytes
    # A chirp of the simulated rig has 5.5 dB; a position averages 16.
    assert published.noise.position_db == pytest.approx(5.5 + 10 * np.log10(16), abs=0.1)


def test_a_scan_at_five_times_the_published_speed_is_not_possible(rig):
    assert not forecast(PlanChanges(columns=20, rows=20, speed_mm_s=100.0).apply(rig)).possible


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
    matching_warnings = [warning for warning in warnings if warning.where == topic and value in warning.what]
    (matching_warning,) = matching_warnings
    assert (matching_warning.level == "error") == refused
    # Errors come before warnings.
    levels = [warning.level for warning in warnings]
    assert levels == sorted(levels)


def list_notes(rig: Instrument, topic: str, scene_mm: tuple[float, float] | None = None) -> list[str]:
    """Texts of the warnings about one topic."""
    return [warning.what for warning in find_warnings(rig, Noise(), scene_mm) if warning.where == topic]


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
    # Another note, which both plans have, says that the stage is faster than the published one.
    notes_at_the_limit = [text for text in list_notes(at_the_limit.apply(rig), topic) if "published" not in text]
    notes_beyond = [text for text in list_notes(beyond.apply(rig), topic) if "published" not in text]
    assert not notes_at_the_limit
    assert len(notes_beyond) == 1


def test_the_speed_and_the_pulses_that_are_advised_for_a_burst_are_the_largest_possible_ones(rig):
    (text,) = list_notes(PlanChanges(speed_mm_s=100.0).apply(rig), "burst")
    advised = re.search(r"at most ([\d.]+) mm/s, or at most (\d+) pulses", text)
    speed_mm_s = float(advised[1])
    pulses = int(advised[2])
    assert not list_notes(PlanChanges(speed_mm_s=0.999 * speed_mm_s).apply(rig), "burst")
    assert list_notes(PlanChanges(speed_mm_s=1.01 * speed_mm_s).apply(rig), "burst")
    assert not list_notes(PlanChanges(speed_mm_s=100.0, pulses=pulses).apply(rig), "burst")
    assert list_notes(PlanChanges(speed_mm_s=100.0, pulses=pulses + 1).apply(rig), "burst")


def test_the_note_on_idle_radars_says_how_many_pulses_have_room(rig):
    (text,) = list_notes(rig, "idle")
    # Of the 100 ms of a step, 16 pulses of 1.5 ms fill 24 %; the time is enough for 66.
    assert "for 76% of a row" in text
    assert "up to 66 pulses" in text


def test_the_step_that_is_advised_against_aliases_is_the_largest_without_them(rig):
    (text,) = list_notes(PlanChanges(step_y_mm=8.0).apply(rig), "aliasing")
    step_mm = float(re.search(r"at most ([\d.]+) mm,", text)[1])
    assert not list_notes(PlanChanges(step_y_mm=step_mm).apply(rig), "aliasing")
    assert list_notes(PlanChanges(step_y_mm=step_mm + 0.2).apply(rig), "aliasing")


SCENE_WIDTH_MM = 50.0


@pytest.fixture
def wide_steps_rig(rig):
    """A scan of 200 mm in y with steps so wide that ghosts appear in the image."""
    return PlanChanges(step_y_mm=8.0, height_mm=200.0).apply(rig)


def test_ghosts_are_noted_if_that_of_an_object_at_the_edge_of_the_scene_is_in_the_image(wide_steps_rig):
    _, ghost_distance_mm = compute_field_limits(wide_steps_rig).alias_free_mm
    image_mm = wide_steps_rig.image.rows * wide_steps_rig.image.pixel_mm
    # The ghost of an object at one edge of the scene is at the other edge of the image.
    limit_mm = 2 * ghost_distance_mm - image_mm
    assert not list_notes(wide_steps_rig, "aliasing", (SCENE_WIDTH_MM, limit_mm - 0.1))
    (text,) = list_notes(wide_steps_rig, "aliasing", (SCENE_WIDTH_MM, limit_mm + 0.1))
    assert "in y" in text
    assert f"{limit_mm + 0.1:.0f} mm" in text
    (text,) = list_notes(wide_steps_rig, "aliasing", (SCENE_WIDTH_MM, 150.0))
    assert f"ghosts {ghost_distance_mm:.0f} mm" in text
    assert f"needs {(150 + image_mm) / 2:.0f} mm" in text


def test_an_aperture_is_noted_if_it_does_not_receive_the_mirror_reflections_of_the_whole_scene(wide_steps_rig):
    _, margin_mm = compute_field_limits(wide_steps_rig).mirror_zone_mm
    limit_mm = 200.0 - 2 * margin_mm
    assert not list_notes(wide_steps_rig, "aperture", (SCENE_WIDTH_MM, limit_mm - 0.1))
    (text,) = list_notes(wide_steps_rig, "aperture", (SCENE_WIDTH_MM, limit_mm + 0.1))
    assert "in y" in text
    assert f"{limit_mm + 0.1:.0f} mm" in text
    (text,) = list_notes(wide_steps_rig, "aperture", (SCENE_WIDTH_MM, 150.0))
    assert f"200 mm in y images {limit_mm:.0f} mm" in text
    assert f"({margin_mm:.0f} mm of margin" in text


def test_the_note_about_an_unknown_if_ends_with_the_start_offsets(rig):
    (text,) = list_notes(rig, "IF")
    # The radars start within 5 ns of each other, in which a ramp of 38.8 MHz/us rises by 194 kHz.
    assert "margin of 194 kHz" in text
    assert not list_notes(make_programmed_rig(), "IF")
    # An IF above the sample rate of 2.15 MHz.
    assert list_notes(make_programmed_rig(3e6), "IF")


def test_the_wait_for_last_packets_is_that_of_all_rows(rig):
    (text,) = list_notes(rig, "card")
    wait_min = tail_s(rig) * rig.grid.rows / 60
    assert f"{wait_min:.1f} min" in text


@pytest.mark.parametrize("samples", [90, 91])
def test_a_frame_that_is_smaller_than_a_packet_is_noted(samples):
    rig = make_rig_with(chirp={"samples": samples, "linear_samples": [0, 64]})
    # Two bytes each for the real and the imaginary part on four receive antennas.
    frame_bytes = samples * 2 * 2 * 4
    is_noted = any("is smaller than a packet" in text for text in list_notes(rig, "card"))
    assert is_noted == (frame_bytes < 1456)


def test_a_step_that_is_not_a_whole_number_of_motor_steps_is_refused(rig):
    """The stage has 200 motor steps a millimetre, so that 2.005 mm are 401."""
    for axis in ("x", "y"):
        assert not list_notes(PlanChanges(**{f"step_{axis}_mm": 2.005}).apply(rig), f"step {axis}")
        (text,) = list_notes(PlanChanges(**{f"step_{axis}_mm": 2.0025}).apply(rig), f"step {axis}")
        assert "2.0025 mm" in text
        assert "400.5 motor steps" in text


def test_proposals_keep_the_time_and_are_possible(rig):
    minutes = 30.0
    best_plan, second_plan = propose(rig, minutes, count=2)
    assert best_plan.noise.image_db >= second_plan.noise.image_db
    for plan in (best_plan, second_plan):
        assert plan.possible
        assert plan.time.minutes <= minutes
        # Bursts leave a twentieth of the time free.
        assert plan.burst.duty <= 0.95
        # The radar counts the frames of a row with 16 bits.
        assert plan.rig.grid.columns * plan.rig.burst.pulses <= 2**16 - 1
        assert not [warning for warning in plan.warnings if warning.where in ("aliasing", "motion")]
    (plan_of_an_hour,) = propose(rig, 2 * minutes, count=1)
    assert plan_of_an_hour.noise.image_db > best_plan.noise.image_db


def test_a_proposed_burst_of_several_frames_of_chirps_travels_at_most_half_a_wavelength(rig):
    burst = msgspec.structs.replace(rig.burst, pulses=4, chirps=4, chirp_us=143.0, period_us=10_000.0)
    fast_stage = msgspec.structs.replace(rig.stage, speed_mm_s=100.0, travel_speed_mm_s=120.0)
    rig = msgspec.structs.replace(rig, burst=burst, stage=fast_stage)
    plans = []
    for minutes in (8.0, 12.0):
        plans += propose(rig, minutes, count=25, scene_mm=(1.0, 1.0))
    assert plans
    assert max(plan.burst.travel_wavelengths for plan in plans) <= 0.5


@pytest.mark.parametrize(
    "changes", [PlanChanges(pulses=13), PlanChanges(columns=91), PlanChanges(pulses=1, columns=91)]
)
def test_a_number_of_pulses_that_is_advised_for_a_row_of_whole_packets_gives_it_a_short_last_packet(rig, changes):
    """A card marks the end of a row with a short packet. No number is advised if one more pulse gives none either."""
    rig = changes.apply(rig)
    (text,) = [warning.what for warning in find_warnings(rig, Noise()) if "no short packet" in warning.what]
    advised = re.search(r"(\d+) pulses a position have an end mark", text)
    one_more_pulse_helps = not fills_whole_packets(rig, rig.burst.pulses + 1)
    assert (advised is not None) == one_more_pulse_helps
    if advised is not None:
        advised_pulses = int(advised[1])
        assert not fills_whole_packets(rig, advised_pulses)


# The delay between two packets (us), and the rate that a card reaches with it (Mbit/s), by the table of its maker, TI.
@pytest.mark.parametrize(("delay_us", "mbit_s"), [(5, 706), (10, 545), (25, 325), (50, 193)])
@pytest.mark.parametrize("share_of_rate", [0.95, 1.05])
def test_frames_that_come_faster_than_a_card_sends_them_are_noted(rig, delay_us, mbit_s, share_of_rate):
    burst = msgspec.structs.replace(rig.burst, pulses=4, chirps=16, chirp_us=20.0)
    card = msgspec.structs.replace(rig.card, packet_delay_us=delay_us)
    rig = msgspec.structs.replace(rig, burst=burst, card=card)
    period_us = 8 * rig.frame_bytes / mbit_s / share_of_rate
    rig = msgspec.structs.replace(rig, burst=msgspec.structs.replace(burst, period_us=period_us))
    notes = [warning for warning in find_warnings(rig, Noise()) if warning.what.startswith("a card needs")]
    assert bool(notes) == (share_of_rate > 1)


def test_too_little_time_has_no_plan(rig):
    assert propose(rig, minutes=1.0) == []


def test_a_burst_of_one_pulse_with_many_chirps_is_kept(rig):
    """It fits at five times the published speed."""
    burst = msgspec.structs.replace(rig.burst, pulses=1, chirps=16, chirp_us=143.0, period_us=2800.0)
    fast_stage = msgspec.structs.replace(rig.stage, speed_mm_s=100.0, travel_speed_mm_s=120.0)
    rig = msgspec.structs.replace(rig, burst=burst, stage=fast_stage)
    planned = forecast(rig)
    assert planned.possible
    assert "burst" not in [warning.where for warning in planned.warnings]
    for proposal in propose(rig, minutes=60.0):
        assert proposal.rig.burst == burst


@pytest.mark.parametrize(
    ("changes", "unresolved_axes"),
    [(PlanChanges(columns=2, rows=2), "xy"), (PlanChanges(width_mm=5.0, step_x_mm=7.0), "x"), (PlanChanges(), "")],
)
def test_an_aperture_that_resolves_nothing_has_a_warning_instead_of_figures(rig, changes, unresolved_axes):
    planned = forecast(changes.apply(rig))
    warnings = [warning for warning in planned.warnings if warning.where == "resolution"]
    for axis, warning in zip(unresolved_axes, warnings, strict=True):
        assert f"resolves nothing in {axis}" in warning.what
    (line,) = [line for line in describe(planned).splitlines() if line.startswith("resolution")]
    # Of each axis the line has the width of a point and its limit.
    assert line.count("none") == 2 * len(unresolved_axes)
