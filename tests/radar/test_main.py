"""`python -m polysight.host.radar`: the plan without a board, and its refusals."""

from __future__ import annotations

import sys

import msgspec
import pytest
import tomli_w

from polysight.host.radar.__main__ import main
from polysight.host.radar.messages import decode
from polysight.host.radar.program import program
from polysight.shared.tables import to_builtins


@pytest.fixture
def rig_file(rig, tmp_path):
    def write(changed=rig):
        path = tmp_path / "rig.toml"
        path.write_text(tomli_w.dumps(to_builtins(changed)), encoding="utf-8")
        return str(path)

    return write


def run(monkeypatch, *args: str) -> int:
    monkeypatch.setattr(sys, "argv", ["radar", *args])
    return main()


def test_the_plan_is_every_message_of_every_board(rig, rig_file, monkeypatch, capsys):
    assert run(monkeypatch, "plan", rig_file()) == 0
    out = capsys.readouterr().out
    assert "BROKEN" not in out
    sent = [decode(bytes.fromhex(line.split()[-1])).blocks for line in out.splitlines() if "34122143" in line]
    expected = []
    for board in rig.boards:
        made = program(rig, board)
        expected += [(c.block(),) for c in (*made.basic, *made.waveform, *made.frames(5600))]
    assert sent == expected


def test_a_broken_constraint_shows_in_the_plan_and_keeps_boards_untouched(rig, rig_file, monkeypatch, capsys):
    path = rig_file(msgspec.structs.replace(rig, radar=msgspec.structs.replace(rig.radar, rx_gain_db=31)))
    assert run(monkeypatch, "plan", path) == 0
    assert "BROKEN  RX gain step" in capsys.readouterr().out
    monkeypatch.setattr("polysight.host.radar.__main__.open_board", lambda serial: pytest.fail(f"{serial} was opened"))
    assert run(monkeypatch, "check", path, "RH") == 2
    assert "RX gain step" in capsys.readouterr().err


def test_a_board_is_checked_and_gets_firmware(rig_file, words, board, clock, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("polysight.host.radar.__main__.open_board", lambda serial: words if serial == "FTRH" else None)
    monkeypatch.setattr("polysight.host.radar.__main__.SystemClock", lambda: clock)
    board.patch = False
    assert run(monkeypatch, "check", rig_file(), "RH") == 5
    assert "no patch" in capsys.readouterr().err
    image = tmp_path / "image.bin"
    image.write_bytes(bytes(range(256)) * 4)
    assert run(monkeypatch, "firmware", rig_file(), "RH", str(image)) == 0
    assert "RH: chirp and data path are set" in capsys.readouterr().out
    assert board.patch
    assert words.closed


def test_an_unknown_board_is_named(rig_file, monkeypatch, capsys):
    assert run(monkeypatch, "check", rig_file(), "XX") == 2
    assert "no board 'XX'" in capsys.readouterr().err


def test_a_rig_without_native_boards_is_told_what_to_set(rig, rig_file, monkeypatch, capsys):
    path = rig_file(msgspec.structs.replace(rig, radar=type(rig.radar)()))
    for what in (("plan", path), ("check", path, "RH")):
        assert run(monkeypatch, *what) == 2
        assert "usb_serial" in capsys.readouterr().err
