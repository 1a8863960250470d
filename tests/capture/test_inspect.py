"""Recordings are described by their layout; the real packet capture is placed as a received row."""

import functools
import io
import json
import subprocess
import sys

import dpkt
import numpy as np
import pytest
from matplotlib.figure import Figure
from tests.support.capture.recordings import CARD, OTHER, draw_row, write_pcap
from tests.support.capture.records import encode_packets
from tests.support.paths import REAL_CAPTURES, RIG_FILE
from tests.support.processes import Bench
from tests.support.refusals import expect_refusal
from tests.support.scenes import write_small_scene

from polysight.capture import recognise_format
from polysight.capture.dca1000 import Status
from polysight.capture.inspect import Layout, inspect_bin, inspect_pcap, is_pcap, read_pcap
from polysight.jobs.recordings import format_report, inspect_file, plot_profile
from polysight_shared.errors import DataError, ErrorCode

needs_real = pytest.mark.skipif(
    not REAL_CAPTURES.is_dir(),
    reason="the packet capture of a real card is not beside this repository (not ours to publish)",
)


@pytest.mark.parametrize("layout", [Layout(lanes, samples, 4, q) for lanes in (4, 2) for q in (False, True)
                                    for samples in (128, 256)])  # fmt: skip
def test_a_recording_in_its_layout_has_a_peak_and_no_remarks(tmp_path, layout):
    path = tmp_path / "x.bin"
    draw_row(layout.lanes, layout.q_first, samples=layout.samples).tofile(path)
    r = inspect_bin(path, layout)
    assert (r.layout, r.chirps, r.remarks) == (layout, 32, [])
    assert r.peak_bin < layout.samples // 2
    assert r.profile_db.shape == (layout.samples,)


