"""The commands around a rig and its scans, simulated or real.

Simulated: demo, simulate, reproduce. Real: plan, doctor, card, inspect, radar, jog, scan, resume,
validate, drop-raw. `add` takes a command's name, its function (of this file, or the name of one of `polysight.jobs`,
such as "devices.jog_stage"), a line of help, examples, and the options that come first in its help.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from polysight.cli.options import (
    RIG_FILE,
    AddCommand,
    add_action,
    add_config_option,
    add_json_option,
    add_material_options,
    count,
    count_from_zero,
    file_ending,
    material_settings,
    number,
    parse_shipped_path,
    positive,
)
from polysight.data import find_packaged
from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError, ErrorCode

# Limits of options are chosen, far beyond values of a rig, unless a comment says otherwise.
_bursts = number(int, "a whole number from 1 to 16", lambda value: 1 <= value <= 16)
# At less than a few wavelengths of 4 mm, an antenna does not see a plane wave.
_distance = number(float, "a distance from 20 to 10000 mm", lambda value: 20 <= value <= 10_000)
_seconds = number(float, "a number of seconds from 0 to 3600", lambda value: 0 <= value <= 3600)
_minutes = number(float, "a time of 0.01 to 100000 minutes", lambda value: 0.01 <= value <= 100_000)
_decibels = number(float, "a ratio of -100 to 100 dB", lambda value: abs(value) <= 100)
_jog_mm = number(float, "a distance of -100 to 100 mm", lambda value: 0 < abs(value) <= 100)
_scene_side = number(float, "a length above 0, at most 10000 mm", lambda value: 0 < value <= 10_000)


def add_commands(add: AddCommand) -> None:
    """Register the commands."""
    _add_simulated(add)
    _add_plan(add)
    _add_doctor(add)
    _add_card(add)
    _add_inspect(add)
    _add_radar(add)
    _add_jog(add)
    _add_scans(add)


# --- plan ---

_NUMBERS = (
    ("--columns", count, "positions in a row"),
    ("--rows", count, "rows"),
    ("--step-x-mm", positive, "distance of positions in a row; the aperture keeps its size"),
    ("--step-y-mm", positive, "distance of rows; the aperture keeps its size"),
    ("--width-mm", positive, "aperture in x"),
    ("--height-mm", positive, "aperture in y"),
    ("--object-distance-mm", _distance, "z of the object plane"),
    ("--speed-mm-s", positive, "stage speed in a row"),
    ("--accel-mm-s2", positive, "acceleration of the stage"),
    ("--pulses", count, "chirps a position"),
    ("--period-us", positive, "time from one chirp of a burst to the next"),
)


def _plan(args: argparse.Namespace) -> int:
    """Run `polysight plan`."""
    from polysight.planning import PlanChanges, PlanOptions, run_plan

    names = [flag[2:].replace("-", "_") for flag, _, _ in _NUMBERS]
    options = PlanOptions(
        minutes=args.minutes,
        count=args.count,
        like=args.like,
        snr_db=args.snr_db,
        row_overhead_s=args.row_overhead_s,
        scene_mm=args.scene_mm,
        scene=args.scene,
        as_json=args.as_json,
    )
    return run_plan(args.config, PlanChanges(**{name: getattr(args, name) for name in names}), options)


def _parse_size(text: str) -> tuple[float, float]:
    """Parse WIDTH,HEIGHT in millimetres."""
    try:
        width, height = (_scene_side(part) for part in text.split(","))
    except (ValueError, argparse.ArgumentTypeError):
        form = "WIDTH,HEIGHT in mm, at most 10000, e.g. 170,170"
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form {form}") from None
    return width, height


def _add_plan(add: AddCommand) -> None:
    """Add `polysight plan` and its options."""
    sub = add(
        "plan",
        _plan,
        "predict time, resolution, noise and data of a scan, or propose the best scans within a time",
        "polysight plan --minutes 30\n  polysight plan --speed-mm-s 100 --pulses 16 --period-us 750",
        ("--minutes", "--like"),
    )
    add_config_option(sub, shipped=True)
    sub.add_argument("--minutes", type=_minutes, metavar="M", help="propose the best plans within this time")
    sub.add_argument("--count", type=count, default=5, metavar="N", help="number of proposals (default: 5)")
    sub.add_argument("--like", type=Path, metavar="SCAN", help="use the noise and the pauses between rows of this scan")
    sub.add_argument(
        "--scene", type=parse_shipped_path, metavar="FILE", help="scene file whose plates are checked, with its grid"
    )
    sub.add_argument("--scene-mm", type=_parse_size, metavar="W,H", help="size of the scene (default: the image's)")
    sub.add_argument(
        "--snr-db",
        type=_decibels,
        metavar="DB",
        help="direct path over noise per channel, sample and chirp (default: 5.5)",
    )
    sub.add_argument(
        "--row-overhead-s",
        type=_seconds,
        metavar="S",
        help="standstill between rows (default: 0.3, simulated)",
    )
    add_json_option(sub)
    group = sub.add_argument_group("numbers of the plan", "instead of the rig file's")
    for flag, kind, text in _NUMBERS:
        group.add_argument(flag, type=kind, metavar="N", help=text)


# --- doctor ---


def _run_doctor(args: argparse.Namespace) -> int:
    """Run `polysight doctor`. Raises ConfigError for a movement without pulses."""
    from polysight.doctor import DoctorOptions, run_doctor

    if args.move and not args.pulse:
        raise ConfigError(
            "--move and --no-pulse", "each point of the row is a burst of SYNC_IN pulses", "leave one of them out",
            code=ErrorCode.VALUES_CONFLICT,
        )  # fmt: skip
    options = DoctorOptions(config=args.config, out=args.out, move=args.move, pulse=args.pulse, bursts=args.bursts)
    return run_doctor(options, args.as_json, bundle=args.bundle)


def _add_doctor(add: AddCommand) -> None:
    """Add `polysight doctor` and its options."""
    sub = add(
        "doctor",
        _run_doctor,
        "check every hop of the rig in order and say what to do; nothing moves without --move",
        "polysight doctor --config instrument.toml --out scans",
        ("--config", "--move", "--bundle"),
    )
    add_config_option(sub)
    sub.add_argument(
        "--move", action="store_true", help="THE STAGE MOVES: home it and run a short row with SYNC_IN pulses"
    )
    sub.add_argument(
        "--bundle",
        type=Path,
        metavar="FILE.zip",
        help="write findings, versions, rig file, logs and last lines of manifests, to send; no raw data, no keys",
    )
    sub.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="test the disk of this folder")
    sub.add_argument(
        "--no-pulse",
        dest="pulse",
        action="store_false",
        help="send no SYNC_IN pulses (default: a few bursts at rest; armed radars transmit)",
    )
    sub.add_argument("--bursts", type=_bursts, default=4, metavar="N", help="bursts to capture (default: 4)")
    add_json_option(sub)


# --- card ---


def _program_card(args: argparse.Namespace) -> int:
    from polysight.jobs.devices import program_card

    return program_card(args.config, args.name, mac=args.mac, at=args.at, yes=args.yes, wait_s=args.wait)


def _reset_card(args: argparse.Namespace) -> int:
    from polysight.jobs.devices import reset_card

    return reset_card(args.config, args.name, args.radar)


def _add_board(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("name", metavar="BOARD", help="name of the board in the rig file, e.g. RH")


def _add_own_config(sub: argparse.ArgumentParser) -> None:
    """Add `--config` to an action, without a default, which would replace the value given before the action."""
    sub.add_argument("--config", type=Path, default=argparse.SUPPRESS, metavar="FILE", help="rig file")


def _add_card(add: AddCommand) -> None:
    """Add `polysight card` and its actions."""
    card = add(
        "card",
        "devices.show_cards",
        "check the network path to each capture card; program or reset a card",
        "polysight card",
    )
    add_config_option(card)
    card.add_argument(
        "--listen",
        dest="listen_s",
        type=_seconds,
        default=0.0,
        metavar="S",
        help="record from every card for S seconds, to see whether its radar streams (default: 0)",
    )
    add_json_option(card)
    actions = card.add_subparsers(dest="action", metavar="ACTION")

    sub = add_action(
        actions,
        "program",
        _program_card,
        "write a board's addresses and ports from the rig file into its card's EEPROM",
        "polysight card program RH --mac 12:34:56:78:90:13 --at 192.168.33.180:4096",
    )
    _add_board(sub)
    sub.add_argument("--mac", required=True, help="new MAC address of the card, unique in its network")
    sub.add_argument(
        "--at",
        default="",
        metavar="ADDRESS:PORT",
        help="present address of the card (default: the rig file's; a new card: 192.168.33.180:4096)",
    )
    sub.add_argument("--yes", action="store_true", help="do not ask for confirmation")
    sub.add_argument(
        "--wait", type=_seconds, default=120.0, metavar="S", help="look for the card afterwards (default: 120 s; 0: no)"
    )
    _add_own_config(sub)
    sub = add_action(actions, "reset", _reset_card, "reset a card's FPGA, or its radar", "polysight card reset RH")
    _add_board(sub)
    sub.add_argument("--radar", action="store_true", help="reset the radar board, which must be armed again")
    _add_own_config(sub)


# --- inspect ---


def _inspect(args: argparse.Namespace) -> int:
    """Run `polysight inspect`; options that are not given leave the rig file's values."""
    from polysight.jobs.recordings import inspect_file, inspect_placement

    if args.placement:
        return inspect_placement(args.file, args.as_json)
    options = {"lanes": args.lanes, "samples": args.samples, "q_first": args.q_first}
    given_options = {name: value for name, value in options.items() if value is not None}
    return inspect_file(
        args.file,
        config=args.config,
        plot=args.plot,
        card_address=args.card,
        as_json=args.as_json,
        changes=given_options,
    )


