"""`polysight radar`: the plan without a board, a board checked step by step, firmware, traces and their replay."""

import json
import os
import re
from pathlib import Path

import msgspec
import pytest
import tomli_w
from tests.support.radar.boards import change_radar_table

from polysight.cli.main import main
from polysight.radar.commands import make_program
from polysight.radar.diagnosis import ReplayedWords
from polysight.radar.messages import decode
from polysight_shared.errors import DeviceError
from polysight_shared.tables import to_builtins
from polysight_simulators.radars import RadarBoard, make_image
from polysight_simulators.radars.__main__ import replay
from polysight_simulators.radars.cores import BOOT_S, FAULT_DATA

# Exit statuses of `polysight`
SUCCESS = 0
NOT_PASSED = 1
REFUSED = 2
UNUSABLE_FILE = 3
INTERRUPTED = 130

# First bytes of each message of the host, and of each message of a board
HOST_SYNC = "34122143"
BOARD_SYNC = "badccdab"

# Steps of `polysight radar check`, in order.
STEPS = ["USB", "reset", "power rails", "firmware", "RF power-up", "versions", "settings", "RF init", "chirp", "die id"]
STEPS += ["one frame", "read back"]


@pytest.fixture
def rig_file(rig, tmp_path):
    def write(changed=rig):
        path = tmp_path / "rig.toml"
        path.write_text(tomli_w.dumps(to_builtins(changed)), encoding="utf-8")
        return path

    return write


@pytest.fixture
def opened_boards(words, clock, monkeypatch):
    """Each opening of a board by the command: its address, and True if slowly.

    In place of any board the simulated board `RH` is opened.
    """
    places = []

    def open_board(place, slow):
        places.append((place, slow))
        return words

    monkeypatch.setattr("polysight.jobs.devices.open_board", open_board)
    monkeypatch.setattr("polysight.jobs.devices.SystemClock", lambda: clock)
    return places


def run(path, *args: str) -> int:
    return main(["radar", "--config", str(path), *args])


# Changes of a simulated board


def leave_sound(_board):
    pass


def set_wrong_jumpers(board):
    """The jumpers of a board select how it starts."""
    board.functional_jumpers = False


def switch_off(board):
    board.switch_power(False)


def erase_flash(board):
    board.cores.flash = b""


def damage_memory(board):
    # Bit of the boot status: the memory was not initialised.
    board.cores.hardware_bits = 1 << 55


def unplug(board):
    board.plugged = False


def test_the_plan_lists_every_message_of_every_board(rig, rig_file, capsys):
    assert run(rig_file(), "plan") == SUCCESS
    out = capsys.readouterr().out
    assert "BROKEN" not in out
    lines_of_messages = [line for line in out.splitlines() if HOST_SYNC in line]
    sent = [decode(bytes.fromhex(line.split()[-1])).blocks for line in lines_of_messages]
    expected = []
    for board in rig.boards:
        messages = make_program(rig, board)
        frames_of_a_row = rig.grid.columns * rig.burst.pulses
        commands = (*messages.basic, *messages.waveform, *messages.make_frame_commands(frames_of_a_row))
        expected += [(command.block(),) for command in commands]
    assert sent == expected


def test_a_sound_board_passes_every_step(rig_file, opened_boards, capsys):
    assert run(rig_file(), "check", "RH", "--json", "--slow") == SUCCESS
    result = json.loads(capsys.readouterr().out)
    assert [s["step"] for s in result["steps"]] == STEPS
    assert all(s["holds"] for s in result["steps"])
    assert result["report"]["die_id"].startswith("5eed0001")
    assert opened_boards == [("FTRH", True)]


