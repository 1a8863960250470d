"""A command with random arguments ends with an exit status and a message, never with a traceback."""

import argparse
import io
import random
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from docs.check.commands import find_parser
from tests.support.paths import RIG_FILE
from tests.support.scenes import write_small_scene

from polysight.cli.main import main
from polysight_shared.errors import ConfigError, DataError, DeviceError, ScanError
from polysight_simulators.__main__ import main as simulators

# These commands serve, wait for a rig, or run for minutes; other tests give them wrong input.
NOT_DRAWN = ("serve", "preview", "demo", "simulate", "reproduce", "scan", "resume", "doctor", "card", "radar", "ask")
# Values that are mostly wrong: no number, too large, too small, or of another form than the option takes.
NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e308", "5e-324", "9" * 20, "1_000", "0x10", "half", "1,2", "1,2,3,4,5")
BOXES = ("0,0,nan,40", "1,2,3,4", "0,0,0,0", "-60,0,1e9,40", "a=1,2,3", "=b", "a=")
LAYERS = ("glass,5.5,nan,3", "a,metal,3", "glass,1,2", "?", "glass,?,?", "glass,?,3-1")
WORDS = ("", "-", "--", "../x", "/", "%s", "{}", "e\u202exe", "x" * 300, "1x1@0", "100000x100000@0.001")
FILES = (
    "scan", "scan/raw", "scan/products", "scan/manifest.jsonl", "scan/products/image.npz", "text.txt", "random.bin",
    "empty", "array.npz", "damaged.toml", "instrument.toml", "/dev/null", "no folder/no file",
)  # fmt: skip
# Number of random command lines; with --long, number for each command.
CASES = 60
CASES_LONG = 500
# Errors of the command line or of a file, a device, or a scan say what to do.
STATUSES_WITH_A_REMEDY = (
    ConfigError.exit_status,
    DataError.exit_status,
    DeviceError.exit_status,
    ScanError.exit_status,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a processed scan, a rig file, a scene, and files of other kinds."""
    folder = tmp_path_factory.mktemp("random")
    shutil.copy(RIG_FILE, folder)
    (folder / "scene.toml").write_text(write_small_scene(12, 4, pixels=30, pixel_mm=5.0, seed=1))
    (folder / "text.txt").write_text("hello\n")
    (folder / "random.bin").write_bytes(random.Random(1).randbytes(5000))
    (folder / "empty").touch()
    (folder / "damaged.toml").write_text("[grid\n")
    np.savez(folder / "array.npz", a=np.arange(3))
    scan = str(folder / "scan")
    assert simulators(["simulate", str(folder / "scene.toml"), "--config", str(RIG_FILE), "--out", scan]) == 0
    main(["process", scan, "--out", f"{scan}/products"])
    return folder


def list_command_parsers() -> dict[str, argparse.ArgumentParser]:
    """Parsers of the commands that are drawn."""
    parser = find_parser("polysight.cli.main")
    assert parser is not None
    (subcommands,) = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return {name: subparser for name, subparser in subcommands.choices.items() if name not in NOT_DRAWN}


def draw_value(action: argparse.Action, draw: random.Random) -> str:
    """A value of an option, which is sometimes right and mostly wrong."""
    if action.choices and draw.random() < 0.6:
        return str(draw.choice(list(action.choices)))
    # Files are in the list twice, as most arguments are files. The last values are right for many options.
    kind = draw.choice((FILES, FILES, NUMBERS, BOXES, LAYERS, WORDS, ("scan", "3", "out/x")))
    return draw.choice(kind)


def draw_words(parser: argparse.ArgumentParser, draw: random.Random) -> Iterator[str]:
    """Arguments and options of a command, in any number."""
    for action in parser._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        if isinstance(action, argparse._SubParsersAction):
            name = draw.choice(list(action.choices))
            yield name
            yield from draw_words(action.choices[name], draw)
        elif not action.option_strings:
            yield draw.choice(("scan", "scan/products", draw_value(action, draw)))
        elif action.required or draw.random() < 0.3:
            yield action.option_strings[-1]
            if action.nargs != 0:
                yield draw_value(action, draw)


def list_number_commands(name: str, parser: argparse.ArgumentParser) -> Iterator[list[str]]:
    """Command lines of a command that give each number to each option with a value."""
    options = [action for action in parser._actions if action.option_strings and action.nargs != 0]
    arguments = ["scan" for action in parser._actions if not action.option_strings]
    for option in options:
        required_words = []
        for other_option in options:
            if other_option.required and other_option is not option:
                required_words += [other_option.option_strings[-1], "out/x"]
        for number in NUMBERS:
            yield [name, *arguments, *required_words, f"{option.option_strings[-1]}={number}"]


def check_end(words: list[str]) -> None:
    """Run a command in this process: it ends with 0, or with another status and a message."""
    out = io.StringIO()
    err = io.StringIO()
    try:
        with redirect_stdout(out), redirect_stderr(err):
            status = main(words)
    except SystemExit as exit_request:
        # The parser of arguments raises it after an error, and after `--help`.
        status = exit_request.code
    output = out.getvalue() + err.getvalue()
    assert isinstance(status, int), words
    assert output.strip() or status == 0, words
    assert "Traceback" not in output, words
    # A command that succeeds shows no NaN and no infinity, except for texts that were typed: those of notes, and the
    # name of the folder in the last line of a list of scans.
    computed_text = "" if words[0] == "note" else re.sub(r"scans under .*", "", out.getvalue())
    shown_words = {word.strip("(),;:+-").lower() for word in computed_text.split()}
    if status == 0:
        assert not {"nan", "inf"} & shown_words, (words, out.getvalue())
    if status in STATUSES_WITH_A_REMEDY:
        assert "usage:" in output or "\n  do: " in output, (words, output)


def test_random_command_lines_end_with_a_message(folder, monkeypatch, request):
    draw = random.Random(1)
    parsers = list_command_parsers()
    cases = CASES_LONG * len(parsers) if request.config.getoption("--long") else CASES
    with chdir(folder):
        for _ in range(cases):
            name = draw.choice(list(parsers))
            # Without --yes a command asks before it changes something, and gets no answer.
            words = [word for word in draw_words(parsers[name], draw) if word != "--yes"]
            monkeypatch.setattr(sys, "stdin", io.StringIO(""))
            check_end([name, *words])


def test_each_option_accepts_or_refuses_each_number(folder, monkeypatch, request):
    """All combinations with --long, otherwise a sample of them."""
    lines = []
    for name, parser in list_command_parsers().items():
        lines += list_number_commands(name, parser)
    if not request.config.getoption("--long"):
        lines = random.Random(2).sample(lines, CASES // 3)
    with chdir(folder):
        for words in lines:
            monkeypatch.setattr(sys, "stdin", io.StringIO(""))
            check_end(words)
