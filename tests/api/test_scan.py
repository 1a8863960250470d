"""Laws of `polysight.open_scan`: its results are those of the commands, with descriptions; no files remain."""

import shutil
import subprocess
import sys
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

# Permittivity of the PET plate in the simulated scene.
TRUE_PET = 3.78 - 0.7j
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


# --- what a dataset says of itself ------------------------------------------------------------------------------------


def test_images_have_named_dimensions_and_places_from_the_centre(scan):
    image = scan.image()
    assert {name for name, v in image.data_vars.items() if v.dims == ("y_mm", "x_mm")} == {
        "h", "v", "p", "valid", "p_sigma"
    }  # fmt: skip
    assert {image[name].dtype for name in "hvp"} == {np.dtype(np.complex64)}
    assert image["valid"].dtype == bool
    assert image.sizes == {"y_mm": 60, "x_mm": 90}
    for axis in "xy":
        assert np.diff(image[f"{axis}_mm"]) == pytest.approx(2)
        assert np.diff(image[f"{axis}_m"]) == pytest.approx(2e-3)
    assert float(image["incidence_deg"]) == pytest.approx(54.9, abs=0.2)
    assert float(image["incidence_rad"]) == pytest.approx(np.radians(float(image["incidence_deg"])))


def test_a_place_on_the_command_line_is_the_same_pixel_in_python(scan):
    """The two frames differ by 75 mm here: the same coordinates in the other frame are another pixel, or none."""
    image = scan.image()
    assert abs(image.attrs["image_centre_y_m"]) > 0.05
    plate = image.sel(x_mm=PET["centre_mm"][0], y_mm=PET["centre_mm"][1], method="nearest")
    metal = image.sel(x_mm=COPPER["centre_mm"][0], y_mm=COPPER["centre_mm"][1], method="nearest")
    # P is 1 on the metal, and unlike 1 on the plate; 0.2 is chosen.
    assert abs(complex(metal["p"]) - 1) < 0.2
    assert abs(complex(plate["p"]) - 1) > 0.2
    with pytest.raises(KeyError):
        image.sel(x=0.045)


@pytest.mark.parametrize("name", DATASETS)
def test_every_variable_has_units_and_a_name_and_every_dataset_its_provenance(scan, name):
    dataset = getattr(scan, name)()
    for variable in dataset.variables.values():
        assert {"units", "long_name"} <= set(variable.attrs) <= {"units", "long_name", "axis"}
        assert variable.attrs["long_name"]
    assert {"x_mm", "y_mm", "x_m", "y_m"} <= set(dataset.coords) or dataset.sizes == {"patch": 2}
    assert "(simulated)" in dataset.attrs["title"]
    assert dataset.attrs["rig"] == scan.rig.name
    assert polysight.__version__ in dataset.attrs["versions"]


def test_patches_are_where_the_plates_are(scan):
    patches = scan.patches()
    assert list(patches["patch"]) == [1, 2]
    for patch, plate in zip((1, 2), (COPPER, PET), strict=True):
        row = patches.sel(patch=patch)
        assert [float(row["centre_x_mm"]), float(row["centre_y_mm"])] == pytest.approx(plate["centre_mm"], abs=6)
        label = patches["label"].sel(x_mm=row["centre_x_mm"], y_mm=row["centre_y_mm"], method="nearest")
        assert label == patch
        inside = patches["interior"] & (patches["label"] == patch)
        assert inside.sum() == row["pixels"]
        assert (patches["label"].where(patches["interior"]) != 0).all()


def test_permittivity_is_near_the_truth_and_unknown_for_metal(scan):
    copper = scan.permittivity().sel(patch=1)
    pet = scan.permittivity().sel(patch=2)
    for name in ("permittivity", "permittivity_real_standard_error", "permittivity_loss_standard_error"):
        assert np.isnan(copper[name])
        assert np.isfinite(pet[name])
    assert complex(pet["true_permittivity"]) == TRUE_PET
    # Both limits are chosen; the ratio of metal is 1.
    assert abs(complex(pet["permittivity"]) - TRUE_PET) < 1.0
    assert abs(complex(copper["ratio"]) - 1) < 0.1


