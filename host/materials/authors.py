"""The published data set's material files, `materials/<name>_<angle>.pkl`, read without running what they may hold.

A pickle is a program. This reader admits numpy arrays and plain types and nothing else: any other name in the file is
an error that says so, and nothing of it is carried out.
"""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.materials.library import Entry, Library
from polysight.shared.errors import DataError

_ADMITTED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("builtins", "complex"),
    ("_codecs", "encode"),
    *(
        (module, name)
        for module, names in {
            "multiarray": ("_reconstruct", "scalar"),
            "numeric": ("_frombuffer",),
        }.items()
        for name in names
        for module in (f"numpy.core.{module}", f"numpy._core.{module}")
    ),
}


class _Restricted(pickle.Unpickler):
    """An unpickler for arrays and plain types."""

    def find_class(self, module: str, name: str) -> Any:
        """The named constructor, if it is one of numpy's arrays. Raises UnpicklingError."""
        if (module, name) not in _ADMITTED:
            raise pickle.UnpicklingError(f"it wants to call {module}.{name}")
        return super().find_class(module, name)


def read_pickle(path: Path) -> Any:
    """Content of a pickle of arrays and plain types.

    Raises
    ------
    DataError
        when the file is absent, damaged, or would call anything but numpy's array constructors.
    """
    try:
        return _Restricted(io.BytesIO(path.read_bytes())).load()
    except OSError as e:
        raise DataError(f"{path}: cannot be read: {e.strerror}", "the path is wrong, or you may not read it") from None
    except pickle.UnpicklingError as e:
        raise DataError(
            f"{path}: refused: {e}",
            "a pickle can run any program; here only numpy arrays and plain types are read",
            "do not open it with pickle.load unless you trust its maker",
        ) from None
    except Exception as e:  # noqa: BLE001 - a damaged pickle raises anything
        raise DataError(f"{path}: not a pickle: {type(e).__name__}: {e}", "it is cut short or another file") from None


def read_material(path: Path) -> Entry:
    """One material file as an entry of the library, divided by its reference.

    `values` and `ref_values` are [P, H, V]; P is divided by the reference's mean P, H and V by the root mean square
    of its amplitudes (Eq. 8 and 9 of the paper).

    Raises
    ------
    DataError
        as :func:`read_pickle`, or when keys are missing or arrays have another form.
    """
    raw = read_pickle(path)
    try:
        p, h, v = (_pixels(x) for x in raw["values"])
        ref_p, ref_h, ref_v = (_pixels(x) for x in raw["ref_values"])
        name, angle = str(raw["name"]), float(raw["incident_angle"])
        scan, reference = str(raw["collection_name"]), str(raw["ref_name"])
        thickness = _number(raw.get("thickness"))
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise DataError(
            f"{path}: not a material file: {type(e).__name__}: {e}",
            "expected a dict with name, collection_name, incident_angle, ref_name, values [P, H, V], ref_values",
        ) from None
    if not p.size == h.size == v.size > 0 or not ref_p.size == ref_h.size == ref_v.size > 0:
        raise DataError(f"{path}: P, H and V have {p.size}, {h.size}, {v.size} pixels", "they belong to one box")
    level_h, level_v, level_p = np.sqrt(np.mean(abs(ref_h) ** 2)), np.sqrt(np.mean(abs(ref_v) ** 2)), np.mean(ref_p)
    if not (np.isfinite([level_h, level_v, abs(level_p)]).all() and min(level_h, level_v, abs(level_p)) > 0):
        raise DataError(f"{path}: the reference {reference} holds no signal", "ref_values are zero or not finite")
    return Entry(
        name=name,
        scan=scan,
        h=(abs(h) / level_h).astype(np.float32),
        v=(abs(v) / level_v).astype(np.float32),
        p=(p / level_p).astype(np.complex64),
        incidence_deg=angle,
        simulated=bool(raw.get("simulated", False)),
        thickness_mm=thickness,
        reference=reference,
    )


def read_materials(folder: Path) -> Library:
    """All material files of a folder as a library, not yet fitted. Raises DataError, also when there is none."""
    files = sorted(folder.glob("*.pkl"))
    if not files:
        raise DataError(f"{folder}: no material files", "expected <name>_<angle>.pkl", "give the materials/ folder")
    return Library(tuple(read_material(f) for f in files), {}, f"{len(files)} material files of {folder.name}")


def write_material(path: Path, entry: Entry) -> None:
    """Write an entry as a material file of the published form; its reference is an ideal metal.

    One key more than the published files have: `simulated`, so that what was simulated is called so when it is read.
    """
    one = np.ones(1, np.complex64)
    content = {
        "name": entry.name,
        "thickness": entry.thickness_mm,
        "collection_name": entry.scan,
        "incident_angle": entry.incidence_deg,
        "ref_name": entry.reference or "metal",
        "ref_thickness": None,
        "values": [entry.p, entry.h.astype(np.complex64), entry.v.astype(np.complex64)],
        "ref_values": [one, one, one],
        "simulated": entry.simulated,
    }
    path.write_bytes(pickle.dumps(content))


def write_materials(folder: Path, entries: Iterable[Entry]) -> None:
    """Write entries as `<name>_<angle>.pkl`; entries of one name and angle from several scans are numbered."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, entry in enumerate(entries):
        safe = "".join(c if c.isalnum() or c in "-." else "-" for c in entry.name).strip("-")
        path = folder / f"{safe}_{entry.incidence_deg:.0f}.pkl"
        write_material(path if not path.exists() else path.with_stem(f"{path.stem}_{i}"), entry)


def _pixels(values: Any) -> npt.NDArray[np.complex128]:
    return np.asarray(values, np.complex128).ravel()


def _number(value: Any) -> float | None:
    if isinstance(value, str):  # "3 mm"
        value = value.lower().removesuffix("mm").strip()
    return None if value is None or value == "" else float(value)
