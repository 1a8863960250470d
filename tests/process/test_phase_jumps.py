"""A jump of a channel's phase within a scan is found to the row, reported, and counted in the errors."""

from __future__ import annotations

import itertools
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benchmarks.coverage import Cubes
from tests.support.mangled_scans import PLATES, SCENE, compute_distances
from tests.support.pipelines import make_pipeline
from tests.support.rigs import load_published_rig
from tests.support.scenes import make_scene

from polysight.process.row_phases import find_phase_jumps
from polysight.results import PhaseJump
from polysight_simulators.scene import decode_scene
from polysight_worlds import METAL, Plate, Stack, World, published_rig as independent_rig, record
from polysight_worlds.world import nine_places

# The scene without plates: its samples have the direct path only.
EMPTY: dict[str, Any] = SCENE | {"plates": []}


def make_jumping_cubes(board: str, row: int, degrees: float) -> Cubes:
    """Return cubes of the six plates in which the echo of one board is turned from a row on; the direct path is not."""
    cubes = Cubes(load_published_rig(), decode_scene(SCENE, "test"))
    direct_only = Cubes(load_published_rig(), decode_scene(EMPTY, "test"))
    direct = direct_only._cubes[board].mean(axis=(1, 2, 3), keepdims=True)
    echoes = cubes._cubes[board][:, row:] - direct
    cubes._cubes[board][:, row:] = direct + echoes * np.exp(1j * np.radians(degrees)).astype(np.complex64)
    return cubes


@pytest.mark.parametrize(("board", "row", "degrees"), [("RV", 14, 30.0), ("RV", 24, -30.0), ("RH", 16, 25.0)])
def test_a_jump_within_the_scan_is_the_first_reason_and_counted(board, row, degrees):
    cubes = make_jumping_cubes(board, row, degrees)
    pipeline = make_pipeline(cubes)  # type: ignore[arg-type]
    findings = pipeline.examine(pipeline.form_images())
    (jump,) = pipeline.quality.boards[board].find_phase_jumps()
    assert abs(jump.row - row) <= 1
    # The angles are found to 0.8 to 2.5 degrees; the limit is about a fifth of a jump.
    assert np.degrees(jump.angle_rad) == pytest.approx(degrees, abs=6)
    assert pipeline.quality.result().boards[board].phase_jumps == [jump]
    assert findings.verdict.level == "care"
    assert f"{board}: the phase of the echo jumps" in findings.verdict.reasons[0].what
    # All true permittivities are within three standard deviations.
    squared_distances = compute_distances(cubes, findings)
    assert len(squared_distances) == len(PLATES)
    assert max(squared_distances) < 3.0**2


def test_no_jump_is_found_without_one_or_with_one_of_2_degrees():
    for cubes in (make_jumping_cubes("RV", 20, 0.0), make_jumping_cubes("RV", 20, 2.0)):
        pipeline = make_pipeline(cubes)  # type: ignore[arg-type]
        assert not any(board.find_phase_jumps() for board in pipeline.quality.boards.values())


def draw_scene(rng: np.random.Generator) -> dict[str, Any]:
    """Return a scene of rough, tilted plates of random materials in most of nine places, with rows 5 or 6 mm apart."""
    plates: list[dict[str, Any]] = []
    for x, y in itertools.product((-60, 0, 60), (-60, 0, 60)):
        if plates and rng.random() < 0.35:
            continue
        plate: dict[str, Any] = {
            "name": f"plate {len(plates)}", "centre_mm": [x + rng.uniform(-5, 5), y + rng.uniform(-5, 5)],
            "size_mm": rng.uniform(30, 55, 2).tolist(), "tilt_deg": rng.normal(0, 0.7, 2).tolist(),
            "height_mm": -rng.uniform(0, 6), "rough_mm": float(rng.choice([0.0, 0.08, 0.25])), "rough_length_mm": 15.0,
        }  # fmt: skip
        medium = {"permittivity": [rng.uniform(2, 7), rng.uniform(0, 1.5)]} if plates else {"metal": True}
        plates.append(plate | medium)
    grid = {"columns": 31, "rows": int(rng.integers(25, 68)), "step_x_mm": 10.0, "step_y_mm": float(rng.choice([5, 6]))}
    return {"name": "drawn", "seed": int(rng.integers(1000000)), "grid": grid, "plates": plates}


def test_no_drawn_scene_has_a_jump_of_its_own(request):
    """A jump that is found where there is none would be removed from the images, and spoil them."""
    rng = np.random.default_rng(3)
    scenes = 40 if request.config.getoption("--long") else 1
    for _ in range(scenes):
        cubes = Cubes(load_published_rig(), decode_scene(draw_scene(rng), "test"))
        pipeline = make_pipeline(cubes)  # type: ignore[arg-type]
        assert not any(board.find_phase_jumps() for board in pipeline.quality.boards.values())


