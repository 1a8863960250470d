"""Error messages and notices of the programs name commands; each of these commands exists and has valid options.

Commands are searched in all strings of the source files. A command with its arguments must be valid as a whole, so that
a user can paste it; a command that is only named must exist.
"""

import argparse
import ast
import re
from functools import cache
from pathlib import Path

import pytest
from docs.check.commands import PROGRAMS, command_faults, find_parser, mention_faults
from tests.support.paths import RIG_FILE

ROOT = RIG_FILE.parent
SOURCE_FOLDERS = ("host", "papers", "pi_controller", "shared", "simulators")
# In place of the value of an f-string. The number 8 is valid as a path, as a name and as a number.
PLACEHOLDER = "8"
# A command in backticks.
QUOTED_COMMAND = re.compile(r"`((?:sudo )?polysight(?:-pi)? [^`]+)`")
# A command without backticks, such as `polysight label SCAN --box A=1,2,3,4` in a sentence. It ends before the next
# word of small letters and before the next punctuation mark; a comma within an argument is none.
PLAIN_COMMAND = re.compile(
    r"""
    (?<![`\w/-])  # not in backticks, and no part of a longer name or of a path
    (
        polysight(?:-pi)?[ ][a-z][a-z-]+  # program and subcommand
        (?:
            [ ](?![a-z]+\b)  # the next argument is no word of small letters
            (?:[^;,:()`\s]|,(?=\S))+
        )*
    )
    """,
    re.VERBOSE,
)
# Commands whose first argument is the name of an action, as in `polysight card test`.
COMMANDS_WITH_ACTIONS = ("calibrate", "card", "radar")


def list_subcommands() -> set[str]:
    """Names of the commands of all programs."""
    names: set[str] = set()
    for module in PROGRAMS.values():
        for action in find_parser(module)._actions:
            if isinstance(action, argparse._SubParsersAction):
                names |= set(action.choices)
    return names


def list_sources() -> list[Path]:
    """Source files; the folders `build` are none, because they contain copies from which wheels were built."""
    paths = []
    for folder in SOURCE_FOLDERS:
        paths += sorted((ROOT / folder).rglob("*.py"))
    return [path for path in paths if "build" not in path.parts]


SUBCOMMANDS = list_subcommands()
SOURCES = list_sources()


@cache
def list_texts(path: Path) -> list[tuple[int, str]]:
    """Line number and text of each string in a file except docstrings; values of f-strings become PLACEHOLDER."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    # Nodes that are no texts of messages. First the docstrings: a string that is a statement of its own is one.
    excluded = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = []
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            text = ""
            for part in node.values:
                # Otherwise the walk, which comes to the parts later, would list each part as a text, too.
                excluded.add(id(part))
                text += str(part.value) if isinstance(part, ast.Constant) else PLACEHOLDER
            texts.append((node.lineno, text))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in excluded:
            texts.append((node.lineno, node.value))
    return texts


def list_commands(text: str) -> list[str]:
    """Command lines in a message, first those in backticks.

    Without backticks "polysight" may be the name of the project: only phrases with the name of a command count.
    """
    commands = QUOTED_COMMAND.findall(text)
    for phrase in PLAIN_COMMAND.findall(QUOTED_COMMAND.sub("", text)):
        subcommand = phrase.split()[1]
        if subcommand in SUBCOMMANDS:
            commands.append(phrase)
    return commands


def has_arguments(command: str) -> bool:
    """False for a command that is only named, or named with an option."""
    _, subcommand, *arguments = command.removeprefix("sudo ").split()
    if subcommand in COMMANDS_WITH_ACTIONS:
        arguments = arguments[1:]
    return bool(arguments) and not arguments[0].startswith("-")


def test_commands_are_found_in_messages():
    assert list_commands("do: `polysight process 8 --out DIR`, then go") == ["polysight process 8 --out DIR"]
    assert list_commands("polysight label 8 --metal NAME, or measure") == ["polysight label 8 --metal NAME"]
    assert list_commands("polysight label 8 --box A=1,2,3,4; then go") == ["polysight label 8 --box A=1,2,3,4"]
    assert list_commands("the polysight of today") == []


def test_the_search_finds_the_commands_of_the_source_files():
    """The source files had 287 commands, 95 of them with arguments (measured): a broken search finds far fewer."""
    commands = []
    for path in SOURCES:
        for _, text in list_texts(path):
            commands += list_commands(text)
    assert len(commands) > 100
    assert len([command for command in commands if has_arguments(command)]) > 50


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_command_in_a_message_exists_and_has_valid_options(path):
    faults = []
    for line, text in list_texts(path):
        for command in list_commands(text):
            # The word COMMAND in a message stands for any command, and dots for further arguments.
            example = command.removesuffix("...").replace("COMMAND", "scan")
            if has_arguments(command):
                faults_of_command = command_faults(example)
            else:
                faults_of_command = mention_faults(example)
            faults += [f"{path}:{line}: {command}: {fault}" for fault in faults_of_command]
    assert not faults, "\n".join(faults)
