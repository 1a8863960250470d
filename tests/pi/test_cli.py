"""The program `polysight-pi`: its start and end, its commands with and without a running service, its errors."""

import errno
import json
import os
import shlex

import pytest
from tests.support.pi.fakes import FakeLines
from tests.support.pi.program import Process
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig, set_stage_port

from polysight_pi import PROGRAM
from polysight_pi.cli import main
from polysight_pi.trigger import BurstRecord
from polysight_shared import messages as m
from polysight_shared.errors import ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.sockets import create_replier, make_server_context
from polysight_simulators.loopback import move_to_free_subnet

# Exit statuses of the program
SUCCESS = 0
CHECK_FAILED = 1
USAGE_ERROR = 2
FAILURE = 5


@pytest.fixture
def run_command(capsys):
    """Function that runs a command in this process; it returns exit status, output and error text."""

    def command(*args):
        status = main([str(a) for a in args])
        return status, *capsys.readouterr()

    return command


def test_sigterm_ends_the_row_and_the_program(instrument, start, hub, stage):
    program, host = start(instrument, "--wires", hub)
    host.must_accept(host.make_begin())
    host.home()
    assert host.run_row(0).status == "done"
    stage.stays_after = 2
    host.start_row(1)
    host.wait_for_event(m.Capture, lambda e: e.row_index == 1)
    no_output = ""
    no_errors = ""
    assert program.end() == (SUCCESS, no_output, no_errors)
    last = host.wait_for_event(m.RowFinished)
    assert (last.row_index, last.status) == (1, "aborted")
    assert not host.list_events(m.RunStopped)


def test_simulated_wires_need_neither_gpiod_nor_numpy(config, hub, stage, tmp_path):
    (tmp_path / "blocked").mkdir()
    for name in ("gpiod", "numpy"):
        (tmp_path / "blocked" / f"{name}.py").write_text("raise ImportError('blocked')")
    path = os.pathsep.join(filter(None, [str(tmp_path / "blocked"), os.environ.get("PYTHONPATH")]))
    with Process(config, "--wires", hub, "--stage-port", stage.port, PYTHONPATH=path) as program:
        assert program.ready_line[0] == "ready", program.popen.communicate()
        status, _, _ = program.end()
    assert status == SUCCESS


def test_a_misspelt_key_of_the_rig_file_is_named_with_exit_status_2(run_command, config):
    config.write_text(config.read_text().replace("heartbeat_ms = 50", "heartbeet_ms = 50"))
    status, _, err = run_command("run", "--config", config)
    assert status == USAGE_ERROR
    assert "heartbeet_ms" in err
    assert "do:" in err


def test_an_open_address_needs_keys(run_command, config, tmp_path, hub, stage):
    options = ("--wires", hub, "--stage-port", stage.port, "--command-address", "tcp://0.0.0.0:*")
    status, _, err = run_command("run", "--config", config, *options)
    assert status == USAGE_ERROR
    assert "polysight-pi keys" in err
    status, _, _ = run_command("keys", "--config", config)
    assert status == SUCCESS
    assert (tmp_path / "keys" / "pi.key_secret").stat().st_mode & 0o077 == 0
    status, _, err = run_command("keys", "--config", config)
    assert status == USAGE_ERROR
    assert "--replace" in err
    with Process(config, *options) as program:
        assert program.ready_line[1].startswith("tcp://0.0.0.0:")


def test_check_names_every_hop(run_command, config, hub, stage):
    options = ("--config", config, "--wires", hub, "--stage-port", stage.port, "--json")
    status, out, _ = run_command("check", *options)
    findings = {f["name"]: f for f in json.loads(out)}
    assert status == SUCCESS, findings
    assert {"plan", "simulated wires", "stage", "journal", "command address"} <= set(findings)
    status, out, _ = run_command("check", "--config", config, "--wires", hub)
    assert status == CHECK_FAILED
    assert "fail  stage" in out
    assert "do:" in out


