"""Point response: measured widths and sidelobes agree with formulas, and so does the loss by missing positions."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from msgspec import UNSET

from polysight.imaging import ImageBuilder
from polysight.imaging.resolution import compute_point_response, describe_board, describe_imaging
from polysight_shared.geometry import specular_midpoint_m


def _make_full_board(rig, **options):
    board = ImageBuilder(rig, **options).boards["RH"]
    board.valid[:] = True
    return board


@pytest.mark.parametrize(("columns", "rows", "step"), [(41, 41, 4.0), (350, 200, 2.0)])
def test_without_a_taper_the_measured_response_is_the_geometrys_limit(make_rig, columns, rows, step):
    board = _make_full_board(make_rig(columns, rows, step, step, pixels=(31, 31)), taper="boxcar")
    response = compute_point_response(board.aperture, board.weights)
    np.testing.assert_allclose(response.width_mm, response.limit_mm, rtol=0.08)
    # A sinc's first sidelobe is -13.3 dB
    assert max(response.sidelobe_db) < -11


def test_the_limit_is_that_of_the_plane_wave_formula_and_the_papers_is_not(make_rig):
    board = _make_full_board(make_rig(41, 41, 4.0, 4.0, pixels=(31, 31)), taper="boxcar")
    response = compute_point_response(board.aperture, board.weights)
    cos = np.cos(np.radians(54.93))
    wave = 3.82
    height = 488.0
    length = 160.0
    plane = (0.886 * wave * height / (2 * length * cos**3), 0.886 * wave * height / (2 * length * cos))
    np.testing.assert_allclose(response.limit_mm, plane, rtol=0.1)
    np.testing.assert_allclose(response.paper_mm, wave * 499 / length, rtol=0.03)


def test_the_published_scan_reaches_what_the_simulation_of_its_geometry_says(make_rig):
    """5.4 x 3.6 mm without a taper; the paper's r lambda / L is 2.8 mm along its 0.7 m and 4.9 mm along its 0.4 m."""
    board = _make_full_board(make_rig(350, 200, 2.0, 2.0, pixels=(150, 150)), taper="boxcar")
    response = compute_point_response(board.aperture, board.weights)
    np.testing.assert_allclose(response.width_mm, (5.4, 3.6), atol=0.35)
    np.testing.assert_allclose(response.paper_mm, (2.7, 4.8), atol=0.15)


def test_a_taper_trades_width_for_sidelobes(make_rig):
    rig = make_rig(41, 41, 4.0, 4.0, pixels=(31, 31))

    def response_with(name):
        board = _make_full_board(
            msgspec.structs.replace(rig, image=msgspec.structs.replace(rig.image, apodisation=name))
        )
        return compute_point_response(board.aperture, board.weights)

    none = response_with("none")
    kaiser = response_with("kaiser")
    taylor = response_with("taylor")
    for tapered in (kaiser, taylor):
        assert min(np.subtract(tapered.width_mm, none.width_mm)) > 0
        assert max(tapered.sidelobe_db) < max(none.sidelobe_db) - 8


def test_missing_positions_cost_what_is_reported(make_rig, points_rows):
    rig = make_rig(31, 21, 4.0, 4.0, pixels=(9, 9))
    point = np.array(specular_midpoint_m(rig, rig.receivers[0]))
    builder = ImageBuilder(rig, taper="boxcar")
    rng = np.random.default_rng(0)
    for index, row in points_rows(rig, rig.receivers[0], [point], [1.0]):
        row.valid[rng.uniform(size=31) < 0.05] = False
        builder.add_row("RH", index, row)
    board = builder.boards["RH"]
    facts = describe_board(board)
    assert facts.masked_positions == (~board.valid).sum() > 10
    assert facts.masked == pytest.approx(facts.masked_positions / facts.positions, abs=1e-6)
    summed = np.abs(board.image()[0]).max() * float(board.count) / (board.valid.size * 4)
    peak = np.abs(board.image()[0]).max()
    assert -20 * np.log10(summed / peak) == pytest.approx(facts.loss_db, abs=1e-3)
    # Image amplitudes do not change
    assert peak == pytest.approx(1, abs=0.03)


def test_notices_of_images_are_reported_if_there_are_any(make_rig):
    builder = ImageBuilder(make_rig(5, 5))
    notice = "the direct sum is slower"
    assert describe_imaging(builder, SimpleNamespace(notices=(notice,)))["notices"] == [notice]
    assert list(describe_imaging(builder, SimpleNamespace(notices=()))) == ["RH", "RV"]


def test_without_data_there_is_no_response(make_rig):
    facts = describe_board(ImageBuilder(make_rig(5, 5)).boards["RV"])
    assert facts.masked == 1
    assert facts.loss_db is UNSET


@pytest.mark.parametrize(("columns", "rows"), [(2, 41), (41, 2), (1, 41), (41, 1)])
def test_an_axis_on_which_nothing_is_resolved_has_no_figures(make_rig, columns, rows):
    """The figures hold for a small part of the plane: a cell wider than the image has none."""
    board = _make_full_board(make_rig(columns, rows, 4.0, 4.0, pixels=(31, 31)))
    response = compute_point_response(board.aperture, board.weights)
    for figures in (response.width_mm, response.limit_mm, response.paper_mm, response.sidelobe_db):
        assert np.isinf(figures).tolist() == [columns < 3, rows < 3]
    assert [width is None for width in describe_board(board).point_width_mm] == [columns < 3, rows < 3]
