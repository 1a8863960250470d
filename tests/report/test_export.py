"""Exports contain the saved values: every format is read back by its own library."""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from polysight.cli.main import main
from polysight.products import read_products
from polysight.products.exports import pack_mat
from polysight.results import to_plain


def assert_same_arrays(read_array, products):
    """Check that `read_array` of a name has the values and the kind of numbers of the products' array."""
    for name in ("h", "v", "p", "valid"):
        assert (np.asarray(read_array(name)) == getattr(products, name)).all()
        assert np.asarray(read_array(name)).dtype.kind == getattr(products, name).dtype.kind


def test_a_matlab_file_has_the_arrays_settings_and_materials_of_the_products(folder, tmp_path):
    products = read_products(folder)
    (tmp_path / "image.mat").write_bytes(pack_mat(products))
    content = scipy.io.loadmat(tmp_path / "image.mat", simplify_cells=True)
    assert_same_arrays(lambda name: content[name].astype(getattr(products, name).dtype), products)
    assert np.array_equal(content["x_m"], products.x_m)
    assert np.array_equal(content["y_m"], products.y_m)
    config = content["config"]
    assert config["chirp"]["start_hz"] == products.facts.instrument["chirp"]["start_hz"]
    # First step of the mount of the second board in instrument.toml.
    assert list(config["boards"][1]["mount"][0]["shift_mm"]) == [15.837, -3.35, 0.0]
    assert content["versions"]["polysight"] == "0.1.0"
    assert json.loads(content["materials_json"]) == to_plain(products.materials)
    assert bool(content["simulated"]) is True


def test_images_without_materials_export_too(folder, tmp_path):
    for name in ("materials.json", "quality.json", "scan.json"):
        (folder / name).unlink()
    products = read_products(folder)
    assert products.simulated is None
    (tmp_path / "image.mat").write_bytes(pack_mat(products))
    assert np.array_equal(scipy.io.loadmat(tmp_path / "image.mat")["h"], products.h)


def test_the_command_writes_what_is_asked_for(folder, capsys):
    assert main(["export", str(folder), "--netcdf", "--mat", "--csv"]) == 0
    paths = [Path(line) for line in capsys.readouterr().out.split()]
    assert sorted(path.name for path in paths) == ["image.mat", "image.nc", "materials.csv"]
    assert all(path.exists() and path.parent == folder.parent / "one-export" for path in paths)
    assert sorted(p.name for p in folder.iterdir()) == ["image.npz", "materials.json", "quality.json", "scan.json"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--mat"], ["image.npz"]),
        ([], ["--netcdf"]),
    ],
)
def test_data_that_cannot_be_exported_is_reported(tmp_path, capsys, arguments, words):
    assert main(["export", str(tmp_path), *arguments]) != 0
    message = capsys.readouterr().err
    assert all(word in message for word in words)


def test_a_scan_folder_stands_for_its_products(folder):
    scan = folder.parent / "scan"
    scan.mkdir()
    folder.rename(scan / "products")
    assert read_products(scan).folder == scan / "products"
