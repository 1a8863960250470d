"""Warnings about the plates of a scene before it is scanned: gaps, size, aperture and thickness."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polysight.imaging import compute_field_limits, compute_point_response
from polysight.materials import SegmentSettings
from polysight.planning.forecast import Noise, describe_aperture, find_warnings
from polysight.polarimetry import multilayer, specular_incidence_rad
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import PolysightError
from polysight_shared.findings import Finding
from polysight_shared.tables import decode, read_toml, to_builtins

# Gap in resolution cells below which two plates may merge into one patch. Chosen: a point is one cell wide at half
# power, and half a cell more is left between two of them.
LEAST_GAP_CELLS = 1.5
# The reflection at a plate's back makes the ratio V / H of the plate differ from that of a half space of the same
# medium. Largest relative difference within the sweep that is not worth a warning; chosen.
LARGEST_RIPPLE = 0.05
# Tables of a scene file that replace keys of the rig file.
_OVERRIDES = ("grid", "burst", "image", "stage")
# Number of frequencies of the sweep at which that difference is computed; chosen.
_SWEEP_POINTS = 41
Pair = tuple[float, float]


class Plate(msgspec.Struct, frozen=True):
    """A plate of a scene file, as far as the warnings need it; millimetres from the image's centre.

    `background`: a table or wall, which is larger than the image and gets no warnings.
    """

    name: str
    centre_mm: Pair
    size_mm: Pair
    # Real part and loss; None: metal or layers.
    permittivity: Pair | None = None
    thickness_mm: float | None = None
    background: bool = False

    def edges(self, axis: int) -> Pair:
        """Return the lower and upper edge along x (0) or y (1)."""
        half = self.size_mm[axis] / 2
        return self.centre_mm[axis] - half, self.centre_mm[axis] + half


def read_scene(path: Path, rig: Instrument) -> tuple[Instrument, list[Plate]]:
    """Return the rig with the scene's grid, burst, image, stage and distance, and the plates but the background.

    Raises
    ------
    ConfigError
        if the file or one of these values is wrong.
    """
    scene = read_toml(path)
    table: dict[str, Any] = to_builtins(rig)
    for name in _OVERRIDES:
        table[name] = {**table[name], **scene.get(name, {})}
    if "object_distance_mm" in scene:
        table["geometry"] = {**table["geometry"], "object_distance_mm": scene["object_distance_mm"]}
    plates = [_decode_plate(raw, path) for raw in scene.get("plates", [])]
    return decode(table, Instrument, str(path)), [plate for plate in plates if not plate.background]


def find_scene_warnings(scene: Path, config: Path) -> list[Finding]:
    """Return the notes about the plates of a scene file, and about the ghosts that its grid's steps make by aliasing.

    A wrong file has no notes: the simulator says what is wrong with it.
    """
    try:
        rig, plates = read_scene(scene, load_instrument(config))
    except PolysightError:
        return []
    notes = list(warn_of_scene(rig, plates))
    # A plate that covers the whole image has its ghosts on itself, where they add nothing.
    width_mm = rig.image.columns * rig.image.pixel_mm
    height_mm = rig.image.rows * rig.image.pixel_mm
    smaller = [plate for plate in plates if plate.size_mm[0] < width_mm or plate.size_mm[1] < height_mm]
    if smaller:
        # A ghost is harmful where it lies on another plate or makes a patch of its own: the plates set the extent of
        # the scene. The warnings about aliasing do not depend on the noise.
        scene_mm = _measure_extent(smaller, axis=0), _measure_extent(smaller, axis=1)
        warnings = find_warnings(rig, Noise(), scene_mm)
        notes += [note for note in warnings if note.where == "aliasing"]
    return notes


def _measure_extent(plates: Sequence[Plate], axis: int) -> float:
    """Return the width of the smallest scene that is centred on the image and holds the plates, mm."""
    return 2 * max(abs(edge) for plate in plates for edge in plate.edges(axis))


def _decode_plate(raw: Mapping[str, Any], path: Path) -> Plate:
    """Return a plate of a scene file; keys that the warnings do not need are left out."""
    known_keys = {key: value for key, value in raw.items() if key in Plate.__struct_fields__}
    return decode(known_keys, Plate, f"{path}: plates")


def warn_of_scene(rig: Instrument, plates: Sequence[Plate]) -> Iterator[Finding]:
    """Yield a note for each gap, size, place or thickness that spoils the result of a plate."""
    aperture, taper = describe_aperture(rig)
    cell_mm = compute_point_response(aperture, taper).width_mm
    for plate in plates:
        yield from _warn_of_size(plate, cell_mm)
        yield from _warn_of_aperture(plate, rig)
        yield from _warn_of_thickness(plate, rig)
    # A grid of one row, or of one column, resolves nothing across it: its cell is infinite. The notes about the
    # aperture report that.
    if all(map(math.isfinite, cell_mm)):
        for first, second in combinations(plates, 2):
            yield from _warn_of_gap(first, second, cell_mm)


def _warn_of_gap(first: Plate, second: Plate, cell_mm: Pair) -> Iterator[Finding]:
    """Warn of two plates closer than 1.5 resolution cells, which segmentation may join."""
    gaps_mm = []
    for axis in (0, 1):
        low, high = first.edges(axis)
        other_low, other_high = second.edges(axis)
        gaps_mm.append(max(low, other_low) - min(high, other_high))
    cells = [gap / cell for gap, cell in zip(gaps_mm, cell_mm, strict=True)]
    # Plates side by side overlap along one axis, where the gap is negative: the larger gap is the one between them.
    axis = int(np.argmax(cells))
    if cells[axis] < LEAST_GAP_CELLS:
        least_mm = LEAST_GAP_CELLS * cell_mm[axis]
        text = (
            f"{first.name} and {second.name} are {max(gaps_mm[axis], 0):.0f} mm apart in {'xy'[axis]}; below"
            f" {math.ceil(least_mm)} mm (1.5 resolution cells) they may be found as one patch: move them apart, or draw"
            " boxes (polysight label)"
        )
        yield Finding("note", text, where="gap")


def _warn_of_size(plate: Plate, cell_mm: Pair) -> Iterator[Finding]:
    """Warn of a plate that is so small that its edges disturb every pixel of it."""
    margin_mm = SegmentSettings().margin_mm
    for axis in (0, 1):
        least_mm = 2 * margin_mm + cell_mm[axis]
        if plate.size_mm[axis] < least_mm < math.inf:
            text = (
                f"{plate.name} is {plate.size_mm[axis]:.0f} mm wide in {'xy'[axis]}; below {math.ceil(least_mm)} mm no"
                " pixel is free of its edges"
            )
            yield Finding("note", text, where="size")


def _warn_of_aperture(plate: Plate, rig: Instrument) -> Iterator[Finding]:
    """Warn of a plate that reaches beyond the area where this aperture images mirrors well."""
    zone_mm = compute_field_limits(rig).mirror_zone_mm
    aperture_mm = ((rig.grid.columns - 1) * rig.grid.step_x_mm, (rig.grid.rows - 1) * rig.grid.step_y_mm)
    for axis in (0, 1):
        # Around the specular point of a smooth plate the aperture must hold the first Fresnel zone, on every side.
        reach_mm = aperture_mm[axis] / 2 - zone_mm[axis]
        low, high = plate.edges(axis)
        beyond_mm = max(-low, high) - reach_mm
        if beyond_mm > 0:
            text = (
                f"{plate.name} reaches {beyond_mm:.0f} mm beyond the {max(2 * reach_mm, 0):.0f} mm in {'xy'[axis]} that"
                f" this aperture of {aperture_mm[axis]:.0f} mm images well: a larger aperture, or nearer to the centre"
            )
            yield Finding("note", text, where="aperture")


def _warn_of_thickness(plate: Plate, rig: Instrument) -> Iterator[Finding]:
    """Warn of a plate whose back changes V / H within the sweep: it is not a half space."""
    if plate.permittivity is None or plate.thickness_mm is None:
        return
    first, last = rig.chirp.linear_samples
    samples = np.linspace(first, last, _SWEEP_POINTS)
    frequencies_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * samples
    eps = complex(plate.permittivity[0], -plate.permittivity[1])
    theta_rad = specular_incidence_rad(rig)
    sheet_s, sheet_p = multilayer(eps, plate.thickness_mm / 1e3, frequencies_hz, theta_rad)
    bulk_s, bulk_p = multilayer(eps, np.inf, frequencies_hz, theta_rad)
    if not (np.all(sheet_s) and np.all(bulk_s)):
        # Nothing is reflected: air, or no thickness.
        return
    # At the Brewster angle V / H vanishes, and with it the reference of the relative change: LARGEST_RIPPLE replaces
    # a smaller reference.
    sheet_ratio = sheet_p / sheet_s
    bulk_ratio = bulk_p / bulk_s
    change = np.abs(sheet_ratio - bulk_ratio) / np.maximum(np.abs(bulk_ratio), LARGEST_RIPPLE)
    if change.max() > LARGEST_RIPPLE:
        text = (
            f"{plate.name}: {plate.thickness_mm:g} mm are thin enough for its back to change the ratio by up to"
            f" {100 * change.max():.0f} % over the sweep: process with --bands 4 and fit it as a layer"
            " (docs/how-to/layers.md), or take a thicker piece"
        )
        yield Finding("note", text, where="thickness")
