"""From a world to a pair of images: echoes, direct path, nuisances of the scan, matched filter.

The processing knows the nominal rig only. Each sample is divided by the direct path of its position (the nominal one in
length), the range gate is the sum over frequencies, and the image a matched filter on the object plane.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from polysight_worlds.media import reflect
from polysight_worlds.optics import Antenna, receive_direct, turn_back
from polysight_worlds.rig import Rig, published_rig, turn
from polysight_worlds.scan import fast_length, fft2, ifft2, record, signed_lags
from polysight_worlds.world import Nuisances, Plate, World, disturb_plates


@dataclass(frozen=True)
class ImagePair:
    """Images of one scan in the rig frame, and the truth.

    h, v: complex64 [ny, nx], row 0 at the smallest y, relative to the direct path. Phases fall with the path, as fields
    of exp(+j omega t) do: H / V of a plate over that of metal is r_s / r_p, and a lossy permittivity eps' - j eps''.
    `h_slope`, `v_slope`: change of h and v per Hz: image of the data times (f - mean) over the variance of f.
    `x_m` [nx], `y_m` [ny]: centres of the pixels in the rig frame. `world`: as it was scanned, with
    the plates' drawn heights and tilts. `rig`: the nominal one.
    """

    h: NDArray
    v: NDArray
    x_m: NDArray
    y_m: NDArray
    world: World
    nuisances: Nuisances
    rig: Rig
    h_slope: NDArray
    v_slope: NDArray

    @property
    def incidence_deg(self) -> float:
        """Mean of the angles of incidence of H and V, a tenth of a degree apart."""
        return (self.rig.incidence_deg("h") + self.rig.incidence_deg("v")) / 2

    def plate_ratio(self, plate: Plate) -> complex:
        """H / V of a plate over that of metal, without any disturbance, at the middle of the band."""
        cos_h = np.cos(np.radians(self.rig.incidence_deg("h")))
        cos_v = np.cos(np.radians(self.rig.incidence_deg("v")))
        r_s, _ = reflect(plate.stack, self.rig.frequencies_hz.mean(), cos_h)
        _, r_p = reflect(plate.stack, self.rig.frequencies_hz.mean(), cos_v)
        return complex(r_s / r_p)

    def label_boxes(self) -> dict:
        """Return boxes of the plates inside the picture as a label file: mm from the picture's middle, y up."""
        middle_m = np.array([self.x_m.mean(), self.y_m.mean()] * 2)
        half_mm = 1000 * (self.x_m[-1] - self.x_m[0]) / 2
        boxes = {}
        for number, plate in enumerate(self.world.plates):
            box_mm = 1000 * (np.array(plate.box_m) - middle_m)
            if np.abs(box_mm).max() <= half_mm:
                boxes[f"{plate.name}#{number}"] = np.round(box_mm, 2).tolist()
        metal = [f"{p.name}#{i}" for i, p in enumerate(self.world.plates) if p.stack.is_metal]
        metal = [name for name in metal if name in boxes]
        return {"unit": "mm", "by_hand": True, "labels": boxes, "metal": metal[0] if metal else None}

    def truth(self) -> dict:
        """Return the truth for JSON, complex numbers as [real, imaginary]; a label file of the instrument, too."""
        plates = []
        for plate in self.world.plates:
            written: dict[str, Any] = asdict(plate)
            stack = written.pop("stack")
            ratio = self.plate_ratio(plate)
            written["box_m"] = plate.box_m
            written["is_metal"] = plate.stack.is_metal
            written["layers"] = [[eps.real, eps.imag, 1000 * thick] for eps, thick in stack["layers"]]
            written["below"] = [stack["below"].real, stack["below"].imag]
            written["ratio"] = [ratio.real, ratio.imag]
            plates.append(written)
        return {
            **self.label_boxes(),
            "simulated": True,
            "phase": "falls with the path",
            "incidence_deg": self.incidence_deg,
            "frequencies_hz": self.rig.frequencies_hz.tolist(),
            "nuisances": asdict(self.nuisances),
            "active": self.nuisances.active(),
            "plates": plates,
        }


