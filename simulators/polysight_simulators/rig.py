"""Start a whole simulated rig: wires, stage, radars with capture cards, and optionally the Pi's program.

    python -m polysight_simulators.rig --config instrument.toml --scene SCENE.toml --dir DIR --time-scale 30 --with-pi

It writes into DIR: `instrument.toml`, the rig file with the addresses of these processes; `truth.json`, the plates of
the scene (not with --pattern); reports of the cards; logs. It prints `ready DIR/instrument.toml` when all processes are
ready.

The *wires* process relays edges of GPIO lines and the stage's motion between the others.
SIGTERM, SIGINT or the end of a process ends all of them; SIGUSR1 switches all cards off and on. *Wire time* is the
clock of the simulated signals: wall time times the time scale.
"""

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple

import tomli_w

from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import ConfigError, DeviceError, PolysightError
from polysight_shared.program import die_with_parent
from polysight_shared.tables import decode, to_builtins
from polysight_simulators.faults import read_faults
from polysight_simulators.loopback import move_to_free_subnet
from polysight_simulators.process import announce_ready, make_parser, parse_count, run_until_stopped
from polysight_simulators.radars import make_image
from polysight_simulators.scene import Scene, apply_scene, load_scene, truth
from polysight_simulators.wires import MAX_SOCKET_PATH

# Shortest heartbeat timeout, `stage.heartbeat_ms` of the stage and four times `pi.host_heartbeat_ms` of the Pi: the
# processes share the cores of a busy machine, and may be late; chosen.
MIN_HEARTBEAT_MS = 2000
# Firmware image of the radars in the folder of the rig.
IMAGE_FILE = "firmware.bin"
# Longest wall time until all processes have printed `ready`; chosen for a busy machine.
READY_TIMEOUT_S = 60.0
# Wall time from SIGTERM to SIGKILL; chosen for a busy machine.
STOP_TIMEOUT_S = 5.0
# Largest speed of the emulated UNO: its heartbeat clock is scaled, that of the Pi's program is not.
UNO_TIME_SCALE = 2.0
# Time between two looks if a process is ready; chosen.
_POLL_S = 0.02
# Time between two looks if a process of the ready rig has ended; chosen.
_WATCH_S = 0.2
# Start offset of the receivers: it puts the published rig's direct path in the middle of its IF window.
_NATIVE_OFFSET_HZ = 790e3
# Last lines of a log that an error shows; chosen.
_LOG_LINES = 15
# One thread for linear algebra, unless the environment says otherwise: several processes with more threads on few cores
# are ten times slower. Unbuffered: `ready` is read from the log.
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}


def _set_native_control(table: dict[str, Any], if_offset_hz: float) -> None:
    """Set native radar control in the rig file's table: an entry for each board, and a start offset of the receivers.

    A receiver's start offset in the rig file is not changed, unless it is 0: then it becomes `if_offset_hz`, or that of
    the published rig if `if_offset_hz` is 0, too. `move_to_free_subnet` sets the address of each board.
    """
    names = [board["name"] for board in table["boards"]]
    # A simulated board's USB serial number is its name.
    table["radar"] |= {"control": "native", "native": {name: {"usb_serial": name} for name in names}}
    for board in table["boards"]:
        if board["role"] != "transmit" and not board["start_offset_hz"]:
            board["start_offset_hz"] = if_offset_hz or _NATIVE_OFFSET_HZ


def _apply_if_offset(table: dict[str, Any], if_offset_hz: float) -> None:
    """Add the scene's IF offset to the start offsets of the receivers: the rig file describes what they do."""
    for board in table["boards"]:
        if board["role"] != "transmit":
            board["start_offset_hz"] += if_offset_hz


