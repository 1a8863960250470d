"""`polysight reproduce --authors`: the POLySIGHT paper's Table 2, Fig. 18, 20 and 21 from the published files.

Two ways to keep training and test apart: whole scans left out, which judges materials that at least two scans hold; and
by pixel, which is optimistic, because pixels of one patch know each other. Table 2 is made by three recipes, the
authors' among them; the paper's Eq. 3 gives the permittivity from the ratio of H to V, relative to metal, and the angle
of incidence. The page and the terminal's tables are made here.

A source is `materials/`, `labels/` or the images made here; a task is the name of a group of materials, with
", two angles" after it for two incidence angles.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from polysight.materials import (
    CHANNELS,
    DISCRIMINANT_MODEL,
    PAPER_MODEL,
    Library,
    Permittivity,
    Samples,
    Score,
    estimate_permittivity,
    score,
)
from polysight.polarimetry import permittivity_from_ratio
from polysight.report import INK, PALETTE
from polysight_papers.sensys2026.classification import SECOND_ANGLE_DEG, TASKS, confusion_figure, published_percent
from polysight_papers.sensys2026.dataset import IMAGES, AuthorsData, read_authors
from polysight_papers.sensys2026.dataset_sugar import authors_fig21
from polysight_papers.sensys2026.item import (
    Item,
    Picture,
    Published,
    Table,
    new_figure,
    percent,
    published_values,
    style_axes,
    table2,
)
from polysight_papers.sensys2026.patches import groups
from polysight_papers.sensys2026.run import Origin, make_folder, make_items
from polysight_shared.errors import ConfigError, DataError, ErrorCode

JUDGED_PIXELS = 1500
PATCH_PIXELS = 6
"""About JUDGED_PIXELS of a task are judged, equally many of each patch but not fewer than PATCH_PIXELS, if it has them.
Chosen: all pixels are compared with all, so that the time grows with the square of JUDGED_PIXELS."""
LEFT_OUT = "scans left out"
OPTIMISTIC = "by pixel (optimistic)"


def task_samples(data: AuthorsData, source: str, task: str) -> Samples | None:
    """Return the pixels of a task of Fig. 18; None with fewer than two materials in the source."""
    name, _, two = task.partition(", ")
    group = groups()[name]
    numbers = range(group.materials[0].number, group.materials[-1].number + 1)
    first = data.select(source, numbers, group.angle_deg)
    if not two:
        if len(first.names) <= 1:
            return None
        return _samples(first)
    second = data.select(source, numbers, SECOND_ANGLE_DEG)
    if not first.entries or not second.entries:
        return None
    first, second = pair_scans(first, second)
    shared = {(e.name, e.scan) for e in first.entries} & {(e.name, e.scan) for e in second.entries}
    if len({name for name, _ in shared}) < 2:
        return None
    # Patches of a material in a pair of scans are paired in their order, their pixels at random; the rest is left out.
    return _samples(first).join(_samples(second))


def _samples(library: Library) -> Samples:
    """Return pixels of a library, of each patch so few that all can be compared with all."""
    return Samples.from_library(library, max(PATCH_PIXELS, JUDGED_PIXELS // len(library.entries)))


def pair_scans(first: Library, second: Library) -> tuple[Library, Library]:
    """Return scans of two angles in pairs, those with most materials in common first; a pair has one name in both.

    No scan is in two pairs, so that a pair can be left out as a whole. Scans without a partner are left out.
    """
    names_by_scan = [{s: {e.name for e in lib.entries if e.scan == s} for s in lib.scans} for lib in (first, second)]
    # All pairs with common materials: how many, and both names.
    pairs = sorted(
        ((len(a & b), s, t) for s, a in names_by_scan[0].items() for t, b in names_by_scan[1].items() if a & b),
        key=lambda p: (-p[0], p[1], p[2]),
    )
    # New names of the scans of each angle.
    names: tuple[dict[str, str], dict[str, str]] = ({}, {})
    for _, s, t in pairs:
        if s not in names[0] and t not in names[1]:
            names[0][s] = names[1][t] = f"{s} and {t}"

    def rename_scans(library: Library, to: dict[str, str]) -> Library:
        entries = tuple(replace(e, scan=to[e.scan]) for e in library.entries if e.scan in to)
        return Library(entries, note=library.note)

    return rename_scans(first, names[0]), rename_scans(second, names[1])


def select_repeated(samples: Samples) -> Samples | None:
    """Return the materials of at least two scans; None if these are fewer than two, or the scans fewer than three.

    The classifiers fit their weights with scans kept apart: two must remain when one is left out.
    """
    scans = {n: np.unique(samples.groups[samples.names == n]).size for n in np.unique(samples.names)}
    repeated_samples = samples.take(np.isin(samples.names, [n for n, count in scans.items() if count > 1]))
    if np.unique(repeated_samples.names).size > 1 and np.unique(repeated_samples.groups).size > 2:
        return repeated_samples
    return None


def _split_one_scan(samples: Samples) -> Samples:
    """Return the pixels of one scan as two scans of every other pixel; those of several scans unchanged.

    Only for the split by pixel, which lets a patch know itself in any case.
    The halves of a patch are two patches: weights are fitted to a few pixels of each patch, among which both must be.
    """
    if np.unique(samples.groups).size > 1:
        return samples
    half = np.arange(samples.names.size) % 2
    return replace(samples, groups=np.array(["even", "odd"])[half], patches=2 * samples.patches + half)


class Judgements:
    """Scores of the classifiers on a data set; each is computed once."""

    def __init__(self, data: AuthorsData) -> None:
        self.data = data
        self._samples: dict[tuple[str, str], Samples | None] = {}
        self._scores: dict[tuple[str, str, str, str], tuple[Score, Score | None]] = {}

    def samples(self, source: str, task: str) -> Samples | None:
        """Return the pixels of a task; None with fewer than two materials in the source."""
        if (source, task) not in self._samples:
            self._samples[source, task] = task_samples(self.data, source, task)
        return self._samples[source, task]

    def list_tasks(self, tasks: tuple[str, ...]) -> list[tuple[str, str, Samples]]:
        """Return source, task and pixels of all that can be judged. Raises DataError if there is nothing."""
        tasks_with_samples = [
            (s, t, x) for s in self.data.sources for t in tasks if (x := self.samples(s, t)) is not None
        ]
        if not tasks_with_samples:
            raise DataError(
                "nothing to classify: no source holds two materials of one group under its angle",
                "solids and powders are judged at 60 degrees, liquids at 55, as in the paper",
                "see what the names were taken for, and --names",
                code=ErrorCode.NO_DATA,
            )
        return tasks_with_samples

    def score(self, source: str, task: str, model: str, channels: str = "H+V+P") -> tuple[Score, Score | None]:
        """Return the scores of a model by pixel, and with whole scans left out if possible."""
        key = source, task, model, channels
        samples = self.samples(source, task)
        if samples is None:
            raise DataError(
                f"{source} has no {task}", "the data set is not complete", "download it again", code=ErrorCode.NO_DATA
            )
        if key not in self._scores:
            several = select_repeated(samples)
            mixed = score(_split_one_scan(samples), model, channels, by_pixel=True)
            scans_left_out = None
            if several is not None:
                scans_left_out = score(several, model, channels, folds=np.unique(several.groups).size)
            self._scores[key] = (mixed, scans_left_out)
        return self._scores[key]


FIG18_HEAD = (
    "Task",
    "source",
    "scans",
    "H, published",
    f"H, KNN {OPTIMISTIC}",
    f"H, KNN {LEFT_OUT}",
    "H+V+P, published",
    f"KNN, {OPTIMISTIC}",
    f"KNN, {LEFT_OUT}",
    f"discriminant, {OPTIMISTIC}",
    f"discriminant, {LEFT_OUT}",
    "discriminant, patches, scans left out",
    "materials in two scans or more",
)
FIG18_NOTES = (
    "The paper does not say how training and test pixels were kept apart; its numbers fit a split by pixel, which "
    "is optimistic: pixels of one patch are then in both sets. With whole scans left out no pixel of a test scan was"
    " trained on; only materials that two scans or more hold can be judged so (last column), and a dash stands"
    " where these, or the scans, are too few.",
    "Solids and powders are taken at 60 degrees, liquids at 55; the second angle is 55. Two angles: scans in"
    " pairs, those with most materials in common, and pairs left out.",
)


def authors_fig18(judge: Judgements) -> Item:
    """Return the accuracy of the paper's KNN and of the discriminant, with confusion matrices. Raises DataError."""
    printed = published_values()["classification"]
    rows = []
    content = {}
    pictures = {}
    for source, task, samples in judge.list_tasks(TASKS):
        name, _, two_angles = task.partition(", ")
        paper = published_percent(task) / 100
        published_h = None if two_angles else printed[name]["h_percent"] / 100
        several = select_repeated(samples)
        knn_mixed, knn_apart = judge.score(source, task, PAPER_MODEL)
        discriminant_mixed, discriminant_apart = judge.score(source, task, DISCRIMINANT_MODEL)
        h_mixed, h_apart = judge.score(source, task, PAPER_MODEL, "H")
        scores = (knn_mixed, knn_apart, discriminant_mixed, discriminant_apart)
        if several is None:
            split = OPTIMISTIC
            material_count = 0
            h = h_mixed
            discriminant = discriminant_mixed
        else:
            split = LEFT_OUT
            material_count = np.unique(several.names).size
            h = h_apart
            discriminant = discriminant_apart
        rows.append(
            (
                f"{np.unique(samples.names).size} {task}",
                source,
                str(np.unique(samples.groups).size),
                percent(published_h),
                *(_share(s) for s in (h_mixed, h_apart)),
                percent(paper),
                *(_share(s) for s in scores),
                # Of patches; the figure's third panel counts their pixels.
                "–" if discriminant_apart is None else percent(discriminant_apart.patches),
                str(material_count),
            )
        )
        content[f"{task}, {source}"] = {
            "published_percent": 100 * paper,
            "scores": [None if s is None else asdict(s) for s in (*scores, h_mixed, h_apart)],
            "judged_with_scans_left_out": material_count,
        }
        if h is None or discriminant is None:
            continue
        key = f"{task}-{source}".replace(", ", "-").replace(" ", "-").replace("/", "")
        caption = f"{task[0].upper()}{task[1:]}, {source}, {split}. Rows are the truth, adding to 100 %."
        named = [m for m in table2() if m.name in discriminant.names]
        pictures[key] = Picture(confusion_figure(named, h, discriminant), caption)
    return Item(
        "fig18",
        "Fig. 18: classification of solids, liquids and powders",
        FIG18_NOTES,
        (Table("Share of pixels named right, mean over materials", FIG18_HEAD, tuple(rows)),),
        pictures,
        content,
    )