@pytest.mark.parametrize(
    ("spoil", "step", "text"),
    [
        (set_wrong_jumpers, "reset", ("SOP0 set", "[ o=o ]", "5 V")),
        (switch_off, "reset", ("no power",)),
        (erase_flash, "versions", ("no patch", "radar.firmware")),
        (damage_memory, "firmware", ("memory not initialised",)),
        (unplug, "reset", ("unplugged",)),
    ],
)
@pytest.mark.usefixtures("opened_boards")
def test_a_failed_step_is_reported_with_what_was_expected_and_a_remedy(rig_file, board, capsys, spoil, step, text):
    spoil(board)
    assert run(rig_file(), "check", "RH") == NOT_PASSED
    out = capsys.readouterr().out
    failed = [line for line in out.splitlines() if "FAILED" in line]
    assert len(failed) == 1
    assert step in failed[0]
    assert "expected: " in out
    assert "do: " in out
    assert all(w in out for w in text)


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [
        ("burst", "pulses", 200),
        ("radar", "rx_gain_db", -1),
        ("radar", "idle_us", 1e6),
        ("chirp", "hpf1_khz", 0.0),
    ],
)
def test_a_plan_with_a_broken_constraint_fails_without_opening_a_board(
    rig, rig_file, opened_boards, capsys, table, key, value
):
    part = msgspec.structs.replace(getattr(rig, table), **{key: value})
    path = rig_file(msgspec.structs.replace(rig, **{table: part}))
    assert run(path, "plan") == NOT_PASSED
    out = capsys.readouterr().out
    assert "BROKEN" in out
    assert HOST_SYNC not in out
    assert run(path, "check", "RH") == REFUSED
    assert "the radars would refuse" in capsys.readouterr().err
    assert opened_boards == []


@pytest.mark.usefixtures("opened_boards")
def test_firmware_goes_to_ram_and_to_the_flash_only_with_the_option_flash(rig_file, words, board, capsys, tmp_path):
    board.cores.flash = b""
    image = tmp_path / "image.bin"
    image.write_bytes(make_image())
    assert run(rig_file(), "firmware", "RH", str(image)) == SUCCESS
    assert "not written" in capsys.readouterr().out
    assert board.cores.flash == b""
    assert run(rig_file(), "firmware", "RH", str(image), "--flash") == SUCCESS
    assert "patch 2.2.2.0 from flash" in capsys.readouterr().out
    assert board.cores.flash == make_image()
    assert words.closed


def test_a_file_that_is_not_an_image_is_refused_without_opening_a_board(rig_file, opened_boards, capsys, tmp_path):
    image = tmp_path / "notes.txt"
    image.write_text("not firmware")
    for options in ((), ("--flash",)):
        assert run(rig_file(), "firmware", "RH", str(image), *options) == REFUSED
        assert "is not firmware" in capsys.readouterr().err
    assert opened_boards == []


def test_an_unknown_board_is_refused(rig_file, capsys):
    assert run(rig_file(), "check", "XX") == REFUSED
    assert "no board 'XX'" in capsys.readouterr().err


def test_a_rig_without_native_boards_is_refused(rig, rig_file, capsys):
    path = rig_file(msgspec.structs.replace(rig, radar=type(rig.radar)()))
    for description in (("plan",), ("check", "RH")):
        assert run(path, *description) == REFUSED
        assert "usb_serial" in capsys.readouterr().err


@pytest.mark.parametrize("change", [leave_sound, erase_flash, set_wrong_jumpers])
@pytest.mark.usefixtures("opened_boards")
def test_a_replayed_trace_has_the_same_result(rig_file, board, capsys, tmp_path, change):
    change(board)
    trace = str(tmp_path / "day.jsonl")
    status = run(rig_file(), "check", "RH", "--trace", trace)
    result = [line for line in capsys.readouterr().out.splitlines() if line.startswith("RH")]
    assert run(rig_file(), "replay", trace) == status
    second_lines = capsys.readouterr().out.splitlines()
    assert [line for line in second_lines if line.startswith("RH")] == result
    assert second_lines[0].startswith("replayed from")


