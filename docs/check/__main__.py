"""`python -m docs.check [--run] [PAGE ...]`: check README and docs; with --run, run their commands."""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from docs.check.commands import is_ours
from docs.check.looking import page_faults
from docs.check.pages import SHELLS, Block, Page, all_pages, read_page
from docs.check.running import PageRun, run_page, scratch_copy


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _why_not_run(block: Block, first_line: int, run: PageRun | None) -> str:
    """Return why the commands of a block were not run, or that one failed; "" if they ran.

    `first_line` is that of its first command, `run` how the commands of its page ended; None without `--run`.
    """
    if block.kept_back:
        return block.kept_back
    if run is None:
        return "--run not given"
    last_line = block.line + block.text.count("\n")
    if not run.failed_line or run.failed_line > last_line:
        return ""
    if run.failed_line < first_line:
        return "not reached"
    return "FAILED"


def _table(pages: Sequence[Page], runs: dict[Path, PageRun]) -> None:
    """Print every shell block: run, or only checked and why."""
    _say("\nshell blocks of the pages:")
    count_run = 0
    count_checked = 0
    for page in pages:
        for block in page.blocks:
            commands = block.commands() if block.language in SHELLS or block.is_run else []
            if block.language == "python":
                # A program counts as one.
                commands = commands[:1]
            if block.language == "":
                commands = [(n, text) for n, text in enumerate(block.text.splitlines(), block.line) if is_ours(text)]
            if not commands:
                continue
            first_line, first_command = commands[0]
            why = _why_not_run(block, first_line, runs.get(page.path))
            if why:
                state = "checked"
                count_checked += len(commands)
            else:
                state = "run"
                count_run += len(commands)
            _say(f"  {state:7}  {page.name}:{block.line:<4} {first_command[:70]:70}  {why}")
    _say(f"{count_run} commands run, {count_checked} only checked")


def main(argv: Sequence[str] | None = None) -> int:
    """Check the pages; 0 only when nothing is wrong."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.check",
        description="Check links and commands of README and docs.",
        epilog="example:\n  python -m docs.check --run docs/how-to/scan.md",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("pages", nargs="*", type=Path, metavar="PAGE", help="default: README and all of docs")
    parser.add_argument("--run", action="store_true", help="run the commands too, in a scratch copy")
    args = parser.parse_args(argv)
    for path in args.pages:
        if not path.is_file():
            parser.error(f"{path} is not a page")
    pages = [read_page(path.resolve()) for path in args.pages or all_pages()]
    faults = [fault for page in pages for fault in page_faults(page)]
    runs: dict[Path, PageRun] = {}
    if args.run:
        with tempfile.TemporaryDirectory(prefix="docs-") as folder:
            copy = scratch_copy(Path(folder))
            for page in pages:
                if any(block.is_run for block in page.blocks):
                    run = runs[page.path] = run_page(page, copy)
                    _say(f"{'FAILED' if run.failed_line else 'ran   '}  {page.name}  {run.seconds:.0f} s")
                    if run.failed_line:
                        faults.append(f"{page.name}:{run.failed_line}: this command failed; the end of what it said:\n")
                        faults[-1] += run.output
    _table(pages, runs)
    for fault in faults:
        _say(fault)
    links = sum(len(page.links) for page in pages)
    _say(f"{len(pages)} pages, {links} links, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    # The commands of a page have a session of their own: they end with this program, as at Ctrl-C.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    sys.exit(main())
