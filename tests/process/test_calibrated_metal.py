"""A scan is divided by its metal calibration pixel by pixel, and masked where the calibration has no metal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.support.processes import output_of
from tests.support.scenes import EVERYWHERE, scene_of
from tests.support.store.facts import facts_of

from polysight.calibration.files import SourceScan, write_metal
from polysight.jobs.calibrate import load_reference
from polysight.store import manifest
from polysight.store.scan_folder import MANIFEST
from polysight_shared.files import read_json

SCENE = scene_of(EVERYWHERE, columns=10, rows=8) | {"image": {"columns": 24, "rows": 24, "pixel_mm": 4.0}}


@pytest.fixture(scope="module")
def products(scan_of, tmp_path_factory):
    """Products of a scan whose metal calibration has known gains in the left half of the image only."""
    folder = tmp_path_factory.mktemp("metal")
    scan = scan_of(folder / "scan", SCENE)
    seen = load_reference(scan)
    known = seen.valid & (seen.x_m < seen.x_m.mean())
    gains = np.broadcast_to(np.exp((4 + 10j) * (seen.x_m - seen.x_m.mean())), seen.h.shape)
    made = replace(seen, h=(seen.h * gains).astype(np.complex64), valid=known)
    path = write_metal(made, [SourceScan("plate", str(scan), True, 8)], scan / "calibration")
    facts = facts_of(scan)
    facts[0]["instrument"]["calibration"] = {"metal": str(path)}
    (scan / MANIFEST).write_bytes(b"".join(manifest.encode_line(fact) for fact in facts))
    output_of("process", scan, "--out", folder / "out", "--model", "none")
    return folder / "out", known, gains, path


def test_each_pixel_is_divided_by_its_own_gain_where_that_is_known(products):
    out, known, gains, path = products
    with np.load(out / "image.npz") as image:
        p, valid = image["p"], image["valid"]
    assert not (valid & ~known).any()
    assert (valid & known).sum() > 0.9 * known.sum() > 100
    assert np.abs(gains[valid] - 1).max() > 0.4
    # What is left: noise, smoothing, and leakage that is not metal's any more.
    np.testing.assert_allclose((p * gains)[valid], 1.0, atol=0.08)
    quality = read_json(out / "quality.json")
    assert quality["calibration"]["metal"]["file"] == str(path)
    assert quality["metal_reference"]["share_of_plane"] == pytest.approx(known.mean(), abs=1e-4)
