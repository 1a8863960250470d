"""MATLAB: one .mat file of version 5, as scipy.io writes it."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from polysight.host.export.hdf5 import CONVENTION
from polysight.host.export.table import material_columns
from polysight.host.report import write_atomically
from polysight.host.report.read import SavedProducts

_LONGEST_NAME = 63


def write_mat(path: Path, products: SavedProducts) -> None:
    """Write `h`, `v`, `p`, `valid` [y, x], `x_m`, `y_m`, struct `materials` of columns, structs `config`, `versions`.

    `quality_json` and `materials_json` are those files as text: jsondecode reads them.
    """
    content = {
        "h": products.h,
        "v": products.v,
        "p": products.p,
        "valid": products.valid,
        "x_m": products.x_m[None, :],
        "y_m": products.y_m[:, None],
        "materials": {name: _column(values) for name, values in material_columns(products).items()},
        "config": _struct(products.scan.get("instrument", {})),
        "versions": _struct(products.scan.get("versions", {})),
        "scan_id": products.scan_id,
        "simulated": np.nan if products.simulated is None else products.simulated,
        "convention": CONVENTION,
        "quality_json": json.dumps(products.quality),
        "materials_json": json.dumps(products.materials),
    }
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, content, long_field_names=True, do_compression=True, oned_as="column")
    write_atomically(path, buffer.getvalue())


def _column(values: list[Any]) -> Any:
    """A column of numbers, not a number where one is not known; of words, a cell array."""
    if any(isinstance(v, str) for v in values):
        return np.array([v or "" for v in values], dtype=object)[:, None]
    if values and all(isinstance(v, bool) for v in values):
        return np.array(values)[:, None]
    return np.array([np.nan if v is None else v for v in values], np.float64)[:, None]


def _struct(node: Any) -> Any:
    """Nested tables as structs; names made into MATLAB's; lists that are not plain numbers as cell arrays."""
    if isinstance(node, dict):
        return {_name(k): _struct(v) for k, v in node.items() if v is not None} or np.zeros((0, 0))
    if isinstance(node, list | tuple):
        if node and all(isinstance(v, int | float) and not isinstance(v, bool) for v in node):
            return np.array(node, np.float64)[None, :]
        cells = np.empty((1, len(node)), dtype=object)
        for i, v in enumerate(node):
            cells[0, i] = _struct(v)
        return cells
    return float(node) if isinstance(node, int) and not isinstance(node, bool) else node


def _name(key: str) -> str:
    name = re.sub(r"\W", "_", key)
    return (name if name[:1].isalpha() else f"x{name}")[:_LONGEST_NAME]
