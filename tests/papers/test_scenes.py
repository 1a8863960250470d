"""Scenes, rig files and estimators of the figures of the POLySIGHT paper that are made from simulated scans."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure
from tests.support.paths import RIG_FILE
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.polarimetry import specular_incidence_rad
from polysight_papers.sensys2026 import images, run as catalogue
from polysight_papers.sensys2026.images import FIG13_DISTANCE_MM, front_on, plate, simulate_scan
from polysight_papers.sensys2026.item import Run, table2
from polysight_papers.sensys2026.permittivities import APART_MM, REACH_MM, places
from polysight_papers.sensys2026.synchronisation import _draw_skirts, tones
from polysight_shared.config import load_instrument
from polysight_shared.errors import ErrorCode


@pytest.mark.parametrize("seed", range(20))
def test_random_places_never_overlap_and_stay_on_the_plane(seed):
    box_places = places(seed)
    for i, (x_mm, y_mm) in enumerate(box_places):
        assert abs(x_mm) <= REACH_MM
        assert abs(y_mm) <= REACH_MM
        # Two boxes of one size do not overlap if they are far enough apart in x or in y.
        for other_x_mm, other_y_mm in box_places[:i]:
            assert max(abs(x_mm - other_x_mm), abs(y_mm - other_y_mm)) >= APART_MM


def test_a_rig_with_its_boards_side_by_side_sees_the_plane_from_the_front(tmp_path):
    published = load_published_rig()
    side_by_side = load_instrument(front_on(RIG_FILE, tmp_path))
    # The paper rounds 54.95 degrees.
    assert np.degrees(specular_incidence_rad(published)) == pytest.approx(55, abs=0.2)
    # Boards have a size, so that it is not 0 but 1.4 degrees (measured).
    assert np.degrees(specular_incidence_rad(side_by_side)) < 2
    assert side_by_side.chirp == published.chirp


def test_the_plane_of_fig13_is_seen_under_50_degrees():
    rig = load_published_rig()
    geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=FIG13_DISTANCE_MM)
    rig_of_fig13 = msgspec.structs.replace(rig, geometry=geometry)
    # A distance of 598 mm gives 49.8 degrees.
    assert np.degrees(specular_incidence_rad(rig_of_fig13)) == pytest.approx(50, abs=0.4)


@pytest.mark.parametrize("if_hz", [210e3, 870e3, 1.81e6])
def test_a_tone_s_frequency_and_amplitude_are_found(if_hz):
    """The amplitude is that of all four receive antennas together: the root of the sum of squares."""
    chirp = load_published_rig().chirp
    time_s = np.arange(chirp.samples) / chirp.sample_rate_hz
    gains = np.array([1.0, 1j, -0.5, 0.25])[:, None, None]
    samples = gains * 40 * np.exp(2j * np.pi * if_hz * time_s)
    frequency, amplitude = tones(samples.astype(np.complex64), chirp)
    # The largest error is 237 Hz (measured), a thirtieth of a bin of the Fourier transform (2.15 MHz / 256).
    assert frequency[0] == pytest.approx(if_hz, abs=300)
    assert amplitude[0] == pytest.approx(40 * np.sqrt((np.abs(gains) ** 2).sum()), rel=2e-3)


def test_a_simulated_scan_is_made_and_removed():
    grid = {"columns": 3, "rows": 1, "step_x_mm": 10.0, "step_y_mm": 6.0}
    with simulate_scan("small", [plate("copper", None, 0, 0)], RIG_FILE, seed=1, grid=grid) as (source, truth):
        assert source.simulated
        assert [p.metal for p in truth] == [True]
        folder = source.path
        assert folder.exists()
    assert not folder.exists()


def test_a_scene_that_cannot_be_simulated_is_named():
    with (
        expect_refusal(ErrorCode.VALUE_INVALID, "broken"),
        simulate_scan("broken", [plate("x", 0.5 + 0j, 0, 0)], RIG_FILE, seed=1),
    ):
        pass


def test_the_corners_of_the_high_pass_filter_are_found_from_the_sweep_of_figure_9():
    item = catalogue.MAKERS["fig9"](Run(config=RIG_FILE))
    # The response differs by 0.13 dB, but the corners by up to 14 % (measured): a lower first corner and a higher
    # second one give nearly the same response.
    assert item.data["largest_difference_db"] < 0.2
    assert item.data["fitted_corners_hz"] == pytest.approx(item.data["programmed_corners_hz"], rel=0.15)


def test_every_item_of_the_paper_is_made():
    assert set(catalogue.MAKERS) == set(catalogue.TITLES)


def test_plates_of_a_scan_have_the_permittivities_of_their_rows_of_table_2(monkeypatch):
    simulated = []

    def note_plates(_, plates, *__, **___):
        simulated.append(plates)
        # The test needs the scene alone. The error ends `view_scan` before anything is simulated.
        raise InterruptedError

    monkeypatch.setattr(images, "simulate_scan", note_plates)
    rows = (2, 9, 30)
    with pytest.raises(InterruptedError):
        images.view_scan("rows", rows, Run())
    copper, *plates = simulated[0]
    assert copper["metal"]
    for row, scene_plate in zip(rows, plates, strict=True):
        published = table2()[row - 1]
        real, loss = scene_plate["permittivity"]
        assert scene_plate["name"] == published.name
        assert complex(real, -loss) == published.permittivity


def test_names_of_plates_are_drawn_at_their_centres_without_the_words_in_brackets():
    boxes_mm = [(-60.0, -50.0, -20.0, -10.0), (10.0, 30.0, 40.0, 80.0)]
    plates = [SimpleNamespace(name="glass (float)", box_mm=box) for box in boxes_mm]
    axes = Figure().add_subplot()
    images._label_plates(axes, SimpleNamespace(plates=plates, extent_mm=(-150, 150, -150, 150)))
    assert [t.get_position() for t in axes.texts] == [(-40, -30), (25, 55)]
    assert {t.get_text() for t in axes.texts} == {"glass"}


def test_the_smear_around_a_tone_rises_with_the_power_of_its_noise():
    chirp = load_published_rig().chirp
    # Complex noise of one receive antenna and 20 chirps, and a tone at a fifth of the sample rate.
    real_and_imaginary = np.random.default_rng(1).standard_normal((1, 20, chirp.samples, 2))
    noise = real_and_imaginary @ [1, 1j]
    tone = np.exp(2j * np.pi * 0.2 * np.arange(chirp.samples))
    axes = Figure().add_subplot()
    quiet_db = _draw_skirts(axes, (tone + 0.01 * noise).astype(np.complex64), chirp)
    loud_db = _draw_skirts(axes, (tone + 0.1 * noise).astype(np.complex64), chirp)
    # Mean level relative to the tone, of whole chirps and of their linear part.
    for part, level_db in quiet_db.items():
        # -57 dB at most (measured).
        assert level_db < -30
        # Ten times the amplitude is 20 dB more.
        assert loud_db[part] - level_db == pytest.approx(20, abs=1)
