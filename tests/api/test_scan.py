"""`polysight.open_scan`: its datasets have the results of the commands, with units and names. It writes no files."""

import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import xarray
from msgspec.structs import replace
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts

import polysight
from polysight import open_scan, read_netcdf
from polysight.jobs import surface as jobs_surface
from polysight.products.processed import read_image
from polysight.store import MANIFEST, ScanFolder, manifest
from polysight_shared.config import load_instrument
from polysight_shared.errors import DataError, ErrorCode, PolysightError

from .conftest import COPPER, PET, REPO, run_command, simulate_plates

# Permittivity of the PET plate in the simulated scene
TRUE_PET = 3.78 - 0.7j
# Incidence angle of the published rig, degrees
INCIDENCE_DEG = 54.9
# Size of a pixel of the simulated scans
PIXEL_MM = 2.0
# Rows of the scan `folder`
ROWS = 27
# Methods of a scan, each of which returns a dataset.
DATASETS = ("image", "patches", "permittivity", "materials")


@pytest.fixture(scope="module")
def scan(folder):
    return open_scan(folder)


def copy_without_rows(folder: Path, out: Path, *rows: int) -> Path:
    """A copy of a scan folder in which these rows were never committed."""
    shutil.copytree(folder, out)
    facts = load_facts(out)
    kept_facts = [fact for fact in facts if fact["fact"] != "row_committed" or fact["row"] not in rows]
    (out / MANIFEST).write_bytes(b"".join(manifest.encode_line(f) for f in kept_facts))
    return out


# --- content and descriptions of datasets -----------------------------------------------------------------------------


def test_images_have_named_dimensions_pixel_coordinates_and_an_incidence_angle(scan):
    image = scan.image()
    variables_of_pixels = {name for name, v in image.data_vars.items() if v.dims == ("y_mm", "x_mm")}
    assert variables_of_pixels == {"h", "v", "p", "valid", "p_sigma"}
    assert {image[name].dtype for name in "hvp"} == {np.dtype(np.complex64)}
    assert image["valid"].dtype == bool
    assert image.sizes == {"y_mm": 60, "x_mm": 90}
    for axis in "xy":
        assert np.diff(image[f"{axis}_mm"]) == pytest.approx(PIXEL_MM)
        assert np.diff(image[f"{axis}_m"]) == pytest.approx(PIXEL_MM / 1e3)
    # It is measured with the plates: 54.95 degrees.
    assert float(image["incidence_deg"]) == pytest.approx(INCIDENCE_DEG, abs=0.2)
    assert float(image["incidence_rad"]) == pytest.approx(np.radians(float(image["incidence_deg"])))


def test_coordinates_in_mm_are_those_of_scene_files_and_commands(scan):
    """They are relative to the centre of the image. Those in m are in the rig's frame, here 0.1 m away."""
    image = scan.image()
    assert abs(image.attrs["image_centre_y_m"]) > 0.05
    pet = image.sel(x_mm=PET["centre_mm"][0], y_mm=PET["centre_mm"][1], method="nearest")
    copper = image.sel(x_mm=COPPER["centre_mm"][0], y_mm=COPPER["centre_mm"][1], method="nearest")
    # P = H / V relative to metal: |P - 1| is 0.01 on the copper and 2.9 on the PET.
    assert abs(complex(copper["p"]) - 1) < 0.2
    assert abs(complex(pet["p"]) - 1) > 0.2
    with pytest.raises(KeyError):
        image.sel(x=0.045)


@pytest.mark.parametrize("name", DATASETS)
def test_variables_have_units_and_names_and_datasets_name_their_origin(scan, name):
    dataset = getattr(scan, name)()
    for variable in dataset.variables.values():
        assert {"units", "long_name"} <= set(variable.attrs) <= {"units", "long_name", "axis"}
        assert variable.attrs["long_name"]
    # A dataset has pixels, or else only the two patches.
    has_pixels = {"x_mm", "y_mm", "x_m", "y_m"} <= set(dataset.coords)
    assert has_pixels or dataset.sizes == {"patch": 2}
    assert "(simulated)" in dataset.attrs["title"]
    assert dataset.attrs["rig"] == scan.rig.name
    assert polysight.__version__ in dataset.attrs["versions"]


