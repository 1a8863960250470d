"""Unknown recordings are recognised; the real packet capture is read through the receiver's placement."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import pytest

from polysight.host.capture import dca1000, kind_of
from polysight.host.capture.dca1000 import Status
from polysight.host.capture.inspect import Known, Report, Shape, inspect_bin
from polysight.host.capture.pcap import inspect_pcap, read_pcap
from polysight.host.jobs.recordings import inspect_file, main_text, plot_profile
from polysight.shared.error_codes import ErrorCode
from polysight.shared.errors import DataError
from tests.support.capture.recordings import real_row, row, write_pcap
from tests.support.paths import REAL_CAPTURES
from tests.support.refusals import refused
from tests.support.rigs import published_rig

needs_real = pytest.mark.skipif(
    not REAL_CAPTURES.is_dir(),
    reason="the packet capture of a real card is not beside this repository (not ours to publish)",
)


def inspect_shape(path: Path, shape: Shape, q_first: bool | None = False) -> Report:
    return inspect_bin(path, Known.of_shape(shape, q_first))


@pytest.mark.parametrize("lanes", [4, 2])
@pytest.mark.parametrize("q_first", [False, True])
def test_shape_and_order_are_guessed(tmp_path, lanes, q_first):
    path = tmp_path / "x.bin"
    row(lanes, q_first).tofile(path)
    r = inspect_bin(path)
    assert (r.lanes, r.samples, r.chirps, r.q_first) == (lanes, 256, 32, q_first)
    assert r.peak_bin < 128
    assert r.remarks == []
    assert "guessed" in main_text(r)


@pytest.mark.parametrize("lanes", [4, 2])
@pytest.mark.parametrize("q_first", [False, True])
@pytest.mark.parametrize("samples", [128, 256, 512])
def test_adjacent_pairs_are_recognised(tmp_path, lanes, q_first, samples):
    """Public data sets of IWR and AWR16xx, 18xx, 68xx hold I and Q of a sample side by side."""
    path = tmp_path / "x.bin"
    row(lanes, q_first, samples=samples, adjacent=True).tofile(path)
    r = inspect_bin(path)
    assert (r.lanes, r.samples, r.chirps, r.q_first, r.adjacent) == (lanes, samples, 32, q_first, True)
    assert r.peak_bin < samples // 2
    assert "adjacent" in main_text(r)


@pytest.mark.parametrize("adjacent", [False, True])
@pytest.mark.parametrize("lanes", [4, 2])
def test_guesses_have_likelihoods(tmp_path, lanes, adjacent):
    """They sum to one, the taken one is the likeliest of clear data, and what is given leaves no choice."""
    path = tmp_path / "x.bin"
    row(lanes, False, adjacent=adjacent).tofile(path)
    r = inspect_bin(path)
    assert sum(g.likelihood for g in r.guesses) == pytest.approx(1)
    assert r.guesses[0].shape == Shape(lanes, True, 256, 4, adjacent)
    assert r.guesses[0].likelihood == max(g.likelihood for g in r.guesses)
    assert f"{100 * r.guesses[0].likelihood:.0f} %" in main_text(r)
    given = inspect_bin(path, Known.of_shape(Shape(lanes, True, 256, 4, adjacent)))
    assert [g.likelihood for g in given.guesses] == [1.0]


def noise_of_a_receiver(tmp_path: Path) -> bytes:
    del tmp_path
    return np.random.default_rng(1).normal(scale=20, size=1 << 16).round().astype("<i2").tobytes()


def a_whole_picture(tmp_path: Path) -> bytes:
    row(4, False).tofile(tmp_path / "y.bin")
    plot_profile(inspect_bin(tmp_path / "y.bin"), tmp_path / "y.png")
    return (tmp_path / "y.png").read_bytes()


@pytest.mark.parametrize(
    ("content", "is_capture"),
    [
        (noise_of_a_receiver, True),
        (lambda _p: row(4, False).tobytes(), True),
        (lambda _p: row(2, False, adjacent=True).tobytes(), True),
        (lambda _p: altered(row(4, False), "clipping").tobytes(), True),
        (lambda _p: altered(row(2, False), "offset binary").tobytes(), True),
        (lambda _p: np.random.default_rng(1).bytes(1 << 17), False),
        (lambda _p: bytes(1 << 16), False),
        (lambda _p: b"\xff" * (1 << 16), False),
        (lambda _p: np.full(1 << 15, 517, "<i2").tobytes(), False),
        (lambda _p: ("a text, in another code\n" * 3000).encode("utf-16"), False),
        (a_whole_picture, False),
        (lambda _p: Path(sys.executable).resolve().read_bytes()[: 1 << 20], False),
    ],
)
def test_files_that_are_no_recordings_have_their_own_status(tmp_path, capsys, content, is_capture):
    path = tmp_path / "x.bin"
    path.write_bytes(content(tmp_path))
    assert inspect_file(path, None, None, "", as_json=False) == (0 if is_capture else DataError.exit_status)
    assert ("not a capture" in capsys.readouterr().out) is not is_capture


def test_empty_and_truncated_recordings_are_reported(tmp_path):
    path = tmp_path / "x.bin"
    path.write_bytes(row(4, False).tobytes() + b"12345")
    assert "5 bytes after" in main_text(inspect_bin(path))
    np.zeros(4096, dtype=np.uint8).tofile(path)
    assert "every sample is zero" in main_text(inspect_bin(path, Known(4, samples=256, q_first=False)))


@pytest.mark.parametrize("lanes", [4, 2])
@pytest.mark.parametrize("samples", [128, 256, 512])
def test_real_samples_are_recognised(tmp_path, lanes, samples):
    path = tmp_path / "x.bin"
    real_row(lanes, samples=samples).tofile(path)
    r = inspect_bin(path)
    assert (r.lanes, r.is_complex, r.samples, r.chirps) == (lanes, False, samples, 32)
    assert r.profile_db.shape == (samples // 2,)
    assert r.remarks == []
    assert "-lane, real" in main_text(r)


@pytest.mark.parametrize(
    "given", [Shape(2, True, 256), Shape(4, True, 512), Shape(4, False, 256), Shape(2, False, 256)]
)
def test_a_layout_that_does_not_fit_is_reported(tmp_path, given):
    path = tmp_path / "x.bin"
    row(4, False).tofile(path)
    assert inspect_shape(path, Shape(4, True, 256)).remarks == []
    remarks = inspect_shape(path, given).remarks
    assert any(str(Shape(4, True, 256)) in text for text in remarks)


def test_swapped_i_and_q_are_reported(tmp_path):
    path = tmp_path / "x.bin"
    row(4, True).tofile(path)
    assert any("I and Q" in text for text in inspect_shape(path, Shape(4, True, 256)).remarks)
    assert inspect_shape(path, Shape(4, True, 256), q_first=True).remarks == []
    assert inspect_shape(path, Shape(4, True, 256), q_first=None).q_first


def altered(words: np.ndarray, fault: str) -> np.ndarray:
    """A recording with a fault of the radar, the card or the program that wrote it."""
    if fault == "offset binary":
        return (words.view("<u2") ^ 0x8000).view("<i2")
    if fault == "constant offset":
        return words + np.int16(4000)
    gain = 0.9 * 32767 / words.std()
    return np.clip(words * gain, -32768, 32767).astype("<i2")


@pytest.mark.parametrize("lanes", [4, 2])
@pytest.mark.parametrize("is_complex", [True, False])
@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("offset binary", "offset binary"),
        ("constant offset", "constant offset of"),
        ("clipping", "full scale"),
    ],
)
def test_a_fault_is_reported_and_the_layout_still_recognised(tmp_path, lanes, is_complex, fault, says):
    """Nothing is given: the layout is guessed from data with the fault in it, and the fault is the only remark."""
    sound = row(lanes, False) if is_complex else real_row(lanes)
    path = tmp_path / "x.bin"
    sound.tofile(path)
    peak = inspect_bin(path).peak_bin
    altered(sound, fault).tofile(path)
    r = inspect_bin(path)
    assert (r.lanes, r.is_complex, r.samples, r.peak_bin) == (lanes, is_complex, 256, peak)
    assert len(r.remarks) == 1
    assert says in r.remarks[0]
    assert (r.clipped > 0) is (fault == "clipping")


@pytest.mark.parametrize("lanes", [4, 2])
@pytest.mark.parametrize("dead", [0, 3])
def test_a_missing_antenna_is_reported_in_either_layout(tmp_path, lanes, dead):
    path = tmp_path / "x.bin"
    row(lanes, False, dead=dead).tofile(path)
    r = inspect_bin(path)
    assert (r.lanes, r.samples) == (lanes, 256)
    assert [f"RX {dead} " in remark for remark in r.remarks] == [True]


def test_whole_packets_in_a_file_are_not_taken_for_samples(tmp_path):
    """A program that writes packets as they come leaves ten bytes of counters before every 1456 of payload."""
    data = row(4, False).tobytes()
    starts = range(0, len(data), 1456)
    packets = [dca1000.encode_packet(9 + k, 70_000 + a, data[a : a + 1456]) for k, a in enumerate(starts)]
    path = tmp_path / "x.bin"
    path.write_bytes(b"".join(packets))
    r = inspect_bin(path)
    assert (r.lanes, r.samples, r.chirps, r.bytes) == (4, 256, 32, len(data))
    assert ["whole packets" in remark for remark in r.remarks] == [True]
    path.write_bytes(data)
    assert inspect_bin(path).remarks == []


def test_shape_of_the_rig_file():
    rig = published_rig()
    assert Shape.of_instrument(rig) == Shape(4, True, 256)
    assert Shape.of_instrument(rig).chirp_bytes == rig.frame_bytes


@pytest.mark.parametrize("kind", ["complex", "real"])
def test_plot(tmp_path, kind):
    path, png = tmp_path / "x.bin", tmp_path / "x.png"
    (row(4, False) if kind == "complex" else real_row(4)).tofile(path)
    plot_profile(inspect_bin(path), png)
    assert png.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    with pytest.raises(DataError):
        plot_profile(inspect_bin(path), tmp_path / "absent" / "x.png")


def test_of_a_huge_file_only_the_beginning_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("polysight.host.capture.inspect.MAX_BYTES", 1 << 20)
    path = tmp_path / "x.bin"
    row(4, False).tofile(path)
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


def test_too_small_or_absent(tmp_path):
    (tmp_path / "x.bin").write_bytes(b"")
    with refused(ErrorCode.NOT_ENOUGH_DATA):
        inspect_bin(tmp_path / "x.bin")
    with refused(ErrorCode.FILE_UNREADABLE):
        inspect_bin(tmp_path / "absent.bin")


@pytest.mark.parametrize(("order", "magic", "tick"), [("<", 0xA1B2C3D4, 1000), (">", 0xA1B23C4D, 1)])
def test_pcap_forms(tmp_path, order, magic, tick):
    write_pcap(tmp_path / "x.pcap", [b"hello", b"x" * 100], order, magic)
    found = list(read_pcap(tmp_path / "x.pcap"))
    assert [d.payload for d in found] == [b"hello", b"x" * 100]
    assert found[0].t_ns == 100 * 10**9 + 5 * tick
    assert found[0].source == ("192.168.33.180", 1024)


def test_lost_packets_of_a_pcap_are_masked_and_reported(tmp_path):
    data = row(4, False).tobytes()
    count, sequence = 2**48 - 30_000, 2**32 - 3
    starts = range(0, len(data), 1456)
    packets = [dca1000.encode_packet(sequence + k, count + a, data[a : a + 1456]) for k, a in enumerate(starts)]
    write_pcap(tmp_path / "x.pcap", [*packets[:5], *packets[6:], packets[4]])
    r = inspect_pcap(tmp_path / "x.pcap")
    assert r.card is not None
    assert r.card.record is not None
    assert r.card.record.missing == [(5 * 1456, 6 * 1456)]
    assert r.card.record.counts.duplicates == 1
    assert (r.lanes, r.samples, r.chirps) == (4, 256, 32)
    assert "1456 bytes are missing" in main_text(r)


@pytest.mark.parametrize("size", [0, 3, 10, 30, 60])
def test_truncated_pcap_is_refused(tmp_path, size):
    write_pcap(tmp_path / "x.pcap", [b"hello"])
    path = tmp_path / "y.pcap"
    path.write_bytes((tmp_path / "x.pcap").read_bytes()[:size])
    with pytest.raises(DataError):
        list(read_pcap(path))


@needs_real
def test_real_record():
    r = inspect_pcap(REAL_CAPTURES / "test_one_frame.pcap")
    assert (r.lanes, r.chirps * r.rx, r.samples, r.q_first) == (2, 16, 256, True)
    assert (r.peak_bin, round(r.peak_db)) == (59, 47)
    assert r.card is not None
    assert r.card.record is not None
    assert r.card.record.complete
    assert r.card.record.counts.placed == 12
    assert r.card.tail_bytes == 16384 - 11 * 1456
    assert r.card.tail_after_s == pytest.approx(2.0, abs=0.001)
    assert r.card.status == Status.RECORD_COMPLETED
    assert ("RECORD_START", 0) in r.card.replies


@needs_real
def test_real_commands():
    r = inspect_pcap(REAL_CAPTURES / "test_cmd.pcap")
    assert r.card is not None
    assert r.card.version == "2.8"
    names = [name for name, _ in r.card.replies]
    assert len(names) == 10
    assert {"RESET_FPGA", "RECORD_START", "RECORD_STOP", "CONFIGURE_PACKET", "ALIVE", "VERSION"} <= set(names)
    assert "2.8" in main_text(r)


def npy() -> bytes:
    out = io.BytesIO()
    np.save(out, np.zeros(3))
    return out.getvalue()


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (npy(), "a numpy array"),
        ("# Überschrift\n".encode() * 40, "text"),
        (("ä" * 400).encode()[:511], "text"),  # cut within a character
        (b"\x89PNG\r\n", "a picture (PNG)"),
        (b"", "empty"),
        (bytes(range(256)), "unknown bytes"),
    ],
)
def test_other_files_are_recognised_by_their_first_bytes(head, kind):
    assert kind_of(head) == kind
