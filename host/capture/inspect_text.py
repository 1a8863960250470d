"""What is in a recording, for people."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polysight.host.capture.dca1000 import Code
from polysight.host.capture.inspect import CardReport, Report


def main_text(report: Report) -> str:
    """The report for people."""
    r = report
    lines = [f"{r.path}: {r.bytes} bytes{' of a simulated scan' if r.simulated else ''}"]
    if r.card is not None:
        lines += _card_lines(r.card)
    if r.chirps:
        order = ("Q first" if r.q_first else "I first") if r.is_complex else "real"
        lines += [
            f"shape      {r.chirps} chirps x {r.rx} RX x {r.samples} samples, {r.lanes}-lane, {order}"
            + (f" (guessed: {', '.join(r.guessed)})" if r.guessed else ""),
            f"peak       {r.peak_db:.1f} dB over the median at bin {r.peak_bin} of {r.samples}",
            f"level      rms {', '.join(f'{v:.0f}' for v in r.rx_rms)} counts on RX 0.., DC {max(r.rx_dc):.1f}",
            f"clipping   {r.clipped} values at full scale",
            f"profile    {_sparkline(r.profile_db)}",
        ]
    return "\n".join(lines + [f"note       {remark}" for remark in r.remarks]) + "\n"


def _card_lines(card: CardReport) -> list[str]:
    lines = [f"card       {card.address}, {len(card.replies)} replies: {', '.join(n for n, _ in card.replies)}"]
    refused = [n for n, s in card.replies if s and n not in (Code.STATUS.name, Code.VERSION.name)]
    if refused:
        lines.append(f"refused    {', '.join(refused)}")
    if card.version:
        lines.append(f"FPGA       {card.version}")
    if card.status:
        lines.append(f"status     {' '.join(s.name or '?' for s in card.status)}")
    if card.record is not None:
        c = card.record.counts
        lines.append(
            f"record     {card.record.received} of {card.record.expected} bytes in {c.placed} packets, {c.duplicates}"
            f" duplicates, {c.late} late, {c.disagreeing} disagreeing"
        )
    if card.tail_bytes:
        lines.append(f"tail       {card.tail_bytes} bytes, {card.tail_after_s:.3f} s after the packet before")
    return lines


def _sparkline(profile_db: NDArray[np.float64], width: int = 64) -> str:
    bars = " ▁▂▃▄▅▆▇█"
    groups = np.array_split(profile_db, min(width, profile_db.size))
    tops = np.array([g.max() for g in groups])
    span = max(float(tops.max()), 1e-9)
    return "".join(bars[int(np.clip(round(t / span * 8), 0, 8))] for t in tops)
