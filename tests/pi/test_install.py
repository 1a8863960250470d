"""Installed files of a Pi: the installation script, the systemd unit, the udev rules."""

import configparser
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tests.support.paths import REPO, RIG_FILE
from tests.support.processes import HANG_S
from tests.support.rigs import load_published_rig

from polysight_pi.system import TRIGGER_PRIORITY

PI = REPO / "pi_controller"
# Exit statuses of install.sh
SUCCESS = 0
USAGE_ERROR = 2
FAILURE = 5
PROGRAM = "/opt/polysight/venv/bin/polysight-pi"
# Shell script in place of a command that would change this machine: it only records its arguments.
STUB = '#!/bin/sh\necho "$(basename "$0") $*" >> "$LOG"\n'
STUBS = {
    **dict.fromkeys(("groupadd", "useradd", "udevadm", "systemctl", "chown", "pip"), STUB),
    # No such group or user yet.
    "getent": STUB + "exit 2\n",
    # `python3 -m venv FOLDER`
    "python3": STUB + 'if [ "$2" = venv ]; then mkdir -p "$3/bin"; cp "$PIP" "$3/bin/python"; fi\n',
    # `python -m pip wheel --quiet --no-deps --wheel-dir FOLDER`
    "python": STUB + 'mkdir -p "$7"; touch "$7/a.whl"\n',
    # The Pi is a folder of the test.
    "ssh": STUB + '[ "$1" = -t ] && shift; shift; cd "$PI_HOME" && sh -c "$*"\n',
    "sudo": STUB + '"$@"\n',
}


@pytest.fixture
def unit():
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(PI / "polysight-pi.service")
    return parser


@pytest.fixture
def analyze(tmp_path):
    """Function that runs systemd-analyze on the unit, whose program, not installed here, is replaced by another."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze: `apt-get install systemd` runs this test too")
    text = (PI / "polysight-pi.service").read_text()
    assert PROGRAM in text
    path = tmp_path / "polysight-pi.service"
    path.write_text(text.replace(PROGRAM, "/bin/true"))
    return lambda *words: subprocess.run(
        ["systemd-analyze", *words, str(path)], capture_output=True, text=True, timeout=HANG_S, check=False
    )


def test_systemd_accepts_the_unit_without_a_warning(analyze):
    process = analyze("verify", "--man=no")
    assert "polysight-pi.service" not in process.stderr, process.stderr
    assert process.returncode == 0, process.stderr


# Program that allows itself only these address families and then binds a ZeroMQ socket. It does what systemd does for
# RestrictAddressFamilies=, with a filter of system calls (seccomp(2)): if the call's number is that of socket() and its
# first argument, the family, is not allowed, the call fails with error 97, EAFNOSUPPORT; everything else is allowed.
# prctl 38 is PR_SET_NO_NEW_PRIVS, and 22 is PR_SET_SECCOMP.
BIND = """
import ctypes, os, struct, sys
import zmq
number = {"x86_64": 41, "aarch64": 198}[os.uname().machine]
families = [getattr(__import__("socket"), name) for name in sys.argv[1:]]
code = [(0x20, 0, 0, 0), (0x15, 0, len(families) + 2, number), (0x20, 0, 0, 16)]
code += [(0x15, len(families) - n, 0, family) for n, family in enumerate(families)]
code += [(0x06, 0, 0, 0x50000 | 97), (0x06, 0, 0, 0x7FFF0000)]
filters = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *c) for c in code))
program = struct.pack("HxxxxxxP", len(code), ctypes.addressof(filters))
libc = ctypes.CDLL(None, use_errno=True)
assert libc.prctl(38, 1, 0, 0, 0) == 0 and libc.prctl(22, 2, program, 0, 0) == 0, os.strerror(ctypes.get_errno())
context = zmq.Context()
context.socket(zmq.ROUTER).bind("tcp://127.0.0.1:*")
context.destroy(linger=0)
print("bound")
"""


def test_the_unit_leaves_the_address_families_that_zeromq_needs(unit):
    if os.uname().machine not in ("x86_64", "aarch64"):
        pytest.skip("the numbers of system calls are known for x86-64 and arm64 alone: run this test on one of these")
    families = unit["Service"]["RestrictAddressFamilies"].split()
    process = subprocess.run([sys.executable, "-c", BIND, *families], capture_output=True, text=True, check=False)
    assert (process.returncode, process.stdout) == (0, "bound\n"), process.stderr


def test_the_unit_gives_what_the_program_asks_for(unit):
    service = unit["Service"]
    assert int(service["LimitRTPRIO"]) >= TRIGGER_PRIORITY
    assert service["LimitMEMLOCK"] == "infinity"
    assert {"gpio", "spi", "dialout"} <= set(service["SupplementaryGroups"].split())
    rig = load_published_rig()
    assert Path(rig.pi.journal_dir).is_relative_to(service["ReadWritePaths"])
    assert Path(rig.pi.journal_dir).is_relative_to(Path("/var/lib") / service["StateDirectory"])
    assert (service["Type"], service["Restart"]) == ("notify", "on-failure")
    # The executor notifies the watchdog, and a lost stage blocks it for 25 s. A program that hangs is ended within a
    # minute.
    assert 25 < int(service["WatchdogSec"]) <= 60


# Of systemd's scale from 0 to 10
LARGEST_EXPOSURE = 3.0


def test_the_unit_exposes_little(analyze):
    """systemd's exposure level is 0 for a program without any rights and 10 for one without any limit."""
    process = analyze("security", "--offline=yes", "--no-pager")
    exposure = re.search(r"Overall exposure level for \S+: ([0-9.]+)", process.stdout)
    if exposure is None:
        pytest.skip(f"this systemd-analyze measures no file: {process.stderr.strip()}")
    assert float(exposure[1]) <= LARGEST_EXPOSURE, process.stdout


