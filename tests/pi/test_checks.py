"""GPIO and SPI lines without a chip, and `polysight-pi check`: each fault is found, named, and has a remedy."""

import errno
import json
import shutil
import socket
import struct
from collections import namedtuple
from types import SimpleNamespace

import msgspec
import pytest
from tests.support.pi.program import run
from tests.support.refusals import expect_refusal

from polysight_pi import checks, lines as pi_lines
from polysight_pi.checks import check_lines, judge_widths, measure_clock, run_check
from polysight_pi.keys import make_keys
from polysight_pi.lines import GpiodLines, find_chip, open_lines
from polysight_pi.trigger import BurstSpec, send_burst
from polysight_shared.config import Instrument, Pi
from polysight_shared.errors import ErrorCode
from polysight_shared.findings import Finding
from polysight_shared.sockets import create_publisher, create_replier
from polysight_shared.tables import decode, to_builtins
from polysight_simulators import gpio

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
replace = msgspec.structs.replace


@pytest.fixture
def rig_with(gpio_rig):
    """Function that returns the rig on a stand-in chip, with these settings of [pi]."""
    return lambda **settings: replace(gpio_rig, pi=replace(gpio_rig.pi, **settings))


@pytest.fixture
def on_chip(write_config, stage, tmp_path):
    """Function that runs the command on a stand-in chip with these faults; it returns the findings by name."""
    if lacking := gpio.list_missing_packages():
        pytest.skip(f"no stand-in chip without {' '.join(lacking)}: {gpio.ENABLING_COMMAND}")

    def check(rig, *faults, port=None):
        arguments = ("--config", write_config(rig), "--stage-port", port or stage.port, "--json")
        process = run("check", *arguments, **gpio.environment(tmp_path / "chip", faults=faults))
        findings = {f["name"]: f for f in json.loads(process.stdout)}
        assert (process.returncode == 0) == all(f["verdict"] != "fail" for f in findings.values())
        assert all(f["remedy"] for f in findings.values() if f["verdict"] != "ok"), findings
        return findings

    return check


def test_a_rig_without_faults_gets_ok_for_each_check(on_chip, rig_with):
    # A one-shot makes the width of pulses, so the 4 us that each change of the output takes here are good enough.
    findings = on_chip(rig_with(one_shot=True), "slow:4")
    # Whether real-time priority is permitted depends on this machine.
    rights = ["real time"]
    lines = ["GPIO chip", "trigger line 26", "SYNC_IN line 22", "pulses", "pulse width"]
    rest = ["stage", "journal", "keys", "command address", "event address"]
    assert list(findings) == ["plan", *rights, *lines, *rest]
    assert {f["verdict"] for name, f in findings.items() if name not in rights} == {"ok"}


@pytest.mark.parametrize(
    ("settings", "fault", "name", "words"),
    [
        ({}, "denied", "GPIO chip", "Permission denied"),
        ({}, "busy:26", "trigger line 26", "another-program"),
        ({}, "busy:22", "SYNC_IN line 22", "another-program"),
        ({}, "no-edges", "trigger line 26", "reports no edges"),
        # Each change of an output takes 4 us, so that pulses last longer than the radar's 4 us: fault 105.
        ({}, "slow:4", "pulse width", "105"),
        ({"trigger_in": 60}, "slow:0", "trigger line 60", "no such line"),
        ({"gpio_chip": "pinctrl-none"}, "slow:0", "GPIO chip", "'pinctrl-none'"),
    ],
)
def test_each_fault_of_the_chip_is_reported_by_its_check_and_the_others_go_on(
    on_chip, rig_with, settings, fault, name, words
):
    """The check of the stage still runs: it reports that its port does not exist."""
    findings = on_chip(rig_with(**settings), fault, port="/dev/none")
    assert findings[name]["verdict"] == "fail"
    assert words in findings[name]["found"]
    assert findings["stage"]["verdict"] == "fail"
    assert "/dev/none" in findings["stage"]["found"]


def test_a_kernel_that_may_keep_an_output_high_after_a_crash_is_a_warning(rig_with, tmp_path):
    """The parameter `persist_gpio_outputs` of the pin driver is N where lines become inputs when their program ends."""

    def check_levels(model, **settings):
        (tmp_path / "model").write_bytes(model.encode() + b"\0")
        findings = check_lines(rig_with(**settings), tmp_path / "model", tmp_path)
        return [f.level for f in findings if f.where == "line release"]

    pi_4 = "Raspberry Pi 4 Model B Rev 1.4"
    assert check_levels("QEMU Virtual Machine") == []
    # With SPI the kernel completes a transfer, and its last bits are low.
    assert check_levels(pi_4, wiring="spi", sync_out=(10,)) == []
    # An older kernel has no such parameter.
    assert check_levels(pi_4) == ["warning"]
    parameters = tmp_path / "pinctrl_bcm2835" / "parameters"
    parameters.mkdir(parents=True)
    for value, level in (("Y", "warning"), ("N", "ok")):
        (parameters / "persist_gpio_outputs").write_text(value + "\n")
        assert check_levels(pi_4) == [level]