def authors_fig20(judge: Judgements) -> Item:
    """H, V, P alone and together by the paper's KNN. Raises DataError."""
    printed = published_values()["channels_percent"]
    tasks = ("solids", "liquids", "powders")
    rows = []
    content = {}
    judged_tasks = judge.list_tasks(tasks)
    sources = list(dict.fromkeys(s for s, _, _ in judged_tasks))
    bars = [("published", [printed[c] for c in CHANNELS])]
    for source in sources:
        tasks_of_source = [(t, x) for s, t, x in judged_tasks if s == source]
        means: dict[str, tuple[float, float | None]] = {}
        for channel in CHANNELS:
            scores = [judge.score(source, t, PAPER_MODEL, channel) for t, _ in tasks_of_source]
            weight = [np.unique(x.names).size for _, x in tasks_of_source]
            mixed = float(np.average([by_pixel.pixels for by_pixel, _ in scores], weights=weight))
            scores_apart = [apart for _, apart in scores if apart is not None]
            held_out_accuracy = None
            if scores_apart:
                held_out_accuracy = float(
                    np.average([s.pixels for s in scores_apart], weights=[len(s.names) for s in scores_apart])
                )
            means[channel] = (mixed, held_out_accuracy)
            rows.append(
                (
                    channel,
                    source,
                    f"{printed[channel]:.2f} %",
                    percent(mixed),
                    percent(held_out_accuracy),
                    ", ".join(f"{t} {_share(s)}" for (t, _), (_, s) in zip(tasks_of_source, scores, strict=True)),
                )
            )
            content[f"{channel}, {source}"] = {
                "published_percent": printed[channel],
                "by_pixel": mixed,
                "scans_left_out": held_out_accuracy,
            }
        bars.append((f"{source}, {OPTIMISTIC}", [100 * means[c][0] for c in CHANNELS]))
        if all(means[c][1] is not None for c in CHANNELS):
            bars.append((f"{source}, {LEFT_OUT}", [100 * (means[c][1] or 0.0) for c in CHANNELS]))
    head = ("Channels", "source", "published", OPTIMISTIC, LEFT_OUT, f"each group, {LEFT_OUT}")
    return Item(
        "fig20",
        "Fig. 20: H, V and P alone and together",
        (
            "Mean over the materials of the groups that are in the data, each classified among its own group; the"
            " paper does not say how its mean was taken.",
        ),
        (Table("Share of pixels named right by the paper's KNN", head, tuple(rows)),),
        {"channels": Picture(_draw_channels(bars), "Accuracy of each channel, published and from the files.")},
        content,
    )


