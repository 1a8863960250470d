"""Residual frequency, phase and amplitude errors after synchronisation, for any scan: `polysight sync-report`.

For one scan it shows what Fig. 15 of the POLySIGHT paper shows: histograms of the errors after each of four stages,
with the Cramer-Rao bounds.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from polysight.products import write_json
from polysight.report.style import INK, MUTED, STAMP_COLOUR, encode_png
from polysight.sync import PUBLISHED_STD, STAGES, SyncedRow
from polysight_shared.files import write_atomically

QUANTITIES = ("frequency_hz", "phase_rad", "amplitude")
_LABELS = ("frequency (Hz)", "phase (rad)", "amplitude / mean - 1")
# Number of bins of a histogram; chosen. It is odd, so that one bin is centred at zero.
_BINS = 121
# Range of a histogram to either side of zero, in standard deviations of the first row; chosen.
_RANGE_STDS = 5.0


@dataclass
class _Stage:
    """Running sums of one stage: squares, count, and a histogram of each of `QUANTITIES`.

    The histograms go from -`reach` to `reach` [3], which is computed from the first row.
    """

    reach: NDArray[np.float64]
    squares: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros((3, _BINS), np.int64))
    n: int = 0

    def add(self, values: NDArray[np.float64]) -> None:
        """Add the errors [3, n] of n positions or chirps."""
        self.squares += (values**2).sum(axis=1)
        self.n += values.shape[1]
        for i, reach in enumerate(self.reach):
            self.counts[i] += np.histogram(values[i], bins=_BINS, range=(-reach, reach))[0]

    @property
    def std(self) -> NDArray[np.float64]:
        """Root mean square of each quantity, [3]."""
        return np.sqrt(self.squares / max(self.n, 1))


class SyncReport:
    """Accumulates the residual errors of one board, row by row, in constant memory."""

    def __init__(self, sample_rate_hz: float, linear: tuple[int, int], rx: int) -> None:
        """Begin without rows; synchronisation uses the samples `linear` [first, end) of a chirp, on `rx` receivers."""
        self._rate = sample_rate_hz
        self._samples = linear[1] - linear[0]
        self._rx = rx
        self.stages: dict[str, _Stage] = {}
        self.positions = 0
        self.chirps = 0
        # For each row its power ratio (see `snr`) and its weight, the number of positions.
        self._snr: list[tuple[float, int]] = []

    def add(self, row: SyncedRow) -> None:
        """Add a synchronised row; its `errors` are arrays [3, n] by stage, a key of `STAGES`."""
        self.positions += int(row.valid.sum())
        self.chirps += int(row.chirps[row.valid].sum())
        for name, values in row.errors.items():
            if values.size:
                if name not in self.stages:
                    reach = _RANGE_STDS * np.maximum(np.sqrt((values**2).mean(axis=1)), 1e-12)
                    self.stages[name] = _Stage(reach)
                self.stages[name].add(values)
        # One chirp alone has no noise estimate.
        several = row.valid & (row.chirps > 1)
        if row.noise is not None and several.any():
            ratio = np.median(row.direct_amplitude[several]) ** 2 / np.median(row.noise[several])
            self._snr.append((float(ratio), int(several.sum())))

    @property
    def snr(self) -> float:
        """Power ratio of direct path and noise in one channel of one chirp; NaN without an estimate."""
        ratios, positions = np.array(self._snr or [(np.nan, 1)]).T
        return float(np.average(ratios, weights=positions))

    def bounds(self) -> dict[str, tuple[float, float, float]]:
        """Return Cramer-Rao bounds (Hz, rad, relative amplitude) of one tone as strong as the direct path, by stage.

        For N samples on every RX (Rife and Boorstyn 1974)

            var(w) = 6 / (snr N (N^2 - 1))
            var(phase at the centre) = var(relative amplitude) = 1 / (2 snr N)

        with the angular frequency w in radians per sample. The bound of an aligned chirp is that of its deviation from
        its burst. The error of a chirp with an echo close to the direct path may be below the bound of one tone.
        """
        if not self.chirps or not self._snr:
            return {}
        n = self._samples
        chirps = self.chirps / max(self.positions, 1)

        def compute_bound_of_tone(snr: float) -> tuple[float, float, float]:
            phase = 1 / np.sqrt(2 * snr * n)
            f = np.sqrt(6 / (snr * n * (n**2 - 1))) / (2 * np.pi) * self._rate
            return float(f), float(phase), float(phase)

        # The errors of chirps are relative to the mean of their burst, which leaves 1 - 1 / chirps of the variance.
        single_chirp = compute_bound_of_tone(self.snr * self._rx / (1 - 1 / chirps))
        mean = compute_bound_of_tone(self.snr * self._rx * chirps)
        # The residual of this stage is a difference of two signals with equal noise.
        f, phase, amplitude = (float(np.sqrt(2)) * bound for bound in mean)
        return {"aligned": single_chirp, "averaged": mean, "referenced": (f, phase, amplitude)}

    def summary(self) -> dict[str, Any]:
        """Return the content of sync.json."""
        bounds = self.bounds()
        direct_snr_db = None
        if self._snr:
            direct_snr_db = round(10 * np.log10(self.snr), 2)
        return {
            "positions": self.positions,
            "chirps": self.chirps,
            "direct_snr_db": direct_snr_db,
            "stages": {
                name: {
                    "samples": stage.n,
                    **{f"{q}_std": float(s) for q, s in zip(QUANTITIES, stage.std, strict=True)},
                    **{f"{q}_bound": b for q, b in zip(QUANTITIES, bounds.get(name, ()), strict=False)},
                }
                for name, stage in self.stages.items()
            },
        }


def figure_png(report: SyncReport, title: str, simulated: bool) -> bytes:
    """Return a PNG: histograms of errors after each stage, the bounds as normal distributions, the paper's values."""
    fig = Figure(figsize=(11, 9), dpi=110, layout="constrained", facecolor="white")
    if simulated:
        fig.suptitle(f"{title}   SIMULATED", color=STAMP_COLOUR, fontsize=12)
    else:
        fig.suptitle(title, color=INK, fontsize=12)
    bounds = report.bounds()
    axes = fig.subplots(len(STAGES), 3, squeeze=False)
    for line, (name, description) in zip(axes, STAGES.items(), strict=True):
        stage = report.stages.get(name)
        for i, ax in enumerate(line):
            ax.tick_params(labelsize=8, colors=MUTED)
            ax.set_yticks([])
            ax.locator_params(axis="x", nbins=5)
            if i == 0:
                ax.set_ylabel(f"{name}\n{textwrap.fill(description, 34)}", fontsize=8, color=INK)
            if name == list(STAGES)[-1]:
                ax.set_xlabel(_LABELS[i], fontsize=9, color=MUTED)
            if stage is None or stage.n == 0:
                ax.text(0.5, 0.5, "nothing to measure", ha="center", transform=ax.transAxes, fontsize=8, color=MUTED)
                continue
            reach = stage.reach[i]
            std = stage.std[i]
            x = (np.arange(_BINS) + 0.5) / _BINS * 2 * reach - reach
            density = stage.counts[i] / max(stage.counts[i].sum(), 1) / (2 * reach / _BINS)
            ax.fill_between(x, density, step="mid", color="#88CCEE", label=f"std {std:.3g}")
            if name in bounds:
                bound = bounds[name][i]
                normal = np.exp(-(x**2) / (2 * bound**2)) / (bound * np.sqrt(2 * np.pi))
                ax.plot(x, normal, color="#CC6677", lw=1.2, label=f"Cramér-Rao, one tone {bound:.3g}")
            if name == "referenced" and i < 2:
                published_std = PUBLISHED_STD[QUANTITIES[i]]
                for sign in (-1, 1):
                    ax.axvline(sign * published_std, color=INK, lw=0.8, ls=":")
                ax.plot([], [], color=INK, lw=0.8, ls=":", label=f"paper ±{published_std:g}")
                limit = max(reach, published_std)
                ax.set_xlim(-1.1 * limit, 1.1 * limit)
            ax.legend(fontsize=7, loc="upper right", frameon=False)
    return encode_png(fig)


