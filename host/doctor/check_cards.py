"""Each capture card by its address, and the buffer its data falls into. What `polysight card` tells, in one line."""

from __future__ import annotations

from polysight.host.capture.survey import HopFinding
from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, ok
from polysight.shared.config import Board

_BEFORE_DATA = ("host", "route", "link", "card")


def check_card(bench: Bench, board: Board) -> Finding:
    """The card answers at its address; what does not, is the first hop that is silent."""
    survey = bench.surveys[board.name]
    wrong = next((h for h in survey.hops if h.hop in _BEFORE_DATA and h.verdict == "error"), None)
    if wrong is not None:
        return _as(wrong)
    return ok(
        f"{board.card_address}:{board.command_port} answers, FPGA {survey.version}; data to"
        f" {board.host_address}:{board.data_port}",
        fpga=survey.version,
    )


def check_buffer(bench: Bench, board: Board) -> Finding:
    """The receiving process starts as in a scan, and the kernel grants it the buffer that was asked for."""
    hops = {h.hop: h for h in bench.surveys[board.name].hops}
    receiver, buffer = hops["receiver"], hops["buffer"]
    for verdict in ("error", "warning"):
        for hop in (buffer, receiver):
            if hop.verdict == verdict:
                return _as(hop)
    bench.sound.add(board.name)
    return ok(f"{buffer.found}; {receiver.found}")


def _as(hop: HopFinding) -> Finding:
    return Finding(hop.verdict, hop.found, hop.why, hop.remedy)
