"""Metal's gains belong to one rig: whatever they depend on is noticed when it changes, and what cancels is not."""

import shutil
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from polysight.host.calibration.active import checked, load_calibration
from polysight.host.calibration.files import BoardFilter, FilterFile, SourceScan, head, write
from polysight.host.calibration.metal import write_metal
from polysight.host.cli.main import main
from polysight.host.imaging.gain_conditions import ImagedWith
from polysight.host.imaging.geometry import image_grid
from polysight.host.jobs.calibrate import load_reference
from polysight.host.materials.analyse import MetalChoice
from polysight.host.pipeline import Pipeline
from polysight.host.polarimetry import plane_reference
from polysight.host.process.request import Options
from polysight.host.store.scan_folder import ScanFolder
from polysight.shared.errors import DataError

SOURCES = [SourceScan("plate", "scans/plate", True, 7)]


def board(name, **more):
    def change(table):
        (found,) = (b for b in table["boards"] if b["name"] == name)
        found.update(more)

    return change


def mount(name, first=(), last=()):
    """Steps before and behind a board's mount."""

    def change(table):
        (found,) = (b for b in table["boards"] if b["name"] == name)
        found["mount"] = [*first, *found["mount"], *last]

    return change


def antennas(table):
    table["antennas"]["rx_mm"] = [[x, y, 0.05] for x, y, _ in table["antennas"]["rx_mm"]]


def tables(**more):
    return lambda table: [table[name].update(values) for name, values in more.items()]


MATTERS = {
    "V moved": (mount("RV", last=[{"shift_mm": [0.0, 0.05, 0.0]}]), "RV or its antennas moved or turned"),
    "H turned about the line of its antennas": (
        mount("RH", first=[{"turn_deg": 1.0, "about": "x"}]),
        "RH or its antennas moved or turned",
    ),
    "transmitter moved": (mount("LS", last=[{"shift_mm": [0.0, 0.0, 0.1]}]), "LS or its antennas"),
    "another transmit antenna": (board("LS", tx_antenna=0), "LS or its antennas"),
    "antennas": (antennas, "RV or its antennas"),
    "object plane": (tables(geometry={"object_distance_mm": 499.4}), r"object plane is at 499\.40 mm, not 499\.00"),
    "start frequency of the chirp": (tables(chirp={"start_hz": 76.02e9}), "linear samples are 192 of 76.2917"),
    "slope": (tables(chirp={"slope_hz_per_s": 38.8e12}), "linear samples"),
    "linear samples": (tables(chirp={"linear_samples": [0, 180]}), "linear samples are 180"),
    "window": (tables(image={"apodisation": "none"}), "apodisation is 'none', not 'kaiser'"),
    "filters": (tables(chirp={"hpf1_khz": 235.0}), "RH's high-pass corners are 235 and 350 kHz, not 175 and 350"),
}
CANCELS = {
    "raster": tables(grid={"columns": 20, "rows": 10, "step_x_mm": 4.0}),
    "burst": tables(burst={"pulses": 2}),
    "leakage and speckle filter": tables(polarimetry={"leakage_h": [0.1, 0.02], "smooth_px": 3.0}),
    "start frequency of one receiver": board("RV", start_offset_hz=3e5),
    "stage": tables(stage={"speed_mm_s": 10.0}),
    "the same mount in other steps": mount("RV", last=[{"turn_deg": a, "about": "y"} for a in (30.0, -30.0)]),
}


@pytest.fixture
def metal(make_rig, tmp_path):
    """A calibration file of the rig before it is changed."""
    rig = make_rig()
    grid, rng = image_grid(rig), np.random.default_rng(0)
    noise = 1 + 0.02 * (rng.standard_normal((2, *grid.shape)) + 1j * rng.standard_normal((2, *grid.shape)))
    seen = plane_reference(noise[0], noise[1], grid.x_m, grid.y_m, smooth_mm=4.0, name="plate")
    return write_metal(replace(seen, made_with=ImagedWith.of(rig, {})), SOURCES, tmp_path / "c")


@pytest.mark.parametrize(("change", "said"), MATTERS.values(), ids=MATTERS)
def test_a_scan_of_a_changed_rig_is_refused_and_told_what_changed(metal, make_rig, change, said):
    with pytest.raises(DataError, match=said) as refused:
        checked(make_rig(change, calibration={"metal": str(metal)}), True)
    assert metal.name in refused.value.what
    assert "again" in refused.value.remedy


@pytest.mark.parametrize("change", CANCELS.values(), ids=CANCELS)
def test_what_cancels_changes_nothing(metal, make_rig, change):
    assert checked(make_rig(change, calibration={"metal": str(metal)}), True).metal is not None


def test_filters_measured_after_the_plate_count_where_they_differ(metal, make_rig, tmp_path):
    def file(corner):
        found = BoardFilter([corner, 352.0], [5.0, 11.0], [175.0, 350.0], 100.0, 1900.0, 640, 0.05)
        return str(write(FilterFile(**head("hpf", SOURCES), boards={"RH": found, "RV": found}), tmp_path / "c"))

    assert checked(make_rig(calibration={"metal": str(metal), "hpf": file(179.0)}), True)
    with pytest.raises(DataError, match="RV's high-pass corners"):
        checked(make_rig(calibration={"metal": str(metal), "hpf": file(200.0)}), True)


def test_a_file_that_says_nothing_of_its_rig_is_refused(metal, make_rig):
    """As older releases wrote them."""
    text = metal.read_text()
    head_, _, rest = text.partition("[imaged_with]")
    assert rest
    metal.write_text(head_)
    with pytest.raises(DataError, match="does not say which rig") as refused:
        checked(make_rig(calibration={"metal": str(metal)}), True)
    assert "calibrate metal" in refused.value.remedy