def test_patches_are_where_the_plates_are(scan):
    patches = scan.patches()
    assert list(patches["patch"]) == [1, 2]
    for number, plate in ((1, COPPER), (2, PET)):
        patch = patches.sel(patch=number)
        centre_mm = [float(patch["centre_x_mm"]), float(patch["centre_y_mm"])]
        # Measured: half a pixel.
        assert centre_mm == pytest.approx(plate["centre_mm"], abs=3 * PIXEL_MM)
        label = patches["label"].sel(x_mm=patch["centre_x_mm"], y_mm=patch["centre_y_mm"], method="nearest")
        assert label == number
        inside = patches["interior"] & (patches["label"] == number)
        assert inside.sum() == patch["pixels"]
    # No pixel outside of the patches (label 0) counts as inside of one.
    assert (patches["label"].where(patches["interior"]) != 0).all()


def test_permittivity_is_near_the_truth_for_pet_and_not_a_number_for_metal(scan):
    copper = scan.permittivity().sel(patch=1)
    pet = scan.permittivity().sel(patch=2)
    for name in ("permittivity", "permittivity_real_standard_error", "permittivity_loss_standard_error"):
        assert np.isnan(copper[name])
        assert np.isfinite(pet[name])
    assert complex(pet["true_permittivity"]) == TRUE_PET
    # The standard errors of real part and loss are 0.57 and 0.55; measured: 0.82.
    assert abs(complex(pet["permittivity"]) - TRUE_PET) < 1.0
    # P of metal is 1; measured: 0.004 off.
    assert abs(complex(copper["ratio"]) - 1) < 0.1


def test_materials_have_true_names_and_likely_names(scan):
    materials = scan.materials()
    assert list(materials["true_name"].values) == ["copper", "PET"]
    assert materials["metal_reference"].values.tolist() == [True, False]
    copper = materials.sel(patch=1)
    pet = materials.sel(patch=2)
    # The classifier gives no name to the metal reference.
    assert copper["name"] == ""
    assert pet["runner_up"] != pet["name"]
    # File of the library with which the patches were compared
    assert materials.attrs["library"]


def test_sub_bands_are_a_dimension_of_the_patches(folder):
    patches = open_scan(folder, bands=3).patches()
    assert patches["band_ratio"].dims == ("patch", "band")
    assert patches.sizes["band"] == 3
    assert (patches["band_first_hz"] < patches["band_last_hz"]).all()
    ratios_of_metal = patches["band_ratio"].sel(patch=1)
    # P of metal is 1 at every frequency; measured: up to 0.005 off.
    assert (abs(ratios_of_metal - 1) < 0.3).all()


def test_each_pixel_can_have_its_own_incidence_angle(folder):
    angles = open_scan(folder, incidence="pixel").image()["incidence_deg"]
    assert angles.dims == ("y_mm", "x_mm")
    # Measured: 54.88 degrees in every pixel.
    assert abs(angles - INCIDENCE_DEG).max() < 10


# --- agreement with the commands --------------------------------------------------------------------------------------


def assert_same_image(image: xarray.Dataset, file: Path) -> None:
    saved = read_image(file)
    for name in ("h", "v", "p"):
        np.testing.assert_allclose(image[name].values, getattr(saved, name), rtol=1e-6, atol=1e-6)
    assert (image["valid"].values == saved.valid).all()
    assert (image["x_m"].values == saved.x_m).all()
    assert (image["y_m"].values == saved.y_m).all()


def test_the_image_that_is_not_relative_to_metal_is_that_of_the_command_image(scan, folder, tmp_path):
    run_command("image", shutil.copytree(folder, tmp_path / "scan"), "--out", tmp_path / "out")
    assert_same_image(scan.image(metal_referenced=False), tmp_path / "out" / "image.npz")
    saved = open_scan(tmp_path / "out")
    xarray.testing.assert_allclose(saved.image(metal_referenced=False), scan.image(metal_referenced=False))
    for call in (saved.image, saved.patches, saved.plot):
        with expect_refusal(ErrorCode.MISMATCH):
            call()


