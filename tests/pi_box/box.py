"""A Raspberry Pi 3B emulated by QEMU.

Tests switch its power off and on, run commands over ssh, plug and unplug the stage's USB cable, and read its GPIO
registers from outside.
"""

import json
import re
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from polysight_shared.program import die_with_parent

# Event of QEMU's trace: a program writes to the memory of a device.
MEMORY_WRITE = "memory_region_ops_write"
# Address of a Raspberry Pi 3B's GPIO block.
GPIO_BASE = 0x3F200000
# USB vendor of the stage's serial chip.
FTDI = "0403"
# Offsets of registers (BCM2835 ARM Peripherals, 6.1): functions of the lines, lines to set and to clear, levels.
SELECT = 0x00
SET = 0x1C
CLEAR = 0x28
LEVEL = 0x34
REGISTER_BYTES = 4
# Only hanging programs reach these limits: a busy computer once needed 5 minutes to boot.
BOOT_LIMIT_S = 3600.0
COMMAND_LIMIT_S = 1800.0
KERNEL_LINE = "console=ttyAMA0,115200 root=/dev/mmcblk0 rw rootwait net.ifnames=0 loglevel=3"
KERNEL_LINE += " systemd.default_timeout_start_sec=3600"


class Write(NamedTuple):
    """A write of the Pi to the register that sets GPIO lines 0 to 31, or to the one that clears them."""

    # Time of this computer's clock, not of the Pi's
    t_s: float
    # True: the lines are set
    high: bool
    # Bit n is line n.
    lines: int


