"""RX that were recorded in another order are reported with that order, and no other reason is given."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
from benchmarks.coverage import Cubes
from tests.support.mangled_scans import PLATES, SCENE, Mangle, Mangled, compute_distances
from tests.support.pipelines import make_pipeline
from tests.support.rigs import load_published_rig, make_rig_with

from polysight.jobs.process import LiveProcessing
from polysight.settings import Settings
from polysight.store import ScanFolder
from polysight.sync import BoardSetup, rx_order
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError
from polysight_simulators.scene import decode_scene


def record_in_order(board: str, *order: int) -> Mangle:
    """Record the RX of a board in another order: the first recorded one is RX `order[0]`, counted from 1."""

    # `samples` of a row are [..., rx].
    def mangle(name: str, _: int, samples: np.ndarray) -> None:
        if name == board:
            samples[:] = samples[..., [k - 1 for k in order]]

    return mangle


def declare_order(rig: Instrument, board: str, *order: int) -> Instrument:
    """Return the rig with this order of the RX of a board, as if it stood in the rig file."""
    boards = [msgspec.structs.replace(b, rx_order=order) if b.name == board else b for b in rig.boards]
    return msgspec.structs.replace(rig, boards=tuple(boards))


@pytest.mark.parametrize(
    ("board", "order"),
    [("RV", (2, 1, 3, 4)), ("RV", (4, 3, 2, 1)), ("RV", (1, 3, 2, 4)), ("RH", (2, 1, 3, 4)), ("RH", (4, 3, 2, 1))],
)
def test_another_order_is_the_only_reason_of_the_verdict(process_six_plates, board, order):
    pipeline, _, findings = process_six_plates(record_in_order(board, *order))
    assert findings.verdict.level == "none"
    (reason,) = findings.verdict.reasons
    assert f"the RX of {board} are recorded in another order" in reason.what
    assert f"rx_order = {list(order)}" in reason.do
    assert pipeline.quality.result().boards[board].rx_order == list(order)


def test_with_the_order_in_the_rig_file_the_images_are_the_same(six_plates, process_six_plates):
    class WithOrderInRig(Mangled):
        def __init__(self) -> None:
            super().__init__(six_plates, record_in_order("RV", 4, 3, 1, 2))
            self.instrument = declare_order(six_plates.instrument, "RV", 4, 3, 1, 2)

    pipeline = make_pipeline(WithOrderInRig())  # type: ignore[arg-type]
    images = pipeline.form_images()
    _, expected, _ = process_six_plates()
    # Rounding: the difference is 3e-7 of the largest amplitude. Without the order in the rig file it is 0.9.
    np.testing.assert_allclose(images.v, expected.v, atol=2e-5 * np.abs(expected.v).max())
    findings = pipeline.examine(images)
    assert pipeline.quality.result().boards["RV"].rx_order == []
    # Every dielectric plate was found, and its permittivity was measured.
    distances_from_truth = compute_distances(six_plates, findings)
    assert len(distances_from_truth) == len(PLATES)


def test_the_right_order_and_a_dead_rx_are_not_reported_as_another_order(process_six_plates):
    def silence_third_rx(name: str, _: int, samples: np.ndarray) -> None:
        if name == "RV":
            samples[..., 2] = 0

    for mangle in (None, silence_third_rx):
        pipeline, _, _ = process_six_plates(mangle)
        for board in pipeline.quality.boards.values():
            for row in board.rows.values():
                assert not row.figures.rx_order


@pytest.mark.parametrize(("board", "order"), [("RV", (2, 1, 3, 4)), ("RH", (4, 3, 2, 1))])
def test_another_order_in_cubes_is_reported(process_six_plates, board, order):
    cubes = Cubes(load_published_rig(), decode_scene(SCENE, "test"))
    # A synchronised cube has no phases of the direct path. They are restored here, because they show the order of the
    # RX.
    setups = {b.name: BoardSetup.from_rig(load_published_rig(), b) for b in cubes.instrument.receivers}

    def mangle(name: str, row: int, samples: np.ndarray) -> None:
        path = setups[name].path
        # Of the samples in which the chirp is linear
        first_sample, stop_sample = cubes.instrument.chirp.linear_samples
        middle_of_chirp = (first_sample + stop_sample) // 2
        lags = np.angle(path.steering[:, middle_of_chirp])
        rng = np.random.default_rng(row)
        # [position, sample, 1, rx]
        random_phase = np.exp(2j * np.pi * rng.random((len(samples), 1, 1, 1)))
        samples *= random_phase * np.exp(-1j * lags)
        record_in_order(board, *order)(name, row, samples)

    _, _, findings = process_six_plates(mangle, cubes)
    assert [r.what for r in findings.verdict.reasons if f"the RX of {board} are recorded" in r.what]


def test_another_order_is_reported_to_the_operator_within_the_first_rows(six_plates, monkeypatch, caplog):
    monkeypatch.setattr(ScanFolder, "load", lambda _: Mangled(six_plates, record_in_order("RH", 4, 3, 2, 1)))
    processing = LiveProcessing(six_plates.path, Settings())
    for row in range(3):
        processing.add_row(row)
    messages = [r.getMessage() for r in caplog.records if "another order" in r.getMessage()]
    assert len(messages) == 1


@pytest.mark.parametrize("order", [(1, 2, 3), (1, 1, 2, 3), (0, 1, 2, 3), (2, 3, 4, 5)])
def test_an_order_that_does_not_name_each_rx_once_is_refused(order):
    def write(table: dict) -> None:
        table["boards"][1]["rx_order"] = list(order)

    with pytest.raises(ConfigError, match="rx_order"):
        make_rig_with(write)


@pytest.mark.parametrize("board", [0, 1])
def test_phases_of_one_position_show_the_order_despite_phases_of_the_channels(board):
    """Each of the 24 orders of four RX is found, or one whose phases of the echo are nearly the same.

    The channels have phases of up to 20 degrees of their own, and the echo has noise of 0.1 rad.
    """
    rig = load_published_rig()
    path = BoardSetup.from_rig(rig, rig.receivers[board]).path
    expected = rx_order._expect_phases(path)
    rng = np.random.default_rng(3)
    for order in itertools.permutations(range(4)):
        places = list(order)
        channels = np.exp(1j * np.radians(rng.uniform(-20, 20, 4)))
        direct = channels * np.exp(1j * expected.direct[places])
        echo = np.exp(1j * (expected.echo[places] + 0.1 * rng.standard_normal(4)))
        order_found = rx_order._choose_order(rx_order._RowPhasors(direct, echo), expected)
        # An empty list means the order of the rig file.
        chosen = [k - 1 for k in order_found] if order_found else [0, 1, 2, 3]
        # 1 if all four phases of the echo are the same
        agreement = abs(np.exp(1j * (expected.echo[places] - expected.echo[chosen])).mean())
        # On board RH a rotation of the RX by some places leaves an agreement of 0.99: such orders cannot be told apart.
        # Any other wrong order has less than 0.90, on either board.
        assert agreement > 0.97
