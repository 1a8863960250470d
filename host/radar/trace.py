"""Everything that passed between host and board, with times, in a file; and such a file played to the host again.

One JSON object a line; the form is in docs/spec/mmwavelink.md ("Traces"). A trace of a day on which something failed is
all that is needed to look for the cause elsewhere: :class:`ReplayedWords` stands for the board that it was taken from.
"""

from __future__ import annotations

import itertools
import json
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from polysight.host.radar.spi import Clock, WordLink
from polysight.shared import __version__
from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError, DeviceError
from polysight.shared.files import read_bounded

FORM = 1
INTERRUPT, RESET = "HOST_INTR", "NRST"
LARGEST_BYTES = 2**26  # a scan of some thousand rows
_LONGEST_S = 1e7


class TracedWords:
    """A word link that writes down what passes; satisfies :class:`polysight.host.radar.spi.WordLink`.

    Parameters
    ----------
    words, clock
        The link, and the time that is written.
    file
        Written anew, each line at once, so that nothing is missing of a run that was killed. A disk that fills up ends
        the trace, and nothing else: `ended` says why.
    facts
        For the first line: board, place, and what else helps.

    Raises
    ------
    OSError
        when the file cannot be written.
    """

    def __init__(self, words: WordLink, clock: Clock, file: Path, facts: dict[str, object]) -> None:
        self._words, self._clock, self._began = words, clock, clock.now()
        self._file = file.open("w", encoding="utf-8")
        self._level: bool | None = None
        self._looks = 0  # at the interrupt since the last line, that showed nothing new
        self.file, self.ended = file, ""
        self._write({"trace": FORM, **facts})

    def write(self, words: Sequence[int]) -> None:
        """Shift words out. Raises DeviceError."""
        self._put(out=_hex(words))
        with _Errors(self):
            self._words.write(words)

    def read(self, count: int) -> list[int]:
        """Shift words in. Raises DeviceError."""
        with _Errors(self):
            words = self._words.read(count)
        self._put(**{"in": _hex(words)})
        return words

    def interrupt(self) -> bool:
        """The host interrupt; written down when it has changed. Raises DeviceError."""
        with _Errors(self):
            level = self._words.interrupt()
        if level is self._level:
            self._looks += 1
        else:
            self._level = level
            self._put(line=INTERRUPT, level=int(level), looks=self._looks)
        return level

    def reset(self, held: bool) -> None:
        """Drive the reset. Raises DeviceError."""
        self._put(line=RESET, level=int(not held))
        with _Errors(self):
            self._words.reset(held)

    def close(self) -> None:
        """Close link and file. Twice is once."""
        self._words.close()
        with suppress(OSError):  # what could not be written is tried again here
            self._file.close()

    def note_error(self, what: str) -> None:
        """Write down an error of the link."""
        self._put(error=what)

    def _put(self, **what: object) -> None:
        self._looks = 0
        self._write({"t": round(self._clock.now() - self._began, 6), **what})

    def _write(self, line: dict[str, object]) -> None:
        if self.ended:
            return
        try:
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()
        except OSError as e:
            self.ended = f"ended early: {e.strerror}"


def traced(words: WordLink, clock: Clock, file: Path, rig: Instrument, board: str) -> TracedWords:
    """A board's link that is traced into `file`, which begins with what helps to know of rig, place and time."""
    place, now = rig.radar.native[board].place, round(time.time(), 3)
    facts = {"board": board, "place": place, "rig": rig.name, "polysight": __version__, "unix_s": now}
    return TracedWords(words, clock, file, facts)


def new_trace(folder: Path, board: str) -> Path:
    """A file of its own for a link that is opened now: BOARD-TIME.jsonl (UTC), numbered where that is taken."""
    name = f"{board}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
    ends = itertools.chain([""], (f"-{n}" for n in itertools.count(2)))
    names = (folder / f"{name}{end}.jsonl" for end in ends)
    return next(path for path in names if not path.exists())


class _Errors:
    """A DeviceError that leaves this block is written into the trace."""

    def __init__(self, trace: TracedWords) -> None:
        self._trace = trace

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if isinstance(error, DeviceError):
            self._trace.note_error(error.what)


