"""Numbers that must not change without notice: a JSON file in the test's folder keeps them, and the test compares.

Kept numbers are those of an earlier run, and may be wrong; other tests check what is right. They reveal changes that no
other test notices. To accept new numbers, remove the file and run the test: it writes the file again and fails once.
Then read the difference in git.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

# Values that a file keeps, each with its path in nested containers.
Kept = float | int | str | bool | None
NUMBER = re.compile(
    r"""
    (?<![\w.#])  # not after a letter, a digit, a point or #, as in `v2`, `1.2.3` or `#4`
    [-+\N{MINUS SIGN}]?\d+(?:\.\d+)?
    (?!\w*[-:/]\d)  # not before -, : or / and a digit, as in the year of `2024-05-06` or the hour of `07:30`
    """,
    re.VERBOSE,
)
# Relative difference that counts as rounding. Measured: without compiled loops and vector units, the votes of
# single pixels for materials changed by 2 %, everything else by less than 1 %.
RELATIVE_TOLERANCE = 0.03
# Lines that are described one by one; if a picture has more, they have one common description. The kept pictures have
# at most 6 lines each, besides one line for the normal of each point of a surface.
MOST_LINES = 40


def assert_kept(file: Path, values: object, absolute: float = 1e-5) -> None:
    """Compare all values in nested containers with those that a file keeps.

    Numbers may differ by RELATIVE_TOLERANCE. Numbers near 0, where that is too strict, may differ by `absolute`.
    """
    new = dict(flatten(values))
    if not file.exists():
        file.parent.mkdir(exist_ok=True)
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in new.items())
        file.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
        pytest.fail(f"{file} was written: read it, and run the test again")
    kept_values = json.loads(file.read_text(encoding="utf-8"))
    assert sorted(new) == sorted(kept_values)
    different = {}
    for name, value in new.items():
        if not are_equal_but_for_rounding(value, kept_values[name], absolute):
            different[name] = (value, kept_values[name])
    assert different == {}


def are_equal_but_for_rounding(new: Kept, kept: Kept, absolute: float) -> bool:
    """True for equal values, and for numbers that differ by no more than the tolerances."""
    if isinstance(new, float) and isinstance(kept, float | int):
        return math.isclose(new, kept, rel_tol=RELATIVE_TOLERANCE, abs_tol=absolute)
    return new == kept


def flatten(value: Any, name: str = "") -> Iterator[tuple[str, Kept]]:
    """Yield the path and the value of every element of nested containers; real numbers are rounded to five digits."""
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from flatten(part, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple):
        for index, part in enumerate(value):
            yield from flatten(part, f"{name}[{index}]")
    elif isinstance(value, np.ndarray):
        yield from flatten(summarise_array(value), name)
    elif dataclasses.is_dataclass(value):
        yield from flatten(vars(value), name)
    elif isinstance(value, complex | np.complexfloating):
        yield from flatten([value.real, value.imag], name)
    elif isinstance(value, float | np.floating):
        yield name, float(f"{value:.5g}")
    elif isinstance(value, np.integer | np.bool_):
        yield name, value.item()
    else:
        yield name, value


def summarise_array(values: np.ndarray, samples: int = 7) -> dict[str, Any]:
    """Return the shape of an array, the mean magnitude of its elements, and some evenly spaced elements."""
    flat = values.ravel()
    if values.dtype == bool:
        return {"shape": list(values.shape), "true": int(flat.sum())}
    finite = flat[np.isfinite(flat)]
    if finite.size:
        # Elements near the ends are often margins of an image.
        indices = np.linspace(0.1 * finite.size, 0.9 * finite.size, samples).astype(int)
        mean_magnitude = float(np.abs(finite.astype(complex)).mean())
    else:
        indices = np.array([], dtype=int)
        mean_magnitude = 0.0
    return {
        "shape": list(values.shape),
        "finite": int(finite.size),
        "mean_magnitude": mean_magnitude,
        "values": [element.item() for element in finite[indices]],
    }


def find_numbers(text: str) -> list[float]:
    """Return the numbers in a text, without those in names and without most parts of dates, times and paths."""
    return [float(digits.replace("\N{MINUS SIGN}", "-")) for digits in NUMBER.findall(text)]


@contextmanager
def collect_figures() -> Iterator[list[Figure]]:
    """Collect the figures that are saved as PNG during the block; they are not rendered."""
    saved: list[Figure] = []

    def save(canvas: FigureCanvasAgg, file: Any, **_options: Any) -> None:
        saved.append(canvas.figure)
        file.write(b"\x89PNG")

    def save_file(figure: Figure, file: Any, **_options: Any) -> None:
        saved.append(figure)
        if isinstance(file, str | Path):
            Path(file).write_bytes(b"\x89PNG")
        else:
            file.write(b"\x89PNG")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureCanvasAgg, "print_png", save)
        patch.setattr(Figure, "savefig", save_file)
        yield saved


def describe_figures(saved: Sequence[Figure]) -> list[dict[str, Any]]:
    """Return for each figure its size, and for each of its axes the position, the limits and what is drawn in it."""
    return [
        {"size_in": figure.get_size_inches().tolist(), "axes": [_describe_axes(ax) for ax in figure.axes]}
        for figure in saved
    ]


def _describe_axes(ax: Any) -> dict[str, Any]:
    return {
        "place": list(ax.get_position().bounds),
        "limits": [*ax.get_xlim(), *ax.get_ylim()],
        "texts": [_describe_text(text) for text in ax.texts],
        "lines": _describe_lines([np.column_stack(line.get_data()) for line in ax.lines]),
        "patches": [_compute_mean_and_std(_list_corners(patch)) for patch in ax.patches],
        "points": [_describe_points(collection) for collection in ax.collections],
        "images": [[*image.get_extent(), *image.get_clim(), *image.get_size()] for image in ax.images],
    }


def _describe_text(text: Any) -> list[Any]:
    """Position, size of the font, and numbers in the text."""
    x, y = text.get_position()
    return [float(x), float(y), text.get_fontsize(), find_numbers(text.get_text())]


def _describe_points(collection: Any) -> list[Any]:
    """Opacity, range of the colours, and where the points are."""
    return [
        collection.get_alpha(),
        *collection.get_clim(),
        *_compute_mean_and_std(np.asarray(collection.get_offsets())),
    ]


def _describe_lines(lines: list[np.ndarray]) -> list[list[float]]:
    """Number of points of each line, and their mean and standard deviation.

    More than MOST_LINES are joined and described as one line.
    """
    if len(lines) > MOST_LINES:
        lines = [np.concatenate(lines)]
    return [[len(points), *_compute_mean_and_std(points)] for points in lines]


def _list_corners(patch: Any) -> np.ndarray:
    """Corners of a drawn shape, [corner, (x, y)].

    The path of a rectangle in matplotlib is always the unit square at the origin: it is scaled by the rectangle's width
    and height. Paths of other shapes are not scaled.
    """
    width = patch.get_width() if hasattr(patch, "get_width") else 1.0
    height = patch.get_height() if hasattr(patch, "get_height") else 1.0
    return patch.get_path().vertices @ np.diag([width, height])


def _compute_mean_and_std(points: Any) -> list[float]:
    """Return mean and standard deviation along each axis; an empty list without finite coordinates."""
    points = np.asarray(points, dtype=float)
    if not points.size or not np.isfinite(points).any():
        return []
    return [*np.nanmean(points, axis=0).tolist(), *np.nanstd(points, axis=0).tolist()]