def _draw_channels(bars: list[tuple[str, list[float]]]) -> Any:
    """Draw bars of accuracies in per cent: for each label one of each channel."""
    fig = new_figure(8.4, 4.2)
    ax = fig.subplots()
    width = 0.84 / len(bars)
    for k, (label, heights) in enumerate(bars):
        positions = np.arange(len(CHANNELS)) + width * (k - (len(bars) - 1) / 2)
        hatch = ""
        if OPTIMISTIC in label:
            hatch = "//"
        drawn = ax.bar(positions, heights, 0.92 * width, label=label, color=PALETTE[k], hatch=hatch)
        ax.bar_label(drawn, fmt="%.0f", fontsize=7)
    style_axes(ax, "Accuracy by channel, weighted KNN of the paper", "", "pixels named right (%)")
    ax.set_xticks(range(len(CHANNELS)), list(CHANNELS))
    ax.set_ylim(0, 135)
    ax.legend(fontsize=8, frameon=False, loc="upper left", ncols=2)
    return fig


def _share(score_or_none: Score | None) -> str:
    """Return the share of pixels named right as a cell; a dash without a score."""
    if score_or_none is None:
        return percent(None)
    return percent(score_or_none.pixels)


Complex = npt.NDArray[np.complexfloating]
HEAD = (
    "No.",
    "Material",
    "angle",
    "scans",
    "pixels",
    "published ε′",
    "published ε″",
    "Eq. 3 ε′",
    "Eq. 3 ε″",
    "without leakage ε′",
    "without leakage ε″",
    "±",
    "authors' recipe ε′",
    "authors' recipe ε″",
)
"""Head of the comparison with Table 2."""

