"""A Raspberry Pi 3B in a box: Debian's kernel and its GPIO driver, the real installation, the emulated UNO on USB.

`make test-pi` runs these and prints figures; docs/how-to/hardware-tests.md lists what is emulated.
The tests share one Pi and run in this order; each leaves the service running.
"""

import itertools
import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
from tests.pi_box.installed import PROGRAM, InstalledPi, print_figure
from tests.support.pi.host_side import HostSide
from tests.support.rigs import load_published_rig, set_stage_port, time_by_spi

from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_shared.sockets import HandshakeMonitor, create_requester

# GPIO line of SYNC_IN in the rig file, and functions of a line in the chip's registers.
SYNC_OUT = 22
INPUT = 0
OUTPUT = 1
# Attempts of an action that a busy computer may delay too long
TRIES = 5
pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


@pytest.fixture
def bench(pi: InstalledPi) -> Iterator[InstalledPi]:
    """The Pi with its service stopped, as for work at the bench."""
    pi.systemctl("stop polysight-pi")
    yield pi
    pi.configure()
    pi.start()


@pytest.fixture
def homed_host(host: HostSide) -> HostSide:
    """The host, after homing."""
    home(host)
    return host


def home(host: HostSide) -> None:
    """Home the stage; once more if the Pi calls it lost, because a busy computer delays the connection for a second."""
    for _ in range(TRIES):
        host.must_accept(m.Home())
        if host.wait_for_state("homed", "ready", "fault").state != "fault":
            return
    raise AssertionError(host.ask(m.Status()))


def service_pid(pi: InstalledPi) -> str:
    """The service's process."""
    return pi.read_property("MainPID")


def format_s(begun: float) -> str:
    """Duration since `begun`, by this computer's clock, for a figure."""
    return f"{time.monotonic() - begun:.1f} s"


def test_what_is_installed_belongs_to_whom_the_page_says(pi: InstalledPi):
    """The table of docs/how-to/install.md."""
    places = "/etc/polysight/keys /etc/polysight/keys/pi.key_secret /var/lib/polysight /dev/gpiochip0"
    stat = pi.box.run(f"sudo stat --dereference --format='%n %U:%G %a' {places} /dev/polysight-stage")
    assert dict(line.split(maxsplit=1) for line in stat.splitlines()) == {
        "/etc/polysight/keys": "polysight:polysight 700",
        "/etc/polysight/keys/pi.key_secret": "polysight:polysight 600",
        "/var/lib/polysight": "polysight:polysight 750",
        "/dev/gpiochip0": "root:gpio 660",
        "/dev/polysight-stage": "root:dialout 660",
    }
    assert (pi.read_property("UnitFileState"), pi.read_property("User")) == ("enabled", "polysight")


def test_the_service_has_the_rights_that_its_unit_promises(pi: InstalledPi):
    """Real-time threads and locked memory; a missing right is reported in the log."""
    assert "no real-time scheduling" not in pi.log()
    assert "memory is not locked" not in pi.log()
    threads = pi.box.run(f"ps -L -o cls=,rtprio= -p {service_pid(pi)}").split("\n")
    assert {"FF 40", "FF 50"} <= {" ".join(t.split()) for t in threads}, "the trigger thread before the others"
    locked = pi.box.run(f"grep VmLck /proc/{service_pid(pi)}/status").split()[1]
    assert int(locked) > 0


