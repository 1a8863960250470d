"""The operator's notes and tags of a scan, in `operator.json` beside its rows."""

from __future__ import annotations

import json
import stat
import threading
import unicodedata
from pathlib import Path

import msgspec

from polysight.products import write_atomically
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError, ScanError

NOTES = "operator.json"
LONGEST_NOTES, LONGEST_TAG, MAX_TAGS = 10_000, 40, 20
_MAX_BYTES = 1 << 17
_writing = threading.Lock()  # from the comparison with the present notes until they are replaced


class Notes(msgspec.Struct, frozen=True):
    """Free text and short tags of one scan."""

    notes: str = ""
    tags: tuple[str, ...] = ()


def read_notes(folder: Path) -> Notes:
    """Read the notes of a scan; empty if there are none.

    Raises
    ------
    DataError
        if the file is damaged.
    """
    path = folder / NOTES
    if not is_plain(path):
        return Notes()
    try:
        with path.open("rb") as f:
            raw = f.read(_MAX_BYTES + 1)
        return Notes() if len(raw) > _MAX_BYTES else msgspec.json.decode(raw, type=Notes)
    except FileNotFoundError:
        return Notes()
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError) as e:
        raise DataError(
            f"{path}: cannot be read: {e}", "it was edited or damaged", "correct it, or remove it",
            code=ErrorCode.FILE_DAMAGED,
        ) from None  # fmt: skip


def is_plain(path: Path) -> bool:
    """True if a path is a regular file: no link, and no pipe, on which a reader would block."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except (OSError, ValueError):
        return False


def write_notes(folder: Path, notes: Notes, base: Notes | None = None) -> Notes:
    """Check and write the notes of a scan; return them as written.

    Raises
    ------
    ConfigError
        if a text is too long, or there are too many tags.
    ScanError
        if the present notes differ from `base`, from which these were edited; None: not checked.
    """
    text = printable(notes.notes, keep="\n")
    tags = tuple(dict.fromkeys(tag for tag in (printable(t).strip() for t in notes.tags) if tag))
    wrong = ""
    if len(text) > LONGEST_NOTES:
        wrong = f"the notes have {len(text)} characters, {LONGEST_NOTES} are allowed"
    elif len(tags) > MAX_TAGS:
        wrong = f"{len(tags)} tags, {MAX_TAGS} are allowed"
    elif long := next((tag for tag in tags if len(tag) > LONGEST_TAG), ""):
        wrong = f"the tag {long[:LONGEST_TAG]!r}... has {len(long)} characters, {LONGEST_TAG} are allowed"
    if wrong:
        raise ConfigError(
            wrong, "lists have to stay readable", "shorten it; longer texts go into a file of their own",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    content = {"notes": text, "tags": list(tags)}
    with _writing:
        if base is not None and read_notes(folder) != base:
            raise ScanError(
                f"the notes of {folder.name} have changed", "somebody saved them after they were read here",
                "copy your text, load the page again, and add it", code=ErrorCode.MISMATCH,
            )  # fmt: skip
        write_atomically(folder / NOTES, (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode())
    return Notes(text, tags)


def printable(text: str, keep: str = "") -> str:
    """Return the text without control, direction and surrogate characters, for lists and terminals."""
    bad = ("Cc", "Cf", "Cs", "Zl", "Zp")
    return "".join(c for c in unicodedata.normalize("NFC", text) if c in keep or unicodedata.category(c) not in bad)