def free_port() -> int:
    """An unused TCP port of 127.0.0.1."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


class Monitor:
    """Connection to QEMU's monitor, which controls the emulated machine (QMP, the QEMU Machine Protocol)."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(str(path))
        self._lines = self._socket.makefile("r", encoding="utf-8")
        self._lines.readline()
        self.do("qmp_capabilities")

    def do(self, command: str, **arguments: Any) -> Any:
        """Execute a command of QEMU's monitor and return its result."""
        self._socket.sendall(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
        # Events may come before the reply.
        while True:
            reply = json.loads(self._lines.readline())
            if "event" not in reply:
                assert "return" in reply, reply
                return reply["return"]

    def close(self) -> None:
        self._lines.close()
        self._socket.close()


class Box:
    """An emulated Pi, which is switched on when the object is made. Changes of its SD card are lost at its end.

    Parameters
    ----------
    image
        Folder with the Pi's file system and kernel, which build_root.sh makes; it prints the path.
    work
        Folder for logs and sockets. Its path must be short: the name of a socket has at most 107 bytes.
    stage
        Serial port of the stage on this computer.
    """

    def __init__(self, image: Path, work: Path, stage: Path) -> None:
        self.work = work
        self.stage = stage
        self.console = work / "console.log"
        self._trace = work / "trace.log"
        self.ssh_port = free_port()
        self.command_port = free_port()
        self.event_port = free_port()
        forward = {22: self.ssh_port, 5601: self.command_port, 5602: self.event_port}
        forwards = "".join(f",hostfwd=tcp:127.0.0.1:{outer}-:{inner}" for inner, outer in forward.items())
        command = ["qemu-system-aarch64", "-M", "raspi3b", "-display", "none", "-msg", "timestamp=on"]
        command += ["-kernel", str(image / "vmlinuz"), "-initrd", str(image / "initrd"), "-dtb", str(image / "pi.dtb")]
        # A Pi has no battery for its clock and asks the network for the time. This one gets it from its kernel's
        # command line.
        clock = f"systemd.clock_usec={time.time_ns() // 1000}"
        command += ["-append", f"{KERNEL_LINE} {clock}", "-serial", f"file:{self.console}", "-D", str(self._trace)]
        command += ["-drive", f"if=sd,format=raw,snapshot=on,file={image / 'root.img'}"]
        # Its network is restricted: only the forwarded ports connect to it, and it reaches nothing outside. The
        # packages that a release needs are on the card.
        command += ["-netdev", f"user,id=net,restrict=on{forwards}", "-device", "usb-net,netdev=net"]
        command += ["-qmp", f"unix:{work / 'qmp'},server=on,wait=off"]
        command += ["-chardev", f"serial,id=stage,path={stage}"]
        with (work / "qemu.log").open("wb") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                preexec_fn=partial(die_with_parent, signal.SIGKILL),
            )
        self.ssh_config = work / "ssh"
        self.ssh_config.write_text(
            f"Host box\nHostName 127.0.0.1\nPort {self.ssh_port}\n"
            f"User pi\nIdentityFile {image / 'key'}\nIdentitiesOnly yes\n"
            "StrictHostKeyChecking no\nUserKnownHostsFile /dev/null\nLogLevel ERROR\nConnectTimeout 300\n"
            f"ControlMaster auto\nControlPath {work}/master\nControlPersist yes\n"
        )
        try:
            self.wait(lambda: (work / "qmp").exists(), "QEMU has a monitor")
            self.monitor = Monitor(work / "qmp")
            self.monitor.do("device_add", driver="usb-serial", id="uno", chardev="stage")
            self.boot_s = self._boot()
        except BaseException:
            self._process.kill()
            raise

    def _boot(self) -> float:
        """Wait until a login is possible; return the duration."""
        begun = time.monotonic()

        def can_log_in() -> bool:
            return self.try_run("true", limit_s=600).returncode == 0

        self.wait(can_log_in, "ssh answers", BOOT_LIMIT_S)
        return time.monotonic() - begun

    def wait(self, condition: Callable[[], bool], what: str, limit_s: float = COMMAND_LIMIT_S) -> None:
        """Return when the condition (described by `what`) holds; fail after the limit, or if QEMU has ended."""
        deadline = time.monotonic() + limit_s
        while not condition():
            if self._process.poll() is not None or time.monotonic() > deadline:
                console = self.console.read_text(errors="replace") if self.console.exists() else ""
                log = (self.work / "qemu.log").read_text(errors="replace")
                raise AssertionError(f"not within {limit_s:.0f} s: {what}\n{log[-2000:]}\n{console[-3000:]}")
            time.sleep(0.2)

    def try_run(
        self, command: str, stdin: bytes = b"", limit_s: float = COMMAND_LIMIT_S
    ) -> subprocess.CompletedProcess[str]:
        """Run a shell command on the Pi as its user `pi`."""
        ssh = ["ssh", "-F", str(self.ssh_config), "box", command]
        process = subprocess.run(ssh, input=stdin, capture_output=True, timeout=limit_s, check=False)
        return subprocess.CompletedProcess(
            command, process.returncode, process.stdout.decode(), process.stderr.decode()
        )

    def run(self, command: str, stdin: bytes = b"", limit_s: float = COMMAND_LIMIT_S) -> str:
        """Run a command that must succeed; return its output."""
        process = self.try_run(command, stdin, limit_s)
        assert process.returncode == 0, f"{command}: {process.returncode}\n{process.stdout}\n{process.stderr}"
        return process.stdout

    def plug(self) -> None:
        """Plug in the stage's USB cable."""
        self._authorize_stage(1)

    def unplug(self) -> None:
        """Unplug the stage's USB cable: the Pi's kernel no longer authorises the device, so that it disappears.

        QEMU could remove the device, but its command `device_del` crashes the USB controller.
        """
        self._authorize_stage(0)

    def _authorize_stage(self, value: int) -> None:
        """Write 1 (authorised) or 0 to the file in which Linux has this setting of a USB device."""
        find = f"grep -l {FTDI} /sys/bus/usb/devices/*/idVendor"
        self.run(f"echo {value} | sudo tee $(dirname $({find}))/authorized >/dev/null")

    def register(self, offset: int) -> int:
        """Read a register of the GPIO block from QEMU, without a program on the Pi."""
        command = {"command-line": f"xp /1wx {GPIO_BASE + offset:#x}"}
        answer = self.monitor.do("human-monitor-command", **command)
        return int(answer.split(":")[1], 16)

    def function(self, line: int) -> int:
        """Function of a line: 0 is input, 1 is output. A register has three bits for each of ten lines."""
        register = self.register(SELECT + REGISTER_BYTES * (line // 10))
        shift = 3 * (line % 10)
        return (register >> shift) & 0b111

    def level(self, line: int) -> int:
        """Level of a line, 0 or 1. A register has one bit for each of 32 lines."""
        register = self.register(LEVEL + REGISTER_BYTES * (line // 32))
        shift = line % 32
        return (register >> shift) & 1

    def writes_during(self, action: Callable[[], Any]) -> list[Write]:
        """Call a function; return the writes to the registers that set and clear lines until it returns."""
        size = self._trace.stat().st_size
        self.monitor.do("trace-event-set-state", name=MEMORY_WRITE, enable=True)
        try:
            action()
        finally:
            self.monitor.do("trace-event-set-state", name=MEMORY_WRITE, enable=False)
        with self._trace.open("rb") as trace:
            trace.seek(size)
            text = trace.read().decode(errors="replace")
        pattern = re.compile(rf"@([\d.]+):{MEMORY_WRITE} .*addr 0x(\w+) value 0x(\w+) size 4 name 'bcm2835_gpio'")
        writes = []
        for time_text, address, value in pattern.findall(text):
            offset = int(address, 16) & 0xFF
            if offset in (SET, CLEAR):
                writes.append(Write(t_s=float(time_text), high=offset == SET, lines=int(value, 16)))
        return writes

    def cut_power(self) -> None:
        """Switch the power off and on, and return when a login is possible. Data not yet on the SD card is lost."""
        self.monitor.do("system_reset")
        self._close_ssh()
        self.boot_s = self._boot()

    def _close_ssh(self) -> None:
        """End the connection that all ssh commands share."""
        subprocess.run(["ssh", "-F", str(self.ssh_config), "-O", "exit", "box"], capture_output=True, check=False)

    def close(self) -> None:
        """Switch the power off for good: end QEMU."""
        self._close_ssh()
        self.monitor.close()
        self._process.kill()
        self._process.wait()
