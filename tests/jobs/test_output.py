"""Progress is shown before a step begins, also without a terminal."""

import pytest

from polysight.cli.main import main
from polysight.jobs import output
from polysight.jobs.output import count_steps, steps


def test_every_step_is_named_before_it_begins(capsys):
    answer = [(step, capsys.readouterr().err) for step in steps(["a", "b"], ["first", "second"])]
    assert [step for step, _ in answer] == ["a", "b"]
    # What the step prints begins on a line of its own.
    assert answer[0][1] == "[1/2] first ...\n"
    assert answer[1][1] == "[1/2] first: 0 s\n[2/2] second ...\n"
    assert capsys.readouterr().err == "[2/2] second: 0 s\n"


def test_without_a_terminal_rows_are_counted_in_lines(capsys, monkeypatch):
    now = iter(range(0, 1000, 2))
    monkeypatch.setattr(output, "monotonic", lambda: next(now))
    rows = count_steps(range(40), 40, "rows")
    assert next(rows) == 0
    # Before the first is done
    assert capsys.readouterr().err == "40 rows ...\n"
    assert list(rows) == list(range(1, 40))
    lines = capsys.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 10
    assert all(line.endswith("of 40 rows ...") for line in lines)


def test_a_closed_stderr_stops_nothing(monkeypatch):
    def raise_closed(text: str) -> None:
        raise BrokenPipeError(text)

    monkeypatch.setattr(output.sys.stderr, "write", raise_closed)
    output.say("images")


@pytest.mark.parametrize("words", [["reproduce", "--out", "out", "fig99"]])
def test_a_line_comes_before_slow_libraries_are_loaded(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words) != 0
    assert capsys.readouterr().err.startswith(f"polysight {words[0]}: starting\n")
