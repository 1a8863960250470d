"""Fig. 9: spectrogram of a chirp, and the receiver's high-pass response from a sweep of its start frequency."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import signal

from polysight.host.capture.decode import decode_row
from polysight.host.report.figures import INK, PALETTE
from polysight.host.reproduce.item import Item, Picture, Run, Table, dress, new_figure
from polysight.host.reproduce.scenes import scanned
from polysight.host.sync.hpf import fit_high_pass, high_pass
from polysight.shared.config import Chirp, load_instrument

GRID = {"columns": 6, "rows": 1, "step_x_mm": 10.0, "step_y_mm": 6.0}
OFFSETS_HZ = (200e3, 250e3, 350e3, 450e3, 600e3, 870e3, 1.1e6, 1.3e6, 1.5e6, 1.7e6)
USUAL_HZ = 870e3
SKIRT_HZ = (60e3, 200e3)
"""Where the smear of a bent chirp lies, from its tone."""
_PADDED = 4096


def tones(chirps: npt.NDArray[np.complex64], chirp: Chirp) -> tuple[npt.NDArray, npt.NDArray]:
    """IF (Hz) and amplitude of the strongest tone of each chirp [rx, chirp, sample], summed in power over RX.

    The peak of the zero-padded spectrum; 4096 points keep its loss from falling between them below 0.1 %.
    """
    a, b = chirp.linear_samples
    window = np.hanning(b - a)
    spectrum = np.fft.fft(chirps[..., a:b] * window, _PADDED, axis=-1)
    power = (np.abs(spectrum) ** 2).sum(axis=0)
    at = power.argmax(axis=-1)
    amplitude = np.sqrt(power[np.arange(len(at)), at]) / window.sum()
    return at / _PADDED * chirp.sample_rate_hz, amplitude


def skirt_db(
    chirps: npt.NDArray[np.complex64], rate_hz: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Mean spectrum of chirps [..., sample] about their strongest tone: IF from it (Hz), level (dB below the peak).

    Hann window. Chirps are laid over each other at their peaks, and their power is averaged.
    """
    spectrum = np.fft.fft(chirps * np.hanning(chirps.shape[-1]), _PADDED, axis=-1).reshape(-1, _PADDED)
    power = np.abs(spectrum) ** 2
    laid = np.mean([np.roll(p, _PADDED // 2 - int(p.argmax())) / p.max() for p in power], axis=0)
    return (np.arange(_PADDED) / _PADDED - 0.5) * rate_hz, 10 * np.log10(laid)


def fig9(run: Run) -> Item:
    """The direct path alone, received at ten start frequencies of the receiver."""
    swept, chirp = [], load_instrument(run.config).chirp
    shown = np.zeros((1, 1, chirp.samples), np.complex64)
    for offset in OFFSETS_HZ:
        disturbances = {"if_offset_hz": offset}
        with scanned("direct path", (), run.config, 900, grid=GRID, disturbances=disturbances) as (source, _):
            data = source.read_row(source.instrument.receivers[0].name, 0)
        chirps, valid = decode_row(data.payload, data.missing, data.frames_expected, chirp.samples)
        swept.append(tones(chirps[:, valid], chirp))
        if offset == USUAL_HZ:
            shown = chirps[:, valid]
    if_hz, amplitude = (np.concatenate(part) for part in zip(*swept, strict=True))
    heard = (if_hz > 0.05 * chirp.sample_rate_hz) & (if_hz < 0.9 * chirp.sample_rate_hz)
    if_hz, amplitude = if_hz[heard], amplitude[heard]
    fitted, programmed = fit_high_pass(if_hz, amplitude), high_pass(chirp)

    fig = new_figure(11.5, 4.2)
    left, centre, right = fig.subplots(1, 3)
    f, t, power = signal.spectrogram(
        shown[0, 0], chirp.sample_rate_hz, nperseg=48, noverlap=44, nfft=256, return_onesided=False
    )
    f, power = np.fft.fftshift(f % chirp.sample_rate_hz), np.fft.fftshift(power, axes=0)
    order = np.argsort(f)
    level = 10 * np.log10(power[order] / power.max())
    picture = left.pcolormesh(t * 1e6, f[order] / 1e6, level, cmap="cividis", vmin=-35, vmax=0, rasterized=True)
    edge_us = chirp.linear_samples[1] / chirp.sample_rate_hz * 1e6
    left.axvline(edge_us, color="w", ls="--", lw=1)
    dress(left, "Spectrogram of one chirp", "time in the ADC window (µs)", "IF (MHz)")
    left.grid(visible=False)
    fig.colorbar(picture, ax=left, fraction=0.046, pad=0.02).set_label("dB", fontsize=8)

    smear = {}
    parts = {"whole chirp": ((0, chirp.samples), PALETTE[6]), "used part": (chirp.linear_samples, INK)}
    for part, ((first, last), colour) in parts.items():
        apart, level = skirt_db(shown[..., first:last], chirp.sample_rate_hz)
        near = (np.abs(apart) > SKIRT_HZ[0]) & (np.abs(apart) < SKIRT_HZ[1])
        smear[part] = float(10 * np.log10(np.mean(10 ** (level[near] / 10))))
        centre.plot(apart / 1e6, level, color=colour, lw=1.2, label=part)
    dress(centre, "Spectrum about the tone", "IF from the tone (MHz)", "dB, 0 = peak")
    centre.set_xlim(-0.6, 0.6)
    centre.legend(fontsize=8, frameon=False, loc="upper right")

    at = np.linspace(if_hz.min(), if_hz.max(), 300)
    gain = np.exp(np.mean(np.log(amplitude / np.abs(fitted.response(if_hz)))))
    right.plot(if_hz / 1e6, 20 * np.log10(amplitude / gain), ".", ms=3, color=PALETTE[1], label="sweep, simulated")
    for model, colour, style, name in ((fitted, INK, "-", "fitted"), (programmed, PALETTE[6], "--", "programmed")):
        corners = ", ".join(f"{c / 1e3:.0f}" for c in model.corners_hz)
        response = 20 * np.log10(np.abs(model.response(at)))
        right.plot(at / 1e6, response, color=colour, ls=style, lw=1.5, label=f"{name}: {corners} kHz")
    dress(right, "High-pass filter", "IF (MHz)", "gain (dB)")
    right.legend(fontsize=8, frameon=False, loc="lower right")

    response = np.abs(fitted.response(at)) / np.abs(programmed.response(at))
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
            "amplitude": amplitude / gain,
            "fitted_corners_hz": fitted.corners_hz,
            "programmed_corners_hz": programmed.corners_hz,
            "largest_difference_db": worst,
        },
    )
