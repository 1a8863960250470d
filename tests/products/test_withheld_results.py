"""The verdict `none` withholds results; signs of the errors of a permittivity; products of earlier releases."""

from __future__ import annotations

import csv
import json

import h5py
import numpy as np
import pytest
import scipy.io
import xarray
from tests.support.products import NAMES, judged_products
from tests.support.refusals import refused

from polysight import open_scan
from polysight.cli.main import main
from polysight.imaging import Images
from polysight.products import permittivity_spread, read_image, read_products, withhold, write_image, write_json
from polysight_shared.error_codes import ErrorCode


@pytest.mark.parametrize("level", ["good", "care", "none"])
def test_every_export_holds_the_verdict_and_p_sigma(tmp_path, level):
    folder, out = judged_products(tmp_path / "one", level), tmp_path / "out"
    assert main(["export", str(folder), "--hdf5", "--netcdf", "--zarr", "--mat", "--csv", "--out", str(out)]) == 0
    reasons = json.loads((folder / "materials.json").read_text(encoding="utf-8"))["verdict"]["reasons"]
    sigma = read_image(folder / "image.npz").p_sigma
    with h5py.File(out / "image.h5") as f:
        found = [(dict(f.attrs), f["p_sigma"][()])]
    mat = scipy.io.loadmat(out / "image.mat", simplify_cells=True)
    found.append((mat, mat["p_sigma"]))
    sets = (xarray.open_dataset(out / "image.nc", engine="h5netcdf"), xarray.open_zarr(out / "image.zarr"))
    found += [(dataset.attrs, dataset["p_sigma"].values) for dataset in sets]
    for attributes, values in found:
        assert attributes["verdict"] == level
        assert json.loads(attributes["verdict_reasons"]) == reasons
        np.testing.assert_array_equal(values, sigma)
    with (out / "materials.csv").open(newline="", encoding="utf-8") as f:
        rows = list(csv.DictReader(f))
    assert {r["verdict"] for r in rows} == {level}
    assert {r["verdict_reasons"] for r in rows} == {json.dumps(reasons, ensure_ascii=False)}


def test_without_a_result_no_export_names_anything(tmp_path):
    """Even if the files contain names, as written by a faulty program."""
    folder, out = judged_products(tmp_path / "one", "none", careless=True), tmp_path / "out"
    assert any(name in (folder / "materials.json").read_text(encoding="utf-8") for name in NAMES)
    assert main(["export", str(folder), "--hdf5", "--mat", "--csv", "--zarr", "--out", str(out)]) == 0
    text = (out / "materials.csv").read_text(encoding="utf-8")
    with h5py.File(out / "image.h5") as f:
        text += f["documents/materials"][()].decode()
        assert np.isnan(f["materials/permittivity_real"][()]).all()
        assert np.isnan(f["materials/p_abs_db"][()]).all()
        text += " ".join(v.decode() for v in f["materials/name"][()])
    mat = scipy.io.loadmat(out / "image.mat", simplify_cells=True)
    text += str(mat["materials"]["name"]) + str(mat["materials_json"])
    scan = open_scan(folder)
    patches = scan.patches()
    text += patches.to_dict(data="list").__repr__()
    assert scan.verdict is not None
    assert not scan.verdict.usable
    assert np.isnan(patches["permittivity"]).all()
    assert [name for name in NAMES if name in text] == []


def test_withholding_keeps_positions_and_does_not_change_usable_results(tmp_path):
    usable = json.loads((judged_products(tmp_path / "good", "good") / "materials.json").read_text(encoding="utf-8"))
    assert withhold(usable) is usable
    assert withhold({}) == {}
    content = {**usable, "verdict": {"level": "none", "reasons": []}}
    hidden = withhold(content)
    assert [s["box_mm"] for s in hidden["segments"]] == [s["box_mm"] for s in usable["segments"]]
    assert withhold(hidden) == hidden
    assert content["segments"] == usable["segments"]  # the argument is not changed


def test_loss_is_minus_imag_in_the_covariance_too(tmp_path):
    spread = permittivity_spread({"real": 3, "imag": -1, "covariance": [[0.04, -0.01], [-0.01, 0.09]]})
    assert spread is not None
    assert (spread.real_std, spread.loss_std, spread.covariance) == pytest.approx((0.2, 0.3, 0.01))
    draws = np.random.default_rng(1).multivariate_normal([3, -1], [[0.04, -0.01], [-0.01, 0.09]], 200_000)
    np.testing.assert_allclose(np.cov(draws[:, 0], -draws[:, 1]), spread.matrix, rtol=0.03)
    scan = open_scan(judged_products(tmp_path / "one", "good"))
    pet = scan.materials().sel(patch=2)
    given = read_products(scan.folder).segments[1]["permittivity"]["covariance"]
    assert float(pet["permittivity_real_loss_covariance"]) == pytest.approx(-given[0][1])
    assert float(pet["permittivity_loss_standard_error"]) == pytest.approx(given[1][1] ** 0.5)
    assert str(pet["dominated_by"].values) == "leakage"
    assert str(scan.materials().sel(patch=3)["refused"].values).startswith("noise")


def test_products_of_earlier_releases_are_read_as_before(tmp_path):
    folder = judged_products(tmp_path / "one", None)
    scan, products = open_scan(folder), read_products(folder)
    assert scan.verdict is None
    assert products.p_sigma is None
    assert "p_sigma" not in scan.image()
    assert "verdict" not in scan.image().attrs
    assert str(scan.materials()["name"].values[1]) == "PET"
    assert permittivity_spread({"real": 1, "imag": 0, "real_std": 0.1, "imag_std": 0.2}).matrix.tolist() == [
        pytest.approx([0.01, 0]),
        pytest.approx([0, 0.04]),
    ]
    for unknown in (None, {}, {"real": 1, "imag": 0}, {"covariance": [[None, None], [None, None]]}):
        assert permittivity_spread(unknown) is None
    assert main(["export", str(folder), "--csv", "--out", str(tmp_path / "out")]) == 0
    assert "verdict" not in (tmp_path / "out" / "materials.csv").read_text(encoding="utf-8")


def test_p_sigma_has_the_shape_of_the_image(tmp_path):
    one, axis, valid = np.ones((2, 2), np.complex64), np.array([0.0, 0.1]), np.ones((2, 2), bool)
    with refused(ErrorCode.MISMATCH, "p_sigma"):
        write_image(tmp_path / "i.npz", Images(one, one, axis, axis, valid, one, np.ones((3, 2))))
    write_json(tmp_path / "materials.json", {"segments": []})
    write_image(tmp_path / "i.npz", Images(one, one, axis, axis, valid, one, np.full((2, 2), np.nan)))
    assert read_image(tmp_path / "i.npz").p_sigma.dtype == np.float32
