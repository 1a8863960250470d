"""Progress is told before a step begins, not when it is over."""

from __future__ import annotations

from polysight.host.jobs.steps import steps


def test_every_step_is_named_before_it_begins(capsys):
    told = [(thing, capsys.readouterr().err) for thing in steps(["a", "b"], ["first", "second"])]
    assert [thing for thing, _ in told] == ["a", "b"]
    assert told[0][1] == "[1/2] first ..."
    assert "[2/2] second ..." in told[1][1]
    assert capsys.readouterr().err.endswith("s\n")
