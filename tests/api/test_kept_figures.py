"""The images of a scan of copper and PET, and what commands say of its signals and plans, change only on purpose.

Figures that depend on drawn samples of a posterior are left out: rounding may change them.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from tests.support.kept import assert_kept, collect_figures, describe_figures, find_numbers, summarise_array

from polysight.cli.main import main

HERE = Path(__file__).parent
# Of noise that rounding leaves.
ABSOLUTE = 1e-5


def test_images_change_only_on_purpose(products):
    with np.load(products / "image.npz") as content:
        arrays = {f"image {key}": summarise_array(content[key]) for key in content if key != "meta"}
    assert_kept(HERE / "kept" / "arrays.json", arrays, ABSOLUTE)


COMMANDS = {
    "plan": ["plan"],
    "plan-minutes": ["plan", "--minutes", "30"],
    "plan-fast": ["plan", "--speed-mm-s", "100", "--pulses", "16", "--period-us", "750"],
    "plan-like": ["plan", "--like", "SCAN"],
    "sync-report": ["sync-report", "SCAN", "--out", "OUT/sync"],
    "focus": ["focus", "SCAN", "--out", "OUT/focus", "--depth", "2"],
    "inspect": ["inspect", "SCAN/raw/RH/0003.bin", "--plot", "OUT/profile.png"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_a_command_prints_and_draws_changes_only_on_purpose(name, folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)
    places = {"SCAN": folder, "OUT": tmp_path}
    words = [re.sub("^[A-Z]+", lambda m: str(places.get(m[0], m[0])), word) for word in COMMANDS[name]]
    with collect_figures() as saved:
        status = main(words)
    printed = capsys.readouterr().out
    for table in tmp_path.rglob("*.csv"):
        printed += table.read_text(encoding="utf-8")
    # A path has numbers of the run.
    text_without_paths = re.sub(r"\S*/\S*|[\d.]+ (s|MB|GB)\b", "", printed)
    pictures = describe_figures(saved)
    if name == "sync-report":
        # One of its panels shows what rounding leaves of an amplitude, magnified.
        for picture in pictures:
            picture["axes"] = [axes["texts"] for axes in picture["axes"]]
    figures = {"status": status, "numbers": find_numbers(text_without_paths), "figures": pictures}
    assert_kept(HERE / "kept" / f"{name}.json", figures, 0.02)
