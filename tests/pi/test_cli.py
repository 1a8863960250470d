"""`polysight-pi` as a process: starting, ending, dying, and every way not to start."""

import json
import os
import signal
import socket

import pytest

from polysight.pi_controller.bursts import BurstRecord
from polysight.pi_controller.cli import main
from polysight.shared import messages as m
from polysight.shared.faults import PiFault
from polysight.simulators.loopback import on_free_subnet
from tests.support.pi.fake_lines import FakeLines
from tests.support.pi.host_side import HostSide
from tests.support.pi.program import Process, run


def test_ready_row_and_a_clean_end_on_sigterm(config, hub, stage, instrument):
    with Process(config, "--wires", hub, "--stage-port", stage.port) as p:
        assert p.ready[0] == "ready"
        host = HostSide(p.ready[1], p.events[1], instrument)
        host.accepted(host.begin())
        host.home()
        assert host.row(0).status == "done"
        stage.pace_s = 0.05
        host.accepted(m.RunRow(scan_id="scan", row_index=1, take=1))
        host.wait(m.Capture, lambda e: e.row_index == 1)
        status, out, err = p.end()
        assert (status, out, err) == (0, "", "")
        last = host.wait(m.RowFinished)
        assert (last.row_index, last.status) == (1, "aborted")
        assert not any(isinstance(e, m.RunStopped) for e in host.events)
        host.close()


def test_kill_9_and_the_journal_goes_on(config, hub, stage, instrument):
    args = ("--wires", hub, "--stage-port", stage.port)
    with Process(config, *args) as p:
        host = HostSide(p.ready[1], p.events[1], instrument)
        host.accepted(host.begin())
        host.home()
        host.row(0)
        stage.pace_s = 0.05
        host.accepted(m.RunRow(scan_id="scan", row_index=1, take=1))
        host.wait(m.Capture, lambda e: e.row_index == 1)
        p.end(signal.SIGKILL)
        seen = host.journalled
        host.close()
    stage.pace_s = 0.0
    with Process(config, *args) as p:
        host = HostSide(p.ready[1], p.events[1], instrument)
        kept = host.replay()
        assert kept[: len(seen)] == seen, "what was published is in the journal"
        host.accepted(host.begin())
        host.home()
        assert host.row(1, take=2).status == "done"
        after = host.journalled
        assert isinstance(after[0], m.RunStarted)
        assert after[0].resumed
        assert [e.seq for e in after] == list(range(len(kept) + 1, len(kept) + 1 + len(after)))
        assert host.replay() == kept + after
        host.close()


@pytest.mark.parametrize("missing", ["gpiod", "numpy"])
def test_runs_on_wires_without(config, hub, stage, tmp_path, missing):
    (tmp_path / "blocked").mkdir()
    (tmp_path / "blocked" / f"{missing}.py").write_text("raise ImportError('blocked')")
    path = os.pathsep.join(filter(None, [str(tmp_path / "blocked"), os.environ.get("PYTHONPATH")]))
    with Process(config, "--wires", hub, "--stage-port", stage.port, PYTHONPATH=path) as p:
        assert p.ready[0] == "ready", p.popen.communicate()
        assert p.end()[0] == 0


def test_a_wrong_key_is_exit_2_with_its_name(config):
    config.write_text(config.read_text().replace("heartbeat_ms = 50", "heartbeet_ms = 50"))
    done = run("run", "--config", config)
    assert done.returncode == 2
    assert "heartbeet_ms" in done.stderr
    assert "do:" in done.stderr


def test_no_stage_no_wires_no_gpio(config, hub, tmp_path):
    done = run("run", "--config", config, "--wires", hub)
    assert done.returncode == 5
    assert "no-stage" in done.stderr
    assert "stage.port" in done.stderr
    (tmp_path / "blocked").mkdir()
    (tmp_path / "blocked" / "gpiod.py").write_text("raise ImportError('blocked')")
    done = run("run", "--config", config, PYTHONPATH=str(tmp_path / "blocked"))
    assert done.returncode == 2
    assert "--wires" in done.stderr


def test_a_stage_that_does_not_answer(config, hub, stage):
    stage.deaf = True
    done = run("run", "--config", config, "--wires", hub, "--stage-port", stage.port)
    assert done.returncode == 5
    assert "does not answer HELLO" in done.stderr


def test_a_port_in_use(config, hub, stage):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        done = run("run", "--config", config, "--wires", hub, "--stage-port", stage.port, "--command-address", address)
    assert done.returncode == 5
    assert address in done.stderr


