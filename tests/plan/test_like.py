"""`polysight plan --like SCAN`: noise and standstill between rows are those of that scan."""

from __future__ import annotations

import json

import pytest

from polysight.host.cli.main import main
from polysight.host.plan import Changes
from polysight.host.store import manifest
from polysight.host.store.events import EventWriter
from polysight.host.store.scan_folder import EVENTS, MANIFEST
from polysight.shared.messages import Capture
from polysight.shared.raster import plan_raster
from polysight.simulators.scene import decode_scene, simulate
from tests.support.paths import RIG_FILE

PULSES, ROWS, COLUMNS, SNR_DB, GAP_S = 8, 2, 12, 12.0, 20.0


@pytest.fixture(scope="module")
def scan(rig, tmp_path_factory):
    """A scan of known noise, made without a Pi."""
    folder = tmp_path_factory.mktemp("like") / "scan"
    scene = decode_scene({"name": "quiet", "disturbances": {"ideal": True, "direct_snr_db": SNR_DB}}, "test")
    return simulate(Changes(columns=COLUMNS, rows=ROWS, pulses=PULSES).apply(rig), scene, folder)


def taken_by_a_pi(scan, rig, gap_s: float) -> None:
    """Let the scan's Pi say that so much time passed from a row's last trigger to the next one's first."""
    facts = manifest.read(scan / MANIFEST).facts
    facts[0]["pi"] = {"release": "test"}
    (scan / MANIFEST).write_bytes(b"".join(manifest.encode_line(fact) for fact in facts))
    (scan / EVENTS).unlink(missing_ok=True)
    events, t, seq = EventWriter(scan / EVENTS), 0.0, 0
    for row in plan_raster(Changes(columns=COLUMNS, rows=ROWS).apply(rig).grid):
        for point in range(row.points):
            seq, ns = seq + 1, round(t * 1e9)
            events.append(
                Capture(
                    scan_id="quiet", seq=seq, t_mono_ns=ns, row_index=row.index, take=1, point=point,
                    column=row.column(point), edge_ns=ns, first_pulse_ns=ns, last_pulse_ns=ns, pulses=PULSES,
                    width_max_ns=1, jitter_ns=1,
                )
            )  # fmt: skip
            t += gap_s if point == row.points - 1 else 0.1
    events.sync()
    events.close()


@pytest.fixture
def planned(capsys):
    def plan(*more: object) -> dict:
        arguments = ["plan", "--config", RIG_FILE, "--rows", "30", "--pulses", "16", "--json", *more]
        assert main(list(map(str, arguments))) == 0
        return json.loads(capsys.readouterr().out)

    return plan


def test_noise_and_standstill_are_the_scan_s(scan, rig, planned):
    without = planned()
    alike = planned("--like", scan)
    assert alike["position_snr_db"] == pytest.approx(SNR_DB + 12.04, abs=0.7)  # 16 chirps
    assert alike["noise_source"] == "measured on simulated scan quiet"
    assert "no hardware" in without["noise_source"]
    assert abs(without["position_snr_db"] - alike["position_snr_db"]) > 5
    assert alike["time_s"]["standstill"] == without["time_s"]["standstill"]  # made without a Pi: its times mean nothing
    told = []
    for more_s in (0.0, 1.5):
        taken_by_a_pi(scan, rig, GAP_S + more_s)
        told.append(planned("--like", scan)["time_s"]["standstill"])
    assert told[1] - told[0] == pytest.approx(30 * 1.5)
    assert 0 < told[0] < 30 * GAP_S


def test_what_is_given_beside_it_goes_before_it(scan, rig, planned):
    taken_by_a_pi(scan, rig, GAP_S)
    told = planned("--like", scan, "--snr-db", "3", "--row-overhead-s", "0.5")
    assert told["position_snr_db"] == pytest.approx(3 + 12.04, abs=0.01)
    assert told["time_s"]["standstill"] == pytest.approx(15.0)
