"""The range profile of a recording as a picture."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from polysight.host.capture.inspect import Report
from polysight.shared.errors import DataError

BOTTOM_DB = -20.0


def plot_profile(report: Report, path: Path) -> None:
    """Write the range profile, every antenna and their mean, as a PNG.

    Raises
    ------
    DataError
        when the recording holds no chirp, or the file cannot be written.
    """
    if not report.profile_db.size:
        raise DataError(f"{report.path}: no chirp to plot", "the recording holds no data", "record again")
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for rx, profile in enumerate(report.rx_profile_db):
        silent = " (no signal)" if profile.max() < BOTTOM_DB else ""
        axes.plot(profile, linewidth=0.8, label=f"RX{rx}{silent}")
    axes.plot(report.profile_db, color="black", linewidth=1.4, label="mean")
    axes.axvline(report.peak_bin, color="grey", linestyle=":", linewidth=1.0)
    axes.set_xlabel(f"range bin of {report.samples} samples")
    axes.set_ylabel("power over the median [dB]")
    name = f"{'simulated ' if report.simulated else ''}{report.path.name}"
    axes.set_title(f"{name}: {report.chirps} chirps, peak {report.peak_db:.1f} dB at bin {report.peak_bin}")
    axes.set_ylim(bottom=BOTTOM_DB)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", ncols=5)
    try:
        figure.savefig(path, format="png", dpi=120)
    except OSError as e:
        raise DataError(f"{path}: cannot be written: {e.strerror}", "no such folder, or no permission") from None