def test_a_host_with_the_keys_is_answered_and_one_without_is_refused(pi: InstalledPi, host: HostSide, tmp_path: Path):
    hello = host.ask(m.Hello())
    assert (hello.backend, hello.state) == ("gpiod", "idle")
    assert hello.firmware
    pi.box.run(f"sudo -u polysight {PROGRAM} keys --dir /etc/polysight/keys --client second")
    pi.fetch_keys(tmp_path / "second", "second")
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    second = create_requester(context, pi.addresses()[0], tmp_path / "second")
    second.send(m.pack(m.Hello()))
    assert second.poll(60_000)
    assert isinstance(m.unpack_reply(second.recv()), m.HelloReply)
    pi.box.run(f"sudo -u polysight {PROGRAM} keys --dir /etc/polysight/keys --revoke second")
    second.send(m.pack(m.Hello()))
    assert second.poll(60_000)
    refused = m.unpack_reply(second.recv())
    assert isinstance(refused, m.Refused)
    assert refused.number == PiFault.NOT_OWNER
    stranger = create_requester(context, pi.addresses()[0], tmp_path / "second")
    refusals = HandshakeMonitor(stranger)
    pi.box.wait(refusals.is_refused, "a revoked key is refused at the door", 60)
    refusals.close()
    context.destroy(linger=0)


def test_home_brings_the_motors_to_zero(pi: InstalledPi):
    """`polysight-pi home` on the host, through the service; the steps are counted at the board's pins."""
    begun = time.monotonic()
    assert json.loads(pi.on_host("home", "--json")) == {"x_mm": 0.0, "y_mm": 0.0}
    print_figure(f"home, through the service: {format_s(begun)}")
    assert pi.uno.stands_at_mm == (0.0, 0.0)


def test_a_bench_burst_is_made_of_one_rise_and_one_fall_a_pulse(pi: InstalledPi, homed_host: HostSide):
    """The kernel's driver writes as many pulses to the chip's registers, seen from outside the Pi, as are reported.

    Clearing a line that is low makes no edge: the program does so to be quick. An emulated processor may be so late
    that a pulse would come too early for a radar: the burst ends there, and says so.
    """
    assert (pi.box.function(SYNC_OUT), pi.box.level(SYNC_OUT)) == (OUTPUT, 0)
    burst = pi.rig.burst
    pulse = m.Pulse(pulses=burst.pulses, period_us=burst.period_us, width_us=burst.width_us)
    for _ in range(TRIES):
        replies: list[m.Pulsed] = []
        writes = pi.box.writes_during(lambda: replies.append(homed_host.ask(pulse)))  # noqa: B023
        reply = replies[0]
        assert isinstance(reply, m.Pulsed), replies
        assert [w.lines for w in writes] == [1 << SYNC_OUT] * len(writes), "no other line is touched"
        levels_before = [False, *(w.high for w in writes)]
        # A write that changes the level is an edge; the line is low before and after the burst.
        edges = [w for w, was_high in zip(writes, levels_before, strict=False) if w.high != was_high]
        rises = edges[::2]
        falls = edges[1::2]
        assert len(rises) == len(falls) == reply.pulses > 0
        is_whole_burst = reply.pulses == burst.pulses
        assert is_whole_burst == (reply.fault == 0)
        assert pi.box.level(SYNC_OUT) == 0
        if is_whole_burst:
            break
    spacings_ms = [(b.t_s - a.t_s) * 1e3 for a, b in itertools.pairwise(rises)] or [0.0]
    widths_us = [(fall.t_s - rise.t_s) * 1e6 for rise, fall in zip(rises, falls, strict=True)]
    print_figure(
        f"bench burst: {len(rises)} of {burst.pulses} pulses, {min(widths_us):.0f} .. {max(widths_us):.0f} us wide and"
        f" {min(spacings_ms):.2f} .. {max(spacings_ms):.2f} ms apart, on this computer's clock"
    )


def test_check_finds_everything_that_is_there(bench: InstalledPi):
    findings = bench.check()
    verdicts = {name: f["verdict"] for name, f in findings.items()}
    print_figure("check: " + ", ".join(f"{name} {verdict}" for name, verdict in verdicts.items()))
    assert "fail" not in verdicts.values(), findings
    # Rights of the unit, which a shell lacks; and Debian's driver does not say if lines of dead programs are released.
    assert {n for n, v in verdicts.items() if v == "warn"} <= {"real time", "line release"}
    assert findings["GPIO chip"]["found"].endswith("is 'pinctrl-bcm2835'")
    assert verdicts["keys"] == verdicts["stage"] == "ok"