MAKERS: dict[str, Callable[[Judgements], Item]] = {
    "table2": lambda judge: authors_table2(judge.data),
    "fig18": authors_fig18,
    "fig20": authors_fig20,
    "fig21": lambda judge: authors_fig21(judge.data),
}
# Corrections of the authors before Eq. 3: leakage (`a` in `without_leakage`), a factor on |P| relative to metal,
# percentiles of |P| to keep.
AXIAL_RATIO = 0.05
METAL_FACTOR = 1 / 0.8
PERCENTILES = (30, 70)


def reproduce_authors(
    folder: Path,
    out: Path,
    config: Path,
    keys: Sequence[str] = (),
    images: Path | None = None,
    names: Path | None = None,
) -> int:
    """Print the items, and write them as a page and as files.

    Parameters
    ----------
    folder, config, images, names
        As of :func:`polysight_papers.sensys2026.dataset.read_authors`.
    out
        Folder for the page and the files.
    keys
        Items, default all four.

    Returns
    -------
    int
        Exit status, 0 only when every item was made.

    Raises
    ------
    ConfigError
        when an item cannot be made from these files at all.
    DataError
        when nothing in the folder can be used.
    """
    _check_keys(keys)
    data = read_authors(folder, config, images, names)
    make_folder(out)
    origin = describe_origin(data)
    judge = Judgements(data)
    for notice in data.notices:
        sys.stderr.write(f"note: {notice}\n")

    def show(item: Item) -> None:
        tables = "".join(f"{format_table(table)}\n" for table in item.tables)
        sys.stdout.write(f"\n{item.title} ({origin.word})\n{tables}")

    makers = {key: partial(make, judge) for key, make in MAKERS.items()}
    return make_items(out, keys, makers, origin, on_item=show)


