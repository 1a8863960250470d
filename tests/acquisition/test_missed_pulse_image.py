"""The image of a scan with missed pulses, kept incomplete, is that of the complete scan."""

from __future__ import annotations

import numpy as np
import pytest

from polysight.host.acquisition.missed_pulses import place_frames
from polysight.host.pipeline import Pipeline
from polysight.host.store.scan_folder import ScanFolder
from polysight.host.store.source import RowData, pieces_of
from polysight.simulators.scene import load_scene, simulate
from tests.support.acquisition.arrival_model import PAYLOAD, Load, pulse_times, receive
from tests.support.rigs import published_rig
from tests.support.scenes import small_scene

SCENE = small_scene(24, 10, step_mm=(5.0, 10.0), pulses=6, pixels=24, pixel_mm=5.0)


class Missed:
    """The clean scan, of which every row of both boards misses pulses; `place` says whether its frames are placed."""

    mirrored = synchronised = False
    manifest_faults = ()

    def __init__(self, clean: ScanFolder, place: bool) -> None:
        self._clean, self._place = clean, place
        self.instrument, self.plan = clean.instrument, clean.plan
        self.simulated, self.scan_id, self.path = True, clean.scan_id, clean.path
        self.lost = self.masked = 0

    def rows(self):
        return self._clean.rows()

    def recording_facts(self):
        return {}

    def read_row(self, board: str, row: int) -> RowData:
        whole, frame = self._clean.read_row(board, row), self.instrument.frame_bytes
        pulses = pulse_times(self.plan.columns, self.instrument.burst.pulses, between_ms=250)
        rng = np.random.default_rng([row, board == "RH"])
        missed = sorted(rng.choice(pulses.size, 2, replace=False).tolist())
        slots = np.delete(np.arange(pulses.size), missed)
        if self._place:
            arrivals, answer = receive(pulses, missed, frame, rng, Load())
            placed = place_frames(pulses, answer, arrivals, frame, PAYLOAD)
            assert placed.reason == ""
            received = slots[placed.slots >= 0]
            to = placed.slots[placed.slots >= 0]
        else:
            received, to = slots, np.arange(slots.size)
        frames = whole.payload.reshape(-1, frame)
        out = np.zeros_like(frames)
        out[to] = frames[received]
        absent = np.setdiff1d(np.arange(pulses.size), to)
        self.lost += len(missed)
        self.masked += absent.size
        return RowData(pieces_of(out.reshape(-1)), [(int(s) * frame, int(s + 1) * frame) for s in absent], pulses.size)


def image(source) -> tuple[np.ndarray, np.ndarray]:
    pipeline = Pipeline(source)
    for row in source.rows():
        pipeline.add_row(row)
    found = pipeline.form_images()
    return found.h_raw, found.v_raw


def difference(a, b) -> float:
    return max(float(np.linalg.norm(x - y) / np.linalg.norm(y)) for x, y in zip(a, b, strict=True))


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> ScanFolder:
    folder = tmp_path_factory.mktemp("clean")
    (folder / "scene.toml").write_text(SCENE)
    return ScanFolder.load(simulate(published_rig(), load_scene(folder / "scene.toml"), folder / "scan"))


def test_image_with_missed_pulses_is_the_clean_one(clean):
    want = image(clean)
    placed, slipped = Missed(clean, True), Missed(clean, False)
    good, bad = difference(image(placed), want), difference(image(slipped), want)
    assert placed.masked <= 2 * placed.lost
    assert good < 0.01
    assert bad > 10 * good
