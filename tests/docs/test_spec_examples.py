"""The bytes on the pages agree with their text: the code decodes them, or makes the same."""

import itertools
import json
import re
import struct
from pathlib import Path

import msgspec
import pytest
from docs.check.pages import ROOT, read_page
from starlette.routing import Route
from tests.support.radar.boards import make_native_rig

from polysight.capture import dca1000
from polysight.capture.card import EepromSettings
from polysight.catalogue import Scans
from polysight.radar import commands, messages as radar_messages
from polysight.radar.commands import DEVICE_CONFIGURATION, Command, make_program
from polysight.radar.messages import Direction, Kind, SubBlock, decode, decode_event
from polysight.serve.commands import command_routes
from polysight.serve.front import Front, make_app
from polysight.serve.guard import Access
from polysight.serve.reading import ScanList, reading_routes
from polysight.serve.server import make_reader_app
from polysight.serve.site import ListedScan, Site, Watches
from polysight.serve.stage import StageControl
from polysight_shared import messages, stage_line
from polysight_shared.config import load_instrument

SPEC = ROOT / "docs/spec"


def read_page_text(page: str) -> str:
    return (SPEC / page).read_text(encoding="utf-8")


def read_table_rows(page: str, heading: str) -> list[list[str]]:
    """Cells of every table row under a heading."""
    section = re.split(rf"^#+ {heading}\n", read_page_text(page), flags=re.MULTILINE)[1].split("\n#")[0]
    return [[c.strip() for c in line.strip("|").split("|")] for line in section.splitlines() if line.startswith("| ")]


def read_shown_bytes(page: str, *labels: str) -> bytes:
    """The bytes after a label (a line's first words) in a text block of a page."""
    label = " +".join(map(re.escape, labels))
    match = re.search(rf"^{label} +((?:[0-9a-f]{{2,12}} ?)+)(?: |$)", read_page_text(page), re.MULTILINE)
    assert match, labels
    return bytes.fromhex(match[1])


# --- Pi and host ------------------------------------------------------------------------------------------------------

READERS = {
    "event": messages.unpack_event, "command": messages.unpack_command, "reply": messages.unpack_reply,
    "kept": messages.unpack_with_crc,
}  # fmt: skip


def read_wire_examples() -> list[tuple[str, bytes, dict[str, object]]]:
    """(kind, bytes, content) of each `hex` block and the `json` block that follows it."""
    blocks = read_page(SPEC / "wire.md").blocks
    pairs = [(a, b) for a, b in itertools.pairwise(blocks) if a.language == "hex"]
    return [(a.info[1], bytes.fromhex(a.text), json.loads(b.text)) for a, b in pairs]


@pytest.mark.parametrize(
    ("kind", "raw", "content"), read_wire_examples(), ids=lambda v: v if isinstance(v, str) else ""
)
def test_wire_examples_hold_what_the_page_says(kind, raw, content):
    if kind == "journal":
        size, seq, crc = struct.unpack_from("<III", raw)
        assert size == len(raw) - 12
        assert crc == messages.zlib.crc32(raw[4:8] + raw[12:])
        kind = "event"
        raw = raw[12:]
        assert seq == content["seq"]
    message = msgspec.to_builtins(READERS[kind](raw))
    # Later minor versions add fields
    assert {key: message[key] for key in content} == content
    assert {"type", "version"} <= set(content)


def test_there_are_examples_of_every_kind():
    assert {kind for kind, _, _ in read_wire_examples()} == {"event", "command", "reply", "journal"}


def list_declared_types(union: object) -> list[type]:
    return list(getattr(union, "__args__", ()))


@pytest.mark.parametrize(
    "message", [m for u in (messages.AnyEvent, messages.AnyCommand, messages.AnyReply) for m in list_declared_types(u)]
)
def test_the_page_names_every_message_and_field(message):
    page = "\n".join(line for line in read_page_text("wire.md").splitlines() if f"`{message.__name__}`" in line)
    assert page, message
    if issubclass(message, messages.Event):
        common = {f.encode_name for f in msgspec.structs.fields(messages.Event)}
    else:
        common = set()
    for field in msgspec.structs.fields(message):
        assert field.encode_name in common | {"version"} or f"`{field.encode_name}`" in page, (
            message.__name__,
            field.encode_name,
        )


