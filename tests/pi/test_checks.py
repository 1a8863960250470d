"""`polysight-pi check` finds and names each fault of a Pi and has a remedy; GPIO and SPI lines without a chip.

The check tests the planned burst, the GPIO and SPI lines, the stage, the journal's folder, the keys and the addresses.
"""

import errno
import json
import shutil
import socket
import struct
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
from polysight_shared.faults import PiFault
from polysight_shared.findings import Finding
from polysight_shared.raster import MAX_WIDTH_NS
from polysight_shared.sockets import create_publisher, create_replier
from polysight_shared.tables import decode, to_builtins
from polysight_simulators import gpio

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
replace = msgspec.structs.replace
# An address for which no other machine can be a client, and one that all machines of the network can reach.
LOOPBACK_ADDRESS = "tcp://127.0.0.1:1"
OPEN_ADDRESS = "tcp://0.0.0.0:*"


@pytest.fixture
def rig_with(gpio_rig):
    """Function that returns the rig on a stand-in chip, with these settings of [pi]."""
    return lambda **settings: replace(gpio_rig, pi=replace(gpio_rig.pi, **settings))


@pytest.fixture
def check_on_chip(write_config, stage, tmp_path):
    """Function that runs `polysight-pi check` on a stand-in chip with these faults, and returns the findings by name.

    Faults of the chip are described in `polysight_simulators.gpio.environment`.
    """
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


def test_a_rig_without_faults_gets_ok_for_each_check(check_on_chip, rig_with):
    # On this chip each change of the output takes 4 us longer. With a one-shot that does not matter: the one-shot makes
    # the width of the pulses, not the program.
    findings = check_on_chip(rig_with(one_shot=True), "slow:4")
    # Whether real-time priority is permitted depends on this machine.
    rights = ["real time"]
    lines = ["GPIO chip", "trigger line 26", "SYNC_IN line 22", "pulses", "pulse width"]
    rest = ["stage", "journal", "keys", "command address", "event address"]
    assert list(findings) == ["plan", *rights, *lines, *rest]
    assert {f["verdict"] for name, f in findings.items() if name not in rights} == {"ok"}


# A chip without a fault: changes of its outputs take no longer than usual.
NO_FAULT = "slow:0"


@pytest.mark.parametrize(
    ("settings", "fault", "name", "words"),
    [
        ({}, "denied", "GPIO chip", "Permission denied"),
        ({}, "busy:26", "trigger line 26", "another-program"),
        ({}, "busy:22", "SYNC_IN line 22", "another-program"),
        ({}, "no-edges", "trigger line 26", "reports no edges"),
        # Each change of an output takes 4 us longer, so that pulses exceed the radar's longest width, 4 us.
        ({}, "slow:4", "pulse width", f"fault {int(PiFault.PULSE_TOO_LONG)}"),
        ({"trigger_in": 60}, NO_FAULT, "trigger line 60", "no such line"),
        ({"gpio_chip": "pinctrl-none"}, NO_FAULT, "GPIO chip", "'pinctrl-none'"),
    ],
)
def test_a_fault_of_the_chip_is_reported_and_the_stage_is_still_checked(
    check_on_chip, rig_with, settings, fault, name, words
):
    """The check of the stage reports that its port does not exist."""
    findings = check_on_chip(rig_with(**settings), fault, port="/dev/none")
    assert findings[name]["verdict"] == "fail"
    assert words in findings[name]["found"]
    assert findings["stage"]["verdict"] == "fail"
    assert "/dev/none" in findings["stage"]["found"]


def test_a_kernel_that_may_keep_an_output_high_after_a_crash_is_a_warning(rig_with, tmp_path):
    """Lines become inputs when their program ends if the pin driver's parameter `persist_gpio_outputs` is N.

    If it is Y, a line stays as the program left it.
    """

    def list_levels(model, **settings):
        """Levels of the findings about the release of lines on this model of computer."""
        (tmp_path / "model").write_bytes(model.encode() + b"\0")
        findings = check_lines(rig_with(**settings), tmp_path / "model", tmp_path)
        return [f.level for f in findings if f.where == "line release"]

    pi_4 = "Raspberry Pi 4 Model B Rev 1.4"
    assert list_levels("QEMU Virtual Machine") == []
    # With SPI the kernel completes a transfer, and its last bits are low.
    assert list_levels(pi_4, wiring="spi", sync_out=(10,)) == []
    # An older kernel has no such parameter.
    assert list_levels(pi_4) == ["warning"]
    parameters = tmp_path / "pinctrl_bcm2835" / "parameters"
    parameters.mkdir(parents=True)
    for value, level in (("Y", "warning"), ("N", "ok")):
        (parameters / "persist_gpio_outputs").write_text(value + "\n")
        assert list_levels(pi_4) == [level]


