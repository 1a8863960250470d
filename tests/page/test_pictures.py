"""Pictures and range profiles agree with the data."""

import io
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from tests.support.rigs import load_published_rig

from polysight.catalogue import PHASE_COLOURS, colour_bar, draw
from polysight.imaging import Images
from polysight.page.watch import compute_range_profile_db
from polysight.sync import SyncedRow
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Pixels of the images, different in both directions
NY = 8
NX = 11


def decode_pixels(png: bytes) -> np.ndarray:
    """Pixels of a picture, float [row from the top, column, red green blue opacity], 0 to 1."""
    return imread(io.BytesIO(png), format="png")


@pytest.fixture
def images() -> Images:
    """Images of amplitude 0.01 (-40 dB) with one bright pixel, at the smallest y and the largest x."""
    h = np.full((NY, NX), 0.01, np.complex64)
    h[0, -1] = 1.0
    return Images(
        h=h,
        v=h.copy(),
        x_m=np.arange(NX).astype(np.float64),
        y_m=np.arange(NY).astype(np.float64),
        valid=np.ones((NY, NX), bool),
    )


def test_smallest_y_is_at_the_bottom(images):
    picture = decode_pixels(draw(images)["h_amplitude"].png)
    assert picture.shape == (NY, NX, 4)
    brightness = picture[..., :3].sum(axis=-1)
    brightest_pixel = np.unravel_index(brightness.argmax(), brightness.shape)
    assert brightest_pixel == (NY - 1, NX - 1)


def test_invalid_pixels_are_transparent(images):
    """A pixel is valid once a scanned row has illuminated it."""
    valid = np.ones((NY, NX), bool)
    # The smallest y is the first row of an image and the last row of its picture.
    invalid_rows = 3
    valid[:invalid_rows] = False
    pictures = draw(replace(images, valid=valid))
    for picture in pictures.values():
        opacity = decode_pixels(picture.png)[..., 3]
        assert (opacity[-invalid_rows:] == 0).all()
    opacity_of_amplitude = decode_pixels(pictures["h_amplitude"].png)[..., 3]
    assert (opacity_of_amplitude[:-invalid_rows] == 1).all()


def test_pictures_without_a_valid_pixel_are_transparent(images):
    without_valid_pixels = replace(images, valid=np.zeros((NY, NX), bool))
    for picture in draw(without_valid_pixels).values():
        opacity = decode_pixels(picture.png)[..., 3]
        assert (opacity == 0).all()


def test_the_colours_of_phases_meet_at_180_degrees(images):
    """-180 and +180 degrees have the same colour, which differs from that of 0."""
    angles = np.linspace(-np.pi, np.pi, NX, dtype=np.float32)
    rotated = np.tile(np.exp(1j * angles).astype(np.complex64), (NY, 1))
    colours = decode_pixels(draw(replace(images, h=rotated))["h_phase"].png)[0, :, :3]
    # Colours have 8 bits: equal ones may differ by one step, 1 / 255. The colour of 0 differs by 0.77 (measured).
    assert np.abs(colours[0] - colours[-1]).max() < 0.02
    assert np.abs(colours[0] - colours[NX // 2]).max() > 0.3
    bar = decode_pixels(colour_bar(PHASE_COLOURS))[0]
    assert np.abs(bar[0] - bar[-1]).max() < 0.02


@pytest.mark.parametrize("picture", ["h_phase", "p_phase"])
@pytest.mark.parametrize(
    ("level_db", "opacity"), [(-30, 0.0), (-26, 0.0), (-24, 0.25), (-22, 0.5), (-18, 1.0), (-9, 1.0)]
)
def test_phases_fade_with_the_level_below_the_brightest_pixels(images, picture, level_db, opacity):
    """Opacity falls from 1 at -18 dB to 0 at -26 dB, in proportion to the decibels."""
    h = np.ones((NY, NX), np.complex64)
    # One pixel is dim. The largest y is the first row of a picture.
    column = 3
    h[-1, column] = 10 ** (level_db / 20)
    pixels = decode_pixels(draw(replace(images, h=h, v=np.ones_like(h)))[picture].png)
    opacities = pixels[..., 3]
    # 0.01: opacities have 8 bits.
    assert opacities[0, column] == pytest.approx(opacity, abs=0.01)
    other_opacities = np.delete(opacities.ravel(), column)
    assert (other_opacities == 1).all()


def test_the_picture_p_phase_shows_the_phase_of_h_minus_that_of_v(images):
    """Phases of 1 rad in H and 0.25 rad in V give the same picture as 0.75 rad in H and 0 in V."""
    h = images.h * np.exp(1j).astype(np.complex64)
    v = images.v * np.exp(0.25j).astype(np.complex64)
    picture_of_both = draw(replace(images, h=h, v=v))["p_phase"].png
    h_alone = images.h * np.exp(0.75j).astype(np.complex64)
    picture_of_h_alone = draw(replace(images, h=h_alone))["p_phase"].png
    # Colours have 8 bits: they may differ by two steps of 1 / 255.
    assert np.allclose(decode_pixels(picture_of_both), decode_pixels(picture_of_h_alone), atol=0.01)


CHIRP = load_published_rig().chirp
# Amplitudes relative to the direct path's, which is 1.
ECHO_AMPLITUDE = 0.3
# Places of the range profiles, in steps of 2 mm.
DISTANCES_M = np.linspace(-0.2, 1.0, 601)


def make_row(path_m: float) -> SyncedRow:
    """A row with the direct path, and an echo whose path is longer by `path_m`."""
    receivers = 4
    positions = 5
    sweep_hz = CHIRP.first_sample_hz + CHIRP.hz_per_sample * np.arange(CHIRP.samples)
    direct_and_echo = 1 + ECHO_AMPLITUDE * np.exp(2j * np.pi * sweep_hz * path_m / SPEED_OF_LIGHT_M_S)
    zeros = np.zeros(positions)
    return SyncedRow(
        samples=np.tile(direct_and_echo.astype(np.complex64), (receivers, positions, 1)),
        sweep_hz=sweep_hz.astype(np.float64),
        valid=np.ones(positions, bool),
        chirps=np.ones(positions, int),
        direct_hz=zeros,
        direct_amplitude=zeros,
    )


@pytest.mark.parametrize("path_m", [0.3, 0.45, 0.8])
def test_a_range_profile_has_the_direct_path_at_0_and_an_echo_at_its_longer_path(path_m):
    level_db = compute_range_profile_db(make_row(path_m), CHIRP, DISTANCES_M)
    # A peak may be 1 cm, five steps, away from its path.
    tolerance_m = 0.01
    assert abs(DISTANCES_M[level_db.argmax()]) < tolerance_m
    assert level_db.max() == pytest.approx(0.0, abs=0.05)
    # Without the direct path the echo is the highest peak.
    no_signal_db = -200.0
    level_of_echo_db = np.where(np.abs(DISTANCES_M) < 0.2, no_signal_db, level_db)
    assert DISTANCES_M[level_of_echo_db.argmax()] == pytest.approx(path_m, abs=tolerance_m)
    # Side lobes of the direct path change the level by 0.2 dB (measured).
    assert level_of_echo_db.max() == pytest.approx(20 * np.log10(ECHO_AMPLITUDE), abs=0.5)


def test_the_range_profile_of_a_row_without_valid_positions_is_constant():
    row = make_row(path_m=0.3)
    without_positions = replace(row, valid=np.zeros_like(row.valid))
    level_db = compute_range_profile_db(without_positions, CHIRP, DISTANCES_M)
    assert np.unique(level_db).size == 1
