"""A metal plate over the plane as a calibration file: gains of both channels at every pixel.

What the gains are is :mod:`polysight.host.polarimetry.reference`; here they only get a file of their own.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from polysight.host.calibration.files import MetalBand, MetalFile, SourceScan, head, write
from polysight.host.imaging import SubBand
from polysight.host.polarimetry import PlaneReference
from polysight.host.store import open_npz
from polysight.shared.errors import DataError, DeviceError

IMAGES = ("h", "v", "valid")
LEAST_LEVEL = 0.02  # of a mirror's answer beside the direct path's; antenna patterns may take some 20 dB


def write_metal(reference: PlaneReference, sources: list[SourceScan], out: Path, bands: Sequence[SubBand] = ()) -> Path:
    """Write gains and their file. Returns the file's path; the images lie beside it under the same name.

    `bands` are the parts of the sweep that `reference.bands` are of.

    Raises
    ------
    DataError
        when what was seen is too weak to be metal.
    DeviceError
        when it cannot be written.
    """
    facts = reference.facts()
    for channel, image in (("H", reference.h), ("V", reference.v)):
        level = float(np.median(np.abs(image[reference.valid])))
        if level < LEAST_LEVEL:
            raise DataError(
                f"the reference scan shows no metal plate: {channel} is {level:.4f} of what a mirror answers",
                "there was none, or it lay too deep or tilted to mirror the transmitter into the receivers",
                "scan a flat metal plate that covers the plane, larger than the grid on every side",
            )
    file = MetalFile(
        **head("metal", sources),
        images="",
        images_crc32="",
        share_of_plane=facts["share_of_plane"],
        h_variation_db=facts["h_variation_db"],
        v_variation_db=facts["v_variation_db"],
        ratio_variation_db=facts["ratio_variation_db"],
        ratio_variation_deg=facts["ratio_variation_deg"],
        spread=reference.spread,
        how=reference.how,
        imaged_with=reference.made_with,
        bands=[
            MetalBand(band.first_hz, band.last_hz, part.spread, part.how)
            for band, part in zip(bands, reference.bands, strict=True)
        ],
    )
    path = write(file, out)  # takes the name
    images = path.with_suffix(".npz")
    try:
        arrays = {name: getattr(reference, name) for name in IMAGES}
        if reference.bands:
            arrays |= {f"band_{n}": np.stack([getattr(part, n) for part in reference.bands]) for n in IMAGES}
        np.savez_compressed(images, x_m=reference.x_m, y_m=reference.y_m, **arrays)
        digest = f"{zlib.crc32(images.read_bytes()):08x}"
        path.unlink()
    except OSError as e:
        path.unlink(missing_ok=True)
        images.unlink(missing_ok=True)
        raise DeviceError(f"{images}: {e.strerror}", "the disk is full, or a permission", "free space") from None
    return write(msgspec.structs.replace(file, images=images.name, images_crc32=digest), out)


def read_metal(file: MetalFile, images: Path) -> PlaneReference:
    """The reference that a file and its images hold, sub-bands included.

    Raises
    ------
    DataError
        when the images are not what the file names.
    """
    if not images.is_file() or f"{zlib.crc32(images.read_bytes()):08x}" != file.images_crc32:
        raise DataError(
            f"{images}: absent, or not the images that its calibration file names",
            "the two files were parted",
            "copy both, or calibrate again",
        )
    with open_npz(images) as f:
        arrays: dict[str, npt.NDArray] = dict(f)
    whole = PlaneReference(
        *(arrays[name] for name in IMAGES),
        x_m=arrays["x_m"],
        y_m=arrays["y_m"],
        spread=file.spread,
        how=file.how,
        made_with=file.imaged_with,
    )
    parts = (
        replace(whole, spread=band.spread, how=band.how, **{n: arrays[f"band_{n}"][k] for n in IMAGES})
        for k, band in enumerate(file.bands)
    )
    return replace(whole, bands=tuple(parts))
