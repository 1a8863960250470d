"""The stage of a simulated rig.

A client talks to it through a serial port that behaves like that of the board. The edges of its trigger line and its
motion are sent to the hub of the simulated wires. The program is the sketch's own code, compiled for this machine
(arduino_stage/pc); without a C++ compiler, or with `--python`, it is a stand-in with the same dialogue and the same
step times.
"""

import argparse
import ctypes
import os
import select
import struct
import sys
import termios
import time
import tty
from contextlib import closing
from pathlib import Path
from threading import Event as Signal

from polysight_shared.config import load_instrument
from polysight_shared.errors import DeviceError
from polysight_shared.units import NS_PER_MS
from polysight_shared.wires import WireClient
from polysight_simulators.builds import build_sketch, sketch_compiler
from polysight_simulators.process import announce_ready, check_link, make_parser, run_until_stopped
from polysight_simulators.stage.motion import TICK_HZ
from polysight_simulators.stage.python_stage import PythonStage, Rig

# All times of this file are wall time.
# Time that the board's boot loader takes after a reset; chosen.
BOOT_MS = 200
# Longest wait for bytes before the simulated time advances, while the stage steps and while it rests.
STEP_POLL_MS = 2
REST_POLL_MS = 20
# Masks of inotify(7): closed after writing or after reading; opened.
_IN_CLOSE = 0x08 | 0x10
_IN_OPEN = 0x20
# Its event without a file name: watch descriptor, mask, cookie, length of the name.
_EVENT = struct.Struct("iIII")
# Longest time by which a stepping stage advances together; chosen. If this process gets no CPU time for longer, the
# simulated world is late, instead of making all the missed steps together.
LONGEST_ADVANCE_NS = 20 * NS_PER_MS


class SerialPort:
    """The far end of the USB cable for the Python stand-in: a pseudo terminal behind the symbolic link `link`.

    Raises DeviceError when it cannot be made.
    """

    def __init__(self, link: Path) -> None:
        self._link = link
        try:
            self._master, slave = os.openpty()
            tty.setraw(slave, termios.TCSANOW)
            settings = termios.tcgetattr(slave)
            # A serial port has this control flag (element 2) set, a pseudo terminal has not.
            settings[2] |= termios.HUPCL
            termios.tcsetattr(slave, termios.TCSANOW, settings)
            os.set_blocking(self._master, False)
            name = os.ttyname(slave)
            os.close(slave)
            libc = ctypes.CDLL(None, use_errno=True)
            self._watch = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
            if libc.inotify_add_watch(self._watch, os.fsencode(name), _IN_OPEN | _IN_CLOSE) < 0:
                raise OSError(ctypes.get_errno(), f"no watch on {name}")
            self._clients = 0
            self._dtr = False
            fresh = link.with_name(link.name + ".new")
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(name)
            fresh.replace(link)
        except OSError as e:
            raise DeviceError(
                f"simulated stage port {link}: {e}", "the folder is missing or not writable", "give another path"
            ) from None

    @property
    def is_open(self) -> bool:
        """True if the port was open at the last call of :meth:`was_opened`."""
        return self._clients > 0

    def wait(self, timeout_ms: int) -> None:
        """Wait until bytes arrive, or a client opens or closes the port; at most `timeout_ms`."""
        poll = select.poll()
        poll.register(self._watch, select.POLLIN)
        if self.is_open:
            poll.register(self._master, select.POLLIN)
        poll.poll(timeout_ms)

    def was_opened(self) -> bool:
        """Take note of opening and closing; True if DTR rose since the last call, which resets an UNO.

        The kernel raises DTR when a serial port is opened, and lowers it at the last close unless HUPCL was taken away.
        """
        try:
            events = os.read(self._watch, 4096)
        except BlockingIOError:
            return False
        rose = False
        # The watch is on one file, not on a folder: no event is followed by a file name.
        for _, mask, _, _ in _EVENT.iter_unpack(events):
            if mask & _IN_OPEN:
                rose |= not self._dtr
                self._dtr = True
                self._clients += 1
            if mask & _IN_CLOSE:
                self._clients -= 1
                control_flags = termios.tcgetattr(self._master)[2]
                drops_at_close = bool(control_flags & termios.HUPCL)
                self._dtr = self._clients > 0 or not drops_at_close
        return rose

    def read(self) -> bytes:
        """Return the received bytes; empty when there are none."""
        try:
            return os.read(self._master, 512)
        except OSError:
            # EAGAIN, or EIO while no client is there.
            return b""

    def write(self, data: bytes) -> None:
        """Send bytes; those that a client does not read in time are lost, as on a serial line."""
        try:
            os.write(self._master, data)
        except OSError:
            # The buffer is full.
            return

    def flush(self) -> None:
        """Drop received bytes and set the terminal to raw mode."""
        tty.setraw(self._master, termios.TCSANOW)
        while self.read():
            pass

    def close(self) -> None:
        """Remove the link and the terminal."""
        self._link.unlink(missing_ok=True)
        os.close(self._watch)
        os.close(self._master)


