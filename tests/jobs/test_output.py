"""Progress is shown before a step begins, also without a terminal."""

import pytest

from polysight.cli.main import main
from polysight.jobs import output
from polysight.jobs.output import count_steps, steps


def test_every_step_is_named_before_it_begins(capsys):
    # Each step with the text that was printed before it.
    steps_with_text = [(step, capsys.readouterr().err) for step in steps(["a", "b"], ["first", "second"])]
    assert [step for step, _ in steps_with_text] == ["a", "b"]
    # The line ends, so that what the step prints begins on a line of its own.
    assert steps_with_text[0][1] == "[1/2] first ...\n"
    assert steps_with_text[1][1] == "[1/2] first: 0 s\n[2/2] second ...\n"
    assert capsys.readouterr().err == "[2/2] second: 0 s\n"


def test_without_a_terminal_rows_are_counted_in_lines(capsys, monkeypatch):
    # A clock that advances by 2 s each time it is read.
    now_s = iter(range(0, 1000, 2))
    monkeypatch.setattr(output, "monotonic", lambda: next(now_s))
    rows = count_steps(range(40), 40, "rows")
    assert next(rows) == 0
    # Printed before the first row is done.
    assert capsys.readouterr().err == "40 rows ...\n"
    assert list(rows) == list(range(1, 40))
    lines = capsys.readouterr().err.splitlines()
    assert 3 <= len(lines) <= 10
    assert all(line.endswith("of 40 rows ...") for line in lines)


def test_progress_that_cannot_be_printed_raises_no_error(monkeypatch):
    def raise_closed(text: str) -> None:
        raise BrokenPipeError(text)

    monkeypatch.setattr(output.sys.stderr, "write", raise_closed)
    output.say("images")


@pytest.mark.parametrize("words", [["reproduce", "--out", "out", "fig99"]])
def test_a_line_comes_before_slow_libraries_are_loaded(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words) != 0
    assert capsys.readouterr().err.startswith(f"polysight {words[0]}: starting\n")
