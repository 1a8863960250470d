"""What cannot be undone is done only when a word is repeated by whoever asks for it."""

from __future__ import annotations

import sys


def typed(what: str, word: str, yes: bool) -> str:
    """Say what would be done, and return what is typed in answer; `word` unasked when `yes` was given."""
    sys.stdout.write(f"{what}\n")
    if yes:
        return word
    sys.stdout.write(f"type {word} to do it: ")
    sys.stdout.flush()
    return sys.stdin.readline().strip()
