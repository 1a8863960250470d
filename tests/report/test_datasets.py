"""`polysight export --netcdf` writes the products of a scan, and xarray reads the same values from the file."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray

from polysight.cli.main import main
from polysight.products import exports
from polysight.products.exports import join_complex, read_netcdf, split_complex
from polysight_shared.errors import ConfigError, DataError


def export_folder(folder: Path) -> xarray.Dataset:
    """The NetCDF file of a folder of products, read."""
    out = folder.parent / "out"
    assert main(["export", str(folder), "--netcdf", "--out", str(out)]) == 0
    return read_netcdf(out / "image.nc")


def test_images_and_their_axes_are_the_same_as_in_the_products(folder):
    dataset = export_folder(folder)
    with np.load(folder / "image.npz") as saved:
        for name in ("h", "v", "p", "valid"):
            np.testing.assert_array_equal(dataset[name], saved[name])
            assert dataset[name].dtype == saved[name].dtype
            assert dataset[name].dims == ("y_mm", "x_mm")
        for axis in "xy":
            rig_m = saved[f"{axis}_m"]
            np.testing.assert_array_equal(dataset[f"{axis}_m"], rig_m)
            centre_m = dataset.attrs[f"image_centre_{axis}_m"]
            np.testing.assert_allclose(dataset[f"{axis}_mm"], 1e3 * (rig_m - centre_m), atol=1e-5)
            assert float(dataset[f"{axis}_mm"].mean()) == pytest.approx(0, abs=1e-9)
            assert dataset[f"{axis}_m"].attrs["units"] == "m"
            assert dataset[f"{axis}_mm"].attrs["units"] == "mm"


def test_names_and_numbers_of_patches_are_those_in_materials_json(folder):
    dataset = export_folder(folder)
    # PATCH and METAL in conftest.py, by their labels.
    pet = dataset.sel(patch=4)
    metal = dataset.sel(patch=5)
    assert (pet["name"], pet["runner_up"], metal["name"]) == ("PET", "glass", "")
    assert (pet["confidence"], pet["runner_up_share"]) == (0.75, 0.2)
    assert complex(pet["permittivity"]) == 3.5 - 0.25j
    assert (pet["permittivity_real_standard_error"], pet["permittivity_loss_standard_error"]) == (0.0625, 0.125)
    assert complex(pet["ratio"]) == 10j
    assert np.isnan(metal["permittivity"])
    # Its box in materials.json, which is in mm from the image's centre, too.
    left, _, right, _ = (-30, -40, 50, 40)
    assert float(pet["centre_x_mm"]) == (left + right) / 2
    assert float(pet["centre_y_mm"]) == 0
    assert float(pet["width_mm"]) == right - left
    assert float(pet["patch_incidence_rad"]) == pytest.approx(np.radians(54.5))
    assert dataset["label"].dtype == np.int32
    label_inside_pet = dataset["label"].sel(x_mm=pet["centre_x_mm"], y_mm=pet["centre_y_mm"], method="nearest")
    label_inside_metal = dataset["label"].sel(x_mm=-100, y_mm=0, method="nearest")
    assert label_inside_pet == 4
    assert label_inside_metal == 5


def test_the_attributes_give_the_origin_of_the_data(folder):
    attributes = export_folder(folder).attrs
    assert attributes["scan_id"] == "s"
    assert attributes["simulated"] is True
    # Rows 0, 1 and 5 were recorded.
    assert attributes["rows_missing"].startswith("2-4, 6-")
    assert attributes["positions_masked"] == "RH 2 of 9"
    assert '"columns"' in attributes["instrument"]


def test_netcdf_has_no_complex_variables(folder):
    export_folder(folder)
    with h5py.File(folder.parent / "out" / "image.nc") as f:
        assert {"h_real", "h_imag", "p_real", "p_imag", "permittivity_real", "permittivity_imag"} <= set(f)
        assert not {"h", "permittivity"} & set(f)
        assert f["h_imag"].dtype == np.float32
        assert f["h_imag"].attrs["long_name"].endswith("imaginary part")


def test_joining_the_parts_of_split_complex_variables_restores_the_dataset():
    variables = {
        "a": (
            "t",
            np.array([1 + 2j, complex(np.nan, np.nan), complex(0, np.inf)], np.complex64),
            {"units": "1", "long_name": "a"},
        ),
        "b_real": ("t", [1.0, 2.0, 3.0], {"units": "m", "long_name": "not a part of anything"}),
        "c": ("t", np.array([1e-300 + 1e300j, 0, 1]), {"units": "V", "long_name": "c"}),
        "is_valid": ("t", np.array([True, False, True]), {"long_name": "whether a position is usable"}),
        "count": ("t", np.array([1, 2, 3]), {"units": "1", "long_name": "number of chirps"}),
    }
    dataset = xarray.Dataset(variables, attrs={"title": "x"})
    split = split_complex(dataset)
    assert set(split.data_vars) == {"a_real", "a_imag", "b_real", "c_real", "c_imag", "is_valid", "count"}
    joined = join_complex(split)
    xarray.testing.assert_identical(joined[sorted(variables)], dataset[sorted(variables)])
    assert {name: v.dtype for name, v in joined.items()} == {name: v.dtype for name, v in dataset.items()}


def test_images_without_materials_and_settings_can_be_exported(folder):
    for name in ("materials.json", "scan.json", "quality.json"):
        (folder / name).unlink()
    dataset = export_folder(folder)
    assert set(dataset.dims) == {"y_mm", "x_mm"}
    assert dataset.attrs["simulated"] == "unknown"
    assert dataset.attrs["metal_reference"].startswith("none")


def test_a_missing_package_is_named_with_the_command_that_installs_it(folder, monkeypatch, capsys):
    def raise_import_error(name):
        raise ImportError(name)

    monkeypatch.setattr(exports, "import_module", raise_import_error)
    out = folder.parent / "out"
    assert main(["export", str(folder), "--netcdf", "--out", str(out)]) == ConfigError.exit_status
    message = capsys.readouterr().err
    assert "pip install h5netcdf" in message
    assert not list(out.iterdir())


def test_a_file_that_is_not_netcdf_is_refused(tmp_path):
    (tmp_path / "text.nc").write_text("text")
    for name in ("text.nc", "absent.nc"):
        with pytest.raises(DataError) as caught:
            read_netcdf(tmp_path / name)
        assert name in str(caught.value)
