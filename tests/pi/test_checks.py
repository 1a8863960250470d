"""`polysight-pi check`: each fault is found, named, and comes with what to do."""

from __future__ import annotations

import ctypes
import json
import shutil
import socket
from collections import namedtuple

import msgspec
import pytest

from polysight.pi_controller import checks
from polysight.pi_controller import lines as pi_lines
from polysight.pi_controller.checks import attempt, check_lines, measure_clock
from polysight.pi_controller.keys import make_keys
from polysight.shared.sockets import publisher, replier
from polysight.simulators import gpio
from tests.support.pi.program import run
from tests.support.rigs import timed_by_the_program

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
replace = msgspec.structs.replace


@pytest.fixture
def instrument(instrument):
    """With SYNC_IN on a GPIO line."""
    return timed_by_the_program(instrument)


@pytest.fixture
def rig(instrument, tmp_path):
    """The chip's device is made by the stand-in."""
    return replace(instrument, pi=replace(instrument.pi, gpio_chip=str(tmp_path / "chip")))


@pytest.fixture
def on_chip(write_config, stage, tmp_path):
    """Findings, by name, of the command on a stand-in chip with faults."""
    if lacking := gpio.missing():
        pytest.skip(f"no stand-in chip without {' '.join(lacking)}: {gpio.ENABLING_COMMAND}")

    def check(rig, *faults, port=None):
        arguments = ("--config", write_config(rig), "--stage-port", port or stage.port, "--json")
        done = run("check", *arguments, **gpio.environment(tmp_path / "chip", faults=faults))
        findings = {f["name"]: f for f in json.loads(done.stdout)}
        assert (done.returncode == 0) == all(f["verdict"] != "fail" for f in findings.values())
        assert all(f["remedy"] for f in findings.values() if f["verdict"] != "ok"), findings
        return findings

    return check


def test_a_whole_rig_is_all_ok(on_chip, rig):
    found = on_chip(replace(rig, pi=replace(rig.pi, one_shot=True)))  # how fast this machine is, is not asked
    rights = ["real time"]  # as this machine has it
    lines = ["GPIO chip", "trigger line 26", "SYNC_IN line 22", "pulse width"]
    rest = ["stage", "journal", "keys", "command address", "event address"]
    assert list(found) == ["plan", *rights, *lines, *rest]
    assert {f["verdict"] for name, f in found.items() if name not in rights} == {"ok"}


@pytest.mark.parametrize(
    ("fault", "name", "words"),
    [
        ("denied", "GPIO chip", "Permission denied"),
        ("busy:26", "trigger line 26", "another-program"),
        ("busy:22", "SYNC_IN line 22", "another-program"),
        ("no-edges", "trigger line 26", "reports no edges"),
    ],
)
def test_faults_of_the_chip(on_chip, rig, fault, name, words):
    found = on_chip(rig, fault)
    assert found[name]["verdict"] == "fail"
    assert words in found[name]["found"]


def test_no_chip_no_line_no_port_and_a_deaf_stage(on_chip, rig, stage):
    found = on_chip(replace(rig, pi=replace(rig.pi, gpio_chip="pinctrl-none", trigger_in=60)), port="/dev/none")
    assert "'pinctrl-none'" in found["GPIO chip"]["found"]
    assert "/dev/none cannot be opened" in found["stage"]["found"]
    assert found["stage"]["verdict"] == "fail"
    found = on_chip(replace(rig, pi=replace(rig.pi, trigger_in=60)))
    assert "no such line" in found["trigger line 60"]["found"]
    stage.deaf = True
    found = on_chip(rig)
    assert found["stage"]["verdict"] == "fail"
    assert "HELLO" in found["stage"]["found"]


def test_line_release(rig, tmp_path):
    def of(model, **changes):
        (tmp_path / "model").write_bytes(model.encode() + b"\0")
        changed = replace(rig, pi=replace(rig.pi, **changes))
        return [f for f in check_lines(changed, tmp_path / "model", tmp_path) if f.name == "line release"]

    pi_4 = "Raspberry Pi 4 Model B Rev 1.4"
    assert not of("QEMU Virtual Machine")
    assert not of(pi_4, wiring="spi", sync_out=(10,)), "the kernel ends a transfer, and its last bits are low"
    assert of(pi_4)[0].verdict == "warn"  # an older kernel
    parameters = tmp_path / "pinctrl_bcm2835" / "parameters"
    parameters.mkdir(parents=True)
    for value, verdict in (("Y", "warn"), ("N", "ok")):
        (parameters / "persist_gpio_outputs").write_text(value + "\n")
        (found,) = of(pi_4)
        assert found.verdict == verdict
        assert (verdict == "ok") or "strict_gpiod" in found.remedy


