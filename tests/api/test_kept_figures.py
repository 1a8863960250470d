"""Images of a scan of copper and PET, and the numbers that commands print of it, equal those in files (`kept`).

So they do not change without notice; tests/support/kept.py says how to accept a new number. Numbers that depend on
random samples are not compared, because rounding may change which samples are drawn.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from tests.support.kept import assert_kept, collect_figures, describe_figures, find_numbers, summarise_array

from polysight.cli.main import main

KEPT = Path(__file__).parent / "kept"
# Absolute tolerances for numbers near 0, for which the relative one of `assert_kept` is too strict: of pixels (|H| of
# metal is 1), and of numbers that are printed or drawn.
PIXEL_TOLERANCE = 1e-5
OUTPUT_TOLERANCE = 0.02


def test_images_equal_the_kept_ones(products):
    with np.load(products / "image.npz") as content:
        arrays = {f"image {key}": summarise_array(content[key]) for key in content if key != "meta"}
    assert_kept(KEPT / "arrays.json", arrays, absolute=PIXEL_TOLERANCE)


# Arguments of commands, with `scan` and `out` for the paths of the scan and of the output folder
COMMANDS = {
    "plan": ["plan"],
    "plan-minutes": ["plan", "--minutes", "30"],
    "plan-fast": ["plan", "--speed-mm-s", "100", "--pulses", "16", "--period-us", "750"],
    "plan-like": ["plan", "--like", "{scan}"],
    "sync-report": ["sync-report", "{scan}", "--out", "{out}/sync"],
    "focus": ["focus", "{scan}", "--out", "{out}/focus", "--depth", "2"],
    "inspect": ["inspect", "{scan}/raw/RH/0003.bin", "--plot", "{out}/profile.png"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_the_numbers_and_pictures_of_a_command_equal_the_kept_ones(name, folder, tmp_path, capsys, monkeypatch):
    # A terminal wide enough that no line is wrapped
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.chdir(tmp_path)
    words = [word.format(scan=folder, out=tmp_path) for word in COMMANDS[name]]
    with collect_figures() as saved:
        status = main(words)
    printed = capsys.readouterr().out
    for table in tmp_path.rglob("*.csv"):
        printed += table.read_text(encoding="utf-8")
    # Paths, durations and amounts of memory differ from run to run.
    comparable_text = re.sub(r"\S*/\S*|[\d.]+ (s|MB|GB)\b", "", printed)
    pictures = describe_figures(saved)
    if name == "sync-report":
        # One panel magnifies the rounding errors of an amplitude, so only the texts of panels are compared.
        for picture in pictures:
            picture["axes"] = [axes["texts"] for axes in picture["axes"]]
    figures = {"status": status, "numbers": find_numbers(comparable_text), "figures": pictures}
    assert_kept(KEPT / f"{name}.json", figures, absolute=OUTPUT_TOLERANCE)