def test_check_of_a_rig_with_spi_names_it_and_nothing_else(bench: InstalledPi):
    """There is no SPI controller, as on a Pi where it is not enabled."""
    bench.configure(set_stage_port(time_by_spi(load_published_rig()), bench.rig.stage.port))
    findings = bench.check()
    assert {n for n, f in findings.items() if f["verdict"] == "fail"} == {"SYNC_IN line 10", "pulse width"}
    assert "dtparam=spi=on" in findings["SYNC_IN line 10"]["remedy"]


def test_a_jog_by_hand_moves_the_motors_by_its_distance(bench: InstalledPi):
    by_hand = f"sudo -u polysight {PROGRAM}"
    config = "--config /etc/polysight/instrument.toml --json"
    assert json.loads(bench.box.run(f"{by_hand} home {config}")) == {"x_mm": 0.0, "y_mm": 0.0}
    begun = time.monotonic()
    assert json.loads(bench.box.run(f"{by_hand} jog --dx 10 --dy 5 {config}")) == {"x_mm": 10.0, "y_mm": 5.0}
    print_figure(f"jog by 10 mm and 5 mm, the program's start included: {format_s(begun)}")
    bench.box.wait(lambda: not bench.uno.moving, "the motors rest")
    assert bench.uno.stands_at_mm == (10.0, 5.0)


def test_a_line_whose_program_is_killed_becomes_an_input(bench: InstalledPi):
    """No pulse stays high when the program dies within it, which `check` cannot see with Debian's driver."""
    # The program holds the line until it gets a signal; it runs in the background, and its process number is printed.
    holding_command = f"gpioset --mode=signal pinctrl-bcm2835 {SYNC_OUT}=1 >/dev/null & echo $!"
    number = bench.box.run(f"sudo sh -c '{holding_command}' </dev/null 2>/dev/null").strip()
    bench.box.wait(lambda: bench.box.level(SYNC_OUT) == 1, "the line is high")
    assert bench.box.function(SYNC_OUT) == OUTPUT
    bench.box.run(f"sudo kill -9 {number}")
    bench.box.wait(lambda: bench.box.function(SYNC_OUT) == INPUT, "the line is an input again")


def test_a_killed_service_comes_back_and_its_stage_rests(pi: InstalledPi, homed_host: HostSide):
    """kill -9 in the middle of a row: the stage stops without a command, and no published event is lost."""
    homed_host.must_accept(homed_host.make_begin("killed"))
    homed_host.must_accept(m.RunRow(scan_id="killed", row_index=0, take=1))
    homed_host.wait_for_event(m.RowStarted)
    in_row_mm_s = pi.rig.stage.speed_mm_s
    pi.box.wait(lambda: pi.uno.speed_mm_s == pytest.approx(in_row_mm_s, rel=0.01), "the row is under way")
    killed = service_pid(pi)
    begun = time.monotonic()
    pi.systemctl("kill --signal=KILL polysight-pi")
    last_seen_mm = pi.uno.x_mm
    pi.box.wait(lambda: not pi.uno.moving, "the stage rests")
    beyond_mm = pi.uno.x_mm - last_seen_mm
    # The stage stops when no heartbeat came for its timeout, and slows down. 0.1 s is for the steps between the kill
    # and the reading of its position.
    stopping_s = pi.rig.stage.heartbeat_ms / 1e3 + 0.1
    ramp_mm = in_row_mm_s**2 / 2 / pi.rig.stage.accel_mm_s2
    assert beyond_mm <= stopping_s * in_row_mm_s + ramp_mm
    pi.until_ready()
    print_figure(f"kill -9 in a row: the stage went on for {beyond_mm:.0f} mm (heartbeat"
         f" {pi.rig.stage.heartbeat_ms / 1e3:g} s here); the service was ready after {format_s(begun)}")  # fmt: skip
    assert service_pid(pi) != killed
    back = pi.host()
    assert back.ask(m.Hello()).state == "idle"
    assert back.replay("killed")[: len(homed_host.journalled)] == homed_host.journalled
    back.close()


