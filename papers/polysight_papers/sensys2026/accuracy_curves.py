"""Accuracy of names against spread of specimens, noise, error of the angle, and tilt of plates (part of Fig. 18).

Solids at 60 degrees, a library of other specimens, patches of 12 pixels with the noise of `patches.py`. Where the error
budget includes a condition, the discriminant gets its size, as in processing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from polysight.materials import DISCRIMINANT, MODELS, Model, Samples, SceneErrors, feature_matrix
from polysight.polarimetry import fresnel, permittivity_from_ratio
from polysight.report import PALETTE
from polysight_papers.sensys2026.item import Picture, dress, new_figure
from polysight_papers.sensys2026.patches import Errors, calibrated_errors
from polysight_papers.sensys2026.specimen_spread import LIBRARY_SCANS, bayes, both_angles, by_patch

ANGLE_DEG = 60.0
SPREAD = (0.01, 0.05)
TILT_LEFT, TILT_ALL = 0.004, 0.025
"""Error of V / H a degree of tilt with and without the plate's own tilt taken out, in simulated scenes
(tests/process/test_tilts.py)."""
Real = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """Shares of patches named right and wrong against a condition; the rest is called unknown."""

    label: str
    at: tuple[float, ...]
    right: tuple[float, ...]
    wrong: tuple[float, ...]
    bound: tuple[float, ...] = ()


Change = Callable[[Samples, np.random.Generator, float], Samples]
Budget = Callable[[Samples, float], SceneErrors | None]


def curves(quick: bool) -> tuple[tuple[str, str, tuple[Curve, ...]], ...]:
    """Title, unit and curves of the four panels."""
    base = replace(calibrated_errors("solids", 1 if quick else 3), spread=SPREAD)
    step = 3 if quick else 1
    spreads, noises = (0.0, 1.0, 2.0, 5.0)[::step], (0.5, 1.0, 2.0, 4.0)[::step]
    angles, tilts = (0.0, 0.25, 0.5, 1.0)[::step], (0.0, 0.5, 1.0, 2.0)[::step]
    differing = [replace(base, spread=(s / 100, s / 20)) for s in spreads]
    noisy = [replace(base, amplitude=n * base.amplitude, phase_rad=n * base.phase_rad) for n in noises]
    taught = _taught(base)
    return (
        ("Specimens' spread", "of the real part, % (loss: 5 times that)", (_known(spreads, differing, quick),)),
        ("Noise", "beside that of Fig. 18", (_known(noises, noisy, quick),)),
        ("Angle off by", "degrees", (
            _changed("known to the budget", angles, taught, base, quick, _no_change, _angle_budget, off=True),
            _changed("unknown to the budget", angles, taught, base, quick, _no_change, _nothing, off=True),
        )),
        ("Plates tilted by", "degrees across the plane of incidence", (
            _changed("tilt taken out", tilts, taught, base, quick, _gains(TILT_LEFT), _nothing),
            _changed("tilt left in", tilts, taught, base, quick, _gains(TILT_ALL), _nothing),
        )),
    )  # fmt: skip


def _taught(errors: Errors) -> Model:
    return MODELS[DISCRIMINANT]("H+V+P").fit(both_angles("solids", (ANGLE_DEG,), errors, 41, LIBRARY_SCANS))


def _known(at: Sequence[float], errors: Sequence[Errors], quick: bool) -> Curve:
    """Return the curve of a condition that is equal for library and scans, with Bayes' bound."""
    judged = [_judge(_taught(e), _drawn(e, ANGLE_DEG, quick)) for e in errors]
    bounds = tuple(bayes("solids", (ANGLE_DEG,), e, quick) for e in errors)
    return Curve("found", tuple(at), *_columns(judged), bounds)


def _changed(
    label: str,
    at: Sequence[float],
    model: Model,
    errors: Errors,
    quick: bool,
    change: Change,
    budget: Budget,
    off: bool = False,
) -> Curve:
    """Return the curve of a condition that only scans have; `off`: scans have a larger or smaller incidence angle."""
    judged = []
    for value in at:
        right = wrong = 0.0
        for side in (-1, 1):
            rng = np.random.default_rng([7, side + 1])
            test = change(_drawn(errors, ANGLE_DEG + side * value * off, quick), rng, value)
            one = _judge(model, test, lambda mine, value=value: budget(mine, value))
            right, wrong = right + one[0] / 2, wrong + one[1] / 2
        judged.append((right, wrong))
    return Curve(label, tuple(at), *_columns(judged))


