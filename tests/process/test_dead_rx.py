"""An RX without a signal is left out of synchronisation and images.

The verdict reports that RX and gives no other reason, and the permittivities are still right.
"""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from benchmarks.coverage import Cubes
from tests.support.mangled_scans import PLATES, ROWS, SCENE, Mangle, Mangled, ProcessMangled, compute_distances
from tests.support.pipelines import make_pipeline
from tests.support.rigs import load_published_rig

from polysight.imaging import Images
from polysight.jobs.process import LiveProcessing
from polysight.process import Findings
from polysight.settings import Settings
from polysight.store import CubeRow, RowData, ScanFolder
from polysight.store.source import split_pieces
from polysight.sync import RowSynchroniser
from polysight_simulators.scene import decode_scene

# Squared distance of a true permittivity from its estimate that is three standard deviations
THREE_STDS_SQUARED = 3.0**2
# More rows than the scan has
ALL_ROWS = range(1000)


def draw_noise(row: int, words: np.ndarray, rms: float) -> np.ndarray:
    """Return noise for one RX in the form of `words` [..., rx]: complex for a cube, otherwise ADC units."""
    rng = np.random.default_rng(row)
    if np.iscomplexobj(words):
        return rms * (rng.standard_normal(words.shape[:-1]) + 1j * rng.standard_normal(words.shape[:-1]))
    return np.rint(rng.normal(0, rms, words.shape[:-1])).astype(np.int16)


def kill(
    board: str,
    *rx: int,
    rms: float = 6.0,
    rows: range = ALL_ROWS,
    value: int | None = None,
    positions: slice = slice(None),
) -> Mangle:
    """Give RX, counted from 1, of a board noise or a constant `value` instead of their signal in some rows.

    `positions` are those of the row that are changed.
    """

    def mangle(name: str, row: int, words: np.ndarray) -> None:
        if name != board or row not in rows:
            return
        changed_words = words[_select_chirps(positions, words)]
        for k in rx:
            if value is None:
                changed_words[..., k - 1] = draw_noise(100 * row + k, changed_words, rms)
            else:
                changed_words[..., k - 1] = value

    return mangle


def _select_chirps(positions: slice, words: np.ndarray) -> slice:
    """Return the chirps of some positions; a row of a cube has one for each."""
    chirps = len(words) // SCENE["grid"]["columns"]
    start = None if positions.start is None else positions.start * chirps
    stop = None if positions.stop is None else positions.stop * chirps
    return slice(start, stop)


@pytest.fixture
def source(six_plates: ScanFolder) -> ScanFolder:
    return six_plates


@pytest.fixture
def process(process_six_plates: ProcessMangled) -> ProcessMangled:
    return process_six_plates


def form_images(source: ScanFolder, mangle: Mangle) -> Images:
    return make_pipeline(Mangled(source, mangle)).form_images()  # type: ignore[arg-type]


def list_reasons_about_rx(findings: Findings) -> list[str]:
    return [r.what for r in findings.verdict.reasons if "RX" in r.what]


def list_other_reasons(findings: Findings) -> set[str]:
    """Return all reasons except those about an RX, without the digits in them."""
    return {"".join(c for c in r.what if not c.isdigit()) for r in findings.verdict.reasons if "RX" not in r.what}


@pytest.mark.parametrize(("board", "rx"), [("RV", 3), ("RH", 1)])
def test_noise_instead_of_an_rx_is_reported_and_changes_nothing_else(source, process, board, rx):
    _, healthy_images, healthy = process()
    pipeline, images, findings = process(kill(board, rx))
    assert findings.verdict.level == "care"
    (reason,) = list_reasons_about_rx(findings)
    assert f"RX{rx} of {board}" in reason
    assert list_other_reasons(findings) <= list_other_reasons(healthy)
    assert len(compute_distances(source, findings)) == len(PLATES)
    assert max(compute_distances(source, findings)) < THREE_STDS_SQUARED
    assert pipeline.quality.result().boards[board].dead_rx == {rx: list(range(ROWS))}
    # The images are nearly those of all RX: three of four RX have a correlation of 0.9998 or more with them.
    in_both_images = images.valid & healthy_images.valid
    for image, healthy_image in ((images.h, healthy_images.h), (images.v, healthy_images.v)):
        pixels = image[in_both_images]
        healthy_pixels = healthy_image[in_both_images]
        correlation = abs(np.vdot(pixels, healthy_pixels)) / np.linalg.norm(pixels) / np.linalg.norm(healthy_pixels)
        assert correlation > 0.995


@pytest.fixture(scope="module")
def images_without_rx2(six_plates: ScanFolder) -> Images:
    """Images of the scan in which RX2 of RV gave noise of 6 units only."""
    return form_images(six_plates, kill("RV", 2))


@pytest.mark.parametrize("dead_signal", [{"rms": 60.0}, {"value": 0}, {"value": 1000}, {"value": 32767}], ids=str)
def test_the_images_do_not_depend_on_what_a_dead_rx_sends(source, images_without_rx2, dead_signal):
    images = form_images(source, kill("RV", 2, **dead_signal))
    tolerance = 1e-6 * np.abs(images_without_rx2.v).max()
    np.testing.assert_allclose(images.v, images_without_rx2.v, atol=tolerance)
    np.testing.assert_array_equal(images.h, images_without_rx2.h)


