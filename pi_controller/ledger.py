"""Events in order: numbered, journalled, then published. Used by the executor's thread alone."""

from __future__ import annotations

import time
from collections.abc import Callable

import msgspec

from polysight.pi_controller.journal import Journal, JournalFolder, JournalFullError
from polysight.shared import messages as m
from polysight.shared.errors import DataError, ProtocolError
from polysight.shared.raster import RasterPlan


class Ledger:
    """The events of the current scan. `publish` takes packed events once they are in the journal, `warn` sentences."""

    def __init__(
        self,
        folder: JournalFolder,
        publish: Callable[[list[bytes]], None],
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._folder, self._publish, self._warn = folder, publish, warn
        self._journal: Journal | None = None
        self._outbox: list[tuple[m.AnyEvent, bytes]] = []
        self._to_keep: list[bytes] = []
        self._sync = self.broken = False
        self.scan_id = ""

    @property
    def last_seq(self) -> int:
        """Sequence number of the newest event of the current scan."""
        return self._journal.last_seq + len(self._to_keep) if self._journal else 0

    def open(self, scan_id: str, plan: RasterPlan, host_seq: int) -> tuple[bool, int]:
        """Make `scan_id` the current scan. The next event is numbered behind `host_seq`, the newest the host has.

        Returns whether the scan was begun before, and how many of the host's events the journal has lost.

        Raises
        ------
        JournalFullError
            when the journal cannot be had, or there is no room for this plan's.
        DataError
            when it is no journal, or the scan was begun with another plan. In both cases nothing has changed.
        """
        self.broken = False
        self.commit()
        self._folder.check_room(scan_id, plan.positions)
        journal = self._journal
        if journal is None or self.scan_id != scan_id:
            journal = self._folder.open(scan_id)
            if journal.damage:
                self._warn(journal.damage)
        try:
            begun = _plan_of(journal)
            if begun is not None and begun != plan:
                raise DataError(
                    f"scan {scan_id} was begun with another plan: {begun}",
                    "the scan's name was used before, with another grid",
                    "resume that scan with its own plan, or give the new one another name",
                )
        except (DataError, ProtocolError):
            if journal is not self._journal:
                journal.close()
            raise
        if journal is not self._journal:
            self.close()
            self._journal, self.scan_id = journal, scan_id
        return begun is not None or host_seq > 0, journal.number_behind(host_seq)

    def add(self, event: m.AnyEvent) -> None:
        """Number an event and add it to the batch. An event that is not journalled carries the last number."""
        kept = isinstance(event, m.JOURNALLED) and self._journal is not None and not self.broken
        event = msgspec.structs.replace(
            event, scan_id=self.scan_id, t_mono_ns=time.monotonic_ns(), seq=self.last_seq + kept
        )
        raw = m.pack(event)
        self._outbox.append((event, raw))
        if kept:
            self._to_keep.append(raw)
            self._sync |= not isinstance(event, m.Capture)

    def commit(self) -> None:
        """Write the batch to the journal, then publish it.

        Raises JournalFullError when it cannot be written. From then on events are published with the last good number
        and not kept, until the scan is opened again; of this batch, only what ends a row or names a fault is published.
        """
        batch, to_keep, sync = self._outbox, self._to_keep, self._sync
        self._outbox, self._to_keep, self._sync = [], [], False
        try:
            if to_keep and self._journal is not None:
                self._journal.write(to_keep, sync)
        except JournalFullError:
            self.broken = True
            for event, _ in batch:
                if isinstance(event, m.RowFinished | m.Fault) or not isinstance(event, m.JOURNALLED):
                    self.add(event)
            self._publish([raw for _, raw in self._outbox])
            self._outbox = []
            raise
        if batch:
            self._publish([raw for _, raw in batch])

    def replay(self, scan_id: str, from_seq: int, limit: int) -> m.ReplayReply:
        """Journalled events of any scan."""
        if self._journal is not None and scan_id == self.scan_id:
            found, last = self._journal.read(from_seq, limit), self.last_seq
        else:
            found, last = self._folder.read(scan_id, from_seq, limit)
        return m.ReplayReply(events=[m.unpack_event(raw) for raw in found], last_seq=last)

    def close(self) -> None:
        """Close the current journal."""
        if self._journal is not None:
            journal, self._journal = self._journal, None
            journal.close()


def _plan_of(journal: Journal) -> RasterPlan | None:
    """The plan of the first event; None when there is no event yet."""
    first = journal.read(1, 1)
    event = m.unpack_event(first[0]) if first else None
    return event.plan if isinstance(event, m.RunStarted) else None