@pytest.mark.parametrize("name", DATASETS)
def test_products_and_recorded_rows_give_the_same_datasets(scan, products, name):
    from_rows = getattr(scan, name)()
    from_products = getattr(open_scan(products), name)()
    # Products have the outlines of patches to half a pixel, so that labels differ there (measured: 0.5 % of pixels).
    if "label" in from_rows:
        is_different = from_rows["label"] != from_products["label"]
        assert is_different.sum() < 0.2 * (from_rows["label"] > 0).sum()
        from_rows = from_rows.drop_vars("label")
        from_products = from_products.drop_vars("label")
    xarray.testing.assert_allclose(from_rows, from_products, rtol=1e-6)
    for dataset in (from_rows, from_products):
        del dataset.attrs["processed_utc"]
    assert from_rows.attrs == from_products.attrs


def test_products_in_a_scan_folder_are_used_unless_other_settings_are_given(folder, products, tmp_path):
    scan = shutil.copytree(folder, tmp_path / "scan")
    saved = shutil.copytree(products, scan / "products")
    # Without the recorded data only the products have results.
    shutil.rmtree(scan / "raw")
    shutil.rmtree(scan / "samples", ignore_errors=True)
    assert "saved products" in repr(open_scan(scan))
    assert_same_image(open_scan(scan).image(), saved / "image.npz")
    for opened in (open_scan(scan, fresh=True), open_scan(scan, model="none")):
        assert "recorded rows" in repr(opened)
        with pytest.raises(DataError):
            opened.image()


def test_products_of_other_rows_than_the_scan_s_are_not_used(folder, products, tmp_path):
    # The products were made of all rows, and the scan lacks the last one.
    last_row = ROWS - 1
    scan = copy_without_rows(folder, tmp_path / "scan", last_row)
    shutil.copytree(products, scan / "products")
    opened = open_scan(scan)
    assert "recorded rows" in repr(opened)
    assert opened.image().attrs["rows_missing"] == str(last_row)


@pytest.mark.parametrize("by_columns", [False, True])
def test_data_in_the_layout_of_the_paper_s_authors_can_be_opened(tmp_path, monkeypatch, by_columns):
    monkeypatch.chdir(tmp_path)
    data = simulate_plates(tmp_path / "data", COPPER, PET, layout="authors", by_columns=by_columns)
    opened = open_scan(data)
    assert "SIMULATED" in repr(opened)
    assert opened.rows.missing == ()
    assert opened.rows.planned == (31 if by_columns else 27)
    # The command takes the rig file `instrument.toml` in the folder of the data.
    run_command("process", data, "--out", tmp_path / "out")
    assert_same_image(opened.image(), tmp_path / "out" / "image.npz")
    assert open_scan(tmp_path / "out").rows == opened.rows
    shutil.copytree(tmp_path / "out", data / "products")
    assert "recorded rows" not in repr(open_scan(data))
    # Products do not say which rig file they were made with, so a given one counts as another.
    assert "recorded rows" in repr(open_scan(data, rig=data / "instrument.toml"))
    # Without a rig file in the folder of the data, that of the published rig is used.
    shutil.rmtree(data / "products")
    (data / "instrument.toml").unlink()
    published_rig = load_instrument(REPO / "instrument.toml")
    assert open_scan(data).rig == open_scan(data, rig=published_rig).rig


def test_surfaces_of_data_in_the_authors_layout_are_made_with_the_given_rig(tmp_path, monkeypatch):
    data = simulate_plates(tmp_path / "data", COPPER, layout="authors")
    # Not in the folder of the data, where it would be found without being given.
    rig_file = (data / "instrument.toml").rename(tmp_path / "rig.toml")
    rig = replace(load_instrument(rig_file), name="rig of this test")
    used_rigs = []
    find_surfaces = jobs_surface.make_surface

    def record_rig(folder, instrument, reference):
        used_rigs.append(instrument)
        return find_surfaces(folder, instrument, reference)

    monkeypatch.setattr(jobs_surface, "make_surface", record_rig)
    assert open_scan(data, rig=rig).surface().sizes["point"] > 0
    assert used_rigs == [rig]


# --- rows, laziness, side effects -------------------------------------------------------------------------------------


def test_missing_rows_are_listed(folder, tmp_path):
    missing_rows = (3, 7, 8)
    scan = open_scan(copy_without_rows(folder, tmp_path / "scan", *missing_rows))
    assert scan.rows.planned == ROWS
    assert list(scan.rows.indices) == list(range(ROWS))
    assert scan.rows.missing == missing_rows
    assert set(scan.rows.committed) == set(range(ROWS)) - set(missing_rows)
    assert repr(scan).startswith("<Scan small: SIMULATED, 24 of 27 rows (missing 3, 7-8), recorded rows in ")
    assert scan.image().attrs["rows_missing"] == "3, 7-8"