def derive(rig: Instrument, scene: Scene | None, folder: Path, native: bool = False) -> Instrument:
    """Derive the rig file of a simulated rig in `folder`: the scene's overrides, free addresses, paths, heartbeats.

    The scene's IF offset is added to the start offsets of the receivers. With `native`, which sets native radar
    control, only receivers without a start offset get it. If the rig file itself has native control, it is ignored: the
    boards have the start offsets that the host programs.

    Raises ConfigError if an override breaks a rule, DeviceError if no loopback subnet is free.
    """
    disturbed_rig = rig
    if_offset_hz = 0.0
    if scene is not None:
        disturbed_rig = apply_scene(rig, scene)
        if_offset_hz = scene.disturbances.if_offset_hz
    table: dict[str, Any] = to_builtins(disturbed_rig)
    if native:
        _set_native_control(table, if_offset_hz)
    elif table["radar"]["control"] != "native":
        _apply_if_offset(table, if_offset_hz)
    if table["radar"]["control"] == "native" and not table["radar"]["firmware"]:
        # The boards start with an empty flash.
        table["radar"]["firmware"] = str(folder / IMAGE_FILE)
    table["stage"]["port"] = str(folder / "ttySTAGE")
    table["pi"] |= {"journal_dir": str(folder / "journal"), "key_dir": str(folder / "keys")}
    table["stage"]["heartbeat_ms"] = max(MIN_HEARTBEAT_MS, table["stage"]["heartbeat_ms"])
    # Three of four heartbeats may be late.
    table["pi"]["host_heartbeat_ms"] = table["stage"]["heartbeat_ms"] // 4
    return move_to_free_subnet(decode(table, Instrument, f"{rig.name}, simulated"))


class RigProcess:
    """One process of the rig, with its log."""

    def __init__(self, name: str, command: list[str], logs: Path) -> None:
        self.name = name
        self.log = logs / f"{name}.log"
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**_ENVIRONMENT, **os.environ},
                # Ctrl-C goes only to the rig, which ends its processes in order.
                start_new_session=True,
                preexec_fn=die_with_parent,
            )

    @property
    def ready(self) -> bool:
        """True if it has printed `ready`."""
        return any(line.startswith("ready") for line in self._read_log())

    def check(self) -> None:
        """Raise DeviceError with the last lines of its log if the process has ended."""
        status = self._process.poll()
        if status is not None:
            raise DeviceError(
                f"simulated rig: the {self.name} process ended with status {status}:\n" + self.last_lines(),
                "see its last lines above",
                f"the whole log is {self.log}",
            )

    def last_lines(self) -> str:
        """Return the end of its log."""
        return "\n".join(f"    {line}" for line in self._read_log()[-_LOG_LINES:])

    def _read_log(self) -> list[str]:
        return self.log.read_text(encoding="utf-8", errors="replace").splitlines()

    def send_signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self._process.send_signal(number)

    def end(self) -> None:
        """Send SIGTERM, and SIGKILL after a timeout."""
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()


class RigOptions(NamedTuple):
    """Options of the simulated rig, as on its command line.

    `time_scale`: wire time over wall time; `with_pi`: run the Pi's program; `seed`: None for the scene's; `pattern`:
    counting pattern instead of the scene's signals; `faults`: file with a `[faults]` table; `cache`: folder of the
    scene's object fields (computed echoes); `uno`: emulated board instead of the compiled sketch; `native`: the host
    controls the radars.
    """

    time_scale: float = 1.0
    with_pi: bool = False
    seed: int | None = None
    pattern: bool = False
    faults: Path | None = None
    # Single faults, KEY=VALUE.
    fault: Sequence[str] = ()
    cache: Path | None = None
    uno: bool = False
    native: bool = False


