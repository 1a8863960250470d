"""Random faults at random times: no hang, no traceback, no false success, and the right cause in the error."""

from __future__ import annotations

import random
import re
from collections import Counter

import pytest
from tests.support.radar.faults import FRAMES, Case, Outcome, draw, run

from polysight.radar.board import State
from polysight_simulators.radars import RadarBoard as Simulated

LONGEST_S = 45.0  # of virtual time: a bring-up whose every command is sent three times would be given up long before
NAMED = 0.95


@pytest.fixture(scope="module")
def clean() -> Simulated:
    """A board after a row without any fault."""
    found = run(Case("none", ""), 10**9)
    assert found.error is None
    return found.board


def accepted_rightly(found: Outcome, clean: Simulated) -> bool:
    """Return True if the board of a completed row has the settings of a sound one and has made its frames.

    A board that loses power at the last poll of the host has lost its settings.
    """
    over = found.words.at == found.words.count
    same = found.board.settings == clean.settings or (over and found.board.executed == clean.executed)
    return same and found.radar.state is State.DONE and found.board.cores.frames_left == 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_random_faults(clean, request):
    cases = 10_000 if request.config.getoption("--long") else 300
    failed, unnamed = 0, []
    kinds: Counter[str] = Counter()
    for number in range(cases):
        case, at = draw(random.Random(number))
        found = run(case, at)
        assert found.seconds < LONGEST_S, (number, case.name, at)
        kinds[case.name.split(" 0x")[0]] += 1
        if found.error is None:
            assert accepted_rightly(found, clean), (number, case.name, at)
            continue
        failed += 1
        text = f"{found.error.what} {found.error.why} {' '.join(found.radar.warnings)}"
        if not re.search(case.cause, text, re.DOTALL):
            unnamed.append((number, case.name, at, text))
    print(f"{cases} faults, {failed} ended in an error, {len(unnamed)} of these without the right cause", dict(kinds))  # noqa: T201
    for line in unnamed[:20]:
        print(line)  # noqa: T201
    assert failed > cases / 4
    assert len(unnamed) <= (1 - NAMED) * failed


OF_THE_BOARD = ("flash", "another board", "jumpers")


def test_after_a_repaired_fault_the_next_row_runs():
    """A reset and a configuration recover every board without a defect of its own."""
    for number in range(60):
        case, at = draw(random.Random(number))
        if case.name.startswith(OF_THE_BOARD):
            continue
        found = run(case, at)
        found.heal()
        found.radar.arm(FRAMES)
        assert found.radar.state is State.ARMED, (number, case.name, at)


def test_most_drawn_faults_happen_within_the_run(clean):
    """Most of the drawn faults happen within the run, so that the law above is not empty."""
    del clean
    struck = [run(*draw(random.Random(number))).struck for number in range(40)]
    assert sum(struck) > 24
