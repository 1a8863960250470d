"""The Pi half at 10 positions/s on a stand-in GPIO chip: CPU, memory, edge to first pulse, period, width."""

import argparse
import os
import subprocess
import sys
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import tomli_w
import zmq

from benchmarks.data import temporary
from benchmarks.measure import add_arguments as add_common, cpu_s, machine, write
from polysight.acquisition import PiClient, make_begin_run
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.messages import Capture, RowFinished
from polysight_shared.raster import plan_raster
from polysight_shared.tables import to_builtins
from polysight_shared.wires import WireClient, WireEdge
from polysight_simulators import gpio

RIG = Path(__file__).parents[1] / "instrument.toml"
# Limits (chosen): share of a core, and resident memory.
CPU_AT_MOST = 0.15
MEMORY_AT_MOST_MB = 60.0
# Longest time of a row: ROW_POINTS take 3.5 s.
LIMIT_S = 60.0
# Rows are short, because a busy machine ends some of them with a fault.
ROW_POINTS = 35


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    add_common(parser)
    parser.add_argument("--points", type=int, default=350, metavar="N", help="positions to measure (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """Measure and print; return 0 if processor and memory are within their limits."""
    points = 20 if args.quick else args.points
    with temporary(args.folder) as folder, ExitStack() as stack:
        figures = _measure(_make_rig(folder, min(points, ROW_POINTS)), points, folder, stack)
    print(f"\nthe Pi half, simulated: {points} positions, 10 a second, 16 pulses each; this machine, not a Pi")
    this_machine = machine()
    print(f"{this_machine['cpu']}, {this_machine['cores']} cores, load {this_machine['load_average'][0]}")
    for name, value in figures.items():
        print(f"  {name:48s} {value}")
    write(args.json, "pi", [], figures=figures)
    within = figures["CPU, share of a core"] < CPU_AT_MOST and figures["memory at most, MB"] < MEMORY_AT_MOST_MB
    return 0 if within or args.quick else 1


def _make_rig(folder: Path, points: int) -> Instrument:
    """Return the rig file's rig with one row of so many points, and its devices and journals in `folder`."""
    rig = load_instrument(RIG)
    replace = msgspec.structs.replace
    # Half of a row with steps of 2 mm lies before the stage's centre, and the run-up.
    stage = replace(rig.stage, port=str(folder / "tty"), centre_x_mm=points + 5.0, centre_y_mm=2.0)
    pi = replace(
        rig.pi, gpio_chip=str(folder / "chip"), one_shot=True, journal_dir=str(folder / "journal"),
        command_address="tcp://127.0.0.1:*", event_address="tcp://127.0.0.1:*",
    )  # fmt: skip
    return replace(rig, grid=replace(rig.grid, columns=points, rows=1), stage=stage, pi=pi)


def _start(stack: ExitStack, module: str, *args: object, **environment: str) -> tuple[subprocess.Popen[str], str]:
    """Start a process and wait for its line `ready`; return it with the rest of that line. The stack ends it."""
    command = [sys.executable, "-m", module, *map(str, args)]
    process = stack.enter_context(
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env={**os.environ, **environment})
    )
    stack.callback(process.terminate)
    if process.stdout is None:
        raise RuntimeError("no output")
    return process, process.stdout.readline().removeprefix("ready").strip()