@pytest.mark.parametrize("after_s", [0.0, 1e-4, 1.5e-3, 5e-3, 0.02, 0.5])
@pytest.mark.parametrize("look_s", [0.0, 1.25e-4, 1e-3])
def test_an_event_at_any_time_after_power_up_replays(
    rig_file, words, board, clock, capsys, tmp_path, opened_boards, look_s, after_s
):
    """A trace counts queries, because each takes time over USB: in a replay the line rises at the same query."""
    del opened_boards
    read_line = words.interrupt
    boot = board.cores.boot

    def read_line_slowly():
        clock.sleep(look_s)
        return read_line()

    def boot_with_event():
        boot()
        board.cores.event(0x5002, FAULT_DATA, BOOT_S + after_s)

    board.cores.fault_at = "never"
    words.interrupt = read_line_slowly
    board.cores.boot = boot_with_event
    trace = str(tmp_path / "day.jsonl")
    assert run(rig_file(), "check", "RH", "--trace", trace) == SUCCESS
    result = [line for line in capsys.readouterr().out.splitlines() if line.startswith("RH")]
    assert run(rig_file(), "replay", trace) == SUCCESS
    assert [line for line in capsys.readouterr().out.splitlines() if line.startswith("RH")] == result


@pytest.mark.usefixtures("opened_boards")
def test_a_trace_has_both_directions_and_every_change_of_a_line(rig_file, tmp_path):
    trace = tmp_path / "day.jsonl"
    assert run(rig_file(), "check", "RH", "--trace", str(trace)) == SUCCESS
    lines = [json.loads(line) for line in trace.read_text().splitlines()]
    assert (lines[0]["trace"], lines[0]["board"], lines[0]["place"]) == (1, "RH", "FTRH")
    # NRST, the reset, is low while it is held. HOST_INTR is high while the board has a message.
    assert [r["level"] for r in lines if r.get("line") == "NRST"] == [0, 1]
    levels = [r["level"] for r in lines if r.get("line") == "HOST_INTR"]
    # Only changes are in the trace, so the levels alternate.
    assert levels == [n % 2 for n in range(len(levels))]
    # Each rise of the line is one message, which begins with the device's sync word.
    text = "".join(r.get("in", "") for r in lines)
    assert text.count(BOARD_SYNC) == levels.count(1)
    times = [line["t"] for line in lines[1:]]
    assert times == sorted(times)


@pytest.mark.parametrize("act", [lambda words: words.read(3), lambda words: words.write([5])], ids=["read", "write"])
def test_a_replay_names_the_line_that_differs(tmp_path, act):
    trace = tmp_path / "day.jsonl"
    lines = ('{"trace": 1}', '{"t": 0.1, "in": "01020304"}', '{"t": 0.2, "in": "0506"}')
    trace.write_text("\n".join(lines) + "\n")
    with pytest.raises(DeviceError, match=r"line 2 of the trace.*01020304"):
        act(ReplayedWords(trace))


@pytest.mark.usefixtures("opened_boards")
def test_a_replay_with_another_rig_file_reports_the_first_different_line(rig, rig_file, capsys, tmp_path):
    trace = str(tmp_path / "day.jsonl")
    assert run(rig_file(), "check", "RH", "--trace", trace) == SUCCESS
    path = rig_file(change_radar_table(rig, rx_gain_db=40))
    assert run(path, "replay", trace) == NOT_PASSED
    assert re.search(r"line \d+ of the trace", capsys.readouterr().out)


@pytest.mark.parametrize(
    "text", ["", "hello\n", "{}\n", '{"trace": 2}\n', '{"trace": 1, "board": "RH"}\n{"out": "00"}\n']
)
def test_a_file_that_is_not_a_trace_is_refused(rig_file, capsys, tmp_path, text):
    (tmp_path / "a").write_text(text)
    assert run(rig_file(), "replay", str(tmp_path / "a")) == REFUSED
    assert "--trace FILE" in capsys.readouterr().err


HEAD = '{"trace": 1, "board": "RH"}\n'
BAD_LINES = {
    "nested too deeply": "[" * 100_000,
    "not a table": "5",
    "negative time": '{"t": -5, "out": ""}',
    "infinite time": '{"t": Infinity, "out": ""}',
    "time too large": '{"t": 1e9, "out": ""}',
    "time of 400 digits": '{"t": ' + "9" * 400 + ', "out": ""}',
    "time of another type": '{"t": true, "out": ""}',
    "time before that of the line above": '{"t": 2, "out": ""}\n{"t": 1, "out": ""}',
    "nothing but a time": '{"t": 1}',
    "a line without its level": '{"t": 1, "line": "HOST_INTR"}',
    "not hexadecimal": '{"t": 1, "in": "xyz0"}',
    "bytes of another type": '{"t": 1, "out": 5}',
}


