"""Every command has help with a valid example, and README names every command."""

import argparse
import re
from collections.abc import Iterator

import pytest
from docs.check.commands import command_faults, find_parser
from docs.check.pages import ROOT

MODULES = (
    "polysight.cli.main", "polysight_pi.cli", "docs.check",
    "polysight_simulators", "polysight_simulators.rig", "polysight_simulators.cards", "polysight_simulators.stage",
    "polysight_simulators.wires", "polysight_simulators.uno", "polysight_simulators.radars",
)  # fmt: skip


def list_parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """A parser, and the parsers of all its subcommands."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for subparser in action.choices.values():
                yield from list_parsers(subparser)


def list_all_parsers() -> list[argparse.ArgumentParser]:
    parsers = []
    for module in MODULES:
        parser = find_parser(module)
        if parser is not None:
            parsers += list_parsers(parser)
    return parsers


@pytest.mark.parametrize("parser", list_all_parsers(), ids=lambda parser: parser.prog.replace(" ", "-"))
def test_help_has_an_example_with_valid_options(parser):
    text = parser.format_help()
    _, heading, examples = text.partition("example")
    assert heading, f"`{parser.prog} --help` shows no example"
    # An example follows `example:` on the same line, or is an indented line after `examples:`.
    lines = re.findall(r"^(?:s?: *|  +)((?:polysight|python -m)\S*(?: .*)?)$", examples, re.MULTILINE)
    # A remark may follow an example, after a comma or three spaces.
    lines = [re.split(r", |   ", line)[0].strip() for line in lines]
    assert any(line.startswith(parser.prog) for line in lines), f"no example of {parser.prog} in {examples!r}"
    for line in lines:
        assert list(command_faults(line)) == []


def test_help_begins_with_a_sentence_an_example_and_the_options_used_most():
    root = find_parser("polysight.cli.main")
    assert root is not None
    _, *parsers_of_commands = list_parsers(root)
    for parser in parsers_of_commands:
        text = parser.format_help()
        usage, sentence, *_ = text.split("\n\n")
        assert usage.startswith(f"usage: {parser.prog}")
        assert len(sentence.splitlines()) == 1
        assert sentence.endswith(".")
        assert sentence.count(". ") == 0, f"{parser.prog}: one sentence"
        first_section = re.search(r"\noptions:\n(.*?)(?:\n\n|\Z)", text, re.DOTALL)
        listed_options = re.findall(r"^  (-\S+)", first_section[1], re.MULTILINE) if first_section else []
        # At most three, not counting -h; the others are in sections with other titles.
        assert len([option for option in listed_options if option != "-h,"]) <= 3, f"{parser.prog}: {listed_options}"
        # Options of earlier releases are still accepted, to say what replaces them, but they are not listed.
        for action in parser._actions:
            if action.help is not argparse.SUPPRESS:
                for name in action.option_strings:
                    assert name in text, parser.prog


@pytest.mark.parametrize("parser", list_all_parsers(), ids=lambda parser: parser.prog.replace(" ", "-"))
def test_every_option_is_explained(parser):
    assert parser.description
    options = [action for action in parser._actions if not isinstance(action, argparse._SubParsersAction)]
    without_help = [action.dest for action in options if not action.help]
    assert not without_help, f"{parser.prog}: no help for {without_help}"


def test_readme_names_every_command():
    _, list_of_commands = (ROOT / "README.md").read_text(encoding="utf-8").split("## Commands")
    for module, program in (("polysight.cli.main", "polysight"), ("polysight_pi.cli", "polysight-pi")):
        parser = find_parser(module)
        assert parser is not None
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for name in action.choices:
                    assert re.search(rf"\b{program}\b.*\b{name}\b", list_of_commands), name
