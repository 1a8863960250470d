"""`polysight-pi`: starting, ending, dying; commands with and without a running service; errors and exit status."""

import json
import os

import pytest
from tests.support.pi.fakes import FakeLines
from tests.support.pi.program import Process
from tests.support.rigs import at_stage_port

from polysight_pi.cli import main
from polysight_pi.trigger import BurstRecord
from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_simulators.loopback import move_to_free_subnet


@pytest.fixture
def command(capsys):
    """Runs a command in this process; gives its exit status, output and error text."""

    def command(*args):
        status = main([str(a) for a in args])
        return status, *capsys.readouterr()

    return command


def test_sigterm_ends_the_row_and_the_program(instrument, start, hub, stage):
    program, host = start(instrument, "--wires", hub)
    host.must_accept(host.begin())
    host.home()
    assert host.row(0).status == "done"
    stage.stays_after = 2
    host.start_row(1)
    host.wait(m.Capture, lambda e: e.row_index == 1)
    assert program.end() == (0, "", "")
    last = host.wait(m.RowFinished)
    assert (last.row_index, last.status) == (1, "aborted")
    assert not host.list_events(m.RunStopped)


def test_simulated_wires_need_neither_gpiod_nor_numpy(config, hub, stage, tmp_path):
    (tmp_path / "blocked").mkdir()
    for name in ("gpiod", "numpy"):
        (tmp_path / "blocked" / f"{name}.py").write_text("raise ImportError('blocked')")
    path = os.pathsep.join(filter(None, [str(tmp_path / "blocked"), os.environ.get("PYTHONPATH")]))
    with Process(config, "--wires", hub, "--stage-port", stage.port, PYTHONPATH=path) as p:
        assert p.ready[0] == "ready", p.popen.communicate()
        assert p.end()[0] == 0


def test_a_wrong_key_is_exit_2_with_its_name(command, config):
    config.write_text(config.read_text().replace("heartbeat_ms = 50", "heartbeet_ms = 50"))
    status, _, err = command("run", "--config", config)
    assert (status, "heartbeet_ms" in err, "do:" in err) == (2, True, True)


def test_an_open_address_needs_keys(command, config, tmp_path, hub, stage):
    args = ("--config", config, "--wires", hub, "--stage-port", stage.port, "--command-address", "tcp://0.0.0.0:*")
    status, _, err = command("run", *args)
    assert (status, "polysight-pi keys" in err) == (2, True)
    assert command("keys", "--config", config)[0] == 0
    assert (tmp_path / "keys" / "pi.key_secret").stat().st_mode & 0o077 == 0
    status, _, err = command("keys", "--config", config)
    assert (status, "--replace" in err) == (2, True)
    with Process(*args[1:]) as p:
        assert p.ready[1].startswith("tcp://0.0.0.0:")


def test_check_names_every_hop(command, config, hub, stage):
    options = ("--config", config, "--wires", hub, "--stage-port", stage.port, "--json")
    status, out, _ = command("check", *options)
    findings = {f["name"]: f for f in json.loads(out)}
    assert status == 0, findings
    assert {"plan", "simulated wires", "stage", "journal", "command address"} <= set(findings)
    status, out, _ = command("check", "--config", config, "--wires", hub)
    assert (status, "fail  stage" in out, "do:" in out) == (1, True, True)


def test_commands_without_the_service(command, instrument, write_config, hub, stage):
    config = write_config(at_stage_port(move_to_free_subnet(instrument), stage.port))
    options = ("--config", config, "--wires", hub, "--count", 3, "--json")
    status, out, _ = command("pulse", *options)
    assert (status, [r["pulses"] for r in json.loads(out)]) == (0, [4, 4, 4])
    # Before the first homing, which `jog` needs
    for axis in "xy":
        assert json.loads(command("buzz", axis, "--config", config, "--json")[1]) == {"x_mm": 0.0, "y_mm": 0.0}
    assert [c.args for c in stage.seen if c.verb == "BUZZ"] == [(0,), (1,)]
    assert command("jog", "--config", config, "--dx", 3)[0] != 0
    assert command("home", "--config", config)[1] == "stage at x 0.000 mm, y 0.000 mm\n"
    assert json.loads(command("jog", "--config", config, "--dx", 3, "--json")[1]) == {"x_mm": 3.0, "y_mm": 0.0}
    assert command("events", "--config", config, "--limit-s", 0.1)[0] == 5


def test_commands_while_the_service_runs(command, instrument, write_config, start, hub):
    """Commands that need lines, stage or ports are refused because the service runs; the error has its address."""
    # Ports that stay the same from one program to the next
    rig = move_to_free_subnet(instrument)
    start(rig, "--wires", hub)
    config = write_config(rig)
    assert command("home", "--config", config)[1] == "stage at x 0.000 mm, y 0.000 mm\n"
    # Statuses of the stage are among them
    _, out, _ = command("events", "--config", config, "--count", 10)
    assert "Heartbeat" in [json.loads(line)["type"] for line in out.splitlines()]
    for name in ("check", "pulse", "jog"):
        status, _, err = command(name, "--config", config, *(("--wires", hub) if name != "jog" else ()))
        assert (status, rig.pi.command_address in err) == (5, True)
    status, _, err = command("events", "--config", config, "--scan-id", "none")
    assert (status, "'none'" in err) == (5, True)


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "inf"])
def test_an_impossible_speed_is_a_usage_error(config, speed):
    with pytest.raises(SystemExit) as e:
        main(["jog", "--config", str(config), "--dx", "1", f"--speed={speed}"])
    assert e.value.code == 2


def test_pulse_reports_faults(command, config, monkeypatch):
    late = BurstRecord(
        pulses=2, first_ns=0, last_ns=1, end_ns=2, width_max_ns=1000, jitter_ns=900, fault=PiFault.PERIOD_TOO_SHORT
    )
    records = iter([late, late._replace(fault=0), late])
    monkeypatch.setattr("polysight_pi.lines.open_lines", lambda *_: FakeLines())
    monkeypatch.setattr("polysight_pi.trigger.send_burst", lambda *_: next(records))
    monkeypatch.setattr("polysight_pi.system.prepare_process", list)
    monkeypatch.setattr("polysight_pi.system.prepare_thread", list)
    status, _, err = command("pulse", "--config", config, "--count", 3)
    assert (status, "fault 106 in 2 of 3 bursts" in err, "do:" in err) == (1, True, True)
