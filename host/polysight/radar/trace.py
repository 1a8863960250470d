"""Log the traffic between host and board to a file (`TracedWords`), and replay such a file (`ReplayedWords`).

The file has one JSON object a line; docs/spec/mmwavelink.md ("Traces") has the format. A replay stands for the board,
so that a failure can be examined without it.
"""

from __future__ import annotations

import itertools
import json
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from polysight.radar.spi import Clock, WordLink
from polysight_shared import __version__
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DeviceError
from polysight_shared.files import read_bounded

FORM = 1
INTERRUPT, RESET = "HOST_INTR", "NRST"
MAX_BYTES = 2**26  # a scan of some thousand rows
_MAX_S = 1e7


class TracedWords:
    """A word link (`spi.WordLink`) that logs its traffic.

    Parameters
    ----------
    words, clock
        The link, and the clock for the log.
    file
        Overwritten; each line is flushed at once. A full disk ends only the log, and `ended` has the reason.
    facts
        Content of the first line: board, place, rig, version, time.

    Raises
    ------
    OSError
        if the file cannot be written.
    """

    def __init__(self, words: WordLink, clock: Clock, file: Path, facts: dict[str, object]) -> None:
        self._words, self._clock, self._began = words, clock, clock.now()
        self._file = file.open("w", encoding="utf-8")
        self._level: bool | None = None
        self._looks = 0  # queries of the interrupt without a change since the last line
        self.file, self.ended = file, ""
        self._write({"trace": FORM, **facts})

    def write(self, words: Sequence[int]) -> None:
        """Shift words out. Raises DeviceError."""
        self._put(out=_hex(words))
        with self._log_errors():
            self._words.write(words)

    def read(self, count: int) -> list[int]:
        """Shift words in. Raises DeviceError."""
        with self._log_errors():
            words = self._words.read(count)
        self._put(**{"in": _hex(words)})
        return words

    def interrupt(self) -> bool:
        """Return the host interrupt and log its changes. Raises DeviceError."""
        with self._log_errors():
            level = self._words.interrupt()
        if level is self._level:
            self._looks += 1
        else:
            self._level = level
            self._put(line=INTERRUPT, level=int(level), looks=self._looks)
        return level

    def reset(self, held: bool) -> None:
        """Set the reset line. Raises DeviceError."""
        self._put(line=RESET, level=int(not held))
        with self._log_errors():
            self._words.reset(held)

    def close(self) -> None:
        """Close link and file; may be called twice."""
        self._words.close()
        with suppress(OSError):  # closing tries to write the rest
            self._file.close()

    @contextmanager
    def _log_errors(self) -> Iterator[None]:
        try:
            yield
        except DeviceError as e:
            self._put(error=e.what)
            raise

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
    """Log a board's link to `file`, whose first line has board, place, rig, version and time."""
    place, now = rig.radar.native[board].place, round(time.time(), 3)
    facts = {"board": board, "place": place, "rig": rig.name, "polysight": __version__, "unix_s": now}
    return TracedWords(words, clock, file, facts)


def new_trace(folder: Path, board: str) -> Path:
    """Return an unused path for a new trace: BOARD-TIME.jsonl (UTC), with a number if it exists."""
    name = f"{board}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
    ends = itertools.chain([""], (f"-{n}" for n in itertools.count(2)))
    names = (folder / f"{name}{end}.jsonl" for end in ends)
    return next(path for path in names if not path.exists())


class ReplayedWords:
    """Replay of a trace: a word link and a clock in virtual time. `facts` has the trace's first line.

    The host must repeat its actions of the trace; the first difference raises a DeviceError with both.
    """

    def __init__(self, file: Path) -> None:
        self.facts, self._records = read_trace(file)
        self._at, self._time, self._level = 0, 0.0, False
        self._looks = 0  # since the last replayed line

    def now(self) -> float:
        """Return the trace's time, seconds."""
        self._time += 1e-6
        return self._time

    def sleep(self, seconds: float) -> None:
        """Advance the time."""
        self._time += seconds

    @property
    def done(self) -> bool:
        """True if the whole trace was replayed."""
        return self._at >= len(self._records)

    def write(self, words: Sequence[int]) -> None:
        """Compare the words with those of the trace. Raises DeviceError."""
        self._expect("out", _hex(words))

    def read(self, count: int) -> list[int]:
        """Return the board's words in the trace. Raises DeviceError."""
        words = str(self._expect("in", None))
        if len(words) != 4 * count:
            raise self._differs(f"reads {count} words", f"{len(words) // 4} words")
        return list(struct.unpack(f"<{count}H", bytes.fromhex(words)))

    def interrupt(self) -> bool:
        """Return the level at this query or, if the trace does not count them, at this time. Raises DeviceError."""
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
        """Compare the reset with that of the trace. Raises DeviceError."""
        self._skip_interrupts()
        self._expect("level", int(not held))

    def close(self) -> None:
        """Do nothing."""

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
            raise DeviceError(
                self._records[self._at - 1]["error"], "as in the trace", "see the error of the traced run"
            )

    def _expect(self, key: str, value: object) -> object:
        self._skip_interrupts()
        self._raise_error()
        if self.done:
            raise DeviceError("the trace ends here", "the traced run ended or was killed", "")
        record = self._records[self._at]
        if key not in record or (value is not None and record[key] != value):
            raise self._differs(f"{key} {value}", json.dumps(record))
        self._next()
        self._raise_error()
        return record[key]

    def _differs(self, now: str, then: str) -> DeviceError:
        return DeviceError(
            f"line {self._at + 2} of the trace: the host does {now}, the trace has {then}",
            "another version of this program, another rig file or board, or another trace",
            "replay it with the rig file and the version of the traced run",
        )


def read_trace(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Read a trace: its first line, and the others without an incomplete last one. Raises ConfigError, OSError."""
    lines = read_bounded(file, MAX_BYTES).decode("utf-8", errors="replace").split("\n")
    found = []
    for number, line in enumerate(lines, 1):
        try:
            found.append((number, json.loads(line) if line else None))
        except (ValueError, RecursionError):
            if number < len(lines):
                raise _invalid(file, f"line {number} is not JSON") from None
    records = [(number, r) for number, r in found if r is not None]
    if not records or not isinstance(records[0][1], dict) or records[0][1].get("trace") != FORM:
        raise _invalid(file, f"its first line is not that of a trace, version {FORM}")
    before = 0.0
    for number, record in records[1:]:
        if not _is_valid(record):
            raise _invalid(file, f"line {number} is not a line of a trace")
        if record["t"] < before:
            raise _invalid(file, f"line {number} has an earlier time than the one before")
        before = record["t"]
    return records[0][1], [r for _, r in records[1:]]


def _is_valid(record: object) -> bool:
    """Return True if a line has a form of docs/spec/mmwavelink.md ("Traces")."""
    if (
        not isinstance(record, dict)
        or isinstance(record.get("t"), bool)
        or not isinstance(record.get("t"), int | float)
    ):
        return False
    if not 0 <= record["t"] <= _MAX_S:
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


def _invalid(file: Path, what: str) -> ConfigError:
    return ConfigError(
        f"{file}: {what}", "another file", "give a file of `polysight radar --trace FILE`", code=ErrorCode.FILE_FOREIGN
    )


def _hex(words: Sequence[int]) -> str:
    return struct.pack(f"<{len(words)}H", *words).hex()