def test_rows_are_read_once_and_only_when_results_are_needed(folder, tmp_path, monkeypatch):
    # Saved samples would be read instead of the rows.
    folder = shutil.copytree(folder, tmp_path / "scan", ignore=shutil.ignore_patterns("samples"))
    rows_read: list[tuple[str, int]] = []
    read_row = ScanFolder.read_row

    def record_and_read(self, board, row):
        rows_read.append((board, row))
        return read_row(self, board, row)

    monkeypatch.setattr(ScanFolder, "read_row", record_and_read)
    scan = open_scan(folder)
    assert scan.rows.planned == ROWS
    assert scan.rig.name
    assert not rows_read
    for _ in range(2):
        scan.image()
        scan.image(metal_referenced=False)
        scan.materials()
        scan.plot()
    assert sorted(rows_read) == [(board, row) for board in ("RH", "RV") for row in range(ROWS)]


def test_a_change_of_a_returned_dataset_does_not_change_the_scan_s_own(scan):
    image_before = scan.image()
    changed = scan.image()
    changed["h"][:] = 0
    changed["x_mm"].attrs.clear()
    xarray.testing.assert_identical(scan.image(), image_before)


def read_file_states(folder: Path) -> dict[str, tuple[int, int]]:
    """Time of the last change and size of all files and folders below a folder."""
    states = {}
    for path in sorted(folder.rglob("*")):
        status = path.stat()
        states[str(path)] = (status.st_mtime_ns, status.st_size)
    return states


def test_opening_processing_and_plotting_a_scan_write_no_files(folder, products, tmp_path, monkeypatch):
    scan = shutil.copytree(folder, tmp_path / "scan")
    saved = shutil.copytree(products, tmp_path / "products")
    monkeypatch.chdir(tmp_path)
    files_before = read_file_states(tmp_path)
    for path in (scan, saved):
        opened = open_scan(path)
        repr(opened)
        opened.image()
        opened.patches()
        opened.permittivity()
        opened.materials()
        opened.plot()
    assert read_file_states(tmp_path) == files_before


# --- files ------------------------------------------------------------------------------------------------------------


def assert_contains(dataset: xarray.Dataset, expected: xarray.Dataset) -> None:
    """All variables of `expected` are in the dataset, with the same values, attributes and types of numbers."""
    variables = sorted(map(str, expected.data_vars))
    xarray.testing.assert_equal(dataset[variables], expected[variables])
    for name, variable in expected.variables.items():
        assert dataset[name].attrs == variable.attrs, name
        # Strings have another type after they were read.
        is_number = variable.dtype.kind in "cfib"
        if is_number:
            assert dataset[name].dtype == variable.dtype, name


def test_a_netcdf_file_keeps_every_value(products, tmp_path):
    scan = open_scan(products)
    scan.to_netcdf(tmp_path / "image.nc")
    dataset = read_netcdf(tmp_path / "image.nc")
    assert_contains(dataset, scan.image().assign(scan.patches().data_vars))
    assert dataset.attrs.items() >= {**scan.image().attrs, **scan.patches().attrs}.items()
    assert scan.rig.name in dataset.attrs["instrument"]


# --- the figure -------------------------------------------------------------------------------------------------------


def test_the_figure_has_axes_in_mm_colour_bars_in_db_and_a_title(scan):
    # Images of H, V and P, and a map of the patches if they are relative to metal.
    for figure, panels in ((scan.plot(), 4), (scan.plot(metal_referenced=False), 3)):
        panel_axes = [ax for ax in figure.axes if ax.get_title(loc="left")]
        colour_bars = [ax for ax in figure.axes if ax not in panel_axes]
        assert len(panel_axes) == panels
        assert len(colour_bars) == 3
        assert all((ax.get_xlabel(), ax.get_ylabel()) == ("x (mm)", "y (mm)") for ax in panel_axes)
        assert all(bar.get_ylabel().startswith("dB") for bar in colour_bars)
        assert figure.get_suptitle() == "Scan small (simulated)"
        assert figure._repr_png_().startswith(b"\x89PNG")
    map_of_patches = scan.plot().axes[3]
    assert "metal reference" in " ".join(text.get_text() for text in map_of_patches.texts)