@pytest.mark.parametrize("settings", [{"wiring": "gpiomem"}, {"wiring": "lines", "sync_out": (22, 23)}])
def test_a_wiring_that_the_service_refuses_is_an_error(rig_with, tmp_path, settings):
    findings = list(check_lines(rig_with(**settings), tmp_path / "model", tmp_path))
    assert [(f.level, f.where) for f in findings] == [("error", "wiring")]
    assert "no longer supported" in findings[0].what


def test_a_single_pulse_that_is_too_long_is_an_error_unless_a_one_shot_makes_the_width():
    """`judge_widths` returns a Finding for an error, and a text otherwise."""
    sound_ns = [3_000] * 1000
    one_too_long_ns = [3_000] * 999 + [MAX_WIDTH_NS + 1]
    accepted = judge_widths(sound_ns, one_shot=False)
    assert isinstance(accepted, str)
    assert "measured now" in accepted
    finding = judge_widths(one_too_long_ns, one_shot=False)
    assert isinstance(finding, Finding)
    assert finding.level == "error"
    # Two remedies.
    assert "one_shot = true" in finding.do
    assert 'wiring = "spi"' in finding.do
    accepted_with_one_shot = judge_widths(one_too_long_ns, one_shot=True)
    assert isinstance(accepted_with_one_shot, str)
    assert "a one-shot sets the width" in accepted_with_one_shot


def test_spi_that_is_off_has_its_remedy(rig_with, tmp_path):
    rig_without_spi = rig_with(wiring="spi", sync_out=(10,), spi_device=str(tmp_path / "spidev0.0"))
    finding = run_check("pulse width", measure_clock, rig_without_spi)
    assert finding.level == "error"
    assert "dtparam=spi=on" in finding.do


def check_journal(folder, needed_bytes):
    return run_check("journal", checks._check_journal, folder, needed_bytes)


def test_a_journal_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    assert check_journal(tmp_path / "file" / "journal", needed_bytes=0).level == "error"


def test_too_little_space_for_the_journal_is_an_error(tmp_path, monkeypatch):
    disk = SimpleNamespace(free=1 << 20)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk)
    finding = check_journal(tmp_path, needed_bytes=100 << 20)
    assert finding.level == "error"
    assert "1 MiB free" in finding.what
    assert "100 MiB wanted" in finding.what


def check_keys(folder, *addresses):
    return run_check("keys", checks._check_keys, folder, addresses)


def check_address(name, create_socket, address, key_folder):
    return run_check(name, checks._check_address, create_socket, address, key_folder)


def test_an_address_that_only_this_machine_can_reach_needs_no_keys(tmp_path):
    assert check_keys(tmp_path / "keys", LOOPBACK_ADDRESS).level == "ok"


def test_each_fault_of_the_keys_has_its_remedy(tmp_path):
    folder = tmp_path / "keys"
    secret_key = folder / "pi.key_secret"

    def expect_finding(level, remedy):
        finding = check_keys(folder, LOOPBACK_ADDRESS, OPEN_ADDRESS)
        assert finding.level == level
        assert remedy in finding.do

    expect_finding("error", "polysight-pi keys --dir")
    make_keys(folder)
    expect_finding("ok", "")
    secret_key.chmod(0o644)
    expect_finding("warning", "chmod 600")
    secret_key.chmod(0o600)
    (folder / "allowed_clients").write_text("")
    expect_finding("warning", "--client")
    secret_key.write_text("garbage")
    expect_finding("error", f"keys --dir {folder} --replace")


def test_keys_that_root_made_are_given_to_the_services_user(tmp_path, monkeypatch):
    """A test as root may read every file, so the refusal is simulated."""

    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    folder = tmp_path / "keys"
    make_keys(folder)
    monkeypatch.setattr(checks, "load_certificate", refuse)
    monkeypatch.setattr("zmq.auth.load_certificate", refuse)
    findings = [
        check_keys(folder, OPEN_ADDRESS),
        check_address("command address", create_replier, OPEN_ADDRESS, folder),
    ]
    for finding in findings:
        assert finding.level == "error"
        assert f"`sudo chown -R polysight: {folder}`" in finding.do


