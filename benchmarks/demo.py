"""CPU seconds of the demo's scan, mean per row by kind of process (host, Pi, ...), and of `process`."""

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.data import ROOT, temporary
from benchmarks.measure import add_arguments, count_repeats, cpu_s, line_at_most, show, write
from benchmarks.waits import command
from polysight.store import MANIFEST

__all__ = ["add_arguments", "run"]
# Time between two readings of the manifest and of the processes; chosen.
_POLL_S = 0.05
# How often the scan is processed; chosen.
REPEATS = 3
# Kind of a process by a part of its command line; the first part that occurs decides. Without any it is the host.
KINDS = {
    "receiver_process": "receivers",
    "polysight_pi": "Pi",
    "polysight_simulators": "simulators",
    "polysight": "host",
}
# Scene of `--quick`.
QUICK = ROOT / "examples" / "own-scene.toml"


def run(args: argparse.Namespace) -> int:
    """Scan and process the demo; print CPU seconds and their limits (chosen)."""
    # Not in `args.folder`, which is not used here: paths of the rig's sockets must be short.
    with temporary(None) as folder:
        scene = ROOT / "examples" / "demo.toml"
        if args.quick:
            scene = QUICK
        rows, by_kind = scan_cpu_s(folder / "demo", scene)
        # CPU seconds of each run.
        processed = [
            command(["process", str(folder / "demo" / "scan"), "--out", str(folder / f"products{n}")])[0]
            for n in range(count_repeats(args.quick, REPEATS))
        ]
    each = ", ".join(f"{kind} {seconds / rows:.2f}" for kind, seconds in by_kind.items())
    total = sum(by_kind.values()) / rows
    process_s = statistics.median(processed)
    lines = [
        line_at_most("a row of the demo's scan, all processes, CPU s", total, "s", 0.75, note=f"{rows} rows: {each}"),
        line_at_most(
            "process of that scan, CPU s",
            process_s,
            "s",
            6.0,
            note=", ".join(f"{seconds:.1f}" for seconds in processed),
        ),
    ]
    show("the demo's scan, simulated cards, radars, Pi and stage", lines, args.quick)
    write(args.json, "demo", lines, rows=rows, by_kind=by_kind, process_cpu_s=processed)
    return 0


def scan_cpu_s(out: Path, scene: Path) -> tuple[int, dict[str, float]]:
    """Run the demo; return the rows between the first commit seen and the last, and CPU seconds of each kind meanwhile.

    The fields at the radars, which the simulator computes before the first row, and the products are not counted, nor
    are processes that ended before the last commit. Raises RuntimeError if the demo fails, or no two commits were seen.
    """
    words = [sys.executable, "-m", "polysight", "demo", "--scene", str(scene), "--out", str(out)]
    demo = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.DEVNULL)
    # Number of commits, and kind and CPU seconds of each process at that time: at the first commit seen and the newest.
    first = None
    last = None
    while demo.poll() is None:
        committed = _count_commits(out / "scan" / MANIFEST)
        if committed and (last is None or committed > last[0]):
            last = committed, _measure_cpu_of_tree(demo.pid)
            first = first or last
        time.sleep(_POLL_S)
    if demo.returncode or first is None or last is None or first[0] == last[0]:
        raise RuntimeError(f"the demo ended with status {demo.returncode}")
    by_kind = dict.fromkeys(KINDS.values(), 0.0)
    for pid, (kind, seconds) in last[1].items():
        by_kind[kind] += seconds - first[1].get(pid, (kind, 0.0))[1]
    return last[0] - first[0], by_kind


def _count_commits(manifest: Path) -> int:
    """Return the number of commits of rows in a scan's manifest (a row committed again counts again); 0 without it."""
    if not manifest.exists():
        return 0
    return manifest.read_text(encoding="utf-8").count('"row_committed"')


def _measure_cpu_of_tree(root: int) -> dict[int, tuple[str, float]]:
    """Return kind and CPU seconds of a process and all below it, by process id."""
    parents = dict(_list_parents())
    tree = {}
    for pid in parents:
        above = pid
        while above not in (root, 0):
            above = parents.get(above, 0)
        if above == root:
            try:
                line = Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8", errors="replace").replace("-", "_")
                tree[pid] = next((name for part, name in KINDS.items() if part in line), "host"), cpu_s(pid)
            except (FileNotFoundError, ProcessLookupError):
                continue
    return tree


def _list_parents() -> Iterator[tuple[int, int]]:
    """Yield the id of every process and that of its parent."""
    for process in Path("/proc").iterdir():
        if process.name.isdigit():
            try:
                status = (process / "stat").read_text(encoding="utf-8", errors="replace")
            except (FileNotFoundError, ProcessLookupError):
                continue
            # After the name, which is in brackets: state, then the parent (proc(5)).
            yield int(process.name), int(status.rsplit(")", 1)[1].split()[1])
