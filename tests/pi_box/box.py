"""A Raspberry Pi 3B on QEMU: its power switch, ssh, its USB socket, and its GPIO registers seen from outside."""

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
# Only hanging programs reach these limits: a busy computer once needed 5 minutes to boot.
BOOT_LIMIT_S = 3600.0
COMMAND_LIMIT_S = 1800.0
KERNEL_LINE = "console=ttyAMA0,115200 root=/dev/mmcblk0 rw rootwait net.ifnames=0 loglevel=3"
KERNEL_LINE += " systemd.default_timeout_start_sec=3600"


class Write(NamedTuple):
    """A value written to a register that sets or clears GPIO lines 0 to 31; its time is that of this computer."""

    t_s: float
    high: bool
    # Bit n stands for line n.
    lines: int


def free_port() -> int:
    """An unused TCP port of 127.0.0.1."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


class Monitor:
    """QEMU's monitor (QMP)."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.connect(str(path))
        self._lines = self._socket.makefile("r", encoding="utf-8")
        self._lines.readline()
        self.do("qmp_capabilities")

    def do(self, command: str, **arguments: Any) -> Any:
        """Execute a command and return its result."""
        self._socket.sendall(json.dumps({"execute": command, "arguments": arguments}).encode() + b"\n")
        while True:
            reply = json.loads(self._lines.readline())
            if "event" not in reply:
                assert "return" in reply, reply
                return reply["return"]

    def close(self) -> None:
        self._lines.close()
        self._socket.close()


class Box:
    """A Pi that has been switched on; data on its card is lost when it is deleted.

    Parameters
    ----------
    image
        Folder that build_root.sh has printed.
    work
        Folder for its log and its sockets; its path must be short.
    stage
        Serial port (of this computer) of the stage.
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
        # Neither a Pi nor this box has a battery for its clock: a Pi asks the network, the box is told the time.
        clock = f"systemd.clock_usec={time.time_ns() // 1000}"
        command += ["-append", f"{KERNEL_LINE} {clock}", "-serial", f"file:{self.console}", "-D", str(self._trace)]
        command += ["-drive", f"if=sd,format=raw,snapshot=on,file={image / 'root.img'}"]
        # Restricted: only the forwarded ports connect in or out; packages of a release are on the card.
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
        """Return when the condition holds; fail after the limit, or when the machine has ended."""
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
        """Unplug it: the device disappears for the Pi's kernel. QEMU's own `device_del` crashes its USB controller."""
        self._authorize_stage(0)

    def _authorize_stage(self, value: int) -> None:
        find = f"grep -l {FTDI} /sys/bus/usb/devices/*/idVendor"
        self.run(f"echo {value} | sudo tee $(dirname $({find}))/authorized >/dev/null")

    def register(self, offset: int) -> int:
        """A register of the GPIO block, read without the Pi's processor."""
        command = {"command-line": f"xp /1wx {GPIO_BASE + offset:#x}"}
        answer = self.monitor.do("human-monitor-command", **command)
        return int(answer.split(":")[1], 16)

    def function(self, line: int) -> int:
        """Function of a line: 0 input, 1 output. A register has three bits for each of ten lines."""
        register = self.register(SELECT + 4 * (line // 10))
        return register >> 3 * (line % 10) & 7

    def level(self, line: int) -> int:
        """The level of a line. A register has one bit for each of 32 lines."""
        register = self.register(LEVEL + 4 * (line // 32))
        return register >> line % 32 & 1

    def writes_during(self, action: Callable[[], Any]) -> list[Write]:
        """Record the writes to the registers that set and clear lines during the block."""
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
        for t, address, value in pattern.findall(text):
            offset = int(address, 16) & 0xFF
            if offset in (SET, CLEAR):
                writes.append(Write(float(t), offset == SET, int(value, 16)))
        return writes

    def cut_power(self) -> None:
        """Switch the power off and on: data that was not on the card is lost. Returns when a login is possible."""
        self.monitor.do("system_reset")
        self._hang_up()
        self.boot_s = self._boot()

    def _hang_up(self) -> None:
        subprocess.run(["ssh", "-F", str(self.ssh_config), "-O", "exit", "box"], capture_output=True, check=False)

    def close(self) -> None:
        """Pull the plug."""
        self._hang_up()
        self.monitor.close()
        self._process.kill()
        self._process.wait()
