"""Waiting times of a user: last row to image and report, another plane from kept samples, lists of scans, commands."""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.data import ROOT, SCENE, published_scene, recorded_rows, temporary, write_scan
from benchmarks.measure import Seconds, add_arguments, count_repeats, line_at_most, show, write
from benchmarks.whole import rows_that_fit
from polysight.catalogue import Scans
from polysight.jobs.process import make_products, publish_images
from polysight.pipeline import Pipeline
from polysight.settings import Settings
from polysight.store import MANIFEST, ScanFolder

__all__ = ["add_arguments", "run"]
# How often each wait is measured; the median counts.
REPEATS = 3
# CPU seconds that each command may take (all limits here are chosen); {made} is a folder of products.
COMMANDS = {
    "--help": 0.2,
    "materials {made}": 0.6,
    "report {made}": 0.6,
    "permittivity {made}": 0.6,
    "plan": 1.0,
}


def rows_then_products(scan: Path, out: Path) -> dict[str, float]:
    """Process a scan as if it were recorded now; return wall seconds from its last row to images and to the report."""
    source = ScanFolder.load(scan)
    pipeline = Pipeline(source, live=True, samples="keep")
    rows = list(source.rows())
    for row in rows[:-1]:
        pipeline.add_row(row)
    began = time.perf_counter()
    # From raw data, even where the samples are kept.
    pipeline.synchronise_row(rows[-1])
    pipeline.samples.save(rows[-1])
    publish_images(pipeline, out)
    image_s = time.perf_counter() - began
    make_products(pipeline, out, ())
    return {"image": image_s, "report": time.perf_counter() - began}


def from_samples(scan: Path, repeats: int) -> tuple[Seconds, Seconds]:
    """Measure reading all rows back and making the images of H and V, each time in a new pipeline.

    Return the seconds for images on the rig file's plane, and on another plane.
    """
    same = Seconds()
    other_seconds = Seconds()
    for _ in range(repeats + 1):
        for took, depth_mm in ((same, 0.0), (other_seconds, 5.0)):
            source = ScanFolder.load(scan)
            pipeline = Pipeline(source, Settings(depth_mm=depth_mm), samples="read")
            rows = list(source.rows())
            if not all(pipeline.samples.is_kept(row) for row in rows):
                raise RuntimeError("samples were not kept")
            with took.time_block():
                for row in rows:
                    pipeline.add_row(row)
                pipeline.form_images()
    # The first round makes kernels, so it does not count.
    for took in (same, other_seconds):
        del took.cpu[0], took.wall[0]
    return same, other_seconds


def time_list(scan: Path, products: Path, root: Path, count: int) -> tuple[Seconds, Seconds]:
    """Time a list of `count` scans below `root`, at first and later; each has manifest and products, but no report."""
    for n in range(count):
        shutil.copytree(
            products, root / f"scan-{n}" / "products", ignore=shutil.ignore_patterns("report.html", "figures")
        )
        shutil.copy(scan / MANIFEST, root / f"scan-{n}")
    first = Seconds()
    next_seconds = Seconds()
    for _ in range(REPEATS):
        scans = Scans(root)
        for took in (first, next_seconds):
            with took.time_block():
                if len(scans.list()) != count:
                    raise RuntimeError("scans are missing in the list")
    return first, next_seconds


def command(words: list[str]) -> tuple[float, float]:
    """Run `polysight WORDS`; return its CPU and wall seconds. Raises RuntimeError if it fails."""
    start = os.times()
    began = time.perf_counter()
    process = subprocess.run([sys.executable, "-m", "polysight", *words], cwd=ROOT, capture_output=True, check=False)
    wall = time.perf_counter() - began
    end = os.times()
    if process.returncode:
        raise RuntimeError(f"polysight {' '.join(words)}: {process.stderr.decode()}")
    return end.children_user + end.children_system - start.children_user - start.children_system, wall


def run(args: argparse.Namespace) -> int:
    """Measure all waits and print the table; return 0."""
    rig, scene = published_scene(args.quick)
    repeats = count_repeats(args.quick, REPEATS)
    most_rows = rig.grid.rows
    scans_in_list = 200
    if args.quick:
        most_rows = 20
        scans_in_list = 20
    with temporary(args.folder) as folder:
        count = rows_that_fit(rig, most_rows, folder)
        # Four simulated rows, again and again.
        write_scan(folder / "scan", rig, recorded_rows(rig, scene, min(4, count)), count)
        after_last_row = [rows_then_products(folder / "scan", folder / f"out{n}") for n in range(repeats)]
        same, other_seconds = from_samples(folder / "scan", repeats)
        products = small_products(folder)
        first, next_seconds = time_list(folder / "scan", products, folder / "many", scans_in_list)
        command_times = {
            name: [command(name.format(made=products).split()) for _ in range(repeats)] for name in COMMANDS
        }
    boards = len(rig.receivers)
    lines = []
    for stage, limit in (("image", 0.1), ("report", 4.0)):
        waited = [seconds_by_stage[stage] for seconds_by_stage in after_last_row]
        note = ", ".join(f"{seconds:.2f}" for seconds in waited)
        lines.append(
            line_at_most(f"last committed row to {stage}, wall s", statistics.median(waited), "s", limit, note=note)
        )
    for name, took in (("its own plane", same), ("another plane", other_seconds)):
        lines.append(
            line_at_most(f"image from kept samples, {name}, a board, CPU s", took.median / boards, "s", 0.15, 0.1)
        )
    for name, took in (("first look", first), ("later", next_seconds)):
        note = f"{took.median_wall:.2f} s wall"
        lines.append(
            line_at_most(
                f"list of {scans_in_list} scans of the operator's page, {name}, CPU s", took.median, "s", 1.0, 0.5, note
            )
        )
    for name, times in command_times.items():
        cpu = statistics.median(t[0] for t in times)
        wall = statistics.median(t[1] for t in times)
        note = f"{wall:.2f} s wall"
        lines.append(line_at_most(f"polysight {name.split()[0]}, CPU s", cpu, "s", COMMANDS[name], note=note))
    show("waiting times, simulated rows", lines, args.quick)
    write(args.json, "waits", lines, behind=after_last_row, commands=command_times)
    return 0


def small_products(folder: Path) -> Path:
    """Simulate and process a small scan; return the folder of its products, for commands that read products."""
    scan = folder / "small"
    products = folder / "made"
    rig = ["--config", str(ROOT / "instrument.toml")]
    # A scene smaller than the published one.
    small = SCENE.parent / "own-scene.toml"
    subprocess.run(
        [sys.executable, "-m", "polysight_simulators", "simulate", str(small), *rig, "--out", str(scan)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    command(["process", str(scan), "--out", str(products)])
    shutil.rmtree(scan)
    return products
