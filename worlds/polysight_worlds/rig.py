"""The rig: one transmitter and two receivers that a stage moves together in front of the scene.

Axes: x from TX to RX, y up, z towards the object. H receives s (along y at the middle of the picture), V receives p, TX
sends equal parts of both. A board's mount gives place and boresight. Polarisations are exact where the object plane is
a mirror, as the authors state: the turn of 22.5 degrees in the mounts of both receivers would mix s and p, and their
pictures have no such mixture. A stage offset of zero is the middle of the grid.
"""

import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polysight_worlds.optics import Antenna

# The chirp's linear part. The echoes of a flat scene lie within so few range cells that six to twelve frequencies
# describe them; eight are chosen.
FREQUENCIES_HZ = np.linspace(76.3e9, 79.75e9, 8)


@dataclass(frozen=True)
class Rig:
    """Antennas at stage offset zero, the object plane's z, the grid of offsets, and the transmit frequencies.

    The defaults are those of the published rig.
    """

    tx: Antenna
    h: Antenna
    v: Antenna
    plane_m: float = 0.499
    columns: int = 350
    rows: int = 200
    step_m: float = 0.002
    frequencies_hz: NDArray = field(default_factory=FREQUENCIES_HZ.copy)

    @property
    def centre_m(self) -> NDArray:
        """x, y [2] at which TX and H see the object plane as a mirror at stage offset zero; the picture's middle."""
        return find_mirror_point(self.tx.position, self.h.position, self.plane_m)[:2]

    def incidence_deg(self, channel: str) -> float:
        """Return the angle of incidence at the mirror point of receiver "h" or "v": the same wherever a plate lies."""
        mirror_point = find_mirror_point(self.tx.position, getattr(self, channel).position, self.plane_m)
        incident = mirror_point - self.tx.position
        return float(np.degrees(np.arccos(incident[2] / np.linalg.norm(incident))))

    def offsets_m(self) -> tuple[NDArray, NDArray]:
        """Return the stage offsets in x [columns] and y [rows]."""
        x = (np.arange(self.columns) - (self.columns - 1) / 2) * self.step_m
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.step_m
        return x, y


def turn(axis: NDArray, angle_deg: float) -> NDArray:
    """Return the rotation matrix [3, 3] about a unit axis [3] (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(angle_deg)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def find_mirror_point(tx: NDArray, rx: NDArray, plane_m: float) -> NDArray:
    """Return the point of the plane z = `plane_m` in which RX sees TX as in a mirror, [3], metres."""
    # On the line to the other antenna, the mirror point divides as the two heights above the plane do.
    share = (plane_m - tx[2]) / (2 * plane_m - tx[2] - rx[2])
    return np.array([*(tx + share * (rx - tx))[:2], plane_m])


def place(steps: list[dict], antenna_mm: NDArray) -> tuple[NDArray, NDArray]:
    """Return position (metres) and boresight [3] of a board's antenna after the steps of its mount, in their order."""
    position = np.asarray(antenna_mm, float)
    boresight = np.array([0.0, 0.0, 1.0])
    for step in steps:
        if "shift_mm" in step:
            position = position + np.asarray(step["shift_mm"], float)
        else:
            rotation = turn(np.eye(3)["xyz".index(step["about"])], step["turn_deg"])
            position = rotation @ position
            boresight = rotation @ boresight
    return position / 1000, boresight


def load_rig(file: Path) -> Rig:
    """Load the rig of an `instrument.toml`: mounts, antennas, object distance, grid; a board's four RX become one."""
    return read_rig(tomllib.loads(file.read_text(encoding="utf-8")))


def read_rig(content: dict, leakage: tuple[complex, complex] = (0j, 0j)) -> Rig:
    """Return the rig of an instrument file's content; `leakage`: p into H and s into V, towards their mirror points."""
    boards = {board["role"]: board for board in content["boards"]}
    antennas = content["antennas"]
    sender = boards["transmit"]
    tx = place(sender["mount"], antennas["tx_mm"][sender["tx_antenna"]])
    middle_mm = np.mean(antennas["rx_mm"], axis=0)
    h = place(boards["receive_h"]["mount"], middle_mm)
    v = place(boards["receive_v"]["mount"], middle_mm)
    plane_m = content["geometry"]["object_distance_mm"] / 1000
    grid = content["grid"]
    return build_rig(tx, h, v, plane_m=plane_m, columns=grid["columns"], rows=grid["rows"], leakage=leakage)


