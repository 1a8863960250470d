"""Displaced rows and a drifting phase are reported as such; effects that only look like a jump are not corrected."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from benchmarks.coverage import Cubes
from msgspec import UNSET
from tests.support.mangled_scans import PLATES, SCENE, compute_distances
from tests.support.pipelines import make_pipeline
from tests.support.rigs import load_published_rig

from polysight.process.row_phases import DisplacedRows, find_displaced_rows, find_phase_jumps, keep_jumps_without_shifts
from polysight_simulators.scene import decode_scene
from polysight_worlds import METAL, Plate, Stack, World, published_rig as independent_rig, record
from polysight_worlds.world import nine_places

EMPTY: dict[str, Any] = SCENE | {"plates": []}
# Distance along y of the rows of the independent generator, and of those that are interpolated between them
FINE_STEP_MM = 2.0
STEP_MM = 4.0
Echoes = dict[int, np.ndarray]


@pytest.fixture(scope="module")
def fine_rows() -> list[np.ndarray]:
    """Echoes of nine plates in both boards, [row, position] with rows 2 mm apart, of the independent generator."""
    rig = independent_rig()
    stacks = [METAL, *(Stack(below=complex(e, -0.4)) for e in (2.2, 3.0, 3.6, 4.2, 5.0, 6.0, 7.0, 2.6))]
    places = nine_places((rig.centre_m[0], rig.centre_m[1]))
    plates = [Plate(str(i), place, (0.046, 0.046), s) for i, (place, s) in enumerate(zip(places, stacks, strict=True))]
    boards = []
    for antenna in (rig.h, rig.v):
        echoes = record(rig, antenna, World(tuple(plates)))
        direct_m = np.linalg.norm(antenna.position - rig.tx.position)
        # The range cell of the plates, 0.308 m beyond the direct path: the sum over the sweep of the echo times the
        # conjugate of a wave with this path.
        conjugate_wave = np.exp(2j * np.pi * rig.frequencies_hz * (direct_m + 0.308) / 299792458.0)
        boards.append(np.tensordot(conjugate_wave, echoes, 1))
    return boards


def displace(fine: np.ndarray, shifts_mm: np.ndarray) -> Echoes:
    """Return rows 4 mm apart, each as recorded at its displaced place: interpolated by the spectrum along y."""
    frequencies = np.fft.fftfreq(len(fine), FINE_STEP_MM)
    spectrum = np.fft.fft(fine, axis=0)
    rows = {}
    for number in range(len(fine) // 2):
        y_mm = STEP_MM * number + shifts_mm[number]
        rows[number] = (np.exp(2j * np.pi * frequencies * y_mm) @ spectrum / len(fine))[None]
    return rows


def draw_shifts_mm(seed: int, rms_mm: float) -> np.ndarray:
    """Return the displacements of 100 rows: random from row to row, and a wave over 10 to 60 rows."""
    rng = np.random.default_rng(seed)
    slow = np.sin(2 * np.pi * np.arange(100) / rng.uniform(10, 60))
    return rms_mm * (rng.standard_normal(100) + 1.5 * slow)


@pytest.mark.parametrize("seed", range(4))
def test_rows_that_are_displaced_in_both_boards_are_found_and_are_not_jumps(fine_rows, seed):
    """The phase of V in a displaced row looks like a jump of the phase, which must not be corrected."""
    boards = [displace(fine, draw_shifts_mm(seed, 0.4)) for fine in fine_rows]
    displaced = find_displaced_rows(boards, STEP_MM)
    # Found are 0.33 to 0.44 mm.
    assert displaced.rms_mm == pytest.approx(0.4, rel=0.5)
    # There are candidates for a jump, and none is left when the displacements are known.
    assert any(find_phase_jumps(rows) for rows in boards)
    assert not any(keep_jumps_without_shifts(find_phase_jumps(rows), rows, displaced.shifts) for rows in boards)


def test_rows_in_their_places_are_not_displaced(fine_rows):
    boards = [displace(fine, np.zeros(100)) for fine in fine_rows]
    assert find_displaced_rows(boards, STEP_MM).rms_mm == 0.0


def test_quality_json_has_the_size_of_displaced_rows_and_no_entry_without_them(monkeypatch):
    pipeline = make_pipeline(Cubes(load_published_rig(), decode_scene(EMPTY, "test")))  # type: ignore[arg-type]
    assert pipeline.quality.result().rows_displaced_mm is UNSET
    monkeypatch.setattr(
        "polysight.process.quality.find_displaced_rows", lambda *_: DisplacedRows(np.zeros((1, 41)), 0.4)
    )
    pipeline.quality.find_displaced_rows()
    assert pipeline.quality.result().rows_displaced_mm == 0.4


@pytest.mark.parametrize("in_both_boards", [False, True])
def test_a_jump_is_not_taken_for_a_displacement(fine_rows, in_both_boards):
    boards = [displace(fine, np.zeros(100)) for fine in fine_rows]
    jumping_boards = boards if in_both_boards else boards[1:]
    for rows in jumping_boards:
        # The phase of all rows from number 48 on jumps by 0.6 rad.
        for number in range(48, 100):
            rows[number] = rows[number] * np.exp(0.6j)
    assert find_displaced_rows(boards, STEP_MM).rms_mm == 0.0


def test_a_jump_among_displaced_rows_is_found_at_its_row(fine_rows):
    rows = displace(fine_rows[1], draw_shifts_mm(1, 0.4))
    other_rows = displace(fine_rows[0], draw_shifts_mm(1, 0.4))
    # A jump of 1.2 rad in one of the boards
    for number in range(48, 100):
        rows[number] = rows[number] * np.exp(1.2j)
    shifts = find_displaced_rows([other_rows, rows], STEP_MM).shifts
    jumps = keep_jumps_without_shifts(find_phase_jumps(rows), rows, shifts)
    assert [jump.row for jump in jumps] == [48]


def make_drifting_cubes(board: str, phase_rad: np.ndarray) -> Cubes:
    """Return cubes of the six plates in which the echo of one board, not its direct path, has a phase of each row."""
    cubes = Cubes(load_published_rig(), decode_scene(SCENE, "test"))
    direct_only = Cubes(load_published_rig(), decode_scene(EMPTY, "test"))
    direct = direct_only._cubes[board].mean(axis=(1, 2, 3), keepdims=True)
    echoes = cubes._cubes[board] - direct
    cubes._cubes[board] = direct + echoes * np.exp(1j * phase_rad).astype(np.complex64)[None, :, None, None]
    return cubes


@pytest.mark.parametrize(("board", "size_rad"), [("RV", 0.8), ("RH", -1.0)])
def test_a_drift_of_one_boards_phase_is_the_first_reason_and_is_removed(board, size_rad):
    """The drift looks like a second path or like displaced boards; neither is reported."""
    rows = SCENE["grid"]["rows"]
    phase_rad = size_rad * np.sin(2 * np.pi * np.arange(rows) / rows)
    cubes = make_drifting_cubes(board, phase_rad)
    pipeline = make_pipeline(cubes)  # type: ignore[arg-type]
    findings = pipeline.examine(pipeline.form_images())
    drift = pipeline.quality.result().phase_drift
    assert drift
    assert drift.board == board
    # The drift has a range of twice its size; the plates do not reach its extremes.
    assert abs(size_rad) < drift.range_rad < 2.2 * abs(size_rad)
    assert drift.left_rad < drift.rms_rad / 2
    assert "the phase of V / H drifts over the rows" in findings.verdict.reasons[0].what
    assert not any("second path" in r.why or "out of place" in r.why for r in findings.verdict.reasons)
    # All true permittivities are within three standard deviations.
    squared_distances = compute_distances(cubes, findings)
    assert len(squared_distances) == len(PLATES)
    assert max(squared_distances) < 3.0**2


def test_a_drift_of_0_02_radians_is_not_reported():
    rows = SCENE["grid"]["rows"]
    cubes = make_drifting_cubes("RV", 0.02 * np.sin(2 * np.pi * np.arange(rows) / rows))
    pipeline = make_pipeline(cubes)  # type: ignore[arg-type]
    pipeline.form_images()
    assert pipeline.quality.result().phase_drift is UNSET