def simulate(
    world: World,
    nuisances: Nuisances | None = None,
    rig: Rig | None = None,
    *,
    pixels: int = 150,
    kaiser_beta: float = 0.0,
) -> ImagePair:
    """Scan a world and image it on `pixels` x `pixels` of one stage step, centred as `Rig.centre_m`.

    `kaiser_beta`: window over the aperture; 0: no window. With a window, H / V of metal changes by some per cent over
    the picture, because H and V see a place from offsets 17 mm apart.
    """
    nominal = published_rig() if rig is None else rig
    nuisances = Nuisances() if nuisances is None else nuisances
    nominal = _cut_grid(nominal, nuisances)
    true_world = disturb_plates(_shift_world(world, nuisances, pixels * nominal.step_m), nuisances)
    true_rig = disturb_rig(nominal, nuisances)
    # A second number beside the seed: every purpose has random numbers of its own.
    rng = np.random.default_rng([nuisances.seed, 3])
    positions = _draw_bad_positions(rng, nominal, nuisances)
    from_middle_hz = nominal.frequencies_hz - nominal.frequencies_hz.mean()
    slope_weights = (from_middle_hz / np.mean(from_middle_hz**2)).astype(np.float32)[:, None, None]
    images = []
    slopes = []
    for channel in ("h", "v"):
        true_rx: Antenna = getattr(true_rig, channel)
        echoes = record(true_rig, true_rx, true_world, seed=nuisances.seed)
        direct = receive_direct(true_rig.tx, true_rx, true_rig.frequencies_hz)
        data = disturb_data(
            rng=rng, rig=nominal, echoes=echoes, direct=direct, nuisances=nuisances, channel=channel, dark=positions
        )
        rx: Antenna = getattr(nominal, channel)
        image, slope = backproject(nominal, rx, np.stack([data, data * slope_weights]), pixels, kaiser_beta)
        images.append(image)
        slopes.append(slope)
    x_m, y_m = pixel_centres(nominal, pixels)
    return ImagePair(
        h=images[0],
        v=images[1],
        x_m=x_m,
        y_m=y_m,
        world=true_world,
        nuisances=nuisances,
        rig=nominal,
        h_slope=slopes[0],
        v_slope=slopes[1],
    )


def disturb_rig(rig: Rig, nuisances: Nuisances) -> Rig:
    """Return the rig as it really stands: boards turned and misplaced, polarisations leaking, longer stage steps."""
    rng = np.random.default_rng([nuisances.seed, 4])

    def disturb(antenna: Antenna, turn_deg: float, leakage: float) -> Antenna:
        axis = draw_direction(rng)
        shift_m = draw_direction(rng) * nuisances.misplaced_mm / 1000
        phase = rng.uniform(0, 2 * np.pi)
        return antenna.rotate(turn(axis, turn_deg), shift_m).with_leakage(leakage * np.exp(1j * phase))

    return replace(
        rig,
        tx=disturb(rig.tx, nuisances.tx_turn_deg, 0.0),
        h=disturb(rig.h, nuisances.h_turn_deg, nuisances.leakage),
        v=disturb(rig.v, nuisances.v_turn_deg, nuisances.leakage),
        step_m=rig.step_m * (1 + nuisances.stage_scale),
    )


def draw_direction(rng: Generator) -> NDArray:
    """Return the unit vector [3] in any direction."""
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _cut_grid(rig: Rig, nuisances: Nuisances) -> Rig:
    """Return the rig with the share `aperture` of columns and rows left out."""
    share = 1 - nuisances.aperture
    return replace(rig, columns=round(rig.columns * share), rows=round(rig.rows * share))