@pytest.mark.parametrize(("columns", "rows", "step_mm"), [(14, 10, (14.0, 12.0)), (31, 24, (10.0, 12.0))])
def test_no_jump_is_searched_in_rows_too_far_apart_or_too_few(columns, rows, step_mm):
    plates = [
        {"name": "copper", "centre_mm": [-34.0, 0.0], "size_mm": [46.0, 60.0], "metal": True},
        {"name": "mine", "centre_mm": [34.0, 0.0], "size_mm": [46.0, 60.0], "permittivity": [4.0, 0.4]},
    ]
    scene = make_scene(*plates, columns=columns, rows=rows, step_mm=step_mm, image={"columns": 40, "rows": 30})
    pipeline = make_pipeline(Cubes(load_published_rig(), decode_scene(scene, "test")))  # type: ignore[arg-type]
    assert not any(board.find_phase_jumps() for board in pipeline.quality.boards.values())


@pytest.fixture(scope="module")
def independent_rows():
    """Echoes of nine plates in V's board by row, in one range cell, of the independent generator; without a jump."""
    rig = independent_rig()
    places = nine_places((rig.centre_m[0], rig.centre_m[1]))
    stacks = [METAL, *(Stack(below=complex(e, -0.4)) for e in (2.2, 3.0, 3.6, 4.2, 5.0, 6.0, 7.0, 2.6))]
    plates = [Plate(str(i), place, (0.046, 0.046), s) for i, (place, s) in enumerate(zip(places, stacks, strict=True))]
    echoes = record(rig, rig.v, World(tuple(plates)))
    direct_m = np.linalg.norm(rig.v.position - rig.tx.position)
    # The plates are in the range cell 0.308 m beyond the direct path: the sum over the sweep of the echo times the
    # conjugate of a wave with this path.
    middle_m = 0.308
    conjugate_wave = np.exp(2j * np.pi * rig.frequencies_hz * (direct_m + middle_m) / 299792458.0)
    cell = np.tensordot(conjugate_wave, echoes, 1)
    return {row: cell[row][None] for row in range(len(cell))}


def add_jumps(rows, jumps):
    """Return the same rows with jumps: `jumps` is the row before which the phase jumps, to degrees."""
    jumping_rows = {}
    for row, echo in rows.items():
        degrees = sum(jump_deg for jump_row, jump_deg in jumps.items() if row >= jump_row)
        jumping_rows[row] = echo * np.exp(1j * np.radians(degrees))
    return jumping_rows


@pytest.mark.parametrize("degrees", [30.0, -45.0, 15.0])
@pytest.mark.parametrize("row", [60, 100, 130])
def test_jumps_of_an_independent_world_are_found(independent_rows, degrees, row):
    assert find_phase_jumps(independent_rows) == ()
    (jump,) = find_phase_jumps(add_jumps(independent_rows, {row: degrees}))
    assert jump.row == row
    # Angles are found to 0.02 degrees: there is no noise.
    assert np.degrees(jump.angle_rad) == pytest.approx(degrees, abs=1)


@pytest.mark.parametrize("jumps", [{60: 30.0, 100: -45.0}, {64: -20.0, 98: -60.0, 130: -58.0}])
def test_each_of_several_jumps_is_found_one_by_one(independent_rows, jumps):
    """Jumps that were not found would split plates in the image."""
    phase_jumps = find_phase_jumps(add_jumps(independent_rows, jumps))
    assert [jump.row for jump in phase_jumps] == list(jumps)
    # The largest error is 0.05 degrees.
    angles_deg = np.degrees([jump.angle_rad for jump in phase_jumps])
    assert angles_deg == pytest.approx(list(jumps.values()), abs=1.5)


def test_rows_are_turned_back_by_all_jumps_and_the_longest_section_keeps_its_phase(monkeypatch):
    pipeline = make_pipeline(Cubes(load_published_rig(), decode_scene(EMPTY, "test")))  # type: ignore[arg-type]
    board = pipeline.quality.boards["RV"]
    monkeypatch.setattr(board, "find_phase_jumps", lambda: (PhaseJump(4, 0.5), PhaseJump(25, -0.2)))
    corrected_rows: dict[str, Any] = {}
    builder = SimpleNamespace(
        boards={name: SimpleNamespace(turn_rows=partial(corrected_rows.__setitem__, name)) for name in ("RH", "RV")}
    )
    pipeline.quality._remove_phase_jumps([builder])  # type: ignore[list-item]
    # Rows 4 to 24 are the longest section without a jump.
    assert not corrected_rows["RH"].any()
    np.testing.assert_allclose(corrected_rows["RV"][[0, 3, 4, 24, 25, -1]], [0.5, 0.5, 0.0, 0.0, 0.2, 0.2])
