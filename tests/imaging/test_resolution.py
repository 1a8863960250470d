"""The point response: widths and sidelobes agree with formulas; the reported loss is that of missing positions."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from msgspec import UNSET

from polysight.imaging import ImageBuilder
from polysight.imaging.resolution import compute_point_response, describe_board, describe_imaging
from polysight_shared.geometry import specular_midpoint_m


def _make_full_board(rig, **options):
    """Samples of RH in which no position is missing."""
    board = ImageBuilder(rig, **options).boards["RH"]
    board.valid[:] = True
    return board


@pytest.mark.parametrize(("columns", "rows", "step"), [(41, 41, 4.0), (350, 200, 2.0)])
def test_without_a_taper_the_measured_response_is_the_geometrys_limit(make_rig, columns, rows, step):
    rig = make_rig(columns, rows, step_x=step, step_y=step, pixels=(31, 31))
    board = _make_full_board(rig, taper="boxcar")
    response = compute_point_response(board.aperture, board.weights)
    # Differences of up to 6 % are measured.
    np.testing.assert_allclose(response.width_mm, response.limit_mm, rtol=0.08)
    # A sinc's first sidelobe is -13.3 dB; -12.7 dB is measured.
    assert max(response.sidelobe_db) < -11


def test_the_limit_is_that_of_the_plane_wave_formula_and_the_papers_is_reported_beside_it(make_rig):
    """The formula is 0.886 lambda h / (2 L cos^3) in x and / (2 L cos) in y; the paper has lambda r / L for both."""
    rig = make_rig(columns=41, rows=41, step_x=4.0, step_y=4.0, pixels=(31, 31))
    board = _make_full_board(rig, taper="boxcar")
    response = compute_point_response(board.aperture, board.weights)
    # Incidence angle of RH
    cos = np.cos(np.radians(54.93))
    # About that of the middle of the sweep
    wavelength_mm = 3.82
    # From the antennas, which stand some 11 mm before the stage's plane; the paper's r is from the stage's plane.
    height_mm = 488.0
    distance_mm = 499.0
    # 40 steps of 4 mm
    length_mm = 160.0
    limit_x = 0.886 * wavelength_mm * height_mm / (2 * length_mm * cos**3)
    limit_y = 0.886 * wavelength_mm * height_mm / (2 * length_mm * cos)
    # The formulas hold for plane waves and rounded lengths: differences of 1 % and 0.6 % are measured.
    np.testing.assert_allclose(response.limit_mm, (limit_x, limit_y), rtol=0.1)
    np.testing.assert_allclose(response.paper_mm, wavelength_mm * distance_mm / length_mm, rtol=0.03)


def test_the_published_scan_reaches_what_the_simulation_of_its_geometry_says(make_rig):
    """5.4 x 3.6 mm without a taper; the paper's r lambda / L is 2.7 mm along its 0.7 m and 4.8 mm along its 0.4 m."""
    rig = make_rig(columns=350, rows=200, step_x=2.0, step_y=2.0, pixels=(150, 150))
    board = _make_full_board(rig, taper="boxcar")
    response = compute_point_response(board.aperture, board.weights)
    # The numbers are rounded; differences of 0.1 and 0.05 mm are measured.
    np.testing.assert_allclose(response.width_mm, (5.4, 3.6), atol=0.35)
    np.testing.assert_allclose(response.paper_mm, (2.7, 4.8), atol=0.15)


def test_a_taper_trades_width_for_sidelobes(make_rig):
    rig = make_rig(columns=41, rows=41, step_x=4.0, step_y=4.0, pixels=(31, 31))

    def compute_response_with(taper):
        image = msgspec.structs.replace(rig.image, apodisation=taper)
        board = _make_full_board(msgspec.structs.replace(rig, image=image))
        return compute_point_response(board.aperture, board.weights)

    untapered = compute_response_with("none")
    for taper in ("kaiser", "taylor"):
        tapered = compute_response_with(taper)
        assert min(np.subtract(tapered.width_mm, untapered.width_mm)) > 0
        # Measured: -13 dB without a taper, -27 and -29 dB with one
        assert max(tapered.sidelobe_db) < max(untapered.sidelobe_db) - 8


def test_the_reported_loss_is_the_share_of_missing_positions(make_rig, points_rows):
    rig = make_rig(columns=31, rows=21, step_x=4.0, step_y=4.0, pixels=(9, 9))
    point = np.array(specular_midpoint_m(rig, rig.receivers[0]))
    builder = ImageBuilder(rig, taper="boxcar")
    rng = np.random.default_rng(0)
    for index, row in points_rows(rig, rig.receivers[0], [point], [1.0]):
        row.valid[rng.uniform(size=31) < 0.05] = False
        builder.add_row("RH", index, row)
    board = builder.boards["RH"]
    facts = describe_board(board)
    # 5 % of 31 x 21 positions are 33; 26 are drawn.
    masked_positions = (~board.valid).sum()
    assert masked_positions > 10
    assert facts.masked_positions == masked_positions
    # Reported shares have six decimals.
    assert facts.masked == pytest.approx(masked_positions / facts.positions, abs=1e-6)
    # An image is the mean over the samples that were received: a point of amplitude 1 has the peak 1.
    peak = np.abs(board.image()[0]).max()
    assert peak == pytest.approx(1, abs=0.03)
    # The loss is that of the sum over all positions and all four RX, in which missing samples are 0.
    measured_fraction = float(board.count) / (board.valid.size * 4)
    assert -20 * np.log10(measured_fraction) == pytest.approx(facts.loss_db, abs=1e-3)


def test_notices_of_images_are_reported_if_there_are_any(make_rig):
    builder = ImageBuilder(make_rig(columns=5, rows=5))
    notice = "the direct sum is slower"
    assert describe_imaging(builder, SimpleNamespace(notices=(notice,)))["notices"] == [notice]
    assert list(describe_imaging(builder, SimpleNamespace(notices=()))) == ["RH", "RV"]


def test_without_data_there_is_no_response(make_rig):
    facts = describe_board(ImageBuilder(make_rig(columns=5, rows=5)).boards["RV"])
    assert facts.masked == 1
    assert facts.loss_db is UNSET


@pytest.mark.parametrize(("columns", "rows"), [(2, 41), (41, 2), (1, 41), (41, 1)])
def test_an_axis_with_one_or_two_positions_has_no_resolution(make_rig, columns, rows):
    """The figures are infinite: a resolution cell would be wider than the image."""
    board = _make_full_board(make_rig(columns, rows, step_x=4.0, step_y=4.0, pixels=(31, 31)))
    response = compute_point_response(board.aperture, board.weights)
    # Along x and along y
    has_no_resolution = [columns in (1, 2), rows in (1, 2)]
    for figures in (response.width_mm, response.limit_mm, response.paper_mm, response.sidelobe_db):
        assert np.isinf(figures).tolist() == has_no_resolution
    assert [width is None for width in describe_board(board).point_width_mm] == has_no_resolution
