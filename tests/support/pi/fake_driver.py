"""A stage driver without a stage."""

from __future__ import annotations

from typing import Any

from polysight.shared.config import Stage
from polysight.shared.stage_line import Immediate, Reply


class FakeDriver:
    """Takes everything; what was sent is kept."""

    def __init__(self) -> None:
        self.config = Stage("none")
        self.sent: list[Immediate] = []
        self.x_mm = self.y_mm = 0.0
        self.firmware = "fake"
        self.number = 0
        self.link = self  # what it asks of an open link

    def connect(self) -> None: ...
    def clear(self) -> None: ...
    def at_rest(self) -> None: ...
    def repeat(self) -> None: ...
    def note_position(self, _: Reply) -> None: ...

    def send_byte(self, byte: Immediate) -> None:
        self.sent.append(byte)

    def home(self) -> int:
        self.number += 1
        return self.number

    def row(self, *_: Any) -> int:
        self.number += 1
        return self.number
