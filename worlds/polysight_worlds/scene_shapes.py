"""Echoes of the shapes of a scene file, for simulators that look for them (entry point `polysight.shape_echoes`).

The only things that pass are plain tables, as a scene file and a rig file hold them, and arrays.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight_worlds.media import METAL, Stack
from polysight_worlds.optics import Antenna
from polysight_worlds.rig import find_mirror_point, read_boards, read_rig
from polysight_worlds.shape_echoes import simulate_echo
from polysight_worlds.shapes import Shape, bottle, cylinder, plate, sphere


def simulate_echoes(
    shapes: Sequence[dict[str, Any]],
    rig: dict[str, Any],
    role: str,
    leakage: tuple[complex, complex],
    offsets_m: NDArray,
    frequencies_hz: NDArray,
    centre_m: tuple[float, float, float],
    path_m: float,
) -> NDArray:
    """Return samples of shapes at one board, complex64 [rx, frequency, offset].

    Phases rise with the path and have that of `path_m` removed. The mirror on the object plane has the amplitude
    1 / path in H and in V. `shapes` and `rig`: tables of the scene file and the rig file; `role`: "receive_h" or
    "receive_v"; `leakage`: amplitudes of p in H and of s in V, relative to the receiver's polarisation; `offsets_m`
    [n, 2]. `centre_m`: the image's centre on the object plane.
    """
    nominal = read_rig(rig)
    boards = read_boards(rig, leakage)
    channel = role.removeprefix("receive_")
    level = _mirror_level(nominal.tx, getattr(nominal, channel), nominal.plane_m)
    offsets = np.column_stack([offsets_m, np.zeros(len(offsets_m))])
    pieces = [piece for table in shapes for piece in make_shapes(table, centre_m)]
    samples = []
    for rx in boards.receivers()[channel]:
        wave = np.zeros((len(frequencies_hz), len(offsets)), np.complex64)
        for piece in pieces:
            wave += simulate_echo(piece, boards.tx, rx, np.asarray(frequencies_hz, float), offsets, path_m)
        # Fields are exp(-j k r) here, and the simulator's phases rise with the path.
        samples.append(wave.conj() / np.float32(level))
    return np.stack(samples)


def _mirror_level(tx: Antenna, rx: Antenna, plane_m: float) -> float:
    """Return product of both antennas' fields towards their mirror point, in the polarisation of the receiver."""
    point = find_mirror_point(tx.position, rx.position, plane_m)
    rays = [(point - antenna.position) / np.linalg.norm(point - antenna.position) for antenna in (tx, rx)]
    fields = [antenna.field(ray[:, None])[:, 0] for antenna, ray in zip((tx, rx), rays, strict=True)]
    # TX sends equal parts of both polarisations.
    return float(np.linalg.norm(fields[0]) * np.linalg.norm(fields[1]) / np.sqrt(2))


def make_shapes(table: dict[str, Any], centre_m: Sequence[float]) -> tuple[Shape, ...]:
    """Return the shapes of one [[shapes]] table, which has its optional keys, too: no defaults are known here."""
    x, y, z = centre_m
    front_m = x + table["centre_mm"][0] / 1000, y + table["centre_mm"][1] / 1000, z + table["height_mm"] / 1000
    name = table["name"]
    kind = table["kind"]
    stack = _read_stack(table)
    if kind == "plate":
        width_mm, height_mm = table["size_mm"]
        piece = plate(
            name,
            stack,
            front_m,
            (width_mm / 1000, height_mm / 1000),
            tilt_deg=tuple(table["tilt_deg"]),
            turn_deg=table["turn_deg"],
            bends=tuple(table["bends_per_m"]),
        )
        return (piece,)
    radius_m = table["radius_mm"] / 1000
    length_m = table["length_mm"] / 1000
    axis = tuple(table["axis"])
    # The table places the point nearest to the rig; z grows away from the rig.
    middle_m = (front_m[0], front_m[1], front_m[2] + radius_m)
    if kind == "sphere":
        return (sphere(name, stack, middle_m, radius_m),)
    if kind == "bottle":
        return bottle(name, stack, middle_m, radius_m, length_m, axis=axis)
    # With a slope the cylinder is a cone.
    slope = float(np.tan(np.radians(table["slope_deg"])))
    return (cylinder(name, stack, middle_m, radius_m, length_m, axis=axis, slope=slope),)


def _read_stack(table: dict[str, Any]) -> Stack:
    """Return the medium of a shape in a scene file: metal, a sheet in air, or a half space."""
    if table.get("metal"):
        return METAL
    real, loss = table["permittivity"]
    medium = complex(real, -loss)
    if table.get("thickness_mm") is None:
        return Stack(below=medium)
    return Stack(((medium, table["thickness_mm"] / 1000),), 1.0)
