"""A scan is divided by its metal calibration pixel by pixel, and masked where the calibration has no metal."""

from dataclasses import replace

import numpy as np
import pytest
from tests.support.processes import read_output
from tests.support.scenes import EVERYWHERE, make_scene
from tests.support.store.facts import load_facts

from polysight.calibration.files import SourceScan, write_metal
from polysight.jobs.calibrate import load_reference
from polysight.store import manifest
from polysight.store.scan_folder import MANIFEST
from polysight_shared.files import read_json

SCENE = make_scene(EVERYWHERE, columns=10, rows=8) | {"image": {"columns": 24, "rows": 24, "pixel_mm": 4.0}}


@pytest.fixture(scope="module")
def products(make_scan, tmp_path_factory):
    """Products of a scan whose metal calibration has known gains in the left half of the image only."""
    folder = tmp_path_factory.mktemp("metal")
    scan = make_scan(folder / "scan", SCENE)
    plate = load_reference(scan)
    is_known = plate.valid & (plate.x_m < plate.x_m.mean())
    # A gain of H that changes along x by 4 nepers and 10 radians per metre. The image is 96 mm wide: over its left half
    # that is 17 % and 27 degrees.
    gains = np.broadcast_to(np.exp((4 + 10j) * (plate.x_m - plate.x_m.mean())), plate.h.shape)
    partial_reference = replace(plate, h=(plate.h * gains).astype(np.complex64), valid=is_known)
    path = write_metal(
        partial_reference, [SourceScan("plate", str(scan), simulated=True, rows=8)], scan / "calibration"
    )
    facts = load_facts(scan)
    facts[0]["instrument"]["calibration"] = {"metal": str(path)}
    (scan / MANIFEST).write_bytes(b"".join(manifest.encode_line(fact) for fact in facts))
    read_output("process", scan, "--out", folder / "out", "--model", "none")
    return folder / "out", is_known, gains, path


def test_each_pixel_is_divided_by_its_own_gain_where_that_is_known(products):
    out, is_known, gains, path = products
    with np.load(out / "image.npz") as image:
        p = image["p"]
        valid = image["valid"]
    assert not (valid & ~is_known).any()
    # The metal of the calibration fills at least a sixth of the 24 x 24 pixels.
    known_pixels = is_known.sum()
    assert known_pixels > 100
    assert (valid & is_known).sum() > 0.9 * known_pixels
    # Without the correction by the gains the errors would be larger than 0.4.
    assert np.abs(gains[valid] - 1).max() > 0.4
    # The remaining errors are noise, smoothing, and leakage that differs from metal's.
    np.testing.assert_allclose((p * gains)[valid], 1.0, atol=0.08)
    quality = read_json(out / "quality.json")
    assert quality["calibration"]["metal"]["file"] == str(path)
    assert quality["metal_reference"]["share_of_plane"] == pytest.approx(is_known.mean(), abs=1e-4)