def test_materials_have_names_and_a_runner_up(scan):
    materials = scan.materials()
    assert list(materials["true_name"].values) == ["copper", "PET"]
    assert materials["metal_reference"].values.tolist() == [True, False]
    # The metal reference gets no name.
    assert materials["name"].values[0] == ""
    assert materials["runner_up"].values[1] != materials["name"].values[1]
    assert materials.attrs["library"]


def test_sub_bands_are_a_dimension_of_their_own(folder):
    patches = open_scan(folder, bands=3).patches()
    assert patches["band_ratio"].dims == ("patch", "band")
    assert patches.sizes["band"] == 3
    assert (patches["band_first_hz"] < patches["band_last_hz"]).all()
    ratios_of_metal = patches["band_ratio"].sel(patch=1)
    assert (abs(ratios_of_metal - 1) < 0.3).all()


def test_each_pixel_can_have_its_own_incidence(folder):
    angles = open_scan(folder, incidence="pixel").image()["incidence_deg"]
    assert angles.dims == ("y_mm", "x_mm")
    assert abs(angles - 54.9).max() < 10


# --- the same as the commands -----------------------------------------------------------------------------------------


def assert_same_image(image: xarray.Dataset, file: Path) -> None:
    saved = read_image(file)
    for name in ("h", "v", "p"):
        np.testing.assert_allclose(image[name].values, getattr(saved, name), rtol=1e-6, atol=1e-6)
    assert (image["valid"].values == saved.valid).all()
    assert (image["x_m"].values == saved.x_m).all()
    assert (image["y_m"].values == saved.y_m).all()


def test_the_unreferenced_image_is_what_image_writes(scan, folder, tmp_path):
    run_command("image", shutil.copytree(folder, tmp_path / "scan"), "--out", tmp_path / "out")
    assert_same_image(scan.image(metal_referenced=False), tmp_path / "out" / "image.npz")
    saved = open_scan(tmp_path / "out")
    xarray.testing.assert_allclose(saved.image(metal_referenced=False), scan.image(metal_referenced=False))
    for call in (saved.image, saved.patches, saved.plot):
        with expect_refusal(ErrorCode.MISMATCH):
            call()


@pytest.mark.parametrize("name", DATASETS)
def test_products_give_the_same_datasets_as_the_rows(scan, products, name):
    from_rows = getattr(scan, name)()
    from_products = getattr(open_scan(products), name)()
    # Outlines are saved to half a pixel
    if "label" in from_rows:
        differ = from_rows["label"] != from_products["label"]
        assert differ.sum() < 0.2 * (from_rows["label"] > 0).sum()
        from_rows = from_rows.drop_vars("label")
        from_products = from_products.drop_vars("label")
    xarray.testing.assert_allclose(from_rows, from_products, rtol=1e-6)
    for dataset in (from_rows, from_products):
        del dataset.attrs["processed_utc"]
    assert from_rows.attrs == from_products.attrs


def test_saved_products_of_a_scan_folder_are_used_while_they_hold_its_rows(folder, products, tmp_path):
    scan = shutil.copytree(folder, tmp_path / "scan")
    saved = shutil.copytree(products, scan / "products")
    # Only the products can answer
    shutil.rmtree(scan / "raw")
    shutil.rmtree(scan / "samples", ignore_errors=True)
    assert "saved products" in repr(open_scan(scan))
    assert_same_image(open_scan(scan).image(), saved / "image.npz")
    for opened in (open_scan(scan, fresh=True), open_scan(scan, model="none")):
        assert "recorded rows" in repr(opened)
        with pytest.raises(DataError):
            opened.image()


def test_products_of_other_rows_are_not_used(folder, products, tmp_path):
    scan = copy_without_rows(folder, tmp_path / "scan", 26)
    shutil.copytree(products, scan / "products")
    opened = open_scan(scan)
    assert "recorded rows" in repr(opened)
    assert opened.image().attrs["rows_missing"] == "26"


