"""The list of scans as the page asks for it: whole once, then what has changed since.

2,000 scans are some 800 kB of JSON, and each open page asks for the list every 4 s. The server numbers the states of
its list; a page names the one that it has.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Sequence

import msgspec

from polysight.catalogue import Summary

# Random bytes that tell the states of this server from those of one that ran before.
ORIGIN_BYTES = 4


class ListedScan(Summary, frozen=True, kw_only=True):
    """A line of the list with the scan's size, None while it is being counted."""

    bytes: int | None


class ListChanges(msgspec.Struct, frozen=True, kw_only=True):
    """Scans that are new or differ, and names that are gone; all scans if `whole`. `stamp` names the state reached."""

    stamp: str
    whole: bool
    scans: list[ListedScan]
    gone: list[str]


class ChangingList:
    """The newest list, with the number of the state in which each of its scans changed last."""

    def __init__(self) -> None:
        # A server that was started again counts from zero: stamps of another one are not its own.
        self._origin = secrets.token_hex(ORIGIN_BYTES)
        self._number = 0
        self._scans: dict[str, ListedScan] = {}
        self._changed_in: dict[str, int] = {}
        self._gone_in: dict[str, int] = {}
        self._lock = threading.Lock()

    def update(self, scans: Sequence[ListedScan], stamp: str) -> ListChanges:
        """Take over the newest list; return what differs from the state that `stamp` names, or all of it."""
        with self._lock:
            self._take_over({scan.name: scan for scan in scans})
            reached = f"{self._origin}-{self._number}"
            shown_state = self._find_state(stamp)
            if shown_state is None:
                return ListChanges(stamp=reached, whole=True, scans=list(self._scans.values()), gone=[])
            changed = [scan for name, scan in self._scans.items() if self._changed_in[name] > shown_state]
            removed = [name for name, number in self._gone_in.items() if number > shown_state]
        return ListChanges(stamp=reached, whole=False, scans=changed, gone=removed)

    def _take_over(self, scans: dict[str, ListedScan]) -> None:
        """Make this the newest list; note in which state each scan changed or went. The lock is held."""
        changed = [name for name, scan in scans.items() if self._scans.get(name) != scan]
        removed = [name for name in self._scans if name not in scans]
        if changed or removed:
            self._number += 1
        for name in changed:
            self._changed_in[name] = self._number
            self._gone_in.pop(name, None)
        for name in removed:
            del self._changed_in[name]
            self._gone_in[name] = self._number
        self._scans = scans

    def _find_state(self, stamp: str) -> int | None:
        """Return the number of the state that a stamp names; None if the stamp is not of this list."""
        origin, _, number = stamp.partition("-")
        is_number = number.isascii() and number.isdecimal() and len(number) <= len(str(self._number))
        if origin != self._origin or not is_number:
            return None
        return int(number)
