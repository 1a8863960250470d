"""For wrong input the exit status is not 0, and one message says what is wrong, why, and what to do.

Most commands of the host run in the process of the test (`run_here`), which is faster. A wrong rig file and an
interrupt are also given to real programs.
"""

import os
import pty
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import tomli_w
from tests.support.paths import RIG_FILE
from tests.support.processes import HANG_S
from tests.support.scenes import write_small_scene

from polysight_shared.errors import ConfigError, DataError, DeviceError
from polysight_shared.tables import to_builtins

SCENE = write_small_scene(12, 4, pixels=30, pixel_mm=5.0, metal=False, seed=1)


def check_refusal(ended, *words: str, status: int | None = None) -> None:
    """Check that the exit status is `status`, or not 0, and that the message has its three parts and these words."""
    assert ended.status > 0, ended
    if status is not None:
        assert ended.status == status, ended
    message = ended.message
    assert "\n  why: " in message, message
    assert "\n  do: " in message, message
    for word in words:
        assert word in message, message


# --- files the user wrote ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("program", ["polysight", "polysight-pi"])
def test_a_rig_file_with_an_unknown_key_is_refused_with_that_key(bench, program):
    """Other wrong contents are in tests/shared."""
    path = bench.folder / "wrong.toml"
    path.write_text(RIG_FILE.read_text().replace("baud = 115200", "baud = 115200\nbaude = 9600"))
    command = ["scan", "--out", "s"] if program == "polysight" else ["run"]
    ended = bench.run(program, *command, "--config", path)
    check_refusal(ended, path.name, "stage", "baude", status=ConfigError.exit_status)
    assert not (bench.folder / "s").exists()


def test_files_that_are_missing_or_of_another_kind_are_named(bench):
    missing_rig_file = "no.toml: no such file"
    ended = bench.run_here("scan", "--out", "s")
    check_refusal(ended, "instrument.toml: no such file", status=ConfigError.exit_status)
    ended = bench.run("polysight-pi", "run", "--config", "no.toml")
    check_refusal(ended, missing_rig_file, status=ConfigError.exit_status)
    ended = bench.run_polysight("simulate", "no.toml", "--config", RIG_FILE, "--out", "d")
    check_refusal(ended, "no.toml: no such file", status=ConfigError.exit_status)
    ended = bench.run_here("reproduce", "--config", "no.toml", "--out", "r", "table1")
    check_refusal(ended, missing_rig_file, status=ConfigError.exit_status)
    ended = bench.run_here("preview", RIG_FILE, "--port", "0")
    check_refusal(ended, "instrument.toml is a file", status=ConfigError.exit_status)
    check_refusal(bench.run_here("inspect", "no.bin"), "no.bin", status=DataError.exit_status)
    check_refusal(bench.run_here("inspect", "no.pcap"), "no.pcap", status=DataError.exit_status)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[grid]", "colour = 3\n[grid]", ("scene.toml", "colour")),
        ("pulses = 2", "pulses = 2000", ("burst of 2000 pulses", "passes a point every")),
        ("", "", ("scene.toml: no such file",)),
    ],
)
def test_a_wrong_scene_file_is_refused_before_anything_is_changed(bench, old, new, words):
    """The folder of an earlier demo is kept, and no rig is started. Without `old` there is no scene file."""
    scenes = bench.folder / "scenes"
    scenes.mkdir()
    (scenes / "a.toml").write_text(SCENE)
    if old:
        (scenes / "scene.toml").write_text(SCENE.replace(old, new, 1))
    earlier_demo = bench.folder / "d"
    earlier_demo.mkdir()
    # This file marks the folder of a demo, which another demo may overwrite.
    (earlier_demo / ".polysight-demo").touch()
    (earlier_demo / "report.html").touch()
    rig = ("--config", RIG_FILE)
    ended = bench.run_here("demo", "--scene", "scenes/scene.toml", *rig, "--out", "d")
    check_refusal(ended, *words, status=ConfigError.exit_status)
    assert (earlier_demo / "report.html").exists()
    ended = bench.run_polysight("simulate", "scenes/scene.toml", *rig, "--out", "s")
    check_refusal(ended, *words, status=ConfigError.exit_status)
    if old:
        ended = bench.run_here("train", "--simulate", "scenes", *rig, "--out", "l.npz")
        check_refusal(ended, *words, status=ConfigError.exit_status)
    folders = {path.name for path in bench.folder.iterdir() if path.is_dir()}
    assert folders == {"scenes", "d"}


def test_a_training_without_its_rig_file_or_output_folder_is_refused(bench):
    (bench.folder / "scenes").mkdir()
    (bench.folder / "scenes" / "a.toml").write_text(SCENE)
    train = ("train", "--simulate", "scenes")
    ended = bench.run_here(*train, "--config", "no.toml", "--out", "l.npz")
    check_refusal(ended, "no.toml: no such file", status=ConfigError.exit_status)
    ended = bench.run_here(*train, "--config", RIG_FILE, "--out", "no/l.npz")
    check_refusal(ended, "no such folder no", status=ConfigError.exit_status)