def _drawn(errors: Errors, angle_deg: float, quick: bool) -> Samples:
    return both_angles("solids", (angle_deg,), errors, 500, 2 if quick else 10)


def _judge(
    model: Model, test: Samples, budget: Callable[[Samples], SceneErrors | None] = lambda _: None
) -> tuple[float, float]:
    """Shares of patches named right, and wrong."""
    named, right, _ = by_patch(model, test, budget)
    return float((named & right).mean()), float((named & ~right).mean())


def _columns(judged: Sequence[tuple[float, float]]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    right, wrong = zip(*judged, strict=True)
    return right, wrong


def _no_change(test: Samples, rng: np.random.Generator, value: float) -> Samples:
    del rng, value
    return test


def _gains(share: float) -> Change:
    """V of every patch off by `share` a degree, either way."""

    def change(test: Samples, rng: np.random.Generator, degrees: float) -> Samples:
        _, patch = np.unique(test.patches, return_inverse=True)
        gain = np.exp(share * degrees * rng.choice([-1.0, 1.0], patch.max() + 1))[patch]
        p = 1 / ((test.x[:, 2] + 1j * test.x[:, 3]) * gain)
        return replace(test, x=feature_matrix(test.x[:, 0], test.x[:, 1] * gain, p))

    return change


def _nothing(mine: Samples, value: float) -> None:
    del mine, value


def _angle_budget(mine: Samples, degrees: float) -> SceneErrors:
    """The budget of a scan whose angle is known to so many degrees (at least 0.05)."""
    std, angle = np.radians(max(degrees, 0.05)), np.radians(ANGLE_DEG)
    patches = np.unique(mine.patches)
    columns = np.zeros((patches.size, 3, 1))
    for i, p in enumerate(patches):
        q = np.mean(mine.x[mine.patches == p, 2] + 1j * mine.x[mine.patches == p, 3])
        eps = complex(permittivity_from_ratio(q, angle))
        (s, v), (other_s, other_v) = (fresnel(eps, a) for a in (angle, angle + std))
        turned = float(np.angle((other_s / other_v) / (s / v)))
        columns[i, :, 0] = np.log(np.abs(other_s / s)), np.log(np.abs(other_v / v)), turned
    return SceneErrors(np.zeros((patches.size, 3, 3)), columns, np.eye(1))


def curves_picture(quick: bool) -> Picture:
    """The four panels."""
    fig = new_figure(9.0, 6.4)
    axes = fig.subplots(2, 2, sharey=True).ravel()
    for ax, (title, unit, lines) in zip(axes, curves(quick), strict=True):
        for k, line in enumerate(lines):
            colour = PALETTE[k]
            ax.plot(line.at, 100 * np.array(line.right), color=colour, marker="o", ms=4, label=f"right, {line.label}")
            ax.plot(
                line.at,
                100 * np.array(line.wrong),
                color=colour,
                ls=":",
                marker="x",
                ms=4,
                label=f"wrong, {line.label}",
            )
            if line.bound:
                ax.plot(line.at, 100 * np.array(line.bound), color=PALETTE[5], ls="--", label="Bayes bound")
        dress(ax, title, unit, "patches (%)")
        ax.set_ylim(-3, 103)
        ax.legend(fontsize=7, frameon=False, loc="center left")
    return Picture(
        fig,
        f"{DISCRIMINANT}, 23 solids at {ANGLE_DEG:.0f}°, {LIBRARY_SCANS} other specimens of each in the library;"
        f" simulated. Where not on the axis, spread is {100 * SPREAD[0]:g} / {100 * SPREAD[1]:g} % and noise that of"
        " Fig. 18. What is neither right nor wrong is called unknown. A tilt is the error of V / H that it leaves"
        f" ({100 * TILT_LEFT:g} % a degree, {100 * TILT_ALL:g} % left in), as measured in simulated scenes.",
    )
