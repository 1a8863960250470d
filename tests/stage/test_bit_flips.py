"""No single flipped bit turns a command into another one."""

from __future__ import annotations

import pytest

from polysight.shared.stage_line import Command


@pytest.mark.parametrize(
    ("verb", "args"),
    [
        ("MOVE", (12_000, 340, 4000)),
        ("ROW", (8000, -400, 5, 1000, 4000)),
        ("ENABLE", (0,)),
        ("SET", (0, 30_000)),
        ("HOME", ()),
        ("CLEAR", ()),
        ("HELLO", ()),
    ],
)
def test_every_flip_is_refused(talker, verb: str, args: tuple[int, ...]):
    talker.ready()
    assert talker.command("MOVE", 9000, 500, 10_000).kind == "ok"
    talker.rest()
    talker.replies()
    at_rest = talker.status()
    talker.still()
    line = Command(talker.sequence + 1, verb, args).encode()
    for bit in range(8 * len(line)):
        damaged = bytearray(line)
        damaged[bit // 8] ^= 1 << bit % 8
        talker.rx(bytes(damaged) + b"\n")  # the empty line ends what a damaged line end left open
        replies = talker.replies()
        assert replies, f"bit {bit}: no answer"
        assert all(r.kind == "error" and r.sequence is None for r in replies), f"bit {bit}: {replies}"
        assert talker.still()
    assert talker.status() == at_rest
    talker.run_ms(20)
    assert talker.still()
    assert talker.command(verb, *args).kind == "ok"  # undamaged it is obeyed


def test_a_lost_byte_is_noticed(talker):
    talker.ready()
    line = Command(talker.sequence + 1, "MOVE", (12_000, 340, 4000)).encode()
    for i in range(len(line) - 1):
        talker.rx(line[:i] + line[i + 1 :] + b"\n")
        assert all(r.kind == "error" for r in talker.replies())
    talker.run_ms(20)
    assert talker.status().fields["state"] == "idle"
