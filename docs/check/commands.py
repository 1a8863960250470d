"""Whether a command that a page shows exists: program, subcommand, options and their form, without running it."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import inspect
import io
import re
import shlex
from functools import cache
from pathlib import Path
from unittest import mock

from docs.check.pages import ROOT

PROGRAMS = {"polysight": "polysight.cli.main", "polysight-pi": "polysight_pi.cli"}
OWN = ("benchmarks", "docs", "polysight", *(f"polysight_{name}" for name in ("papers", "pi", "shared", "simulators")))
# Words before a command that run it.
_BEFORE = ("sudo", "env", "exec", "time", "nohup", "ssh", "timeout", "nice")
# What ends a command, and what redirects its input or output: words of `shlex` with punctuation.
_ENDS = re.compile(r"[|&;()\n]+")
_REDIRECTS = re.compile(r"[<>&]+")


class _Captured(BaseException):
    """Carries a program's parser out of its `main`."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self.parser = parser


@cache
def find_parser(module: str) -> argparse.ArgumentParser | None:
    """The argument parser that a module's `main` uses; None when it takes no arguments.

    Raises ModuleNotFoundError when there is no such module to run.
    """
    if importlib.util.find_spec(module) is None:
        raise ModuleNotFoundError(f"no module {module}")
    if importlib.util.find_spec(f"{module}.__main__" if _is_package(module) else module) is None:
        raise ModuleNotFoundError(f"{module} cannot be run with -m")
    loaded = importlib.import_module(f"{module}.__main__" if _is_package(module) else module)
    # Neither `parse_args` nor `argparse`, nor a function that builds a parser: its `main` must not be called here.
    if "pars" not in Path(str(loaded.__file__)).read_text(encoding="utf-8"):
        return None

    def capture(self: argparse.ArgumentParser, *_: object) -> None:
        raise _Captured(self)

    with mock.patch.object(argparse.ArgumentParser, "parse_args", capture):
        try:
            loaded.main(*([[]] if inspect.signature(loaded.main).parameters else []))
        except _Captured as captured:
            return captured.parser
    return None


def _is_package(module: str) -> bool:
    """True for a module with a folder of its own."""
    spec = importlib.util.find_spec(module)
    return spec is not None and spec.submodule_search_locations is not None


def simple_commands(line: str) -> list[list[str]]:
    """The words of each command of a shell line, without redirections and without sudo, ssh and the like."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    found: list[list[str]] = [[]]
    skip = False
    for word in lexer:
        if skip:
            skip = False
        elif _ENDS.fullmatch(word):
            found.append([])
        elif _REDIRECTS.fullmatch(word):
            skip = True
            # The number of the stream in `2>&1` came as a word of its own.
            if found[-1][-1:] in (["1"], ["2"]):
                found[-1].pop()
        else:
            found[-1].append(word)
    return [words for words in map(_without_runner, found) if words]


def _without_runner(words: list[str]) -> list[str]:
    """Return a command without the programs that run it, their options and values, and variables that are set."""
    while words and (words[0] in _BEFORE or re.fullmatch(r"[A-Za-z_]+=.*|-\w*|\$|!", words[0])):
        runner = words[0]
        words = words[1:]
        if runner == "ssh":
            # The first word that is not an option is the machine.
            words = words[next((n for n, word in enumerate(words) if not word.startswith("-")), 0) + 1 :]
        elif runner in ("-u", "-n", "timeout"):
            words = words[1:]
    return words


def _module(words: list[str]) -> tuple[str, list[str]] | None:
    """Our module that a command runs and its arguments; None when it is not a program of ours."""
    program = Path(words[0]).name
    if program in PROGRAMS:
        return PROGRAMS[program], words[1:]
    if re.fullmatch(r"python[\d.]*", program) and words[1:2] == ["-m"] and words[2].partition(".")[0] in OWN:
        return words[2], words[3:]
    return None


def is_ours(line: str) -> bool:
    """Whether a line runs a program of ours, or make."""
    try:
        return any(words[0] == "make" or _module(words) for words in simple_commands(line))
    except ValueError:
        return False


def command_faults(line: str) -> list[str]:
    """What is wrong with a whole command line as a page shows it; empty when its programs would take it."""
    try:
        commands = simple_commands(line)
    except ValueError as e:
        return [f"{line!r} is not a shell command: {e}"]
    faults: list[str] = []
    for words in commands:
        if Path(words[0]).name == "make":
            faults += _make_faults(words[1:])
        elif "pytest" in words[:3]:
            faults += _pytest_faults(words[words.index("pytest") + 1 :])
        elif (our_module := _module(words)) is not None:
            faults += _parse_faults(*our_module)
    return faults


def _parse_faults(module: str, arguments: list[str]) -> list[str]:
    """What the module's own parser says against the arguments; empty when it takes them."""
    try:
        parser = find_parser(module)
    except ModuleNotFoundError as e:
        return [str(e)]
    if parser is None:
        return [f"{module} takes no arguments"] if arguments else []
    messages = io.StringIO()
    with contextlib.redirect_stderr(messages), contextlib.redirect_stdout(io.StringIO()):
        try:
            parser.parse_args(arguments)
        except SystemExit as e:
            if e.code:
                return [messages.getvalue().strip().splitlines()[-1]]
    return []