def _shift_world(world: World, nuisances: Nuisances, width_m: float) -> World:
    """Shift the plates by the share `border` of a width, in one of four drawn directions."""
    if not nuisances.border:
        return world
    rng = np.random.default_rng([nuisances.seed, 5])
    direction = [(1, 0), (-1, 0), (0, 1), (0, -1)][rng.integers(4)]
    dx, dy = (nuisances.border * width_m * d for d in direction)
    plates = []
    for plate in world.plates:
        x, y = plate.centre_m
        plates.append(replace(plate, centre_m=(x + dx, y + dy)))
    return replace(world, plates=tuple(plates))


def _draw_bad_positions(rng: Generator, rig: Rig, nuisances: Nuisances) -> NDArray:
    """Draw positions without signal, bool [rows, columns]: runs of 1 to 20 in a row, the same for both receivers."""
    bad = np.zeros((rig.rows, rig.columns), bool)
    return _add_runs(rng, bad, nuisances.dark)


def _add_runs(rng: Generator, marked: NDArray, share: float) -> NDArray:
    """Mark runs of 1 to 20 (chosen) positions until at least this share is marked; changes and returns `marked`."""
    while marked.mean() < share:
        row = rng.integers(marked.shape[0])
        first = rng.integers(marked.shape[1])
        marked[row, first : first + rng.integers(1, 21)] = True
    return marked


def disturb_data(
    rng: Generator,
    rig: Rig,
    echoes: NDArray,
    direct: NDArray,
    nuisances: Nuisances,
    channel: str,
    dark: NDArray,
) -> NDArray:
    """Return echoes relative to the direct path as the synchronisation sees it, complex64 [frequencies, rows, columns].

    `echoes` have the same shape, `direct` [frequencies] is the undisturbed path; `channel` is "h" or "v", `dark` bool
    [rows, columns] marks positions without signal.
    """
    shape = echoes.shape[1:]
    beside = nuisances.multipath * _draw_fringes(rng, rig)
    received_direct = direct[:, None, None] * (1 + beside)
    echoes = echoes.copy()
    if nuisances.clipping:
        echoes, received_direct = _clip(echoes, received_direct, nuisances.clipping)
    rms = np.sqrt(np.mean(np.abs(echoes) ** 2))
    if nuisances.noise:
        echoes = echoes + nuisances.noise * rms * _draw_noise(rng, echoes.shape)
    if nuisances.interference:
        # 2 to 10 times the mean echo, chosen.
        hit = _add_runs(rng, np.zeros(shape, bool), nuisances.interference)
        strength = rms * rng.uniform(2, 10) * np.exp(2j * np.pi * rng.random(echoes.shape))
        echoes = echoes + hit * strength
    data = echoes / received_direct
    if channel == "v" and (nuisances.drift or nuisances.drift_deg):
        data = data * _draw_drift(rng, shape, nuisances)
    data = np.where(dark, 0, data)
    return data.astype(np.complex64)


def _draw_noise(rng: Generator, shape: tuple[int, ...]) -> NDArray:
    """Draw complex noise of mean power 1, complex64 of this shape."""
    pair = rng.standard_normal((2, *shape), dtype=np.float32)
    return (pair[0] + 1j * pair[1]) * np.float32(np.sqrt(0.5))


def _draw_fringes(rng: Generator, rig: Rig) -> NDArray:
    """Return unit phasors [rows, columns] of a second path beside the direct one: curved fringes, 15 to 200 mm wide.

    They curve by up to 15 turns at a metre from the middle. Ranges are chosen.
    """
    x, y = rig.offsets_m()
    period_m = 0.015 * (0.2 / 0.015) ** rng.random()
    direction = rng.uniform(0, 2 * np.pi)
    along = x * np.cos(direction) + y[:, None] * np.sin(direction)
    curved = rng.uniform(-15, 15) * (x**2 + y[:, None] ** 2)
    return np.exp(2j * np.pi * (along / period_m + curved + rng.random()))


