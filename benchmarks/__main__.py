"""`python -m benchmarks [NAME [options]]`: the benchmarks of NAMES one after another, or one with its options.

`plans`, `sparse_scans` and `static_chirps` are not among them: each is a program of its own.
"""

import argparse
import importlib
import sys
from pathlib import Path

from benchmarks.measure import limit_threads

NAMES = (
    "capture",
    "sync",
    "image",
    "whole",
    "waits",
    "demo",
    "gpu",
    "scaling",
    "accuracy",
    "coverage",
    "layers",
    "picture",
    "worlds",
    "shapes",
    "touching",
    "foreign",
    "widths",
    "pi",
)


def main(argv: list[str]) -> int:
    """Run one benchmark or all; each prints its own table. Return the highest exit status."""
    limit_threads()
    modules = {name: importlib.import_module(f"benchmarks.{name}") for name in NAMES}
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--out", type=Path, default=None, help="folder for each benchmark's figures as NAME.json")
    subparsers = parser.add_subparsers(dest="name", metavar="NAME")
    for name, module in modules.items():
        summary = (module.__doc__ or "").splitlines()[0]
        module.add_arguments(subparsers.add_parser(name, help=summary, description=summary))
    args = parser.parse_args(argv)
    if args.name is None:
        options_by_name = {name: parser.parse_args([name]) for name in NAMES}
    else:
        options_by_name = {args.name: args}
    if args.out is not None:
        try:
            args.out.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            parser.error(f"--out {args.out}: {e.strerror}")
    for name, options in options_by_name.items():
        # Benchmarks without the option `json` have no such attribute; a file that was given stays.
        if args.out is not None and getattr(options, "json", "") is None:
            options.json = args.out / f"{name}.json"
    return max(modules[name].run(options) for name, options in options_by_name.items())


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
