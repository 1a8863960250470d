"""The check plate: its distance from its known permittivity, the verdict, the command and the chart."""

import json
import shutil

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from msgspec.structs import replace
from tests.support.products import name_check_plate
from tests.support.refusals import expect_refusal

import polysight
from polysight.cli.main import main
from polysight.results import WARNING_SIGMAS, PatchFigures, PermittivityFigures, check_plate, check_reasons
from polysight_shared.config import CheckPlate
from polysight_shared.errors import ErrorCode

from .conftest import PET

# A plate with a known permittivity of 2.05 - 0.01j, and its place in the image; chosen, as PTFE.
PLATE = CheckPlate(name="PTFE", permittivity=(2.05, 0.01), std=(0.02, 0.01), place_mm=(30.0, 0.0))


def make_patch(real: float, loss: float, covariance: list[list[float | None]] | None = None) -> PatchFigures:
    """A patch around the plate's place, measured with errors of 0.1 unless a covariance is given."""
    covariance = covariance or [[0.01, 0.0], [0.0, 0.01]]
    value = PermittivityFigures(real=real, imag=-loss, covariance=covariance)
    return PatchFigures(label=1, box_mm=(10.0, -20.0, 50.0, 20.0), permittivity=value)


@pytest.mark.parametrize(
    ("sigmas_off", "level"), [(2.44, "good"), (2.46, "warning"), (3.40, "warning"), (3.42, "action"), (-3.42, "action")]
)
def test_a_distance_is_in_standard_deviations_of_the_scan_and_of_the_plate(sigmas_off, level):
    """An error of 0.03 of the scan and one of 0.04 of the plate are 0.05 together."""
    plate = replace(PLATE, std=(0.04, 0.04))
    covariance: list[list[float | None]] = [[0.03**2, 0.0], [0.0, 0.03**2]]
    for real_sigmas, loss_sigmas in ((sigmas_off, 0.0), (0.0, sigmas_off)):
        real = 2.05 + 0.05 * real_sigmas
        loss = 0.01 + 0.05 * loss_sigmas
        result = check_plate(plate, [make_patch(real, loss, covariance)])
        assert result is not None
        assert result.level == level
        assert result.sigmas == pytest.approx(abs(sigmas_off), abs=1e-3)
        assert result.measured == pytest.approx((real, loss))
        assert result.measured_std == pytest.approx((0.03, 0.03))


@pytest.mark.parametrize(
    ("place_mm", "is_on_it"),
    [
        ((10.0, -20.0), True), ((50.0, 20.0), True), ((9.9, 0.0), False), ((50.1, 0.0), False),
        ((30.0, -20.1), False), ((30.0, 20.1), False),
    ],
)  # fmt: skip
def test_a_check_plate_lies_where_a_patch_does(place_mm, is_on_it):
    result = check_plate(replace(PLATE, place_mm=place_mm), [make_patch(2.05, 0.01)])
    assert result is not None
    assert (result.level == "good") == is_on_it


def test_a_patch_without_an_error_is_not_judged():
    value = PermittivityFigures(real=2.05, imag=-0.01)
    result = check_plate(PLATE, [PatchFigures(label=3, box_mm=(10.0, -20.0, 50.0, 20.0), permittivity=value)])
    assert result is not None
    assert (result.level, result.why) == ("missing", "patch 3 there has no permittivity")


@pytest.mark.parametrize(
    ("real", "level", "reasons"), [(2.1, "good", 0), (2.34, "warning", 0), (2.5, "action", 1), (1.6, "action", 1)]
)
def test_only_a_plate_beyond_the_action_limit_is_a_reason_against_a_scan(real, level, reasons):
    result = check_plate(PLATE, [make_patch(real, 0.01)])
    assert result is not None
    assert result.level == level
    assert len(check_reasons(result)) == reasons


