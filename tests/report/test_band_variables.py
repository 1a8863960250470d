"""Sub-bands of the sweep in an export: their variables are for all patches, or there are none."""

import pytest

from polysight.products.exports import _make_band_variables
from polysight.results import BandFigures, ComplexNumber, PatchFigures

BANDS = [
    BandFigures(first_hz=76e9, last_hz=77e9, ratio=ComplexNumber(0.5, -0.1)),
    BandFigures(first_hz=77e9, last_hz=78e9, ratio=None),
]


def make_patch(label: int, bands: list[BandFigures]) -> PatchFigures:
    return PatchFigures(label=label, box_mm=(0.0, 0.0, 1.0, 1.0), bands=bands)


def test_sub_bands_of_all_patches_are_exported():
    known, unknown = BANDS
    variables = _make_band_variables([make_patch(1, [known, unknown]), make_patch(2, [unknown, known])])
    dimensions, ratios, *_ = variables["band_ratio"]
    assert dimensions == ("patch", "band")
    assert ratios[0, 0] == pytest.approx(0.5 - 0.1j)
    assert ratios[1, 1] == pytest.approx(0.5 - 0.1j)


@pytest.mark.parametrize("patches", [[], [make_patch(1, [])], [make_patch(1, BANDS), make_patch(2, [])]])
def test_an_export_has_no_sub_bands_unless_each_patch_has_them(patches):
    assert _make_band_variables(patches) == {}
