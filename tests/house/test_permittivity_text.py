"""A complex permittivity is written by one function, which knows the sign: nowhere `2.89 - j-27.3`."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from polysight.materials import format_permittivity

ROOT = Path(__file__).parents[2]
TOPS = ("host", "papers", "simulators", "worlds", "benchmarks", "examples", "shared", "pi_controller")
BY_HAND = re.compile(r"[-+−–] ?j\(?$")
OTHERS = re.compile(r"[-+−–] ?j\(?(\$?\{|%)")
WRITER = "host/polysight/materials/measure.py"


def built_by_hand(text: str) -> list[int]:
    """Lines of Python whose f-string puts a number behind `- j`."""
    collected = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.JoinedStr):
            for part, state_after in zip(node.values, node.values[1:], strict=False):
                if isinstance(part, ast.Constant) and isinstance(part.value, str):
                    written = part.value
                else:
                    written = ""
                if isinstance(state_after, ast.FormattedValue) and BY_HAND.search(written):
                    collected.append(node.lineno)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and OTHERS.search(node.value):
            collected.append(node.lineno)
    return collected


def test_no_text_is_built_by_hand():
    past = []
    for top in TOPS:
        for file in (ROOT / top).rglob("*.py"):
            name = str(file.relative_to(ROOT))
            if name != WRITER and "build" not in file.parts:
                past += [f"{name}:{line}" for line in built_by_hand(file.read_text(encoding="utf-8"))]
        for file in (f for suffix in ("js", "html", "ipynb") for f in (ROOT / top).rglob(f"*.{suffix}")):
            past += [str(file.relative_to(ROOT))] if OTHERS.search(file.read_text(encoding="utf-8")) else []
    assert past == [], "use format_permittivity of polysight.materials"


@pytest.mark.parametrize(
    "text", ['f"{e.real:.2f} - j{-e.imag:.2f}"', 'f"- j({a} +- {b})"', '"%.2f - j%.2f" % x', '"{} -j{}".format(1, 2)']
)
def test_the_law_sees_what_it_is_about(text):
    assert built_by_hand(text)
    assert not built_by_hand('f"exp(-j 2 pi {f})"')


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (2.89 - 0.43j, "2.89 - j0.43"),
        (2.89 + 27.3j, "2.89 + j27.30"),
        (4 + 0j, "4.00 - j0.00"),
        (4 + 0.001j, "4.00 - j0.00"),
        (complex(-0.001, -0.0), "0.00 - j0.00"),
        (complex(float("inf"), 0), "inf - j0.00"),
        (complex(float("nan"), float("nan")), "nan - jnan"),
    ],
)
def test_loss_is_minus_gain_is_plus(value, text):
    assert format_permittivity(value) == text


def test_parts_line_up_in_columns():
    assert format_permittivity(2.89 - 0.43j, width=6) == "  2.89 - j0.43"
    assert format_permittivity(2.891 - 0.434j, digits=3) == "2.891 - j0.434"


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_what_is_written_reads_back(real, imag):
    match = re.fullmatch(r"(-?[0-9.]+) ([-+]) j([0-9.]+)", format_permittivity(complex(real, imag)))
    assert match is not None
    assert float(match[1]) == pytest.approx(real, abs=0.006)
    assert float(match[2] + match[3]) == pytest.approx(imag, abs=0.006)
