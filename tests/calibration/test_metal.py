"""The metal reference: a scanned plate gives the gains of every pixel and sub-band, and applies to one rig only."""

import shutil

import msgspec
import numpy as np
import pytest
from tests.support.calibration import SOURCES, make_filter_file, make_metal_reference
from tests.support.refusals import expect_refusal

from polysight.calibration.files import load_calibration, load_checked_calibration, write_calibration, write_metal
from polysight.cli.main import main
from polysight.imaging import ImagedWith
from polysight.jobs.calibrate import load_reference
from polysight.materials import KnownScene
from polysight.pipeline import Pipeline
from polysight.settings import Settings
from polysight.store import ScanFolder
from polysight_shared.errors import DataError, ErrorCode


def set_board_values(name, **values):
    """Change keys of one board. Like the next ones, this returns a function that changes the table of a rig file."""

    def change(table):
        (board,) = (b for b in table["boards"] if b["name"] == name)
        board.update(values)

    return change


def add_mount_steps(name, first=(), last=()):
    """Add steps before and after those of a board's mount."""

    def change(table):
        (board,) = (b for b in table["boards"] if b["name"] == name)
        board["mount"] = [*first, *board["mount"], *last]

    return change


def move_antennas(table):
    """Move the receive antennas by 0.05 mm out of the plane of their board."""
    table["antennas"]["rx_mm"] = [[x, y, 0.05] for x, y, _ in table["antennas"]["rx_mm"]]


def set_table_values(**tables):
    """Change keys of tables of the rig file."""

    def change(table):
        for name, values in tables.items():
            table[name].update(values)

    return change


V_MOVED = add_mount_steps("RV", last=[{"shift_mm": [0.0, 0.05, 0.0]}])

# Changes after which a metal reference is not valid, because phases or amplitudes of images change; and the words that
# the message must have.
CHANGES_THAT_MATTER = {
    "V moved": (V_MOVED, ["RV"]),
    "H turned about the line of its antennas": (add_mount_steps("RH", first=[{"turn_deg": 1.0, "about": "x"}]), ["RH"]),
    "transmitter moved": (add_mount_steps("LS", last=[{"shift_mm": [0.0, 0.0, 0.1]}]), ["LS"]),
    "another transmit antenna": (set_board_values("LS", tx_antenna=0), ["LS"]),
    "antennas": (move_antennas, ["RV"]),
    "object plane": (set_table_values(geometry={"object_distance_mm": 499.4}), ["499.40 mm", "499.00"]),
    "start frequency of the chirp": (set_table_values(chirp={"start_hz": 76.02e9}), [192, 76.2917]),
    "slope": (set_table_values(chirp={"slope_hz_per_s": 38.8e12}), ["linear samples"]),
    "linear samples": (set_table_values(chirp={"linear_samples": [0, 180]}), [180]),
    "window": (set_table_values(image={"apodisation": "none"}), ["none", "kaiser"]),
    "filters": (set_table_values(chirp={"hpf1_khz": 235.0}), ["RH", "235 and 350 kHz", "175 and 350"]),
}

# Changes that have the same effect on the plate and on the scene, or none.
CHANGES_THAT_CANCEL = {
    "raster": set_table_values(grid={"columns": 20, "rows": 10, "step_x_mm": 4.0}),
    "burst": set_table_values(burst={"pulses": 2}),
    "leakage and speckle filter": set_table_values(polarimetry={"leakage_h": [0.1, 0.02], "smooth_px": 3.0}),
    "start frequency of one receiver": set_board_values("RV", start_offset_hz=3e5),
    "stage": set_table_values(stage={"speed_mm_s": 10.0}),
    "the same mount in other steps": add_mount_steps("RV", last=[{"turn_deg": a, "about": "y"} for a in (30.0, -30.0)]),
}


@pytest.fixture
def metal(make_rig, tmp_path):
    """A metal reference of the rig before it is changed."""
    return write_metal(make_metal_reference(make_rig()), SOURCES, tmp_path / "c")


@pytest.mark.parametrize(("change", "named"), CHANGES_THAT_MATTER.values(), ids=CHANGES_THAT_MATTER)
def test_a_metal_reference_of_another_rig_is_refused_with_the_difference(metal, make_rig, change, named):
    with expect_refusal(ErrorCode.MISMATCH, metal, *named):
        load_checked_calibration(make_rig(change, calibration={"metal": str(metal)}), simulated=True)


