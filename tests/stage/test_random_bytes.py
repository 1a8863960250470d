"""Random bytes on the serial line: nothing moves, nothing hangs, and the stage obeys again afterwards."""

from __future__ import annotations

import random

import pytest

CHUNK = 4096


@pytest.mark.timeout(600)
def test_random_bytes(talker, request: pytest.FixtureRequest):
    amount = 1_000_000 if request.config.getoption("--long") else 24_000
    rng = random.Random(amount)
    talker.ready()
    talker.still()
    for _ in range(-(-amount // CHUNK)):
        talker.rx(rng.randbytes(CHUNK))
        assert talker.still()
        talker.received = b""
    talker.run_ms(200)
    assert talker.still()
    talker.resync()
    assert talker.command("CLEAR").kind == "ok"  # a STOP may have been among them
    done, _ = talker.motion("MOVE", 500, 400, 4000)
    assert (done.kind, done.integer("x"), done.integer("y")) == ("done", 500, 400)


@pytest.mark.timeout(600)
def test_almost_lines(talker, request: pytest.FixtureRequest):
    """Random lines of the characters of commands."""
    amount = 10_000 if request.config.getoption("--long") else 300
    rng = random.Random(amount)
    talker.ready()
    talker.still()
    for _ in range(amount):
        words = [rng.choice(["N", "N1", "N65536", "MOVE", "ROW", "HOME", "-", "-1", "0", "99999999999", "*", "*0000"])]
        words += [
            rng.choice([" ", "", "N2", "MOVE", "1", "-2147483648", "\t", "*FFFF"]) for _ in range(rng.randint(0, 40))
        ]
        talker.rx("".join(words).encode() + b"\n")
        assert all(r.kind == "error" for r in talker.replies())
    assert talker.still()