def serve(
    stage: PythonStage, port: SerialPort, wires: WireClient | None, time_scale: float, boot_ms: int, stop: Signal
) -> None:
    """Run the stage behind its port until `stop` is set. Raises DeviceError when the wires break."""
    started_ns = time.monotonic_ns()
    advanced_to_ns = started_ns
    ticks = 0.0
    boot_ends_ns = 0
    is_booted = False
    while not stop.is_set():
        port.wait(STEP_POLL_MS if stage.stepping else REST_POLL_MS)
        now_ns = time.monotonic_ns()
        if stage.stepping:
            elapsed_ns = min(now_ns - advanced_to_ns, LONGEST_ADVANCE_NS)
        else:
            elapsed_ns = now_ns - advanced_to_ns
        advanced_to_ns = now_ns
        ticks += elapsed_ns * time_scale * TICK_HZ * 1e-9
        now_ms = (now_ns - started_ns) // NS_PER_MS
        # Opening the port resets the board; its boot loader ignores bytes until it ends.
        if port.was_opened():
            boot_ends_ns = now_ns + boot_ms * NS_PER_MS
            is_booted = False
        is_open = port.is_open

        # A resting stage advances before it reads its bytes: a motion that they order begins at the present time. A
        # stepping stage reads first: it stops if its host is silent for too long, and if this process was late, bytes
        # of the host are waiting.
        if not stage.stepping:
            stage.advance(int(ticks), now_ms)
        if is_open and not is_booted and now_ns >= boot_ends_ns:
            port.flush()
            stage.reset(now_ms)
            is_booted = True
        elif is_open and is_booted:
            stage.receive(port.read())
        if stage.stepping:
            stage.advance(int(ticks), now_ms)

        # `stage.wires` holds the messages since the last round, `wires` is the connection to the hub that gets them.
        if wires is not None and stage.wires:
            wires.send(*stage.wires)
        stage.wires.clear()
        if is_open and stage.replies:
            port.write(bytes(stage.replies))
        stage.replies.clear()


def parser() -> argparse.ArgumentParser:
    """Build the parser of the command line."""
    argument_parser = make_parser(
        "polysight_simulators.stage", str(__doc__), "--config instrument.toml --link out/ttySTAGE"
    )
    argument_parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="rig file, instrument.toml")
    argument_parser.add_argument(
        "--wires", type=Path, metavar="SOCKET", help="hub of the simulated wires; without it no edges"
    )
    argument_parser.add_argument(
        "--link", type=Path, required=True, metavar="PATH", help="name of the serial port to make"
    )
    argument_parser.add_argument(
        "--time-scale", type=float, default=1.0, metavar="X", help="motion runs X times the wall clock"
    )
    argument_parser.add_argument(
        "--boot-ms", type=int, default=BOOT_MS, metavar="N", help="wall time from a reset to the board's banner"
    )
    argument_parser.add_argument(
        "--python", action="store_true", help="the Python stand-in, even where a C++ compiler exists"
    )
    return argument_parser


def main(argv: list[str] | None = None) -> int:
    """Run until SIGTERM or SIGINT."""
    argument_parser = parser()
    args = argument_parser.parse_args(argv)
    if not args.time_scale > 0:
        argument_parser.error("--time-scale must be positive")
    return run_until_stopped(lambda stop: _run(args, stop))


def _run(args: argparse.Namespace, stop: Signal) -> None:
    """Become the compiled sketch if it can be built; otherwise serve the Python stand-in. Raises PolysightError."""
    rig = load_instrument(args.config)
    check_link(args.link)
    gxx = None
    if not args.python:
        gxx = sketch_compiler()
    if gxx is not None:
        program = str(build_sketch(gxx))
        command = [program, "--link", str(args.link), "--time-scale", repr(args.time_scale)]
        command += ["--boot-ms", str(args.boot_ms), "--trigger-line", str(rig.pi.trigger_in)]
        command += ["--steps-per-mm", repr(rig.stage.steps_per_mm)]
        if args.wires:
            command += ["--wires", str(args.wires)]
        os.execv(program, command)
    if not args.python:
        sys.stderr.write("stage: no C++ compiler or no sketch here: the Python stand-in runs instead\n")
    if args.wires:
        wires = WireClient(args.wires)
    else:
        wires = None
    with closing(SerialPort(args.link)) as port:
        announce_ready(str(args.link))
        stage = PythonStage(Rig(rig.stage.steps_per_mm, rig.pi.trigger_in))
        serve(stage, port, wires, args.time_scale, args.boot_ms, stop)


if __name__ == "__main__":
    sys.exit(main())