# --- errors -----------------------------------------------------------------------------------------------------------


def test_a_folder_without_a_scan_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / "absent", str(tmp_path)):
        with pytest.raises(DataError):
            open_scan(path)


def test_a_scan_without_a_committed_row_has_no_results(folder, tmp_path):
    scan = open_scan(copy_without_rows(folder, tmp_path / "scan", *range(ROWS)))
    assert scan.rows.committed == ()
    for call in (scan.image, scan.patches, scan.plot):
        with expect_refusal(ErrorCode.NO_DATA):
            call()
    with expect_refusal(ErrorCode.NO_DATA):
        scan.image(metal_referenced=False)


def test_a_scan_without_metal_has_an_image_and_no_materials(tmp_path):
    scan = open_scan(simulate_plates(tmp_path / "scan"))
    assert scan.verdict is not None
    assert scan.verdict.level == "none"
    assert scan.materials().sizes["patch"] == 0
    assert scan.image(metal_referenced=False).attrs["metal_reference"].startswith("none")


@pytest.mark.parametrize(
    "invalid_parameters",
    [
        {"library": "absent.npz"},
        {"library": polysight.Library(())},
        {"model": "no such model"},
        {"metal_box_mm": (900.0, 900.0, 910.0, 910.0)},
    ],
)
def test_parameters_that_cannot_be_used_are_errors(folder, invalid_parameters):
    with pytest.raises(PolysightError):
        open_scan(folder, **invalid_parameters).materials()


def test_a_given_rig_is_ignored_with_a_warning_if_the_scan_folder_has_its_own(folder):
    with pytest.warns(UserWarning, match="`rig` is ignored"):
        opened = open_scan(folder, rig=REPO / "instrument.toml")
    assert opened.rig == open_scan(folder).rig


def test_settings_of_the_processing_are_refused_for_products(products):
    """Products do not have the recorded rows, so they cannot be processed again with other settings."""
    with expect_refusal(ErrorCode.VALUES_CONFLICT, products):
        open_scan(products, bands=3)
    with expect_refusal(ErrorCode.VALUES_CONFLICT, products):
        open_scan(products, rig=REPO / "instrument.toml")
    with expect_refusal(ErrorCode.MISMATCH):
        open_scan(products).image(metal_referenced=False)


def test_products_that_lack_files_can_be_opened(products, tmp_path):
    bare = shutil.copytree(products, tmp_path / "bare")
    for name in ("scan.json", "quality.json", "patches.npz"):
        (bare / name).unlink()
    scan = open_scan(bare)
    assert "number of rows not known" in repr(scan)
    assert "interior" not in scan.patches()
    assert "incidence_deg" not in scan.image()
    # The remaining file materials.json says so, too.
    assert scan.simulated is True
    for name in ("rig", "rows"):
        with expect_refusal(ErrorCode.KEY_MISSING, name):
            getattr(scan, name)


# --- the package ------------------------------------------------------------------------------------------------------


def run_in_new_process(code: str) -> None:
    """Run lines of Python, which must not raise an error."""
    subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True)


def test_importing_polysight_imports_no_library_and_none_of_its_own_modules():
    # None in `sys.modules` makes an import of that name fail.
    run_in_new_process("""
        import sys
        for name in ("numpy", "xarray", "msgspec", "scipy", "matplotlib"):
            sys.modules[name] = None
        import polysight
        assert polysight.__version__
        assert {"open_scan", "fresnel", "backproject"} <= set(dir(polysight))
        assert not [m for m in sys.modules if m.startswith("polysight.")]
    """)


def test_opening_a_scan_does_not_import_xarray_and_plotting_does_not_import_pyplot(folder):
    """The import of xarray takes long, and pyplot would change how the caller's own figures are shown."""
    run_in_new_process(f"""
        import sys
        import polysight
        scan = polysight.open_scan({str(folder)!r})
        repr(scan)
        scan.rows
        scan.rig
        assert "xarray" not in sys.modules
        scan.plot()
        assert "matplotlib.pyplot" not in sys.modules
    """)


def test_every_public_name_exists():
    for name in polysight.__all__:
        assert getattr(polysight, name)
    with pytest.raises(AttributeError):
        _ = polysight.no_such_name
