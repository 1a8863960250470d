"""The pages in docs/spec agree with the code, for authors of other programs that use these formats.

Bytes of an example are decoded by the code to the values on the page, or the code encodes the values to these bytes.
Tables name every message, field, status bit, event and address that the code has.
"""

import itertools
import json
import re
import struct
from typing import get_args

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
    rows = []
    for line in section.splitlines():
        if line.startswith("| "):
            cells = line.strip("|").split("|")
            rows.append([cell.strip() for cell in cells])
    return rows


def read_shown_bytes(page: str, *labels: str) -> bytes:
    """The hexadecimal bytes of an example: those that follow these labels at the start of a line of a page."""
    label = " +".join(map(re.escape, labels))
    match = re.search(rf"^{label} +((?:[0-9a-f]{{2,12}} ?)+)(?: |$)", read_page_text(page), re.MULTILINE)
    assert match, labels
    return bytes.fromhex(match[1])


# --- Pi and host ------------------------------------------------------------------------------------------------------

UNPACK_FUNCTIONS = {
    "event": messages.unpack_event,
    "command": messages.unpack_command,
    "reply": messages.unpack_reply,
}
# Size, sequence number and checksum, 4 bytes each, before an event in the Pi's journal.
JOURNAL_HEADER = struct.Struct("<III")


def read_wire_examples() -> list[tuple[str, bytes, dict[str, object]]]:
    """Kind, bytes and content of each example: a `hex` block, and the `json` block after it."""
    examples = []
    blocks = read_page(SPEC / "wire.md").blocks
    for block, next_block in itertools.pairwise(blocks):
        if block.language == "hex":
            _, kind = block.info
            examples.append((kind, bytes.fromhex(block.text), json.loads(next_block.text)))
    return examples