def _add_inspect(add: AddCommand) -> None:
    """Add `polysight inspect` and its options."""
    sub = add(
        "inspect", _inspect, "describe a recording of a capture card", "polysight inspect scans/one/raw/RH/0000.bin"
    )
    sub.add_argument("file", type=Path, metavar="FILE", help="payload (.bin), or packets recorded by tcpdump (.pcap)")
    sub.add_argument(
        "--plot", type=file_ending(".png"), metavar="FILE.png", help="draw the range profile of every antenna"
    )
    sub.add_argument("--config", type=Path, metavar="RIG", help="rig file of the recording (default: the scan's)")
    sub.add_argument("--placement", action="store_true", help="show how the packets of a scan's row are placed")
    sub.add_argument("--card", default="", metavar="ADDRESS", help="the card, in a recording of several")
    sub.add_argument(
        "--samples",
        type=number(int, "an even number, 8 or more", lambda n: n >= 8 and n % 2 == 0),
        metavar="N",
        help="samples of a chirp (default: the rig file's, or 256)",
    )
    sub.add_argument("--lanes", type=int, choices=(2, 4), help="LVDS lanes (default: 4)")
    sub.add_argument("--q-first", action="store_true", default=None, help="Q precedes I in the recording")
    add_json_option(sub)


# --- radar ---


