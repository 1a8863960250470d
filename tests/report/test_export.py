"""What is exported is what was saved: every format is read back by its own library."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from tests.support.products import segments
from tests.support.rigs import rig_table

from polysight.cli.main import main
from polysight.imaging import Images
from polysight.products import write_image, write_json
from polysight.products.files import read_products
from polysight.report import exports as hdf5
from polysight.report.exports import write_hdf5, write_mat


@pytest.fixture
def folder(tmp_path):
    """Products as `polysight process` leaves them, of a small made-up image."""
    rng = np.random.default_rng(7)
    h, v = (rng.standard_normal((2, 5, 7)) + 1j * rng.standard_normal((2, 5, 7))).astype(np.complex64)
    valid = rng.uniform(size=(5, 7)) < 0.8
    x, y = np.linspace(-0.1, 0.1, 7), np.linspace(0.05, 0.15, 5)
    made = tmp_path / "one"
    write_image(made / "image.npz", Images(h, v, x, y, valid, h / v))
    write_json(made / "materials.json", {"scan_id": "s", "simulated": True, "segments": segments("good")})
    write_json(made / "quality.json", {"boards": {"RH": {"frames_expected": 7}}})
    rig = rig_table()
    versions = {"polysight": "0.1.0", "numpy": np.__version__}
    write_json(made / "scan.json", {"scan_id": "s", "simulated": True, "versions": versions, "instrument": rig})
    return made


def test_hdf5_shows_the_images_by_nexus_classes(folder):
    """What a NeXus reader follows: `default` from the root to a group whose `signal` and `axes` are in it."""
    products = read_products(folder)
    write_hdf5(folder / "image.h5", products)
    with h5py.File(folder / "image.h5") as f:
        entry = f[f.attrs["default"]]
        data = entry[entry.attrs["default"]]
        assert [x.attrs["NX_class"] for x in (f, entry, data)] == ["NXroot", "NXentry", "NXdata"]
        assert (data[data.attrs["signal"]][:] == products.p).all()
        assert data[data.attrs["signal"]].shape == tuple(data[axis].size for axis in data.attrs["axes"])
        assert all((data[name][:] == getattr(products, name)).all() for name in data.attrs["auxiliary_signals"])


def same_arrays(found, products):
    for name in ("h", "v", "p", "valid"):
        assert (np.asarray(found(name)) == getattr(products, name)).all()
        assert np.asarray(found(name)).dtype.kind == getattr(products, name).dtype.kind


def test_hdf5_round_trip(folder, tmp_path):
    products = read_products(folder)
    write_hdf5(tmp_path / "image.h5", products)
    with h5py.File(tmp_path / "image.h5") as f:
        same_arrays(lambda name: f[name][()], products)
        for name in ("h", "v", "p", "valid"):
            scales = [f[name].dims[i][0] for i in (0, 1)]
            assert [f[name].dims[i].label for i in (0, 1)] == ["y", "x"]
            assert (scales[0][()] == products.y_m).all()
            assert (scales[1][()] == products.x_m).all()
            assert all(s.is_scale and s.attrs["units"] == "m" for s in scales)
        assert f.attrs["scan_id"] == "s"
        assert bool(f.attrs["simulated"]) is True
        assert json.loads(f.attrs["config"]) == products.scan["instrument"]
        assert json.loads(f.attrs["versions"]) == products.scan["versions"]
        documents = {name: json.loads(f[f"documents/{name}"][()]) for name in ("quality", "materials", "scan")}
        expected = {"quality": products.quality, "materials": products.materials, "scan": products.scan}
        assert documents == expected
        assert f["materials/p_phase_deg"].attrs["units"] == "degree"
        assert f["materials/permittivity_real"].attrs["units"] == "1"


def test_matlab_round_trip(folder, tmp_path):
    products = read_products(folder)
    write_mat(tmp_path / "image.mat", products)
    found = scipy.io.loadmat(tmp_path / "image.mat", simplify_cells=True)
    same_arrays(lambda name: found[name].astype(getattr(products, name).dtype), products)
    assert np.array_equal(found["x_m"], products.x_m)
    assert np.array_equal(found["y_m"], products.y_m)
    config = found["config"]
    assert config["chirp"]["start_hz"] == products.scan["instrument"]["chirp"]["start_hz"]
    assert list(config["boards"][1]["mount"][0]["shift_mm"]) == [15.837, -3.35, 0.0]
    assert found["versions"]["polysight"] == "0.1.0"
    assert json.loads(found["materials_json"]) == products.materials
    assert bool(found["simulated"]) is True


def test_images_without_materials_export_too(folder, tmp_path):
    for name in ("materials.json", "quality.json", "scan.json"):
        (folder / name).unlink()
    products = read_products(folder)
    assert products.simulated is None
    write_hdf5(tmp_path / "image.h5", products)
    write_mat(tmp_path / "image.mat", products)
    with h5py.File(tmp_path / "image.h5") as f:
        assert f["materials/permittivity_real"].shape == (0,)
        assert "simulated" not in f.attrs
    assert np.array_equal(scipy.io.loadmat(tmp_path / "image.mat")["h"], products.h)


def test_the_command_writes_what_is_asked_for(folder, capsys):
    assert main(["export", str(folder), "--hdf5", "--mat", "--csv"]) == 0
    named = capsys.readouterr().out.split()
    assert sorted(Path(p).name for p in named) == ["image.h5", "image.mat", "materials.csv"]
    assert all(Path(p).exists() and Path(p).parent == folder.parent / "one-export" for p in named)
    assert sorted(p.name for p in folder.iterdir()) == ["image.npz", "materials.json", "quality.json", "scan.json"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [(["--hdf5"], "image.npz"), ([], "--hdf5")],
)
def test_what_cannot_be_exported_is_said(tmp_path, capsys, arguments, words):
    assert main(["export", str(tmp_path), *arguments]) != 0
    assert words in capsys.readouterr().err


def test_without_h5py_the_message_names_the_extra(folder, tmp_path, monkeypatch, capsys):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(hdf5, "import_module", absent)
    assert main(["export", str(folder), "--hdf5", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "pip install 'polysight[export]'" in said
    assert not list((tmp_path / "out").iterdir())


def test_a_scan_folder_stands_for_its_products(folder):
    scan = folder.parent / "scan"
    scan.mkdir()
    folder.rename(scan / "products")
    assert read_products(scan).folder == scan / "products"
