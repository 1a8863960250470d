"""The authors' rule finds the positions in simulated packet logs of the published layout.

A card sends its last, short packet some 2 s after its data ended (seen on a DCA1000). The authors' decoder lives on it:
it gathers packets until a pause of 45 ms, fills frames from what it has gathered, and a pause of n x 90 ms counts as n
positions. A log without a last pause runs over its end.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.support.rigs import published_rig

from polysight.store.open import open_source
from polysight_simulators.scene import decode_scene, simulate

RIG = published_rig()
PULSES = 16
FRAME = 4096


def scan_in(folder: Path, columns: int = 5, **more: object) -> Path:
    scene = {
        "name": "plate",
        "grid": {"columns": columns, "rows": 2, "step_x_mm": 2.0, "step_y_mm": 6.0},
        "plates": [{"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [30.0, 30.0], "metal": True}],
    }
    return simulate(RIG, decode_scene(scene, "t"), folder, layout="authors", **more)  # type: ignore[arg-type]


def positions_by_pauses(log: Path) -> list[int]:
    """Position of each frame as the authors' rule has it. Raises IndexError where the log has no last pause."""
    table = np.loadtxt(log, delimiter=",", ndmin=2)
    sizes = table[:, 1].astype(int)
    times = table[:, 2]
    frames: list[int] = []
    packet = held_bytes = position = gathered = 0
    while packet < len(sizes):
        while (pause := times[gathered + 1] - times[gathered]) < 0.045:
            gathered += 1
        gathered += 1
        if gathered < len(sizes) - 1:
            position += max(0, int(pause // 0.09) - 1)
        while packet < gathered:
            while held_bytes < FRAME:
                held_bytes += sizes[packet]
                packet += 1
            held_bytes -= FRAME
            frames.append(position)
        position += 1
    return frames


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scan_in(tmp_path_factory.mktemp("scan"))


@pytest.mark.parametrize("board", ["RH", "RV", "LS"])
def test_the_authors_rule_finds_every_frames_position(scan: Path, board: str) -> None:
    logs = sorted((scan / board).glob("*_log.csv"))
    assert len(logs) == 2
    for log in logs:
        assert positions_by_pauses(log) == [i for i in range(5) for _ in range(PULSES)]


def test_the_short_last_packet_comes_two_seconds_after_the_data(scan: Path) -> None:
    table = np.loadtxt(scan / "RH" / "0_0_log.csv", delimiter=",")
    steps = np.diff(table[:, 2])
    assert table[-1, 1] < table[:-1, 1].min()
    assert steps[-1] == pytest.approx(2.0, abs=0.01)
    assert steps[:-1].max() < 0.2


def test_a_row_that_fills_its_last_packet_ends_without_a_late_one(tmp_path: Path) -> None:
    """91 x 4096 bytes are 256 full packets: nothing is left for the timer to send."""
    table = np.loadtxt(scan_in(tmp_path, columns=91) / "RH" / "0_0_log.csv", delimiter=",")
    assert set(table[:, 1]) == {1456}
    assert np.diff(table[:, 2]).max() < 0.2


@pytest.mark.parametrize("skipped", [{}, {("RH", 0): (2,)}, {("RH", 1): (0, 4)}])
def test_the_host_reads_rows_whose_last_packet_comes_late(
    tmp_path: Path, skipped: dict[tuple[str, int], tuple[int, ...]]
) -> None:
    """The late packet is no extra position, also if positions are missing and found by time."""
    source = open_source(scan_in(tmp_path, skipped=skipped), RIG)
    for row in (0, 1):
        for board in ("RH", "RV"):
            missing = source.read_row(board, row).missing  # type: ignore[union-attr]
            skipped_positions = sorted(skipped.get((board, row), ()))
            burst = PULSES * FRAME
            assert missing == [(i * burst, (i + 1) * burst) for i in skipped_positions]
