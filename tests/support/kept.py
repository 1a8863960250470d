"""Figures that change only on purpose: a file beside a test keeps them, and the test compares.

They are not a truth, and do not show what is right: laws do that. They show changes that no law mentions. To
accept new ones, remove the file, run the test, which writes it again and fails once, and read the difference.
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

Kept = float | int | str | bool | None
NUMBER = re.compile(r"(?<![\w.#])[-+\N{MINUS SIGN}]?\d+(?:\.\d+)?(?![\w]*[-:/]\d)")
# Relative difference that counts as rounding. Measured: without compiled loops and vector units, votes of single pixels
# changed by 2 %, everything else by less than 1 %.
RELATIVE = 0.03
MANY_LINES = 40


def assert_kept(file: Path, figures: object, absolute: float = 1e-5) -> None:
    """Compare all numbers, names and truths in nested figures with those that a file keeps."""
    new = dict(flatten(figures))
    if not file.exists():
        file.parent.mkdir(exist_ok=True)
        lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in new.items())
        file.write_text("{\n" + lines + "\n}\n", encoding="utf-8")
        pytest.fail(f"{file} was written: read it, and run the test again")
    kept_values = json.loads(file.read_text(encoding="utf-8"))
    assert sorted(new) == sorted(kept_values)
    different = {
        n: (value, kept_values[n]) for n, value in new.items() if not are_alike(value, kept_values[n], absolute)
    }
    assert different == {}


def are_alike(new: Kept, kept: Kept, absolute: float) -> bool:
    """True for equal values, and for numbers whose difference may be rounding."""
    if isinstance(new, float) and isinstance(kept, float | int):
        return math.isclose(new, kept, rel_tol=RELATIVE, abs_tol=absolute)
    return new == kept


def flatten(value: Any, name: str = "") -> Iterator[tuple[str, Kept]]:
    """Yield the path and value of everything in nested containers; numbers have five digits."""
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


def summarise_array(values: np.ndarray, places: int = 7) -> dict[str, Any]:
    """Return the shape, the mean size and some values of an array, from the same places each time."""
    flat = values.ravel()
    if values.dtype == bool:
        return {"shape": list(values.shape), "true": int(flat.sum())}
    usable = flat[np.isfinite(flat)]
    chosen = usable[np.linspace(0.1 * usable.size, 0.9 * usable.size, places).astype(int)] if usable.size else usable
    size = np.abs(usable.astype(complex))
    return {
        "shape": list(values.shape),
        "finite": int(usable.size),
        "size": float(size.mean()) if size.size else 0.0,
        "values": [v.item() for v in chosen],
    }


def find_numbers(text: str) -> list[float]:
    """Return the numbers in a text, without those of dates, times, versions and names."""
    return [float(n.replace("\N{MINUS SIGN}", "-")) for n in NUMBER.findall(text)]


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
    """What stands where in figures: sizes, axes, and all that is drawn in coordinates of the data."""
    return [
        {"size_in": figure.get_size_inches().tolist(), "axes": [_describe_axes(ax) for ax in figure.axes]}
        for figure in saved
    ]


def _describe_axes(ax: Any) -> dict[str, Any]:
    return {
        "place": list(ax.get_position().bounds),
        "limits": [*ax.get_xlim(), *ax.get_ylim()],
        "texts": [[*_place(text), text.get_fontsize(), find_numbers(text.get_text())] for text in ax.texts],
        "lines": _describe_lines([np.column_stack(line.get_data()) for line in ax.lines]),
        "patches": [_spread(patch.get_path().vertices @ _data_matrix(patch)) for patch in ax.patches],
        "points": [[c.get_alpha(), *c.get_clim(), *_spread(np.asarray(c.get_offsets()))] for c in ax.collections],
        "images": [[*image.get_extent(), *image.get_clim(), *image.get_size()] for image in ax.images],
    }


def _describe_lines(lines: list[np.ndarray]) -> list[list[float]]:
    """Describe each line by its number of points, their mean and spread; very many lines, such as normals, together."""
    if len(lines) > MANY_LINES:
        lines = [np.concatenate(lines)]
    return [[len(points), *_spread(points)] for points in lines]


def _place(text: Any) -> list[float]:
    return [float(c) for c in text.get_position()]


def _data_matrix(patch: Any) -> np.ndarray:
    """Return the size of a patch relative to its path: the path of a rectangle is the unit square."""
    return np.diag([getattr(patch, "get_width", lambda: 1.0)(), getattr(patch, "get_height", lambda: 1.0)()])


def _spread(points: Any) -> list[float]:
    """Return mean and standard deviation along each axis."""
    points = np.asarray(points, dtype=float)
    if not points.size or not np.isfinite(points).any():
        return []
    return [*np.nanmean(points, axis=0).tolist(), *np.nanstd(points, axis=0).tolist()]
