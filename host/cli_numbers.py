"""Numbers on a command line: what is wrong with one is said in words, whether it breaks a rule or is no number."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TypeVar

Number = TypeVar("Number", int, float)


def number(kind: Callable[[str], Number], rule: str, holds: Callable[[Number], bool]) -> Callable[[str], Number]:
    """A `type` for argparse: a number for which `holds` is true; else the error is "... is not `rule`"."""

    def convert(text: str) -> Number:
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not holds(value):
            raise argparse.ArgumentTypeError(f"{text} is not {rule}")
        return value

    return convert


positive = number(float, "a number above 0", lambda value: 0 < value < math.inf)
count = number(int, "a whole number, 1 or more", lambda value: value >= 1)