class RigProcesses:
    """The processes of a simulated rig in `folder`, which contains its rig file; started by the constructor.

    Raises DeviceError if one of them ends, or is not ready before the timeout, ConfigError if the Pi's program is
    missing.
    """

    def __init__(self, rig: Instrument, scene: Path | None, folder: Path, options: RigOptions, stop: Event) -> None:
        self._folder = folder
        self._logs = folder / "logs"
        self._logs.mkdir(parents=True, exist_ok=True)
        self._stop = stop
        self.children: list[RigProcess] = []
        try:
            self._start(rig, scene, options)
        except PolysightError:
            self.end()
            raise

    def _start(self, rig: Instrument, scene: Path | None, options: RigOptions) -> None:
        """Start the processes in order of need: wires, then stage and cards, then the Pi; wait until each is ready."""
        wires = str(self._folder / "wires.sock")
        config = str(self._folder / "instrument.toml")
        self._wait([self._start_module("wires", "wires", "--socket", wires)])
        common = ["--config", config, "--wires", wires, "--time-scale", repr(options.time_scale)]
        started = [self._start_module("stage", "uno" if options.uno else "stage", *common, "--link", rig.stage.port)]
        for group in card_groups(rig):
            name = f"cards-{group.partition(',')[0]}"
            card_options = ["--boards", group, "--report", str(self._folder / f"{name}.json")]
            started.append(
                self._start_module(name, "cards", *common, *card_options, *_list_card_options(scene, options))
            )
        self._wait(started)
        if options.with_pi:
            self._wait([self._launch("pi", [_find_pi_program(), "run", "--config", config, "--wires", wires])])

    def _start_module(self, name: str, module: str, *arguments: str) -> RigProcess:
        return self._launch(name, [sys.executable, "-m", f"polysight_simulators.{module}", *arguments])

    def _launch(self, name: str, command: list[str]) -> RigProcess:
        self.children.append(RigProcess(name, command, self._logs))
        return self.children[-1]

    def _wait(self, started: list[RigProcess]) -> None:
        """Wait until these processes are ready, or `stop` is set.

        Raises DeviceError if one ends or the time is over.
        """
        deadline = time.monotonic() + READY_TIMEOUT_S
        while not self._stop.is_set():
            self.check()
            waiting = [child for child in started if not child.ready]
            if not waiting:
                return
            if time.monotonic() > deadline:
                raise DeviceError(
                    f"simulated rig: {', '.join(c.name for c in waiting)} not ready after {READY_TIMEOUT_S:.0f} s:\n"
                    + waiting[0].last_lines(),
                    "an overloaded machine, or a fault shown above",
                    f"the logs are in {self._logs}",
                )
            self._stop.wait(_POLL_S)

    def check(self) -> None:
        """Raise DeviceError if a process has ended."""
        for child in self.children:
            child.check()

    def power_cycle(self) -> None:
        """Switch every capture card off and on."""
        for child in self.children:
            if child.name.startswith("cards-"):
                child.send_signal(signal.SIGUSR1)

    def end(self) -> None:
        """End all processes, the last one first."""
        for child in reversed(self.children):
            child.end()


def card_groups(rig: Instrument) -> list[str]:
    """Group the boards into processes: one for each recorded board; the others join the first."""
    groups = [[board.name] for board in rig.recorded]
    not_recorded = [board.name for board in rig.boards if not board.record]
    if not groups:
        groups = [[]]
    groups[0] += not_recorded
    return [",".join(names) for names in groups]


def _list_card_options(scene: Path | None, options: RigOptions) -> list[str]:
    """Return the command-line options of a card process; `options` are those of the whole rig."""
    words = []
    if scene is not None:
        # `derive` has put the scene's IF offset into the rig file, or left it out.
        words += ["--scene", str(scene), "--offset-in-rig"]
    if options.pattern:
        words.append("--pattern")
    values = {"--seed": options.seed, "--faults": options.faults, "--cache": options.cache}
    for option, value in values.items():
        if value is not None:
            words += [option, str(value)]
    for fault in options.fault:
        words += ["--fault", fault]
    return words


def _find_pi_program() -> str:
    """Return the path of `polysight-pi` in this environment. Raises ConfigError if it is missing."""
    program = Path(sys.executable).parent / "polysight-pi"
    if not program.exists():
        raise ConfigError(
            f"{program}: not there", "the Pi half is not installed in this environment", "pip install ./pi_controller"
        )
    return str(program)


def _write_files(rig: Instrument, scene: Scene | None, folder: Path, options: RigOptions) -> None:
    """Write rig file and firmware image, and the truth of a scene whose signals are sent."""
    table = to_builtins(rig)
    if rig.name.endswith("(simulated)"):
        table["name"] = rig.name
    else:
        table["name"] = f"{rig.name} (simulated)"
    (folder / "instrument.toml").write_bytes(tomli_w.dumps(table).encode())
    if rig.radar.firmware == str(folder / IMAGE_FILE):
        (folder / IMAGE_FILE).write_bytes(make_image())
    if scene is not None and not options.pattern:
        seed = options.seed
        if seed is None:
            seed = scene.seed
        facts = truth(rig, scene, seed)
        (folder / "truth.json").write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")


