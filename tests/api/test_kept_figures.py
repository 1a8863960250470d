"""The products of a scan of copper and PET change only on purpose: files, report, figures, exports."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.kept import assert_kept, collect_figures, describe_figures, find_numbers, summarise_array

from polysight.cli.main import main
from polysight.products import read_products
from polysight.report import label_figure, write_report

HERE = Path(__file__).parent
# Edges of patches are those of pixels, versions and times are of the run, texts have other tests.
LEFT_OUT = {
    "outline_mm",
    "raw_crc32",
    "rows_recorded",
    "versions",
    "seconds_per_stage",
    "what",
    "why",
    "do",
    "library",
    "how",
}
# Of noise that rounding leaves.
ABSOLUTE = 1e-5


def strip(value: Any) -> Any:
    """Leave out what is of the run."""
    if isinstance(value, dict):
        return {key: strip(part) for key, part in value.items() if key not in LEFT_OUT}
    if isinstance(value, list):
        return [strip(part) for part in value]
    return value


def test_materials_and_quality_change_only_on_purpose(products):
    files = {name: strip(json.loads((products / f"{name}.json").read_text())) for name in ("materials", "quality")}
    assert_kept(HERE / "kept" / "products.json", files, ABSOLUTE)


def test_arrays_change_only_on_purpose(products):
    arrays = {}
    for name in ("image", "patches"):
        with np.load(products / f"{name}.npz") as content:
            arrays |= {f"{name} {key}": summarise_array(content[key]) for key in content if key != "meta"}
    assert_kept(HERE / "kept" / "arrays.json", arrays, ABSOLUTE)


def test_numbers_and_pictures_of_the_report_change_only_on_purpose(products, tmp_path):
    with collect_figures() as saved:
        scan = read_products(products)
        report = write_report(tmp_path, scan)
        label_figure(scan, {"copper": (-70, -20, -20, 25), "PET": (20, -25, 72, 26)}, "copper")
    html = report.read_text(encoding="utf-8")
    text = re.sub(r"<(style|script|svg)\b.*?</\1>|<[^>]+>", " ", html, flags=re.DOTALL)
    # Without how long the run took, when it was and with which versions.
    shown = re.sub(r"[\d.]+ s\s+of processing|Time by stage.*?Rows, masked", "", text, flags=re.DOTALL)
    shown = shown.partition("Provenance")[0]
    figures = {"numbers": find_numbers(shown), "figures": describe_figures(saved)}
    assert_kept(HERE / "kept" / "report.json", figures, 0.005)


SHEET = ("--layer", "sheet,?,0.5-3", "--layer", "plate,metal")
COVERED = ("--layer", "glass,5.5,0.05,3", "--layer", "liquid,?")
COMMANDS = {
    "plan": ["plan"],
    "plan-minutes": ["plan", "--minutes", "30"],
    "plan-fast": ["plan", "--speed-mm-s", "100", "--pulses", "16", "--period-us", "750"],
    "plan-like": ["plan", "--like", "SCAN"],
    "probe": ["probe", "PRODUCTS", "45,0"],
    "compare": ["compare", "PRODUCTS", "BANDED", "--png", "OUT/difference.png"],
    "materials": ["materials", "PRODUCTS", "--json"],
    "materials-banded": ["materials", "BANDED", "--json"],
    "permittivity": ["permittivity", "PRODUCTS", "--json"],
    "sheet": ["permittivity", "BANDED", "--patch", "2", *SHEET],
    "covered": ["permittivity", "PRODUCTS", "--patch", "2", *COVERED],
    "classify": ["classify", "PRODUCTS", "--json"],
    "classify-knn": ["classify", "PRODUCTS", "--model", "knn"],
    "sync-report": ["sync-report", "SCAN", "--out", "OUT/sync"],
    "focus": ["focus", "SCAN", "--out", "OUT/focus", "--depth", "2"],
    "inspect": ["inspect", "SCAN/raw/RH/0003.bin", "--plot", "OUT/profile.png"],
    "export": ["export", "PRODUCTS", "--csv"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_a_command_prints_and_draws_changes_only_on_purpose(
    name, folder, products, banded, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)
    copied = shutil.copytree(products, tmp_path / "products")
    places = {"SCAN": folder, "PRODUCTS": copied, "BANDED": banded, "OUT": tmp_path}
    words = [re.sub("^[A-Z]+", lambda m: str(places.get(m[0], m[0])), word) for word in COMMANDS[name]]
    with collect_figures() as saved:
        status = main(words)
    printed = capsys.readouterr().out
    for table in tmp_path.rglob("*.csv"):
        printed += table.read_text(encoding="utf-8")
    # A path has numbers of the run.
    shown = re.sub(r"\S*/\S*|[\d.]+ (s|MB|GB)\b", "", printed)
    pictures = describe_figures(saved)
    if name == "sync-report":
        # One of its panels shows what rounding leaves of an amplitude, magnified.
        for picture in pictures:
            picture["axes"] = [axes["texts"] for axes in picture["axes"]]
    figures = {"status": status, "numbers": find_numbers(shown), "figures": pictures}
    assert_kept(HERE / "kept" / f"{name}.json", figures, 0.005 if "--json" in words else 0.02)
