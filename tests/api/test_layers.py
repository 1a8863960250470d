"""`Scan.layers`: the unknowns of a stack of layers are fitted to every patch of a scan, and returned as a dataset."""

import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight.api.layers import layer_dataset
from polysight.materials.layers import Layer, Spectrum, predict
from polysight.products import ProcessedScan, write_json

CHIRP = load_published_rig().chirp
SHEET = Layer("sheet", permittivity=3.4 - 0.1j, thickness_m=1.7e-3)
INCIDENCE_DEG = 55.0
# How far a fit trusts |H| of a patch
AMPLITUDE_PERCENT = 10.0
# Numbers of the patches
METAL = 1
SHEET_IN_AIR = 2


@pytest.fixture
def processed(tmp_path):
    """A processed scan of a metal reference and of the sheet without anything behind it, both without noise."""
    inverse_ratios, amplitudes_h = predict([SHEET], Spectrum.from_chirp(CHIRP), np.radians(INCIDENCE_DEG))
    ratio = complex(1 / inverse_ratios[0])
    metal = {"label": METAL, "metal_reference": True}
    sheet = {
        "label": SHEET_IN_AIR,
        "incidence_deg": INCIDENCE_DEG,
        "ratio": {"real": ratio.real, "imag": ratio.imag},
        "inverse_ratio_std": 0.003,
        "amplitude_h": float(amplitudes_h[0]),
        "metal_reference": False,
    }
    write_json(tmp_path / "materials.json", {"segments": [metal, sheet]})
    return ProcessedScan(tmp_path)


def test_the_unknown_permittivity_of_a_layer_is_fitted_to_all_patches_except_metal(processed):
    # A layer is a name, a permittivity and a thickness in mm; "?" is unknown.
    layers = layer_dataset(processed, CHIRP, ["sheet,?,1.7"], bands=None, amplitude_percent=AMPLITUDE_PERCENT)
    assert layers["patch"].values.tolist() == [METAL, SHEET_IN_AIR]
    assert np.isnan(layers["permittivity"].sel(patch=METAL))
    sheet = layers.sel(patch=SHEET_IN_AIR)
    # Measured: equal to 14 digits.
    assert sheet["permittivity"].item() == pytest.approx(SHEET.permittivity, rel=0.01)
    assert sheet["thickness_mm"].item() == pytest.approx(1.7)
    assert layers["thickness_mm"].attrs["units"] == "mm"


def test_layers_can_be_given_as_texts_or_as_objects(processed):
    layers = layer_dataset(processed, CHIRP, ["sheet,?,1.7"], bands=None, amplitude_percent=AMPLITUDE_PERCENT)
    same_stack = [Layer("sheet", permittivity=None, thickness_m=1.7e-3)]
    layers_of_objects = layer_dataset(processed, CHIRP, same_stack, bands=1, amplitude_percent=AMPLITUDE_PERCENT)
    assert layers_of_objects.equals(layers)


def test_an_unknown_thickness_is_ambiguous_if_it_is_fitted_to_one_band(processed):
    """Several pairs of permittivity and thickness reflect in the same way; sub-bands would tell them apart."""
    # The thickness is between 0.5 and 4 mm.
    stack = ["sheet,?,0.5-4"]
    layers = layer_dataset(processed, CHIRP, stack, bands=None, amplitude_percent=AMPLITUDE_PERCENT)
    sheet = layers.sel(patch=SHEET_IN_AIR)
    assert sheet["ambiguous"].item() is True
    # A note lists the other thicknesses.
    assert " mm" in sheet["notes"].item()