@pytest.mark.parametrize("line", BAD_LINES.values(), ids=BAD_LINES.keys())
def test_an_invalid_line_of_a_trace_is_refused_by_its_number(rig_file, capsys, tmp_path, line):
    (tmp_path / "a").write_text(HEAD + line + "\n")
    assert run(rig_file(), "replay", str(tmp_path / "a")) == REFUSED
    assert re.search(r"a: line [23]", capsys.readouterr().err)


@pytest.mark.parametrize("kind", ["device", "pipe", "sparse", "folder"])
def test_devices_pipes_folders_and_huge_files_are_refused_unread(rig, rig_file, capsys, tmp_path, opened_boards, kind):
    path = tmp_path / "odd"
    if kind == "device":
        path = Path("/dev/zero")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        with path.open("wb") as file:
            file.truncate(3 * 2**30)
    text = "bytes" if kind == "sparse" else "not a regular file"
    rig_path = rig_file()
    for arguments in (("firmware", "RH", str(path)), ("replay", str(path))):
        assert run(rig_path, *arguments) == UNUSABLE_FILE
        assert text in capsys.readouterr().err
    rig_with_firmware = change_radar_table(rig, firmware=str(path))
    assert run(rig_file(rig_with_firmware), "check", "RH") == UNUSABLE_FILE
    assert text in capsys.readouterr().err
    assert opened_boards == []


def test_an_existing_trace_is_not_overwritten(rig_file, opened_boards, capsys, tmp_path):
    trace = tmp_path / "day.jsonl"
    trace.write_text("of another day")
    assert run(rig_file(), "check", "RH", "--trace", str(trace)) == REFUSED
    assert "exists already" in capsys.readouterr().err
    assert trace.read_text() == "of another day"
    assert opened_boards == []


@pytest.mark.usefixtures("opened_boards")
def test_an_interrupted_flash_write_reports_the_parts_written(rig_file, words, board, capsys, tmp_path):
    image = tmp_path / "image.bin"
    image.write_bytes(make_image())
    write = words.write
    calls = []

    def stop_at_part_7(sent):
        # The first word of a command's sync word
        if sent[0] == 0x1234:
            calls.append(sent)
        # The first command is the question for the version.
        if len(calls) == 1 + 7:
            raise KeyboardInterrupt
        write(sent)

    words.write = stop_at_part_7
    assert run(rig_file(), "firmware", "RH", str(image), "--flash") == INTERRUPTED
    assert "6 of 35 parts" in capsys.readouterr().err
    assert board.cores.flash != make_image()


@pytest.mark.usefixtures("opened_boards")
def test_a_truncated_trace_replays_to_its_end(rig_file, capsys, tmp_path):
    trace = tmp_path / "day.jsonl"
    assert run(rig_file(), "check", "RH", "--trace", str(trace)) == SUCCESS
    data = trace.read_bytes()
    for size in range(200, len(data), len(data) // 15):
        (tmp_path / "cut").write_bytes(data[:size])
        capsys.readouterr()
        assert run(rig_file(), "replay", str(tmp_path / "cut")) == NOT_PASSED
        assert "the trace ends here" in capsys.readouterr().out


@pytest.mark.usefixtures("opened_boards")
def test_a_trace_is_replayed_to_a_simulated_board(rig_file, tmp_path):
    trace = tmp_path / "day.jsonl"
    assert run(rig_file(), "check", "RH", "--trace", str(trace)) == SUCCESS
    differences_of_equal_board = replay(trace, lambda now: RadarBoard(now, flash=make_image()))
    assert differences_of_equal_board == []
    differences_of_board_without_firmware = replay(trace, RadarBoard)
    assert differences_of_board_without_firmware