def test_pinned_versions_are_what_the_wheels_ask_for():
    words = (PI / "requirements.txt").read_text().split()
    pins = dict(word.split("==") for word in words if "==" in word)
    projects = [(REPO / name / "pyproject.toml").read_text() for name in ("shared", "pi_controller")]
    required_pins = [
        pin for text in projects for pin in re.findall(r'"(\w+)>=([\d.]+)', text.partition("dependencies = [")[2])
    ]
    assert set(pins) == {name for name, _ in required_pins}

    def split_version(version):
        return [int(part) for part in version.split(".")]

    for name, least_version in required_pins:
        assert split_version(pins[name]) >= split_version(least_version), name


def test_udev_rules_are_well_formed():
    all_lines = (PI / "60-polysight.rules").read_text().splitlines()
    lines = [line for line in all_lines if line and not line.startswith("#")]
    # The rules were found.
    assert len(lines) >= 4
    # KEY=="value", KEY{attribute}=="value", or an assignment with = or +=.
    pair = r'[A-Z]+(\{[A-Za-z_]+\})?(==|=|\+=)"[^"]*"'
    for line in lines:
        assert re.fullmatch(rf"{pair}(, {pair})*", line), line


@pytest.fixture
def install(bench, tmp_path):
    """Function that runs install.sh as copied to the Pi; it returns the ended process."""
    copied = tmp_path / "copied"
    shutil.copytree(PI, copied)
    (copied / "a.whl").touch()
    shutil.copy(RIG_FILE, copied)
    options = {"env": bench, "capture_output": True, "text": True, "check": False}
    return lambda *words: subprocess.run([copied / "install.sh", *words], **options)


@pytest.fixture
def bench(tmp_path):
    """Commands that change nothing outside the test's folder, and the environment in which they are found."""
    # With another name of this variable the script would change the machine that runs the tests.
    assert "root=${ROOT:-}" in (PI / "install.sh").read_text()
    for name in ("bin", "home/polysight", "root"):
        (tmp_path / name).mkdir(parents=True)
    for name, text in STUBS.items():
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    (tmp_path / "installed").touch()
    return {
        **os.environ, "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "LOG": str(tmp_path / "log"),
        "PIP": str(tmp_path / "bin/pip"), "ROOT": str(tmp_path / "root"), "PI_HOME": str(tmp_path / "home"),
    }  # fmt: skip


