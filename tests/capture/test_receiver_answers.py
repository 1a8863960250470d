"""How long the host waits for an answer of its receiver process, and which answers it takes for one."""

from types import SimpleNamespace
from typing import Any

import pytest
from tests.support.refusals import expect_refusal

from polysight.capture import receiver
from polysight.capture.receiver import Began, BeginRow, Progress, ReceiverProcess
from polysight_shared.errors import ErrorCode

REQUEST = BeginRow(row=0, take=1, expected_bytes=4096, frame_bytes=4096, path="a.part")
PROGRESS = Progress(row=0, take=1, received=0, complete=False, last_arrival_ns=0)


class Process:
    """A receiver process that gives these answers, each after a second, and nothing more."""

    def __init__(self, answers: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
        self.answers = answers
        self.noted: list[Any] = []
        self.limits_s: list[float] = []
        self.now = 100.0
        self.board = SimpleNamespace(name="RV")
        self._connection = SimpleNamespace(poll=self._poll)
        self._note_answer = self.noted.append
        monkeypatch.setattr(receiver, "send", lambda *_: None)
        monkeypatch.setattr(receiver, "time", SimpleNamespace(monotonic=lambda: self.now))

    def _poll(self, limit_s: float) -> bool:
        self.limits_s.append(limit_s)
        if not self.answers or limit_s < 1.0:
            return False
        self.now += 1.0
        return True

    def _receive_answer(self) -> Any:
        return self.answers.pop(0)

    def ask(self, timeout_s: float) -> Any:
        process: Any = self
        return ReceiverProcess._ask(process, REQUEST, Began, timeout_s)


def test_progress_that_comes_before_the_answer_is_noted(monkeypatch):
    began = Began(stale=3)
    process = Process([PROGRESS, PROGRESS, began], monkeypatch)
    assert process.ask(timeout_s=5.0) == began
    assert process.noted == [PROGRESS, PROGRESS, began]
    # Each answer takes a second of the timeout.
    assert process.limits_s == [5.0, 4.0, 3.0]


@pytest.mark.parametrize("answers", [[], [PROGRESS] * 9])
def test_an_answer_is_waited_for_no_longer_than_the_timeout(monkeypatch, answers):
    timeout_s = 3.0
    process = Process(answers, monkeypatch)
    begun_s = process.now
    with expect_refusal(ErrorCode.NO_ANSWER, "RV", "did not answer BeginRow within 3 s"):
        process.ask(timeout_s)
    assert max(process.limits_s) <= timeout_s
    assert process.now <= begun_s + timeout_s
