"""Calibration files are read back, a scan uses its own copies, and unsuitable or changed files are refused."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
import tomli_w
from tests.support.calibration import SOURCES, make_filter_file, make_metal_reference
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts

from polysight.calibration.files import (
    FilterFile,
    MetalFile,
    PlacesFile,
    SourceScan,
    copy_into_scan,
    load_calibration,
    load_rig_calibration,
    load_scan_calibration,
    read_calibration,
    write_calibration,
    write_metal,
)
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.raster import plan_raster
from polysight_shared.tables import to_builtins

# Measured corners of the high-pass filters in `make_filter_file`. The nominal corners of its board are 175 and 350 kHz.
FILE_CORNERS_HZ = (180.5e3, 355.25e3)


@pytest.fixture
def hpf(tmp_path):
    """The path of a calibration file of the high-pass filters."""
    return write_calibration(make_filter_file(), tmp_path / "c")


@pytest.fixture
def rig_naming(make_rig):
    """`rig_naming(hpf=path, metal=path)`: a rig whose file names these calibration files."""

    def make(**files):
        paths = {kind: str(path) for kind, path in files.items()}
        return make_rig(calibration=paths, grid={"columns": 2, "rows": 2})

    return make


def create_scan(folder, rig) -> ScanFolder:
    """Create a simulated scan with copies of the calibration files that its rig names."""
    copies = copy_into_scan(rig, folder, simulated=True)
    return ScanFolder.create(folder, rig, plan_raster(rig.grid), calibration=copies)


def test_a_filter_measured_with_other_corners_or_not_on_every_receiver_is_refused(make_rig, tmp_path):
    # The board was set to nominal corners of 175 and 350 kHz when its filters were measured.
    complete = make_filter_file()
    without_rv = msgspec.structs.replace(complete, boards={"RH": complete.boards["RH"]})
    cases = [
        # File, first nominal corner of the rig file, and what the message names
        (complete, 350.0, "[175.0, 350.0] kHz"),
        (without_rv, 175.0, "RV"),
    ]
    for i, (file, first_corner_khz, named) in enumerate(cases):
        path = write_calibration(file, tmp_path / str(i))
        rig = make_rig(
            chirp={"hpf1_khz": first_corner_khz}, calibration={"hpf": str(path)}, grid={"columns": 2, "rows": 2}
        )
        with expect_refusal(ErrorCode.MISMATCH, path, named):
            copy_into_scan(rig, tmp_path / "scan", simulated=True)


def test_a_file_is_read_back_as_it_was_written_and_replaces_no_other(tmp_path):
    file = make_filter_file()
    paths = [write_calibration(file, tmp_path / "new") for _ in range(3)]
    assert len(set(paths)) == 3
    assert all(read_calibration(path, FilterFile, "hpf") == file for path in paths)
    # A name begins with the kind of the file and the year of its date, as in hpf-2026.
    assert paths[0].name.startswith("hpf-20")
    assert file.simulated


def test_a_file_of_another_kind_format_or_content_is_refused(hpf):
    with expect_refusal(ErrorCode.FILE_FOREIGN, hpf, "hpf", "direct_path"):
        read_calibration(hpf, PlacesFile, "direct_path")
    text = hpf.read_text()
    hpf.write_text(text.replace("format = 1", "format = 2"))
    with expect_refusal(ErrorCode.VERSION_UNSUPPORTED, hpf, 2):
        read_calibration(hpf, FilterFile, "hpf")
    hpf.write_text(text.replace("chirps = 640", 'chirps = "many"'))
    with pytest.raises(ConfigError) as caught:
        read_calibration(hpf, FilterFile, "hpf")
    assert "chirps" in str(caught.value)


def test_relative_paths_are_relative_to_the_rig_file(tmp_path, make_rig):
    path = write_calibration(make_filter_file(), tmp_path / "sub" / "calibration")
    table = to_builtins(make_rig()) | {"calibration": {"hpf": f"calibration/{path.name}"}}
    (tmp_path / "sub" / "rig.toml").write_text(tomli_w.dumps(table))
    rig = load_instrument(tmp_path / "sub" / "rig.toml")
    assert rig.calibration.hpf == str(path)
    assert load_rig_calibration(rig).high_pass("RH").corners_hz == FILE_CORNERS_HZ


def test_a_rig_without_calibration_files_is_not_changed(make_rig):
    rig = make_rig()
    calibration = load_rig_calibration(rig)
    assert calibration.rig(rig) is rig
    assert calibration.high_pass("RH") is None
    assert calibration.reference() is None
    assert calibration.files() == {}


def test_a_scan_keeps_copies_of_its_calibration(tmp_path, make_rig, rig_naming, hpf):
    dispersion = (0.1 - 0.2j, 0.05j)
    metal = write_metal(replace(make_metal_reference(make_rig()), dispersion=dispersion), SOURCES, hpf.parent)
    scan = create_scan(tmp_path / "scan", rig_naming(hpf=hpf, metal=metal))
    assert sorted(load_facts(scan, "scan_started")[0]["calibration"]) == ["hpf", "metal"]
    assert not [f for f in validate(scan.path) if f.level == "error"]
    # The originals are deleted.
    copies_before = load_scan_calibration(scan)
    for original in hpf.parent.iterdir():
        original.unlink()
    copies_after = load_scan_calibration(ScanFolder.load(scan.path))
    assert copies_after.filters == copies_before.filters
    assert copies_after.high_pass("RH").corners_hz == FILE_CORNERS_HZ
    np.testing.assert_array_equal(copies_after.reference().h, copies_before.reference().h)
    assert copies_after.reference().dispersion == dispersion
    assert set(copies_after.files()) == {"hpf", "metal"}


def test_files_of_one_name_in_two_folders_are_both_kept(tmp_path, make_rig, rig_naming, hpf):
    metal = write_metal(make_metal_reference(make_rig()), SOURCES, tmp_path / "b")
    hpf = hpf.rename(hpf.with_name("latest.toml"))
    metal = metal.rename(metal.with_name("latest.toml"))
    calibration = load_scan_calibration(create_scan(tmp_path / "s", rig_naming(hpf=hpf, metal=metal)))
    assert set(calibration.files()) == {"hpf", "metal"}


def test_a_metal_reference_with_another_pixel_size_is_refused_before_the_scan(tmp_path, make_rig, rig_naming):
    metal = write_metal(make_metal_reference(make_rig(image={"pixel_mm": 2.5})), SOURCES, tmp_path / "c")
    with expect_refusal(ErrorCode.MISMATCH):
        create_scan(tmp_path / "s", rig_naming(metal=metal))


def test_a_changed_or_missing_copy_is_refused(tmp_path, rig_naming, hpf):
    scan = create_scan(tmp_path / "scan", rig_naming(hpf=hpf))
    copy = next((scan.path / "calibration").iterdir())
    copy.write_text(copy.read_text().replace("180.5", "190.5"))
    with expect_refusal(ErrorCode.FILE_DAMAGED, copy, hpf):
        load_scan_calibration(scan)
    copy.unlink()
    with expect_refusal(ErrorCode.FILE_DAMAGED, copy, hpf):
        load_scan_calibration(scan)


def test_the_calibration_of_an_existing_scan_is_not_overwritten(tmp_path, rig_naming, hpf):
    scan = create_scan(tmp_path / "scan", rig_naming(hpf=hpf))
    other_file = write_calibration(make_filter_file(first_khz=200.0), hpf.parent)
    copy_into_scan(rig_naming(hpf=other_file), scan.path, simulated=True)
    assert load_scan_calibration(scan).high_pass("RH").corners_hz == FILE_CORNERS_HZ


def test_a_missing_file_is_refused_before_the_scan_is_created(tmp_path, rig_naming):
    with pytest.raises(ConfigError) as caught:
        copy_into_scan(rig_naming(hpf=tmp_path / "nowhere.toml"), tmp_path / "scan", simulated=True)
    assert "nowhere.toml" in str(caught.value)
    assert not (tmp_path / "scan").exists()


def test_a_metal_reference_is_read_back_as_it_was_written(tmp_path, make_rig):
    reference = make_metal_reference(make_rig())
    path = write_metal(reference, SOURCES, tmp_path)
    reloaded = load_calibration({"metal": path}).reference()
    for name in ("h", "v", "valid", "x_m", "y_m"):
        np.testing.assert_array_equal(getattr(reloaded, name), getattr(reference, name))
    assert (reloaded.spread, reloaded.how) == (reference.spread, reference.how)
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".npz", ".toml"]
    # The phase of H / V rises by 1 rad over the plate. A uniform distribution of width 1 has the standard deviation
    # 1 / sqrt(12). The images' noise of 2 % changes it by less than 5 %.
    expected_deg = np.degrees(1 / np.sqrt(12))
    assert read_calibration(path, MetalFile, "metal").ratio_variation_deg == pytest.approx(expected_deg, rel=0.05)


def test_images_of_another_metal_reference_are_refused(tmp_path, make_rig):
    path = write_metal(make_metal_reference(make_rig()), SOURCES, tmp_path / "one")
    other_reference = write_metal(make_metal_reference(make_rig(), seed=1), SOURCES, tmp_path / "two")
    path.with_suffix(".npz").write_bytes(other_reference.with_suffix(".npz").read_bytes())
    with expect_refusal(ErrorCode.FILE_DAMAGED, path.with_suffix(".npz")):
        load_calibration({"metal": path}).reference()


def test_simulated_calibration_is_refused_for_a_measured_scan(tmp_path, rig_naming, hpf):
    with expect_refusal(ErrorCode.MISMATCH, hpf):
        copy_into_scan(rig_naming(hpf=hpf), tmp_path / "scan", simulated=False)
    measured_sweep = SourceScan("sweep", "scans/sweep", simulated=False, rows=7)
    measured = msgspec.structs.replace(make_filter_file(), sources=[measured_sweep])
    rig = rig_naming(hpf=write_calibration(measured, hpf.parent))
    assert set(copy_into_scan(rig, tmp_path / "scan", simulated=False)) == {"hpf"}