@pytest.mark.parametrize("content", ["a text\n" * 3000, "PNG"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "x.bin"
    path.write_bytes(b"\x89PNG\r\n" * 1000 if content == "PNG" else content.encode())
    with expect_refusal(ErrorCode.FILE_FOREIGN, str(path)):
        inspect_bin(path)


@pytest.mark.parametrize("size", [5000, 1 << 16, 1 << 20])
@pytest.mark.parametrize("layout", [Layout(), Layout(lanes=2), Layout(samples=64)])
def test_random_bytes_are_not_a_recording(tmp_path, size, layout):
    path = tmp_path / "x.bin"
    path.write_bytes(np.random.default_rng(size).bytes(size))
    with expect_refusal(ErrorCode.FILE_FOREIGN, str(path)):
        inspect_bin(path, layout)


def test_zeros_have_their_own_exit_status(tmp_path, capsys):
    (tmp_path / "x.bin").write_bytes(bytes(1 << 16))
    assert inspect_file(tmp_path / "x.bin", None, None, "", as_json=False) == DataError.exit_status
    assert "every sample is zero" in capsys.readouterr().out


def write_faulty_file(words: np.ndarray, fault: str) -> np.ndarray:
    """Return a recording with a fault of the radar, the card or the program that wrote it, named by its remark."""
    if fault == "constant offset of":
        return words + np.int16(4000)
    if fault == "5 bytes after":
        return np.frombuffer(words.tobytes() + b"12345", np.uint8)
    if fault == "full scale":
        return np.clip(words * (0.9 * 32767 / words.std()), -32768, 32767).astype("<i2")
    if fault == "no clear peak":
        return np.random.default_rng(1).normal(scale=20, size=words.size).astype("<i2")
    if fault == "I and Q":
        return draw_row(4, q_first=True)
    if fault == "on RX1:":
        return draw_row(4, q_first=False, dead=0)
    assert fault == "on RX4:"
    return draw_row(4, q_first=False, dead=3)


@pytest.mark.parametrize(
    "fault", ["constant offset of", "5 bytes after", "full scale", "I and Q", "on RX1:", "on RX4:", "no clear peak"]
)
def test_a_fault_causes_its_own_remark_and_no_other(tmp_path, fault):
    write_faulty_file(draw_row(4, False), fault).tofile(tmp_path / "x.bin")
    r = inspect_bin(tmp_path / "x.bin")
    assert [fault in remark for remark in r.remarks] == [True]
    assert (r.clipped > 0) is (fault == "full scale")


@pytest.mark.parametrize("dead", [0, 3])
def test_the_legend_of_the_range_profile_says_which_antenna_has_no_signal(tmp_path, monkeypatch, dead):
    draw_row(4, False, dead=dead).tofile(tmp_path / "x.bin")
    legends = []

    def keep_legend(figure: Figure, *_: object, **__: object) -> None:
        legends.append([text.get_text() for text in figure.axes[0].get_legend().texts])

    monkeypatch.setattr(Figure, "savefig", keep_legend)
    plot_profile(inspect_bin(tmp_path / "x.bin"), tmp_path / "x.png")
    assert legends == [[f"RX{i + 1}" + " (no signal)" * (i == dead) for i in range(4)] + ["mean"]]


def test_the_counters_of_packets_in_a_file_are_left_out_with_a_remark(tmp_path):
    """A program that writes packets as they come leaves ten bytes of counters before every 1456 of payload."""
    data = draw_row(4, False).tobytes()
    path = tmp_path / "x.bin"
    path.write_bytes(b"".join(encode_packets(data, 9, 70_000)))
    r = inspect_bin(path)
    assert (r.chirps, r.bytes) == (32, len(data))
    assert ["whole packets" in remark for remark in r.remarks] == [True]
    path.write_bytes(data)
    assert inspect_bin(path).remarks == []


def test_of_a_huge_file_only_the_beginning_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("polysight.capture.inspect.MAX_BYTES", 1 << 20)
    path = tmp_path / "x.bin"
    draw_row(4, False).tofile(path)
    # 16 GiB, most of which takes no space on the disk.
    with path.open("r+b") as f:
        f.truncate(1 << 34)
    report = inspect_bin(path)
    assert report.bytes <= 1 << 20
    assert any("16384 MiB" in remark for remark in report.remarks)


@needs_real
def test_a_packet_capture_is_known_by_its_first_bytes_whatever_its_name(tmp_path, capsys):
    (tmp_path / "x.bin").write_bytes((REAL_CAPTURES / "test_one_frame.pcap").read_bytes())
    assert inspect_file(tmp_path / "x.bin", None, None, "", as_json=False) == 0
    assert "card  " in capsys.readouterr().out


def test_an_empty_and_an_absent_file_are_refused(tmp_path):
    (tmp_path / "x.bin").write_bytes(b"")
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        inspect_bin(tmp_path / "x.bin")
    with expect_refusal(ErrorCode.FILE_UNREADABLE):
        inspect_bin(tmp_path / "absent.bin")


@pytest.mark.parametrize(("order", "magic", "tick"), [("<", 0xA1B2C3D4, 1000), (">", 0xA1B23C4D, 1)])
def test_packet_captures_of_either_byte_order_and_unit_of_time_are_read(tmp_path, order, magic, tick):
    write_pcap(tmp_path / "x.pcap", [b"hello", b"x" * 100], order, magic)
    packets = list(read_pcap(tmp_path / "x.pcap"))
    assert [d.payload for d in packets] == [b"hello", b"x" * 100]
    assert packets[0].t_s == pytest.approx(100 + 5e-9 * tick, abs=1e-10)
    assert packets[0].source == ("192.168.33.180", 1024)


def test_pcapng_gives_the_same_datagrams(tmp_path):
    write_pcap(tmp_path / "x.pcap", [b"hello", b"x" * 100])
    with (tmp_path / "x.pcap").open("rb") as old, (tmp_path / "x.pcapng").open("wb") as new:
        writer = dpkt.pcapng.Writer(new)
        for t_s, frame in dpkt.pcap.Reader(old):
            writer.writepkt(frame, t_s)
    assert is_pcap((tmp_path / "x.pcapng").read_bytes()[:4])
    assert list(read_pcap(tmp_path / "x.pcapng")) == list(read_pcap(tmp_path / "x.pcap"))


def test_lost_packets_of_a_pcap_are_masked_and_reported(tmp_path):
    packets = encode_packets(draw_row(4, False).tobytes(), 2**32 - 3, 2**48 - 30_000)
    write_pcap(tmp_path / "x.pcap", [*packets[:5], *packets[6:], packets[4]])
    r = inspect_pcap(tmp_path / "x.pcap")
    assert r.card is not None
    assert r.card.record is not None
    assert r.card.record.missing == [(5 * 1456, 6 * 1456)]
    assert r.card.record.counts.duplicates == 1
    assert r.chirps == 32
    assert "1456 bytes are missing" in format_report(r)


@pytest.mark.parametrize("size", [0, 3, 10, 30, 60])
def test_a_truncated_packet_capture_is_refused(tmp_path, size):
    write_pcap(tmp_path / "x.pcap", [b"hello"])
    path = tmp_path / "y.pcap"
    path.write_bytes((tmp_path / "x.pcap").read_bytes()[:size])
    with pytest.raises(DataError):
        list(read_pcap(path))


@needs_real
def test_the_record_of_a_real_card_is_placed_and_its_layout_recognized():
    """With I and Q exchanged the peak is on the other side, which is the remark."""
    r = inspect_pcap(REAL_CAPTURES / "test_one_frame.pcap", Layout(2, q_first=True))
    assert (r.chirps, r.remarks) == (4, [])
    swapped = inspect_pcap(REAL_CAPTURES / "test_one_frame.pcap", Layout(2))
    assert ["I and Q" in remark for remark in swapped.remarks] == [True]
    assert (r.peak_bin, round(r.peak_db)) == (59, 47)
    assert r.card is not None
    assert r.card.record is not None
    assert r.card.record.complete
    assert r.card.record.counts.placed == 12
    assert r.card.tail_bytes == 16384 - 11 * 1456
    # A card sends the short last packet 2 s after the data: its timer is exact to a millisecond.
    assert r.card.tail_after_s == pytest.approx(2.0, abs=0.001)
    assert r.card.status == Status.RECORD_COMPLETED
    assert ("RECORD_START", 0) in r.card.replies


@needs_real
def test_the_replies_of_a_real_card_are_read():
    r = inspect_pcap(REAL_CAPTURES / "test_cmd.pcap")
    assert r.card is not None
    assert r.card.version == "2.8"
    names = [name for name, _ in r.card.replies]
    assert len(names) == 10
    assert {"RESET_FPGA", "RECORD_START", "RECORD_STOP", "CONFIGURE_PACKET", "ALIVE", "VERSION"} <= set(names)
    assert "2.8" in format_report(r)


def npy() -> bytes:
    out = io.BytesIO()
    np.save(out, np.zeros(3))
    return out.getvalue()


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (npy(), "a numpy array"),
        ("# Überschrift\n".encode() * 40, "text"),
        # Cut within a character.
        (("ä" * 400).encode()[:511], "text"),
        (b"\x89PNG\r\n", "a picture (PNG)"),
        (b"", "empty"),
        (bytes(range(256)), "unknown bytes"),
    ],
)
def test_other_files_are_recognised_by_their_first_bytes(head, kind):
    assert recognise_format(head) == kind