def _check_keys(keys: Sequence[str]) -> None:
    """Raise ConfigError for items that cannot be made from the published files."""
    for key in keys:
        if key not in MAKERS:
            raise ConfigError(
                f"item {key!r} cannot be made from the published files",
                "they hold pixels of materials, nothing else of the paper",
                f"give some of: {' '.join(MAKERS)}; without --authors the others are made from simulation",
            )


def describe_origin(data: AuthorsData) -> Origin:
    """Return the origin of the page's numbers: published or simulated files, with the notes on them."""
    contents = "; ".join(
        f"{source}: {len(lib.entries)} boxes of {len(lib.names)} materials in {len(lib.scans)} scans"
        for source, lib in data.sources.items()
    )
    titles = {m.number: m.name for m in table2()}
    taken = ", ".join(f"“{n}” = {k}" for n, k in data.meaning.items() if not n.startswith(titles[k]))
    notes = [f"Read from {data.folder.name}: {contents}.", *(f"{n[0].upper()}{n[1:]}." for n in data.notices)]
    if taken:
        notes.insert(1, f"Names that were taken for a row of Table 2 by their words: {taken}.")
    if data.simulated:
        return Origin(
            "simulated files",
            "Some of these files were simulated, and say so: what is on this page was not measured.",
            "The paper's tables and figures, from simulated files of the published form",
            True,
            tuple(notes),
        )
    return Origin(
        "the published files",
        "Every value and figure on this page that is not headed “published” was computed here from the authors' files.",
        "The paper's tables and figures, computed from the authors' files",
        False,
        tuple(notes),
    )


def format_table(table: Table) -> str:
    """Format a table for the terminal: columns as wide as their cells, long heads over several lines."""
    # Heads may be 9 letters wide in any column (chosen); empty lines above a short head put it beside the last lines.
    limit = [max([9, *(len(row[k]) for row in table.rows)]) for k in range(len(table.head))]
    heads = [_wrap(head, width) for head, width in zip(table.head, limit, strict=True)]
    width = [max([n, *map(len, lines)]) for n, lines in zip(limit, heads, strict=True)]
    tall = max(map(len, heads))
    padded_heads = [[""] * (tall - len(lines)) + lines for lines in heads]
    rows = [*zip(*padded_heads, strict=True), ["-" * n for n in width], *table.rows]

    def line(cells: Sequence[str]) -> str:
        first, *rest = zip(cells, width, strict=True)
        return "  ".join([first[0].ljust(first[1]), *(c.rjust(n) for c, n in rest)]).rstrip()

    return "\n".join([table.caption, *map(line, rows)]) + "\n"


def _wrap(text: str, width: int) -> list[str]:
    """Return lines of at most `width` letters; a longer word is a line of its own."""
    out = [""]
    for word in text.split():
        if out[-1] and len(out[-1]) + 1 + len(word) > width:
            out.append("")
        out[-1] = f"{out[-1]} {word}".strip()
    return out


def without_leakage(p: Complex, axial_ratio: float) -> Complex:
    """Remove the leakage a of both channels from ratios P = (t + a) / (1 + a t); return t (1 for metal)."""
    return (p - axial_ratio) / (1 - axial_ratio * p)


