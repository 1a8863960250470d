"""Files of the project can be read without it, with numpy.fromfile, json and msgpack."""

import hashlib
import json
import socket
import struct
import zlib
from pathlib import Path

import msgpack
import numpy as np
from tests.support.capture.records import encode_packets
from tests.support.processes import wait_for
from tests.support.rigs import load_published_rig
from tests.support.scenes import COPPER, make_scene

from polysight.capture.dca1000 import decode_packet_header
from polysight.capture.receiver import ReceiverProcess
from polysight.store.logs import EventWriter
from polysight.store.manifest import ManifestWriter
from polysight_pi.journal import JournalFile
from polysight_shared.messages import Capture, RunStopped, pack
from polysight_simulators.scene import decode_scene, simulate

FRAMES = 96
SAMPLES = 256


def read_row(path: Path) -> tuple[dict, np.ndarray, np.ndarray]:
    """Index, arrivals and samples of a row, read as docs/spec describes: complex [rx, frame, sample]."""
    words = np.fromfile(path, dtype="<i2").reshape(-1, SAMPLES, 2, 4)
    samples = (words[:, :, 0, :] + 1j * words[:, :, 1, :]).transpose(2, 0, 1)
    with path.with_suffix(".idx").open("rb") as f:
        index = json.loads(f.readline())
        arrivals = np.fromfile(f, dtype="<i8").reshape(-1, 2)
    return index, arrivals, samples


def take_crc(fact: dict) -> None:
    """Check and remove the checksum of a manifest line."""
    crc = fact.pop("crc")
    assert crc == f"{zlib.crc32(json.dumps(fact, sort_keys=True, separators=(',', ':')).encode()):08x}"


def read_events(path: Path) -> list[dict]:
    """Events of a log, their checksums verified and removed."""
    with path.open("rb") as f:
        events = list(msgpack.Unpacker(f))
    for event in events:
        assert event.pop("crc") == zlib.crc32(msgpack.packb(event))
    return events


def test_a_row_and_its_index_are_read(board, tmp_path):
    """One packet was lost: the frames that it touches are missing, the others have the samples that were sent."""
    rng = np.random.default_rng(3)
    counts = rng.integers(-900, 900, (2, 4, FRAMES, SAMPLES))
    truth = counts[0] + 1j * counts[1]
    sent = counts.transpose(2, 3, 0, 1).astype("<i2").tobytes()
    lost_range = (20 * 1456, 21 * 1456)
    path = tmp_path / "0000.bin"
    with ReceiverProcess(board, 1 << 20) as receiver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as card:
        card.bind((board.card_address, 1024))
        receiver.begin_row(0, 1, len(sent), 4096, path, after_reset=True)
        for packet in encode_packets(sent, 1, 0):
            if decode_packet_header(packet)[1] != lost_range[0]:
                card.sendto(packet, (board.host_address, board.data_port))
        wait_for(lambda: receiver.report().received == len(sent) - 1456, "packets")
        row = receiver.end_row()
    index, arrivals, samples = read_row(path)
    assert index["missing"] == [list(lost_range)]
    assert (index["expected"], index["received"], index["gaps"]) == (len(sent), len(sent) - 1456, 1)
    assert arrivals[-1].tolist() == [row.last_arrival_ns, len(sent)]
    assert zlib.crc32(path.read_bytes()) == row.crc32
    # A frame has 4096 bytes. The lost ones, 29,120 to 30,575, are all in frame 7.
    is_present = np.ones(FRAMES, dtype=bool)
    is_present[lost_range[0] // 4096 : (lost_range[1] - 1) // 4096 + 1] = False
    assert is_present.sum() == FRAMES - 1
    np.testing.assert_array_equal(samples[:, is_present], truth[:, is_present])


def test_an_event_log_is_read(tmp_path):
    fields = ("row_index", "take", "point", "column", "edge_ns", "first_pulse_ns", "last_pulse_ns", "pulses")
    rest = {"scan_id": "s", "t_mono_ns": 5, "width_max_ns": 3, "jitter_ns": 7, "pulses_seen": True}
    sent = [{"seq": k + 1} | rest | {name: k * 10**9 + n for n, name in enumerate(fields)} for k in range(5)]
    path = tmp_path / "events.msgpack"
    writer = EventWriter(path)
    for event in sent:
        writer.append(Capture(**event))
    writer.sync()
    writer.close()
    events = read_events(path)
    assert [event.pop("version") for event in events] == ["1.0"] * 5
    assert events == [{"type": "Capture"} | event for event in sent]


def test_a_manifest_is_read_with_its_checksums_and_chain(tmp_path):
    facts = [
        {"fact": "scan_started", "scan_id": "s"},
        {"fact": "row_committed", "row": 3, "boards": {"RH": {"n": 1.5}}},
    ]
    with ManifestWriter(tmp_path / "manifest.jsonl", create=True) as writer:
        for fact in facts:
            writer.append(fact)
    lines = (tmp_path / "manifest.jsonl").read_bytes().splitlines()
    lines_as_facts = [json.loads(line) for line in lines]
    for count, fact in enumerate(lines_as_facts):
        take_crc(fact)
        assert fact.pop("count") == count
        assert fact.pop("previous") == (hashlib.sha256(lines[count - 1]).hexdigest()[:16] if count else "")
    assert lines_as_facts == facts


def test_all_files_of_a_simulated_scan_folder_are_read(tmp_path):
    folder = simulate(load_published_rig(), decode_scene(make_scene(COPPER, columns=3, rows=2), "t"), tmp_path / "scan")
    facts = [json.loads(line) for line in (folder / "manifest.jsonl").read_text("ascii").splitlines()]
    for fact in facts:
        take_crc(fact)
    plan = facts[0]["plan"]
    rows = {fact["row"]: fact for fact in facts if fact["fact"] == "row_committed"}
    assert sorted(rows) == list(range(plan["rows"]))
    for fact in rows.values():
        for board in fact["boards"].values():
            index, _, samples = read_row(folder / board["file"])
            assert zlib.crc32((folder / board["file"]).read_bytes()) == int(board["crc32"], 16)
            assert index["missing"] == []
            assert samples.shape == (4, fact["pulses"], SAMPLES)
            # There is a signal.
            assert np.abs(samples).mean() > 100
    events = read_events(folder / "events.msgpack")
    assert [event["seq"] for event in events] == list(range(1, len(events) + 1))
    # Odd rows run towards -x.
    points = [event["column"] for event in events if event["type"] == "Capture" and event["row_index"] == 1]
    assert points == list(reversed(range(plan["columns"])))


def test_a_journal_is_read(tmp_path):
    """The magic, then for each event its length, number and CRC-32 of number and payload, and the event itself."""
    journal = JournalFile(tmp_path / "s.journal")
    sent = [{"scan_id": "s", "seq": k, "t_mono_ns": k, "exit_status": "abort", "reason": "x" * k} for k in (1, 2, 3)]
    journal.write([pack(RunStopped(**event)) for event in sent])
    journal.close()
    raw = (tmp_path / "s.journal").read_bytes()
    assert raw[:8] == b"PSJRNL1\n"
    offset = 8
    collected = []
    while offset < len(raw):
        length, seq, crc = struct.unpack_from("<III", raw, offset)
        payload = raw[offset + 12 : offset + 12 + length]
        assert crc == zlib.crc32(struct.pack("<I", seq) + payload)
        collected.append(msgpack.unpackb(payload))
        offset += 12 + length
    assert collected == [{"type": "RunStopped", "version": "1.0", **event} for event in sent]
