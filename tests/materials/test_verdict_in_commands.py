"""The commands `polysight materials`, `permittivity`, `report` and `classify` with judged products."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from tests.support.products import NAMES, PERMITTIVITY, REASON, write_judged_products

from polysight.cli.main import main
from polysight.materials import PATCHES_FILE
from polysight.materials.patch_files import PATCHES_FORMAT
from polysight.results import NoResult
from polysight.results.verdict import LEVELS

# Numbers of the products that must not be printed without a result: real part, loss and ratio.
NUMBERS = ("2.9", "0.2", "3.0")


def write_products_with_pixels(folder: Path) -> Path:
    """Add the patches.npz that `classify` needs: three patches of four pixels of the simulated library's PET."""
    labels = (1, 2, 3)
    pixels_of_a_patch = 4
    patches = [
        {"label": label, "centre_mm": [30.0 * label, 0.0], "truth": None, "pixels": pixels_of_a_patch}
        for label in labels
    ]
    # The pixels of a patch lie in a line, 1 mm apart.
    places = np.array([[30.0 * label + pixel, 0.0] for label in labels for pixel in range(pixels_of_a_patch)])
    # Features of a pixel: |H|, |V|, real and imaginary part of V / H. All pixels have the same.
    features = np.tile([0.5, 0.15, 0.3, 0.05], (len(places), 1))
    meta = {"format": PATCHES_FORMAT, "angle_deg": 55.0, "simulated": True, "patches": patches}
    out = io.BytesIO()
    np.savez_compressed(
        out,
        meta=np.frombuffer(json.dumps(meta).encode(), np.uint8),
        places_mm=places.astype(np.float32),
        features=features.astype(np.float32),
    )
    (folder / PATCHES_FILE).write_bytes(out.getvalue())
    return folder


@pytest.mark.parametrize("command", ["materials", "permittivity"])
@pytest.mark.parametrize("level", LEVELS)
def test_the_verdict_comes_first_and_decides_the_exit_status(tmp_path, capsys, command, level):
    folder = str(write_judged_products(tmp_path, level, keep_withheld=True))
    status = main([command, folder])
    out = capsys.readouterr().out
    assert status == (NoResult.exit_status if level == "none" else 0)
    assert f"verdict:  {LEVELS[level]}" in out
    if level != "good":
        assert REASON["do"] in out
    if level == "none":
        # Neither names nor numbers are printed, although the products of this test contain them.
        assert [word for word in (*NAMES, *NUMBERS) if word in out] == []
        return
    line = next(text for text in out.splitlines() if "PET" in text)
    assert out.index("verdict:") < out.index(line)
    assert "2.90 - j0.20" in line
    assert "+- 0.20, 0.10  mostly leakage" in line
    assert "not judged" in out
    assert "noise: its pixels do not agree; look at the image" in out


@pytest.mark.parametrize("command", ["materials", "permittivity"])
def test_json_without_a_result_is_printed_with_nulls(tmp_path, capsys, command):
    folder = str(write_judged_products(tmp_path, "none", keep_withheld=True))
    assert main([command, folder, "--json"]) == NoResult.exit_status
    out = capsys.readouterr().out
    assert [word for word in NAMES if word in out] == []
    content = json.loads(out)
    if command == "materials":
        assert content[0]["verdict"]["level"] == "none"
        for segment in content[0]["segments"]:
            assert segment["name"] is None
            assert segment["permittivity"] is None
            assert segment["ratio"] is None
    else:
        for patch in content:
            assert patch["name"] is None
            assert patch["single_interface"] is None


def test_no_layer_is_fitted_without_a_result(tmp_path, capsys):
    folder = write_judged_products(tmp_path, "none", keep_withheld=True)
    status = main(["permittivity", str(folder), "--layer", "sheet,?,0.5"])
    answer = capsys.readouterr()
    assert status == NoResult.exit_status
    assert answer.out == ""
    assert REASON["what"] in answer.err


@pytest.mark.parametrize("level", LEVELS)
def test_report_prints_the_verdict_and_the_path_of_the_page(tmp_path, capsys, level):
    folder = write_judged_products(tmp_path, level)
    (folder / "report.html").write_text("<html>", encoding="utf-8")
    assert main(["report", str(folder)]) == (NoResult.exit_status if level == "none" else 0)
    out = capsys.readouterr().out
    assert out.startswith(f"verdict:  {LEVELS[level]}")
    assert "report.html" in out


@pytest.mark.parametrize("as_json", [False, True])
def test_classify_names_nothing_without_a_result_and_no_refused_patch(tmp_path, capsys, as_json):
    options = ["--json"] if as_json else []
    without_result = write_products_with_pixels(write_judged_products(tmp_path / "none", "none"))
    good_products = write_products_with_pixels(write_judged_products(tmp_path / "good", "good"))
    assert main(["classify", str(without_result), *options]) == NoResult.exit_status
    out = capsys.readouterr().out
    if as_json:
        for patch in json.loads(out)["patches"]:
            assert patch["name"] is None
            assert patch["confidence"] is None
    else:
        assert "pixels:" not in out
    assert main(["classify", str(good_products), *options]) == 0
    out = capsys.readouterr().out
    if as_json:
        # Patch 1 is the metal reference.
        answer = json.loads(out)
        assert [p["label"] for p in answer["patches"]] == [2]
        assert [p["label"] for p in answer["refused"]] == [3]
    else:
        assert "3  not judged: noise" in out


def test_products_of_earlier_releases_print_no_verdict(tmp_path, capsys):
    folder = str(write_judged_products(tmp_path, level=None))
    for command in ("materials", "permittivity"):
        assert main([command, folder]) == 0
        out = capsys.readouterr().out
        assert "verdict" not in out
        assert "2.90 - j0.20" in out
        assert "+- 0.20, 0.10" in out


def test_the_numbers_looked_for_are_those_of_the_products():
    """Without this, the tests above could look for numbers that no command would ever print."""
    assert PERMITTIVITY["real"] == 2.9
