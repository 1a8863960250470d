"""The check plate: a plate of known permittivity that lies in every scan of a rig.

The distance of its measured from its known permittivity, in standard deviations of both, shows whether the rig still
measures well: level `good`, `warning` beyond the limit of 95 % of good scans, `action` beyond that of 99.7 %.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from msgspec.structs import replace
from tests.support.products import name_check_plate
from tests.support.refusals import expect_refusal

import polysight
from polysight.cli.main import main
from polysight.results import (
    WARNING_SIGMAS,
    CheckResult,
    PatchFigures,
    PermittivityFigures,
    check_plate,
    check_reasons,
)
from polysight_shared.config import CheckPlate
from polysight_shared.errors import ErrorCode

from .conftest import PET

# Real part and loss (minus the imaginary part) of the permittivity of PTFE, and their standard deviations.
REAL = 2.05
LOSS = 0.01
REAL_STD = 0.02
LOSS_STD = 0.01
PLATE = CheckPlate(name="PTFE", permittivity=(REAL, LOSS), std=(REAL_STD, LOSS_STD), place_mm=(30.0, 0.0))
# Box of the plate's patch in the image: x0, y0, x1, y1.
BOX_MM = (10.0, -20.0, 50.0, 20.0)
Covariance = list[list[float | None]]
# Exit statuses of `polysight check`: the level is `action`, and the configuration is wrong.
NEEDS_ACTION = 1
WRONG_CONFIGURATION = 2


def make_patch(real: float, loss: float, covariance: Covariance | None = None) -> PatchFigures:
    """The plate's patch, measured with independent errors of 0.1 unless a covariance is given."""
    if covariance is None:
        covariance = [[0.1**2, 0.0], [0.0, 0.1**2]]
    value = PermittivityFigures(real=real, imag=-loss, covariance=covariance)
    return PatchFigures(label=1, box_mm=BOX_MM, permittivity=value)


def check(plate: CheckPlate, *patches: PatchFigures) -> CheckResult:
    """The check of a scan with these patches, whose rig file has this plate."""
    result = check_plate(plate, patches)
    assert result is not None
    return result


# In two dimensions 95 % of a normal distribution lie within 2.45 standard deviations, and 99.7 % within 3.41.
@pytest.mark.parametrize(
    ("sigmas_off", "level"), [(2.44, "good"), (2.46, "warning"), (3.40, "warning"), (3.42, "action"), (-3.42, "action")]
)
def test_the_errors_of_scan_and_plate_add_up_in_the_distance(sigmas_off, level):
    scan_std = 0.03
    plate_std = 0.04
    std = np.hypot(scan_std, plate_std)
    plate = replace(PLATE, std=(plate_std, plate_std))
    covariance: Covariance = [[scan_std**2, 0.0], [0.0, scan_std**2]]
    for real_sigmas, loss_sigmas in ((sigmas_off, 0.0), (0.0, sigmas_off)):
        real = REAL + std * real_sigmas
        loss = LOSS + std * loss_sigmas
        result = check(plate, make_patch(real, loss, covariance))
        assert result.level == level
        assert result.sigmas == pytest.approx(abs(sigmas_off), abs=1e-3)
        assert result.measured == pytest.approx((real, loss))
        assert result.measured_std == pytest.approx((scan_std, scan_std))


@pytest.mark.parametrize(
    ("place_mm", "is_in_box"),
    [
        ((10.0, -20.0), True), ((50.0, 20.0), True), ((9.9, 0.0), False), ((50.1, 0.0), False),
        ((30.0, -20.1), False), ((30.0, 20.1), False),
    ],
)  # fmt: skip
def test_the_plate_is_the_patch_whose_box_contains_its_position(place_mm, is_in_box):
    result = check(replace(PLATE, place_mm=place_mm), make_patch(REAL, LOSS))
    assert (result.level == "good") == is_in_box


def test_a_permittivity_without_a_standard_error_is_not_checked():
    value = PermittivityFigures(real=REAL, imag=-LOSS)
    result = check(PLATE, PatchFigures(label=3, box_mm=BOX_MM, permittivity=value))
    assert (result.level, result.why) == ("missing", "patch 3 there has no permittivity")


# The measured real part has an error of 0.1, and that of the plate hardly adds to it.
@pytest.mark.parametrize(
    ("real", "level", "reasons"), [(2.1, "good", 0), (2.34, "warning", 0), (2.5, "action", 1), (1.6, "action", 1)]
)
def test_only_a_plate_beyond_the_action_limit_is_a_reason_against_a_scan(real, level, reasons):
    result = check(PLATE, make_patch(real, LOSS))
    assert result.level == level
    assert len(check_reasons(result)) == reasons