def run(config: Path, scene_path: Path | None, folder: Path, options: RigOptions, stop: Event) -> None:
    """Start a simulated rig, announce that it is ready, and keep it until `stop` is set.

    Raises PolysightError if a file is invalid, or a process does not start or ends.
    """
    folder = folder.resolve()
    if len(str(folder / "wires.sock").encode()) > MAX_SOCKET_PATH:
        raise ConfigError(f"--dir {folder}: too long a path", "it contains a Unix socket", "choose a shorter one")
    if options.uno and options.time_scale > UNO_TIME_SCALE:
        raise ConfigError(
            f"--uno with --time-scale {options.time_scale:g}",
            "the emulated board's heartbeat clock is scaled, the Pi's is not",
            f"give at most {UNO_TIME_SCALE:g}, or leave out --uno",
        )
    scene = None
    if scene_path is not None:
        scene = load_scene(scene_path)
    if not 0 < options.time_scale < math.inf:
        raise ConfigError(f"--time-scale {options.time_scale:g}", "it must be positive", "give a number above 0")
    if scene is None and not options.pattern:
        raise ConfigError("neither --scene nor --pattern", "the radars need a signal", "give one of them")
    rig = derive(load_instrument(config), scene, folder, options.native)
    boards = tuple(b.name for b in rig.boards)
    # Invalid faults raise an error before anything starts.
    read_faults(options.faults, list(options.fault), boards, control=rig.radar.control)
    folder.mkdir(parents=True, exist_ok=True)
    _write_files(rig, scene, folder, options)
    power_cycle = Event()
    signal.signal(signal.SIGUSR1, lambda _signal, _frame: power_cycle.set())
    processes = RigProcesses(rig, scene_path, folder, options, stop)
    try:
        if not stop.is_set():
            announce_ready(str(folder / "instrument.toml"))
        while not stop.wait(_WATCH_S):
            processes.check()
            if power_cycle.is_set():
                power_cycle.clear()
                processes.power_cycle()
    finally:
        processes.end()


def main(argv: list[str] | None = None) -> int:
    """Run a simulated rig until SIGTERM, SIGINT or the end of a process; return the exit status."""
    parser = make_parser(
        "polysight_simulators.rig",
        "Start a simulated rig; print `ready FILE` with its rig file, and run until Ctrl-C.",
        "--config instrument.toml --scene examples/metal-plate.toml --dir out/rig --time-scale 30 --with-pi",
    )
    parser.add_argument("--config", type=Path, required=True, help="rig file")
    parser.add_argument("--scene", type=Path, help="scene file; not needed with --pattern")
    parser.add_argument("--dir", type=Path, required=True, help="folder of this rig: its rig file, logs, serial port")
    parser.add_argument("--time-scale", type=float, default=1.0, help="speed: wire time relative to wall time")
    parser.add_argument("--with-pi", action="store_true", help="run the Pi's program too")
    parser.add_argument("--seed", type=parse_count, help="default: the scene's")
    parser.add_argument("--pattern", action="store_true", help="send a counting pattern instead of the scene's signals")
    parser.add_argument("--faults", type=Path, help="TOML file with a [faults] table for the cards")
    parser.add_argument("--fault", action="append", default=[], metavar="[BOARD.]KEY=VALUE", help="a single fault")
    parser.add_argument("--cache", type=Path, help="cache folder for the scene's object fields")
    parser.add_argument(
        "--uno",
        action="store_true",
        help=f"run the sketch's machine code on an emulated board; --time-scale at most {UNO_TIME_SCALE:g}",
    )
    parser.add_argument("--native", action="store_true", help="the host configures and arms the radars (simulated USB)")
    arguments = vars(parser.parse_args(argv))
    config = arguments.pop("config")
    scene = arguments.pop("scene")
    folder = arguments.pop("dir")
    options = RigOptions(**arguments)
    return run_until_stopped(lambda stop: run(config, scene, folder, options, stop))


if __name__ == "__main__":
    sys.exit(main())