def test_an_open_address_needs_keys(config, tmp_path, hub, stage):
    args = ("--config", config, "--wires", hub, "--stage-port", stage.port, "--command-address", "tcp://0.0.0.0:*")
    done = run("run", *args)
    assert done.returncode == 2
    assert "polysight-pi keys" in done.stderr
    assert run("keys", "--config", config).returncode == 0
    secret = tmp_path / "keys" / "pi.key_secret"
    assert secret.stat().st_mode & 0o077 == 0
    again = run("keys", "--config", config)
    assert again.returncode == 2
    assert "--replace" in again.stderr
    with Process(args[1], *args[2:]) as p:
        assert p.ready[1].startswith("tcp://0.0.0.0:")
        assert p.end()[0] == 0


def test_check_names_every_hop(config, hub, stage):
    done = run("check", "--config", config, "--wires", hub, "--stage-port", stage.port, "--json")
    findings = {f["name"]: f for f in json.loads(done.stdout)}
    assert done.returncode == 0, findings
    assert {"plan", "simulated wires", "stage", "journal", "command address"} <= set(findings)
    done = run("check", "--config", config, "--wires", hub)
    assert done.returncode == 1
    assert "fail  stage" in done.stdout
    assert "do:" in done.stdout


def test_pulse_jog_home_events(instrument, write_config, hub, stage):
    config = write_config(on_free_subnet(instrument))  # ports that stay the same from one program to the next
    done = run("pulse", "--config", config, "--wires", hub, "--count", 3, "--json")
    assert done.returncode == 0
    assert [r["pulses"] for r in json.loads(done.stdout)] == [4, 4, 4]
    port = ("--config", config, "--stage-port", stage.port)
    assert run("home", *port).stdout == "stage at x 0.000 mm, y 0.000 mm\n"
    done = run("jog", *port, "--dx", 3, "--json")
    assert json.loads(done.stdout) == {"x_mm": 3.0, "y_mm": 0.0}
    done = run("events", "--config", config, "--limit-s", 0.1)
    assert done.returncode == 5
    assert "nobody answers" in done.stderr
    with Process(config, "--wires", hub, "--stage-port", stage.port):
        assert run("home", "--config", config).stdout == "stage at x 0.000 mm, y 0.000 mm\n"
        done = run("events", "--config", config, "--count", 2)
        assert [json.loads(line)["type"] for line in done.stdout.splitlines()] == ["Heartbeat", "Heartbeat"]
        for command in ("check", "pulse", "jog"):
            done = run(command, "--config", config, *(("--wires", hub) if command != "jog" else ()))
            assert done.returncode == 5
            assert "polysight-pi run serves at" in done.stderr, "and not that a line or a port is in use"
        done = run("events", "--config", config, "--scan-id", "none")
        assert done.returncode == 5
        assert "none" in done.stderr


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "inf"])
def test_no_speed_is_not_taken_for_another_one(config, speed, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["jog", "--config", str(config), "--dx", "1", f"--speed={speed}"])
    assert "--speed: must be above 0" in capsys.readouterr().err


def test_pulse_says_why_it_did_not_work(config, monkeypatch, capsys):
    late = BurstRecord(2, 0, 1, 2, 1000, 900, PiFault.PERIOD_TOO_SHORT)
    monkeypatch.setattr("polysight.pi_controller.lines.open_lines", lambda *_: FakeLines())
    monkeypatch.setattr("polysight.pi_controller.bursts.send_bursts", lambda *_: [late, late._replace(fault=0), late])
    monkeypatch.setattr("polysight.pi_controller.system.prepare_process", list)
    monkeypatch.setattr("polysight.pi_controller.system.prepare_thread", list)
    assert main(["pulse", "--config", str(config)]) == 1
    said = capsys.readouterr().err
    assert "fault 106 in 2 of 3 bursts" in said
    assert "do:" in said


def test_what_the_system_refuses_is_a_message(config, monkeypatch, capsys):
    def refuse(_):
        raise PermissionError(13, "Permission denied", "/dev/gpiochip0")

    monkeypatch.setattr("polysight.pi_controller.client.refuse_beside_service", refuse)
    assert main(["jog", "--config", str(config)]) == 5
    said = capsys.readouterr().err
    assert "/dev/gpiochip0: Permission denied" in said
    assert "do: as the service's user" in said


@pytest.mark.parametrize("command", ["run", "check", "pulse", "jog", "home", "events", "keys"])
def test_every_help_has_an_example(command):
    done = run(command, "--help")
    assert done.returncode == 0
    assert f"example:  polysight-pi {command}" in done.stdout