def test_the_distance_takes_the_correlation_of_real_part_and_loss_into_account():
    """Here both parts tend to be too large together, so that such an error is a smaller distance than an opposite one.

    With the plate's own errors the standard deviation is 0.14 in the likely direction, and 0.03 across it.
    """
    # Of real and imaginary part; the loss is minus the imaginary part.
    covariance: Covariance = [[0.01, -0.0095], [-0.0095, 0.01]]
    error = 0.2
    both_too_large = check(PLATE, make_patch(REAL + error, LOSS + error, covariance))
    opposite_errors = check(PLATE, make_patch(REAL + error, LOSS - error, covariance))
    assert both_too_large.sigmas is not None
    assert opposite_errors.sigmas is not None
    # The size of both errors is 0.28: 2.0 and 10.3 standard deviations.
    assert both_too_large.sigmas < 2.1
    assert opposite_errors.sigmas > 5


def test_95_percent_of_good_scans_are_good_and_hardly_any_needs_action():
    rng = np.random.default_rng(1)
    draws = 2000
    covariance = np.array([[0.04, -0.01], [-0.01, 0.02]])
    covariance_with_plate = covariance + np.diag([REAL_STD**2, LOSS_STD**2])
    levels = []
    for _ in range(draws):
        real, imag = rng.multivariate_normal([REAL, -LOSS], covariance_with_plate)
        levels.append(check(PLATE, make_patch(real, -imag, covariance.tolist())).level)
    # The share of 2000 draws has a standard deviation of 0.005 about 0.95, and of 0.0012 about 0.003.
    assert levels.count("good") / draws == pytest.approx(0.95, abs=4 * 0.005)
    assert levels.count("action") / draws < 0.01


@pytest.mark.parametrize("patches", [[], [PatchFigures(label=1, box_mm=BOX_MM)]])
def test_a_plate_without_a_patch_or_a_permittivity_is_a_reason_against_a_scan(patches):
    result = check(PLATE, *patches)
    assert result.level == "missing"
    assert len(check_reasons(result)) == 1


@pytest.mark.parametrize("patches", [[], [PatchFigures(label=1, box_mm=BOX_MM)]])
def test_a_rig_without_a_check_plate_has_no_check(patches):
    assert check_plate(CheckPlate(), patches) is None


@pytest.fixture
def products_copy(products, tmp_path):
    return shutil.copytree(products, tmp_path / "products")


@pytest.mark.parametrize(
    ("permittivity", "status", "needs_action"),
    # The true permittivity of the plate, and one that it does not have.
    [((3.78, 0.7), 0, False), ((9.0, 0.01), NEEDS_ACTION, True)],
)
def test_the_command_prints_the_check_and_draws_a_chart(
    products_copy, tmp_path, capsys, permittivity, status, needs_action
):
    set_check_plate_of_pet(products_copy, permittivity)
    chart = tmp_path / "chart.png"
    assert main(["check", str(products_copy), "--chart", str(chart), "--json"]) == status
    (printed,) = json.loads(capsys.readouterr().out)
    assert (printed["level"] == "action") == needs_action
    assert chart.read_bytes().startswith(b"\x89PNG")
    table = polysight.check(products_copy)
    assert table["level"].item() == printed["level"]
    assert table["sigmas"].item() == printed["sigmas"]
    real, loss = permittivity
    assert table["expected_permittivity"].item() == complex(real, -loss)
    assert all({"units", "long_name"} <= set(variable.attrs) for variable in table.variables.values())


@pytest.mark.parametrize("permittivity", [(3.78, 0.7), (9.0, 0.01)])
def test_the_chart_has_a_point_with_an_error_bar_for_each_scan(products_copy, permittivity):
    set_check_plate_of_pet(products_copy, permittivity)
    # The same scan twice: as a path and as an opened scan.
    figure = polysight.plot_check(products_copy, polysight.open_scan(products_copy))
    table = polysight.check(products_copy)
    assert f"{WARNING_SIGMAS} standard deviations" in figure.get_suptitle()
    assert [ax.get_ylabel() for ax in figure.axes] == ["real part", "loss"]
    real_axes = figure.axes[0]
    points = real_axes.get_lines()[0].get_ydata()
    real = table["permittivity"].real.item()
    assert points == pytest.approx([real, real])
    (error_bars,) = real_axes.containers
    bar_lines = error_bars.get_children()[-1]
    assert isinstance(bar_lines, LineCollection)
    ends = np.asarray(bar_lines.get_segments()[0])
    y_of_ends = ends[:, 1]
    real_std = table["permittivity_real_standard_error"].item()
    assert np.ptp(y_of_ends) == pytest.approx(2 * WARNING_SIGMAS * real_std)


def set_check_plate_of_pet(products: Path, permittivity: tuple[float, float]) -> None:
    """Name the plate of PET as the check plate, with this real part and loss."""
    x_mm, y_mm = PET["centre_mm"]
    name_check_plate(products, CheckPlate(name="PET", permittivity=permittivity, place_mm=(x_mm, y_mm)))


def test_a_check_without_scans_is_refused():
    with expect_refusal(ErrorCode.OTHER):
        polysight.check()


def test_checking_a_scan_whose_rig_file_has_no_check_plate_is_an_error(products_copy, capsys):
    name_check_plate(products_copy, CheckPlate())
    assert main(["check", str(products_copy)]) == WRONG_CONFIGURATION
    assert "names no check plate" in capsys.readouterr().err
