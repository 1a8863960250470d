"""A stack fitted to every patch of a processed scan, as a dataset."""

import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight.api.layers import layer_dataset
from polysight.materials.layers import Layer, Spectrum, predict
from polysight.products import ProcessedScan, write_json

CHIRP = load_published_rig().chirp
SHEET = Layer("sheet", 3.4 - 0.1j, 1.7e-3)


@pytest.fixture
def done(tmp_path):
    """A metal reference, and a sheet in air."""
    q, h = predict([SHEET], Spectrum.from_chirp(CHIRP), np.radians(55.0))
    ratio = complex(1 / q[0])
    sheet = {"label": 2, "incidence_deg": 55.0, "ratio": {"real": ratio.real, "imag": ratio.imag}}
    sheet |= {"inverse_ratio_std": 0.003, "amplitude_h": float(h[0]), "metal_reference": False}
    write_json(tmp_path / "materials.json", {"segments": [{"label": 1, "metal_reference": True}, sheet]})
    return ProcessedScan(tmp_path)


def test_the_unknown_layer_of_each_patch(done):
    """The metal reference has no values."""
    layers = layer_dataset(done, CHIRP, ["sheet,?,1.7"], None, 10.0)
    assert layers["patch"].values.tolist() == [1, 2]
    eps = layers["permittivity"].values
    assert np.isnan(eps[0])
    assert eps[1] == pytest.approx(SHEET.permittivity, rel=0.01)
    assert layers["thickness_mm"].values[1] == pytest.approx(1.7)
    assert layers["thickness_mm"].attrs["units"] == "mm"
    same = layer_dataset(done, CHIRP, [Layer("sheet", None, 1.7e-3)], 1, 10.0)
    assert same.equals(layers)


def test_a_free_thickness_from_one_band_is_reported_as_ambiguous(done):
    layers = layer_dataset(done, CHIRP, ["sheet,?,0.5-4"], None, 10.0)
    assert bool(layers["ambiguous"].values[1])
    assert " mm" in layers["notes"].values[1]
