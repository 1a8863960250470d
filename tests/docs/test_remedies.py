"""Commands in messages have existing names and options; with their arguments they can be pasted and are valid."""

import argparse
import ast
import re
from functools import cache
from pathlib import Path

import pytest
from docs.check.commands import PROGRAMS, command_faults, find_parser, mention_faults
from tests.support.paths import RIG_FILE

ROOT = RIG_FILE.parent
SUBCOMMANDS = {
    name
    for module in PROGRAMS.values()
    for action in find_parser(module)._actions
    if isinstance(action, argparse._SubParsersAction)
    for name in action.choices
}
SOURCES = [
    path
    for folder in ("host", "papers", "pi_controller", "shared", "simulators")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if "build" not in path.parts
]
# A value that is put into a message: it may be a path, a name or a number.
PLACEHOLDER = "8"
# In backticks; else from the name of the program to the end of the phrase.
QUOTED = re.compile(r"`((?:sudo )?polysight(?:-pi)? [^`]+)`")
PLAIN = re.compile(r"(?<![`\w/-])(polysight(?:-pi)? [a-z][a-z-]+(?: (?![a-z]+\b)(?:[^;,:()`\s]|,(?=\S))+)*)")
ACTIONS = ("calibrate", "card", "radar")


@cache
def list_texts(path: Path) -> list[tuple[int, str]]:
    """Strings of a file that are not docstrings, with their lines; a value that is put in is PLACEHOLDER."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    # Docstrings, and the pieces of a string with values in it.
    excluded = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            excluded |= {id(value) for value in node.values}
            pieces = [v.value if isinstance(v, ast.Constant) else PLACEHOLDER for v in node.values]
            texts.append((node.lineno, "".join(map(str, pieces))))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in excluded:
            texts.append((node.lineno, node.value))
    return texts


def list_commands(text: str) -> list[str]:
    """Command lines that a message names; a sentence about a program names none."""
    phrases = [phrase for phrase in PLAIN.findall(QUOTED.sub("", text)) if phrase.split()[1] in SUBCOMMANDS]
    return QUOTED.findall(text) + phrases


def is_whole(command: str) -> bool:
    """True if a command has its arguments; False if it is named alone, or with an option only."""
    words = command.removeprefix("sudo ").split()[2:]
    if command.split()[1] in ACTIONS:
        words = words[1:]
    return bool(words) and not words[0].startswith("-")


def test_commands_are_found_in_messages():
    assert list_commands("do: `polysight process 8 --out DIR`, then go") == ["polysight process 8 --out DIR"]
    assert list_commands("polysight label 8 --metal NAME, or measure") == ["polysight label 8 --metal NAME"]
    assert list_commands("polysight label 8 --box A=1,2,3,4; then go") == ["polysight label 8 --box A=1,2,3,4"]
    assert list_commands("the polysight of today") == []
    commands = [command for path in SOURCES for _, text in list_texts(path) for command in list_commands(text)]
    assert len(commands) > 100
    assert sum(map(is_whole, commands)) > 50


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_command_that_a_message_names_is_one(path):
    faults = []
    for line, text in list_texts(path):
        for command in list_commands(text):
            pasted = command.removesuffix("...").replace("COMMAND", "scan")
            problems = command_faults(pasted) if is_whole(command) else mention_faults(pasted)
            faults += [f"{path}:{line}: {command}: {fault}" for fault in problems]
    assert not faults, "\n".join(faults)
