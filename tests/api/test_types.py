"""Types of the public interface: every parameter and result has one that is not `Any` without reason."""

import inspect
import re
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, get_overloads

import pytest

import polysight

NOT_TYPED = {
    "Library.__init__": "its fit is as JSON has it",
    "Library.fit_for": "as JSON has it",
    "PaperKNeighborsClassifier.kneighbors": "scikit-learn's",
    "PaperKNeighborsClassifier.metric": "scikit-learn's",
}
"""Names whose type may be `Any`, and the reason."""


def list_functions(cls: type) -> Iterator[tuple[str, Callable[..., Any]]]:
    """Public functions of a class that this project wrote, its constructor and the getters of its properties."""
    for owner in cls.__mro__:
        if not owner.__module__.startswith("polysight"):
            continue
        for name, member in vars(owner).items():
            if name.startswith("_") and name != "__init__":
                continue
            if isinstance(member, property):
                member = member.fget
            elif isinstance(member, cached_property):
                member = member.func
            elif isinstance(member, classmethod | staticmethod):
                member = member.__func__
            if inspect.isfunction(member):
                yield f"{cls.__name__}.{name}", member


def list_public_functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Functions and methods behind the names of `polysight`, each overload by itself."""
    for name in polysight.__all__:
        value = getattr(polysight, name)
        if inspect.isclass(value):
            yield from list_functions(value)
        elif callable(value):
            for overload in get_overloads(value) or [value]:
                yield name, overload


@pytest.mark.parametrize(
    ("name", "function"), [pytest.param(*f, id=f[0]) for f in list_public_functions() if f[0] not in NOT_TYPED]
)
def test_every_parameter_and_result_has_a_specific_type(name, function):
    signature = inspect.signature(function)
    types = {p.name: p.annotation for p in signature.parameters.values() if p.name not in ("self", "cls")}
    if not name.endswith(".__init__"):
        types["result"] = signature.return_annotation
    for parameter, annotation in types.items():
        assert annotation is not inspect.Parameter.empty, f"{name}: {parameter}"
        # An array of any numbers is typed.
        text = re.sub(r"NDArray\[Any\]", "NDArray", str(annotation))
        assert not re.search(r"\bAny\b", text), f"{name}: {parameter}: {annotation}"
