"""No flipped bit and no lost byte turns a command into another one."""

from __future__ import annotations

from polysight_shared.stage_line import Command

# In an order in which each is obeyed after the one before.
COMMANDS = (
    ("HELLO", ()), ("CLEAR", ()), ("SET", (0, 30_000)), ("MOVE", (12_000, 340, 4000)),
    ("ROW", (8000, -400, 5, 1000, 4000)), ("HOME", ()), ("ENABLE", (0,)),
)  # fmt: skip


def test_every_damaged_line_is_refused(talker):
    talker.ready()
    for verb, args in COMMANDS:
        talker.rest()
        talker.replies()
        at_rest = talker.status()
        talker.still()
        line = Command(talker.sequence + 1, verb, args).encode()
        flips = [line[: i // 8] + bytes([line[i // 8] ^ 1 << i % 8]) + line[i // 8 + 1 :] for i in range(8 * len(line))]
        for damaged in flips + [line[:i] + line[i + 1 :] for i in range(len(line) - 1)]:
            talker.rx(damaged + b"\n")  # the empty line ends a line whose end is damaged
            replies = talker.replies()
            assert replies, f"{damaged!r}: no answer"
            assert all(r.kind == "error" and r.sequence is None for r in replies), f"{damaged!r}: {replies}"
            assert talker.still()
        assert talker.status() == at_rest
        talker.run_ms(20)
        assert talker.still()
        assert talker.command(verb, *args).kind == "ok"  # undamaged it is obeyed