@pytest.mark.parametrize("change", CHANGES_THAT_CANCEL.values(), ids=CHANGES_THAT_CANCEL)
def test_settings_that_cancel_may_change(metal, make_rig, change):
    rig = make_rig(change, calibration={"metal": str(metal)})
    assert load_checked_calibration(rig, simulated=True).metal is not None


def test_filters_measured_after_the_plate_may_differ_only_slightly(metal, make_rig):
    def make_rig_with_filter(corner_khz):
        file = write_calibration(make_filter_file(corner_khz), metal.parent)
        return make_rig(calibration={"metal": str(metal), "hpf": str(file)})

    # The plate was imaged with 175 kHz, as the rig file says.
    assert load_checked_calibration(make_rig_with_filter(179.0), simulated=True)
    with expect_refusal(ErrorCode.MISMATCH, "RV", 200):
        load_checked_calibration(make_rig_with_filter(200.0), simulated=True)


def test_a_file_of_an_older_release_without_its_rig_is_refused(metal, make_rig):
    text_before, _, text_after = metal.read_text().partition("[imaged_with]")
    assert text_after
    metal.write_text(text_before)
    with expect_refusal(ErrorCode.KEY_MISSING, metal):
        load_checked_calibration(make_rig(calibration={"metal": str(metal)}), simulated=True)