def _draw_drift(rng: Generator, shape: tuple[int, int], nuisances: Nuisances) -> NDArray:
    """Complex gain over the scan [rows, columns]: smooth in time, row after row; its span is that of the nuisances.

    The shape is chosen: a line, and 1, 2 and 3 half waves of falling size.
    """
    time = np.arange(shape[0])[:, None] / shape[0] + np.arange(shape[1]) / (shape[0] * shape[1])
    gains = []
    for span in (nuisances.drift, np.radians(nuisances.drift_deg)):
        wander = rng.uniform(-1, 1) * time
        for waves in (1, 2, 3):
            wave = np.sin(np.pi * waves * time + 2 * np.pi * rng.random())
            wander = wander + rng.standard_normal() / (2 * waves) * wave
        gains.append(span * (wander - wander.mean()) / np.ptp(wander))
    return (1 + gains[0]) * np.exp(1j * gains[1])


def _clip(echoes: NDArray, direct: NDArray, share: float) -> tuple[NDArray, NDArray]:
    """Limit direct path plus echo, both [frequencies, rows, columns], to (1 - share) of the largest amplitude.

    Each frequency is a time of the chirp. What the limiter leaves is split again: the direct path has its mean gain.
    """
    received = direct + echoes
    amplitude = np.abs(received)
    limit = (1 - share) * amplitude.max()
    gain = np.minimum(1, limit / amplitude)
    new_direct = direct * gain.mean(axis=0)
    return received * gain - new_direct, new_direct


def pixel_centres(rig: Rig, pixels: int) -> tuple[NDArray, NDArray]:
    """Return coordinates of the picture's pixel centres in the rig frame, x and y [pixels], metres."""
    along = (np.arange(pixels) - (pixels - 1) / 2) * rig.step_m
    return rig.centre_m[0] + along, rig.centre_m[1] + along


def backproject(rig: Rig, rx: Antenna, data: NDArray, pixels: int, kaiser_beta: float = 0.0) -> NDArray:
    """Matched filter of complex64 `data` [..., frequencies, rows, columns] on the object plane, [..., pixels, pixels].

    I(v) = sum over offsets u and frequencies of w(u) data(u, f) exp(+jk (path(v - u) - direct)), over the sum of w.
    """
    window = np.outer(np.kaiser(rig.rows, kaiser_beta), np.kaiser(rig.columns, kaiser_beta)).astype(np.float32)
    shape = fast_length(rig.rows + pixels - 1), fast_length(rig.columns + pixels - 1)
    x_m, y_m = pixel_centres(rig, pixels)
    offsets_x, offsets_y = rig.offsets_m()
    # v - u at the lags of a circular convolution: 0 .. pixels - 1, then the negative ones.
    x = x_m[0] - offsets_x[0] + signed_lags(shape[1], pixels) * rig.step_m
    y = y_m[0] - offsets_y[0] + signed_lags(shape[0], pixels) * rig.step_m
    out = _measure_distance(rig.tx, x, y, rig.plane_m)
    back = _measure_distance(rx, x, y, rig.plane_m)
    excess_m = out + back - np.linalg.norm(rx.position - rig.tx.position)
    spectrum = np.zeros((*data.shape[:-3], *shape), np.complex64)
    for index, frequency_hz in enumerate(rig.frequencies_hz):
        kernel = turn_back(-excess_m, frequency_hz)
        spectrum += fft2(window * data[..., index, :, :], shape) * fft2(kernel)
    image = ifft2(spectrum)[..., :pixels, :pixels] / (window.sum() * len(rig.frequencies_hz))
    return image.astype(np.complex64)


def _measure_distance(antenna: Antenna, x: NDArray, y: NDArray, z: float) -> NDArray:
    """Return the distances [y, x] from an antenna to points of the plane z, metres."""
    ax, ay, az = antenna.position
    return np.sqrt((x[None, :] - ax) ** 2 + (y[:, None] - ay) ** 2 + (z - az) ** 2)
