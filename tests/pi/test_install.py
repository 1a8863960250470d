"""Installed files of a Pi: the installation script, the systemd unit, the udev rules."""

import configparser
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tests.support.paths import REPO, RIG_FILE
from tests.support.processes import HANG_S
from tests.support.rigs import load_published_rig

PI = REPO / "pi_controller"
PROGRAM = "/opt/polysight/venv/bin/polysight-pi"
# Replaces a command that would change this machine; its arguments are recorded.
STUB = '#!/bin/sh\necho "$(basename "$0") $*" >> "$LOG"\n'
STUBS = {
    **dict.fromkeys(("groupadd", "useradd", "udevadm", "systemctl", "chown", "pip"), STUB),
    "getent": STUB + "exit 2\n",
    "python3": STUB + 'if [ "$2" = venv ]; then mkdir -p "$3/bin"; cp "$PIP" "$3/bin/python"; fi\n',
    "python": STUB + 'mkdir -p "$7"; touch "$7/a.whl"\n',  # -m pip wheel --quiet --no-deps --wheel-dir FOLDER
    "ssh": STUB + '[ "$1" = -t ] && shift; shift; cd "$PI_HOME" && sh -c "$*"\n',  # the Pi is a folder here
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
    """Runs systemd-analyze on the unit; its program is replaced, because it is not installed here."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze: `apt-get install systemd` runs this test too")
    text = (PI / "polysight-pi.service").read_text()
    assert PROGRAM in text
    path = tmp_path / "polysight-pi.service"
    path.write_text(text.replace(PROGRAM, "/bin/true"))
    return lambda *words: subprocess.run(
        ["systemd-analyze", *words, str(path)], capture_output=True, text=True, timeout=HANG_S, check=False
    )


def test_the_unit_is_what_systemd_accepts(analyze):
    process = analyze("verify", "--man=no")
    assert "polysight-pi.service" not in process.stderr, process.stderr
    assert process.returncode == 0, process.stderr


# As systemd does for RestrictAddressFamilies=: socket() of another family fails with EAFNOSUPPORT (seccomp(2)).
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
    assert int(service["LimitRTPRIO"]) >= 50
    assert service["LimitMEMLOCK"] == "infinity"
    assert {"gpio", "spi", "dialout"} <= set(service["SupplementaryGroups"].split())
    rig = load_published_rig()
    assert Path(rig.pi.journal_dir).is_relative_to(service["ReadWritePaths"])
    assert Path(rig.pi.journal_dir).is_relative_to(Path("/var/lib") / service["StateDirectory"])
    # The executor notifies the watchdog; a lost stage blocks it for 25 s.
    assert (service["Type"], service["Restart"]) == ("notify", "on-failure")
    assert 25 < int(service["WatchdogSec"]) <= 60


def test_the_unit_exposes_little(analyze):
    """systemd's exposure level: 0 is a program without any rights, 10 one without any limit."""
    process = analyze("security", "--offline=yes", "--no-pager")
    exposure = re.search(r"Overall exposure level for \S+: ([0-9.]+)", process.stdout)
    if exposure is None:
        pytest.skip(f"this systemd-analyze measures no file: {process.stderr.strip()}")
    assert float(exposure[1]) <= 3.0, process.stdout


def test_pinned_versions_are_what_the_wheels_ask_for():
    pins = dict(x.split("==") for x in (PI / "requirements.txt").read_text().split() if "==" in x)
    projects = [(REPO / name / "pyproject.toml").read_text() for name in ("shared", "pi_controller")]
    required_pins = [
        pin for text in projects for pin in re.findall(r'"(\w+)>=([\d.]+)', text.partition("dependencies = [")[2])
    ]
    assert set(pins) == {name for name, _ in required_pins}

    def key(version):
        return [int(x) for x in version.split(".")]

    assert all(key(pins[name]) >= key(least) for name, least in required_pins)


def test_udev_rules_are_well_formed():
    lines = [x for x in (PI / "60-polysight.rules").read_text().splitlines() if x and not x.startswith("#")]
    assert len(lines) >= 4
    pair = r'[A-Z]+(\{[A-Za-z_]+\})?(==|=|\+=)"[^"]*"'
    for line in lines:
        assert re.fullmatch(rf"{pair}(, {pair})*", line), line


@pytest.fixture
def install(bench, tmp_path):
    """Runs install.sh as copied to the Pi; returns the ended process."""
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


def test_installing_twice_keeps_the_rig_file_and_whatever_else_is_in_the_users_home(bench, tmp_path):
    """`make pi-install` as a whole, with every command that changes a machine replaced."""
    root = tmp_path / "root"
    log = tmp_path / "log"
    (tmp_path / "home/polysight/notes").write_text("mine")
    make = ["make", "pi-install", "HOST=pi@here", f"VENV={tmp_path}", f"BIN={tmp_path}/bin", f"OUT={tmp_path}/out"]
    for rig_file in (None, "mine"):
        if rig_file:
            (root / "etc/polysight/instrument.toml").write_text(rig_file)
            log.unlink()
        process = subprocess.run(make, cwd=REPO, env=bench, capture_output=True, text=True, check=False)
        assert process.returncode == 0, process.stdout + process.stderr
        log_text = log.read_text()
        assert log_text.count("-m venv") == (rig_file is None), "made once, and kept with its libraries"
        order = [
            log_text.index(w)
            for w in ("pip wheel", "pip install --quiet --retries", "--force-reinstall", "try-restart")
        ]
        assert order == sorted(order)
        assert "--no-index" in log_text, "what was built on the host needs no internet here"
    assert (tmp_path / "home/polysight/notes").read_text() == "mine"
    assert (root / "etc/polysight/instrument.toml").read_text() == "mine"
    assert (root / "etc/polysight/keys").stat().st_mode & 0o777 == 0o700
    for name in ("etc/systemd/system/polysight-pi.service", "etc/udev/rules.d/60-polysight.rules"):
        assert (root / name).read_text() == (PI / Path(name).name).read_text()
    assert "--groups gpio,spi,dialout" in log_text, (
        "by hand, `polysight-pi check` as this user has no group from the unit"
    )
    for words in ("useradd --system", "systemctl enable"):
        assert words in log_text
    assert PROGRAM in process.stdout
    opt = root / "opt/polysight"
    assert (opt / "venv").readlink() == Path("releases/2")
    back = [subprocess.run([PI / "install.sh", "--roll-back"], env=bench, check=False).returncode for _ in range(2)]
    assert back == [0, 5], "to the first release, and no further"
    assert (opt / "venv").readlink() == Path("releases/1")
    assert (opt / "venv/bin/python").is_file()


def test_a_machine_that_is_not_a_pi_is_not_changed(install, bench, tmp_path):
    if Path("/proc/device-tree/model").exists():
        pytest.skip("this machine has a device tree: it may be a Pi")
    del bench["ROOT"]
    for arguments in ((), ("--roll-back",)):
        process = install(*arguments)
        assert (process.returncode, "not a Raspberry Pi" in process.stderr) == (2, True)
    assert not (tmp_path / "log").exists(), "no command was run"


def test_a_release_that_cannot_be_installed_changes_nothing(install, tmp_path):
    assert install().returncode == 0
    opt = tmp_path / "root/opt/polysight"
    log = tmp_path / "log"
    releases_before = sorted(p.name for p in (opt / "releases").iterdir())
    (opt / "venv/bin/python").write_text(STUB + "exit 1\n")
    log.unlink()
    failed = install()
    assert (failed.returncode, "internet" in failed.stderr) == (5, True)
    assert "systemctl" not in log.read_text(), "the running service goes on"
    assert (opt / "venv").readlink() == Path("releases/1")
    assert sorted(p.name for p in (opt / "releases").iterdir()) == releases_before


def test_an_unfinished_release_is_never_used(install, tmp_path):
    """Power is lost while pip installs: the release's folder exists but must not become active."""
    opt = tmp_path / "root/opt/polysight"
    assert install().returncode == 0
    python = opt / "venv/bin/python"
    python_text = python.read_text()
    python.write_text(STUB + "kill -9 $PPID\n")
    assert install().returncode == -9
    assert (opt / "venv").readlink() == Path("releases/1")
    python.write_text(python_text)
    assert install().returncode == 0
    assert install("--roll-back").returncode == 0
    assert (opt / "venv").readlink() == Path("releases/1")