def test_without_the_service_commands_use_the_stage_themselves(run_command, instrument, write_config, hub, stage):
    config = write_config(set_stage_port(move_to_free_subnet(instrument), stage.port))
    options = ("--config", config, "--wires", hub, "--count", 3, "--json")
    status, out, _ = run_command("pulse", *options)
    assert status == SUCCESS
    bursts = json.loads(out)
    assert [burst["pulses"] for burst in bursts] == [instrument.burst.pulses] * 3
    # `buzz` makes a motor sound, also before the first homing, which `jog` needs.
    for axis in "xy":
        _, out, _ = run_command("buzz", axis, "--config", config, "--json")
        assert json.loads(out) == {"x_mm": 0.0, "y_mm": 0.0}
    x_axis = 0
    y_axis = 1
    assert [c.args for c in stage.seen if c.verb == "BUZZ"] == [(x_axis,), (y_axis,)]
    status, _, _ = run_command("jog", "--config", config, "--dx", 3)
    assert status != SUCCESS
    _, out, _ = run_command("home", "--config", config)
    assert out == "stage at x 0.000 mm, y 0.000 mm\n"
    _, out, _ = run_command("jog", "--config", config, "--dx", 3, "--json")
    assert json.loads(out) == {"x_mm": 3.0, "y_mm": 0.0}
    status, _, _ = run_command("events", "--config", config, "--limit-s", 0.1)
    assert status == FAILURE


def test_while_the_service_runs_commands_ask_it_or_are_refused(run_command, instrument, write_config, start, hub):
    """Commands that need lines, stage or ports are refused because the service runs; the error has its address."""
    # The port has to be known before the service starts: the commands use it, too.
    rig = move_to_free_subnet(instrument)
    start(rig, "--wires", hub)
    config = write_config(rig)
    _, out, _ = run_command("home", "--config", config)
    assert out == "stage at x 0.000 mm, y 0.000 mm\n"
    # Of ten events one is a heartbeat; the others are statuses of the stage.
    _, out, _ = run_command("events", "--config", config, "--count", 10)
    assert "Heartbeat" in [json.loads(line)["type"] for line in out.splitlines()]
    for command in (("check", "--wires", hub), ("pulse", "--wires", hub), ("jog",)):
        status, _, err = run_command(*command, "--config", config)
        assert status == FAILURE
        assert rig.pi.command_address in err
    status, _, err = run_command("events", "--config", config, "--scan-id", "none")
    assert status == FAILURE
    assert "'none'" in err


IMPOSSIBLE_NUMBERS = [
    ("jog", "--speed", ["0", "-1", "nan", "inf", "1e9", "fast"]),
    ("jog", "--dx", ["nan", "-inf", "1e300", "far"]),
    ("events", "--limit-s", ["nan", "-1", "1e300", "long"]),
    ("events", "--from-seq", ["0", "9" * 24, "first"]),
    ("pulse", "--count", ["0", "1.5", "many"]),
]


@pytest.mark.parametrize(("command", "option", "values"), IMPOSSIBLE_NUMBERS)
def test_an_impossible_number_is_a_usage_error_that_names_it(config, capsys, command, option, values):
    for value in values:
        with pytest.raises(SystemExit) as e:
            main([command, "--config", str(config), f"{option}={value}"])
        err = capsys.readouterr().err
        assert e.value.code == USAGE_ERROR
        assert repr(value) in err
        # Names of functions of the program are not for people.
        assert "_parse" not in err


def test_events_of_a_name_that_no_scan_can_have_and_an_end_without_a_run_are_refused(
    run_command, instrument, write_config, start, hub
):
    rig = move_to_free_subnet(instrument)
    start(rig, "--wires", hub)
    config = write_config(rig)
    for name in ("../x", "", "a\nb"):
        status, _, err = run_command("events", "--config", config, "--scan-id", name)
        assert status == FAILURE
        assert "no journal of scan" in err
        # The reply is not mistaken for a message of another release.
        assert "releases" not in err
    status, _, err = run_command("take-over", "end", "--config", config)
    assert status == FAILURE
    assert "no run is active" in err


def test_take_over_reports_that_no_service_has_run(run_command, config):
    status, _, err = run_command("take-over", "abort", "--config", config)
    assert status == FAILURE
    assert "has not run" in err
    assert "systemctl" in err