def _add_link(sub: argparse.ArgumentParser) -> None:
    """Add the options of the link between host and board."""
    sub.add_argument("--trace", type=Path, metavar="FILE", help="record all words between host and board")
    sub.add_argument("--slow", action="store_true", help="send words one by one at 1 MHz, for doubtful wiring")


def _add_radar(add: AddCommand) -> None:
    """Add `polysight radar` and its actions."""
    radar = add(
        "radar",
        "devices.plan_radars",
        "check one radar board, load its firmware, or replay a trace",
        "polysight radar check RH",
    )
    add_config_option(radar)
    actions = radar.add_subparsers(dest="action", metavar="ACTION")

    sub = add_action(
        actions,
        "plan",
        "devices.plan_radars",
        "show all constraints and the settings of each board",
        "polysight radar plan",
    )
    _add_own_config(sub)
    sub = add_action(
        actions,
        "check",
        "devices.check_radar",
        "check one board step by step, from USB to one frame",
        "polysight radar check RH --trace first-day.jsonl",
    )
    _add_board(sub)
    _add_link(sub)
    _add_own_config(sub)
    add_json_option(sub)
    sub = add_action(
        actions,
        "firmware",
        "devices.load_firmware",
        "load TI's firmware into a board's RAM, or write it to its flash",
        "polysight radar firmware RH xwr22xx_metaImage.bin --flash",
    )
    _add_board(sub)
    sub.add_argument("image", type=Path, metavar="IMAGE", help="TI's xwr22xx_metaImage.bin")
    sub.add_argument(
        "--flash", action="store_true", help="write the board's flash (default: RAM, until its next reset)"
    )
    _add_link(sub)
    _add_own_config(sub)
    sub = add_action(
        actions,
        "replay",
        "devices.replay_radar",
        "run the check against a trace",
        "polysight radar replay first-day.jsonl",
    )
    sub.add_argument("trace", type=Path, metavar="TRACE", help="file written by --trace")
    _add_own_config(sub)
    add_json_option(sub)


