"""Measured noise and standstill: of a simulated scan with known noise, and by the clock of the simulated rig."""

from __future__ import annotations

import subprocess
import sys
from itertools import groupby, pairwise

import msgspec
import pytest
import tomli_w

from polysight.host.plan import Changes
from polysight.host.plan.plan_command import measure_noise, measure_row_overhead
from polysight.host.plan.timing import row_motion_s, scan_time, turn_s, whole_packets
from polysight.host.store.events import read_events
from polysight.host.store.scan_folder import EVENTS, ScanFolder
from polysight.shared.config import load_instrument
from polysight.shared.error_codes import ErrorCode
from polysight.shared.messages import Capture
from polysight.shared.tables import to_builtins
from polysight.simulators.scene import decode_scene, simulate
from tests.support.refusals import refused


def small_scan(rig, folder, pulses, snr_db):
    rig = Changes(columns=24, rows=2, pulses=pulses).apply(rig)
    scene = decode_scene({"name": "noise", "disturbances": {"ideal": True, "direct_snr_db": snr_db}}, "test")
    return ScanFolder.load(simulate(rig, scene, folder))


@pytest.mark.parametrize("snr_db", [3.0, 12.0])
def test_the_noise_of_a_simulated_scan_is_found(rig, tmp_path, snr_db):
    found = measure_noise(small_scan(rig, tmp_path / "scan", 8, snr_db))
    assert found.direct_snr_db == pytest.approx(snr_db, abs=0.7)
    assert "simulated" in found.source
    assert measure_row_overhead(tmp_path / "scan") is None  # without a Pi there are no times


def test_a_scan_without_rows_has_no_noise(rig, tmp_path):
    scan = small_scan(rig, tmp_path / "scan", 4, 3.0)
    empty = ScanFolder.create(tmp_path / "empty", scan.instrument, scan.plan, simulated=True)
    with refused(ErrorCode.NOT_ENOUGH_DATA):
        measure_noise(empty)


@pytest.fixture(scope="module")
def scanned(rig, tmp_path_factory):
    """A scan with the whole simulated rig, processes and sockets, 40 times as fast as real."""
    folder = tmp_path_factory.mktemp("rig")
    rig = Changes(columns=13, rows=3, pulses=7, speed_mm_s=40.0).apply(rig)
    rig = msgspec.structs.replace(rig, stage=msgspec.structs.replace(rig.stage, centre_x_mm=120.0, centre_y_mm=60.0))
    (folder / "rig.toml").write_text(tomli_w.dumps(to_builtins(rig)))
    command = [
        sys.executable,
        "-m",
        "polysight.simulators.rig",
        "--config",
        folder / "rig.toml",
        "--dir",
        folder / "rig",
    ]
    command += ["--pattern", "--time-scale", "40", "--with-pi"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            ready = process.stdout.readline()
            assert ready.startswith("ready "), ready
            scan = [sys.executable, "-m", "polysight.host", "scan", "--config", ready.removeprefix("ready ").strip()]
            subprocess.run([*scan, "--out", folder / "scan", "--no-process"], check=True, timeout=240)
        finally:
            process.terminate()
    return folder / "scan", load_instrument(folder / "rig.toml")


def test_a_simulated_scan_s_own_clock_agrees(scanned):
    """Rows take the estimated time; the gaps between them are motion plus the measured standstill."""
    folder, rig = scanned
    assert whole_packets(rig)
    estimate = scan_time(rig, 0.0)
    captures = [e for e in read_events(folder / EVENTS).events if isinstance(e, Capture)]
    rows = [[e.edge_ns / 1e9 for e in group] for _, group in groupby(captures, lambda e: (e.row_index, e.take))]
    assert [len(row) for row in rows] == [13] * 3
    for row in rows:
        assert row[-1] - row[0] == pytest.approx(estimate.measuring_s / 3, abs=1e-3)
    motion = row_motion_s(rig.grid, rig.stage) - estimate.measuring_s / 3 + turn_s(rig.grid, rig.stage)
    gaps = [later[0] - earlier[-1] for earlier, later in pairwise(rows)]
    assert min(gaps) > motion - 0.02
    assert measure_row_overhead(folder) == pytest.approx(sum(gaps) / 2 - motion, abs=1e-6)