@pytest.fixture
def polysight(tmp_path):
    return functools.partial(Bench(tmp_path).run_here, "inspect")


def test_the_command_reads_the_layout_that_is_given(polysight, tmp_path):
    draw_row(4, False).tofile(tmp_path / "rig.bin")
    draw_row(2, True, samples=128).tofile(tmp_path / "other.bin")
    process = polysight("rig.bin", "--config", RIG_FILE, "--plot", "rig.png")
    assert process.status == 0, process
    assert "note" not in process.out
    assert (tmp_path / "rig.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    options = ("--samples", "128", "--lanes", "2", "--q-first", "--json")
    document = json.loads(polysight("other.bin", *options).out)
    assert (document["lanes"], document["samples"], document["q_first"], document["remarks"]) == (2, 128, True, [])
    assert polysight("rig.bin", "--plot", "rig.bin/x.png").status == 5


def test_the_command_reads_packets_of_one_of_several_cards(polysight, tmp_path):
    each_packet_twice = [packet for packet in encode_packets(draw_row(4, False).tobytes(), 1, 0) for _ in range(2)]
    # A packet capture is recognized by its first bytes, not by its name.
    write_pcap(tmp_path / "both", each_packet_twice, cards=(CARD, OTHER))
    process = polysight("both")
    assert process.status == 3
    assert "192.168.33.180 and 192.168.33.181" in process.err
    options = ("--card", "192.168.33.181", "--config", RIG_FILE, "--plot", "both.png")
    process = polysight("both", *options)
    assert process.status == 0, process.err
    assert "32 chirps x 4 RX x 256 samples" in process.out
    assert (tmp_path / "both.png").exists()
    assert "nothing from a DCA1000 at 192.168.33.7" in polysight("both", "--card", "192.168.33.7").err


def test_a_row_of_a_scan_is_read_with_the_scans_rig_file(polysight, tmp_path):
    (tmp_path / "scene.toml").write_text(write_small_scene(8, 2, metal=False))
    simulate = [sys.executable, "-m", "polysight_simulators", "simulate", tmp_path / "scene.toml", "--config", RIG_FILE]
    subprocess.run([*simulate, "--out", tmp_path / "scan"], check=True, capture_output=True)
    process = polysight("scan/raw/RV/0001.bin")
    assert process.status == 0, process.err
    assert "of a simulated scan" in process.out
    assert "16 chirps x 4 RX x 256 samples, 4-lane, I first\n" in process.out
    (tmp_path / "scan" / "manifest.jsonl").write_bytes(b"damaged\n")
    process = polysight("scan/raw/RV/0001.bin")
    assert process.status == 0
    assert "of a simulated scan" not in process.out
