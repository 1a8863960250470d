"""The commands of a page, run in a scratch copy of the repository as a newcomer would, in the order of the page."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from docs.check.pages import ROOT, Page

LIMIT_S = 900.0
"""A page that takes longer has failed; chosen."""
# Scene of the simulated rig, and its seconds per second.
RIG_SCENE = "examples/nine-materials.toml"
RIG_TIME_SCALE = 40
# Not copied: large files, and those made by the programs.
_LEFT_OUT = shutil.ignore_patterns(
    *(".git", ".venv", Path(sys.prefix).name, "out", "build", "__pycache__", ".*_cache", "*.egg-info", "scans")
)


@dataclass(frozen=True)
class PageRun:
    """How a page's commands ended: at which line it failed (0: it did not), the time, and the output's end."""

    failed_line: int
    seconds: float
    output: str


def scratch_copy(folder: Path, root: Path = ROOT) -> Path:
    """A copy of the working tree with this environment as its .venv; nothing that a page does reaches the tree."""
    copy = folder / "polysight"
    shutil.copytree(root, copy, ignore=_LEFT_OUT)
    (copy / ".venv").symlink_to(sys.prefix)
    for file in copy.rglob("pyproject.toml"):
        # Older than .venv/installed: `make` shall not install the copy.
        os.utime(file, (0, 0))
    return copy


def make_script(page: Page) -> str:
    """A shell script whose line numbers are the page's: all but the commands to be run is left blank."""
    lines = [""] * len(page.path.read_text(encoding="utf-8").splitlines())
    for block in page.blocks:
        for number, text in block.shell_lines() if block.is_run else ():
            lines[number - 1] = text
        if block.is_run and block.language == "python":
            # The shell's words stand where the page has its fences.
            lines[block.line - 2] = "python - <<'PYTHON'"
            lines[block.line - 1 + block.text.count("\n")] = "PYTHON"
    # On the first line, which is a heading: stop at the first failure, and say before each command where we are.
    lines[0] = f"set -euo pipefail; trap 'echo $LINENO >\"$AT_LINE\"' DEBUG; {lines[0]}"
    return "\n".join(lines) + "\n"


def run_page(page: Page, copy: Path, limit_s: float = LIMIT_S) -> PageRun:
    """Run a page's commands in `copy`, with a simulated rig running where a block asks for one."""
    began = time.monotonic()
    work = copy.parent / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    script = work / "page.sh"
    script.write_text(make_script(page), encoding="utf-8")
    # Holds the line of the command that runs, see `make_script`.
    at = work / "at"
    at.write_text("0")
    environment = {
        **os.environ, "PATH": f"{copy / '.venv/bin'}:{os.environ['PATH']}", "AT_LINE": str(at), "LC_ALL": "C.UTF-8",
        "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(copy),
    }  # fmt: skip
    rig = None
    shell = None
    with (work / "output").open("w+") as output:
        try:
            if any("rig" in block.info[1:] for block in page.blocks):
                rig = _start_rig(copy, work, environment)
            shell = subprocess.Popen(
                ["bash", str(script)], cwd=copy, env=environment, stdout=output, stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL, start_new_session=True,
            )  # fmt: skip
            try:
                status = shell.wait(limit_s)
            except subprocess.TimeoutExpired:
                # As of timeout(1).
                status = 124
        finally:
            if shell is not None:
                # The shell, or programs that it left running.
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(shell.pid, signal.SIGKILL)
                shell.wait()
            if rig is not None:
                _end(rig)
                shutil.copy(ROOT / "instrument.toml", copy)
        output.seek(0)
        output_text = output.read()
    return PageRun(max(1, int(at.read_text())) if status else 0, time.monotonic() - began, output_text[-3000:])


def _start_rig(copy: Path, work: Path, environment: dict[str, str]) -> subprocess.Popen[str]:
    """A simulated rig; `instrument.toml` of the copy becomes the one that reaches it."""
    command = [sys.executable, "-m", "polysight_simulators.rig", "--config", "instrument.toml", "--scene", RIG_SCENE]
    command += ["--dir", str(work / "rig"), "--time-scale", str(RIG_TIME_SCALE), "--with-pi", "--native"]
    rig = subprocess.Popen(
        command, cwd=copy, env=environment, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    output_text = rig.stdout.readline() if rig.stdout else ""
    if not output_text.startswith("ready "):
        _end(rig)
        raise RuntimeError(f"the simulated rig did not start; its logs are in {work / 'rig/logs'}")
    shutil.copy(work / "rig/instrument.toml", copy)
    return rig


def _end(rig: subprocess.Popen[str]) -> None:
    """End the simulated rig; kill it if it does not end within 20 s."""
    rig.terminate()
    try:
        rig.communicate(timeout=20)
    except subprocess.TimeoutExpired:
        rig.kill()
        rig.communicate()
