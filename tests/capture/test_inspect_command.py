"""`polysight inspect` as a user runs it."""

from __future__ import annotations

import functools
import json
import subprocess
import sys

import pytest
from tests.support.capture.recordings import CARD, OTHER, row, write_pcap
from tests.support.capture.records import encode_packet
from tests.support.paths import RIG_FILE
from tests.support.processes import Bench
from tests.support.scenes import small_scene


@pytest.fixture
def polysight(tmp_path):
    return functools.partial(Bench(tmp_path).here, "inspect")


def test_the_command_reads_the_layout_that_is_given(polysight, tmp_path):
    row(4, False).tofile(tmp_path / "rig.bin")
    row(2, True, samples=128).tofile(tmp_path / "other.bin")
    done = polysight("rig.bin", "--config", RIG_FILE, "--plot", "rig.png")
    assert (done.status, "note" in done.out) == (0, False), done
    assert (tmp_path / "rig.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    found = json.loads(polysight("other.bin", "--samples", "128", "--lanes", "2", "--q-first", "--json").out)
    assert (found["lanes"], found["samples"], found["q_first"], found["remarks"]) == (2, 128, True, [])
    assert polysight("rig.bin", "--plot", "absent/x.png").status == 3


def test_the_command_reads_packets_of_one_of_several_cards(polysight, tmp_path):
    data = row(4, False).tobytes()
    starts = range(0, len(data), 1456)
    packets = [encode_packet(1 + k, a, data[a : a + 1456]) for k, a in enumerate(starts)]
    both = [packet for packet in packets for _ in range(2)]
    write_pcap(tmp_path / "both", both, cards=(CARD, OTHER))  # known by its first bytes, not by its name
    done = polysight("both")
    assert done.status == 3
    assert "192.168.33.180 and 192.168.33.181" in done.err
    done = polysight("both", "--card", "192.168.33.181", "--config", RIG_FILE, "--plot", "both.png")
    assert done.status == 0, done.err
    assert "32 chirps x 4 RX x 256 samples" in done.out
    assert (tmp_path / "both.png").exists()
    assert "nothing from a DCA1000 at 192.168.33.7" in polysight("both", "--card", "192.168.33.7").err


def test_a_row_of_a_scan_is_read_with_the_scans_rig_file(polysight, tmp_path):
    (tmp_path / "scene.toml").write_text(small_scene(8, 2, metal=False))
    simulate = [sys.executable, "-m", "polysight_simulators", "simulate", tmp_path / "scene.toml", "--config", RIG_FILE]
    subprocess.run([*simulate, "--out", tmp_path / "scan"], check=True, capture_output=True)
    done = polysight("scan/raw/RV/0001.bin")
    assert done.status == 0, done.err
    assert "of a simulated scan" in done.out
    assert "16 chirps x 4 RX x 256 samples, 4-lane, I first\n" in done.out
    (tmp_path / "scan" / "manifest.jsonl").write_bytes(b"damaged\n")
    done = polysight("scan/raw/RV/0001.bin")
    assert (done.status, "of a simulated scan" in done.out) == (0, False)
