"""Illumination: what a uniform perfect mirror at the object plane would look like.

A flat plate is bright only where it mirrors the TX into the RX. For a mirror parallel to the stage that point moves
with the stage, so its echo is the same at every position: excess path `|tx' - rx| - |tx - rx|` with tx' the TX's
mirror image, amplitude 1 / |tx' - rx|. Its image is the footprint of aperture, mask and window. H and V have theirs
some 17 mm apart, and dividing each image by its own leaves the reflectivity.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polysight.host.imaging.grid import Antennas
from polysight.host.imaging.reduce import Reduction
from polysight.shared.config import Chirp
from polysight.shared.units import SPEED_OF_LIGHT_M_S


def mirror_samples(antennas: Antennas, z_m: float, chirp: Chirp) -> NDArray[np.complex128]:
    """A mirror's samples after referencing, [rx, sample]; amplitude relative to a direct path of one metre."""
    path = antennas.mirror_m(z_m)
    sweep = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)
    phase = 2j * np.pi * np.outer(path - antennas.direct_m, sweep) / SPEED_OF_LIGHT_M_S
    return (np.exp(phase) / path[:, None]).astype(np.complex128)


def mirror_reduced(antennas: Antennas, z_m: float, chirp: Chirp, reduction: Reduction) -> NDArray[np.complex128]:
    """The same after the range gate, [rx, frequency]."""
    return mirror_samples(antennas, z_m, chirp) @ reduction.matrix.T
