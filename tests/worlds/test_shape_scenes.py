"""Drawn scenes of shapes and the disturbances of their scans."""

import numpy as np
import pytest
from scipy.stats import kstest

import polysight_worlds as worlds
from polysight_worlds.shape_scenes import disturb_boards
from polysight_worlds.shapes import find_specular

ALL_RX = worlds.published_boards()
# One RX of each board
BOARDS = worlds.Boards(ALL_RX.tx, ALL_RX.h[:1], ALL_RX.v[:1])
OFFSETS_M = worlds.scan_offsets(every=50)
FREQUENCIES_HZ = np.linspace(76.3e9, 79.7e9, 3)


def scan_reference(nuisances: worlds.ShapeNuisances, number: int = 0) -> dict[str, np.ndarray]:
    """Samples of each board of the reference sphere; the scan's `number` decides which noise it has."""
    return worlds.scan_shapes(
        [worlds.reference_sphere()], OFFSETS_M, nuisances, boards=BOARDS, frequencies_hz=FREQUENCIES_HZ, number=number
    )


@pytest.mark.parametrize("kind", worlds.KINDS)
def test_a_drawn_object_has_an_echo_and_its_true_surface_is_where_the_rays_are_reflected(kind):
    scene = worlds.draw_shapes(5, kind, with_table=True)
    samples = worlds.scan_shapes(scene.shapes, OFFSETS_M, boards=BOARDS, frequencies_hz=FREQUENCIES_HZ)
    brightest = np.abs(samples["h"]).max()
    # A flat mirror has 1 / L = 0.6, over a path L of 1.7 m. A curved dielectric has more than a thousandth of that, and
    # a concave mirror, which focuses, not four times as much.
    assert 6e-4 < brightest < 2

    # The ray of the stage at its middle position, where the antennas stand at their places in the rig file.
    shape = scene.shapes[0]
    tx_m = BOARDS.tx.position[:, None]
    rx_m = BOARDS.h[0].position[:, None]
    patch = shape.evaluate(*find_specular(shape, tx_m, rx_m))
    # A bottle has three pieces: the ray of the first may meet it beyond its edge, where the surface is another piece's.
    if kind != "bottle":
        distances, normals = scene.nearest_surface(patch.point.T)
        assert distances == pytest.approx(0, abs=1e-8)
        assert pytest.approx(patch.normal, abs=1e-6) == normals.T

    # The ranges that the description of `draw_shapes` promises.
    assert scene.permittivity is not None
    assert 2 <= scene.permittivity.real <= 9
    assert -1 <= scene.permittivity.imag <= 0


def test_a_seed_gives_one_scene():
    assert repr(worlds.draw_shapes(8)) == repr(worlds.draw_shapes(8))


def test_all_objects_are_metal_where_the_share_of_metal_is_one():
    # The permittivity of a metal object is None.
    for seed in range(3):
        assert worlds.draw_shapes(seed, metal_share=1.0, kind="sphere").permittivity is None


@pytest.mark.parametrize(
    "change",
    [{"misplaced_mm": 1.0}, {"axes_deg": 2.0}, {"leakage": 0.05}, {"gain_db": 1.0}],
    ids=lambda change: next(iter(change)),
)
def test_each_disturbance_changes_the_samples_and_repeats(change):
    undisturbed = scan_reference(worlds.ShapeNuisances(noise=0))
    nuisances = worlds.ShapeNuisances(noise=0, seed=3, **change)
    disturbed = scan_reference(nuisances)
    relative_changes = []
    for channel, samples in undisturbed.items():
        change_of_samples = np.abs(disturbed[channel] - samples).max()
        relative_changes.append(change_of_samples / np.abs(samples).max())
    # A sample whose phase is reversed changes by 2, and with a gain of 1 dB more by 2.1: no change is larger. The
    # changes here are 0.06, by the leakage of 0.05, to 1.9.
    assert 0.01 < max(relative_changes) < 2.5
    second_scan = scan_reference(nuisances)
    assert all(np.array_equal(disturbed[channel], second_scan[channel]) for channel in undisturbed)


def test_the_back_of_a_body_is_not_a_surface_that_is_seen():
    """A table may touch the back of a body: its pixels must not count as pixels of the body's surface.

    The antennas see the front only, so that a point at the back is farther than a radius from the nearest surface.
    """
    scene = worlds.draw_shapes(5, "barrel")
    middle_m = np.array(scene.shapes[0].place_m)
    towards_antennas = -scene.shapes[0].axes[:, 2]
    radius_m = scene.radius_m
    front_m = middle_m + radius_m * towards_antennas
    back_m = middle_m - radius_m * towards_antennas
    (front_distance_m, back_distance_m), normals = scene.nearest_surface(np.stack([front_m, back_m]))
    assert abs(front_distance_m) < 1e-6
    # The normal at the front is the direction to the antennas.
    assert normals[0] @ towards_antennas > 0.99
    assert abs(back_distance_m) > radius_m


@pytest.mark.parametrize(
    ("change", "std"),
    [
        # The rms of a displacement is given, which has three components.
        ({"misplaced_mm": 1.0}, 1e-3 / np.sqrt(3)),
        ({"axes_deg": 2.0}, np.radians(2.0)),
        # That of a complex number, which has two parts.
        ({"leakage": 0.05}, 0.05 / np.sqrt(2)),
    ],
    ids=["places", "axes", "leakage"],
)
def test_disturbances_are_normally_distributed_with_the_size_given(change, std):
    # The covariances that estimates state are tested with these disturbances. If all draws had the same magnitude,
    # every draw would lie inside the stated region, and a wrong covariance would not be noticed.
    deviations = []
    # With 800 deviations or more, the comparison below notices a size that is wrong by some 30 per cent.
    for seed in range(400):
        true_boards = disturb_boards(BOARDS, worlds.ShapeNuisances(seed=seed, **change))
        for antenna, true_antenna in ((BOARDS.h[0], true_boards.h[0]), (BOARDS.v[0], true_boards.v[0])):
            # The component of the true polarisation across the nominal one: the sine of a turn, or the leakage.
            cross_axis = np.cross(antenna.boresight, antenna.polarisation)
            across = complex(cross_axis @ true_antenna.polarisation)
            if "misplaced_mm" in change:
                deviations.extend(true_antenna.position - antenna.position)
            elif "axes_deg" in change:
                deviations.append(np.arcsin(across.real))
            else:
                deviations.extend([across.real, across.imag])
    # One true distribution in a thousand would fail; these seeds do not (the least of three p-values is 0.13).
    assert kstest(np.array(deviations) / std, "norm").pvalue > 1e-3


def test_noise_differs_between_scans_of_one_rig():
    without_noise = scan_reference(worlds.ShapeNuisances(noise=0))["h"]
    first_noise = scan_reference(worlds.ShapeNuisances(noise=1), number=0)["h"] - without_noise
    second_noise = scan_reference(worlds.ShapeNuisances(noise=1), number=1)["h"] - without_noise
    # The deviation of so few samples (3 frequencies at 28 positions) varies by some 8 per cent; these differ by 10.
    assert np.std(first_noise) == pytest.approx(np.std(second_noise), rel=0.3)
    assert not np.allclose(first_noise, second_noise)