def test_an_address_in_use_is_an_error(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        _, port = server.getsockname()
        finding = check_address("command address", create_replier, f"tcp://127.0.0.1:{port}", tmp_path)
    assert finding.level == "error"


def test_an_open_address_without_keys_is_an_error(tmp_path):
    finding = check_address("event address", create_publisher, OPEN_ADDRESS, tmp_path)
    assert finding.level == "error"
    assert "polysight-pi keys" in finding.do


def test_an_invalid_address_is_an_error(tmp_path):
    assert check_address("event address", create_publisher, "tcp//x", tmp_path).level == "error"


def test_a_burst_that_does_not_end_before_the_next_point_is_an_error(gpio_rig):
    too_many_pulses = replace(gpio_rig, burst=replace(gpio_rig.burst, pulses=100))
    assert run_check("plan", checks._check_plan, too_many_pulses).level == "error"


# Number of the system call that sets lines: GPIO_V2_LINE_SET_VALUES_IOCTL of <linux/gpio.h>, which is
# _IOWR(0xB4, 0x0F, two 64-bit words). From the highest bits on: read and write (3), 16 bytes, type and number.
SET_VALUES = 3 << 30 | 16 << 16 | 0xB4 << 8 | 0x0F


@pytest.mark.parametrize(
    ("width_ns", "slept_ns"),
    [
        # Up to 1 us the program does not sleep.
        (25, 0), (1000, 0),
        (1001, 1001), (4000, 4000),
    ],
)  # fmt: skip
def test_a_pulse_of_up_to_1_us_is_two_calls_without_sleep_between_them(gpio_rig, monkeypatch, width_ns, slept_ns):
    """On a Pi the two calls, which set and clear the line, take about 1 us.

    The test's clock advances only while the program sleeps, so a short pulse has no length here.
    """
    clock = SimpleNamespace(now_ns=0)
    # Time and level of each change of the output.
    changes = []
    # The line is low from the beginning.
    level = 0
    request = SimpleNamespace(fd=7, release=lambda: None)

    def set_line(fd, number, values):
        nonlocal level
        new_level, mask = struct.unpack("=QQ", values)
        assert (fd, number, mask) == (request.fd, SET_VALUES, 1)
        if new_level != level:
            changes.append((clock.now_ns, new_level))
        level = new_level

    def sleep_until(_lines, t_ns):
        clock.now_ns = max(clock.now_ns, t_ns)

    monkeypatch.setattr(pi_lines, "_request", lambda *_, **__: request)
    monkeypatch.setattr(pi_lines, "_is_stamped_by_the_kernel", lambda _: True)
    monkeypatch.setattr(pi_lines.fcntl, "ioctl", set_line)
    monkeypatch.setattr(pi_lines, "time", SimpleNamespace(monotonic_ns=lambda: clock.now_ns))
    monkeypatch.setattr(pi_lines.TriggerInput, "sleep_until", sleep_until)
    start_ns = 5_000
    spec = BurstSpec(pulses=4, period_ns=1_500_000, width_ns=width_ns)
    sent = send_burst(GpiodLines(gpio_rig.pi), spec, start_ns)
    expected_changes = []
    for k in range(spec.pulses):
        rise_ns = start_ns + k * spec.period_ns
        expected_changes += [(rise_ns, 1), (rise_ns + slept_ns, 0)]
    assert changes == expected_changes
    assert (sent.pulses, sent.width_max_ns) == (spec.pulses, slept_ns)


@pytest.mark.parametrize(("wiring", "sync_out"), [("lines", (22, 23, 24)), ("gpiomem", (22,))])
def test_wirings_of_older_releases_are_read_from_manifests_but_not_opened(gpio_rig, hub, wiring, sync_out):
    """They are refused on GPIO lines and on simulated wires; the refusal advises the wiring `fanout` instead."""
    rig = replace(gpio_rig, pi=replace(gpio_rig.pi, wiring=wiring, sync_out=sync_out, gpiomem="/dev/gpiomem"))
    assert decode(to_builtins(rig), Instrument, "manifest") == rig
    gpio_lines = None
    for simulated_wires in (gpio_lines, hub):
        with expect_refusal(ErrorCode.VALUE_INVALID, wiring, "fanout"):
            open_lines(rig, simulated_wires)


def test_with_spi_the_output_is_the_mosi_pin_of_the_device():
    """MOSI is GPIO 10 for SPI 0, which is the default, and GPIO 20 for SPI 1."""
    with pytest.raises(ValueError, match="GPIO 10"):
        Pi(wiring="spi", sync_out=(22,))
    assert Pi(wiring="spi", sync_out=(20,), spi_device="/dev/spidev1.0").sync_out == (20,)
    with pytest.raises(ValueError, match="GPIO 20"):
        Pi(wiring="spi", sync_out=(10,), spi_device="/dev/spidev1.0")


def test_the_refusal_of_a_missing_chip_lists_the_existing_ones(tmp_path):
    assert find_chip("/dev/gpiochip7") == "/dev/gpiochip7"
    (tmp_path / "gpiochip0").write_text("")
    with expect_refusal(ErrorCode.FILE_MISSING, "pinctrl-bcm2835", "gpiochip0"):
        find_chip("pinctrl-bcm2835", tmp_path)
