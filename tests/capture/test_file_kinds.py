"""What a foreign file is, by its first bytes."""

from __future__ import annotations

import io

import numpy as np
import pytest

from polysight.host.capture import kind_of


def npy() -> bytes:
    out = io.BytesIO()
    np.save(out, np.zeros(3))
    return out.getvalue()


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (npy(), "a numpy array"),
        ("# Überschrift\n".encode() * 40, "text"),
        (("ä" * 400).encode()[:511], "text"),  # cut within a character
        (b"\x89PNG\r\n", "a picture (PNG)"),
        (b"", "empty"),
        (bytes(range(256)), "unknown bytes"),
    ],
)
def test_kinds(head, kind):
    assert kind_of(head) == kind
