"""Fig. 18 of the POLySIGHT paper (solids under one and two angles, liquids, powders, confusions), Fig. 20 (channels).

Pixels are drawn with the errors of `patches.py`. `pixel_bound` is the share that no classifier can pass.

A task is the name of a group of materials, with ", two angles" after it if each pixel is seen under both. H and V are
the pixels in both polarisations relative to metal, P is H / V; "H+V+P" uses all three. "By pixel" a pixel may be judged
by others of its own patch, which is optimistic; with scans left out it is not. `quick` draws less, for a first look.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from textwrap import fill
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from polysight.materials import (
    CHANNELS,
    DISCRIMINANT_MODEL,
    PAPER_MODEL,
    REJECTED_SHARE,
    Samples,
    Score,
    score,
    score_unseen_materials,
)
from polysight.polarimetry import fresnel
from polysight.report import INK, PALETTE
from polysight_papers.sensys2026.item import (
    Item,
    Picture,
    Published,
    Run,
    Table,
    new_figure,
    percent,
    published_values,
    style_axes,
)
from polysight_papers.sensys2026.patches import (
    PIXELS,
    SCANS,
    Errors,
    calibrated_errors,
    count_draws,
    draw,
    groups,
    spread_table,
)

# The second angle of the task of two angles, in the paper.
SECOND_ANGLE_DEG = 55.0
RESULT_SEED = 20
"""Seed of the draw that is judged (chosen)."""
TASKS = ("solids", "solids, two angles", "liquids", "powders")
OTHER_DRAWS = tuple(range(21, 29))
"""Seeds of further draws, for the random spread of one draw."""
# A score, one of its matrices of confusions [true, named], and a title.
Panel = tuple[Score, npt.NDArray[np.float64], str]
# Draws of each material for a bound. Chosen: its standard error is below 1 %.
TRIALS = 4000


@cache
def task_samples(task: str, seed: int, quick: bool) -> Samples:
    """Return the pixels of a task of Fig. 18, under one angle, or under both for the task of two angles."""
    name, _, two = task.partition(", ")
    group = groups()[name]
    errors = calibrated_errors(name, count_draws(quick))
    samples = draw(group.materials, group.angle_deg, errors, seed).samples()
    if not two:
        return samples
    # `draw` seeds errors by the angle too: those of both angles are independent, as `pixel_bound` assumes.
    return samples.join(draw(group.materials, SECOND_ANGLE_DEG, errors, seed).samples())


@cache
def score_simulated(task: str, model: str, channels: str, by_pixel: bool, quick: bool) -> Score:
    """Return the score of a model on the draw for the results.

    `model`: key of the host's models; `channels`: such as "H+V+P"; `by_pixel`: split by pixel, not by scan.
    """
    return score(task_samples(task, RESULT_SEED, quick), model, channels, by_pixel)


def noise_text(tasks: Iterable[str], quick: bool) -> str:
    """Return a note on the errors that pixels are drawn with, and how many pixels there are."""
    names = sorted({t.partition(", ")[0] for t in tasks})
    printed = ", ".join(f"{100 * calibrated_errors(n, count_draws(quick)).amplitude:.2f} % ({n})" for n in names)
    phase_std_rad = published_values()["phase_std_rad"]
    return (
        f"Amplitude errors, set so that H alone scores as published: {printed}; phase error {phase_std_rad:g} rad. A"
        f" scan is one placement of all materials with its own metal reference; {SCANS} scans, {PIXELS} pixels a patch."
    )


def _list_angles_deg(task: str) -> tuple[float, ...]:
    """Return the incidence angles of a task, degrees."""
    name, _, two = task.partition(", ")
    if two:
        return (groups()[name].angle_deg, SECOND_ANGLE_DEG)
    return (groups()[name].angle_deg,)


def accuracy_over_draws(quick: bool) -> Table:
    """Return the discriminant's accuracy over further draws of the same noise, and the Bayes limit."""
    seeds = OTHER_DRAWS
    if quick:
        seeds = OTHER_DRAWS[:2]
    rows = []
    for task in TASKS:
        name = task.partition(", ")[0]
        scores = [score(task_samples(task, seed, quick), DISCRIMINANT_MODEL) for seed in seeds]
        errors = calibrated_errors(name, count_draws(quick))
        # In the order of the kinds below.
        limits = [
            pixel_bound(groups()[name].materials, _list_angles_deg(task), errors, reference, pixels)
            for reference, pixels in ((True, 1), (False, 1), (False, PIXELS))
        ]
        cells = []
        for share, limit in zip(("pixels", "in_scan", "by_patch"), limits, strict=True):
            values = np.array([getattr(s, share) for s in scores])
            cells += [f"{100 * values.mean():.2f} ± {100 * values.std():.2f} %", percent(limit)]
        rows.append((f"{len(scores[0].names)} {task}", *cells))
    kinds = ("pixel alone", "pixel, scan known", "by patch, scan known")
    head = ("Task", *(f"{k}{w}" for k in kinds for w in (", found", ", bound")))
    caption = (
        f"The {DISCRIMINANT_MODEL} with scans left out, mean and spread over {len(seeds)} other draws;"
        " the bound is the best any classifier can do that knows every material's mean and the errors' sizes"
        " (and, where the scan is known, the reference's error)"
    )
    return Table(caption, head, tuple(rows))