SMALL = {
    "grid": {"columns": 10, "rows": 8, "step_x_mm": 14.0, "step_y_mm": 14.0},
    "image": {"columns": 24, "rows": 24, "pixel_mm": 4.0},
}
PLATE = {"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [500.0, 400.0], "metal": True}


@pytest.fixture(scope="module")
def plate(make_rig, scan_of, tmp_path_factory):
    return scan_of(tmp_path_factory.mktemp("metal") / "plate", make_rig(**SMALL), plates=[PLATE])


def test_places_found_after_the_plate_was_scanned_count(plate, make_rig):
    """The rig file is the same, but the places in force are not."""
    reference = load_reference(plate)
    rig = make_rig(**SMALL)
    reference.check_rig(ImagedWith.of(rig, {}))
    moved = msgspec.structs.replace(
        rig, geometry=msgspec.structs.replace(rig.geometry, object_distance_mm=rig.geometry.object_distance_mm + 0.2)
    )
    with pytest.raises(DataError, match="object plane"):
        reference.check_rig(ImagedWith.of(moved, {}))


def test_processing_refuses_a_reference_of_another_rig_before_it_reads_rows(plate, make_rig, scan_of, tmp_path, capsys):
    """V moved between the plate's scan and this one: its axes are the same, its phase is not."""
    moved = make_rig(MATTERS["V moved"][0], **SMALL)
    other = scan_of(tmp_path / "other", moved, plates=[PLATE])
    out = tmp_path / "out"
    assert main(["process", str(other), "--reference", str(plate), "--out", str(out), "--model", "none"]) == 3
    assert "RV or its antennas moved" in capsys.readouterr().err
    assert not (out / "image.npz").exists()


@pytest.fixture
def taken_with(plate, make_rig, believe_rig, tmp_path):
    """The plate's scan as if it had been taken with a changed rig and a calibration file."""

    def make(metal, change=lambda _table: None):
        folder = shutil.copytree(plate, tmp_path / f"scan-{len(list(tmp_path.iterdir()))}")
        inside = shutil.copytree(metal.parent, folder / "calibration") / metal.name  # where a scan keeps its files
        believe_rig(folder, make_rig(change, **SMALL, calibration={"metal": str(inside)}))
        return ScanFolder.load(folder)

    return make


def calibrated(plate, out, *more):
    assert main(["calibrate", "metal", str(plate), "--out", str(out), *more]) == 0
    return next(out.glob("*.toml"))


def test_processing_refuses_the_calibration_of_another_rig(plate, taken_with, tmp_path):
    path = calibrated(plate, tmp_path / "c")
    assert Pipeline(taken_with(path)).metal_plane(Options()) is not None
    moved = Pipeline(taken_with(path, MATTERS["V moved"][0]))
    with pytest.raises(DataError, match="RV or its antennas moved"):
        moved.metal_plane(Options())
    assert moved.metal_plane(Options(metal_box_mm=(0, 0, 9, 9))) is None  # the scene's own metal is of its own rig
    assert moved.metal_plane(Options(), in_scene=True) is None


BANDS = 2


def test_sub_bands_of_the_plate_are_kept_and_others_are_refused(plate, taken_with, tmp_path, capsys):
    path = calibrated(plate, tmp_path / "c", "--bands", str(BANDS))
    assert "2 sub-bands kept: 76.28..78.57, 77.44..79.73 GHz" in capsys.readouterr().out
    found, expected = load_calibration({"metal": path}).reference(), load_reference(plate, bands=BANDS)
    assert len(found.bands) == len(expected.bands) == BANDS
    for mine, made in zip(found.bands, expected.bands, strict=True):
        for name in ("h", "v", "valid"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(made, name))
        assert (mine.spread, mine.how) == (made.spread, made.how)
    pipeline = Pipeline(taken_with(path))
    assert len(pipeline.metal_plane(Options(bands=BANDS)).bands) == BANDS
    assert pipeline.metal_plane(Options()) is not None
    with pytest.raises(DataError, match="holds 2 sub-bands, not 3") as refused:
        pipeline.metal_plane(Options(bands=3))
    assert "--bands 3" in refused.value.remedy
    assert "--bands 2" in refused.value.remedy


def test_a_file_without_sub_bands_refuses_them_before_rows_are_read(plate, taken_with, tmp_path, capsys):
    scan = taken_with(calibrated(plate, tmp_path / "c"))
    assert main(["process", str(scan.path), "--bands", "2", "--out", str(tmp_path / "out"), "--model", "none"]) == 3
    assert "no sub-bands, not 2" in capsys.readouterr().err
    assert not (tmp_path / "out" / "image.npz").exists()


def test_each_sub_band_is_divided_by_its_own_metal(plate, taken_with, tmp_path):
    """Metal referenced to the calibration file of the same metal is 1 in every sub-band."""
    pipeline = Pipeline(taken_with(calibrated(plate, tmp_path / "c", "--bands", str(BANDS))), bands=BANDS)
    for row in pipeline.source.rows():
        pipeline.add_row(row)
    reference = pipeline.metal_plane(Options(bands=BANDS))
    (found,) = pipeline.find_materials(pipeline.form_images(), MetalChoice(plane=reference)).rows()
    assert len(found["bands"]) == BANDS
    for band in found["bands"]:
        assert complex(*band["ratio"].values()) == pytest.approx(1.0, abs=0.02)
    assert pipeline.quality.notes["metal_reference"]["sub_bands"] == BANDS
