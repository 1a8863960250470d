"""Noise and standstill from scans: of a simulated scan with known noise, and of the simulated rig's own clock."""

from __future__ import annotations

import subprocess
import sys
from itertools import groupby, pairwise

import msgspec
import pytest
import tomli_w

from polysight.host.plan import Changes, Noise
from polysight.host.plan.text import noise_of, row_overhead_of
from polysight.host.plan.timing import row_motion_s, scan_time, turn_s, whole_packets
from polysight.host.store.events import read_events
from polysight.host.store.scan_folder import EVENTS, ScanFolder
from polysight.shared.config import load_instrument
from polysight.shared.errors import DataError
from polysight.shared.messages import Capture
from polysight.shared.tables import to_builtins
from polysight.simulators.scene import decode_scene, simulate


def small_scan(rig, folder, pulses, snr_db):
    rig = Changes(columns=24, rows=2, pulses=pulses).apply(rig)
    scene = decode_scene({"name": "noise", "disturbances": {"ideal": True, "direct_snr_db": snr_db}}, "test")
    return ScanFolder.load(simulate(rig, scene, folder))


@pytest.mark.parametrize("snr_db", [3.0, 12.0])
def test_the_noise_of_a_simulated_scan_is_found(rig, tmp_path, snr_db):
    found = noise_of(small_scan(rig, tmp_path / "scan", 8, snr_db))
    assert found.direct_snr_db == pytest.approx(snr_db, abs=0.7)
    assert "simulated" in found.source
    assert row_overhead_of(tmp_path / "scan") is None  # made without a Pi: its times mean nothing


def test_a_scan_without_rows_cannot_tell_its_noise(rig, tmp_path):
    scan = small_scan(rig, tmp_path / "scan", 4, 3.0)
    empty = ScanFolder.create(tmp_path / "empty", scan.instrument, scan.plan, simulated=True)
    with pytest.raises(DataError, match="cannot be told"):
        noise_of(empty)


def test_the_default_noise_is_called_simulated():
    assert "simulated" in Noise().source


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
            scan = [
                sys.executable,
                "-m",
                "polysight.host",
                "scan",
                "--config",
                ready.removeprefix("ready ").strip(),
            ]
            subprocess.run([*scan, "--out", folder / "scan", "--no-process"], check=True, timeout=240)
        finally:
            process.terminate()
    return folder / "scan", load_instrument(folder / "rig.toml")


def test_a_simulated_scan_s_own_clock_agrees(scanned):
    """Rows take exactly what was estimated; between them pass the motion and the standstill that is told."""
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
    told = row_overhead_of(folder)
    assert told == pytest.approx(sum(gaps) / 2 - motion, abs=1e-6)