def test_a_service_that_hangs_is_started_again(pi: InstalledPi):
    """The executor notifies systemd's watchdog."""
    hung = service_pid(pi)
    begun = time.monotonic()
    pi.systemctl("kill --signal=STOP polysight-pi")
    pi.box.wait(lambda: service_pid(pi) not in (hung, "0"), "another process")
    pi.until_ready()
    print_figure(f"SIGSTOP: ready again after {format_s(begun)}")
    assert "watchdog" in pi.box.run("sudo journalctl --unit polysight-pi --no-pager").lower()


def test_a_stage_whose_cable_was_pulled_is_homed_again_from_the_host(pi: InstalledPi, homed_host: HostSide):
    pi.box.unplug()
    pi.box.wait(lambda: not homed_host.ask(m.Status()).homed, "the stage is lost")
    pi.box.plug()
    pi.box.wait(lambda: pi.box.try_run("test -e /dev/polysight-stage").returncode == 0, "the port is back")
    home(homed_host)
    assert pi.uno.stands_at_mm == (0.0, 0.0)


def test_a_stage_that_is_plugged_in_after_the_service_has_started_is_found(bench: InstalledPi):
    """The kernel has no serial driver until the first cable is plugged in."""
    bench.box.unplug()
    bench.box.wait(lambda: bench.box.try_run("test -e /dev/polysight-stage").returncode != 0, "the port is gone")
    bench.box.run("sudo modprobe --remove ftdi_sio")
    bench.systemctl("start --no-block polysight-pi")
    bench.box.wait(lambda: "cannot be opened" in bench.log(), "it looks for the stage")
    bench.box.plug()
    bench.until_ready()


def test_an_update_and_a_roll_back_change_the_release_alone(pi: InstalledPi):
    """Rig file, keys and journals are kept; a running service continues with its release."""
    files = "/etc/polysight/instrument.toml /etc/polysight/keys/* /var/lib/polysight/journal/*.journal"
    checksum_command = f"sudo sh -c 'sha256sum {files}'"
    sums_before = pi.box.run(checksum_command)
    first = service_pid(pi)
    begun = time.monotonic()
    pi.install()
    print_figure(f"update: {format_s(begun)}")
    pi.until_ready()
    assert pi.release() == "releases/2"
    second = service_pid(pi)
    begun = time.monotonic()
    pi.box.run("sudo ~/.cache/polysight-install/install.sh --roll-back")
    print_figure(f"roll back: {format_s(begun)}")
    pi.until_ready()
    assert pi.release() == "releases/1"
    assert len({first, second, service_pid(pi)}) == 3
    assert "releases/1/" in pi.box.run(
        f"sudo readlink /proc/{service_pid(pi)}/exe /opt/polysight/venv; pgrep -af polysight-pi"
    )
    assert pi.box.try_run("sudo ~/.cache/polysight-install/install.sh --roll-back").returncode == 5
    sums_after = pi.box.run(checksum_command)
    assert set(sums_before.splitlines()) <= set(sums_after.splitlines())


def test_a_power_cut_in_a_row_loses_no_event_that_was_sent(pi: InstalledPi, homed_host: HostSide):
    """After a power cut the Pi starts without help, with its keys, ready to be homed."""
    homed_host.must_accept(homed_host.make_begin("cut"))
    homed_host.must_accept(m.RunRow(scan_id="cut", row_index=0, take=1))
    homed_host.wait_for_event(m.RowStarted)
    pi.box.cut_power()
    pi.until_ready()
    print_figure(f"power cut: logged in again after {pi.box.boot_s:.0f} s")
    back = pi.host()
    assert back.replay("cut")[: len(homed_host.journalled)] == homed_host.journalled
    assert back.ask(m.Hello()).state == "idle"
    back.close()
