"""Every parameter and result of the public interface has a type, and none of them is `Any` without a reason."""

import inspect
import re
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, get_overloads

import pytest

import polysight

# Functions in whose types `Any` may be, and the reason.
ANY_ALLOWED = {
    "Library.__init__": "the parameter `fit` is any JSON object",
    "Library.fit_for": "returns any JSON object",
    "PaperKNeighborsClassifier.kneighbors": "has the types of scikit-learn's method",
    "PaperKNeighborsClassifier.metric": "has the types of scikit-learn's attribute",
}


def list_functions(cls: type) -> Iterator[tuple[str, Callable[..., Any]]]:
    """Constructor, public methods and getters of properties of a class, without those of a base of another project."""
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
    """Name and function for all functions and methods of `polysight`; overloads are separate functions."""
    for name in polysight.__all__:
        value = getattr(polysight, name)
        if inspect.isclass(value):
            yield from list_functions(value)
        elif callable(value):
            for overload in get_overloads(value) or [value]:
                yield name, overload


def list_cases() -> list[Any]:
    return [pytest.param(name, f, id=name) for name, f in list_public_functions() if name not in ANY_ALLOWED]


@pytest.mark.parametrize(("name", "function"), list_cases())
def test_every_parameter_and_result_has_a_specific_type(name, function):
    signature = inspect.signature(function)
    types = {p.name: p.annotation for p in signature.parameters.values() if p.name not in ("self", "cls")}
    if not name.endswith(".__init__"):
        types["result"] = signature.return_annotation
    for parameter, annotation in types.items():
        assert annotation is not inspect.Parameter.empty, f"{name}: {parameter}"
        # `NDArray[Any]`, an array of numbers of any kind, is specific enough.
        text = str(annotation).replace("NDArray[Any]", "NDArray")
        assert not re.search(r"\bAny\b", text), f"{name}: {parameter}: {annotation}"