@pytest.mark.parametrize("by_columns", [False, True])
def test_the_published_layout_opens(tmp_path, monkeypatch, by_columns):
    monkeypatch.chdir(tmp_path)
    data = simulate_plates(tmp_path / "data", COPPER, PET, layout="authors", by_columns=by_columns)
    opened = open_scan(data)
    assert "SIMULATED" in repr(opened)
    assert opened.rows.missing == ()
    assert opened.rows.planned == (31 if by_columns else 27)
    run_command("process", data, "--out", tmp_path / "out")  # with the instrument.toml of the data's folder
    assert_same_image(opened.image(), tmp_path / "out" / "image.npz")
    assert open_scan(tmp_path / "out").rows == opened.rows
    shutil.copytree(tmp_path / "out", data / "products")
    assert "recorded rows" not in repr(open_scan(data))
    assert "recorded rows" in repr(open_scan(data, rig=data / "instrument.toml")), "products are of some other rig file"
    shutil.rmtree(data / "products")
    (data / "instrument.toml").unlink()
    assert open_scan(data).rig == open_scan(data, rig=load_instrument(REPO / "instrument.toml")).rig


def test_the_published_layout_has_surfaces_with_the_rig_that_it_was_opened_with(tmp_path, monkeypatch):
    data = simulate_plates(tmp_path / "data", COPPER, layout="authors")
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


def test_missing_rows_are_named(folder, tmp_path):
    scan = open_scan(copy_without_rows(folder, tmp_path / "scan", 3, 7, 8))
    assert scan.rows.planned == 27
    assert list(scan.rows.indices) == list(range(27))
    assert scan.rows.missing == (3, 7, 8)
    assert set(scan.rows.committed) == set(range(27)) - {3, 7, 8}
    assert repr(scan).startswith("<Scan small: SIMULATED, 24 of 27 rows (missing 3, 7-8), recorded rows in ")
    assert scan.image().attrs["rows_missing"] == "3, 7-8"


def test_rows_are_read_once_and_only_when_asked_for(folder, tmp_path, monkeypatch):
    folder = shutil.copytree(folder, tmp_path / "scan", ignore=shutil.ignore_patterns("samples"))
    read: list[tuple[str, int]] = []
    true_read = ScanFolder.read_row

    def count_read(self, board, row):
        read.append((board, row))
        return true_read(self, board, row)

    monkeypatch.setattr(ScanFolder, "read_row", count_read)
    scan = open_scan(folder)
    assert scan.rows.planned == 27
    assert scan.rig.name
    assert not read
    for _ in range(2):
        scan.image()
        scan.image(metal_referenced=False)
        scan.materials()
        scan.plot()
    assert sorted(read) == [(board, row) for board in ("RH", "RV") for row in range(27)]


def test_results_are_the_callers_to_change(scan):
    image_before = scan.image()
    changed = scan.image()
    changed["h"][:] = 0
    changed["x_mm"].attrs.clear()
    xarray.testing.assert_identical(scan.image(), image_before)


def read_file_states(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(p): (p.stat().st_mtime_ns, p.stat().st_size) for p in sorted(folder.rglob("*"))}


def test_nothing_is_written_unless_asked(folder, products, tmp_path, monkeypatch):
    scan = shutil.copytree(folder, tmp_path / "scan")
    saved = shutil.copytree(products, tmp_path / "products")
    monkeypatch.chdir(tmp_path)
    files_before = read_file_states(tmp_path)
    for path in (scan, saved):
        opened = open_scan(path)
        repr(opened)
        for name in DATASETS:
            getattr(opened, name)()
        opened.plot()
    assert read_file_states(tmp_path) == files_before


# --- files ------------------------------------------------------------------------------------------------------------


def assert_same_dataset(dataset: xarray.Dataset, expected: xarray.Dataset) -> None:
    variables = sorted(map(str, expected.data_vars))
    xarray.testing.assert_equal(dataset[variables], expected[variables])
    for name, variable in expected.variables.items():
        assert dataset[name].attrs == variable.attrs, name
        if variable.dtype.kind in "cfib":
            assert dataset[name].dtype == variable.dtype, name