def mention_faults(text: str) -> list[str]:
    """What is wrong with a command that a sentence names, perhaps without its arguments: subcommand and options."""
    try:
        commands = simple_commands(text)
    except ValueError:
        # Words in code type need not be a shell's.
        return []
    faults: list[str] = []
    for words in commands:
        our_module = _module(words)
        if our_module is not None and not (Path(words[0]).name in PROGRAMS and len(words) == 1):
            faults += _walk(*our_module)
        elif words[0] == "make" and len(words) > 1 and re.fullmatch(r"[a-z-]+", words[1]):
            faults += _make_faults(words[1:])
    return faults


def _walk(module: str, words: list[str]) -> list[str]:
    """The first subcommand or option among the words that the module's parser does not have; empty without one."""
    try:
        parser = find_parser(module)
    except ModuleNotFoundError as e:
        return [str(e)]
    known = set(parser._option_string_actions) if parser else set()
    for word in words:
        name = word.partition("=")[0]
        actions = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)] if parser else []
        choices = actions[0].choices if actions else {}
        if word in choices:
            parser = choices[word]
            known |= set(parser._option_string_actions)
        elif actions and actions[0].required and re.fullmatch(r"[a-z-]+", word):
            return [f"{module}: no subcommand {word!r}"]
        elif re.fullmatch(r"--[a-z-]+", name) and name not in known:
            return [f"{module}: no option {name}"]
    return []


def _make_faults(words: list[str]) -> list[str]:
    """Targets and variables of `make`, for the Makefile of the folder that `-C` gives."""
    folder = ROOT / (words[words.index("-C") + 1] if "-C" in words else "")
    texts = [p.read_text(encoding="utf-8") for p in (folder / "Makefile", *folder.glob("*.mk")) if p.exists()]
    targets = {t for text in texts for t in re.findall(r"^([a-z][a-z-]*):", text, re.MULTILINE)}
    variables = {v for text in texts for v in re.findall(r"\$\(([A-Z_]+)\)", text)}
    faults: list[str] = []
    skip = False
    for word in words:
        # `-C`, and the folder that follows it.
        if skip or word == "-C":
            skip = not skip
        elif "=" in word:
            faults += [] if word.partition("=")[0] in variables else [f"make: no variable {word.partition('=')[0]}"]
        elif not word.startswith("-") and word not in targets:
            faults.append(f"make: no target {word}")
    return faults


def _pytest_faults(words: list[str]) -> list[str]:
    """Paths of the test suite, and options of our own or pytest's."""
    sources = "".join(p.read_text(encoding="utf-8") for p in (ROOT / "tests").rglob("conftest.py"))
    known = {*re.findall(r'addoption\(\s*"(--[a-z-]+)"', sources), "--dist", "--collect-only", "--last-failed"}
    faults = [f"pytest: no path {w}" for w in words if w.startswith("tests") and not (ROOT / w).exists()]
    options = [w.partition("=")[0] for w in words if w.startswith("--")]
    return faults + [f"pytest: no option {o}" for o in options if o not in known]