def test_the_images_are_those_of_a_rig_without_the_rx(source):
    """RX3 of both boards is dead. The other rig has three RX, and its recorded words are those of these three."""

    class WithThreeRx(Mangled):
        def __init__(self) -> None:
            super().__init__(source, lambda *_: None)
            rig = source.instrument
            rx_mm = tuple(place_mm for k, place_mm in enumerate(rig.antennas.rx_mm) if k != 2)
            self.instrument = msgspec.structs.replace(rig, antennas=msgspec.structs.replace(rig.antennas, rx_mm=rx_mm))

        def read_row(self, board: str, row: int) -> RowData | CubeRow:
            recorded = source.read_row(board, row)
            words = recorded.payload.view(np.int16).reshape(-1, 4)
            words_without_rx3 = np.ascontiguousarray(np.delete(words, 2, axis=1))
            return replace(recorded, pieces=split_pieces(words_without_rx3.reshape(-1).view(np.uint8)))

    def kill_rx3(name: str, row: int, words: np.ndarray) -> None:
        """Kill RX3 of any board."""
        kill(name, 3)(name, row, words)

    images_of_three_rx = make_pipeline(WithThreeRx()).form_images()  # type: ignore[arg-type]
    images = form_images(source, kill_rx3)
    for image, image_without_rx in ((images.h, images_of_three_rx.h), (images.v, images_of_three_rx.v)):
        np.testing.assert_allclose(image, image_without_rx, atol=2e-5 * np.abs(image_without_rx).max())


@pytest.mark.parametrize("rows", [range(16, ROWS), range(16, 17)])
def test_an_rx_that_dies_within_the_scan_is_left_out(source, process, rows):
    pipeline, _, findings = process(kill("RV", 4, rows=rows))
    (reason,) = list_reasons_about_rx(findings)
    assert "RX4 of RV" in reason
    assert "first in row 16" in reason
    assert pipeline.quality.result().boards["RV"].dead_rx == {4: list(rows)}
    assert list_other_reasons(findings) <= list_other_reasons(process()[2])
    assert max(compute_distances(source, findings)) < THREE_STDS_SQUARED


@pytest.mark.parametrize("positions", [slice(38, None), slice(21, 27), slice(0, 5), slice(24, None)], ids=str)
@pytest.mark.parametrize("dead_signal", [{"rms": 6.0}, {"value": 0}], ids=str)
def test_an_rx_without_a_signal_in_a_few_positions_of_a_row_is_dead_in_the_row(source, positions, dead_signal):
    mangled = Mangled(source, kill("RV", 2, rows=range(20, 21), positions=positions, **dead_signal))
    synchroniser = RowSynchroniser(mangled, source.instrument, {})  # type: ignore[arg-type]
    assert synchroniser.synchronise("RV", mangled.read_row("RV", 20))[0].dead_rx == [2]
    assert synchroniser.synchronise("RV", mangled.read_row("RV", 19))[0].dead_rx == []


def test_an_rx_that_is_10_db_weaker_is_not_dead(process):
    def weaken(name: str, _: int, words: np.ndarray) -> None:
        if name == "RV":
            words[..., 1] = np.rint(words[..., 1] * 10 ** (-10 / 20))

    pipeline, _, findings = process(weaken)
    assert list_reasons_about_rx(findings) == []
    assert pipeline.quality.result().boards["RV"].dead_rx == {}


def test_with_two_dead_rx_of_a_board_the_permittivities_are_still_right(source, process):
    _, _, findings = process(kill("RH", 2, 3))
    assert len(list_reasons_about_rx(findings)) == 1
    assert list_other_reasons(findings) <= list_other_reasons(process()[2])
    assert max(compute_distances(source, findings)) < THREE_STDS_SQUARED


def test_a_board_without_any_rx_is_refused(process):
    _, _, findings = process(kill("RV", 1, 2, 3, 4))
    assert findings.verdict.level == "none"
    assert any("RV: the direct path is missing" in r.what for r in findings.verdict.reasons)
    assert list_reasons_about_rx(findings) == []


def test_a_dead_rx_is_reported_to_the_operator_with_the_first_row(source, monkeypatch, caplog):
    monkeypatch.setattr(ScanFolder, "load", lambda _: Mangled(source, kill("RV", 3)))
    processing = LiveProcessing(source.path, Settings())
    for row in range(3):
        processing.add_row(row)
    (message,) = [r.getMessage() for r in caplog.records if "RX" in r.getMessage()]
    assert message.startswith("row 0: RX3 of RV gives no signal")


def test_live_images_and_images_of_kept_samples_leave_out_the_dead_rx_too(source):
    """Reduced samples are kept in memory: images formed from them again are the same."""
    mangle = kill("RV", 4, rows=range(16, ROWS))
    expected = form_images(source, mangle)
    live = make_pipeline(Mangled(source, mangle), live=True)  # type: ignore[arg-type]
    current = live.form_images(from_sums=True)
    np.testing.assert_allclose(current.v, expected.v, atol=1e-5 * np.abs(expected.v).max())
    next_pipeline = make_pipeline(source)
    for row in source.rows():
        for name, board in live.builder.boards.items():
            next_pipeline.builder.boards[name].put(row, board.read_reduced(row))
    np.testing.assert_allclose(next_pipeline.form_images().v, expected.v, atol=1e-6 * np.abs(expected.v).max())


# Noise relative to the signal of the other RX
@pytest.mark.parametrize("rms", [0.0, 0.03])
def test_a_dead_rx_in_a_cube_is_reported_like_one_in_rows(process, rms):
    cubes = Cubes(load_published_rig(), decode_scene(SCENE, "test"))
    level = float(np.sqrt(np.mean(np.abs(cubes.read_row("RV", 15).cube) ** 2)))
    _, _, healthy = process(None, of=cubes)
    _, _, findings = process(kill("RV", 4, rms=rms * level), of=cubes)
    (reason,) = list_reasons_about_rx(findings)
    assert "RX4 of RV" in reason
    assert list_other_reasons(findings) <= list_other_reasons(healthy)
    assert len(compute_distances(cubes, findings)) == len(PLATES)
    assert max(compute_distances(cubes, findings)) < THREE_STDS_SQUARED