# Tables of a rig with a small grid and a small image, and a copper plate that is larger than both
SMALL = {
    "grid": {"columns": 10, "rows": 8, "step_x_mm": 14.0, "step_y_mm": 14.0},
    "image": {"columns": 24, "rows": 24, "pixel_mm": 4.0},
}
PLATE = {"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [500.0, 400.0], "metal": True}

# Sub-bands of the sweep
BANDS = 2


@pytest.fixture(scope="module")
def plate(make_rig, make_scan, tmp_path_factory):
    """A scan of the copper plate."""
    return make_scan(tmp_path_factory.mktemp("metal") / "plate", make_rig(**SMALL), plates=[PLATE])


def calibrate(plate, out, *options):
    """Calibrate with a plate; return the calibration file."""
    assert main(["calibrate", "metal", str(plate), "--out", str(out), *options]) == 0
    return next(out.glob("*.toml"))


@pytest.fixture(scope="module")
def full_metal(plate, tmp_path_factory):
    """The plate's metal reference without sub-bands."""
    return calibrate(plate, tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def banded_metal(plate, tmp_path_factory):
    """The plate's metal reference with sub-bands."""
    return calibrate(plate, tmp_path_factory.mktemp("banded"), "--bands", str(BANDS))


@pytest.fixture
def take_scan_with(plate, make_rig, set_rig, tmp_path):
    """`take_scan_with(metal, change)`: the plate's scan, whose manifest has a changed rig and this calibration file."""

    def make(metal, change=lambda _table: None):
        folder = shutil.copytree(plate, tmp_path / f"scan-{len(list(tmp_path.iterdir()))}")
        # A scan has its own copies of calibration files, in this folder.
        metal_of_scan = shutil.copytree(metal.parent, folder / "calibration") / metal.name
        set_rig(folder, make_rig(change, **SMALL, calibration={"metal": str(metal_of_scan)}))
        return ScanFolder.load(folder)

    return make


def test_a_scan_without_metal_is_refused(tmp_path, make_rig, make_scan):
    small = {"grid": {"columns": 4, "rows": 3}, "image": {"columns": 20, "rows": 20}}
    point = {"position_mm": [0.0, 0.0], "amplitude": [1e-3, 0.0]}
    folder = make_scan(tmp_path / "air", make_rig(**small), points=[point])
    status = main(["calibrate", "metal", str(folder), "--out", str(tmp_path / "c")])
    assert status == DataError.exit_status
    assert not (tmp_path / "c").exists()


def test_a_plastic_sheet_is_not_a_metal_plate(tmp_path, make_rig, make_scan):
    sheet = PLATE | {"name": "acrylic", "permittivity": [4.0, 0.4]}
    del sheet["metal"]
    folder = make_scan(tmp_path / "sheet", make_rig(**SMALL), plates=[sheet])
    with expect_refusal(ErrorCode.NO_DATA, "no metal"):
        load_reference(folder)


def test_an_object_plane_calibrated_after_the_plate_is_refused(plate, make_rig):
    """The rig file is the same, but the calibrated distance of the plane, which replaces that of the file, is not."""
    reference = load_reference(plate)
    rig = make_rig(**SMALL)
    reference.check_rig(ImagedWith.from_rig(rig, {}))
    deeper = msgspec.structs.replace(rig.geometry, object_distance_mm=rig.geometry.object_distance_mm + 0.2)
    with expect_refusal(ErrorCode.MISMATCH):
        reference.check_rig(ImagedWith.from_rig(msgspec.structs.replace(rig, geometry=deeper), {}))


def test_processing_refuses_a_reference_scan_of_another_rig_before_it_reads_rows(plate, make_rig, make_scan, tmp_path):
    """The board V moved between the two scans: its axes are the same, but not its phases."""
    other_scan = make_scan(tmp_path / "other", make_rig(V_MOVED, **SMALL), plates=[PLATE])
    out = tmp_path / "out"
    options = ["--reference", str(plate), "--out", str(out), "--model", "none"]
    assert main(["process", str(other_scan), *options]) == DataError.exit_status
    assert not (out / "image.npz").exists()


def test_processing_refuses_the_calibration_of_another_rig(full_metal, take_scan_with):
    assert load_metal_plane(Pipeline(take_scan_with(full_metal))) is not None
    moved = Pipeline(take_scan_with(full_metal, V_MOVED))
    with expect_refusal(ErrorCode.MISMATCH, "RV"):
        load_metal_plane(moved)
    # With metal in the scene itself no reference of another scan is needed.
    assert load_metal_plane(moved, in_scene=True) is None


def load_metal_plane(pipeline, bands=1, in_scene=False):
    """The metal reference that the pipeline uses; None if it uses metal in the scene."""
    no_reference_scan = None
    return pipeline.calibration.metal_plane(pipeline.rig, no_reference_scan, in_scene, bands)


def test_the_calibration_file_holds_the_reference_of_the_plate_in_every_sub_band(plate, banded_metal, take_scan_with):
    reference = load_calibration({"metal": banded_metal}).reference()
    expected = load_reference(plate, bands=BANDS)
    assert len(reference.bands) == BANDS
    assert len(expected.bands) == BANDS
    for stored, computed in zip((reference, *reference.bands), (expected, *expected.bands), strict=True):
        for name in ("h", "v", "valid"):
            np.testing.assert_array_equal(getattr(stored, name), getattr(computed, name))
        assert (stored.spread, stored.how) == (computed.spread, computed.how)
    pipeline = Pipeline(take_scan_with(banded_metal))
    assert len(load_metal_plane(pipeline, BANDS).bands) == BANDS
    assert load_metal_plane(pipeline) is not None
    with expect_refusal(ErrorCode.MISMATCH, "2 sub-bands, not 3", "--bands 3", "--bands 2"):
        load_metal_plane(pipeline, 3)


def test_missing_sub_bands_are_refused_before_rows_are_read(full_metal, take_scan_with, tmp_path):
    scan = take_scan_with(full_metal)
    arguments = ["process", str(scan.path), "--bands", "2", "--out", str(tmp_path / "out"), "--model", "none"]
    assert main(arguments) == DataError.exit_status
    assert not (tmp_path / "out" / "image.npz").exists()


def test_metal_is_one_in_the_whole_sweep_and_in_every_sub_band(banded_metal, take_scan_with):
    pipeline = Pipeline(take_scan_with(banded_metal), Settings(bands=BANDS))
    for row in pipeline.source.rows():
        pipeline.add_row(row)
    reference = load_metal_plane(pipeline, BANDS)
    (metal_row,) = pipeline.find_materials(pipeline.form_images(), KnownScene(metal=reference)).rows()
    assert len(metal_row.bands) == BANDS
    # Differences of up to 0.005 are measured.
    for ratio in (metal_row.ratio, *(band.ratio for band in metal_row.bands)):
        assert ratio.value == pytest.approx(1.0, abs=0.02)
    assert pipeline.quality.notes["metal_reference"].sub_bands == BANDS