def build_rig(
    tx: tuple[NDArray, NDArray],
    h: tuple[NDArray, NDArray],
    v: tuple[NDArray, NDArray],
    *,
    plane_m: float,
    columns: int = 350,
    rows: int = 200,
    leakage: tuple[complex, complex] = (0j, 0j),
) -> Rig:
    """Return the rig of three boards, each (position in metres, boresight).

    At its own mirror point H receives s, and V receives p; towards that of H, TX sends s and p in equal parts.
    `leakage`: the amplitudes of p in H and of s in V, relative to the receiver's polarisation.
    """

    def aim(
        board: tuple[NDArray, NDArray], receiver: tuple[NDArray, NDArray], s_share: complex, p_share: complex
    ) -> Antenna:
        """Aim a board at the mirror point of a receiver; the dipole has shares along the s and the p direction."""
        direction = find_mirror_point(tx[0], receiver[0], plane_m) - board[0]
        direction /= np.linalg.norm(direction)
        s_axis = np.cross([0.0, 0.0, 1.0], direction)
        s_axis *= np.sign(s_axis[1]) / np.linalg.norm(s_axis)
        # Along +x, so that metal gives H and V the same sign.
        p_axis = np.cross(direction, s_axis)
        p_axis *= np.sign(p_axis[0])
        return Antenna.aim(*board, direction, s_share * s_axis + p_share * p_axis)

    half = np.sqrt(0.5)
    return Rig(aim(tx, h, half, half), aim(h, h, 1, leakage[0]), aim(v, v, leakage[1], 1), plane_m, columns, rows)


def published_rig() -> Rig:
    """Return the published rig, 55 degrees of incidence: numbers of `place` with the mounts of instrument.toml."""
    tx = np.array([-0.705544, 0.097419, 0.013030]), np.array([0.694658, 0.0, 0.719340])
    h = np.array([0.685843, 0.104606, 0.011526]), np.array([-0.819152, 0.0, 0.573576])
    v = np.array([0.683008, 0.136290, 0.009475]), np.array([-0.950993, -0.130885, 0.280145])
    return build_rig(tx, h, v, plane_m=0.499)


@dataclass(frozen=True)
class Boards:
    """All antennas at stage offset zero: TX, and the RX of both receiving boards."""

    tx: Antenna
    h: tuple[Antenna, ...]
    v: tuple[Antenna, ...]

    def receivers(self) -> dict[str, tuple[Antenna, ...]]:
        """Return the receiving boards by channel."""
        return {"h": self.h, "v": self.v}


def spread_receivers(rig: Rig, step_h_m: NDArray, step_v_m: NDArray, count: int = 4) -> Boards:
    """Return boards whose `count` RX lie `step_h_m` or `step_v_m` [3] apart about the mean places of `rig`."""
    places = np.arange(count) - (count - 1) / 2
    h = tuple(replace(rig.h, position=rig.h.position + place * step_h_m) for place in places)
    v = tuple(replace(rig.v, position=rig.v.position + place * step_v_m) for place in places)
    return Boards(rig.tx, h, v)


def load_boards(file: Path) -> Boards:
    """Return the boards of an `instrument.toml`."""
    return read_boards(tomllib.loads(file.read_text(encoding="utf-8")))


def read_boards(content: dict, leakage: tuple[complex, complex] = (0j, 0j)) -> Boards:
    """Return the boards of an instrument file's content, their RX evenly spaced; `leakage` as of `read_rig`."""
    steps = {}
    for board in content["boards"]:
        places = [place(board["mount"], antenna_mm)[0] for antenna_mm in content["antennas"]["rx_mm"]]
        steps[board["role"]] = (places[-1] - places[0]) / max(1, len(places) - 1)
    rig = read_rig(content, leakage)
    return spread_receivers(rig, steps["receive_h"], steps["receive_v"], len(content["antennas"]["rx_mm"]))


def published_boards() -> Boards:
    """Return the boards of the published rig: RX half a wavelength (1.9 mm) apart along each board."""
    step_h_m = np.array([0.00100684, 0.00072709, 0.00143791])
    step_v_m = np.array([-0.00041705, 0.00175540, -0.00059560])
    return spread_receivers(published_rig(), step_h_m, step_v_m)