def test_netcdf_keeps_every_value(products, tmp_path):
    scan = open_scan(products)
    scan.to_netcdf(tmp_path / "image.nc")
    dataset = read_netcdf(tmp_path / "image.nc")
    assert_same_dataset(dataset, scan.image().assign(scan.patches().data_vars))
    assert dataset.attrs.items() >= {**scan.image().attrs, **scan.patches().attrs}.items()
    assert scan.rig.name in dataset.attrs["instrument"]


# --- the figure -------------------------------------------------------------------------------------------------------


def test_the_figure_has_axes_in_mm_colour_bars_and_says_simulated(scan):
    for figure, pictures in ((scan.plot(), 4), (scan.plot(metal_referenced=False), 3)):
        titled = [ax for ax in figure.axes if ax.get_title(loc="left")]
        bars = [ax for ax in figure.axes if ax not in titled]
        assert (len(titled), len(bars)) == (pictures, 3)
        assert all((ax.get_xlabel(), ax.get_ylabel()) == ("x (mm)", "y (mm)") for ax in titled)
        assert all(bar.get_ylabel().startswith("dB") for bar in bars)
        assert figure.get_suptitle() == "Scan small (simulated)"
        assert figure._repr_png_().startswith(b"\x89PNG")
    assert "metal reference" in " ".join(t.get_text() for t in scan.plot().axes[3].texts)


# --- errors -----------------------------------------------------------------------------------------------------------


def test_other_folders_are_refused(tmp_path):
    for path in (tmp_path, tmp_path / "absent", str(tmp_path)):
        with pytest.raises(DataError):
            open_scan(path)


def test_a_scan_without_a_whole_row_says_so(folder, tmp_path):
    scan = open_scan(copy_without_rows(folder, tmp_path / "scan", *range(27)))
    assert scan.rows.committed == ()
    for call in (scan.image, scan.patches, scan.plot, lambda: scan.image(metal_referenced=False)):
        with expect_refusal(ErrorCode.NO_DATA):
            call()


def test_a_scan_without_metal_lists_the_available_results(tmp_path):
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


def test_a_given_rig_is_reported_as_ignored_if_the_scan_folder_has_one(folder):
    with pytest.warns(UserWarning, match="`rig` is ignored"):
        opened = open_scan(folder, rig=REPO / "instrument.toml")
    assert opened.rig == open_scan(folder).rig


def test_products_cannot_be_processed_again(products):
    with expect_refusal(ErrorCode.VALUES_CONFLICT, products):
        open_scan(products, bands=3)
    with expect_refusal(ErrorCode.VALUES_CONFLICT, products):
        open_scan(products, rig=REPO / "instrument.toml")
    with expect_refusal(ErrorCode.MISMATCH):
        open_scan(products).image(metal_referenced=False)


def test_products_without_facts_of_the_scan_can_be_opened(products, tmp_path):
    bare = shutil.copytree(products, tmp_path / "bare")
    for name in ("scan.json", "quality.json", "patches.npz"):
        (bare / name).unlink()
    scan = open_scan(bare)
    assert "number of rows not known" in repr(scan)
    assert "interior" not in scan.patches()
    assert "incidence_deg" not in scan.image()
    # as in materials.json
    assert scan.simulated is True
    for name in ("rig", "rows"):
        with expect_refusal(ErrorCode.KEY_MISSING, name):
            getattr(scan, name)


# --- the package ------------------------------------------------------------------------------------------------------


def test_importing_polysight_imports_nothing_else():
    code = (
        "import sys\nfor name in ('numpy', 'xarray', 'msgspec', 'scipy', 'matplotlib'): sys.modules[name] = None\n"
        "import polysight\nassert polysight.__version__\n"
        "assert {'open_scan', 'fresnel', 'backproject'} <= set(dir(polysight))\n"
        "assert not [m for m in sys.modules if m.startswith('polysight.')]\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_opening_a_scan_needs_neither_xarray_nor_matplotlib_s_state(folder):
    code = (
        f"import sys, polysight\nscan = polysight.open_scan({str(folder)!r})\nrepr(scan), scan.rows, scan.rig\n"
        "assert 'xarray' not in sys.modules\nscan.plot()\nassert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_is_there():
    for name in polysight.__all__:
        assert getattr(polysight, name)
    with pytest.raises(AttributeError):
        _ = polysight.no_such_name
