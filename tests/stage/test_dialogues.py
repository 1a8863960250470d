"""Whole conversations, written down in dialogues/*.txt, with every kind of stage.

`-> VERB ARGS`       send a command with the next sequence number and its checksum
`-> N7 VERB ARGS`    ... with this number
`-> again`           send the last command's bytes again
`-> <HOLD>`          an immediate byte
`-> "bytes"`         exactly these bytes
`-> sealed "body"`   this body with its checksum and line end
`<- REPLY`           the next reply; # is the number of the last command, #ROW that of the last ROW, ? any value
`<- silence`         nothing has come
`.. 100 ms`          let time pass; also `rest`, `press X|Y|E|nothing`, `slip DX DY`, `reset`

Consecutive lines `->` are sent in one piece. A real stage does not wait while this machine is busy: so bytes that
must be sent before an event of the stage go in one piece, or have seconds to spare.

Further tests: no flipped bit, lost byte or random bytes make any of these stages move.
"""

import random
from pathlib import Path

import pytest
from tests.support.stage.conversation import play

from polysight_shared.stage_line import Command

DIALOGUES = sorted((Path(__file__).parent / "dialogues").glob("*.txt"))


@pytest.mark.parametrize("path", DIALOGUES, ids=lambda p: p.stem)
def test_dialogue(talker, path: Path):
    play(talker, path)


# In an order in which each command is accepted after the previous one.
COMMANDS = (
    ("HELLO", ()), ("CLEAR", ()), ("SET", (0, 30_000)), ("MOVE", (12_000, 340, 4000)),
    ("ROW", (8000, -400, 5, 1000, 4000)), ("HOME", ()), ("ENABLE", (0,)),
)  # fmt: skip


def test_every_damaged_line_is_refused(talker):
    talker.prepare()
    for verb, args in COMMANDS:
        talker.run_until_rest()
        talker.read_replies()
        at_rest = talker.ask_status()
        talker.has_stood_still()
        line = Command(talker.sequence + 1, verb, args).encode()
        flips = [line[: i // 8] + bytes([line[i // 8] ^ 1 << i % 8]) + line[i // 8 + 1 :] for i in range(8 * len(line))]
        for damaged in flips + [line[:i] + line[i + 1 :] for i in range(len(line) - 1)]:
            # The empty line ends a line whose end is damaged
            talker.send(damaged + b"\n")
            replies = talker.read_replies()
            assert replies, f"{damaged!r}: no answer"
            assert all(r.kind == "error" and r.sequence is None for r in replies), f"{damaged!r}: {replies}"
            assert talker.has_stood_still()
        assert talker.ask_status() == at_rest
        talker.run_ms(20)
        assert talker.has_stood_still()
        # Undamaged it is executed
        assert talker.send_command(verb, *args).kind == "ok"


CHUNK = 4096


def test_random_bytes(talker, request: pytest.FixtureRequest):
    amount = 1_000_000 if request.config.getoption("--long") else 24_000
    rng = random.Random(amount)
    talker.prepare()
    talker.has_stood_still()
    for _ in range(-(-amount // CHUNK)):
        talker.send(rng.randbytes(CHUNK))
        assert talker.has_stood_still()
        talker.received = b""
    talker.run_ms(200)
    assert talker.has_stood_still()
    talker.resynchronise()
    # Some of the bytes may have been a STOP
    assert talker.send_command("CLEAR").kind == "ok"
    done, _ = talker.run_motion("MOVE", 500, 400, 4000)
    assert (done.kind, done.integer("x"), done.integer("y")) == ("done", 500, 400)


def test_almost_lines(talker, request: pytest.FixtureRequest):
    """Random lines of the characters of commands."""
    amount = 10_000 if request.config.getoption("--long") else 300
    rng = random.Random(amount)
    talker.prepare()
    talker.has_stood_still()
    for _ in range(amount):
        words = [rng.choice(["N", "N1", "N65536", "MOVE", "ROW", "HOME", "-", "-1", "0", "99999999999", "*", "*0000"])]
        words += [
            rng.choice([" ", "", "N2", "MOVE", "1", "-2147483648", "\t", "*FFFF"]) for _ in range(rng.randint(0, 40))
        ]
        talker.send("".join(words).encode() + b"\n")
        assert all(r.kind == "error" for r in talker.read_replies())
    assert talker.has_stood_still()
