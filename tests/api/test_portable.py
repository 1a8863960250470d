"""Scans are processed, read and exported without modules that only POSIX systems have: this also works on Windows."""

import subprocess
import sys
import textwrap

from tests.support.rigs import load_published_rig
from tests.support.scenes import COPPER, PET, make_scene

from polysight_simulators.scene import decode_scene, simulate

# Code that runs before that of a test. It hides POSIX modules and functions, replaces Windows' file locks (msvcrt), and
# records in `tried` what else the program tries that Windows does not have: /proc, compiled loops (kernels), and the
# exchange of two names (renameat2). `subprocess` is imported before there is a `msvcrt`, which it would take for that
# of Windows.
HIDE_POSIX = """
import builtins, ctypes, io, os, subprocess, sys, types
for name in ("fcntl", "resource", "termios", "tty", "pty", "grp", "pwd", "syslog"):
    sys.modules[name] = None
for name in ("O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "sysconf", "sched_getaffinity", "getloadavg"):
    delattr(os, name)
locked = []
msvcrt = types.ModuleType("msvcrt")
msvcrt.LK_NBLCK = 2
msvcrt.locking = lambda file, mode, count: locked.append((mode, count))
sys.modules["msvcrt"] = msvcrt
tried = set()
open_file = io.open
def open_without_proc(file, *more, **named):
    if str(file).startswith("/proc"):
        tried.add("/proc")
        raise FileNotFoundError(2, "there is no /proc", str(file))
    return open_file(file, *more, **named)
io.open = builtins.open = open_without_proc
class Library(ctypes.CDLL):
    def __init__(self, name, *more, **named):
        if name is not None and "kernels" in str(name):
            tried.add("kernels")
            raise OSError("nothing was compiled")
        super().__init__(name, *more, **named)
    def __getattr__(self, name):
        if name == "renameat2":
            tried.add(name)
            raise AttributeError(name)
        return super().__getattr__(name)
ctypes.CDLL = Library
"""


def run_without_posix(program: str, *arguments: object) -> str:
    """Run lines of Python after HIDE_POSIX, which must not raise an error; return what they print."""
    code = HIDE_POSIX + textwrap.dedent(program)
    process = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stderr
    return process.stdout


def test_every_public_name_is_imported_without_posix():
    run_without_posix("import polysight\nfor name in polysight.__all__: getattr(polysight, name)")
    run_without_posix("import polysight.jobs.process, polysight.jobs.batch, polysight.catalogue, polysight.serve")


def test_a_scan_is_processed_read_and_exported_without_posix(tmp_path):
    scene = decode_scene(make_scene(COPPER, PET, columns=15, rows=17), "test")
    scan = simulate(load_published_rig(), scene, tmp_path / "scan")
    program = """
    from polysight.cli.main import main
    scan, out = sys.argv[1:]
    assert main(["image", scan, "--out", out]) == 0
    assert main(["process", scan, "--out", out]) == 0
    # One byte of a file was locked.
    assert (msvcrt.LK_NBLCK, 1) in locked
    assert {"renameat2", "kernels"} <= tried
    import polysight
    print(polysight.open_scan(out).materials().sizes["patch"])
    assert main(["export", out, "--csv", "--mat", "--out", out + "-export"]) == 0
    """
    printed = run_without_posix(program, scan, tmp_path / "products")
    # The number of patches
    assert "2" in printed.splitlines()
    assert {path.name for path in (tmp_path / "products-export").iterdir()} == {"image.mat", "materials.csv"}
    assert not list(tmp_path.glob(".products*"))