def unknowns(quick: bool) -> Table:
    """Return the shares called unknown: patches of known materials, and of materials left out of training."""
    tasks = TASKS
    if quick:
        tasks = TASKS[:1]
    rows = []
    for task in tasks:
        drawn = task_samples(task, RESULT_SEED, quick)
        # For each material left out of training: the share of its patches that is rightly called unknown.
        called_unknown = score_unseen_materials(drawn, DISCRIMINANT_MODEL)
        mistaken = [n for n, share in called_unknown.items() if share < 0.5]
        rows.append(
            (
                f"{len(called_unknown)} {task}",
                percent(score_simulated(task, DISCRIMINANT_MODEL, "H+V+P", False, quick).unknown),
                percent(float(np.mean(list(called_unknown.values())))),
                ", ".join(mistaken) or "–",
            )
        )
    head = ("Task", "known, called unknown", "never learnt, called unknown", "taken for another more often than not")
    return Table(f"Patches called unknown; {REJECTED_SHARE:.0%} of the known ones are meant to be", head, tuple(rows))


@dataclass(frozen=True)
class TaskScores:
    """Scores of a task of Fig. 18: the paper's KNN and the discriminant.

    Fields that end in `_pixel` are of the split by pixel, the others of the split by scan.
    """

    task: str
    knn: Score
    knn_pixel: Score
    discriminant: Score
    discriminant_pixel: Score
    # The KNN on |H| alone, scans left out
    h: Score
    h_pixel: Score

    @staticmethod
    def score(task: str, quick: bool) -> TaskScores:
        """Judge both models on a task, and the KNN on |H| alone."""
        # In the order of the fields.
        scores = [
            score_simulated(task, model, channels, by_pixel, quick)
            for model, channels in ((PAPER_MODEL, "H+V+P"), (DISCRIMINANT_MODEL, "H+V+P"), (PAPER_MODEL, "H"))
            for by_pixel in (False, True)
        ]
        return TaskScores(task, *scores)

    def row(self) -> tuple[str, ...]:
        """Return a line of the table, published and simulated shares."""
        name, _, two_angles = self.task.partition(", ")
        published_h = None
        if not two_angles:
            published_h = published_values()["classification"][name]["h_percent"] / 100
        return (
            f"{len(self.knn.names)} {self.task}",
            percent(published_h),
            percent(self.h_pixel.pixels),
            percent(published_percent(self.task) / 100),
            percent(self.knn_pixel.pixels),
            percent(self.knn.pixels),
            percent(self.discriminant_pixel.pixels),
            percent(self.discriminant.pixels),
            percent(self.discriminant.in_scan),
            percent(self.discriminant.by_patch),
        )

    def to_json(self, quick: bool) -> dict[str, Any]:
        """Return the task's part of the JSON file."""
        return {
            "published_percent": published_percent(self.task),
            "simulated": [asdict(s) for s in (self.knn_pixel, self.knn, self.discriminant_pixel, self.discriminant)],
            "h_only_pixel_split": self.h_pixel.pixels,
            "errors": asdict(calibrated_errors(self.task.partition(", ")[0], count_draws(quick))),
        }

    def picture(self) -> Picture:
        """Return the confusion matrices of H alone, and of the discriminant for pixels and patches; scans left out."""
        task = self.task
        angle = " and ".join(f"{a:.0f}°" for a in _list_angles_deg(task))
        return Picture(
            confusion_figure(groups()[task.partition(", ")[0]].materials, self.h, self.discriminant),
            f"{task[0].upper()}{task[1:]} at {angle}, whole scans left out. Rows are the truth and add up to 100 %; the"
            " numbers are those of Table 2.",
        )