@pytest.mark.parametrize("settings", [{"wiring": "gpiomem"}, {"wiring": "lines", "sync_out": (22, 23)}])
def test_a_wiring_that_the_service_refuses_is_an_error(rig_with, tmp_path, settings):
    findings = list(check_lines(rig_with(**settings), tmp_path / "model", tmp_path))
    assert [(f.level, f.where) for f in findings] == [("error", "wiring")]
    assert "no longer supported" in findings[0].what


def test_one_pulse_in_a_thousand_that_is_too_long_is_an_error_without_a_one_shot():
    """The radar takes at most 4 us (4,000 ns); a one-shot makes the width, which does not depend on the program."""
    assert "measured now" in str(judge_widths([3_000] * 1000, one_shot=False))
    finding = judge_widths([3_000] * 999 + [4_001], one_shot=False)
    assert isinstance(finding, Finding)
    assert finding.level == "error"
    # Two remedies.
    assert "one_shot = true" in finding.do
    assert 'wiring = "spi"' in finding.do
    assert "a one-shot sets the width" in str(judge_widths([3_000] * 999 + [4_001], one_shot=True))


def test_spi_that_is_off_has_its_remedy(rig_with, tmp_path):
    rig_without_spi = rig_with(wiring="spi", sync_out=(10,), spi_device=str(tmp_path / "spidev0.0"))
    finding = run_check("pulse width", measure_clock, rig_without_spi)
    assert finding.level == "error"
    assert "dtparam=spi=on" in finding.do


def test_a_journal_folder_that_cannot_be_made_or_has_too_little_space_is_an_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    assert run_check("journal", checks._check_journal, tmp_path / "file" / "journal", 0).level == "error"
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(100, 99, 1 << 20))
    finding = run_check("journal", checks._check_journal, tmp_path, checks.JOURNAL_BYTES)
    assert finding.level == "error"
    # 1 MiB is free, and 100 MiB are needed.
    assert "1 MiB" in finding.what
    assert "100 MiB" in finding.what


def test_each_fault_of_the_keys_has_its_remedy(tmp_path):
    """Only an address that other machines can reach needs keys."""
    folder = tmp_path / "keys"
    addresses = ("tcp://127.0.0.1:1", "tcp://0.0.0.0:2")
    assert run_check("keys", checks._check_keys, folder, addresses[:1]).level == "ok"
    finding = run_check("keys", checks._check_keys, folder, addresses)
    assert (finding.level, "polysight-pi keys --dir" in finding.do) == ("error", True)
    make_keys(folder)
    assert run_check("keys", checks._check_keys, folder, addresses).level == "ok"
    (folder / "pi.key_secret").chmod(0o644)
    finding = run_check("keys", checks._check_keys, folder, addresses)
    assert (finding.level, "chmod 600" in finding.do) == ("warning", True)
    (folder / "pi.key_secret").chmod(0o600)
    (folder / "allowed_clients").write_text("")
    finding = run_check("keys", checks._check_keys, folder, addresses)
    assert (finding.level, "--client" in finding.do) == ("warning", True)
    (folder / "pi.key_secret").write_text("garbage")
    finding = run_check("keys", checks._check_keys, folder, addresses)
    assert (finding.level, f"keys --dir {folder} --replace" in finding.do) == ("error", True)


def test_keys_that_root_made_are_given_to_the_services_user(tmp_path, monkeypatch):
    """A test as root may read every file, so the refusal is simulated."""

    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    folder = tmp_path / "keys"
    make_keys(folder)
    monkeypatch.setattr(checks, "load_certificate", refuse)
    monkeypatch.setattr("zmq.auth.load_certificate", refuse)
    address = "tcp://0.0.0.0:*"
    for finding in (
        run_check("keys", checks._check_keys, folder, (address,)),
        run_check("command address", checks._check_address, create_replier, address, folder),
    ):
        assert (finding.level, f"`sudo chown -R polysight: {folder}`" in finding.do) == ("error", True)


