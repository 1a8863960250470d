"""Update the knowledge for the card's next record (`Past`) with the packets of a row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from polysight.capture.earlier_records import Past, Span
from polysight.capture.packet_log import PacketLog
from polysight.capture.record_search import SWITCHED_ON, Found, later_packets

_REMEMBERED = 4  # earlier records whose counters are kept
_GAPS = 64  # largest number of gaps of a record that are kept


def past_after(past: Past, found: Found, log: PacketLog, located: bool, frame_bytes: int) -> Past:
    """Return the knowledge for the next record.

    `located` is also False if the card reported dropped data: then only a short last packet marks the record's end.
    """
    e, full = log.expected, found.full
    if found.base is None:
        return _after_nothing(past, e, full, frame_bytes)
    base, ends = found.base, (found.offsets + log.sizes)[found.own]
    stop = int(ends.max())
    more = _more_records(found, stop, e)
    if located and not more:
        sure = tuple(span for span in past.spans if span.sure)
        anew = past.anew + 1 if base == SWITCHED_ON and past.spans else 0
        return Past(base, (e,), _remember(sure, Span(base, e, missing=_outstanding(found, log))), anew=anew)
    first = int(found.offsets[found.own].min())
    short = bool((log.sizes[found.own][ends == stop] < full).all())
    if found.restarted:
        return Past(base, tuple(sorted({stop, e})), _remember(past.spans, Span(base, e)))
    if more:  # the end of the last of them is unknown
        return Past(spans=_remember(past.spans, Span(base, max(stop, e))), unseen=True)
    if found.certain:
        frames = range(-(-stop // frame_bytes) * frame_bytes, e + 1, frame_bytes) if frame_bytes > 1 else range(0)
        return Past(base, tuple(sorted({*frames, *([stop] if short else [])})), _remember(past.spans, Span(base, e)))
    back = -(-max(0, first - (stop - e)) // full)  # packets that may be lost before the first
    low, high = first - back * full, max(stop, first + e) if e % full else stop
    spans = _remember(past.spans, Span(base.after(low, low // full), high - low))
    end, joined = base.after(stop, -(-stop // full)), 0
    if found.doubtful:
        joined = past.joined + 1 if past.joint == base else 1
        spans = (*spans, Span(end, e, sure=False))
    elif e % full == 0 and first + e > stop:
        spans = (*spans, Span(end, first + e - stop, sure=False))
    anew = past.anew + 1 if found.doubtful and base == SWITCHED_ON else 0
    known = Past(spans=spans, joint=end if joined else None, joined=joined, unseen=past.unseen, anew=anew)
    # A short packet ends its record, wherever that began. One truncated on the way leads to a line without packets.
    return replace(known, base=base, ends=(stop,), guessed=True) if short and not found.doubtful else known


def _outstanding(found: Found, log: PacketLog) -> tuple[tuple[int, int], ...] | None:
    """Return the missing byte ranges of a located record; None if they are too many to keep."""
    came = (found.own | found.old) & (found.offsets >= 0) & (found.offsets < log.expected)
    starts, stops = found.offsets[came], (found.offsets + log.sizes)[came]
    order = np.argsort(starts, kind="stable")
    a = np.append(starts[order], log.expected)
    b = np.maximum.accumulate(np.append(0, stops[order]))
    gaps = tuple((int(b[k]), int(a[k])) for k in np.flatnonzero(a > b).tolist())
    return gaps if len(gaps) <= _GAPS else None


def _more_records(found: Found, stop: int, expected: int) -> bool:
    """True if packets have counters behind the record's end: another record of unknown size, or the card restarted."""
    return bool(later_packets(found, ~(found.own | found.early | found.old), stop, expected).any())


def _after_nothing(past: Past, expected: int, full: int, frame_bytes: int) -> Past:
    """Return the knowledge after a row without packets, whose record may have been sent or not."""
    if past.base is None or len(past.ends) != 1 or past.guessed:
        return Past(spans=past.spans, unseen=True)
    end = past.ends[0]
    base = past.base.after(end, -(-end // full))
    spans = _remember(past.spans, Span(base, expected, sure=False))
    step = frame_bytes if frame_bytes > 1 else max(1, expected)
    return Past(base, tuple(range(0, expected + 1, step)), spans, unseen=True)


def _remember(spans: tuple[Span, ...], span: Span) -> tuple[Span, ...]:
    return (*spans, span)[-_REMEMBERED:]