def published_percent(task: str) -> float:
    """Return the paper's accuracy with H, V and P; `task` is the name of a group, with ", two angles" for both."""
    name, _, two_angles = task.partition(", ")
    published = published_values()["classification"][name]
    if two_angles:
        return published["two_angles_percent"]
    return published["all_percent"]


def fig18(run: Run) -> Item:
    """Return the accuracy of the paper's KNN and of the discriminant under both splits, with confusion matrices."""
    scores = [TaskScores.score(task, run.quick) for task in TASKS]
    head = (
        "Task",
        "H, published",
        "H, simulated",
        "H+V+P, published",
        "KNN, by pixel (optimistic)",
        "KNN, scans left out",
        "discriminant, by pixel (optimistic)",
        "discriminant, scans left out: pixel alone",
        "… pixel, scan known",
        "… by patch",
    )
    return Item(
        "fig18",
        "Fig. 18: classification of solids, liquids and powders",
        (
            "Published beside simulated. The paper does not say how training and test pixels were kept apart; its "
            "numbers fit a split by pixel, which is optimistic: pixels of one patch are then in both sets. With "
            "whole scans left out, no pixel of a test scan was ever trained on. The column “H, simulated” is by "
            "pixel, as that is what the noise was set on; it differs from the published one by the chance of another "
            "draw.",
            "The KNN's weights λ_H, λ_V, λ_P are fitted on the training pixels of every fold, whole scans left out"
            " there too.",
            "“Pixel alone” uses only the pixel. “Scan known” also uses the features of the scan's other patches, "
            "but not their names: they show the error of the metal reference, which they all share. “By patch” also "
            "uses the mean of a patch's pixels; each pixel counts as its patch.",
            noise_text(TASKS, run.quick),
            "Nine liquids where the paper counts eight: Table 2 lists nine, and the paper does not say which one it "
            "left out.",
        ),
        (
            Table("Share of pixels named right, mean over materials", head, tuple(s.row() for s in scores)),
            accuracy_over_draws(run.quick),
            spread_table(run.quick),
            unknowns(run.quick),
        ),
        {s.task.replace(", ", "-").replace(" ", "-"): s.picture() for s in scores},
        {s.task: s.to_json(run.quick) for s in scores},
    )