def test_an_address_in_use_without_keys_or_invalid_and_a_burst_too_long_are_errors(tmp_path, gpio_rig):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        assert run_check("command address", checks._check_address, create_replier, address, tmp_path).level == "error"
    finding = run_check("event address", checks._check_address, create_publisher, "tcp://0.0.0.0:*", tmp_path)
    assert (finding.level, "polysight-pi keys" in finding.do) == ("error", True)
    assert run_check("event address", checks._check_address, create_publisher, "tcp//x", tmp_path).level == "error"
    slow = replace(gpio_rig, burst=replace(gpio_rig.burst, pulses=100))
    assert run_check("plan", checks._check_plan, slow).level == "error", "the burst does not end before the next point"


# Number of the system call that sets lines, GPIO_V2_LINE_SET_VALUES_IOCTL of <linux/gpio.h>:
# _IOWR(0xB4, 0x0F, two 64-bit words).
SET_VALUES = 3 << 30 | 16 << 16 | 0xB4 << 8 | 0x0F


@pytest.mark.parametrize(("width_ns", "sent_ns"), [(25, 0), (1000, 0), (1001, 1001), (4000, 4000)])
def test_a_short_pulse_is_two_calls_with_nothing_between_them(gpio_rig, monkeypatch, width_ns, sent_ns):
    """Up to 1 us the line is set and cleared without waiting, which takes about that time on a Pi.

    The test's clock advances only while the program sleeps, so a short pulse has no length here.
    """
    clock = SimpleNamespace(t=0)
    # Time and level of each change of the output.
    log = []

    def ioctl(fd, number, values):
        bits, mask = struct.unpack("=QQ", values)
        assert (fd, number, mask) == (7, SET_VALUES, 1)
        if not log or log[-1][1] != bits:
            log.append((clock.t, bits))

    request = SimpleNamespace(fd=7, release=lambda: None)
    monkeypatch.setattr(pi_lines, "_request", lambda *_, **__: request)
    monkeypatch.setattr(pi_lines, "_is_stamped_by_the_kernel", lambda _: True)
    monkeypatch.setattr(pi_lines.fcntl, "ioctl", ioctl)
    monkeypatch.setattr(pi_lines, "time", SimpleNamespace(monotonic_ns=lambda: clock.t))
    monkeypatch.setattr(pi_lines.TriggerInput, "sleep_until", lambda _, t_ns: setattr(clock, "t", max(clock.t, t_ns)))
    spec = BurstSpec(4, 1_500_000, width_ns)
    sent = send_burst(GpiodLines(gpio_rig.pi), spec, 5_000)
    expected_log = []
    for k in range(4):
        rise_ns = 5_000 + k * spec.period_ns
        expected_log += [(rise_ns, 1), (rise_ns + sent_ns, 0)]
    # At time 0 the line was set low.
    assert [change for change in log if change[0]] == expected_log
    assert (sent.pulses, sent.width_max_ns) == (4, sent_ns)


@pytest.mark.parametrize(("wiring", "sync_out"), [("lines", (22, 23, 24)), ("gpiomem", (22,))])
def test_wirings_of_older_releases_are_read_from_manifests_but_not_opened(gpio_rig, hub, wiring, sync_out):
    old = {"wiring": wiring, "sync_out": sync_out, "gpiomem": "/dev/gpiomem"}
    rig = msgspec.structs.replace(gpio_rig, pi=msgspec.structs.replace(gpio_rig.pi, **old))
    assert decode(to_builtins(rig), Instrument, "manifest") == rig
    for wires in (None, hub):
        with expect_refusal(ErrorCode.VALUE_INVALID, wiring, "fanout"):
            open_lines(rig, wires)


def test_with_spi_the_output_is_the_mosi_pin_of_the_device():
    """GPIO 10 for SPI 0, GPIO 20 for SPI 1."""
    with pytest.raises(ValueError, match="GPIO 10"):
        Pi(wiring="spi", sync_out=(22,))
    assert Pi(wiring="spi", sync_out=(20,), spi_device="/dev/spidev1.0").sync_out == (20,)
    with pytest.raises(ValueError, match="GPIO 20"):
        Pi(wiring="spi", sync_out=(10,), spi_device="/dev/spidev1.0")


def test_a_missing_chip_is_reported_with_those_that_exist(tmp_path):
    assert find_chip("/dev/gpiochip7") == "/dev/gpiochip7"
    (tmp_path / "gpiochip0").write_text("")
    with expect_refusal(ErrorCode.FILE_MISSING, "pinctrl-bcm2835", "gpiochip0"):
        find_chip("pinctrl-bcm2835", tmp_path)