# --- recorded data ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded_scan(tmp_path_factory):
    """A simulated scan of an empty scene: no metal, no plates."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "scene.toml").write_text(SCENE)
    command = [sys.executable, "-m", "polysight_simulators", "simulate", folder / "scene.toml", "--config", RIG_FILE]
    subprocess.run([*command, "--out", folder / "scan"], check=True, capture_output=True)
    return folder / "scan"


@pytest.fixture
def scan(recorded_scan, bench):
    """A copy of the recorded scan, which the test may damage."""
    return Path(shutil.copytree(recorded_scan, bench.folder / "scan"))


@pytest.mark.parametrize("command", ["process", "validate", "resume"])
def test_a_folder_that_is_not_a_scan_is_refused(bench, command):
    out = ["--out", "out"] if command == "process" else []
    (bench.folder / "empty").mkdir()
    (bench.folder / "other").mkdir()
    (bench.folder / "other" / "notes.txt").write_text("not a scan")
    if command == "validate":
        names = ("missing", "empty", "other", "other/notes.txt")
    else:
        names = ("missing", "other")
    for name in names:
        check_refusal(bench.run_here(command, name, *out), name, status=DataError.exit_status)
    assert not (bench.folder / "out").exists()


def test_a_scan_without_a_row_is_not_processed_but_can_be_resumed(bench, scan):
    path = scan / "manifest.jsonl"
    first_line, *_ = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(first_line)
    ended = bench.run_here("process", scan, "--out", "out")
    check_refusal(ended, f"polysight resume {scan}", status=DataError.exit_status)


def test_a_library_that_cannot_be_read_is_refused_before_processing(bench, scan):
    process = ("process", scan, "--out", "out", "--library")
    (bench.folder / "junk.npz").write_text("no library")
    for name in ("no.npz", "junk.npz", "scan"):
        check_refusal(bench.run_here(*process, name), name, "polysight train", status=DataError.exit_status)
    assert not (bench.folder / "out").exists(), "something was processed"
    check_refusal(bench.run_here("train", "--config", RIG_FILE, "--out", "l.npz"), "--simulate")


def test_an_output_folder_with_other_files_is_refused_and_kept(bench, scan):
    own_folder = bench.folder / "mine"
    own_folder.mkdir()
    (own_folder / "thesis.tex").write_text("precious")
    for command in (["image", scan], ["demo", "--config", RIG_FILE], ["scan", "--config", RIG_FILE]):
        ended = bench.run_here(*command, "--out", own_folder)
        check_refusal(ended, str(own_folder), "--out", status=ConfigError.exit_status)
    for command in (["image", scan], ["demo", "--config", RIG_FILE]):
        ended = bench.run_here(*command, "--out", own_folder / "thesis.tex")
        check_refusal(ended, "thesis.tex", "--out", status=ConfigError.exit_status)
    ended = bench.run_here("scan", "--config", RIG_FILE, "--out", scan)
    check_refusal(ended, f"polysight resume {scan}", status=ConfigError.exit_status)
    assert (own_folder / "thesis.tex").read_text() == "precious"
    assert list(own_folder.iterdir()) == [own_folder / "thesis.tex"]
    assert bench.run_here("image", scan, "--out", "out").status == 0
    assert bench.run_here("image", scan, "--out", "out").status == 0, "earlier products may be replaced"


# --- the program of the Pi --------------------------------------------------------------------------------------------


@pytest.fixture
def file_of_lonely_rig(bench, lonely_instrument):
    """A rig file to whose addresses no device answers."""
    path = bench.folder / "rig.toml"
    path.write_text(tomli_w.dumps(to_builtins(lonely_instrument)))
    return path


@pytest.fixture
def wires(bench):
    """Socket of a program that simulates the wires between Pi, stage and radars."""
    path = bench.folder / "wires.sock"
    bench.start("python", "-m", "polysight_simulators.wires", "--socket", path).wait_ready()
    return path


def listen_on(address: str) -> socket.socket:
    """A socket that accepts connections at a `tcp://` address."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    return socket.create_server((host, int(port)))


def test_a_stage_that_does_not_answer_is_named(bench, file_of_lonely_rig, lonely_instrument, wires, silent_pty):
    run = ("polysight-pi", "run", "--config", file_of_lonely_rig, "--wires", wires)
    ended = bench.run(*run)
    check_refusal(ended, lonely_instrument.stage.port, "No such file", "stage.port", status=DeviceError.exit_status)
    ended = bench.run(*run, "--stage-port", silent_pty)
    check_refusal(ended, silent_pty, "does not answer", "make flash", status=DeviceError.exit_status)
    (bench.folder / "file").touch()
    ended = bench.run(*run, "--stage-port", bench.folder / "file")
    check_refusal(ended, "file", status=DeviceError.exit_status)


def test_a_missing_socket_of_the_wires_is_named(bench, file_of_lonely_rig):
    ended = bench.run("polysight-pi", "run", "--config", file_of_lonely_rig, "--wires", "no.sock")
    check_refusal(ended, "no.sock", status=DeviceError.exit_status)


@pytest.fixture
def silent_pty():
    """A serial port without a device."""
    master, slave = pty.openpty()
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


# --- a Pi that does not answer ----------------------------------------------------------------------------------------


def test_ctrl_c_ends_a_scan_that_waits_for_the_pi(bench, file_of_lonely_rig, lonely_instrument):
    """The address of the Pi accepts the connection and never answers."""
    table = to_builtins(lonely_instrument)
    table["limits"]["command_timeout_s"] = HANG_S
    file_of_lonely_rig.write_text(tomli_w.dumps(table))
    with listen_on(lonely_instrument.pi.command_address):
        scan = bench.start("polysight", "scan", "--config", file_of_lonely_rig, "--out", "s")
        bench.wait_for(lambda: "connect" in scan.err, "the scan says that it connects")
        scan.interrupt()
        # The limit counts seconds in which the machine is idle. Without the interrupt the scan would wait longer.
        ended = scan.wait(limit_s=10)
    assert ended.status == 128 + signal.SIGINT
    assert ended.message == "polysight scan: stopped"
    assert not (bench.folder / "s").exists()
