"""Trigger skew between the boards, by the IF of their direct paths."""

from __future__ import annotations

import numpy as np

from polysight.host.calibration.direct_signal import DirectSignal, unwrapped
from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, error, not_checked, ok, warning
from polysight.shared.config import Instrument

MUCH_S = 10e-9
TOO_MUCH_S = 20e-9
JITTER_S = 4e-9  # two clocks of 5 ns each make 2 ns


def check_skew(bench: Bench) -> Finding:
    """Both receivers start together; the transmitter's start is known as well as the start frequencies are."""
    if any(b.name not in bench.signals for b in bench.rig.receivers):
        return not_checked("the direct path of both receivers is needed")
    return judge(bench.rig, bench.signals)


def judge(rig: Instrument, signals: dict[str, DirectSignal]) -> Finding:
    """What is to be said of two receivers' direct paths."""
    h, v = rig.receivers
    later = {b.name: signals[b.name].later_s(rig) for b in (h, v)}
    skew = later[v.name][0] - later[h.name][0]
    unsure = float(np.hypot(later[h.name][1], later[v.name][1]))
    jitter = max(float(unwrapped(signals[b.name].if_hz, rig).std()) for b in (h, v)) / rig.chirp.slope_hz_per_s
    ppm = {b.name: signals[b.name].crystal_ppm(rig) for b in (h, v)}
    told = f"{v.name} starts {skew * 1e9:+.2f} +- {unsure * 1e9:.2f} ns after {h.name}; " + ", ".join(
        f"{name} {mean * 1e9:+.1f} ns after the transmitter, crystal {ppm[name]:+.2f} ppm"
        for name, (mean, _) in later.items()
    )
    facts = {
        "skew_ns": skew * 1e9,
        "standard_error_ns": unsure * 1e9,
        "jitter_ns": jitter * 1e9,
        "later_ns": {name: mean * 1e9 for name, (mean, _) in later.items()},
        "crystal_ppm": ppm,
    }
    lines = "several GPIO lines, written one after another" if rig.pi.wiring != "fanout" else "cables of unequal length"
    why = f"{lines}, a slow edge, or start_offset_hz that one board does not have"
    remedy = "one line and a clock buffer (docs/how-to/wiring.md); compare SYNC_IN at the boards with an oscilloscope"
    if abs(skew) > TOO_MUCH_S:
        return error(told, why, remedy, **facts)
    if abs(skew) > MUCH_S:
        return warning(told, why, remedy, **facts)
    if jitter > JITTER_S:
        return warning(
            f"{told}; {jitter * 1e9:.1f} ns from chirp to chirp",
            "more than two clocks of 5 ns explain: noise or slow edges on SYNC_IN",
            remedy,
            **facts,
        )
    return ok(told, **facts)
