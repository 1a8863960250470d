"""Permittivities are fitted with the rig of the products, and not with that of the rig file in the current folder.

Damaged and missing products, and a full disk, are reported with their paths.
"""

import errno
import json
import os
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest
import tomli_w
from tests.support.paths import RIG_FILE
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.cli.main import main
from polysight.imaging import Images, sub_bands
from polysight.materials import parse_layer
from polysight.materials.layers import Layer, Spectrum, predict
from polysight.products import MATERIALS, ProcessedScan, read_products, rx_gains, write_json
from polysight_shared.errors import DataError, ErrorCode, convert_os_error
from polysight_shared.files import write_atomically
from polysight_shared.tables import to_builtins

# The rig of the rig file in the current folder.
HERE = load_published_rig()
# The rig of the scan: another slope, and another window of the samples.
USED = msgspec.structs.replace(
    HERE, chirp=msgspec.structs.replace(HERE.chirp, slope_hz_per_s=HERE.chirp.slope_hz_per_s * 0.4, adc_start_us=9.0)
)
# About that of water at these frequencies.
WATER = 9.4 - 18j
# Layers as the command takes them: name, real part, loss and thickness in mm of glass; the permittivity of water is
# to be found.
STACK = ["glass,5.5,0.05,3", "water,?"]
ANGLE_DEG = 55.0
# The products have no noise: the fitted permittivity is within this of the truth. With a wrong chirp it is wrong by
# more than 1.
FIT_ERROR = 1e-2


def make_ratio_entry(inverse: complex) -> dict:
    """The ratio P = H / V in materials.json, from its inverse, and the error of the inverse."""
    ratio = 1 / inverse
    return {"ratio": {"real": ratio.real, "imag": ratio.imag}, "inverse_ratio_std": 0.005}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Products of water behind glass, measured with USED; the current folder has the published rig file."""
    layers = [parse_layer(STACK[0]), Layer("water", WATER)]
    whole_band = predict(layers, Spectrum.from_chirp(USED.chirp, 1), np.radians(ANGLE_DEG))[0]
    parts = predict(layers, Spectrum.from_chirp(USED.chirp, 3), np.radians(ANGLE_DEG))[0]
    bands = [
        make_ratio_entry(complex(q)) | {"first_hz": b.first_hz, "last_hz": b.last_hz}
        for q, b in zip(parts, sub_bands(USED.chirp, 3), strict=True)
    ]
    row = {"label": 3, "name": "liquid", "incidence_deg": ANGLE_DEG, "permittivity": None, "bands": bands}
    made_folder = tmp_path / "made"
    write_json(made_folder / "materials.json", {"segments": [row | make_ratio_entry(complex(whole_band[0]))]})
    write_json(made_folder / "scan.json", {"scan_id": "s", "simulated": True, "instrument": to_builtins(USED)})
    shutil.copy(RIG_FILE, tmp_path / "instrument.toml")
    monkeypatch.chdir(tmp_path)
    return made_folder


def fit_water(capsys, *arguments: object) -> complex:
    """The permittivity of water that the command finds with these arguments."""
    layers = [word for layer in STACK for word in ("--layer", layer)]
    assert main(["permittivity", *map(str, arguments), *layers, "--json"]) == 0
    real, loss = json.loads(capsys.readouterr().out)[0]["layer"]["permittivity"]
    return complex(real, -loss)


@pytest.mark.parametrize("bands", [1, 3])
def test_permittivity_is_computed_with_the_chirp_of_the_products(folder, capsys, bands):
    assert abs(fit_water(capsys, folder, "--bands", bands) - WATER) < FIT_ERROR


def test_a_rig_file_may_replace_the_chirp_unless_sub_bands_contradict_it(folder, capsys):
    Path("used.toml").write_text(tomli_w.dumps(to_builtins(USED)))
    assert abs(fit_water(capsys, folder, "--config", "used.toml") - WATER) < FIT_ERROR
    arguments = ["permittivity", str(folder), "--config", "instrument.toml", "--layer", "water,?"]
    for bands in ("1", "3"):
        assert main([*arguments, "--bands", bands]) == DataError.exit_status
        message = capsys.readouterr().err
        assert "patch 3" in message
        assert "instrument.toml" in message
    # Without sub-bands nothing contradicts the wrong chirp, and the permittivity found with it is wrong.
    materials = json.loads((folder / MATERIALS).read_text())
    del materials["segments"][0]["bands"]
    write_json(folder / MATERIALS, materials)
    assert abs(fit_water(capsys, folder, "--config", "instrument.toml") - WATER) > 1


def test_a_missing_chirp_is_not_guessed(folder, capsys):
    (folder / "scan.json").unlink()
    arguments = ["permittivity", str(folder)]
    assert main([*arguments, "--layer", "water,?"]) == DataError.exit_status
    assert "--config" in capsys.readouterr().err
    assert main(arguments) == 0, "a single interface needs no chirp: it reflects all frequencies alike"


def test_a_scan_folder_may_be_given_for_its_products(folder, tmp_path, capsys):
    scan = tmp_path / "scan"
    scan.mkdir()
    folder.rename(scan / "products")
    assert abs(fit_water(capsys, scan) - WATER) < FIT_ERROR


@pytest.mark.parametrize("name", ["materials.json", "scan.json"])
@pytest.mark.parametrize("content", [b"half of i", b"[1, 2]", b'{"segments": 3, "instrument": {"chirp": 7}}'])
def test_damaged_products_are_named(folder, capsys, name, content):
    (folder / name).write_bytes(content)
    assert main(["permittivity", str(folder), "--layer", "water,?"]) == DataError.exit_status
    assert name in capsys.readouterr().err


def test_missing_products_are_named(tmp_path):
    with expect_refusal(ErrorCode.FILE_MISSING, tmp_path, MATERIALS):
        read_products(tmp_path, MATERIALS)
    assert ProcessedScan(tmp_path).materials is None
    assert ProcessedScan(tmp_path).rig is None


def test_a_full_disk_is_reported_with_the_path(tmp_path, monkeypatch):
    def fail_as_a_full_disk_does(_fd: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail_as_a_full_disk_does)
    with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)) as caught:
        write_atomically(tmp_path / "image.npz", b"1")
    assert caught.value.errno == errno.ENOSPC
    assert str(tmp_path) in str(convert_os_error(caught.value))


def test_gains_are_relative_to_each_boards_first_rx():
    """In decibels and degrees, from complex gains."""
    dark_pixel = np.zeros((1, 1), np.complex64)
    axis = np.zeros(1)
    gains = {
        "RH": np.array([2.0, 20.0, 2.0j, -0.2], np.complex128),
        "RV": np.array([5j, 5j], np.complex128),
    }
    images = Images(h=dark_pixel, v=dark_pixel, x_m=axis, y_m=axis, valid=np.ones((1, 1), bool), rx_gains=gains)
    gains_read = {name: [(g.gain_db, g.phase_deg) for g in board] for name, board in rx_gains(images).items()}
    assert gains_read["RH"] == [pytest.approx(g) for g in ((0.0, 0.0), (20.0, 0.0), (0.0, 90.0), (-20.0, 180.0))]
    assert gains_read["RV"] == [pytest.approx((0.0, 0.0))] * 2