class ReplayedWords:
    """A board as a trace shows it, and its clock: a word link, and time that passes by waiting.

    The host must do what it did then: the first thing that differs is a DeviceError that names both.

    Attributes
    ----------
    facts
        The trace's first line.
    """

    def __init__(self, file: Path) -> None:
        self.facts, self._records = read_trace(file)
        self._at, self._time, self._level = 0, 0.0, False
        self._looks = 0  # since the last line that was played

    def now(self) -> float:
        """Seconds of the trace's time."""
        self._time += 1e-6
        return self._time

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        self._time += seconds

    @property
    def done(self) -> bool:
        """True when all of the trace was played."""
        return self._at >= len(self._records)

    def write(self, words: Sequence[int]) -> None:
        """What the host writes must be what it wrote then. Raises DeviceError."""
        self._expect("out", _hex(words))

    def read(self, count: int) -> list[int]:
        """What the board said then. Raises DeviceError."""
        said = str(self._expect("in", None))
        if len(said) != 4 * count:
            raise self._differs(f"reads {count} words", f"{len(said) // 4} words")
        return list(struct.unpack(f"<{count}H", bytes.fromhex(said)))

    def interrupt(self) -> bool:
        """The line as it was at this look, or, in a trace that does not count them, at this time.

        Raises DeviceError.
        """
        self._looks += 1
        while not self.done and self._records[self._at].get("line") == INTERRUPT:
            record = self._records[self._at]
            looks = record.get("looks")
            if self._looks <= looks if looks is not None else record["t"] > self.now():
                break
            self._play_level()
            if looks is not None:
                break
        self._raise_error()
        return self._level

    def reset(self, held: bool) -> None:
        """The reset must move as it did then. Raises DeviceError."""
        self._skip_interrupts()
        self._expect("level", int(not held))

    def close(self) -> None:
        """Nothing is open."""

    def _skip_interrupts(self) -> None:
        while not self.done and self._records[self._at].get("line") == INTERRUPT:
            self._play_level()

    def _play_level(self) -> None:
        self._level = bool(self._records[self._at]["level"])
        self._next()

    def _next(self) -> None:
        self._time = max(self._time, self._records[self._at]["t"])
        self._at, self._looks = self._at + 1, 0

    def _raise_error(self) -> None:
        if not self.done and "error" in self._records[self._at]:
            self._next()
            raise DeviceError(self._records[self._at - 1]["error"], "as in the trace", "the trace's own remedy")

    def _expect(self, key: str, value: object) -> object:
        self._skip_interrupts()
        self._raise_error()
        if self.done:
            raise DeviceError("the trace ends here", "the run it was taken from ended, or was killed", "")
        record = self._records[self._at]
        if key not in record or (value is not None and record[key] != value):
            raise self._differs(f"{key} {value}", json.dumps(record))
        self._next()
        self._raise_error()
        return record[key]

    def _differs(self, now: str, then: str) -> DeviceError:
        return DeviceError(
            f"line {self._at + 2} of the trace: the host does {now}, then it was {then}",
            "another version of this program, another rig file or board, or another trace",
            "replay it with the rig file and the version that it was taken with",
        )


def read_trace(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """A trace's first line, and the others; a last line that was cut off is left out. Raises ConfigError, OSError."""
    lines = read_bounded(file, LARGEST_BYTES).decode("utf-8", errors="replace").split("\n")
    found = []
    for number, line in enumerate(lines, 1):
        try:
            found.append((number, json.loads(line) if line else None))
        except (ValueError, RecursionError):
            if number < len(lines):
                raise _no_trace(file, f"line {number} is no JSON") from None
    records = [(number, r) for number, r in found if r is not None]
    if not records or not isinstance(records[0][1], dict) or records[0][1].get("trace") != FORM:
        raise _no_trace(file, f"its first line is not that of a trace of form {FORM}")
    before = 0.0
    for number, record in records[1:]:
        if not _sound(record):
            raise _no_trace(file, f"line {number} is none of a trace's lines")
        if record["t"] < before:
            raise _no_trace(file, f"line {number} is of an earlier time than the one before")
        before = record["t"]
    return records[0][1], [r for _, r in records[1:]]


def _sound(record: object) -> bool:
    """Whether a line is one of those in docs/spec/mmwavelink.md ("Traces")."""
    if (
        not isinstance(record, dict)
        or isinstance(record.get("t"), bool)
        or not isinstance(record.get("t"), int | float)
    ):
        return False
    if not 0 <= record["t"] <= _LONGEST_S:
        return False
    looks = record.get("looks", 0)
    if "line" in record:
        level = record["line"] in (INTERRUPT, RESET) and record.get("level") in (0, 1)
        return level and isinstance(looks, int) and looks >= 0
    texts = [record[key] for key in ("out", "in", "error") if key in record]
    if len(texts) != 1 or not isinstance(texts[0], str):
        return False
    text = texts[0]
    words = len(text) % 4 == 0 and all(c in "0123456789abcdef" for c in text)
    return words or "error" in record


def _no_trace(file: Path, what: str) -> ConfigError:
    return ConfigError(f"{file}: {what}", "another file", "take one that `polysight radar --trace FILE` wrote")


def _hex(words: Sequence[int]) -> str:
    return struct.pack(f"<{len(words)}H", *words).hex()
