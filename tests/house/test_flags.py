"""Flags in the source that have the same value in every call or class: `frozen`, `strict`, `daemon` and others.

With these values a function cannot change a record that was passed to it, `zip` drops no items, no thread keeps a
program from ending, and no file from outside is unpickled. Few other tests would notice a single wrong flag.
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.house.test_roof import PROJECTS, ROOT

# Classes that are not frozen, by kind. Their fields are filled in one after another, by the code that reads them.
MUTABLE_CLASSES = {
    "dataclass": {
        "BoardEchoes", "BoardRows", "CardReport", "CardSurvey", "CheckContext", "EventLog", "Manifest", "Maximum",
        "PacketCounts", "PlacesFit", "Report", "RunningJog", "RunningRow", "ScanResult", "Take", "Windows", "_Motion",
        "_Stage",
    },
    "Struct": {"BoardCounts", "BoardFacts", "TraceLine", "_Head"},
}  # fmt: skip

# Function, its flag, the value of the flag, and the number of calls with the opposite value.
FLAGS = [
    # Seven calls may drop items on purpose. For example, one of two libraries may have more patches than the other.
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


def find_name(expression: ast.expr) -> str:
    """Last name of an expression such as `zip` or `np.load`; "" for any other expression."""
    if isinstance(expression, ast.Attribute):
        return expression.attr
    if isinstance(expression, ast.Name):
        return expression.id
    return ""


def find_flag(keywords: list[ast.keyword], name: str) -> object:
    """Value of the keyword argument `name` if it is a constant, else None."""
    for keyword in keywords:
        if keyword.arg == name and isinstance(keyword.value, ast.Constant):
            return keyword.value.value
    return None


def test_every_class_is_frozen_except_those_that_are_listed(nodes):
    mutable = {"dataclass": set(), "Struct": set()}
    for node in nodes:
        if not isinstance(node, ast.ClassDef):
            continue
        for decorator in node.decorator_list:
            is_call = isinstance(decorator, ast.Call)
            decorator_name = find_name(decorator.func if is_call else decorator)
            keywords = decorator.keywords if is_call else []
            if decorator_name == "dataclass" and find_flag(keywords, "frozen") is not True:
                mutable["dataclass"].add(node.name)
        is_struct = any(find_name(base) == "Struct" for base in node.bases)
        if is_struct and find_flag(node.keywords, "frozen") is not True:
            mutable["Struct"].add(node.name)
    assert mutable == MUTABLE_CLASSES


@pytest.mark.parametrize(("function", "flag", "value", "exceptions"), FLAGS, ids=str)
def test_a_flag_has_the_same_value_in_every_call_with_few_exceptions(function, flag, value, exceptions, nodes):
    calls = [n for n in nodes if isinstance(n, ast.Call) and find_name(n.func) == function]
    values = Counter(find_flag(call.keywords, flag) for call in calls)
    assert values[value] > 0
    assert values[not value] == exceptions