def format_report(boards: dict[str, dict[str, Any]], simulated: bool) -> str:
    """Return the report as text."""
    heading = "Synchronisation residuals (standard deviations)"
    if simulated:
        heading += ", simulated data"
    lines = [heading, ""]
    for board, stages in boards.items():
        snr = ""
        if stages["direct_snr_db"] is not None:
            snr = f", direct path {stages['direct_snr_db']} dB over noise a channel"
        lines.append(f"{board}: {stages['chirps']} chirps at {stages['positions']} positions{snr}")
        for name, stage in stages["stages"].items():
            values = f"{stage['frequency_hz_std']:10.2f} Hz {stage['phase_rad_std']:9.5f} rad"
            values += f" {stage['amplitude_std']:9.5f}"
            bound = ""
            if "phase_rad_bound" in stage:
                bound = f"   bound {stage['frequency_hz_bound']:.2f} Hz {stage['phase_rad_bound']:.5f} rad"
            lines.append(f"  {name:11s}{values}{bound}   ({STAGES[name]})")
    lines += ["", f"paper, after all stages: {PUBLISHED_STD['frequency_hz']:g} Hz, {PUBLISHED_STD['phase_rad']:g} rad"]
    return "\n".join(lines) + "\n"


def write_sync_report(out: Path, reports: dict[str, SyncReport], scan: str, simulated: bool) -> str:
    """Write sync.json, sync.txt and sync-BOARD.png into a folder; return the text."""
    boards = {name: report.summary() for name, report in reports.items()}
    write_json(out / "sync.json", {"scan": scan, "simulated": simulated, "paper": PUBLISHED_STD, "boards": boards})
    for name, report in reports.items():
        write_atomically(out / f"sync-{name}.png", figure_png(report, f"{scan}, {name}", simulated))
    text = format_report(boards, simulated)
    write_atomically(out / "sync.txt", text.encode())
    return text
