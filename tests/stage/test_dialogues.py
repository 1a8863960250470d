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

import math
import random
from pathlib import Path

import pytest
from tests.support.stage.conversation import play

from polysight_shared.stage_line import Command

DIALOGUES = sorted((Path(__file__).parent / "dialogues").glob("*.txt"))


@pytest.mark.parametrize("path", DIALOGUES, ids=lambda p: p.stem)
def test_every_kind_of_stage_answers_as_the_dialogue_is_written(talker, path: Path):
    play(talker, path)


# One command of each verb, in an order in which each is accepted after the previous one.
COMMANDS = (
    ("HELLO", ()), ("CLEAR", ()), ("SET", (0, 30_000)), ("MOVE", (12_000, 340, 4000)),
    ("ROW", (8000, -400, 5, 1000, 4000)), ("HOME", ()), ("ENABLE", (0,)),
)  # fmt: skip


def list_damaged(line: bytes) -> list[bytes]:
    """Copies of the line: in each another bit is flipped, or another byte before the line end is missing."""
    damaged_lines = []
    for bit in range(8 * len(line)):
        flipped = bytearray(line)
        flipped[bit // 8] ^= 1 << bit % 8
        damaged_lines.append(bytes(flipped))
    damaged_lines += [line[:i] + line[i + 1 :] for i in range(len(line) - 1)]
    return damaged_lines


def test_every_damaged_line_is_refused_and_moves_nothing(talker):
    talker.prepare()
    for verb, args in COMMANDS:
        talker.run_until_rest()
        talker.read_replies()
        at_rest = talker.ask_status()
        talker.has_stood_still()
        line = Command(talker.sequence + 1, verb, args).encode()
        for damaged in list_damaged(line):
            # A second line end ends a line whose own is damaged.
            talker.send(damaged + b"\n")
            replies = talker.read_replies()
            assert replies, f"{damaged!r}: no answer"
            # The stage does not know which command it was.
            assert all(r.kind == "error" and r.sequence is None for r in replies), f"{damaged!r}: {replies}"
            assert talker.has_stood_still()
        assert talker.ask_status() == at_rest
        talker.run_ms(20)
        assert talker.has_stood_still()
        # The undamaged line is executed.
        assert talker.send_command(verb, *args).kind == "ok"


# Bytes that are sent in one piece
CHUNK_BYTES = 4096


def test_random_bytes_move_nothing(talker, request: pytest.FixtureRequest):
    amount = 1_000_000 if request.config.getoption("--long") else 24_000
    rng = random.Random(amount)
    talker.prepare()
    talker.has_stood_still()
    for _ in range(math.ceil(amount / CHUNK_BYTES)):
        talker.send(rng.randbytes(CHUNK_BYTES))
        assert talker.has_stood_still()
        talker.received = b""
    talker.run_ms(200)
    assert talker.has_stood_still()

    talker.resynchronise()
    # One of the bytes may have been a STOP, which is an alarm.
    assert talker.send_command("CLEAR").kind == "ok"
    done, _ = talker.run_motion("MOVE", 500, 400, 4000)
    assert (done.kind, done.integer("x"), done.integer("y")) == ("done", 500, 400)


def test_random_lines_of_the_words_of_commands_move_nothing(talker, request: pytest.FixtureRequest):
    amount = 10_000 if request.config.getoption("--long") else 300
    first_words = ["N", "N1", "N65536", "MOVE", "ROW", "HOME", "-", "-1", "0", "99999999999", "*", "*0000"]
    further_words = [" ", "", "N2", "MOVE", "1", "-2147483648", "\t", "*FFFF"]
    rng = random.Random(amount)
    talker.prepare()
    talker.has_stood_still()
    for _ in range(amount):
        words = [rng.choice(first_words)]
        words += [rng.choice(further_words) for _ in range(rng.randint(0, 40))]
        talker.send("".join(words).encode() + b"\n")
        assert all(r.kind == "error" for r in talker.read_replies())
    assert talker.has_stood_still()
