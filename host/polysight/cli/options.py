"""The parser of commands, its short help, and options that several commands share."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, TypeVar

from polysight.data import find_packaged
from polysight.settings import Settings, path_text
from polysight_shared.errors import ConfigError, ErrorCode

# Name of the rig file, the settings of the whole instrument, in a folder.
RIG_FILE = Path("instrument.toml")
# Number of options that help shows before "more options"; chosen.
_OPTIONS_SHOWN = 3
# Largest coordinate of a box: far outside of any image, so that a wrong unit is noticed.
_FARTHEST_MM = 10_000
# Names in a parsed command line that are not options.
_OF_THE_PARSER = ("command", "action", "run")


class CommandParser(argparse.ArgumentParser):
    """A parser with a short help: usage, one sentence, example, arguments, the most used options, then the rest.

    Attributes
    ----------
    most_used
        Options that are shown first, besides the required ones; others follow in the order of their definition.
    """

    most_used: tuple[str, ...] = ()

    def format_usage(self) -> str:
        """Return the usage in one line: required options and arguments, and `[options]` for all others."""
        options = [a for a in self._actions if a.option_strings]
        formatter = self._get_formatter()
        formatter.add_usage(None, [a for a in self._actions if a.required or not a.option_strings], [])
        optional = " [options]" if any(not a.required for a in options) else ""
        return formatter.format_help().rstrip() + f"{optional}\n"

    def format_help(self) -> str:
        """Return the help text."""
        # The first two groups are argparse's own.
        groups = self._action_groups[2:]
        grouped = [a for group in groups for a in group._group_actions]
        options = [a for a in self._actions if a.option_strings and a not in grouped]
        # The keys are sorted with False first: required options, the most used ones, the others, and --help at the end.
        options.sort(key=lambda a: (not a.required, not set(self.most_used) & set(a.option_strings), a.dest == "help"))
        # There is no section "more options" that has only --help.
        first = _OPTIONS_SHOWN
        if len(options) <= _OPTIONS_SHOWN + 1:
            first = len(options)
        formatter = self._get_formatter()
        formatter.add_text(self.description)
        formatter.add_text(self.epilog)
        for title, text, actions in (
            ("arguments", None, [a for a in self._actions if not a.option_strings and a not in grouped]),
            ("options", None, options[:first]),
            ("more options", None, options[first:]),
            *((group.title, group.description, group._group_actions) for group in groups),
        ):
            formatter.start_section(title)
            formatter.add_text(text)
            formatter.add_arguments(actions)
            formatter.end_section()
        return f"{self.format_usage()}\n{formatter.format_help()}"


def describe(sub: argparse.ArgumentParser, text: str, example: str) -> None:
    """Set the description and the example of a command's help."""
    sub.description = f"{text[0].upper()}{text[1:]}."
    sub.epilog = f"example:\n  {example}"
    sub.formatter_class = argparse.RawDescriptionHelpFormatter


Run = Callable[[argparse.Namespace], int] | str
"""Action of a command: a function, or the name of one in `polysight.jobs`, such as "scans.note". In the second case the
options of the command have the names of the function's parameters."""


def set_run(sub: argparse.ArgumentParser, run: Run) -> None:
    """Set the function of a command; if it is given by name, its module is loaded when the command runs."""
    if isinstance(run, str):
        run = partial(_run_job, run)
    sub.set_defaults(run=run)


def _run_job(name: str, args: argparse.Namespace) -> int:
    """Call a function of `polysight.jobs` with the options of its command."""
    module, _, function = name.partition(".")
    options = {option: value for option, value in vars(args).items() if option not in _OF_THE_PARSER}
    return getattr(import_module(f"polysight.jobs.{module}"), function)(**options)


class AddCommand(Protocol):
    """Adds a command to `polysight`, and returns its parser."""

    def __call__(
        self,
        name: str,
        run: Run,
        text: str,
        example: str,
        most_used: tuple[str, ...] = (),
    ) -> CommandParser:
        """Return a parser for the options of the command; `most_used` are shown first in its help."""
        ...


def add_action(
    actions: argparse._SubParsersAction[Any],
    name: str,
    run: Run,
    text: str,
    example: str,
) -> argparse.ArgumentParser:
    """Add an action of a command, such as `polysight card reset`; returns its parser."""
    sub = actions.add_parser(name, help=text)
    describe(sub, text, example)
    set_run(sub, run)
    return sub


def parse_shipped_path(text: str) -> Path:
    """Parse the path of a scene or rig file, which may be one that comes with the program."""
    return find_packaged(Path(text))


def add_json_option(sub: argparse.ArgumentParser) -> None:
    """Add `--json`."""
    sub.add_argument("--json", dest="as_json", action="store_true", help="print JSON, for programs")


def material_settings(args: argparse.Namespace) -> Settings:
    """Return the settings from the options of :func:`add_material_options`.

    Raises
    ------
    ConfigError
        when an option would have no effect.
    """
    options = {"--library": args.library, "--metal-box": args.metal, "--labels": args.labels, "--model": args.model}
    options_used = [name for name, value in options.items() if value is not None]
    if options_used and getattr(args, "no_process", False):
        raise ConfigError(
            f"{' and '.join(options_used)} with --no-process would do nothing",
            "these options say how a scan is processed, and --no-process only records it",
            "give these options to `polysight process` later, or leave --no-process out",
            code=ErrorCode.VALUES_CONFLICT,
        )
    if args.library is not None and args.model == "none":
        raise ConfigError(
            "--library with --model none would do nothing", "--model none names nothing", "leave one of them out",
            code=ErrorCode.VALUES_CONFLICT,
        )  # fmt: skip
    return Settings(
        metal_box_mm=args.metal, library=path_text(args.library), model=args.model, labels=path_text(args.labels)
    )