@pytest.mark.parametrize(
    ("kind", "raw", "content"),
    read_wire_examples(),
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_bytes_of_a_wire_example_are_decoded_to_its_json(kind, raw, content):
    if kind == "journal":
        size, seq, crc = JOURNAL_HEADER.unpack_from(raw)
        event = raw[JOURNAL_HEADER.size :]
        packed_seq = struct.pack("<I", seq)
        assert size == len(event)
        assert crc == messages.zlib.crc32(packed_seq + event)
        assert seq == content["seq"]
        message = messages.unpack_event(event)
    else:
        message = UNPACK_FUNCTIONS[kind](raw)
    decoded = msgspec.to_builtins(message)
    # The page need not show fields that later minor versions added.
    assert {key: decoded[key] for key in content} == content
    assert {"type", "version"} <= set(content)


def test_there_are_examples_of_every_kind():
    assert {kind for kind, _, _ in read_wire_examples()} == {"event", "command", "reply", "journal"}


def list_message_types() -> list[type[msgspec.Struct]]:
    types: list[type[msgspec.Struct]] = []
    for union in (messages.AnyEvent, messages.AnyCommand, messages.AnyReply):
        types += get_args(union)
    return types


MESSAGE_TYPES = list_message_types()


@pytest.mark.parametrize("message", MESSAGE_TYPES)
def test_the_page_names_every_message_and_field(message):
    lines = [line for line in read_page_text("wire.md").splitlines() if f"`{message.__name__}`" in line]
    assert lines, message
    lines_of_message = "\n".join(lines)
    # Fields of every message, and of every event, are described once on the page.
    common_fields = {"version"}
    if issubclass(message, messages.Event):
        common_fields |= {field.encode_name for field in msgspec.structs.fields(messages.Event)}
    for field in msgspec.structs.fields(message):
        if field.encode_name not in common_fields:
            assert f"`{field.encode_name}`" in lines_of_message, field.encode_name


@pytest.mark.parametrize("message", MESSAGE_TYPES)
def test_fields_with_a_unit_of_length_speed_or_time_are_floats_and_no_others(message):
    """The page says so: their names end in _mm, _mm_s or _us."""
    for field in msgspec.structs.fields(message):
        # A float with bounds is `Annotated[float, ...]`.
        is_float = getattr(field.type, "__origin__", field.type) is float
        assert is_float == field.name.endswith(("_mm", "_mm_s", "_us")), field.name


@pytest.mark.parametrize("message", MESSAGE_TYPES)
def test_the_page_lists_every_field_that_may_be_left_out(message):
    after_the_heading = read_page_text("wire.md").split("These may be left out:")[1]
    optional_fields = after_the_heading.split("\n*")[0]
    for field in msgspec.structs.fields(message):
        if field.default is not msgspec.NODEFAULT and field.name != "version":
            assert f"`{field.encode_name}`" in optional_fields, field.encode_name


# --- stage line -------------------------------------------------------------------------------------------------------


def test_the_stage_line_example_numbers_its_commands_and_answers_each_of_them():
    after_the_heading = read_page_text("stage-line.md").split("## Example")[1]
    _, example, *_ = after_the_heading.split("```")
    commands = []
    replies = []
    # Lines to the stage begin with ->, lines from it with <-; all end in a checksum.
    for line in re.findall(r"^(?:->|<-) \S.*\*[0-9A-F]{4}$", example, re.MULTILINE):
        direction, text = line.split(" ", 1)
        raw = text.encode("ascii") + b"\n"
        if direction == "->":
            command = stage_line.Command.decode(raw)
            assert command.encode() == raw
            commands.append(command)
        else:
            reply = stage_line.Reply.decode(raw)
            assert reply.encode() == raw
            replies.append(reply)
    numbers_of_commands = [command.sequence for command in commands]
    assert numbers_of_commands == list(range(1, len(commands) + 1))
    assert {reply.sequence for reply in replies if reply.kind in ("ok", "error")} == set(numbers_of_commands)
    assert {reply.kind for reply in replies} == {"banner", "ok", "done", "status", "error"}


# --- capture card -----------------------------------------------------------------------------------------------------


def test_the_code_encodes_the_requests_to_a_card_that_the_page_shows():
    packet_configuration = dca1000.encode_packet_configuration(packet_bytes=1470, delay_us=25.0)
    requests = {
        ("record start", "request"): (dca1000.Code.RECORD_START, b""),
        ("configure FPGA", "request"): (dca1000.Code.CONFIGURE_FPGA, dca1000.encode_fpga_configuration()),
        ("packets", "request"): (dca1000.Code.CONFIGURE_PACKET, packet_configuration),
        ("version", "request"): (dca1000.Code.VERSION, b""),
    }
    for labels, (code, data) in requests.items():
        assert read_shown_bytes("dca1000.md", *labels) == dca1000.encode_request(code, data)
    rig = load_instrument(ROOT / "instrument.toml")
    settings = EepromSettings.of_board(rig.by_name("RH"), "12:34:56:78:90:13")
    request = dca1000.encode_request(dca1000.Code.CONFIGURE_EEPROM, settings.encode())
    assert read_shown_bytes("dca1000.md", "EEPROM of RH", "request") == request


def test_the_code_decodes_the_replies_of_a_card_that_the_page_shows():
    lines = re.findall(r"^ +reply +([0-9a-f ]+)$", read_page_text("dca1000.md"), re.MULTILINE)
    replies = [dca1000.decode_reply(bytes.fromhex(line)) for line in lines]
    record_start, configure_fpga, version = replies
    success = 0
    assert (record_start.code, record_start.status) == (dca1000.Code.RECORD_START, success)
    assert (configure_fpga.code, configure_fpga.status) == (dca1000.Code.CONFIGURE_FPGA, success)
    assert version.code == dca1000.Code.VERSION
    assert str(dca1000.decode_version(version.status)) == "2.8"
    completed = dca1000.decode_reply(read_shown_bytes("dca1000.md", "record completed", "status"))
    assert (completed.code, completed.status) == (dca1000.Code.STATUS, dca1000.Status.RECORD_COMPLETED)


def test_the_page_has_the_number_and_name_of_every_status_bit_of_a_card():
    bits = dict(re.findall(r"\| (\d+) \| ([A-Z_]+) (?=\|)", read_page_text("dca1000.md")))
    expected_bits = {}
    for status in dca1000.Status:
        bit_number = status.value.bit_length() - 1
        expected_bits[str(bit_number)] = status.name
    assert bits == expected_bits


@pytest.mark.parametrize(("label", "number"), [("first", 1), ("second", 2), ("46th", 46)])
def test_the_packet_headers_on_the_page_count_packets_from_1_and_bytes_from_0(label, number):
    header = read_shown_bytes("dca1000.md", label)
    payload = b"x"
    sequence, byte_count = dca1000.decode_packet_header(header + payload)
    assert sequence == number
    assert byte_count == (number - 1) * dca1000.MAX_PAYLOAD_BYTES


# --- radar link -------------------------------------------------------------------------------------------------------


def format_number(number: int) -> str:
    """The number of a message as the page writes it."""
    return f"0x{number:04X}"


def test_the_page_shows_the_messages_that_configure_a_radar_of_the_published_rig_in_their_order():
    rig = make_native_rig()
    board_program = make_program(rig, rig.by_name("RH"))
    sent: list[Command] = [
        DEVICE_CONFIGURATION,
        *board_program.basic,
        *board_program.waveform,
        *board_program.make_frame_commands(rig.grid.columns * rig.burst.pulses),
    ]
    # Columns of the table: number, name, fields, content for the published rig.
    contents = {number: content for number, _, _, content in read_table_rows("mmwavelink.md", "Sub-blocks")}
    for message in sent:
        number = format_number(message.ID)
        if contents[number] == "see below":
            raw = read_shown_bytes("mmwavelink.md", number)
        else:
            raw = bytes.fromhex(contents[number].strip("`"))
        assert raw == message.block().data, number
    order_on_page = list(contents)
    places_on_page = [order_on_page.index(format_number(message.ID)) for message in sent]
    assert places_on_page == sorted(places_on_page)


def test_the_page_names_every_message_that_is_sent_to_a_radar():
    numbers = set()
    for value in vars(commands).values():
        is_class_of_commands = isinstance(value, type) and isinstance(getattr(value, "ID", None), int)
        if is_class_of_commands or isinstance(value, commands.ConstantCommand):
            numbers.add(value.ID)
    # With fewer the search has missed some.
    assert len(numbers) > 20
    page = read_page_text("mmwavelink.md")
    assert not [hex(number) for number in numbers if format_number(number) not in page]


@pytest.mark.parametrize(
    ("label", "sequence", "action"),
    # Action 1 starts frames; 4 ends the wait for triggers.
    [("frame start", 3, 1), ("stop 4", 4, 4)],
)
def test_the_code_decodes_the_messages_with_header_and_checksum_that_the_page_shows(label, sequence, action):
    message = decode(read_shown_bytes("mmwavelink.md", f"{label}, sequence {sequence}"))
    assert (message.direction, message.kind, message.sequence) == (Direction.HOST_TO_RF, Kind.COMMAND, sequence)
    frame_control = 0x0140
    reserved = 0
    assert message.blocks == (SubBlock(frame_control, struct.pack("<HH", action, reserved)),)


def test_the_page_has_the_number_and_name_of_every_event_of_a_radar_and_says_whether_it_is_fatal():
    _, _, *rows = read_table_rows("mmwavelink.md", "Events")
    name_by_number = {int(number, 16): name for number, name, _, _ in rows}
    assert name_by_number == {number: name for number, (name, _) in radar_messages._EVENTS.items()}
    for number, _, _, fatal in rows:
        # The first byte of a fault is its type; faults of type 255 are never fatal. The data of other events are groups
        # of 32 bits, and the same bytes set some of these bits.
        data_of_each_type = [bytes([event_type, 0, 0, 0] * 6) for event_type in range(255)]
        events = [decode_event(SubBlock(int(number, 16), data)) for data in data_of_each_type]
        assert any(event.fatal for event in events) == (fatal != "no"), number


@pytest.mark.parametrize("page", sorted(path.name for path in SPEC.glob("*.md")))
def test_pages_name_files_that_exist(page):
    path_in_backticks = r"`((?:host|shared|simulators|pi_controller|arduino_stage|tests)/[\w/.]+\w)`"
    for path in re.findall(path_in_backticks, read_page_text(page)):
        assert (ROOT / path).exists(), path


# --- requests of the operator's page ----------------------------------------------------------------------------------


def test_every_request_to_the_server_is_described(tmp_path):
    site = Site(Scans(tmp_path), Watches(control=True))
    front = Front(site.scans, Access(), starts=True, reader=make_reader_app(site), stage=StageControl(tmp_path))
    routes = [*make_app(front).routes, *reading_routes(site), *command_routes(site)]
    # One process passes all other requests on to another process.
    forwarded = "/api/{path:path}"
    for method in ("GET", "POST"):
        served = set()
        for route in routes:
            if isinstance(route, Route) and method in (route.methods or ()) and route.path.startswith("/api/"):
                served.add(route.path)
        described = set()
        for first_cell, *_ in read_table_rows("requests.md", method):
            described |= set(re.findall(r"`(/api/[^`]+)`", first_cell))
        assert described == served - {forwarded}


@pytest.mark.parametrize("part", [ScanList, ListedScan])
def test_every_key_of_the_list_of_scans_is_described(part):
    described = set()
    for first_cell, *_ in read_table_rows("requests.md", "The list and its changes"):
        described |= set(re.findall(r"`(\w+)`", first_cell))
    assert {field.encode_name for field in msgspec.structs.fields(part)} <= described
