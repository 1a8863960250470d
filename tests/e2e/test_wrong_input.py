"""For any wrong input the exit status is not 0, and one message says what, why and what to do.

Commands of the host run in this process. The tests that show that a program's exit status and stderr are those of its
`main` are `test_rig_file`, which starts both programs, and those of interrupted commands.
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

from polysight_shared.tables import to_builtins

SCENE = write_small_scene(12, 4, pixels=30, pixel_mm=5.0, metal=False, seed=1)


def check_refusal(ended, *words: str, status: int | None = None) -> None:
    """Exit status not 0; one message with what, why and what to do, in which the words occur."""
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
def test_rig_file(bench, program):
    """Which contents are refused, and in which words, is shown in tests/shared."""
    path = bench.folder / "wrong.toml"
    path.write_text(RIG_FILE.read_text().replace("baud = 115200", "baud = 115200\nbaude = 9600"))
    command = ["scan", "--out", "s"] if program == "polysight" else ["run"]
    check_refusal(bench.run(program, *command, "--config", path), path.name, "stage", "baude", status=2)
    assert not (bench.folder / "s").exists()


def test_files_that_are_not_there(bench):
    check_refusal(bench.run_here("scan", "--out", "s"), "instrument.toml: no such file", status=2)
    check_refusal(bench.run("polysight-pi", "run", "--config", "no.toml"), "no.toml: no such file", status=2)
    check_refusal(
        bench.run_polysight("simulate", "no.toml", "--config", RIG_FILE, "--out", "d"),
        "no.toml: no such file",
        status=2,
    )
    reproduce = ("reproduce", "--config", "no.toml", "--out", "r", "table1")
    check_refusal(bench.run_here(*reproduce), "no.toml: no such file", status=2)
    check_refusal(bench.run_here("preview", RIG_FILE, "--port", "0"), "instrument.toml is a file", status=2)
    check_refusal(bench.run_here("inspect", "no.bin"), "no.bin", status=3)
    check_refusal(bench.run_here("inspect", "no.pcap"), "no.pcap", status=3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[grid]", "colour = 3\n[grid]", ("scene.toml", "colour")),
        ("pulses = 2", "pulses = 2000", ("burst of 2000 pulses", "passes a point every")),
        ("", "", ("scene.toml: no such file",)),
    ],
)
def test_scene_file(bench, old, new, words):
    """The error comes before anything else: an existing demo folder is kept, and no rig was started."""
    scenes = bench.folder / "scenes"
    scenes.mkdir()
    (scenes / "a.toml").write_text(SCENE)
    if old:
        (scenes / "scene.toml").write_text(SCENE.replace(old, new, 1))
    last = bench.folder / "d"
    last.mkdir()
    (last / ".polysight-demo").touch()
    (last / "report.html").touch()
    rig = ("--config", RIG_FILE)
    check_refusal(bench.run_here("demo", "--scene", "scenes/scene.toml", *rig, "--out", "d"), *words, status=2)
    assert (last / "report.html").exists()
    check_refusal(bench.run_polysight("simulate", "scenes/scene.toml", *rig, "--out", "s"), *words, status=2)
    if old:
        check_refusal(bench.run_here("train", "--simulate", "scenes", *rig, "--out", "l.npz"), *words, status=2)
    assert {p.name for p in bench.folder.iterdir() if p.is_dir()} == {"scenes", "d"}


def test_rig_file_of_a_training(bench):
    (bench.folder / "scenes").mkdir()
    (bench.folder / "scenes" / "a.toml").write_text(SCENE)
    train = ("train", "--simulate", "scenes")
    check_refusal(bench.run_here(*train, "--config", "no.toml", "--out", "l.npz"), "no.toml: no such file", status=2)
    check_refusal(bench.run_here(*train, "--config", RIG_FILE, "--out", "no/l.npz"), "no such folder no", status=2)


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
    """A copy of it, to be damaged."""
    return Path(shutil.copytree(recorded_scan, bench.folder / "scan"))


@pytest.mark.parametrize("command", ["process", "validate", "resume"])
def test_a_folder_that_is_not_a_scan_is_refused(bench, command):
    out = ["--out", "out"] if command == "process" else []
    (bench.folder / "empty").mkdir()
    (bench.folder / "other").mkdir()
    (bench.folder / "other" / "notes.txt").write_text("not a scan")
    folders = ("missing", "empty", "other", "other/notes.txt")
    for name in folders if command == "validate" else ("missing", "other"):
        check_refusal(bench.run_here(command, name, *out), name, status=3)
    assert not (bench.folder / "out").exists()


def test_scan_without_a_row(bench, scan):
    path = scan / "manifest.jsonl"
    path.write_bytes(path.read_bytes().splitlines(keepends=True)[0])
    check_refusal(bench.run_here("process", scan, "--out", "out"), f"polysight resume {scan}", status=3)


def test_library(bench, scan):
    process = ("process", scan, "--out", "out", "--library")
    (bench.folder / "junk.npz").write_text("no library")
    for name in ("no.npz", "junk.npz", "scan"):
        check_refusal(bench.run_here(*process, name), name, "polysight train", status=3)
    assert not (bench.folder / "out").exists(), "found out before anything is processed"
    check_refusal(bench.run_here("train", "--config", RIG_FILE, "--out", "l.npz"), "--simulate")


def test_out_is_taken(bench, scan):
    own_folder = bench.folder / "mine"
    own_folder.mkdir()
    (own_folder / "thesis.tex").write_text("precious")
    for command in (["image", scan], ["demo", "--config", RIG_FILE], ["scan", "--config", RIG_FILE]):
        check_refusal(bench.run_here(*command, "--out", own_folder), str(own_folder), "--out", status=2)
    for command in (["image", scan], ["demo", "--config", RIG_FILE]):
        check_refusal(bench.run_here(*command, "--out", own_folder / "thesis.tex"), "thesis.tex", "--out", status=2)
    check_refusal(bench.run_here("scan", "--config", RIG_FILE, "--out", scan), f"polysight resume {scan}", status=2)
    assert (own_folder / "thesis.tex").read_text() == "precious"
    assert list(own_folder.iterdir()) == [own_folder / "thesis.tex"]
    assert bench.run_here("image", scan, "--out", "out").status == 0
    assert bench.run_here("image", scan, "--out", "out").status == 0, "earlier products may be replaced"


# --- the Pi's side ----------------------------------------------------------------------------------------------------


@pytest.fixture
def lonely(bench, lonely_instrument):
    """A rig file without devices."""
    path = bench.folder / "rig.toml"
    path.write_text(tomli_w.dumps(to_builtins(lonely_instrument)))
    return path


@pytest.fixture
def wires(bench):
    """Simulated wires."""
    path = bench.folder / "wires.sock"
    bench.start("python", "-m", "polysight_simulators.wires", "--socket", path).wait_ready()
    return path


def listen_on(address: str) -> socket.socket:
    """A socket that holds a `tcp://` address."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    server = socket.create_server((host, int(port)))
    return server


