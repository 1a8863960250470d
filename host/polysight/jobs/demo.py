"""`polysight demo`: the simulated rig and the host as separate processes, and the report at the end.

The simulators are started as programs and never imported, so that the host does not depend on them.
"""

from __future__ import annotations

import importlib.util
import selectors
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from polysight.results import NoResult
from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode, PolysightError

# An empty file that marks a folder as a demo, which another demo may overwrite.
_MARK_FILE = ".polysight-demo"
# Starting is mostly imports, of some seconds; the limit is far above them, for an overloaded machine.
_START_LIMIT_S = 60.0
# A process that does not end within this time after SIGTERM is killed; chosen.
_STOP_LIMIT_S = 10.0
TIME_SCALE = 40.0
"""Simulated seconds per second: a row of 18 s takes about half a second."""


def require_package(package: str, folder: str) -> None:
    """Check that another package of this project is installed: a user may have installed only the host's wheel.

    Raises
    ------
    ConfigError
        when it is missing, with the folder to install it from.
    """
    if importlib.util.find_spec(package) is None:
        raise ConfigError(
            f"the package {package} is not installed",
            "this command needs it, and the host's wheel does not contain it",
            f"pip install ./{folder}, or its wheel",
            code=ErrorCode.PACKAGE_MISSING,
        )


def run_simulator(arguments: Sequence[str]) -> int:
    """Run `python -m polysight_simulators ...` and return its exit status. Raises ConfigError if it is missing."""
    require_package("polysight_simulators", "simulators")
    return subprocess.run([sys.executable, "-m", "polysight_simulators", *arguments], check=False).returncode


def simulate_scene(scene: Path, config: Path, out: Path, seed: int | None = None) -> None:
    """Write the simulated scan of a scene into `out`; the simulator's notes are printed to stderr when it has ended.

    Raises PolysightError with the simulator's message.
    """
    require_package("polysight_simulators", "simulators")
    command = [sys.executable, "-m", "polysight_simulators", "simulate", str(scene), "--config", str(config)]
    command += ["--out", str(out), "--json"]
    if seed is not None:
        command += ["--seed", str(seed)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode != 0:
        raise _simulator_error(process.returncode, process.stderr)
    sys.stderr.write(process.stderr)


def check_scenes(scenes: Iterable[Path], config: Path) -> None:
    """Check scene files against the rig before they are used.

    Raises
    ------
    ConfigError
        naming the file, the key and the rule that is broken.
    """
    require_package("polysight_simulators", "simulators")
    command = [sys.executable, "-m", "polysight_simulators", "check", *map(str, scenes), "--config", str(config)]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode != 0:
        raise _simulator_error(process.returncode, process.stderr)


def _simulator_error(status: int, output: str) -> PolysightError:
    """Return the error of a simulator that failed: its message and exit status."""
    error_types = {error.exit_status: error for error in (ConfigError, DataError)}
    error_type = error_types.get(status, DeviceError)
    message = output.strip().removeprefix("error: ")
    return error_type(message or f"a simulator ended with status {status}, without a message")


def _check_folder(out: Path) -> None:
    """Raise ConfigError if `out` is a file, or a folder with anything but an existing demo."""
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file", "a demo needs a folder", "give another --out")
    if out.exists() and any(out.iterdir()) and not (out / _MARK_FILE).exists():
        raise ConfigError(f"{out} is not empty", "it contains other files than those of a demo", "give another --out")


def _make_fresh_folder(out: Path) -> None:
    """Make a folder with nothing but the mark of a demo; an existing demo folder is overwritten."""
    if out.exists() and any(out.iterdir()):
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)
    (out / _MARK_FILE).touch()


@contextmanager
def run_simulated_rig(config: Path, scene: Path, folder: Path, time_scale: float) -> Iterator[Path]:
    """Run the simulated rig with its Pi process; yield the rig file with their addresses.

    `folder` gets that file and the logs, `time_scale` is the number of simulated seconds per second. The host controls
    its radars over simulated USB (`--native`). The rig runs in another session, which Ctrl-C does not reach: the scan
    ends first, and this function ends the rig.

    Raises
    ------
    PolysightError
        when it does not start, with its own message; its logs are in `folder`/logs.
    """
    require_package("polysight_simulators", "simulators")
    command = [sys.executable, "-m", "polysight_simulators.rig", "--config", str(config), "--scene", str(scene)]
    command += ["--dir", str(folder), "--time-scale", str(time_scale), "--with-pi", "--native"]
    rig = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        yield _wait_ready(rig, folder)
    finally:
        rig.send_signal(signal.SIGTERM)
        try:
            rig.communicate(timeout=_STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            rig.kill()
            rig.communicate()


def _wait_ready(rig: subprocess.Popen[str], folder: Path) -> Path:
    """Return the rig file named by the rig's `ready` line. Raises PolysightError if the rig ends or is not ready."""
    if rig.stdout is None or rig.stderr is None:
        raise DeviceError("the simulated rig has no output to read", "it was started without pipes", "start it again")
    deadline = time.monotonic() + _START_LIMIT_S
    with selectors.DefaultSelector() as selector:
        selector.register(rig.stdout, selectors.EVENT_READ)
        while (seconds_left := deadline - time.monotonic()) > 0:
            if not selector.select(seconds_left):
                continue
            line = rig.stdout.readline()
            if line.startswith("ready "):
                return Path(line.removeprefix("ready ").strip())
            if not line:
                output = rig.stderr.read()
                raise _simulator_error(rig.wait(), output)
    raise DeviceError(
        f"the simulated rig was not ready within {_START_LIMIT_S:.0f} s",
        "the machine is overloaded",
        f"see {folder / 'logs'}",
    )


def run_demo(scene: Path, config: Path, out: Path, time_scale: float | None) -> int:
    """Scan a scene with the simulated rig; return the scan's exit status, or the number of the signal that killed it.

    `time_scale` is the number of simulated seconds per second; None: `TIME_SCALE`.

    Raises
    ------
    PolysightError
        when a file is wrong, the folder is taken, or a part of the rig does not start.
    KeyboardInterrupt
        after the scan and the rig have been ended.
    """
    started_s = time.monotonic()
    load_instrument(config)
    _check_folder(out)
    check_scenes([scene], config)
    _make_fresh_folder(out)
    sys.stderr.write(f"simulated rig: no hardware is involved. Scene {scene}\n")
    with run_simulated_rig(config, scene, out / "rig", time_scale or TIME_SCALE) as rig_file:
        command = [sys.executable, "-m", "polysight", "scan", "--config", str(rig_file), "--out", str(out / "scan")]
        command += ["--truth", str(rig_file.parent / "truth.json")]
        status = _run_to_its_end(command)
    if status in (0, NoResult.exit_status):
        sys.stdout.write(f"simulated demo: {time.monotonic() - started_s:.0f} s in all\n")
    else:
        sys.stderr.write(f"the logs of the simulated rig are in {out / 'rig' / 'logs'}\n")
    return abs(status)


def _run_to_its_end(command: Sequence[str]) -> int:
    """Run a program; return its status, or minus the number of the signal that killed it.

    Ctrl-C stops the program first, cleanly, with a single signal.
    """
    child = subprocess.Popen(command, start_new_session=True)
    try:
        return child.wait()
    finally:
        if child.poll() is None:
            child.terminate()
            try:
                child.wait(_STOP_LIMIT_S)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
