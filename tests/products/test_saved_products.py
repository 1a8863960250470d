"""What programs read back from products is what they were made with, not what lies in the current folder."""

from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest
import tomli_w

from polysight.host.cli.main import main
from polysight.host.imaging.images import sub_bands
from polysight.host.materials import parse_layer
from polysight.host.materials.layers import Layer, Spectrum, predict
from polysight.host.products import write_json
from polysight.host.products.files import MATERIALS, SavedProducts, read_products, write_atomically
from polysight.shared.errors import DataError, os_error
from polysight.shared.tables import to_builtins
from tests.support.paths import RIG_FILE
from tests.support.rigs import published_rig

HERE = published_rig()  # the rig file in the current folder
USED = msgspec.structs.replace(  # the one the scan was made with: another slope, another window
    HERE, chirp=msgspec.structs.replace(HERE.chirp, slope_hz_per_s=HERE.chirp.slope_hz_per_s * 0.4, adc_start_us=9.0)
)
WATER, STACK = 9.4 - 18j, ["glass,5.5,0.05,3", "water,?"]
ANGLE_DEG = 55.0


def part_of(inverse: complex) -> dict:
    ratio = 1 / inverse
    return {"ratio": {"real": ratio.real, "imag": ratio.imag}, "inverse_ratio_std": 0.005}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Products of water behind glass, seen with USED; the current folder has the published rig file."""
    layers = [parse_layer(STACK[0]), Layer("water", WATER)]
    whole, parts = (predict(layers, Spectrum.of(USED.chirp, n), np.radians(ANGLE_DEG))[0] for n in (1, 3))
    bands = [
        part_of(complex(q)) | {"first_hz": b.first_hz, "last_hz": b.last_hz}
        for q, b in zip(parts, sub_bands(USED.chirp, 3), strict=True)
    ]
    row = {"label": 3, "name": "liquid", "incidence_deg": ANGLE_DEG, "permittivity": None, "bands": bands}
    made = tmp_path / "made"
    write_json(made / "materials.json", {"segments": [row | part_of(complex(whole[0]))]})
    write_json(made / "scan.json", {"scan_id": "s", "simulated": True, "instrument": to_builtins(USED)})
    shutil.copy(RIG_FILE, tmp_path / "instrument.toml")
    monkeypatch.chdir(tmp_path)
    return made


def found(capsys, *arguments: object) -> complex:
    layers = [word for layer in STACK for word in ("--layer", layer)]
    assert main(["permittivity", *map(str, arguments), *layers, "--json"]) == 0
    real, loss = json.loads(capsys.readouterr().out)[0]["layer"]["permittivity"]
    return complex(real, -loss)


@pytest.mark.parametrize("bands", [1, 3])
def test_permittivity_is_that_of_the_chirp_the_products_were_made_with(folder, capsys, bands):
    assert abs(found(capsys, folder, "--bands", bands) - WATER) < 1e-2


def test_a_rig_file_may_replace_the_chirp_but_not_against_the_sub_bands(folder, capsys):
    Path("used.toml").write_text(tomli_w.dumps(to_builtins(USED)))
    assert abs(found(capsys, folder, "--config", "used.toml") - WATER) < 1e-2
    arguments = ["permittivity", str(folder), "--config", "instrument.toml", "--layer", "water,?"]
    for bands in ("1", "3"):
        assert main([*arguments, "--bands", bands]) == DataError.exit_status
        said = capsys.readouterr().err
        assert "segment 3 was imaged from" in said
        assert "instrument.toml" in said
    materials = json.loads((folder / MATERIALS).read_text())
    del materials["segments"][0]["bands"]  # nothing tells of another chirp: whoever gives one is believed
    write_json(folder / MATERIALS, materials)
    assert abs(found(capsys, folder, "--config", "instrument.toml") - WATER) > 1


def test_without_a_word_on_the_chirp_none_is_guessed(folder, capsys):
    (folder / "scan.json").unlink()
    arguments = ["permittivity", str(folder)]
    assert main([*arguments, "--layer", "water,?"]) == DataError.exit_status
    assert "--config FILE" in capsys.readouterr().err
    assert main(arguments) == 0, "one interface needs no chirp"


def test_a_scan_folder_stands_for_its_products(folder, tmp_path, capsys):
    scan = tmp_path / "scan"
    scan.mkdir()
    folder.rename(scan / "products")
    assert abs(found(capsys, scan) - WATER) < 1e-2


@pytest.mark.parametrize("name", ["materials.json", "scan.json"])
@pytest.mark.parametrize("content", [b"half of i", b"[1, 2]", b'{"segments": 3, "instrument": {"chirp": 7}}'])
def test_damaged_products_are_named(folder, capsys, name, content):
    (folder / name).write_bytes(content)
    assert main(["permittivity", str(folder), "--layer", "water,?"]) == DataError.exit_status
    assert f"{name}: cannot be read" in capsys.readouterr().err


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(DataError, match=r"no materials\.json") as e:
        read_products(tmp_path, MATERIALS)
    assert "polysight process" in e.value.remedy
    assert SavedProducts(tmp_path).materials == {}
    assert SavedProducts(tmp_path).chirp is None


def test_a_full_disk_is_told_with_the_path(tmp_path, monkeypatch):
    def full(_fd: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space") as e:
        write_atomically(tmp_path / "image.npz", b"1")
    assert str(tmp_path) in str(os_error(e.value))