def fig20(run: Run) -> Item:
    """H, V, P alone and together: the paper's KNN under both splits."""
    printed = published_values()["channels_percent"]
    rows = []
    data = {}
    tasks = ("solids", "liquids", "powders")
    weight = [len(groups()[t].materials) for t in tasks]
    fig = new_figure(8.4, 4.2)
    ax = fig.subplots()
    bars = []
    for channel in CHANNELS:
        by_pixel = [score_simulated(t, PAPER_MODEL, channel, True, run.quick).pixels for t in tasks]
        left_out = [score_simulated(t, PAPER_MODEL, channel, False, run.quick).pixels for t in tasks]
        means = [float(np.average(x, weights=weight)) for x in (by_pixel, left_out)]
        rows.append((channel, f"{printed[channel]:.2f} %", *(percent(x) for x in (*means, *left_out))))
        bars.append((printed[channel], 100 * means[0], 100 * means[1]))
        data[channel] = {"published_percent": printed[channel], "by_pixel": means[0], "scans_left_out": means[1]}
        data[channel] |= {f"{t}_scans_left_out": x for t, x in zip(tasks, left_out, strict=True)}
    labels = ("published", "simulated, by pixel (optimistic)", "simulated, scans left out")
    for k, (label, colour, hatch) in enumerate(
        zip(labels, (PALETTE[0], PALETTE[1], PALETTE[6]), ("", "//", ""), strict=True)
    ):
        heights = [b[k] for b in bars]
        drawn = ax.bar(np.arange(4) + 0.27 * (k - 1), heights, 0.25, label=label, color=colour, hatch=hatch)
        ax.bar_label(drawn, fmt="%.1f", fontsize=7)
    style_axes(ax, "Accuracy by channel, weighted KNN of the paper", "", "pixels named right (%)")
    ax.set_xticks(range(4), list(CHANNELS))
    ax.set_ylim(0, 118)
    ax.legend(fontsize=8, frameon=False, loc="upper left", ncols=3)
    columns = ("by pixel (optimistic)", "scans left out", *(f"{t}, scans left out" for t in tasks))
    return Item(
        "fig20",
        "Fig. 20: H, V and P alone and together",
        (
            "The order is the paper's: H, then V, then P, and all three together best. In this simulation V and P alone"
            " do better than published: their errors are only those the paper states, while the rig has more (uneven"
            " illumination, leakage, thickness). Only measurements with the rig can show how much of this advantage "
            "remains.",
            "Mean over the materials of the three groups, each classified among its own group; the paper does not say"
            " how its mean was taken.",
        ),
        (
            Table(
                "Share of pixels named right by the paper's KNN",
                ("Channels", "published", *(f"simulated, {c}" for c in columns)),
                tuple(rows),
            ),
        ),
        {"channels": Picture(fig, "Published and simulated accuracy of each channel.")},
        data,
    )


def confusion_figure(materials: Sequence[Published], h: Score, best: Score) -> Figure:
    """Draw the confusion of the paper's KNN by H alone beside the discriminant's, by pixels and by patches."""
    panels: tuple[Panel, ...] = (
        (h, h.confusion, f"H alone: {percent(h.pixels)}\n{PAPER_MODEL}"),
        (best, best.confusion, f"H, V and P, pixels alone: {percent(best.pixels)}\n{DISCRIMINANT_MODEL}"),
        (best, best.patch_confusion, f"H, V and P, by patch: {percent(best.by_patch)}\n{DISCRIMINANT_MODEL}"),
    )
    n = len(materials)
    if n > 12:
        # Large matrices stand two by two, and leave room for a list of confusions.
        fig = new_figure(11.5, 11.0)
        axes = fig.subplots(2, 2).ravel()
        leftmost = (axes[0], axes[2])
        size = 7.5
        letters_a_line = 60
        axes[3].set_axis_off()
        # There is room for two panels' confusions; those of the first, H alone, are not listed (chosen).
        axes[3].text(0.02, 0.98, _list_confusions(panels[1:]), va="top", fontsize=9, color=INK, linespacing=1.5)
    else:
        fig = new_figure(11.5, 4.5)
        axes = fig.subplots(1, len(panels))
        leftmost = (axes[0],)
        size = 8.0
        letters_a_line = 36
    image = None
    for ax, (scored, table, title) in zip(axes[: len(panels)], panels, strict=True):
        order = [scored.names.index(m.name) for m in materials]
        shares = table[np.ix_(order, order)]
        image = ax.imshow(100 * shares, cmap="cividis", vmin=0, vmax=100, interpolation="nearest")
        y_title = ""
        y_labels = [str(m.number) for m in materials]
        if ax in leftmost:
            y_title = "true"
            y_labels = [f"{m.name}  {m.number}" for m in materials]
        lines = [fill(line, letters_a_line) for line in title.splitlines()]
        style_axes(ax, "\n".join(lines), "named", y_title)
        ax.title.set_fontsize(9.5)
        ax.grid(visible=False)
        ax.set_xticks(range(n), [str(m.number) for m in materials], fontsize=size)
        ax.set_yticks(range(n), y_labels, fontsize=size)
        # Below half of a per cent the number would be 0.
        for i, j in zip(*np.nonzero(shares > 0.005), strict=True):
            colour = "w"
            if shares[i, j] > 0.6:
                colour = INK
            text = f"{100 * shares[i, j]:.0f}"
            ax.text(j, i, text, ha="center", va="center", fontsize=size - 1.5, color=colour)
    if image is not None:
        bar = fig.colorbar(image, ax=list(axes), fraction=0.02, pad=0.01)
        bar.set_label("% of pixels", fontsize=8)
        bar.ax.tick_params(labelsize=7)
    return fig


