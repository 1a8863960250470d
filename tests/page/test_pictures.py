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

NY = 8
NX = 11


def decode_pixels(png: bytes) -> np.ndarray:
    return imread(io.BytesIO(png), format="png")


@pytest.fixture
def images() -> Images:
    h = np.full((NY, NX), 0.01, np.complex64)
    # Smallest y, largest x
    h[0, -1] = 1.0
    axes = (np.arange(NX, dtype=float), np.arange(NY, dtype=float))
    return Images(h, h.copy(), *axes, np.ones((NY, NX), bool))


def test_smallest_y_is_at_the_bottom(images):
    picture = decode_pixels(draw(images)["h_amplitude"].png)
    assert picture.shape == (NY, NX, 4)
    brightness = picture[..., :3].sum(axis=-1)
    assert np.unravel_index(brightness.argmax(), brightness.shape) == (NY - 1, NX - 1)


def test_what_no_row_has_lit_is_transparent(images):
    is_lit = np.ones((NY, NX), bool)
    is_lit[:3] = False
    for picture in draw(replace(images, valid=is_lit)).values():
        assert (decode_pixels(picture.png)[-3:, :, 3] == 0).all()
    assert (decode_pixels(draw(replace(images, valid=is_lit))["h_amplitude"].png)[:-3, :, 3] == 1).all()


def test_nothing_lit_is_drawn_all_the_same(images):
    nothing_lit = replace(images, valid=np.zeros((NY, NX), bool))
    assert all((decode_pixels(p.png)[..., 3] == 0).all() for p in draw(nothing_lit).values())


def test_phase_is_cyclic_and_comes_round(images):
    angles = np.linspace(-np.pi, np.pi, NX, dtype=np.float32)
    rotated = np.tile(np.exp(1j * angles).astype(np.complex64), (NY, 1))
    row = decode_pixels(draw(replace(images, h=rotated))["h_phase"].png)[0, :, :3]
    assert np.abs(row[0] - row[-1]).max() < 0.02
    assert np.abs(row[0] - row[NX // 2]).max() > 0.3
    ends = decode_pixels(colour_bar(PHASE_COLOURS))[0]
    assert np.abs(ends[0] - ends[-1]).max() < 0.02


@pytest.mark.parametrize("picture", ["h_phase", "p_phase"])
@pytest.mark.parametrize(
    ("level_db", "opacity"), [(-30, 0.0), (-26, 0.0), (-24, 0.25), (-22, 0.5), (-18, 1.0), (-9, 1.0)]
)
def test_phases_fade_with_the_level_below_the_brightest_pixels(images, picture, level_db, opacity):
    h = np.ones((NY, NX), np.complex64)
    # The picture's first row
    h[-1, 3] = 10 ** (level_db / 20)
    drawn = decode_pixels(draw(replace(images, h=h, v=np.ones_like(h)))[picture].png)
    assert drawn[0, 3, 3] == pytest.approx(opacity, abs=0.01)
    assert (np.delete(drawn[..., 3].ravel(), 3) == 1).all()


def test_phase_of_p_is_the_difference(images):
    h = images.h * np.exp(1j).astype(np.complex64)
    v = images.v * np.exp(0.25j).astype(np.complex64)
    p = draw(replace(images, h=h, v=v))["p_phase"].png
    same = draw(replace(images, h=images.h * np.exp(0.75j).astype(np.complex64)))["p_phase"].png
    assert np.allclose(decode_pixels(p), decode_pixels(same), atol=0.01)


@pytest.mark.parametrize("path_m", [0.3, 0.45, 0.8])
def test_an_echo_stands_at_its_path_in_the_range_profile(path_m):
    chirp = load_published_rig().chirp
    sweep_hz = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)
    echo = 1 + 0.3 * np.exp(2j * np.pi * sweep_hz * path_m / SPEED_OF_LIGHT_M_S)
    samples = np.tile(echo.astype(np.complex64), (4, 5, 1))
    zeros = np.zeros(5)
    row = SyncedRow(
        samples=samples,
        sweep_hz=sweep_hz,
        valid=np.ones(5, bool),
        chirps=np.ones(5, int),
        direct_hz=zeros,
        direct_amplitude=zeros,
    )
    distances_m = np.linspace(-0.2, 1.0, 601)
    level = compute_range_profile_db(row, chirp, distances_m)
    assert abs(distances_m[level.argmax()]) < 0.01
    assert level.max() == pytest.approx(0.0, abs=0.05)
    level_without_direct_path = np.where(np.abs(distances_m) < 0.2, -200.0, level)
    assert distances_m[level_without_direct_path.argmax()] == pytest.approx(path_m, abs=0.01)
    assert level_without_direct_path.max() == pytest.approx(20 * np.log10(0.3), abs=0.5)
    without_positions = replace(row, valid=np.zeros(5, bool))
    assert np.ptp(compute_range_profile_db(without_positions, chirp, distances_m)) == 0