def test_the_error_of_both_parts_and_their_correlation_count():
    """An error along the axis of the covariance is likelier than one across it; the loss is -imag."""
    covariance: list[list[float | None]] = [[0.01, -0.0095], [-0.0095, 0.01]]
    along = check_plate(PLATE, [make_patch(2.25, 0.21, covariance)])
    across = check_plate(PLATE, [make_patch(2.25, -0.19, covariance)])
    assert along is not None
    assert along.sigmas is not None
    assert along.sigmas < 2.1
    assert across is not None
    assert across.sigmas is not None
    assert across.sigmas > 5


def test_good_scans_are_within_the_limits():
    """Limits are those of 95 % and 99.7 % of good scans; 2000 draws are chosen."""
    rng = np.random.default_rng(1)
    draws = 2000
    covariance = np.array([[0.04, -0.01], [-0.01, 0.02]])
    levels = []
    for _ in range(draws):
        real, imag = rng.multivariate_normal([2.05, -0.01], covariance + np.diag([0.02**2, 0.01**2]))
        result = check_plate(PLATE, [make_patch(real, -imag, covariance.tolist())])
        assert result is not None
        levels.append(result.level)
    assert levels.count("good") / draws == pytest.approx(0.95, abs=0.02)
    assert levels.count("action") / draws < 0.01


@pytest.mark.parametrize("patches", [[], [PatchFigures(label=1, box_mm=(10.0, -20.0, 50.0, 20.0))]])
def test_a_plate_that_is_not_measured_is_a_reason(patches):
    result = check_plate(PLATE, patches)
    assert result is not None
    assert result.level == "missing"
    assert len(check_reasons(result)) == 1
    assert check_plate(CheckPlate(), patches) is None


@pytest.fixture
def products_copy(products, tmp_path):
    return shutil.copytree(products, tmp_path / "products")


@pytest.mark.parametrize(("permittivity", "status"), [((3.78, 0.7), 0), ((9.0, 0.01), 1)])
def test_the_command_prints_and_draws_the_check(products_copy, tmp_path, capsys, permittivity, status):
    x_mm, y_mm = PET["centre_mm"]
    name_check_plate(products_copy, CheckPlate(name="PET", permittivity=permittivity, place_mm=(x_mm, y_mm)))
    chart = tmp_path / "chart.png"
    assert main(["check", str(products_copy), "--chart", str(chart), "--json"]) == status
    (check,) = json.loads(capsys.readouterr().out)
    assert (check["level"] == "action") == bool(status)
    assert chart.read_bytes().startswith(b"\x89PNG")
    table = polysight.check(products_copy)
    assert table["level"].item() == check["level"]
    assert table["sigmas"].item() == check["sigmas"]
    assert table["expected_permittivity"].item() == complex(permittivity[0], -permittivity[1])
    assert all({"units", "long_name"} <= set(variable.attrs) for variable in table.variables.values())
    figure = polysight.plot_check(products_copy, polysight.open_scan(products_copy))
    assert f"{WARNING_SIGMAS} standard deviations" in figure.get_suptitle()
    chart_axes = figure.axes
    assert [ax.get_ylabel() for ax in chart_axes] == ["real part", "loss"]
    points = chart_axes[0].get_lines()[0].get_ydata()
    assert points == pytest.approx([table["permittivity"].real.item()] * 2)
    bars = chart_axes[0].containers[0].get_children()[-1]
    assert isinstance(bars, LineCollection)
    bar = np.asarray(bars.get_segments()[0])[:, 1]
    assert np.ptp(bar) == pytest.approx(2 * WARNING_SIGMAS * check["measured_std"][0])


def test_a_check_without_scans_is_refused():
    with expect_refusal(ErrorCode.OTHER):
        polysight.check()


def test_a_rig_file_without_a_plate_is_an_error(products_copy, capsys):
    name_check_plate(products_copy, CheckPlate())
    assert main(["check", str(products_copy)]) == 2
    assert "names no check plate" in capsys.readouterr().err