# --- jog ---


def _add_jog(add: AddCommand) -> None:
    """Add `polysight jog` and its options."""
    sub = add(
        "jog",
        "devices.jog_stage",
        "move one axis of the homed stage; it stops at Ctrl-C and if this program ends",
        "polysight jog x 10\n  polysight jog y -2.5 --speed-mm-s 5",
    )
    sub.add_argument("axis", choices=("x", "y"), help="axis of the stage")
    sub.add_argument("distance_mm", type=_jog_mm, metavar="MM", help="distance, at most 100 mm each way")
    sub.add_argument("--speed-mm-s", type=positive, metavar="V", help="speed (default: the rig file's in a row)")
    add_config_option(sub)
    add_json_option(sub)


# --- scan, resume, validate, drop-raw ---


def _scan(args: argparse.Namespace) -> int:
    """Run `polysight scan`."""
    from polysight.jobs.live_scan import scan

    return scan(
        args.config,
        args.out,
        material_settings(args),
        truth=args.truth,
        keep_incomplete=args.keep_incomplete,
        process=not args.no_process,
    )


def _resume(args: argparse.Namespace) -> int:
    """Run `polysight resume`."""
    from polysight.jobs.live_scan import resume

    return resume(
        args.folder,
        material_settings(args),
        keep_incomplete=args.keep_incomplete,
        process=not args.no_process,
        config=args.config,
    )


def _validate(args: argparse.Namespace) -> int:
    """Run `polysight validate`."""
    from polysight.jobs.recordings import replace_folder, validate_folder

    if args.replace:
        return replace_folder(args.folder, args.as_json)
    return validate_folder(args.folder, args.as_json)


def _add_recording_options(sub: argparse.ArgumentParser) -> None:
    """Add the options that `scan` and `resume` share."""
    sub.add_argument(
        "--keep-incomplete", action="store_true", help="after all retakes keep a row with gaps, masked, and continue"
    )
    sub.add_argument("--no-process", action="store_true", help="only record; `polysight process` can follow later")
    add_material_options(sub)


