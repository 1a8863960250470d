"""What the tables of the rig file are made of."""

from __future__ import annotations

from typing import Annotated

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the rig file: frozen, unknown keys refused."""


def require(ok: bool, rule: str) -> None:
    """Hold a rule of a table. Raises ValueError, which the reader of the file turns into words."""
    if not ok:
        raise ValueError(rule)