def test_types_follow_from_names_as_the_page_says():
    """Floats end in _mm, _mm_s or _us; everything else that is a number is an integer."""
    for union in (messages.AnyEvent, messages.AnyCommand, messages.AnyReply):
        for message in list_declared_types(union):
            for field in msgspec.structs.fields(message):
                # For any bounds
                is_float = getattr(field.type, "__origin__", field.type) is float
                assert is_float == field.name.endswith(("_mm", "_mm_s", "_us")), (message.__name__, field.name)


def test_what_may_be_left_out():
    answer = read_page_text("wire.md").split("These may be left out:")[1].split("\n*")[0]
    for union in (messages.AnyEvent, messages.AnyCommand, messages.AnyReply):
        for message in list_declared_types(union):
            for field in msgspec.structs.fields(message):
                if field.default is not msgspec.NODEFAULT and field.name != "version":
                    assert f"`{field.encode_name}`" in answer, (message.__name__, field.encode_name)


# --- stage line -------------------------------------------------------------------------------------------------------


def test_stage_line_examples_are_a_dialogue():
    example = read_page_text("stage-line.md").split("## Example")[1].split("```")[1]
    sent = []
    answered = []
    for line in re.findall(r"^(?:->|<-) \S.*\*[0-9A-F]{4}$", example, re.MULTILINE):
        raw = line[3:].encode("ascii") + b"\n"
        if line.startswith("->"):
            sent.append(stage_line.Command.decode(raw))
            assert sent[-1].encode() == raw
        else:
            answered.append(stage_line.Reply.decode(raw))
            assert answered[-1].encode() == raw
    assert [c.sequence for c in sent] == list(range(1, len(sent) + 1))
    assert {r.sequence for r in answered if r.kind in ("ok", "error")} == {c.sequence for c in sent}
    assert {r.kind for r in answered} == {"banner", "ok", "done", "status", "error"}


# --- capture card -----------------------------------------------------------------------------------------------------


def test_card_requests():
    requests = {
        ("record start", "request"): (dca1000.Code.RECORD_START, b""),
        ("configure FPGA", "request"): (dca1000.Code.CONFIGURE_FPGA, dca1000.encode_fpga_configuration()),
        ("packets", "request"): (dca1000.Code.CONFIGURE_PACKET, dca1000.encode_packet_configuration(1470, 25.0)),
        ("version", "request"): (dca1000.Code.VERSION, b""),
    }
    for labels, (code, data) in requests.items():
        assert read_shown_bytes("dca1000.md", *labels) == dca1000.encode_request(code, data)
    settings = EepromSettings.of_board(load_instrument(ROOT / "instrument.toml").by_name("RH"), "12:34:56:78:90:13")
    request = dca1000.encode_request(dca1000.Code.CONFIGURE_EEPROM, settings.encode())
    assert read_shown_bytes("dca1000.md", "EEPROM of RH", "request") == request


def test_card_replies():
    lines = re.findall(r"^ +reply +([0-9a-f ]+)$", read_page_text("dca1000.md"), re.MULTILINE)
    replies = [dca1000.decode_reply(bytes.fromhex(line)) for line in lines]
    assert [r.code for r in replies] == [5, 3, 0x0E]
    assert [r.status for r in replies[:2]] == [0, 0]
    assert str(dca1000.decode_version(replies[2].status)) == "2.8"
    ended = dca1000.decode_reply(read_shown_bytes("dca1000.md", "record completed", "status"))
    assert (ended.code, ended.status) == (dca1000.Code.STATUS, dca1000.Status.RECORD_COMPLETED)


def test_card_status_bits():
    bits = dict(re.findall(r"\| (\d+) \| ([A-Z_]+) (?=\|)", read_page_text("dca1000.md")))
    assert bits == {str(s.value.bit_length() - 1): s.name for s in dca1000.Status}


