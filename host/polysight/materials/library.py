"""The reference library: labelled patches with their pixels and their origin, in one data file.

The file is an .npz with plain arrays and a JSON text; it is read with `allow_pickle=False`, so that a library of
unknown origin cannot run code.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.store import open_npz
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

FORMAT = "polysight-library-1"
SAME_ANGLE_DEG = 1.0
SIMULATED_LIBRARY = Path(__file__).with_name("simulated-library.npz")
"""The default library: simulated scans of examples/library."""


@dataclass(frozen=True)
class Entry:
    """One labelled patch.

    Attributes
    ----------
    name
        Material.
    scan
        Scan of the patch: training and test data are split by scan.
    h, v
        float32 [n], |H| and |V| of its pixels relative to metal.
    p
        complex64 [n], metal-referenced ratio H / V.
    incidence_deg
        Angle of incidence.
    simulated
        True if the scan was simulated.
    seed, thickness_mm, permittivity
        Seed of the simulated placement, thickness of the sample, true [eps', eps'']; None if not known.
    versions
        Versions of the programs that made it.
    reference
        Name of its reference, if that was not the metal of its own scan.
    specimen
        Name of the physical piece of the material; None if not known.
    """

    name: str
    scan: str
    h: npt.NDArray[np.float32]
    v: npt.NDArray[np.float32]
    p: npt.NDArray[np.complex64]
    incidence_deg: float
    simulated: bool
    seed: int | None = None
    thickness_mm: float | None = None
    permittivity: tuple[float, float] | None = None
    versions: dict[str, str] = field(default_factory=dict)
    reference: str | None = None
    specimen: str | None = None


@dataclass(frozen=True)
class Library:
    """Entries, and the model fitted to them (`polysight.materials.train`; may be empty)."""

    entries: tuple[Entry, ...]
    fit: dict[str, Any] = field(default_factory=dict)
    note: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Materials, sorted."""
        return tuple(sorted({e.name for e in self.entries}))

    @property
    def scans(self) -> tuple[str, ...]:
        """Scans, sorted."""
        return tuple(sorted({e.scan for e in self.entries}))

    @property
    def angles_deg(self) -> tuple[float, ...]:
        """Incidence angles, rounded to a tenth of a degree; entries within `SAME_ANGLE_DEG` count as one angle."""
        out: list[list[float]] = []
        for angle in sorted(e.incidence_deg for e in self.entries):
            if out and angle - out[-1][0] <= SAME_ANGLE_DEG:
                out[-1].append(angle)
            else:
                out.append([angle])
        return tuple(round(sum(a) / len(a), 1) for a in out)

    def at(self, angle_deg: float) -> Library:
        """Return the entries under an incidence angle, with their fit.

        Raises DataError if there are none: |P| changes by 10 % in a degree, so other angles cannot be used.
        """
        near = [a for a in self.angles_deg if abs(a - angle_deg) <= SAME_ANGLE_DEG]
        if not near:
            raise DataError(
                f"the library has no patch at {angle_deg:.1f} degrees of incidence",
                f"its incidence angles are {', '.join(f'{a:g}' for a in self.angles_deg)} degrees",
                "train a library at this angle, or process without naming: --model none",
                code=ErrorCode.MISMATCH,
            )
        angle = min(near, key=lambda a: abs(a - angle_deg))
        mine = tuple(e for e in self.entries if abs(e.incidence_deg - angle) <= SAME_ANGLE_DEG)
        return Library(mine, self.fit_of([angle]), self.note)

    def fit_of(self, angles_deg: Sequence[float]) -> dict[str, Any]:
        """Return the fit for an angle, or for several together; may be empty."""
        angles = self.fit.get("angles")
        if angles is None:
            return self.fit if len(angles_deg) == 1 else {}
        return dict(angles.get("+".join(f"{a:g}" for a in sorted(angles_deg)), {}))

    @property
    def simulated(self) -> bool:
        """True if any entry was simulated."""
        return any(e.simulated for e in self.entries)

    def select(self, scans: Iterable[str]) -> Library:
        """Return the entries of these scans, without the fit."""
        wanted = set(scans)
        return Library(tuple(e for e in self.entries if e.scan in wanted), {}, self.note)

    def pixels(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.complex128]]:
        """Return |H|, |V| and P of all pixels, [n] each, entry after entry."""
        return (
            np.concatenate([e.h for e in self.entries]).astype(np.float64),
            np.concatenate([e.v for e in self.entries]).astype(np.float64),
            np.concatenate([e.p for e in self.entries]).astype(np.complex128),
        )

    def of_pixels(self, key: str) -> npt.NDArray:
        """Return an attribute of each pixel's entry (`name` or `scan`), [n]."""
        return np.concatenate([np.full(e.h.size, getattr(e, key)) for e in self.entries])

    def save(self, path: Path) -> None:
        """Write the library; an existing file is replaced once the new one is complete."""
        entries = [
            {k: v for k, v in vars(e).items() if k not in ("h", "v", "p")} | {"pixels": int(e.h.size)}
            for e in self.entries
        ]
        meta = {"format": FORMAT, "note": self.note, "fit": self.fit, "entries": entries}
        text = np.frombuffer(json.dumps(meta, sort_keys=True).encode("utf-8"), np.uint8)
        empty_f, empty_c = np.zeros(0, np.float32), np.zeros(0, np.complex64)
        part = path.with_name(path.name + ".part")
        with part.open("wb") as f:
            np.savez_compressed(
                f,
                h=np.concatenate([empty_f, *(e.h for e in self.entries)]),
                v=np.concatenate([empty_f, *(e.v for e in self.entries)]),
                p=np.concatenate([empty_c, *(e.p for e in self.entries)]),
                meta=text,
            )
            f.flush()
            os.fsync(f.fileno())
        part.replace(path)

    @staticmethod
    def load(path: Path) -> Library:
        """Read a library.

        Raises
        ------
        DataError
            if the file is missing, no library, of another format version, damaged, or has pickled objects.
        """
        bad = f"{path}: not a material library"
        try:
            with open_npz(path) as z:
                meta = json.loads(z["meta"].tobytes().decode("utf-8"))
                h, v, p = z["h"], z["v"], z["p"]
        except FileNotFoundError:
            raise DataError(
                f"{path}: no such library",
                "none was trained yet, or the path is wrong",
                "polysight train",
                code=ErrorCode.FILE_MISSING,
            ) from None
        except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as e:
            why = str(e) if isinstance(e, ValueError) else f"{type(e).__name__}: {e}"
            raise DataError(
                bad, why, "give a library of polysight train, or a folder of products", code=ErrorCode.FILE_UNREADABLE
            ) from None
        if not isinstance(meta, dict) or meta.get("format") != FORMAT:
            found = meta.get("format") if isinstance(meta, dict) else None
            raise DataError(
                bad, f"its format is {found!r}, this program reads {FORMAT!r}", "train it again",
                code=ErrorCode.VERSION_UNSUPPORTED,
            )  # fmt: skip
        try:
            return Library(_entries(meta["entries"], h, v, p), dict(meta["fit"]), str(meta["note"]))
        except (KeyError, TypeError, ValueError) as e:
            raise DataError(
                bad, f"its description does not fit its arrays: {e}", "train it again", code=ErrorCode.FILE_DAMAGED
            ) from None


def _entries(rows: list[dict[str, Any]], h: npt.NDArray, v: npt.NDArray, p: npt.NDArray) -> tuple[Entry, ...]:
    if not h.shape == v.shape == p.shape or h.ndim != 1 or sum(r["pixels"] for r in rows) != h.size:
        raise ValueError(f"arrays {h.shape}, {v.shape}, {p.shape}")
    out, start = [], 0
    for row in rows:
        stop = start + row["pixels"]
        fields = {k: value for k, value in row.items() if k != "pixels"}
        if fields.get("permittivity") is not None:
            fields["permittivity"] = tuple(fields["permittivity"])
        out.append(
            Entry(
                h=h[start:stop].astype(np.float32),
                v=v[start:stop].astype(np.float32),
                p=p[start:stop].astype(np.complex64),
                **fields,
            )
        )
        start = stop
    return tuple(out)