def _measure(rig: Instrument, points: int, folder: Path, stack: ExitStack) -> dict[str, Any]:
    """Start wires, stage and Pi half, run rows until so many points are measured, and return the figures by name.

    `stack` ends the processes.
    """
    config = folder / "rig.toml"
    hub = folder / "wires"
    config.write_text(tomli_w.dumps(to_builtins(rig)), encoding="utf-8")
    _start(stack, "polysight_simulators.wires", "--socket", hub)
    options = ("--config", config, "--wires", hub, "--link", rig.stage.port)
    _start(stack, "polysight_simulators.stage", *options)
    environment = gpio.environment(Path(rig.pi.gpio_chip), hub)
    process, command_address = _start(stack, "polysight_pi", "run", "--config", config, **environment)
    event_address = ""
    if process.stdout:
        event_address = process.stdout.readline().split()[1]
    wires = WireClient(hub, listen=rig.pi.sync_out)
    stack.callback(wires.close)
    addresses = msgspec.structs.replace(rig.pi, command_address=command_address, event_address=event_address)
    context: zmq.Context[Any] = zmq.Context()
    stack.callback(context.destroy, linger=0)
    client = stack.enter_context(PiClient(context, msgspec.structs.replace(rig, pi=addresses)))
    rows = _Rows(client, rig, wires, process.pid)
    while len(rows.bursts) < points:
        rows.take_row()
    status = Path(f"/proc/{process.pid}/status").read_text().split()
    captures = [c for c, _ in rows.bursts]
    late_us = sorted((c.first_pulse_ns - c.edge_ns) / 1e3 for c in captures)
    # Of the edges of a burst every second one rises.
    rises = [[e.t_ns for e in burst[::2]] for _, burst in rows.bursts]
    error_us = sorted(abs((b - a) / 1e3 - rig.burst.period_us) for burst in rises for a, b in pairwise(burst))
    high_us = sorted((b.t_ns - a.t_ns) / 1e3 for _, e in rows.bursts for a, b in zip(e[::2], e[1::2], strict=True))
    width_us = sorted(c.width_max_ns / 1e3 for c in captures)
    return {
        "rows, and how many a busy machine ended early": [rows.rows, len(rows.faults)],
        "faults of those": sorted(set(rows.faults)),
        "CPU, share of a core": round(rows.cpu_s / rows.wall_s, 3),
        "memory at most, MB": round(int(status[status.index("VmHWM:") + 1]) / 1e3, 1),
        "edge to first pulse, us: p50, p99.9, worst": _compute_quantiles(late_us),
        "period off by, us: p50, p99.9, worst": _compute_quantiles(error_us),
        "pulse width, us: p50, p99.9, worst": _compute_quantiles(high_us),
        "reported bound of a burst's widest, us: p50, p99.9": _compute_quantiles(width_us)[:2],
    }


class _Rows:
    """Run rows one after another and record their edges on the wires; `pid` is the Pi half's."""

    def __init__(self, client: PiClient, rig: Instrument, wires: WireClient, pid: int) -> None:
        self._client = client
        self._wires = wires
        self._pid = pid
        self.rows = 0
        self.cpu_s = 0.0
        self.wall_s = 0.0
        self.faults: list[int] = []
        # Complete bursts, each with its edges on SYNC_IN.
        self.bursts: list[tuple[Capture, list[WireEdge]]] = []
        client.follow("benchmark", 0, lambda _: None)
        client.begin_run(make_begin_run(rig, "benchmark", plan_raster(rig.grid)))

    def take_row(self) -> None:
        """Run one row to its end and add its bursts; processor time counts from its first capture on.

        Raises SystemExit if the row does not end, or if the edges on the wires are not those reported.
        """
        self.rows += 1
        while (state := self._client.status().state) != "ready":
            if state in ("idle", "fault"):
                self._client.home()
            time.sleep(0.05)
        self._client.run_row("benchmark", 0, self.rows)
        edges: list[WireEdge] = []
        captures: list[Capture] = []
        cpu_at_start_s = 0.0
        start_s = 0.0
        finished = None
        deadline = time.monotonic() + LIMIT_S
        while finished is None:
            if time.monotonic() > deadline:
                raise SystemExit("a row does not end")
            message = self._wires.receive(0.05)
            if isinstance(message, WireEdge):
                edges.append(message)
            for event in self._client.events():
                if isinstance(event, Capture):
                    if not captures:
                        cpu_at_start_s = cpu_s(self._pid)
                        start_s = time.monotonic()
                    captures.append(event)
                if isinstance(event, RowFinished):
                    finished = event
        if captures:
            self.cpu_s += cpu_s(self._pid) - cpu_at_start_s
            self.wall_s += time.monotonic() - start_s
        # The last edges may come after the event: until half a second brings none (chosen).
        while isinstance(message := self._wires.receive(0.5), WireEdge):
            edges.append(message)
        if finished.fault:
            self.faults.append(finished.fault)
        if len(edges) != 2 * finished.pulses:
            raise SystemExit(f"{len(edges)} edges on the wires, {finished.pulses} pulses reported")
        first_edge = 0
        for capture in captures:
            next_edge = first_edge + 2 * capture.pulses
            # A fault may have cut the last burst short.
            if not finished.fault or capture is not captures[-1]:
                self.bursts.append((capture, edges[first_edge:next_edge]))
            first_edge = next_edge


def _compute_quantiles(values: list[float]) -> list[float]:
    """Return median, 99.9th percentile and maximum of ascending values, rounded to hundredths."""
    shares = [0.5, 0.999, 1.0]
    return [round(values[min(len(values) - 1, int(q * len(values)))], 2) for q in shares]
