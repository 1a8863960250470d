"""`polysight inspect` as a user runs it."""

from __future__ import annotations

import functools
import json
import subprocess
import sys

import pytest

from polysight.host.capture import dca1000
from tests.support.capture.recordings import CARD, OTHER, row, write_pcap
from tests.support.paths import RIG_FILE
from tests.support.processes import Bench
from tests.support.scenes import small_scene


@pytest.fixture
def polysight(tmp_path):
    return functools.partial(Bench(tmp_path).here, "inspect")


def test_the_command_plots_and_compares_with_the_rig_file(polysight, tmp_path):
    row(4, False).tofile(tmp_path / "right.bin")
    row(2, False).tofile(tmp_path / "wrong.bin")
    done = polysight("right.bin", "--config", RIG_FILE, "--plot", "right.png")
    assert (done.status, "guessed" in done.out, "note" in done.out) == (0, False, False), done
    assert (tmp_path / "right.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    done = polysight("wrong.bin", "--config", RIG_FILE)
    assert "the data look like 2-lane complex, 256 samples x 4 RX, not 4-lane complex" in done.out
    done = polysight("wrong.bin", "--json")
    found = json.loads(done.out)
    assert (found["lanes"], found["guessed"]) == (2, ["lanes", "complex or real", "samples", "I/Q order"])
    assert polysight("right.bin", "--plot", "absent/x.png").status == 3


def test_the_command_reads_packets_of_one_of_several_cards(polysight, tmp_path):
    data = row(4, False).tobytes()
    starts = range(0, len(data), 1456)
    packets = [dca1000.encode_packet(1 + k, a, data[a : a + 1456]) for k, a in enumerate(starts)]
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
    simulate = [sys.executable, "-m", "polysight.simulators", "simulate", tmp_path / "scene.toml", "--config", RIG_FILE]
    subprocess.run([*simulate, "--out", tmp_path / "scan"], check=True, capture_output=True)
    done = polysight("scan/raw/RV/0001.bin")
    assert done.status == 0, done.err
    assert "of a simulated scan" in done.out
    assert "16 chirps x 4 RX x 256 samples, 4-lane, I first\n" in done.out
    (tmp_path / "scan" / "manifest.jsonl").write_bytes(b"damaged\n")
    done = polysight("scan/raw/RV/0001.bin")
    assert (done.status, "guessed" in done.out) == (0, True)
