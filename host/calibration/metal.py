"""A metal plate over the plane as a calibration file: gains of both channels at every pixel.

What the gains are is :mod:`host.polarimetry.reference`; here they only get a file of their own.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import msgspec
import numpy as np

from host.calibration.files import MetalFile, SourceScan, head, write
from host.polarimetry import PlaneReference
from shared.errors import DataError, DeviceError

LEAST_LEVEL = 0.02  # of a mirror's answer beside the direct path's; antenna patterns may take some 20 dB


def write_metal(reference: PlaneReference, sources: list[SourceScan], out: Path) -> Path:
    """Write gains and their file. Returns the file's path; the images lie beside it under the same name.

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
        note="sub-bands are not kept: `polysight process --reference SCAN --bands K` makes them",
    )
    path = write(file, out)  # takes the name
    images = path.with_suffix(".npz")
    try:
        np.savez_compressed(
            images, h=reference.h, v=reference.v, valid=reference.valid, x_m=reference.x_m, y_m=reference.y_m
        )
        digest = f"{zlib.crc32(images.read_bytes()):08x}"
        path.unlink()
    except OSError as e:
        path.unlink(missing_ok=True)
        images.unlink(missing_ok=True)
        raise DeviceError(f"{images}: {e.strerror}", "the disk is full, or a permission", "free space") from None
    return write(msgspec.structs.replace(file, images=images.name, images_crc32=digest), out)