def test_no_stage(bench, lonely, lonely_instrument, wires, silent_pty):
    run = ("polysight-pi", "run", "--config", lonely, "--wires", wires)
    check_refusal(bench.run(*run), lonely_instrument.stage.port, "No such file", "stage.port", status=5)
    check_refusal(bench.run(*run, "--stage-port", silent_pty), silent_pty, "does not answer", "make flash", status=5)
    (bench.folder / "file").touch()
    check_refusal(bench.run(*run, "--stage-port", bench.folder / "file"), "file", status=5)
    check_refusal(bench.run("polysight-pi", "run", "--config", lonely, "--wires", "no.sock"), "no.sock", status=5)


@pytest.fixture
def silent_pty():
    """A serial port without a device."""
    master, slave = pty.openpty()
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


# --- the host and what it talks to ------------------------------------------------------------------------------------


def test_interrupted_while_connecting(bench, lonely, lonely_instrument):
    """The Pi's port accepts the connection and never answers: Ctrl-C ends the wait."""
    table = to_builtins(lonely_instrument)
    table["limits"]["command_timeout_s"] = HANG_S
    lonely.write_text(tomli_w.dumps(table))
    with listen_on(lonely_instrument.pi.command_address):
        scan = bench.start("polysight", "scan", "--config", lonely, "--out", "s")
        bench.wait_for(lambda: "connect" in scan.err, "the scan says that it connects")
        scan.interrupt()
        ended = scan.wait(10)
    assert ended.status == 128 + signal.SIGINT
    assert ended.message == "polysight scan: stopped"
    assert not (bench.folder / "s").exists()
