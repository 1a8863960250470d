"""H / V of a point, which both receivers see under different angles.

It is compared with simulated echoes of spheres and cylinders by their exact series (the solution of Maxwell's equations
as a sum over modes), of which the estimator uses nothing.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.surfaces.test_point_errors import UNIT_GAINS

from polysight.data import find_packaged
from polysight.imaging.samples import reduction
from polysight.surfaces import Echoes, Optics, SeenEchoes, find_voltages, make_optics
from polysight.surfaces.gains import predict_voltages, reflect_points
from polysight.surfaces.measure import Shape
from polysight.surfaces.permittivity import add_common_errors, fit_permittivity
from polysight.surfaces.points import compute_tangents, find_normals, find_offset_that_sees, predict_echo
from polysight.surfaces.window import BoardFit, Samples, make_empty_echoes
from polysight_shared.config import load_instrument
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_worlds.media import METAL, Stack
from polysight_worlds.rig import Antenna, Boards, published_boards
from polysight_worlds.shape_echoes import record_shapes
from polysight_worlds.shape_scenes import scan_offsets
from polysight_worlds.shapes import Shape as WorldShape, cylinder, find_specular, sphere

RADIUS_M = 0.4

# The front of the ball is 0.5 m before the stage, in the middle between TX and the receivers.
CENTRE_M = (-0.01, 0.104, 0.5 + RADIUS_M)

# Positions of the stage
OFFSETS_M = np.array([[0.0, 0, 0], [0.1, 0.05, 0], [-0.1, 0.05, 0], [0.05, -0.1, 0]])


def see_exactly(solid: WorldShape, optics: Optics) -> tuple[SeenEchoes, Shape]:
    """Noiseless measurements of the specular points by both receivers, by the exact series at one frequency."""
    published = published_boards()
    boards = Boards(
        published.tx,
        (replace(published.h[0], position=optics.h.at_m),),
        (replace(published.v[0], position=optics.v.at_m),),
    )
    antennas = (optics.tx.at_m[:, None] + OFFSETS_M.T, optics.h.at_m[:, None] + OFFSETS_M.T)
    patch = solid.evaluate(*find_specular(solid, *antennas))
    points = patch.point.T
    normals = patch.normal.T
    # The curvature [2, 2] of the simulated shape is relative to its own two tangents; it is rotated to the tangents
    # that the estimator uses.
    shape_tangents = np.einsum("ijn,jcn->nci", patch.tangents(), np.array([patch.d_a, patch.d_b]))
    rotation = np.swapaxes(compute_tangents(normals), 1, 2) @ shape_tangents
    curvature = rotation @ np.moveaxis(patch.curvature(), -1, 0) @ np.swapaxes(rotation, 1, 2)
    # Cosine of the incidence angle
    _, cos = find_normals(points, OFFSETS_M, optics.tx.at_m, optics.h.at_m)
    # H sees the points from `OFFSETS_M`; V, which stands elsewhere, from other positions.
    seen_from = {
        "h": OFFSETS_M,
        "v": find_offset_that_sees(points, normals, OFFSETS_M, optics.tx.at_m, optics.v.at_m),
    }
    echoes: dict[str, Echoes] = {}
    frequency_hz = optics.wave_number * SPEED_OF_LIGHT_M_S / 2 / np.pi
    for channel, at_m in seen_from.items():
        receiver_m = optics.receiver(channel).at_m
        # The series needs stage offsets that lie in the plane z = 0.
        wave = record_shapes([solid], boards, np.array([frequency_hz]), at_m)[channel][0, 0]
        direct_m = np.linalg.norm(receiver_m - optics.tx.at_m)
        # The path, and its first and second derivatives over the stage's position.
        path, slope, bend = predict_echo(points, normals, curvature, at_m, optics.tx.at_m, receiver_m)
        echoes[channel] = replace(
            make_empty_echoes(),
            at_m=at_m,
            path_m=path,
            slope=slope,
            bend=bend,
            # Samples are conjugate to waves, and their phase is that of the path beyond the direct one.
            amplitude=wave.conj() * np.exp(-1j * optics.wave_number * direct_m),
            amplitude_std=np.zeros(len(path)),
            band_rise=np.zeros(len(path)),
        )
    return SeenEchoes(echoes["h"], echoes["v"], np.zeros(len(points), int)), Shape(points, normals, cos, curvature)


@pytest.mark.parametrize("medium", [2.8 - 0.1j, 8 - 1j], ids=["2.8", "8"])
def test_a_large_ball_gives_both_receivers_what_the_series_says(medium, optics):
    """H / V of a dielectric ball over that of a metal one, which is seen with the same antenna patterns.

    The ratio shows two effects. The incidence angle of V differs from that of H by about 0.1 degrees, which changes r_p
    by 1 % at a permittivity of 2.8; and the curvature of the wave turns r_p by 0.005 rad.
    """
    ratios = {}
    share_of_v = np.zeros(len(OFFSETS_M))
    for name, stack in (("metal", METAL), ("medium", Stack(below=medium))):
        measured, shape = see_exactly(sphere("ball", stack, CENTRE_M, RADIUS_M), optics)
        voltages = find_voltages(measured, optics, shape)
        eps = np.inf if stack.is_metal else medium
        expected = predict_voltages(voltages, reflect_points(eps, voltages, optics.wave_number))
        h, v = (voltages.voltage / expected).T
        ratios[name] = h / v
        # The last one, of the dielectric, remains.
        share_of_v = np.abs(expected[:, 1] / expected[:, 0])
    # V is small near Brewster's angle: its error counts relative to H. It is 0.0001 at most, far below both effects.
    error = ratios["medium"] / ratios["metal"] - 1
    assert np.abs(error * share_of_v).max() < 0.0004


def find_pattern(antenna: Antenna, points: np.ndarray, at_m: np.ndarray) -> np.ndarray:
    """Gain of a simulated antenna in the directions of points [n, 3], at stage offsets [n, 3]."""
    from_antenna = points - at_m - antenna.position
    return (from_antenna @ antenna.boresight / np.linalg.norm(from_antenna, axis=1)) ** antenna.exponent


@pytest.mark.parametrize("medium", [2.8 - 0.1j, 4.5 - 0.3j, 8 - 1j], ids=["2.8", "4.5", "8"])
@pytest.mark.parametrize("axis", [None, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)], ids=["sphere", "upright", "level"])
def test_the_error_of_the_model_is_what_the_series_shows(axis, medium, optics):
    """The model takes the curvature to the first order; the reported error is that of the orders that it neglects.

    The gains of the antennas are known here, so that there is no other error.
    """
    x, y, _ = CENTRE_M
    # Fronts are 0.5 m before the stage; radii of 100 and 150 mm.
    z = 0.5
    stack = Stack(below=medium)
    solid: WorldShape = sphere("solid", stack, (x, y, z + 0.1), radius_m=0.1)
    if axis is not None:
        solid = cylinder("solid", stack, (x, y, z + 0.15), radius_m=0.15, length_m=4.0, axis=axis)
    measured, shape = see_exactly(solid, optics)
    voltages = find_voltages(measured, optics, shape)
    published = published_boards()
    tx = published.tx
    rx_h = replace(published.h[0], position=optics.h.at_m)
    rx_v = replace(published.v[0], position=optics.v.at_m)
    at_v_m = find_offset_that_sees(shape.points, shape.normals, OFFSETS_M, tx.position, rx_v.position)
    gain_h = find_pattern(tx, shape.points, OFFSETS_M) * find_pattern(rx_h, shape.points, OFFSETS_M)
    gain_v = find_pattern(tx, shape.points, at_v_m) * find_pattern(rx_v, shape.points, at_v_m)
    without_patterns = voltages.voltage / np.stack([gain_h, gain_v], axis=1)
    # A noise far below the model's error
    voltages = replace(voltages, voltage=without_patterns, std=np.full(without_patterns.shape, 1e-4))
    fit = fit_permittivity(voltages, UNIT_GAINS, optics.wave_number)
    # Without disturbed scans the errors of places, axes and leakage are left out.
    errors = add_common_errors(fit, voltages, UNIT_GAINS, [], optics.wave_number)
    std = np.sqrt(np.trace(errors["model"]))
    # The reported error is at most two times too small, and about three times too large.
    assert 0.3 * std < abs(fit.eps - medium) < 2 * std


@pytest.mark.parametrize(("behind_m", "most_std"), [(0.0, 0.03), (0.18, 0.1)], ids=["same distance", "180 mm behind"])
def test_the_level_of_metal_is_known_as_well_as_both_its_directions_are(behind_m, most_std, gains, optics):
    """The level (gain of TX times that of the receiver) is learnt from a sphere at one distance.

    At that distance, each direction of arrival at the receiver occurs with one direction of departure from TX. 180 mm
    behind it, the same direction of arrival comes with a departure that differs by 15 degrees, which the sphere has not
    shown: the level is known less well. The stated errors are up to 0.026 at the same distance.
    """
    learnt = gains(optics)
    x, y, z = CENTRE_M
    measured, shape = see_exactly(sphere("ball", METAL, (x, y, z + behind_m), RADIUS_M), optics)
    voltages = find_voltages(measured, optics, shape)
    expected = predict_voltages(voltages, reflect_points(np.inf, voltages, optics.wave_number))
    true_level = np.log(np.abs(voltages.voltage[:, 0] / expected[:, 0]))
    error = true_level - learnt.level(voltages)
    std = learnt.estimate_level_std(voltages)
    # Two standard deviations, and 2 % for the noise that the reference leaves
    assert np.all(np.abs(error) < 2 * std + 0.02)
    assert np.all(std < most_std)


def test_echoes_have_their_phases_at_the_wave_number_of_the_rig():
    """The wave number is that of the middle of the linear part of the sweep, as in the optics.

    That of the whole sweep is 12 / m larger. As paths of H and V differ by 0.7 mm, H / V would be wrong by
    12 / m * 0.7 mm = 0.009 rad.
    """
    rig = load_instrument(find_packaged(Path("instrument.toml")))
    optics = make_optics(rig)
    # Paths of 0.1 to 0.6 m beyond the direct one
    reduced = reduction(rig.chirp, (0.1, 0.6))
    offsets = scan_offsets(21, 21)
    cube = np.zeros((1, reduced.frequencies_hz.size, 21, 21), np.complex64)
    board = Samples(
        cube=cube,
        valid=np.ones((21, 21), bool),
        offsets_m=offsets,
        frequencies_hz=reduced.frequencies_hz,
        tx_m=optics.tx.at_m,
        rx_m=optics.h.at_m[None],
        model=reduced.model,
    )
    assert BoardFit(board).middle == pytest.approx(optics.wave_number)