def authors_recipe(p: Complex, angle_deg: float, leakage: float = AXIAL_RATIO) -> complex:
    """Return the permittivity by the authors' recipe: leakage, factor, the middle pixels by |P|, mean of Eq. 3.

    `leakage` is 0 for ratios that have none any more.
    """
    used = without_leakage(p, leakage) * METAL_FACTOR
    low, high = np.percentile(np.abs(used), PERCENTILES)
    in_range = used[(np.abs(used) >= low) & (np.abs(used) <= high)]
    eps = permittivity_from_ratio(in_range, np.radians(angle_deg))
    return complex(np.mean(eps[np.isfinite(eps)]))


def _collect_pixels(data: AuthorsData, source: str, m: Published) -> tuple[Complex, float, int] | None:
    """Return ratios of a material's pixels, their angle (degrees), and how many scans; None if the source lacks it.

    At the paper's angle, or else at the smallest there is.
    """
    paper = next(g.angle_deg for g in groups().values() if m in g.materials)
    entries = list(data.select(source, range(m.number, m.number + 1), paper).entries)
    if not entries:
        other_angles = sorted(e.incidence_deg for e in data.sources[source].entries if e.name == m.name)
        if not other_angles:
            return None
        entries = list(data.select(source, range(m.number, m.number + 1), other_angles[0]).entries)
    p = np.concatenate([e.p for e in entries]).astype(np.complex128)
    # They lie within `dataset.SAME_ANGLE_DEG` of the selected one.
    angle = float(np.mean([e.incidence_deg for e in entries]))
    return p[np.isfinite(p) & (p != 0)], angle, len({e.scan for e in entries})


@dataclass(frozen=True)
class Estimate:
    """Permittivities of a material from one source: by Eq. 3 unchanged, without leakage, and by the authors' recipe."""

    material: Published
    angle_deg: float
    scans: int
    pixels: int
    as_is: Permittivity
    clean: Permittivity
    recipe: complex

    @property
    def metal_like(self) -> bool:
        """True for metal, and for materials without a permittivity or without its standard error."""
        return self.material.number == 1 or self.clean.value is None or self.clean.real_std is None


def authors_table2(data: AuthorsData) -> Item:
    """Tabulate each source's permittivities by Eq. 3 unchanged, without leakage, and by the authors' recipe.

    Raises
    ------
    DataError
        when no material of the table is in the data.
    """
    # Mean of the real parts: the authors' is real, and one for both channels.
    leakage = float(np.mean([data.base.polarimetry.leakage_h[0], data.base.polarimetry.leakage_v[0]]))
    estimates = {source: _estimate_materials(data, source, leakage) for source in data.sources}
    if not any(estimates.values()):
        raise DataError(
            "no material of Table 2 is in the data", "its names are others, see the notices on them",
            "say which rows they are: --names FILE", code=ErrorCode.NO_DATA,
        )  # fmt: skip
    return Item(
        "table2",
        "Table 2: permittivity of 36 materials",
        (
            "Three ways from the same pixels. “Eq. 3”: the median of V/H relative to metal, as it is in the files."
            f" “Without leakage”: the rig file's cross-polar amplitude, {leakage:g}, is taken out first."
            f" “Authors' recipe”: leakage {AXIAL_RATIO:g}, |P| times {METAL_FACTOR:g}, the pixels between the"
            f" {PERCENTILES[0]}th and the {PERCENTILES[1]}th percentile of |P|, mean of Eq. 3 over them. Leakage "
            "was already removed from images made here, and is not removed again. ± is the standard error of one "
            "patch.",
            "The recipe's factor compensates an effect in the published measurements that is not explained; on data "
            "without this effect, such as simulated data, the recipe is wrong by this factor.",
        ),
        tuple(
            Table(f"Permittivity from {source}", HEAD, tuple(map(_format_row, e))) for source, e in estimates.items()
        ),
        {
            "permittivity": Picture(
                _draw_figure(estimates), "From the files against published; the dotted line is equality."
            )
        },
        {"materials": [_convert_to_json(source, e) for source, in_source in estimates.items() for e in in_source]},
    )