def _add_scans(add: AddCommand) -> None:
    """Add `polysight scan`, `resume`, `validate` and `drop-raw`."""
    sub = add(
        "scan",
        _scan,
        "scan with the rig and process at the same time (Ctrl-C: stop after the row; twice: stop now)",
        "polysight scan --config instrument.toml --out scans/one",
    )
    add_config_option(sub)
    sub.add_argument("--out", type=Path, required=True, metavar="SCAN", help="new scan folder; never overwritten")
    _add_recording_options(sub)
    sub.add_argument("--truth", type=Path, metavar="FILE", help="truth.json of a simulated scene, for the report")

    sub = add("resume", _resume, "resume an interrupted scan at its first missing row", "polysight resume scans/one")
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder; the rig file is in it")
    _add_recording_options(sub)
    sub.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="use [pi], [limits] and the boards' addresses from this rig file from now on (default: the scan's)",
    )

    sub = add(
        "validate", _validate, "check every file of a scan folder and list all faults", "polysight validate scans/one"
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder")
    sub.add_argument(
        "--replace", action="store_true", help="place every row again from its packets, and commit what changes"
    )
    add_json_option(sub)

    sub = add(
        "drop-raw",
        "scans.drop_raw",
        "delete the raw rows of a processed scan; its products and digests stay",
        "polysight drop-raw scans/one",
    )
    sub.add_argument("folder", type=Path, metavar="SCAN", help="scan folder")
    sub.add_argument("--products", type=Path, metavar="DIR", help="products made from it (default: SCAN/products)")
    sub.add_argument("--yes", action="store_true", help="do not ask for confirmation")


def _simulate(args: argparse.Namespace) -> int:
    """Run `polysight simulate`, after warnings about the scene on stderr."""
    from polysight.jobs.demo import run_simulator
    from polysight.planning import find_scene_warnings

    for warning in find_scene_warnings(args.scene, args.config):
        sys.stderr.write(f"note, {warning.where}: {warning.what}\n")
    command = ["simulate", str(args.scene), "--config", str(args.config), "--out", str(args.out)]
    command += ["--layout", args.layout]
    if args.seed is not None:
        command += ["--seed", str(args.seed)]
    return run_simulator(command)


def _run_reproduce(args: argparse.Namespace) -> int:
    """Run `polysight reproduce`. Raises ConfigError for a wrong rig file, or options without an effect."""
    from polysight.jobs.demo import require_package

    if args.config != find_packaged(RIG_FILE):
        # Refuse a wrong rig file now, and not only when the first item needs it.
        load_instrument(args.config)
    require_package("polysight_papers", "papers")
    # This is printed before the libraries for the figures are loaded, which takes seconds.
    sys.stderr.write("polysight reproduce: starting\n")
    sys.stderr.flush()
    if args.authors is not None:
        from polysight_papers.sensys2026.dataset_items import reproduce_authors

        return reproduce_authors(
            args.authors, args.out, args.config, keys=args.items, images=args.images, names=args.names
        )
    if args.images is not None or args.names is not None:
        raise ConfigError(
            "--images and --names say how to read the published files", "no --authors was given",
            "give --authors DIR, or leave them out", code=ErrorCode.VALUES_CONFLICT,
        )  # fmt: skip
    from polysight_papers.sensys2026.item import Run
    from polysight_papers.sensys2026.run import reproduce

    return reproduce(args.out, args.items, Run(quick=args.quick, config=args.config))


def _add_simulated(add: AddCommand) -> None:
    """Add `polysight demo`, `simulate` and `reproduce`."""
    sub = add(
        "demo",
        "demo.run_demo",
        "scan a scene with a simulated rig and write the report; needs no hardware",
        "polysight demo --out out/demo",
        ("--out", "--scene"),
    )
    sub.add_argument(
        "--out",
        type=Path,
        default=Path("out/demo"),
        metavar="DIR",
        help="folder to make (default: out/demo); an existing demo folder is overwritten",
    )
    sub.add_argument(
        "--scene",
        type=parse_shipped_path,
        default=find_packaged(Path("examples/demo.toml")),
        metavar="FILE",
        help="scene file (default: nine plates on a table, as in a lab)",
    )
    sub.add_argument("--time-scale", type=positive, metavar="X", help="simulated seconds per second (default: 40)")
    add_config_option(sub, shipped=True)

    sub = add(
        "simulate",
        _simulate,
        "write the raw data of a scene, with truth.json",
        "polysight simulate examples/point-targets.toml --out out/points",
    )
    sub.add_argument(
        "scene", type=parse_shipped_path, metavar="SCENE.toml", help="scene file, e.g. examples/metal-plate.toml"
    )
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write")
    sub.add_argument(
        "--layout",
        choices=["own", "authors"],
        default="own",
        help="a scan folder (default), or unsynced/<scan> as the paper's authors publish it",
    )
    sub.add_argument("--seed", type=count_from_zero, help="noise seed (default: the scene's)")
    add_config_option(sub, shipped=True)

    sub = add(
        "reproduce",
        _run_reproduce,
        "make the paper's tables and figures, next to the published values",
        "polysight reproduce --out out/reproduce fig18 fig20\n"
        "  polysight reproduce --authors dataset --out out/authors",
    )
    sub.add_argument("items", nargs="*", metavar="ITEM", help="fig3, fig18, table2 ... (default: all there are)")
    sub.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the page and the files")
    sub.add_argument("--quick", action="store_true", help="fewer draws, models and placements")
    sub.add_argument("--authors", type=Path, metavar="DIR", help="use the published data set (materials/, labels/)")
    add_config_option(sub, shipped=True)
    group = sub.add_argument_group("with --authors")
    group.add_argument("--images", type=Path, metavar="DIR", help="also judge images that `polysight process` made")
    group.add_argument(
        "--names", type=Path, metavar="FILE", help='JSON with the row of Table 2 of a name, {"plexi 3": 3}'
    )