def rig_file(config: Path | None, data: Path) -> Path | None:
    """Return the given rig file, else that in the folder of the data, else that in the current folder, else None.

    Published data do not contain the geometry of the rig: without another rig file they get the packaged one, which is
    that of the published rig.
    """
    given_file = config or next((rig for rig in (data / RIG_FILE, RIG_FILE) if rig.exists()), None)
    if given_file is not None:
        return given_file
    from polysight.store import MANIFEST, is_source

    if is_source(data) and not (data / MANIFEST).exists():
        return find_packaged(RIG_FILE)
    return None


Box = tuple[float, float, float, float]


def box(text: str) -> Box:
    """Parse the corners `x0,y0,x1,y1` of a box, millimetres from the image's centre."""
    x0, y0, x1, y1 = _parse_four_numbers(text, "x0,y0,x1,y1 in mm, e.g. -20,-20,20,20")
    if x0 >= x1 or y0 >= y1:
        raise argparse.ArgumentTypeError(f"{text!r}: x0 must be below x1 and y0 below y1")
    return x0, y0, x1, y1


def parse_centred_box(text: str) -> Box:
    """Parse `x,y,width,height`, the form of a box in earlier releases; print the present form."""
    x, y, width, height = _parse_four_numbers(text, "x,y,width,height in mm, e.g. 0,0,40,40")
    if width <= 0 or height <= 0:
        raise argparse.ArgumentTypeError(f"width and height of {text!r} must be positive")
    corners = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
    text_now = ",".join(f"{corner:g}" for corner in corners)
    sys.stderr.write(f"note: --metal is read as centre and size; write --metal-box {text_now}, as all other boxes\n")
    return corners


def _parse_four_numbers(text: str, form: str) -> Box:
    """Parse four numbers separated by commas; `form` describes them in the error message."""
    try:
        a, b, c, d = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form {form}") from None
    if not all(abs(value) <= _FARTHEST_MM for value in (a, b, c, d)):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a position in the image: numbers of at most {_FARTHEST_MM} mm"
        )
    return a, b, c, d


def file_ending(ending: str) -> Callable[[str], Path]:
    """Return a `type` for argparse: the path of a file to write, whose name has the ending of its format."""

    def convert(text: str) -> Path:
        path = Path(text)
        if path.suffix.lower() != ending:
            raise argparse.ArgumentTypeError(f"{text!r} does not end in {ending}, the format that is written")
        return path

    return convert


def readable_text(text: str) -> str:
    """Check a text that will be stored: bytes that are not UTF-8 would be lost without a message."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise argparse.ArgumentTypeError(f"{text!a} is not UTF-8: set the terminal to UTF-8, or write ASCII") from None
    return text


def join_negative_values(words: Sequence[str]) -> list[str]:
    """Return the words such that argparse takes `-45,0,40,40` for a value: `--metal-box -45,0,40,40`, `probe -60,0`."""
    out: list[str] = []
    for word in words:
        if not re.fullmatch(r"-[\d.]+(,[-\d.]+)+", word):
            out.append(word)
        elif out and out[-1].startswith("--") and "=" not in out[-1]:
            out[-1] += f"={word}"
        else:
            # With a blank in front argparse does not take it for an option.
            out.append(f" {word}")
    return out


def add_model_option(sub: argparse.ArgumentParser, none: bool = False) -> None:
    """Add `--model`; with `none` also the choice to name nothing."""
    names = ["knn", "discriminant"]
    text = "default: discriminant; knn is the paper's"
    if none:
        names.append("none")
        text += "; none: name nothing"
    sub.add_argument("--model", choices=names, help=f"classifier ({text})")


def add_config_option(sub: argparse.ArgumentParser, shipped: bool = False) -> None:
    """Add `--config`; with `shipped` the packaged rig file is used where the current folder has none."""
    default = RIG_FILE
    text = "instrument.toml"
    if shipped:
        default = find_packaged(RIG_FILE)
        text = "instrument.toml here, or the packaged one"
    sub.add_argument("--config", type=Path, default=default, metavar="FILE", help=f"rig file (default: {text})")


def add_material_options(sub: argparse.ArgumentParser) -> None:
    """Add the options that say how patches (areas of one material in the image) are found and which names they get."""
    sub.add_argument("--library", type=Path, metavar="FILE", help="reference library (default: the simulated one)")
    sub.add_argument(
        "--metal-box",
        dest="metal",
        type=box,
        metavar="X0,Y0,X1,Y1",
        help="metal reference: corners in mm from the image's centre, e.g. -80,-20,-40,20 (default: found)",
    )
    sub.add_argument("--metal", type=parse_centred_box, help=argparse.SUPPRESS)
    sub.add_argument(
        "--labels",
        type=Path,
        metavar="FILE",
        help="use the boxes of this file (polysight label, or the authors') instead of finding patches",
    )
    add_model_option(sub, none=True)


Number = TypeVar("Number", int, float)


def number(kind: Callable[[str], Number], rule: str, holds: Callable[[Number], bool]) -> Callable[[str], Number]:
    """Return a `type` for argparse: a number for which `holds` is true.

    For any other text the error is "... is not `rule`".
    """

    def convert(text: str) -> Number:
        try:
            value = kind(text)
        except ValueError:
            value = None
        if value is None or not holds(value):
            raise argparse.ArgumentTypeError(f"{text} is not {rule}")
        return value

    return convert


positive = number(float, "a number above 0", lambda value: 0 < value < math.inf)
count = number(int, "a whole number, 1 or more", lambda value: value >= 1)
# It is at most the largest signed integer of 64 bits, as the seed of a scene file.
count_from_zero = number(int, "a whole number, 0 or more", lambda value: 0 <= value < 1 << 63)
