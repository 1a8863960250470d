"""`polysight`: the host's commands. Exit status 0 only when it worked; what, why and what to do on stderr otherwise."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from polysight.host.cli_calibrate import add_calibrate_command
from polysight.host.cli_card import add_card_arguments, card_status
from polysight.host.cli_doctor import add_doctor_command
from polysight.host.cli_export import add_export_command
from polysight.host.cli_materials import add_material_commands
from polysight.host.cli_numbers import positive
from polysight.host.cli_options import RIG, add_config_option, add_material_options, joined, options_of, rig_file
from polysight.host.cli_plan import add_plan_command
from polysight.host.cli_polarimetry import add_leakage_command, add_polarimetry_options, with_polarimetry
from polysight.host.cli_preview import add_preview_command
from polysight.host.cli_process import add_data_arguments, process_scans
from polysight.host.cli_reproduce import add_reproduce_command
from polysight.host.cli_scan import add_scan_commands
from polysight.shared.errors import ConfigError, PolysightError, os_error

Run = Callable[[argparse.Namespace], int]


def _demo(args: argparse.Namespace) -> int:
    from polysight.host.jobs.demo import run_demo

    return run_demo(args.scene, args.config, args.out, args.time_scale)


def _simulate(args: argparse.Namespace) -> int:
    from polysight.host.jobs.demo import run_simulator

    command = ["simulate", str(args.scene), "--config", str(args.config), "--out", str(args.out)]
    command += ["--layout", args.layout]
    if args.seed is not None:
        command += ["--seed", str(args.seed)]
    return run_simulator(command)


def _process(args: argparse.Namespace) -> int:
    return process_scans(args, process_one, rig_file)


def process_one(args: argparse.Namespace) -> int:
    """`polysight process` of one scan."""
    from polysight.host.jobs.process import process

    config = rig_file(args)
    return process(args.data, args.out, config, with_polarimetry(options_of(args), args, config))


def _image(args: argparse.Namespace) -> int:
    from polysight.host.jobs.process import image

    return image(args.data, args.out, rig_file(args))


def _focus(args: argparse.Namespace) -> int:
    from polysight.host.jobs.process import focus

    return focus(args.data, args.out, rig_file(args), args.depth)


def _sync_report(args: argparse.Namespace) -> int:
    from polysight.host.jobs.process import sync_report

    return sync_report(args.data, args.out, rig_file(args))


def _train(args: argparse.Namespace) -> int:
    if args.authors is not None and (args.data or args.simulate):
        raise ConfigError(
            f"{'DATA' if args.data else '--simulate'} and --authors together",
            "a library is made of scans of this rig, or of the published files: not of both",
            "give one of them",
        )
    if args.authors is not None:
        from polysight.papers.sensys2026.dataset import train_authors

        return train_authors(args.authors, args.config, args.out)
    from polysight.host.jobs.process import train

    return train(args.simulate, args.data, args.config, args.out)


def _inspect(args: argparse.Namespace) -> int:
    from polysight.host.jobs.scan_files import inspect_file

    return inspect_file(args.file, args.config, args.plot, args.card, args.json)


def build_parser() -> argparse.ArgumentParser:
    """The whole command line."""
    parser = argparse.ArgumentParser(
        prog="polysight",
        description="See what things are made of: bistatic polarimetric SAR with commodity mmWave radars.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="example:\n  polysight demo --out out/demo\n\n`polysight COMMAND --help` says more about a command.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, run: Run, text: str, example: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name,
            help=text,
            description=f"{text[0].upper()}{text[1:]}.",
            epilog=f"example:\n  {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.set_defaults(run=run)
        return sub

    sub = add(
        "demo",
        _demo,
        "scan a scene with the whole rig simulated, and make the report; no hardware is needed",
        "polysight demo --out out/demo",
    )
    add_config_option(sub)
    sub.add_argument(
        "--scene",
        type=Path,
        default=Path("examples/nine-materials.toml"),
        metavar="FILE",
        help="what to scan (default: nine materials)",
    )
    sub.add_argument(
        "--out",
        type=Path,
        default=Path("out/demo"),
        metavar="DIR",
        help="folder to make (default: out/demo); an earlier demo's is replaced",
    )
    sub.add_argument(
        "--time-scale", type=positive, default=None, metavar="X", help="simulated seconds per second (default: 40)"
    )

    sub = add(
        "simulate",
        _simulate,
        "make the raw data of a scene, with truth.json, in one step and without processes",
        "polysight simulate examples/point-targets.toml --out out/points",
    )
    add_config_option(sub)
    sub.add_argument("scene", type=Path, metavar="SCENE.toml", help="what to scan, e.g. examples/metal-plate.toml")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    sub.add_argument(
        "--layout",
        choices=["own", "authors"],
        default="own",
        help="a scan folder of this program (default), or unsynced/<scan> as the paper's authors publish it",
    )
    sub.add_argument("--seed", type=int, default=None, help="noise seed (default: the scene's)")

    add_scan_commands(add)
    for name, run, text in (
        ("process", _process, "make images, material names and the report from recorded data"),
        ("image", _image, "make only the images from recorded data (image.npz), without naming materials"),
    ):
        sub = add(name, run, text, f"polysight {name} scans/one --out out/one")
        add_data_arguments(sub, several=name == "process")
        if name == "process":
            add_material_options(sub)
            add_polarimetry_options(sub)

    sub = add(
        "focus",
        _focus,
        "find the object plane's distance and tilt by the sharpness of the image; changes no file of the scan",
        "polysight focus scans/one --out out/focus",
    )
    sub.add_argument("data", type=Path, metavar="DATA", help="scan folder, or the authors' unsynced/<scan>")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for focus.json and focus.png")
    sub.add_argument(
        "--depth", type=positive, default=8.0, metavar="MM", help="how far to look to either side (default: 8 mm)"
    )
    sub.add_argument("--config", type=Path, default=None, metavar="FILE", help="rig file for unsynced/<scan>")

    sub = add(
        "sync-report",
        _sync_report,
        "say what synchronisation leaves of frequency, phase and amplitude errors, beside the Cramer-Rao bound",
        "polysight sync-report scans/one --out out/sync",
    )
    sub.add_argument("data", type=Path, metavar="DATA", help="scan folder, or the authors' unsynced/<scan>")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for sync.json, sync.txt, figures")
    sub.add_argument(
        "--config",
        type=Path,
        default=None,
        metavar="FILE",
        help="rig file for unsynced/<scan>; scan folders bring their own (default: instrument.toml, if it is here)",
    )

    sub = add(
        "train",
        _train,
        "make the classifier's reference library from scans of known plates",
        "polysight train --simulate examples/library --out library.npz",
    )
    add_config_option(sub)
    sub.add_argument("data", type=Path, nargs="*", metavar="DATA", help="scan folders with truth.json")
    sub.add_argument(
        "--simulate", type=Path, default=None, metavar="DIR", help="simulate every scene in DIR and use it"
    )
    sub.add_argument(
        "--authors", type=Path, default=None, metavar="DIR", help="the published data set: its materials/ and labels/"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="FILE", help="library to write (.npz)")

    add_material_commands(add)
    add_reproduce_command(add, RIG)
    add_leakage_command(add, RIG)
    add_preview_command(add)
    add_doctor_command(add, RIG)
    add_calibrate_command(add)
    add_plan_command(add, RIG)
    add_export_command(add)

    sub = add(
        "card", card_status, "say of each capture card which hop to it is silent; write its addresses", "polysight card"
    )
    add_config_option(sub)
    add_card_arguments(sub)

    sub = add(
        "inspect", _inspect, "say what a recording of a DCA1000 holds", "polysight inspect scans/one/raw/RH/0000.bin"
    )
    sub.add_argument(
        "file", type=Path, metavar="FILE", help="payload (.bin), or packets recorded by tcpdump -w (.pcap)"
    )
    sub.add_argument(
        "--config", type=Path, metavar="RIG", help="rig file it was recorded with (default: a scan's own; else guessed)"
    )
    sub.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the range profile of every antenna")
    sub.add_argument("--card", default="", metavar="ADDRESS", help="which card, where packets of several were recorded")
    sub.add_argument("--json", action="store_true", help="print JSON, for programs")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    args = build_parser().parse_args(joined(sys.argv[1:] if argv is None else argv))
    # Two BLAS threads on two busy cores wait for each other in a spin: ten times slower than one thread each.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM ends as cleanly as Ctrl-C
    try:
        return args.run(args)
    except PolysightError as e:
        sys.stderr.write(f"polysight {args.command}: {e}\n")
        return e.exit_status
    except KeyboardInterrupt:
        sys.stderr.write(f"polysight {args.command}: stopped\n")
        return 128 + signal.SIGINT
    except BrokenPipeError:
        # Whoever read our output has enough; nothing must be flushed to it at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as e:
        error = os_error(e)
        sys.stderr.write(f"polysight {args.command}: {error}\n")
        return error.exit_status


if __name__ == "__main__":
    sys.exit(main())
