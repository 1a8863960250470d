"""Scans of metal alone: the reference over the plane, and leakage from metal at two orientations."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from polysight.host.imaging import ChannelImages
from polysight.host.offline import imaged
from polysight.host.pipeline import Pipeline
from polysight.host.polarimetry import (
    Leakage,
    PlaneReference,
    leakage_from_images,
    plane_reference,
    specular_incidence_rad,
)
from polysight.shared.errors import DataError

LEAST_PIXELS = 100


def _reference(pipeline: Pipeline, images: ChannelImages) -> PlaneReference:
    name = pipeline.source.scan_id
    found = plane_reference(images.h, images.v, images.x_m, images.y_m, images.valid, name=name)
    return replace(found, made_with=pipeline.imaged_with)


def load_reference(
    folder: Path, config: Path | None = None, by_position: bool = True, bands: int = 1
) -> PlaneReference:
    """The reference from a scan of a metal plate that covers the plane.

    Parameters
    ----------
    folder
        Scan folder, or the authors' unsynced/<scan>.
    config
        Rig file for the latter.
    by_position
        A value for each pixel; else one number a channel.
    bands
        Sub-bands to image too.

    Raises
    ------
    PolysightError
        when the scan cannot be read, or shows no metal plate.
    """
    pipeline, images = imaged(folder, config, bands)
    parts = tuple(_reference(pipeline, band) for band in pipeline.band_images())
    found = replace(_reference(pipeline, images), bands=parts)
    return found if by_position else found.mean()


def leakage_of_scans(
    plate: Path, strips: Sequence[tuple[float, Path]], config: Path | None = None
) -> tuple[Leakage, dict[str, Any]]:
    """Leakage and gains' imbalance from scans of a metal plate and of metal strips in its place.

    Parameters
    ----------
    plate
        Scan of a whole metal plate that covers the plane.
    strips
        (degrees from the vertical towards +x, scan) of strips that cover the plane: two orientations or more; one
        gives the axial ratio alone, the same in both boards.
    config
        Rig file for scans in the authors' layout.

    Returns
    -------
    leakage, facts
        facts are plain: simulated, scan ids, pixels, incidence_deg.

    Raises
    ------
    DataError
        when the scans are of different rigs, do not show metal at the same pixels, or are too alike in orientation.
    """
    pipeline, images = imaged(plate, config)
    whole = _reference(pipeline, images)
    theta = specular_incidence_rad(pipeline.rig)
    mask, turned, names = whole.valid & images.valid, [], [pipeline.source.scan_id]
    simulated = pipeline.source.simulated
    for degrees, folder in strips:
        other, seen = imaged(folder, config)
        whole.check_rig(other.imaged_with, str(plate))
        whole.check_axes(seen.x_m, seen.y_m)
        mask = mask & seen.valid
        turned.append((float(np.radians(degrees)), seen.h, seen.v))
        names.append(other.source.scan_id)
        simulated = simulated or other.source.simulated
    if int(mask.sum()) < LEAST_PIXELS:
        raise DataError(
            f"the scans show metal at {int(mask.sum())} common pixels only",
            "plate and strips must cover the same part of the plane",
            "scan them in the same place, larger than the grid on every side",
        )
    found = leakage_from_images((whole.h, whole.v), turned, mask, theta)
    facts = {"scans": names, "simulated": simulated, "pixels": int(mask.sum())}
    return found, {**facts, "incidence_deg": float(np.degrees(theta))}


def leakage(plate: Path, strips: Sequence[tuple[float, Path]], config: Path | None, as_json: bool) -> int:
    """`polysight leakage`: print what belongs into the rig file's [polarimetry]; returns the exit status."""
    found, facts = leakage_of_scans(plate, strips, config)
    rows = {key: [round(z.real, 5), round(z.imag, 5)] for key, z in (("leakage_h", found.h), ("leakage_v", found.v))}
    imbalance = {"db": 20 * float(np.log10(abs(found.imbalance))), "deg": float(np.degrees(np.angle(found.imbalance)))}
    if as_json:
        out = {**facts, **rows, "imbalance_db": imbalance["db"], "imbalance_deg": imbalance["deg"]}
        sys.stdout.write(
            json.dumps({**out, "residual_rad": found.residual, "alike": len(strips) == 1}, indent=1) + "\n"
        )
        return 0
    source = "# simulated scans\n" if facts["simulated"] else ""
    alike = "# one orientation: both boards are taken to leak alike (the axial ratio)\n" if len(strips) == 1 else ""
    rest = f", the standards agree within {found.residual:.4f} rad" if len(strips) > 2 else ""
    sys.stdout.write(
        f"{source}{alike}[polarimetry]\n"
        f"leakage_h = {rows['leakage_h']}\nleakage_v = {rows['leakage_v']}\n"
        f"# H over V in the images: {imbalance['db']:+.2f} dB, {imbalance['deg']:+.1f} degrees;"
        f" from {facts['pixels']} pixels{rest}\n"
    )
    return 0
