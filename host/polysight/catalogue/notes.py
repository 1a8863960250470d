"""The operator's notes and tags of a scan, in a file of the scan's folder.

A scan folder may come from another person: its notes are read only up to a limit, from a regular file, and shown
without characters that would change the line or the reading direction.
"""

from __future__ import annotations

import json
import stat
import unicodedata
from collections.abc import Callable
from pathlib import Path

import msgspec

from polysight_shared.errors import ConfigError, DataError, ErrorCode, ScanError
from polysight_shared.files import hold_folder, write_atomically

NOTES_FILE = "operator.json"
# Largest numbers of characters of the notes and of a tag, and of tags of a scan; chosen. More would make the list of
# scans unreadable.
MAX_NOTES = 10_000
MAX_TAG = 40
MAX_TAGS = 20
# The longest allowed notes and tags take 44 kB in UTF-8. A file that is larger than this was not written by
# `write_notes`, and is ignored.
MAX_NOTES_BYTES = 1 << 17


class Notes(msgspec.Struct, frozen=True):
    """Free text and short tags of one scan, in `operator.json` of the scan's folder."""

    notes: str = ""
    tags: tuple[str, ...] = ()


def read_notes(folder: Path) -> Notes:
    """Read the notes of a scan; empty if there are none, or the file is larger than `write_notes` writes any.

    Raises
    ------
    DataError
        if the file is damaged.
    """
    path = folder / NOTES_FILE
    if not is_plain(path):
        return Notes()
    try:
        with path.open("rb") as f:
            raw = f.read(MAX_NOTES_BYTES + 1)
        if len(raw) > MAX_NOTES_BYTES:
            return Notes()
        return msgspec.json.decode(raw, type=Notes)
    except FileNotFoundError:
        return Notes()
    except (OSError, msgspec.MsgspecError, UnicodeDecodeError) as e:
        raise DataError(
            f"{path}: cannot be read: {e}", "it was edited or damaged", "correct it, or remove it",
            code=ErrorCode.FILE_DAMAGED,
        ) from None  # fmt: skip


def write_notes(folder: Path, notes: Notes, base: Notes | None = None) -> Notes:
    """Check and write the notes of a scan; return them as written.

    Raises
    ------
    ConfigError
        if a text is too long, or there are too many tags.
    ScanError
        if the present notes differ from `base`, the notes that the user edited; with None this is not checked.
    DataError
        if the present notes are damaged, and `base` is given.
    """

    def check_base(present: Notes) -> Notes:
        if present != base:
            raise ScanError(
                f"the notes of {folder.name} have changed", "somebody saved them after they were read here",
                "copy your text, load the page again, and add it", code=ErrorCode.MISMATCH,
            )  # fmt: skip
        return notes

    if base is not None:
        return change_notes(folder, check_base)
    with hold_folder(folder):
        return _write_checked(folder, notes)


def change_notes(folder: Path, change: Callable[[Notes], Notes]) -> Notes:
    """Apply `change` to the notes of a scan and write the result; return the notes as written.

    Meanwhile the folder is locked, so that no other program changes the notes.

    Raises
    ------
    ConfigError
        if a text is too long, or there are too many tags.
    DataError
        if the present notes are damaged.
    """
    with hold_folder(folder):
        return _write_checked(folder, change(read_notes(folder)))


def _write_checked(folder: Path, notes: Notes) -> Notes:
    """Check and write the notes of a locked folder; return them as written. Raises ConfigError."""
    text = remove_unprintable(notes.notes, keep="\n")
    # A dictionary drops tags that are given twice, and keeps the order.
    tags = dict.fromkeys(remove_unprintable(tag).strip() for tag in notes.tags)
    tags.pop("", None)
    longest = max(tags, key=len, default="")
    fault = ""
    if len(text) > MAX_NOTES:
        fault = f"the notes have {len(text)} characters, {MAX_NOTES} are allowed"
    elif len(tags) > MAX_TAGS:
        fault = f"{len(tags)} tags, {MAX_TAGS} are allowed"
    elif len(longest) > MAX_TAG:
        fault = f"the tag {longest[:MAX_TAG]!r}... has {len(longest)} characters, {MAX_TAG} are allowed"
    if fault:
        raise ConfigError(
            fault, "longer ones would make the list of scans unreadable", "shorten it; put longer texts into a file",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    written = Notes(text, tuple(tags))
    content = json.dumps(msgspec.to_builtins(written), indent=1, ensure_ascii=False)
    write_atomically(folder / NOTES_FILE, f"{content}\n".encode())
    return written


def is_plain(path: Path) -> bool:
    """True if a path is a regular file: no link, and no pipe, on which a reader would block."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except (OSError, ValueError):
        return False


def remove_unprintable(text: str, keep: str = "") -> str:
    """Return the text without control, direction and surrogate characters, for lists and terminals."""
    hidden = ("Cc", "Cf", "Cs", "Zl", "Zp")
    return "".join(c for c in unicodedata.normalize("NFC", text) if c in keep or unicodedata.category(c) not in hidden)
