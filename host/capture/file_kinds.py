"""What kind of file somebody gave instead of ours, by its first bytes."""

from __future__ import annotations

MAGIC = {
    b"\x7fELF": "a program", b"\x89PNG": "a picture (PNG)", b"\xff\xd8\xff": "a picture (JPEG)", b"%PDF": "a PDF",
    b"PK\x03\x04": "an archive (zip)", b"\x1f\x8b": "compressed (gzip)", b"\x89HDF": "HDF5",
    b"BZh": "compressed (bzip2)", b"\xfd7zXZ": "compressed (xz)", b"\x93NUMPY": "a numpy array",
    b"RIFF": "sound or video (RIFF)", b"MATLAB 5.0": "a MATLAB file",
}  # fmt: skip


def kind_of(head: bytes) -> str:
    """What a file is that begins with these bytes, for people: `a picture (PNG)`, `text`; "unknown bytes" otherwise."""
    for magic, kind in MAGIC.items():
        if head.startswith(magic):
            return kind
    if not head:
        return "empty"
    text = head.decode("utf-8", "ignore")
    return "text" if len(text.encode()) > len(head) - 4 and _printable(text) else "unknown bytes"


def _printable(text: str) -> bool:
    return all(c.isprintable() or c.isspace() for c in text)
