"""An installed Pi: the steps of docs/how-to/install.md on it and from its host."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import tomli_w
from tests.pi_box.box import Box
from tests.pi_box.uno import Uno
from tests.support.paths import BIN, REPO
from tests.support.pi.host_side import HostSide
from tests.support.rigs import load_published_rig, time_by_the_program

from polysight_shared.config import Instrument
from polysight_shared.tables import to_builtins

# The program on the Pi, and time limits for an emulated processor on a busy computer
PROGRAM = "/opt/polysight/venv/bin/polysight-pi"
INSTALL_LIMIT_S = 7200
READY_LIMIT_S = 1800.0


def print_figure(text: str) -> None:
    """Print one line, which `make test-pi` shows."""
    sys.stdout.write(text + "\n")


def rig_of_the_box() -> Instrument:
    """Return the published rig, with SYNC_IN by a GPIO line and a one-shot: QEMU has neither SPI nor a Pi's speed."""
    rig = time_by_the_program(load_published_rig())
    replace = msgspec.structs.replace
    return replace(
        rig,
        limits=replace(rig.limits, command_timeout_s=120.0),
        stage=replace(rig.stage, port="/dev/polysight-stage", heartbeat_ms=5000),
        pi=replace(rig.pi, one_shot=True, command_address="tcp://0.0.0.0:5601", event_address="tcp://0.0.0.0:5602"),
    )


class InstalledPi:
    """The box with a release on it, the stage at its USB port, and the host's folder of keys."""

    def __init__(self, box: Box, uno: Uno, work: Path) -> None:
        self.box = box
        self.uno = uno
        self.work = work
        self.rig = rig_of_the_box()
        self.keys = work / "keys"

    def install(self) -> str:
        """Run `make pi-install`, as on a host; return its output."""
        # For make: the environment of these tests counts as up to date.
        (self.work / "installed").touch()
        make = ["make", "pi-install", f"HOST=-F {self.box.ssh_config} box", f"OUT={self.work / 'out'}"]
        make += [f"VENV={self.work}", f"BIN={BIN}"]
        process = subprocess.run(make, cwd=REPO, capture_output=True, text=True, timeout=INSTALL_LIMIT_S, check=False)
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout

    def allow_for_a_slow_processor(self) -> None:
        """Set longer limits for start and watchdog: an emulated processor is 10 to 100 times slower than a Pi's."""
        limits = b"[Service]\nTimeoutStartSec=3600\nWatchdogSec=120\n"
        folder = "/etc/systemd/system/polysight-pi.service.d"
        self.box.run(f"sudo mkdir -p {folder} && sudo tee {folder}/slow.conf >/dev/null", limits)
        self.systemctl("daemon-reload")

    def configure(self, rig: Instrument | None = None) -> None:
        """Write the rig file."""
        text = tomli_w.dumps(to_builtins(rig or self.rig)).encode()
        self.box.run("sudo tee /etc/polysight/instrument.toml >/dev/null", text)

    def make_keys(self) -> None:
        """Make keys on the Pi and bring the host its two."""
        self.box.run(f"sudo -u polysight {PROGRAM} keys --dir /etc/polysight/keys")
        self.fetch_keys(self.keys, "host")

    def fetch_keys(self, folder: Path, client: str) -> None:
        """Copy a client's keys from the box, under the names that a host's have."""
        folder.mkdir(mode=0o700)
        for name_on_box, name_on_host in (("pi.key", "pi.key"), (f"{client}.key_secret", "host.key_secret")):
            (folder / name_on_host).write_text(self.box.run(f"sudo cat /etc/polysight/keys/{name_on_box}"))

    def systemctl(self, words: str) -> str:
        """Run `sudo systemctl` with these arguments; return its output."""
        return self.box.run(f"sudo systemctl {words}")

    def read_property(self, name: str) -> str:
        """A property of the service."""
        return self.box.run(f"sudo systemctl show --value --property={name} polysight-pi").strip()

    def until_ready(self) -> None:
        """Wait until the service has notified systemd that it is ready."""
        self.box.wait(
            lambda: self.read_property("ActiveState") == "active", f"the service runs\n{self.log()}", READY_LIMIT_S
        )

    def log(self) -> str:
        """The service's log."""
        return self.box.run("sudo journalctl --unit polysight-pi --output cat --lines 40 --no-pager")

    def start(self) -> None:
        """Start the service and wait until it is ready."""
        self.systemctl("reset-failed polysight-pi")
        process = self.box.try_run("sudo systemctl start polysight-pi")
        assert process.returncode == 0, self.log()

    def addresses(self) -> tuple[str, str]:
        """Return the addresses of commands and events. 0.0.0.0 leads here too, and needs keys, unlike 127.0.0.1."""
        return f"tcp://0.0.0.0:{self.box.command_port}", f"tcp://0.0.0.0:{self.box.event_port}"

    def on_host(self, *words: str) -> str:
        """Run `polysight-pi` on the host with a rig file that names the box and the host's keys; return its output."""
        command, event = self.addresses()
        pi_settings = msgspec.structs.replace(
            self.rig.pi, command_address=command, event_address=event, key_dir=str(self.keys)
        )
        config = self.work / "host.toml"
        config.write_bytes(tomli_w.dumps(to_builtins(msgspec.structs.replace(self.rig, pi=pi_settings))).encode())
        program = [BIN / "polysight-pi", *words, "--config", config]
        process = subprocess.run(program, cwd=REPO, capture_output=True, text=True, check=False)
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout

    def host(self) -> HostSide:
        """A host with the keys, connected."""
        return HostSide(*self.addresses(), self.rig, self.keys, READY_LIMIT_S)

    def release(self) -> str:
        """The release in use."""
        return self.box.run("readlink /opt/polysight/venv").strip()

    def check(self) -> dict[str, dict[str, Any]]:
        """Return the findings of `polysight-pi check` by name, run as the service's user."""
        command = f"sudo -u polysight {PROGRAM} check --json --config /etc/polysight/instrument.toml"
        process = self.box.try_run(command)
        assert process.returncode in (0, 1), process.stderr
        findings = {f["name"]: f for f in json.loads(process.stdout)}
        assert process.returncode == any(f["verdict"] == "fail" for f in findings.values())
        return findings