def test_data_packet_headers():
    for label, number in (("first", 1), ("second", 2), ("46th", 46)):
        header = read_shown_bytes("dca1000.md", label)
        sequence, count = dca1000.decode_packet_header(header + b"x")
        assert (sequence, count) == (number, (number - 1) * dca1000.MAX_PAYLOAD_BYTES)


# --- radar link -------------------------------------------------------------------------------------------------------


def test_sub_blocks_are_those_of_the_published_rig():
    rig = make_native_rig()
    board_program = make_program(rig, rig.by_name("RH"))
    sent: list[Command] = [
        DEVICE_CONFIGURATION,
        *board_program.basic,
        *board_program.waveform,
        *board_program.make_frame_commands(rig.grid.columns * 16),
    ]
    table = {row[0]: row[3] for row in read_table_rows("mmwavelink.md", "Sub-blocks")}
    for message in sent:
        number = f"0x{message.ID:04X}"
        answer = table[number]
        if answer == "see below":
            raw = read_shown_bytes("mmwavelink.md", number)
        else:
            raw = bytes.fromhex(answer.strip("`"))
        assert raw == message.block().data, number
    order = [row[0] for row in read_table_rows("mmwavelink.md", "Sub-blocks")]
    places = [order.index(f"0x{message.ID:04X}") for message in sent]
    assert places == sorted(places)


def test_the_page_names_every_sub_block_that_is_sent():
    page = read_page_text("mmwavelink.md")
    numbers = {c.ID for c in vars(commands).values() if isinstance(c, type) and isinstance(getattr(c, "ID", None), int)}
    bare = {c.ID for c in vars(commands).values() if isinstance(c, commands.ConstantCommand)}
    assert len(numbers | bare) > 20
    assert not [hex(n) for n in numbers | bare if f"0x{n:04X}" not in page]


def test_whole_messages():
    for label, number, message_kind in (("frame start", 3, 1), ("stop 4", 4, 4)):
        answer = decode(read_shown_bytes("mmwavelink.md", f"{label}, sequence {number}"))
        assert (answer.direction, answer.kind, answer.sequence) == (Direction.HOST_TO_RF, Kind.COMMAND, number)
        assert answer.blocks == (SubBlock(0x0140, struct.pack("<HH", message_kind, 0)),)


def test_events():
    table = {row[0]: row[1:] for row in read_table_rows("mmwavelink.md", "Events")[2:]}
    assert {int(number, 16): name for number, (name, *_) in table.items()} == {
        number: name for number, (name, _) in radar_messages._EVENTS.items()
    }
    for number, (*_, fatal) in table.items():
        answer = any(decode_event(SubBlock(int(number, 16), bytes([k, 0, 0, 0] * 6))).fatal for k in range(255))
        assert answer == (fatal != "no"), number


def test_pages_name_files_that_exist():
    for page in sorted(SPEC.glob("*.md")):
        for path in re.findall(
            r"`((?:host|shared|simulators|pi_controller|arduino_stage|tests)/[\w/.]+\w)`", read_page_text(page.name)
        ):
            assert (ROOT / Path(path)).exists(), f"{page.name} names {path}"


# --- requests of the operator's page ----------------------------------------------------------------------------------


def test_every_request_to_the_server_is_described(tmp_path):
    site = Site(Scans(tmp_path), Watches(control=True))
    front = Front(site.scans, Access(), starts=True, reader=make_reader_app(site), stage=StageControl(tmp_path))
    routes = [*make_app(front).routes, *reading_routes(site), *command_routes(site)]
    for method in ("GET", "POST"):
        served = {r.path for r in routes if isinstance(r, Route) and method in (r.methods or ())}
        described = {
            path for row in read_table_rows("requests.md", method) for path in re.findall(r"`(/api/[^`]+)`", row[0])
        }
        assert described == {path for path in served if path.startswith("/api/")} - {"/api/{path:path}"}


@pytest.mark.parametrize("part", [ScanList, ListedScan])
def test_every_key_of_the_list_of_scans_is_described(part):
    described = {
        key
        for row in read_table_rows("requests.md", "The list and its changes")
        for key in re.findall(r"`(\w+)`", row[0])
    }
    assert {field.encode_name for field in msgspec.structs.fields(part)} <= described
