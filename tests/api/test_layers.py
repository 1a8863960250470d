"""A stack fitted to every patch of a processed scan, as a dataset."""

import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight.api.layers import layer_dataset
from polysight.materials.layers import Layer, Spectrum, predict
from polysight.products import ProcessedScan, write_json

CHIRP = load_published_rig().chirp
# A sheet of 1.7 mm; chosen.
SHEET = Layer("sheet", permittivity=3.4 - 0.1j, thickness_m=1.7e-3)
INCIDENCE_DEG = 55.0


@pytest.fixture
def processed(tmp_path):
    """A processed scan of two patches: 1 is the metal reference, 2 the sheet in air."""
    inverse_ratio, amplitude_h = predict([SHEET], Spectrum.from_chirp(CHIRP), np.radians(INCIDENCE_DEG))
    ratio = complex(1 / inverse_ratio[0])
    sheet = {"label": 2, "incidence_deg": INCIDENCE_DEG, "ratio": {"real": ratio.real, "imag": ratio.imag}}
    # The standard error is chosen.
    sheet |= {"inverse_ratio_std": 0.003, "amplitude_h": float(amplitude_h[0]), "metal_reference": False}
    write_json(tmp_path / "materials.json", {"segments": [{"label": 1, "metal_reference": True}, sheet]})
    return ProcessedScan(tmp_path)


def test_the_unknown_permittivity_of_a_layer_is_fitted_to_each_patch_but_the_metal(processed):
    layers = layer_dataset(processed, CHIRP, ["sheet,?,1.7"], None, 10.0)
    assert layers["patch"].values.tolist() == [1, 2]
    eps = layers["permittivity"].values
    assert np.isnan(eps[0])
    assert eps[1] == pytest.approx(SHEET.permittivity, rel=0.01)
    assert layers["thickness_mm"].values[1] == pytest.approx(1.7)
    assert layers["thickness_mm"].attrs["units"] == "mm"
    same_stack = [Layer("sheet", None, 1.7e-3)]
    assert layer_dataset(processed, CHIRP, same_stack, 1, 10.0).equals(layers)


def test_a_free_thickness_from_one_band_is_reported_as_ambiguous(processed):
    layers = layer_dataset(processed, CHIRP, ["sheet,?,0.5-4"], None, 10.0)
    assert bool(layers["ambiguous"].values[1])
    assert " mm" in layers["notes"].values[1]
