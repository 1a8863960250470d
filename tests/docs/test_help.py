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
    """A parser and all its subcommands'."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from list_parsers(sub)


def list_all_parsers() -> list[argparse.ArgumentParser]:
    all_parsers = [find_parser(module) for module in MODULES]
    return [leaf for parser in all_parsers if parser is not None for leaf in list_parsers(parser)]


@pytest.mark.parametrize("parser", list_all_parsers(), ids=lambda p: p.prog.replace(" ", "-"))
def test_help_has_an_example_that_works(parser):
    text = parser.format_help()
    _, heading, examples = text.partition("example")
    assert heading, f"`{parser.prog} --help` shows no example"
    lines = re.findall(r"^(?:s?: *|  +)((?:polysight|python -m)\S*(?: .*)?)$", examples, re.MULTILINE)
    # A remark may follow an example, after a comma or three spaces.
    lines = [re.split(r", |   ", line)[0].strip() for line in lines]
    assert any(line.startswith(parser.prog) for line in lines), f"no example of {parser.prog} in {examples!r}"
    assert [f for line in lines for f in command_faults(line)] == []


def test_help_begins_with_a_sentence_an_example_and_the_options_used_most():
    root = find_parser("polysight.cli.main")
    assert root is not None
    for parser in [p for p in list_parsers(root) if p is not root]:
        text = parser.format_help()
        usage, sentence, *_ = text.split("\n\n")
        assert usage.startswith(f"usage: {parser.prog}")
        assert len(sentence.splitlines()) == 1
        assert sentence.endswith(".")
        assert sentence.count(". ") == 0, f"{parser.prog}: one sentence"
        first = re.search(r"\noptions:\n(.*?)(?:\n\n|\Z)", text, re.DOTALL)
        listed_options = re.findall(r"^  (-\S+)", first[1], re.MULTILINE) if first else []
        # At most three besides -h; the others have headings of their own.
        assert len([option for option in listed_options if option != "-h,"]) <= 3, f"{parser.prog}: {listed_options}"
        # Options that were removed are still accepted, to say what replaces them, but they are not listed.
        listed_actions = [action for action in parser._actions if action.help is not argparse.SUPPRESS]
        assert all(name in text for action in listed_actions for name in action.option_strings), parser.prog


@pytest.mark.parametrize("parser", list_all_parsers(), ids=lambda p: p.prog.replace(" ", "-"))
def test_every_option_is_explained(parser):
    assert parser.description
    options = [action for action in parser._actions if not isinstance(action, argparse._SubParsersAction)]
    without_help = [action.dest for action in options if not action.help]
    assert not without_help, f"{parser.prog}: no help for {without_help}"


def test_readme_names_every_command():
    block = (ROOT / "README.md").read_text(encoding="utf-8").split("## Commands")[1]
    for module, program in (("polysight.cli.main", "polysight"), ("polysight_pi.cli", "polysight-pi")):
        parser = find_parser(module)
        assert parser is not None
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                missing = [name for name in action.choices if not re.search(rf"\b{program}\b.*\b{name}\b", block)]
                assert not missing, f"README's list of commands lacks {missing}"