def test_the_advice_for_a_file_of_another_user_is_a_complete_command(run_command, config, monkeypatch):
    """A test as root may read every file, so the refusal is simulated."""

    def refuse(*_args, **_kwargs):
        raise PermissionError(errno.EACCES, "Permission denied", "take-over-key")

    monkeypatch.setattr("pathlib.Path.read_text", refuse)
    monkeypatch.setattr("polysight_shared.config.load_instrument", lambda _: load_published_rig())
    status, _, err = run_command("take-over", "abort", "--config", config)
    assert status == FAILURE
    assert f"sudo -u polysight {PROGRAM} take-over abort --config {config}`" in err


def test_for_a_missing_rig_file_the_installed_one_is_advised(run_command, tmp_path, monkeypatch):
    installed = tmp_path / "installed.toml"
    installed.touch()
    monkeypatch.setattr("polysight_pi.cli.RIG_FILE", str(installed))
    status, _, err = run_command("check", "--config", tmp_path / "none.toml")
    assert status == USAGE_ERROR
    assert f"--config {installed}`" in err


def test_the_advised_commands_for_keys_work(run_command, tmp_path):
    """Each is run as printed: make keys before the first client, replace damaged ones, remove a damaged list."""
    folder = tmp_path / "the keys"

    def read_advice(err):
        """Return the words of the command in the line `do:`."""
        (line,) = [line for line in err.splitlines() if line.strip().startswith("do:")]
        return shlex.split(line.split("`")[1])

    status, _, err = run_command("keys", "--dir", folder, "--client", "laptop")
    assert status == USAGE_ERROR
    assert not folder.exists()
    _, *advised_words = read_advice(err)
    status, _, _ = run_command(*advised_words)
    assert status == SUCCESS
    status, _, _ = run_command("keys", "--dir", folder, "--client", "laptop")
    assert status == SUCCESS

    (folder / "allowed_clients").write_bytes(b"\xff\xfe\x00")
    for option in (["--list"], ["--client", "b"], ["--revoke", "laptop"]):
        status, _, err = run_command("keys", "--dir", folder, *option)
        assert status == USAGE_ERROR
        assert "allowed_clients" in err
    assert read_advice(err) == ["rm", str(folder / "allowed_clients")]

    (folder / "allowed_clients").write_text("")
    _, out, _ = run_command("keys", "--dir", folder, "--list")
    assert out == "no client is allowed\n"

    (folder / "pi.key_secret").write_text("public-key = 'short'\nsecret-key = 'short'\n")
    with make_server_context() as context, expect_refusal(ErrorCode.FILE_MISSING, "CURVE") as error:
        create_replier(context, "tcp://0.0.0.0:*", folder).close()
    _, advised_command, _ = error.value.remedy.split("`", 2)
    _, *advised_words = shlex.split(advised_command)
    status, _, _ = run_command(*advised_words)
    assert status == SUCCESS


def test_a_full_disk_is_the_reported_cause_when_keys_cannot_be_made(run_command, tmp_path, monkeypatch):
    def fill(*_args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("polysight_pi.keys.create_certificates", fill)
    status, _, err = run_command("keys", "--dir", tmp_path / "keys")
    assert status == FAILURE
    assert "the disk is full" in err
    assert str(tmp_path) in err
    # More rights would not help.
    assert "sudo" not in err


def test_pulse_reports_the_bursts_with_a_fault(run_command, config, monkeypatch):
    late = BurstRecord(
        pulses=2, first_ns=0, last_ns=1, end_ns=2, width_max_ns=1000, jitter_ns=900, fault=PiFault.PERIOD_TOO_SHORT
    )
    records = iter([late, late._replace(fault=0), late])
    monkeypatch.setattr("polysight_pi.lines.open_lines", lambda *_: FakeLines())
    monkeypatch.setattr("polysight_pi.trigger.send_burst", lambda *_: next(records))
    monkeypatch.setattr("polysight_pi.system.prepare_process", list)
    monkeypatch.setattr("polysight_pi.system.prepare_thread", list)
    status, _, err = run_command("pulse", "--config", config, "--count", 3)
    assert status == CHECK_FAILED
    assert f"fault {int(PiFault.PERIOD_TOO_SHORT)} in 2 of 3 bursts" in err
    assert "do:" in err
