"""Laws of flags that have one value everywhere: a value cannot be changed by whom it is handed to, pairs are complete,
a thread holds up no program's end, a file of somebody else is never unpickled.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.house.test_roof import PROJECTS, ROOT

CHANGED_IN_PLACE = {
    "dataclass": {
        "BoardEchoes", "BoardRows", "CardReport", "CardSurvey", "CheckContext", "EventLog", "Manifest", "Maximum",
        "PacketCounts", "PlacesFit", "Report", "RunningJog", "RunningRow", "ScanResult", "Take", "Windows", "_Motion",
        "_Stage",
    },
    "Struct": {"BoardCounts", "BoardFacts", "TraceLine", "_Head"},
}  # fmt: skip
"""Classes whose fields are filled in one after the other, and are read by those who fill them."""

# Name of the function and of its flag, the flag's value, and how many calls have the other one.
FLAGS = [
    # Of three ends two are active; of two libraries one may have more patches; figures with fewer colours than lines.
    ("zip", "strict", True, 7),
    ("Thread", "daemon", True, 0),
    ("Process", "daemon", True, 0),
    ("load", "allow_pickle", False, 0),
    ("dumps", "allow_nan", False, 0),
    ("rmtree", "ignore_errors", True, 0),
    ("unlink", "missing_ok", True, 0),
    ("CDLL", "use_errno", True, 0),
]


def parse_sources() -> Iterator[ast.Module]:
    for folder in ("host", "shared", "pi_controller", "papers"):
        for file in sorted(Path(ROOT, folder, PROJECTS[folder]).rglob("*.py")):
            yield ast.parse(file.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def nodes() -> list[ast.AST]:
    return [node for tree in parse_sources() for node in ast.walk(tree)]


def find_name(called: ast.expr) -> str:
    return called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "")


def find_flag(keywords: list[ast.keyword], name: str) -> object:
    """Value of a flag that is written out; None without one."""
    return next((k.value.value for k in keywords if k.arg == name and isinstance(k.value, ast.Constant)), None)


def test_values_that_are_handed_on_cannot_be_changed(nodes):
    changed = {"dataclass": set(), "Struct": set()}
    for node in nodes:
        if not isinstance(node, ast.ClassDef):
            continue
        for decorator in node.decorator_list:
            called = decorator.func if isinstance(decorator, ast.Call) else decorator
            keywords = decorator.keywords if isinstance(decorator, ast.Call) else []
            if find_name(called) == "dataclass" and find_flag(keywords, "frozen") is not True:
                changed["dataclass"].add(node.name)
        if any(find_name(base) == "Struct" for base in node.bases) and find_flag(node.keywords, "frozen") is not True:
            changed["Struct"].add(node.name)
    assert changed == CHANGED_IN_PLACE


@pytest.mark.parametrize(("function", "flag", "value", "exceptions"), FLAGS, ids=lambda x: str(x))
def test_a_flag_has_its_value_everywhere(function, flag, value, exceptions, nodes):
    calls = [n for n in nodes if isinstance(n, ast.Call) and find_name(n.func) == function]
    values = Counter(find_flag(call.keywords, flag) for call in calls)
    assert values[value] > 0
    assert values[not value] == exceptions
