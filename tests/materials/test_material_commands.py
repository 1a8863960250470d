"""`polysight permittivity`, `polysight concentration` and `polysight classify`, as typed."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.support.paths import RIG_FILE
from tests.support.published_files import write_materials
from tests.support.refusals import refused
from tests.support.rigs import published_rig

from polysight.cli.main import main
from polysight.jobs.materials import report
from polysight.materials import Entry, Library
from polysight.materials.layers import Layer, Spectrum, predict
from polysight_shared.error_codes import ErrorCode

GLASS = Layer("glass", 5.5 - 0.05j, 3e-3)


def products(folder: Path, inverse: complex, std: float = 0.005) -> Path:
    ratio = 1 / inverse
    row = {"label": 3, "name": "liquid", "incidence_deg": 55.0, "metal_reference": False}
    row |= {"ratio": {"real": ratio.real, "imag": ratio.imag}, "inverse_ratio_std": std}
    row |= {"permittivity": {"real": 1.0, "imag": -0.5, "real_std": 0.1, "imag_std": 0.1}}
    folder.mkdir()
    (folder / "materials.json").write_text(json.dumps({"segments": [row]}))
    return folder


def test_water_behind_glass_as_typed(tmp_path, capsys):
    spectrum = Spectrum.from_chirp(published_rig().chirp)
    inverse = complex(predict([GLASS, Layer("water", 9.37 - 18j)], spectrum, np.radians(55.0))[0][0])
    folder = products(tmp_path / "out", inverse)
    layers = ["--layer", "glass,5.5,0.05,3", "--layer", "water,?"]
    arguments = ["permittivity", str(folder), "--config", str(RIG_FILE), *layers]
    assert main([*arguments, "--json"]) == 0
    layer = json.loads(capsys.readouterr().out)[0]["layer"]
    assert layer["permittivity"] == pytest.approx([9.37, 18.0], rel=1e-4)
    assert layer["thickness_mm"] is None
    assert main(arguments) == 0
    assert "in the stack   9.37 - j18.00" in capsys.readouterr().out
    assert main(["permittivity", str(folder), "--patch", "9"]) != 0
    assert "no patch 9" in capsys.readouterr().err


def sugar() -> list[Entry]:
    ones = np.ones(5, np.float32)
    return [
        Entry(
            name=name,
            scan=scan,
            h=ones,
            v=ones,
            p=np.full(5, np.tan(1.2 - percent / 400), np.complex64),
            incidence_deg=55.0,
            simulated=True,
        )
        for name, percent in (("water", 0.0), ("sugar (1.3%)", 1.3), ("sugar (3.8%)", 3.8), ("sugar (7.4%)", 7.4))
        for scan in ("a", "b")
    ]


@pytest.mark.parametrize("form", ["library", "published files"])
def test_concentration_of_a_library_and_of_published_files(tmp_path, capsys, form):
    path = tmp_path / "sugar.npz"
    if form == "library":
        Library(tuple(sugar())).save(path)
    else:
        path = tmp_path / "materials"
        write_materials(path, sugar())
    assert main(["concentration", str(path), "--value", "water=0", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["median_error_percent"] < 1e-3
    assert result["source"] == "simulated"  # in the published form too
    assert main(["concentration", str(path), "--value", "watr=0"]) != 0
    assert "watr" in capsys.readouterr().err
    assert main(["concentration", str(path), "--value", "water=0"]) == 0
    assert "median error" in capsys.readouterr().out


def test_a_report_of_images_alone_says_what_is_missing(tmp_path):
    (tmp_path / "image.npz").touch()
    with refused(ErrorCode.FILE_MISSING, "report.html"):
        report(tmp_path)


def test_classifiers_are_judged_under_both_splits_as_typed(tmp_path, capsys):
    rng = np.random.default_rng(4)

    def entry(scan: int, name: str, q: complex) -> Entry:
        inverse = q + 0.01 * (rng.standard_normal(12) + 1j * rng.standard_normal(12))
        h = (0.7 + 0.01 * rng.standard_normal(12)).astype(np.float32)
        p = (1 / inverse).astype(np.complex64)
        return Entry(name, f"scan {scan}", h, np.abs(h * inverse).astype(np.float32), p, 55.0, simulated=True)

    entries = [entry(i, name, q) for i in range(3) for name, q in (("near", 0.2), ("far", 0.4 + 0.1j))]
    Library(tuple(entries)).save(tmp_path / "two.npz")
    assert main(["classify", str(tmp_path / "two.npz"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["source"] == "simulated"
    assert {s["split"] for s in answer["scores"]} == {"whole scans left out, 3 scans", "by pixel (optimistic)"}
    assert all(s["pixels"] > 0.95 for s in answer["scores"])
    assert np.shape(answer["confusion_of_best"]) == (2, 2)
    assert main(["classify", str(tmp_path / "two.npz")]) == 0
    out = capsys.readouterr().out
    assert out.startswith("simulated: 2 materials, 3 scans")
    assert "whole scans left out" in out
    assert "by pixel (optimistic)" in out
