"""Calibration files: they read back, a scan keeps copies of what it was taken with, and changed ones are noticed."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from polysight.host.calibration.active import keep_in_scan, load_calibration, of_rig, of_scan
from polysight.host.calibration.files import (
    BoardFilter,
    FilterFile,
    MetalFile,
    PlacesFile,
    SourceScan,
    head,
    read,
    write,
)
from polysight.host.calibration.metal import write_metal
from polysight.host.imaging.gain_conditions import ImagedWith
from polysight.host.imaging.geometry import image_grid
from polysight.host.polarimetry import plane_reference
from polysight.host.store.scan_folder import ScanFolder
from polysight.host.store.validation import validate
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import ConfigError, DataError
from polysight.shared.raster import plan_raster
from polysight.shared.tables import to_builtins

SOURCES = [SourceScan("plate", "scans/plate", True, 7)]


def filter_file(corner_khz=180.5):
    board = BoardFilter([corner_khz, 355.25], [1.5, 2.5], [175.0, 350.0], 100.0, 1900.0, 640, 0.05)
    return FilterFile(**head("hpf", SOURCES), boards={"RH": board, "RV": board})


def metal_reference(rig, seed=0):
    rng, grid = np.random.default_rng(seed), image_grid(rig)
    y, x = np.meshgrid(np.linspace(0, 1, grid.y_m.size), np.linspace(0, 1, grid.x_m.size), indexing="ij")
    gain = (1 + 0.2 * y) * np.exp(1j * x)
    noise = 1 + 0.02 * (rng.standard_normal((2, *x.shape)) + 1j * rng.standard_normal((2, *x.shape)))
    seen = plane_reference(gain * noise[0], 0.7 * noise[1], grid.x_m, grid.y_m, smooth_mm=4.0, name="plate")
    return replace(seen, made_with=ImagedWith.of(rig, {}))


def named(make_rig, **files) -> Instrument:
    return make_rig(calibration={k: str(v) for k, v in files.items()}, grid={"columns": 2, "rows": 2})


def create(folder, rig) -> ScanFolder:
    return ScanFolder.create(folder, rig, plan_raster(rig.grid), extra={"calibration": keep_in_scan(rig, folder, True)})


def test_a_filter_measured_with_other_corners_or_not_on_every_receiver_is_refused(make_rig, tmp_path):
    whole = filter_file()
    lacking = msgspec.structs.replace(whole, boards={"RH": whole.boards["RH"]})
    refused = [(whole, 350.0, r"\[175.0, 350.0\] kHz programmed"), (lacking, 175.0, "RV is not in it")]
    for i, (file, khz, words) in enumerate(refused):
        path = write(file, tmp_path / str(i))
        rig = make_rig(chirp={"hpf1_khz": khz}, calibration={"hpf": str(path)}, grid={"columns": 2, "rows": 2})
        with pytest.raises(ConfigError, match=words):
            keep_in_scan(rig, tmp_path / "scan", True)
    kept = keep_in_scan(named(make_rig, hpf=write(whole, tmp_path / "good")), tmp_path / "scan", True)
    assert list(kept) == ["hpf"]


def test_files_survive_writing_and_never_overwrite(tmp_path):
    file = filter_file()
    paths = [write(file, tmp_path / "new") for _ in range(3)]
    assert len(set(paths)) == 3
    assert all(read(path, FilterFile, "hpf") == file for path in paths)
    assert paths[0].name.startswith("hpf-20")
    assert file.simulated


def test_a_file_of_another_kind_or_a_later_format_is_refused(tmp_path):
    path = write(filter_file(), tmp_path)
    with pytest.raises(ConfigError, match="kind 'hpf', not 'direct_path'"):
        read(path, PlacesFile, "direct_path")
    path.write_text(path.read_text().replace("format = 1", "format = 2"))
    with pytest.raises(ConfigError, match="later release"):
        read(path, FilterFile, "hpf")
    path.write_text(path.read_text().replace("format = 2", "format = 1").replace("chirps = 640", 'chirps = "many"'))
    with pytest.raises(ConfigError, match="chirps"):
        read(path, FilterFile, "hpf")


def test_relative_names_count_from_the_rig_file(tmp_path, make_rig):
    import tomli_w

    (tmp_path / "sub").mkdir()
    path = write(filter_file(), tmp_path / "sub" / "calibration")
    table = to_builtins(make_rig())
    table["calibration"] = {"hpf": f"calibration/{path.name}"}
    (tmp_path / "sub" / "rig.toml").write_text(tomli_w.dumps(table))
    rig = load_instrument(tmp_path / "sub" / "rig.toml")
    assert rig.calibration.hpf == str(path)
    assert of_rig(rig).high_pass("RH").corners_hz == (180.5e3, 355.25e3)


def test_without_files_nothing_changes(make_rig):
    rig = make_rig()
    calibration = of_rig(rig)
    assert calibration.rig(rig) is rig
    assert calibration.high_pass("RH") is calibration.reference() is None
    assert calibration.facts() == {}


def test_a_scan_keeps_what_it_was_taken_with(tmp_path, make_rig):
    path = write(filter_file(), tmp_path / "c")
    metal = write_metal(metal_reference(make_rig()), SOURCES, tmp_path / "c")
    rig = named(make_rig, hpf=path, metal=metal)
    scan = create(tmp_path / "scan", rig)
    assert sorted(scan.facts("scan_started")[0]["calibration"]) == ["hpf", "metal"]
    assert not [f for f in validate(scan.path) if f.severity == "error"]
    before = of_scan(scan)
    for old in (tmp_path / "c").iterdir():
        old.unlink()  # what the rig file names is gone; the scan has its own
    again = of_scan(ScanFolder.load(scan.path))
    assert again.filters == before.filters == filter_file_as(before)
    np.testing.assert_array_equal(again.reference().h, before.reference().h)
    assert set(again.facts()) == {"hpf", "metal"}


def test_files_of_one_name_in_two_folders_are_both_kept(tmp_path, make_rig):
    hpf, metal = write(filter_file(), tmp_path / "a"), write_metal(metal_reference(make_rig()), SOURCES, tmp_path / "b")
    metal = metal.rename(metal.with_name("latest.toml"))
    calibration = of_scan(
        create(tmp_path / "s", named(make_rig, hpf=hpf.rename(hpf.with_name("latest.toml")), metal=metal))
    )
    assert set(calibration.facts()) == {"hpf", "metal"}


def test_metal_of_other_pixels_is_refused_before_the_scan_and_not_after(tmp_path, make_rig):
    metal = write_metal(metal_reference(make_rig(image={"pixel_mm": 2.5})), SOURCES, tmp_path / "c")
    with pytest.raises(DataError, match="different pixels"):
        create(tmp_path / "s", named(make_rig, metal=metal))


def filter_file_as(calibration):
    return msgspec.structs.replace(filter_file(), made_utc=calibration.filters.made_utc)


def test_a_copy_that_was_changed_is_noticed(tmp_path, make_rig):
    rig = named(make_rig, hpf=write(filter_file(), tmp_path / "c"))
    scan = create(tmp_path / "scan", rig)
    copy = next((scan.path / "calibration").iterdir())
    copy.write_text(copy.read_text().replace("180.5", "190.5"))
    with pytest.raises(DataError, match="not the calibration"):
        of_scan(scan)
    copy.unlink()
    with pytest.raises(DataError, match="absent"):
        of_scan(scan)


def test_a_scan_that_was_begun_is_not_touched(tmp_path, make_rig):
    first = named(make_rig, hpf=write(filter_file(), tmp_path / "c"))
    scan = create(tmp_path / "scan", first)
    other = named(make_rig, hpf=write(filter_file(200.0), tmp_path / "c"))
    keep_in_scan(other, scan.path, True)
    assert of_scan(scan).high_pass("RH").corners_hz[0] == 180.5e3


def test_a_file_that_is_not_there_is_named_before_anything_is_made(tmp_path, make_rig):
    with pytest.raises(ConfigError, match=r"nowhere\.toml"):
        keep_in_scan(named(make_rig, hpf=tmp_path / "nowhere.toml"), tmp_path / "scan", True)
    assert not (tmp_path / "scan").exists()


def test_a_metal_reference_survives_its_file(tmp_path, make_rig):
    reference = metal_reference(make_rig())
    path = write_metal(reference, SOURCES, tmp_path)
    again = load_calibration({"metal": path}).reference()
    for name in ("h", "v", "valid", "x_m", "y_m"):
        np.testing.assert_array_equal(getattr(again, name), getattr(reference, name))
    assert (again.spread, again.how) == (reference.spread, reference.how)
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".npz", ".toml"]
    assert read(path, MetalFile, "metal").ratio_variation_deg > 1


def test_images_that_were_exchanged_are_noticed(tmp_path, make_rig):
    path = write_metal(metal_reference(make_rig()), SOURCES, tmp_path / "one")
    other = write_metal(metal_reference(make_rig(), 1), SOURCES, tmp_path / "two")
    path.with_suffix(".npz").write_bytes(other.with_suffix(".npz").read_bytes())
    with pytest.raises(DataError, match="not the images"):
        load_calibration({"metal": path}).reference()


def test_a_measured_scan_refuses_what_was_simulated(tmp_path, make_rig):
    rig = named(make_rig, hpf=write(filter_file(), tmp_path / "c"))
    with pytest.raises(ConfigError, match="simulated data"):
        keep_in_scan(rig, tmp_path / "scan", False)
    measured = msgspec.structs.replace(filter_file(), sources=[SourceScan("sweep", "scans/sweep", False, 7)])
    rig = named(make_rig, hpf=write(measured, tmp_path / "c"))
    assert set(keep_in_scan(rig, tmp_path / "scan", False)) == {"hpf"}
