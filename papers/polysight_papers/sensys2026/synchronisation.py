"""Fig. 12 (before and after synchronisation), Fig. 15 (errors by stage), Fig. 9 (spectrogram, high-pass response).

They are of the POLySIGHT paper. The first two come from one scan of metal plates with the simulated rig, the last from
the direct path alone, received at ten start frequencies.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter

from polysight.capture import decode_row, view_row_words
from polysight.imaging import ImageBuilder
from polysight.report import INK, PALETTE, QUANTITIES, SyncReport
from polysight.sync import (
    FOLD,
    STAGES,
    BoardSetup,
    HighPass,
    fit_high_pass,
    high_pass,
    sample_frequencies_hz,
    synchronise_row,
)
from polysight_papers.sensys2026.images import plate, simulate_scan
from polysight_papers.sensys2026.item import Item, Picture, Run, Table, new_figure, published_values, style_axes
from polysight_shared.config import Chirp, load_instrument
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Complex = npt.NDArray[np.complex64]
# Units of the errors in the order of `QUANTITIES`.
UNITS = ("frequency (Hz)", "phase (rad)", "relative amplitude")

# Fig. 9: a short row, and the IF offsets of the receivers, which sweep the direct path over the filter's slope; chosen.
GRID = {"columns": 6, "rows": 1, "step_x_mm": 10.0, "step_y_mm": 6.0}
OFFSETS_HZ = (200e3, 250e3, 350e3, 450e3, 600e3, 870e3, 1.1e6, 1.3e6, 1.5e6, 1.7e6)
# The offset of which spectrogram and spectra are shown.
USUAL_HZ = 870e3
# Distances from the tone at which the smear of a bent chirp is averaged; chosen.
SKIRT_HZ = (60e3, 200e3)
# Length of zero-padded spectra.
_PADDED = 4096
# Bins of a range profile over the unambiguous range of all samples, and the excess path that is shown; chosen.
_RANGE_BINS = 1024
_SHOWN_M = 2.5


@dataclass(frozen=True)
class SyncScan:
    """Results of one scan of metal plates.

    Attributes
    ----------
    reports
        Errors by stage of each board.
    images
        |H image| before and after synchronisation, [ny, nx].
    profiles
        |Range profile| of the middle row before and after, [position, range], and `range_m`, the excess path. That
        after is of decimated chirps, which show paths beyond 1 m too weak.
    extent_mm
        Left, right, bottom, top edge of the images from their centre.
    """

    reports: dict[str, SyncReport]
    images: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
    profiles: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
    range_m: npt.NDArray[np.float64]
    extent_mm: tuple[float, float, float, float]


@cache
def sync_scan(run: Run) -> SyncScan:
    """Simulate a scan of three metal plates with all disturbances, and synchronise it.

    "Before" is the first chirp of each position as the hardware trigger left it, mixed down by one frequency for the
    whole scan, so that the object lies in the range gate at all; "after" is the pipeline's.
    """
    # Without a permittivity a plate is metal; the numbers are x and y of its centre, mm.
    plates = [plate("copper", None, 0.0, 0.0), plate("left", None, -60.0, 40.0), plate("right", None, 60.0, -40.0)]
    with simulate_scan("three metal plates", plates, run.config, seed=1200) as (source, _):
        rig = source.instrument
        chirp = rig.chirp
        board = rig.receivers[0].name
        setups = {b.name: BoardSetup.from_rig(rig, b) for b in rig.receivers}
        rx = len(rig.antennas.rx_mm)
        reports = {n: SyncReport(chirp.sample_rate_hz, chirp.linear_samples, rx) for n in setups}
        builder_before = ImageBuilder(rig)
        builder_after = ImageBuilder(rig)
        middle = source.plan.rows // 2
        before = np.zeros((0, 0), np.float32)
        after = before
        carrier = None
        for row in source.rows():
            for name, setup in setups.items():
                data = source.read_row(name, row)
                words, valid = view_row_words(data.payload, data.missing, data.frames_expected, chirp.samples, rx)
                synced = synchronise_row(words, valid, setup)
                reports[name].add(synced)
                raw, _ = decode_row(data.payload, data.missing, data.frames_expected, chirp.samples, rx)
                if carrier is None:
                    carrier = float(np.median(synced.direct_hz)) / chirp.sample_rate_hz
                # The first chirp of each burst, [rx, position, sample].
                mixed = raw[:, :: rig.burst.pulses] * np.exp(-2j * np.pi * carrier * np.arange(chirp.samples))
                # All samples of the chirp, where synchronised rows are decimated; and no estimate of the phase's turn
                # from position to position, so that motion in the bursts is not changed.
                unsynchronised = replace(
                    synced, samples=mixed.astype(np.complex64), sweep_hz=sample_frequencies_hz(chirp), turn=None
                )
                builder_before.add_row(name, row, unsynchronised)
                builder_after.add_row(name, row, synced)
                if name == board and row == middle:
                    a, b = chirp.linear_samples
                    before = _compute_range_profile(mixed[0, :, a:b], 1)
                    after = _compute_range_profile(synced.samples[0], FOLD)
        # The first receiver is that of H; the other results of `image` are its footprint and a notice.
        images = [np.abs(b.boards[board].image()[0]).astype(np.float32) for b in (builder_before, builder_after)]
        grid = builder_after.grid
    # At a path of c / hz_per_sample the IF is the sample rate, which cannot be distinguished from 0.
    range_m = np.arange(_RANGE_BINS) / _RANGE_BINS * SPEED_OF_LIGHT_M_S / chirp.hz_per_sample
    bins = int((range_m < _SHOWN_M).sum())
    x = (grid.x_m[[0, -1]] - grid.x_m[[0, -1]].mean()) * 1e3
    y = (grid.y_m[[0, -1]] - grid.y_m[[0, -1]].mean()) * 1e3
    return SyncScan(
        reports,
        (images[0], images[1]),
        (before[:, :bins], after[:, :bins]),
        range_m[:bins],
        (float(x[0]), float(x[1]), float(y[0]), float(y[1])),
    )


def _compute_range_profile(samples: npt.NDArray[np.complexfloating], step: int) -> npt.NDArray[np.float32]:
    """Return |range profile| of samples [position, sample] under Hann's window, [position, range].

    `step` is the distance of the samples, in samples of the chirp: the bins are the same for any.
    """
    spectrum = np.fft.fft(samples * np.hanning(samples.shape[1]), _RANGE_BINS // step)
    return np.abs(spectrum).astype(np.float32)


def fig12(run: Run) -> Item:
    """Draw range profiles of a row and the image of H, before and after synchronisation."""
    scan = sync_scan(run)
    fig = new_figure(11.5, 8.4)
    contrast = []
    for line, image, profile, when in zip(
        fig.subplots(2, 2), scan.images, scan.profiles, ("hardware trigger alone", "all stages"), strict=True
    ):
        level = 20 * np.log10(np.maximum(profile / profile.max(), 1e-4))
        extent = (float(scan.range_m[0]), float(scan.range_m[-1]), 0.0, float(len(profile)))
        picture = line[0].imshow(
            level,
            extent=extent,
            origin="lower",
            aspect="auto",
            cmap="cividis",
            vmin=-40,
            vmax=0,
            interpolation="nearest",
        )
        style_axes(line[0], f"{when}: range profiles", "path beyond the direct path (m)", "position in the middle row")
        fig.colorbar(picture, ax=line[0], fraction=0.046, pad=0.02).set_label("dB", fontsize=8)
        level = 20 * np.log10(np.maximum(image / image.max(), 1e-4))
        picture = line[1].imshow(
            level, extent=scan.extent_mm, origin="lower", cmap="cividis", vmin=-30, vmax=0, interpolation="nearest"
        )
        style_axes(line[1], f"{when}: image of H", "x (mm)", "y (mm)")
        fig.colorbar(picture, ax=line[1], fraction=0.046, pad=0.02).set_label("dB, 0 = its maximum", fontsize=8)
        for ax in line:
            ax.grid(visible=False)
        contrast.append(float(20 * np.log10(image.max() / np.median(image))))
    return Item(
        "fig12",
        "Fig. 12: before and after synchronisation",
        (
            "Three copper plates. With the hardware trigger alone every position has its own delay and phase, and no"
            f" image forms: its maximum is {contrast[0]:.0f} dB above the median pixel; after all stages"
            f" {contrast[1]:.0f} dB. The published figure is a picture that says the same.",
        ),
        (),
        {"synchronisation": Picture(fig, "Range profiles and image of H, above without, below with synchronisation.")},
        {"peak_over_median_db": {"before": contrast[0], "after": contrast[1]}},
    )


def fig15(run: Run) -> Item:
    """Return the standard deviation of frequency, phase and amplitude after each stage, and the Cramer-Rao bounds."""
    paper = published_values()
    published = {"frequency_hz": paper["frequency_std_hz"], "phase_rad": paper["phase_std_rad"]}
    summary: dict[str, Any] = {name: r.summary() for name, r in sync_scan(run).reports.items()}
    fig = new_figure(11.5, 4.4)
    chirps = " and ".join(f"{c['chirps']} chirps of {b}" for b, c in summary.items())
    for ax, quantity, unit in zip(fig.subplots(1, 3), QUANTITIES, UNITS, strict=True):
        _draw_stages(ax, summary, quantity, published.get(quantity))
        style_axes(ax, unit, "", f"standard deviation of {unit}")
        ax.set_xticks(range(len(STAGES)), list(STAGES), fontsize=8)
        ax.legend(fontsize=7.5, frameon=False)
    head = ("Board, stage", *(f"{unit}, {w}" for unit in ("Hz", "rad") for w in ("simulated", "published")))
    head += ("amplitude, simulated",)
    return Item(
        "fig15",
        "Fig. 15: errors by stage of synchronisation",
        (
            "Standard deviations after each stage. The paper took 640,000 chirps of a metal reflector; here"
            f" {chirps}. Its stages are not quite these; its two published numbers stand beside the last one, which is"
            " measured on the echo of the object.",
        ),
        (Table("Standard deviation after each stage", head, _tabulate_stages(summary, published)),),
        {"stages": Picture(fig, "Errors after each stage, on a logarithmic axis, with the bounds of one tone.")},
        summary,
    )


def _draw_stages(ax: Axes, summary: Mapping[str, Any], quantity: str, published: float | None) -> None:
    """Draw the standard deviation of a quantity after each stage, its bounds, and the published value, if any.

    `summary`: by board, as of `SyncReport.summary`; two boards.
    """
    # Circles and squares.
    styles = (("o", PALETTE[0]), ("s", PALETTE[6]))
    for i, (board, content) in enumerate(summary.items()):
        marker, colour = styles[i]
        stages = content["stages"]
        # The two boards stand side by side at each stage.
        positions = np.array([list(STAGES).index(s) for s in stages]) + 0.12 * (2 * i - 1)
        values = [s[f"{quantity}_std"] for s in stages.values()]
        ax.plot(positions, values, marker, ms=7, color=colour, label=f"{board}, simulated")
        key = f"{quantity}_bound"
        bound = [(x, s[key]) for x, s in zip(positions, stages.values(), strict=True) if key in s]
        ax.plot(*zip(*bound, strict=True), "_", ms=16, mew=1.6, color=INK, label=None if i else "Cramér-Rao bound")
    ax.set_yscale("log")
    if published is not None:
        ax.axhline(published, color=PALETTE[2], ls="--", lw=1.2, label=f"published, all stages: {published:g}")
        ax.yaxis.set_minor_formatter(NullFormatter())
    else:
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_locator(LogLocator(subs=(2, 5)))
        ax.yaxis.set_minor_formatter("{x:g}")
        ax.tick_params(axis="y", which="minor", labelsize=7)
    ax.margins(y=0.25)


def _tabulate_stages(summary: Mapping[str, Any], published: Mapping[str, float]) -> tuple[tuple[str, ...], ...]:
    """Return table lines for each board and stage, with the published values in the line of the last stage."""
    rows = []
    for board, content in summary.items():
        for name, s in content["stages"].items():
            # The published values hold for the last stage, and the amplitude has none: its cell is cut off.
            printed = [f"{published[q]:g}" if name == "referenced" and q in published else "" for q in QUANTITIES]
            simulated = [f"{s[f'{q}_std']:.4g}" for q in QUANTITIES]
            cells = [x for pair in zip(simulated, printed, strict=True) for x in pair]
            rows.append((f"{board}, {name}: {STAGES[name]}", *cells[:-1]))
    return tuple(rows)


def tones(chirps: npt.NDArray[np.complex64], chirp: Chirp) -> tuple[npt.NDArray, npt.NDArray]:
    """Return IF (Hz) and amplitude of the strongest tone of each chirp, both [chirp], of chirps [rx, chirp, sample].

    Power is summed over RX.
    The peak of the zero-padded spectrum: with 4096 points, a peak between two of them loses less than 0.1 %.
    """
    a, b = chirp.linear_samples
    window = np.hanning(b - a)
    spectrum = np.fft.fft(chirps[..., a:b] * window, _PADDED, axis=-1)
    power = (np.abs(spectrum) ** 2).sum(axis=0)
    peak_bin = power.argmax(axis=-1)
    amplitude = np.sqrt(power[np.arange(len(peak_bin)), peak_bin]) / window.sum()
    return peak_bin / _PADDED * chirp.sample_rate_hz, amplitude


def skirt_db(
    chirps: npt.NDArray[np.complex64], rate_hz: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Mean spectrum of chirps [..., sample] about their strongest tone: IF from it (Hz), level (dB, 0 at the peak).

    Hann window. Chirps are laid over each other at their peaks, and their power is averaged.
    """
    spectrum = np.fft.fft(chirps * np.hanning(chirps.shape[-1]), _PADDED, axis=-1).reshape(-1, _PADDED)
    power = np.abs(spectrum) ** 2
    laid = np.mean([np.roll(p, _PADDED // 2 - int(p.argmax())) / p.max() for p in power], axis=0)
    return (np.arange(_PADDED) / _PADDED - 0.5) * rate_hz, 10 * np.log10(laid)


def _sweep_start_frequencies(run: Run, chirp: Chirp) -> tuple[npt.NDArray, npt.NDArray, Complex]:
    """Simulate the direct path alone at all start frequencies; return IF (Hz) and amplitude [n] of the chirps in band.

    The third result is all chirps of the usual start frequency, [rx, chirp, sample].
    """
    swept = []
    example = np.zeros((1, 1, chirp.samples), np.complex64)
    for offset in OFFSETS_HZ:
        scene = {"grid": GRID, "disturbances": {"if_offset_hz": offset}}
        with simulate_scan("direct path", (), run.config, seed=900, **scene) as (source, _):
            rig = source.instrument
            data = source.read_row(rig.receivers[0].name, 0)
            rx = len(rig.antennas.rx_mm)
            chirps, valid = decode_row(data.payload, data.missing, data.frames_expected, chirp.samples, rx)
        swept.append(tones(chirps[:, valid], chirp))
        if offset == USUAL_HZ:
            example = chirps[:, valid]
    if_hz, amplitude = (np.concatenate(part) for part in zip(*swept, strict=True))
    # Of aliases beyond the receiver's passband, and of tones near zero, the filter says nothing; chosen.
    in_band = (if_hz > 0.05 * chirp.sample_rate_hz) & (if_hz < 0.9 * chirp.sample_rate_hz)
    return if_hz[in_band], amplitude[in_band], example


def _draw_spectrogram(ax: Axes, samples: Complex, chirp: Chirp) -> None:
    """Draw the spectrogram of one chirp [sample], and the end of its used part."""
    f, t, power = scipy.signal.spectrogram(
        samples, chirp.sample_rate_hz, nperseg=48, noverlap=44, nfft=256, return_onesided=False
    )
    # The IF is 0 to the sample rate, not -1/2 to 1/2 of it.
    f = f % chirp.sample_rate_hz
    order = np.argsort(f)
    level = 10 * np.log10(power[order] / power.max())
    picture = ax.pcolormesh(t * 1e6, f[order] / 1e6, level, cmap="cividis", vmin=-35, vmax=0, rasterized=True)
    ax.axvline(chirp.linear_samples[1] / chirp.sample_rate_hz * 1e6, color="w", ls="--", lw=1)
    style_axes(ax, "Spectrogram of one chirp", "time in the ADC window (µs)", "IF (MHz)")
    ax.grid(visible=False)
    ax.figure.colorbar(picture, ax=ax, fraction=0.046, pad=0.02).set_label("dB", fontsize=8)


def _draw_skirts(ax: Axes, chirps: Complex, chirp: Chirp) -> dict[str, float]:
    """Draw spectra about the tone of whole chirps and of their used part; return the mean level of their smear, dB."""
    smear = {}
    parts = {"whole chirp": ((0, chirp.samples), PALETTE[6]), "used part": (chirp.linear_samples, INK)}
    for part, ((first, last), colour) in parts.items():
        distance_hz, level = skirt_db(chirps[..., first:last], chirp.sample_rate_hz)
        near = (np.abs(distance_hz) > SKIRT_HZ[0]) & (np.abs(distance_hz) < SKIRT_HZ[1])
        smear[part] = float(10 * np.log10(np.mean(10 ** (level[near] / 10))))
        ax.plot(distance_hz / 1e6, level, color=colour, lw=1.2, label=part)
    style_axes(ax, "Spectrum about the tone", "IF from the tone (MHz)", "dB, 0 = peak")
    ax.set_xlim(-0.6, 0.6)
    ax.legend(fontsize=8, frameon=False, loc="upper right")
    return smear


def _draw_filter(ax: Axes, if_hz: npt.NDArray, amplitude: npt.NDArray, fitted: HighPass, programmed: HighPass) -> None:
    """Draw the sweep's amplitude, scaled to the fitted filter's gain, against IF, and both filters' gains."""
    grid_hz = np.linspace(if_hz.min(), if_hz.max(), 300)
    ax.plot(if_hz / 1e6, 20 * np.log10(amplitude), ".", ms=3, color=PALETTE[1], label="sweep, simulated")
    for model, colour, style, name in ((fitted, INK, "-", "fitted"), (programmed, PALETTE[6], "--", "programmed")):
        corners = ", ".join(f"{c / 1e3:.0f}" for c in model.corners_hz)
        response = 20 * np.log10(np.abs(model.response(grid_hz)))
        ax.plot(grid_hz / 1e6, response, color=colour, ls=style, lw=1.5, label=f"{name}: {corners} kHz")
    style_axes(ax, "High-pass filter", "IF (MHz)", "gain (dB)")
    ax.legend(fontsize=8, frameon=False, loc="lower right")


def fig9(run: Run) -> Item:
    """Draw the direct path alone, received at ten start frequencies of the receiver."""
    chirp = load_instrument(run.config).chirp
    if_hz, amplitude, example = _sweep_start_frequencies(run, chirp)
    fitted = fit_high_pass(if_hz, amplitude)
    programmed = high_pass(chirp)
    # The sweep's own level is taken out: the geometric mean of its ratio to the fitted filter.
    amplitude = amplitude / np.exp(np.mean(np.log(amplitude / np.abs(fitted.response(if_hz)))))

    fig = new_figure(11.5, 4.2)
    left_axes, centre, right = fig.subplots(1, 3)
    _draw_spectrogram(left_axes, example[0, 0], chirp)
    smear = _draw_skirts(centre, example, chirp)
    _draw_filter(right, if_hz, amplitude, fitted, programmed)

    grid_hz = np.linspace(if_hz.min(), if_hz.max(), 300)
    response = np.abs(fitted.response(grid_hz)) / np.abs(programmed.response(grid_hz))
    worst = float(np.abs(20 * np.log10(response / np.exp(np.mean(np.log(response))))).max())
    rows = tuple(
        (f"corner {i + 1}", *(f"{m.corners_hz[i] / 1e3:.0f} kHz" for m in (programmed, fitted))) for i in (0, 1)
    )
    return Item(
        "fig9",
        "Fig. 9: spectrogram of a chirp, and the high-pass response",
        (
            "Left, one chirp of the direct path: it bends at its end, and the samples right of the dashed line are not"
            " used. Centre, the mean spectrum of the chirps: 60 to 200 kHz from the tone it lies at"
            f" {smear['whole chirp']:.1f} dB for whole chirps and at {smear['used part']:.1f} dB for the used part. In"
            " the paper the bends raise it at all frequencies; the simulated chirp bends less, and noise is all there"
            " is. Right, the"
            f" direct path's amplitude in {if_hz.size} chirps while the receiver's start frequency is moved over"
            f" {len(OFFSETS_HZ)} values, and the filter fitted to it: two first-order sections (an LCCDE). Over the"
            f" swept band its gain is within {worst:.2f} dB of the programmed one's. The paper gives no numbers for"
            " this figure.",
        ),
        (Table("Corners of the receiver's filter", ("", "programmed", "fitted, simulated"), rows),),
        {"receiver": Picture(fig, "Spectrogram of one chirp; mean spectrum; amplitude against IF with the filter.")},
        {
            "if_hz": if_hz,
            "amplitude": amplitude,
            "fitted_corners_hz": fitted.corners_hz,
            "programmed_corners_hz": programmed.corners_hz,
            "largest_difference_db": worst,
        },
    )