@pytest.mark.parametrize(("slow", "one_shot", "verdict"), [("0", False, "ok"), ("4", False, "fail"), ("4", True, "ok")])
def test_widths_are_measured_with_the_line_low(on_chip, rig, slow, one_shot, verdict):
    """`slow:US`: each change of an output takes so long, as a Pi's do. No pulse is sent meanwhile."""
    found = on_chip(replace(rig, pi=replace(rig.pi, one_shot=one_shot)), *([f"slow:{slow}"] if slow != "0" else []))
    width = found["pulse width"]
    if slow == "0":
        assert "measured now" in width["found"] or width["verdict"] == "fail", "as fast as this machine is"
    else:
        assert width["verdict"] == verdict
    assert width["verdict"] == "ok" or 'wiring = "spi"' in width["remedy"]


class Spidev:
    """An SPI controller behind a file, at so many times the clock it is asked for."""

    def __init__(self, rate, monkeypatch):
        self.t, self.rate, self.data = 0, rate, []
        monkeypatch.setattr(pi_lines.fcntl, "ioctl", self.ioctl)
        monkeypatch.setattr(pi_lines.time, "monotonic_ns", lambda: self.t)

    def ioctl(self, _, number, message):
        if number == pi_lines.MESSAGE:
            tx, _, length, clock_hz, *_ = pi_lines._TRANSFER.unpack(message)
            self.data.append(ctypes.string_at(tx, length))
            self.t += 60_000 + round(8e9 * length / clock_hz / self.rate)
        return 0


@pytest.mark.parametrize(("rate", "verdict"), [(1.0, "ok"), (1.6, "fail"), (0.6, "fail")])
def test_an_spi_clock_is_measured_with_the_line_low(rig, tmp_path, monkeypatch, rate, verdict):
    (tmp_path / "spidev0.0").touch()
    device = Spidev(rate, monkeypatch)
    pi = replace(rig.pi, wiring="spi", sync_out=(10,), spi_device=str(tmp_path / "spidev0.0"))
    found = attempt("pulse width", lambda: measure_clock(replace(rig, pi=pi)))
    assert found.verdict == verdict
    assert (verdict == "ok") == (not found.remedy)
    assert not any(any(data) for data in device.data), "no pulse"
    pi_lines.SpiDevice(pi.spi_device).transfer(b"\x01\x80", 1_000_000)
    assert device.data[-1] == b"\x01\x80"


def test_spi_that_is_off_is_told(rig, tmp_path):
    pi = replace(rig.pi, wiring="spi", sync_out=(10,), spi_device=str(tmp_path / "spidev0.0"))
    found = attempt("pulse width", lambda: measure_clock(replace(rig, pi=pi)))
    assert (found.verdict, "dtparam=spi=on" in found.remedy) == ("fail", True)


def test_rights_that_are_missing(monkeypatch):
    monkeypatch.setattr(checks.system, "prepare_process", lambda: ["no real-time scheduling", "memory is not locked"])
    monkeypatch.setattr(checks.system, "prepare_thread", lambda: ["no real-time scheduling"])
    found = checks._real_time()
    assert (found.verdict, found.found) == ("warn", "no real-time scheduling; memory is not locked")
    assert "LimitRTPRIO" in found.remedy


def test_journal_and_disk(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    found = attempt("journal", checks._journal, tmp_path / "file" / "journal", 0)
    assert found.verdict == "fail"
    assert found.remedy
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(100, 99, 1 << 20))
    found = attempt("journal", checks._journal, tmp_path, checks.JOURNAL_BYTES)
    assert (found.verdict, "1 MiB free, 100 MiB wanted" in found.found) == ("fail", True)


def test_keys(tmp_path):
    folder, addresses = tmp_path / "keys", ("tcp://127.0.0.1:1", "tcp://0.0.0.0:2")
    assert checks.attempt("keys", lambda: checks._keys(folder, addresses[:1])).verdict == "ok"
    found = checks.attempt("keys", lambda: checks._keys(folder, addresses))
    assert (found.verdict, found.remedy) == ("fail", "polysight-pi keys")
    make_keys(folder)
    assert checks.attempt("keys", lambda: checks._keys(folder, addresses)).verdict == "ok"
    (folder / "pi.key_secret").chmod(0o644)
    found = checks.attempt("keys", lambda: checks._keys(folder, addresses))
    assert (found.verdict, "chmod 600" in found.remedy) == ("warn", True)


def test_addresses(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        found = checks.attempt("command address", checks._address, replier, address, tmp_path)
    assert found.verdict == "fail"
    found = checks.attempt("event address", checks._address, publisher, "tcp://0.0.0.0:*", tmp_path)
    assert (found.verdict, "polysight-pi keys" in found.remedy) == ("fail", True)
    found = checks.attempt("event address", checks._address, publisher, "tcp//x", tmp_path)
    assert found.verdict == "fail"


def test_a_burst_that_does_not_fit(rig):
    slow = replace(rig, burst=replace(rig.burst, pulses=100))
    found = checks.attempt("plan", lambda: checks._plan(slow))
    assert (found.verdict, "burst" in found.found) == ("fail", True)