def _list_confusions(panels: Sequence[Panel]) -> str:
    """List the five largest confusions of each panel."""
    lines = []
    for scored, table, title in panels:
        confusions = table * (1 - np.eye(len(table)))
        lines.append(f"Most confused, {title.splitlines()[0].rpartition(':')[0]}:")
        for cell in np.argsort(confusions, axis=None)[::-1][:5]:
            i, j = np.unravel_index(cell, confusions.shape)
            if confusions[i, j] > 0:
                lines.append(f"   {scored.names[i]} named {scored.names[j]}: {100 * confusions[i, j]:.0f} %")
        if confusions.any():
            lines += [""]
        else:
            lines += ["   none", ""]
    return "\n".join(lines)


@cache
def pixel_bound(
    materials: tuple[Published, ...], angles_deg: tuple[float, ...], errors: Errors, reference: bool, pixels: int
) -> float:
    """Return the share of pixels that Bayes' rule names right, knowing all means and the sizes of errors.

    On ln|H|, ln|V| and arg P the errors are normal up to their second order, and the same for all materials: Bayes'
    rule is the nearest mean. Found by drawing, `TRIALS` a material.

    Parameters
    ----------
    materials, angles_deg, errors
        Materials, incidence angles and errors that the pixels are drawn with.
    reference
        True if the error of the scan's metal reference is in the pixels; False if it is known and removed.
    pixels
        Pixels a decision is taken from: their own errors average out, those of the patch do not.
    """
    eps = np.array([m.permittivity for m in materials])
    # In units of a pixel's variance, of which `errors.shared` is common to its patch: that part, the reference's, which
    # is as large, and the pixel's own.
    variance = errors.shared * (2 if reference else 1) + (1 - errors.shared) / pixels
    columns = []
    std = []
    for angle in angles_deg:
        # H is s, V is p; metal reflects -1 in both, which changes neither magnitudes nor their ratio. The phase of P is
        # that of H minus that of V: two independent errors.
        r_s, r_p = fresnel(eps, np.radians(angle))
        p = r_s / r_p
        columns += [np.log(np.abs(r_s)), np.log(np.abs(r_p)), p / np.abs(p)]
        std += [errors.amplitude, errors.amplitude, errors.phase_rad * np.sqrt(2)]
    mean = np.stack(columns, axis=1)
    rng = np.random.default_rng(0)
    right = []
    for k in range(len(materials)):
        cost = np.zeros((TRIALS, len(materials)))
        for c, s in enumerate(std):
            noise = s * np.sqrt(variance) * rng.standard_normal((TRIALS, 1))
            # Every third column is the direction of P: angles differ, not logarithms.
            if c % 3 == 2:
                difference = np.angle(mean[k, c] * np.exp(1j * noise) / mean[None, :, c])
            else:
                difference = np.real(mean[k, c]) + noise - np.real(mean[None, :, c])
            cost += (difference / s) ** 2
        right.append((cost.argmin(axis=1) == k).mean())
    return float(np.mean(right))
