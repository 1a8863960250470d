"""A verdict of `none` withholds results in all exports.

Errors of a loss have their sign, and products of earlier releases, which have no verdict, are read.
"""

import csv
import json

import msgspec
import numpy as np
import pytest
import scipy.io
import xarray
from tests.support.products import NAMES, write_judged_products
from tests.support.refusals import expect_refusal

from polysight import open_scan
from polysight.cli.main import main
from polysight.imaging import Images
from polysight.products import read_products, write_image, write_json
from polysight.products.processed import read_image
from polysight.results import PermittivityFigures, ScanMaterials, Verdict
from polysight_shared.errors import ErrorCode


@pytest.mark.parametrize("level", ["good", "care", "none"])
def test_every_export_holds_the_verdict_and_p_sigma(tmp_path, level):
    folder = write_judged_products(tmp_path / "one", level)
    out = tmp_path / "out"
    assert main(["export", str(folder), "--netcdf", "--mat", "--csv", "--out", str(out)]) == 0
    reasons = json.loads((folder / "materials.json").read_text(encoding="utf-8"))["verdict"]["reasons"]
    sigma = read_image(folder / "image.npz").p_sigma
    mat = scipy.io.loadmat(out / "image.mat", simplify_cells=True)
    dataset = xarray.open_dataset(out / "image.nc", engine="h5netcdf")
    for attributes, values in ((mat, mat["p_sigma"]), (dataset.attrs, dataset["p_sigma"].values)):
        assert attributes["verdict"] == level
        assert json.loads(attributes["verdict_reasons"]) == reasons
        np.testing.assert_array_equal(values, sigma)
    with (out / "materials.csv").open(newline="", encoding="utf-8") as f:
        rows = list(csv.DictReader(f))
    assert {r["verdict"] for r in rows} == {level}
    assert {r["verdict_reasons"] for r in rows} == {json.dumps(reasons, ensure_ascii=False)}


def test_without_a_result_no_export_names_anything(tmp_path):
    """Results are withheld even if the files contain names, as written by a faulty program."""
    folder = write_judged_products(tmp_path / "one", "none", keep_withheld=True)
    out = tmp_path / "out"
    assert any(name in (folder / "materials.json").read_text(encoding="utf-8") for name in NAMES)
    assert main(["export", str(folder), "--mat", "--csv", "--out", str(out)]) == 0
    text = (out / "materials.csv").read_text(encoding="utf-8")
    mat = scipy.io.loadmat(out / "image.mat", simplify_cells=True)
    assert np.isnan(mat["materials"]["permittivity_real"]).all()
    assert np.isnan(mat["materials"]["p_abs_db"]).all()
    text += str(mat["materials"]["name"]) + str(mat["materials_json"])
    scan = open_scan(folder)
    patches = scan.patches()
    text += patches.to_dict(data="list").__repr__()
    assert scan.verdict is not None
    assert not scan.verdict.usable
    assert np.isnan(patches["permittivity"]).all()
    assert [name for name in NAMES if name in text] == []


def test_withholding_keeps_positions_and_does_not_change_usable_results(tmp_path):
    folder = write_judged_products(tmp_path / "good", "good")
    usable = ScanMaterials.read(folder / "materials.json")
    assert usable is not None
    hidden = msgspec.structs.replace(usable, verdict=Verdict("none"))
    assert [patch.box_mm for patch in hidden.segments] == [patch.box_mm for patch in usable.segments]
    assert all(patch.name is None and patch.permittivity is None and patch.truth is None for patch in hidden.segments)
    assert any(patch.name for patch in usable.segments)


def test_loss_is_minus_imag_in_the_covariance_too(tmp_path):
    covariance = [[0.04, -0.01], [-0.01, 0.09]]
    spread = PermittivityFigures(real=3, imag=-1, covariance=covariance).spread
    assert spread is not None
    assert (spread.real_std, spread.loss_std, spread.covariance) == pytest.approx((0.2, 0.3, 0.01))
    # The same from draws: a covariance of 200,000 draws is known to a per cent or so.
    draws = np.random.default_rng(1).multivariate_normal([3, -1], covariance, 200_000)
    real = draws[:, 0]
    loss = -draws[:, 1]
    np.testing.assert_allclose(np.cov(real, loss), spread.matrix, rtol=0.03)
    scan = open_scan(write_judged_products(tmp_path / "one", "good"))
    pet = scan.materials().sel(patch=2)
    given_covariance = read_products(scan.folder).segments[1].permittivity.covariance
    assert float(pet["permittivity_real_loss_covariance"]) == pytest.approx(-given_covariance[0][1])
    assert float(pet["permittivity_loss_standard_error"]) == pytest.approx(given_covariance[1][1] ** 0.5)
    assert str(pet["dominated_by"].values) == "leakage"
    assert str(scan.materials().sel(patch=3)["refused"].values).startswith("noise")


def test_products_of_earlier_releases_are_read_as_before(tmp_path):
    folder = write_judged_products(tmp_path / "one", None)
    scan = open_scan(folder)
    products = read_products(folder)
    assert scan.verdict is None
    assert products.images.p_sigma is None
    assert "p_sigma" not in scan.image()
    assert "verdict" not in scan.image().attrs
    assert str(scan.materials()["name"].values[1]) == "PET"
    # Files of earlier releases have standard deviations and no covariance.
    with_stds = PermittivityFigures(real=1, imag=0, real_std=0.1, imag_std=0.2)
    assert with_stds.spread is not None
    np.testing.assert_allclose(with_stds.spread.matrix, [[0.01, 0], [0, 0.04]])
    without_errors = PermittivityFigures(real=1, imag=0)
    assert without_errors.spread is None
    with_unknown_covariance = PermittivityFigures(real=1, imag=0, covariance=[[None, None], [None, None]])
    assert with_unknown_covariance.spread is None
    assert main(["export", str(folder), "--csv", "--out", str(tmp_path / "out")]) == 0
    assert "verdict" not in (tmp_path / "out" / "materials.csv").read_text(encoding="utf-8")


def test_p_sigma_has_the_shape_of_the_image(tmp_path):
    image = np.ones((2, 2), np.complex64)
    axis = np.array([0.0, 0.1])
    valid = np.ones((2, 2), bool)
    with expect_refusal(ErrorCode.MISMATCH, "p_sigma"):
        write_image(
            tmp_path / "i.npz",
            Images(h=image, v=image, x_m=axis, y_m=axis, valid=valid, p=image, p_sigma=np.ones((3, 2))),
        )
    write_json(tmp_path / "materials.json", {"segments": []})
    write_image(
        tmp_path / "i.npz",
        Images(h=image, v=image, x_m=axis, y_m=axis, valid=valid, p=image, p_sigma=np.full((2, 2), np.nan)),
    )
    assert read_image(tmp_path / "i.npz").p_sigma.dtype == np.float32