def test_installing_twice_keeps_the_rig_file_and_other_files_in_the_users_home(bench, tmp_path):
    """`make pi-install` as a whole, with every command that changes a machine replaced."""
    root = tmp_path / "root"
    log = tmp_path / "log"
    (tmp_path / "home/polysight/notes").write_text("mine")
    make = ["make", "pi-install", "HOST=pi@here", f"VENV={tmp_path}", f"BIN={tmp_path}/bin", f"OUT={tmp_path}/out"]
    for is_first_installation in (True, False):
        if not is_first_installation:
            (root / "etc/polysight/instrument.toml").write_text("mine")
            log.unlink()
        process = subprocess.run(make, cwd=REPO, env=bench, capture_output=True, text=True, check=False)
        assert process.returncode == 0, process.stdout + process.stderr
        log_text = log.read_text()
        # The environment is made once, and kept with its libraries.
        assert log_text.count("-m venv") == (1 if is_first_installation else 0)
        steps = ("pip wheel", "pip install --quiet --retries", "--force-reinstall", "try-restart")
        order = [log_text.index(step) for step in steps]
        assert order == sorted(order)
        # The Pi needs no internet for the packages that were built on the host.
        assert "--no-index" in log_text
    assert (tmp_path / "home/polysight/notes").read_text() == "mine"
    assert (root / "etc/polysight/instrument.toml").read_text() == "mine"
    assert (root / "etc/polysight/keys").stat().st_mode & 0o777 == 0o700
    for name in ("etc/systemd/system/polysight-pi.service", "etc/udev/rules.d/60-polysight.rules"):
        assert (root / name).read_text() == (PI / Path(name).name).read_text()
    # The unit gives the service these groups; `polysight-pi check`, run by hand as this user, needs them too.
    assert "--groups gpio,spi,dialout" in log_text
    for words in ("useradd --system", "systemctl enable"):
        assert words in log_text
    assert PROGRAM in process.stdout
    opt = root / "opt/polysight"
    assert (opt / "venv").readlink() == Path("releases/2")
    roll_back = [PI / "install.sh", "--roll-back"]
    statuses = [subprocess.run(roll_back, env=bench, check=False).returncode for _ in range(2)]
    # The first roll-back leads to the first release; there is none before that.
    assert statuses == [SUCCESS, FAILURE]
    assert (opt / "venv").readlink() == Path("releases/1")
    assert (opt / "venv/bin/python").is_file()


def test_a_machine_that_is_not_a_pi_is_not_changed(install, bench, tmp_path):
    if Path("/proc/device-tree/model").exists():
        pytest.skip("this machine has a device tree: it may be a Pi")
    del bench["ROOT"]
    for arguments in ((), ("--roll-back",)):
        process = install(*arguments)
        assert process.returncode == USAGE_ERROR
        assert "not a Raspberry Pi" in process.stderr
    assert not (tmp_path / "log").exists(), "no command was run"


def test_a_release_that_cannot_be_installed_changes_nothing(install, tmp_path):
    assert install().returncode == SUCCESS
    opt = tmp_path / "root/opt/polysight"
    log = tmp_path / "log"
    releases_before = sorted(p.name for p in (opt / "releases").iterdir())
    (opt / "venv/bin/python").write_text(STUB + "exit 1\n")
    log.unlink()
    failed = install()
    assert failed.returncode == FAILURE
    assert "internet" in failed.stderr
    # The running service is not touched.
    assert "systemctl" not in log.read_text()
    assert (opt / "venv").readlink() == Path("releases/1")
    assert sorted(p.name for p in (opt / "releases").iterdir()) == releases_before


def test_an_unfinished_release_is_never_used(install, tmp_path):
    """Power is lost while pip installs: the release's folder exists but must not become active."""
    opt = tmp_path / "root/opt/polysight"
    assert install().returncode == SUCCESS
    python = opt / "venv/bin/python"
    python_text = python.read_text()
    # This program kills the script that has called it.
    python.write_text(STUB + "kill -9 $PPID\n")
    assert install().returncode == -signal.SIGKILL
    assert (opt / "venv").readlink() == Path("releases/1")
    python.write_text(python_text)
    assert install().returncode == SUCCESS
    assert install("--roll-back").returncode == SUCCESS
    assert (opt / "venv").readlink() == Path("releases/1")
