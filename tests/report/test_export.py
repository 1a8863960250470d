"""`polysight export` writes MATLAB, NetCDF and CSV files; scipy reads the saved values from the MATLAB file."""

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
    """Check that `read_array(name)` has the values and the kind of numbers of the products' array of that name."""
    for name in ("h", "v", "p", "valid"):
        read = np.asarray(read_array(name))
        expected = getattr(products, name)
        assert (read == expected).all()
        assert read.dtype.kind == expected.dtype.kind


def test_a_matlab_file_has_the_arrays_settings_and_materials_of_the_products(folder, tmp_path):
    products = read_products(folder)
    (tmp_path / "image.mat").write_bytes(pack_mat(products))
    content = scipy.io.loadmat(tmp_path / "image.mat", simplify_cells=True)
    assert_same_arrays(lambda name: content[name].astype(getattr(products, name).dtype), products)
    assert np.array_equal(content["x_m"], products.x_m)
    assert np.array_equal(content["y_m"], products.y_m)
    config = content["config"]
    assert config["chirp"]["start_hz"] == products.facts.instrument["chirp"]["start_hz"]
    # Nested settings: the first step of the mount of the second board in instrument.toml.
    second_board = config["boards"][1]
    first_step = second_board["mount"][0]
    assert list(first_step["shift_mm"]) == [15.837, -3.35, 0.0]
    assert content["versions"]["polysight"] == "0.1.0"
    assert json.loads(content["materials_json"]) == to_plain(products.materials)
    assert bool(content["simulated"]) is True


def test_images_without_materials_and_settings_can_be_exported(folder, tmp_path):
    for name in ("materials.json", "quality.json", "scan.json"):
        (folder / name).unlink()
    products = read_products(folder)
    assert products.simulated is None
    (tmp_path / "image.mat").write_bytes(pack_mat(products))
    assert np.array_equal(scipy.io.loadmat(tmp_path / "image.mat")["h"], products.h)


def test_the_command_writes_the_requested_formats_to_a_folder_next_to_the_products(folder, capsys):
    assert main(["export", str(folder), "--netcdf", "--mat", "--csv"]) == 0
    paths = [Path(line) for line in capsys.readouterr().out.split()]
    assert sorted(path.name for path in paths) == ["image.mat", "image.nc", "materials.csv"]
    for path in paths:
        assert path.exists()
        assert path.parent == folder.parent / "one-export"
    files_of_products = sorted(path.name for path in folder.iterdir())
    assert files_of_products == ["image.npz", "materials.json", "quality.json", "scan.json"]


@pytest.mark.parametrize(
    ("arguments", "missing"),
    [
        (["--mat"], "image.npz"),
        # Without a format the message names those that there are.
        ([], "--netcdf"),
    ],
)
def test_an_export_without_images_or_without_a_format_is_refused(tmp_path, capsys, arguments, missing):
    assert main(["export", str(tmp_path), *arguments]) != 0
    assert missing in capsys.readouterr().err


def test_the_folder_of_a_scan_can_be_given_for_its_products(folder):
    scan = folder.parent / "scan"
    scan.mkdir()
    folder.rename(scan / "products")
    assert read_products(scan).folder == scan / "products"
