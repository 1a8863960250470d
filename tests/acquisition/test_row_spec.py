"""docs/spec/row.md agrees with the code: states, transitions, messages."""

import re

import pytest
from tests.support.paths import REPO
from tests.support.refusals import expect_refusal

from polysight.acquisition.row import TRANSITIONS, RowState, RowTransaction
from polysight.capture import receiver as receiver_words
from polysight.capture.dca1000 import Code
from polysight.radar.control import RadarControl, RadarState
from polysight_shared import messages
from polysight_shared.config import Radar
from polysight_shared.errors import ErrorCode

SPEC = (REPO / "docs/spec/row.md").read_text(encoding="utf-8")


def read_table(heading: str) -> list[list[str]]:
    """Return the cells of the first table under a heading, without its head."""
    section = SPEC.split(f"## {heading}\n")[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def find_code_words(cell: str) -> list[str]:
    """Return the words in backquotes."""
    return re.findall(r"`([^`]+)`", cell)


def test_the_table_of_states_has_the_transitions_of_the_code():
    described = {}
    for state, _, next_states in read_table("States of a take"):
        described[find_code_words(state)[0]] = set(find_code_words(next_states))
    assert described == {str(state): {str(s) for s in next_states} for state, next_states in TRANSITIONS.items()}
    assert set(described) == {str(s) for s in RowState}


def test_every_state_can_be_reached_and_left_or_is_an_end():
    reached = set()
    to_visit = [RowState.WAITING]
    while to_visit:
        state = to_visit.pop()
        if state not in reached:
            reached.add(state)
            to_visit += TRANSITIONS[state]
    assert reached == set(RowState)
    ends = {s for s in RowState if not TRANSITIONS[s]}
    assert ends == {RowState.COMMITTED, RowState.KEPT, RowState.REJECTED, RowState.STOPPED, RowState.FAILED}
    # From each state but the ends a take may fail.
    assert all(RowState.FAILED in next_states for next_states in TRANSITIONS.values() if next_states)


def test_every_message_of_the_table_exists_in_the_code():
    documented = {
        "Pi": vars(messages), "receivers": vars(receiver_words), "cards": Code.__members__, "radars": vars(RadarControl)
    }  # fmt: skip
    for state, party, messages_cell in read_table("Messages"):
        assert find_code_words(state)[0] in set(RowState)
        assert find_code_words(messages_cell)
        for word in find_code_words(messages_cell):
            assert word in documented[party.split()[0]], (party, word)


def test_radar_backends_and_states_are_described():
    controls = Radar.__annotations__["control"]
    assert [find_code_words(row[0])[0] for row in read_table("Radars")] == re.findall(r"\w+", controls)[1:]
    assert all(f"`{state.name}`" in SPEC for state in RadarState)


@pytest.mark.parametrize("state", list(RowState))
def test_only_the_transitions_of_the_table_are_made(state):
    for next_state in RowState:
        reported: list[RowState] = []
        transaction = RowTransaction(reported.append)
        transaction.state = state
        if next_state in TRANSITIONS[state]:
            transaction.change_state(next_state)
            assert reported == [RowState.WAITING, next_state]
        else:
            with expect_refusal(ErrorCode.OTHER, state, next_state):
                transaction.change_state(next_state)