def _estimate_materials(data: AuthorsData, source: str, leakage: float) -> list[Estimate]:
    """Estimate all materials of Table 2 in a source; `leakage` is still in its ratios, unless they were made here."""
    recipe_leakage = AXIAL_RATIO
    if source == IMAGES:
        leakage = 0.0
        recipe_leakage = 0.0
    source_estimates = []
    for m in table2():
        pixels = _collect_pixels(data, source, m)
        if pixels is None or not pixels[0].size:
            continue
        p, angle, scans = pixels
        # Only H / V is known: it is used as H, with V = 1.
        ones = np.ones(p.size, np.complex128)
        theta = np.radians(angle)
        as_is = estimate_permittivity(p, ones, theta)
        clean = estimate_permittivity(without_leakage(p, leakage), ones, theta)
        source_estimates.append(
            Estimate(
                material=m,
                angle_deg=angle,
                scans=scans,
                pixels=p.size,
                as_is=as_is,
                clean=clean,
                recipe=authors_recipe(p, angle, recipe_leakage),
            )
        )
    return source_estimates


def _format_row(e: Estimate) -> tuple[str, ...]:
    """Return the cells of a material's row; published, estimated unchanged, clean and by the recipe."""
    m = e.material
    std = e.clean.real_std
    # Table 2 gives no loss for number 23, cork.
    return (
        str(m.number),
        m.name,
        f"{e.angle_deg:.0f}°",
        str(e.scans),
        str(e.pixels),
        f"{m.permittivity.real:.4g}",
        "–" if m.number == 23 else f"{-m.permittivity.imag:.4g}",
        *_format_cells(e.as_is.value),
        *_format_cells(e.clean.value),
        "" if std is None or e.metal_like else f"± {std:.2f}",
        *_format_cells(None if e.metal_like else e.recipe),
    )


def _format_cells(value: complex | None) -> tuple[str, str]:
    """Return real part and loss as cells."""
    if value is None:
        return ("metal-like", "")
    return (f"{value.real:.2f}", f"{-value.imag:.2f}")


def _convert_to_json(source: str, e: Estimate) -> dict[str, Any]:
    """Return an estimate for the JSON file, which gets complex numbers as pairs when it is written."""
    return {
        "source": source,
        "number": e.material.number,
        "name": e.material.name,
        "angle_deg": e.angle_deg,
        "scans": e.scans,
        "pixels": e.pixels,
        "published": e.material.permittivity,
        "as_is": e.as_is.value,
        "without_leakage": e.clean.value,
        "std": e.clean.real_std,
        "authors_recipe": e.recipe,
        "metal_like": e.metal_like,
        "ratio": e.clean.ratio,
    }


def _draw_figure(estimates: Mapping[str, Sequence[Estimate]]) -> Figure:
    """Draw real part and loss of each source, without leakage, against the published values."""
    fig = new_figure(10.5, 4.6)
    axes = fig.subplots(1, 2)
    for colour, (source, source_estimates) in zip(
        (PALETTE[0], PALETTE[6], PALETTE[3]), estimates.items(), strict=False
    ):
        bars: dict[str, Any] = {"fmt": "o", "ms": 4, "color": colour, "lw": 1, "label": source}
        drawn = [e for e in source_estimates if not e.metal_like]
        true = [e.material.permittivity for e in drawn]
        values = [e.clean.value or 0j for e in drawn]
        std = [e.clean.real_std or 0.0 for e in drawn]
        # Real part and loss have the same standard error (`estimate_permittivity`).
        axes[0].errorbar([t.real for t in true], [v.real for v in values], yerr=std, **bars)
        axes[1].errorbar([-t.imag for t in true], [-v.imag for v in values], yerr=std, **bars)
    for ax, part in zip(axes, ("real part ε′", "loss ε″"), strict=True):
        style_axes(ax, part, f"published {part}", f"{part} without leakage")
        ax.axline((1, 1), slope=1, color=INK, lw=0.8, ls=":")
        ax.legend(fontsize=8, frameon=False)
    return fig
