"""Draw the specimens of a scene: true permittivities, heights and tilts of plates, and the facets of rough plates.

A scene file has nominal values; :func:`draw_specimens` draws each plate's permittivity and adds shift and tilt of the
object plane to it. The draws depend only on the scene's seed and the plate's index: another power cycle (`--seed`)
scans the same specimens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight_simulators.scene.draws import stream_key
from polysight_simulators.scene.scene_file import Layer, Pair, Plate, Scene

_AIR = (1.0, 0.0)


@dataclass(frozen=True)
class Facets:
    """Rectangles of constant height on a plate, in addition to its tilt; metres from the plate's centre.

    Attributes
    ----------
    x_m, y_m
        Centres of the columns and rows of facets.
    size_m
        Sides of one facet along x and y.
    height_m
        float64 [row, column]: zero for a smooth plate, which is one facet.
    """

    x_m: NDArray[np.floating]
    y_m: NDArray[np.floating]
    size_m: tuple[float, float]
    height_m: NDArray[np.floating]


def draw_specimens(scene: Scene) -> Scene:
    """Return the scene with true plates and points; applying it again changes nothing.

    Permittivities are drawn with `specimen_spread`: the real part from a normal distribution (at least 1), the loss
    from a log-normal one, around the nominal values; a layer of air stays air. Shift and tilt of the plane are added to
    those of each plate and point.
    """
    plates = tuple(_placed(_drawn(p, i, scene), scene) for i, p in enumerate(scene.plates))
    points = tuple(
        msgspec.structs.replace(p, height_mm=p.height_mm + _plane_height_mm(scene, p.position_mm)) for p in scene.points
    )
    return msgspec.structs.replace(
        scene,
        plates=plates,
        points=points,
        plane_shift_mm=0.0,
        plane_tilt_deg=(0.0, 0.0),
        specimen_spread=(0.0, 0.0),
    )


def facets(plate: Plate, index: int, seed: int) -> Facets:
    """Return the facets of the plate with this index: independent normal heights from the scene's seed.

    A whole number of facets fits the plate, with sides near `rough_length_mm`.
    """
    n = [max(1, round(side / plate.rough_length_mm)) if plate.rough_mm else 1 for side in plate.size_mm]
    sx, sy = (side / 1e3 / count for side, count in zip(plate.size_mm, n, strict=True))
    x, y = ((np.arange(count) - (count - 1) / 2) * side for count, side in zip(n, (sx, sy), strict=True))
    height = np.zeros((n[1], n[0]))
    if plate.rough_mm:
        rng = np.random.default_rng([stream_key(seed, "rough"), index])
        height = rng.standard_normal(height.shape) * plate.rough_mm / 1e3
    return Facets(x, y, (sx, sy), height)


def slopes(plate: Plate) -> tuple[float, float]:
    """Return the growth of the plate's height along x and y."""
    return math.tan(math.radians(plate.tilt_deg[0])), math.tan(math.radians(plate.tilt_deg[1]))


def _plane_height_mm(scene: Scene, at_mm: Pair) -> float:
    along = [math.tan(math.radians(a)) * x for a, x in zip(scene.plane_tilt_deg, at_mm, strict=True)]
    return scene.plane_shift_mm + sum(along)


def _placed(plate: Plate, scene: Scene) -> Plate:
    """Return the plate with shift and tilt of the plane added."""
    tilt = plate.tilt_deg
    if any(scene.plane_tilt_deg):
        both = [
            math.tan(math.radians(a)) + math.tan(math.radians(b))
            for a, b in zip(tilt, scene.plane_tilt_deg, strict=True)
        ]
        tilt = (math.degrees(math.atan(both[0])), math.degrees(math.atan(both[1])))
    height_mm = plate.height_mm + _plane_height_mm(scene, plate.centre_mm)
    return msgspec.structs.replace(plate, tilt_deg=tilt, height_mm=height_mm)


def _drawn(plate: Plate, index: int, scene: Scene) -> Plate:
    """Return the plate with drawn permittivities."""
    if not any(scene.specimen_spread) or plate.metal:
        return plate
    rng = np.random.default_rng([stream_key(scene.seed, "specimen"), index])
    if plate.permittivity is not None:
        return msgspec.structs.replace(plate, permittivity=_vary(plate.permittivity, scene.specimen_spread, rng))
    return msgspec.structs.replace(plate, layers=tuple(_vary_layer(x, scene, rng) for x in plate.layers))


def _vary_layer(layer: Layer, scene: Scene, rng: np.random.Generator) -> Layer:
    varied = _vary(layer.permittivity, scene.specimen_spread, rng)
    return layer if layer.permittivity == _AIR else msgspec.structs.replace(layer, permittivity=varied)


def _vary(nominal: Pair, spread: Pair, rng: np.random.Generator) -> Pair:
    real, loss = rng.standard_normal(2)
    width = math.sqrt(math.log1p(spread[1] ** 2))  # the log-normal factor has mean 1 and standard deviation spread[1]
    return max(1.0, nominal[0] * (1 + spread[0] * real)), nominal[1] * math.exp(width * loss - width**2 / 2)
