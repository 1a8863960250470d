"""Processing, notebooks and results need no module of POSIX systems, so that they run on Windows."""

import subprocess
import sys
import textwrap

from tests.support.rigs import load_published_rig
from tests.support.scenes import COPPER, PET, make_scene

from polysight_simulators.scene import decode_scene, simulate

# Code before that of a test: POSIX modules and functions are missing, and `asked` notes which other things the program
# tried that Windows has not: /proc, compiled loops, and an exchange of two names (renameat2).
HIDDEN = """
import builtins, ctypes, io, os, subprocess, sys, types  # subprocess takes a msvcrt for Windows' own
for name in ("fcntl", "resource", "termios", "tty", "pty", "grp", "pwd", "syslog"):
    sys.modules[name] = None
for name in ("O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "sysconf", "sched_getaffinity", "getloadavg"):
    delattr(os, name)
locked = []
msvcrt = types.ModuleType("msvcrt")
msvcrt.LK_NBLCK = 2
msvcrt.locking = lambda file, mode, count: locked.append((mode, count))
sys.modules["msvcrt"] = msvcrt
asked = set()
open_file = io.open
def open_without_proc(file, *more, **named):
    if str(file).startswith("/proc"):
        asked.add("/proc")
        raise FileNotFoundError(2, "there is no /proc", str(file))
    return open_file(file, *more, **named)
io.open = builtins.open = open_without_proc
class Library(ctypes.CDLL):
    def __init__(self, name, *more, **named):
        if name is not None and "kernels" in str(name):
            asked.add("kernels")
            raise OSError("nothing was compiled")
        super().__init__(name, *more, **named)
    def __getattr__(self, name):
        if name == "renameat2":
            asked.add(name)
            raise AttributeError(name)
        return super().__getattr__(name)
ctypes.CDLL = Library
"""


def run_hidden(program: str, *arguments: object) -> str:
    """Run a program where these modules and functions, /proc and compiled loops are not there.

    Windows' locks are a stand-in.
    """
    code = HIDDEN + textwrap.dedent(program)
    process = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert process.returncode == 0, process.stderr
    return process.stdout


def test_every_public_name_is_imported_without_posix():
    run_hidden("import polysight\nfor name in polysight.__all__: getattr(polysight, name)")
    run_hidden("import polysight.jobs.process, polysight.jobs.batch, polysight.catalogue, polysight.serve")


def test_a_scan_is_processed_read_and_exported_without_posix(tmp_path):
    scene = decode_scene(make_scene(COPPER, PET, columns=15, rows=17), "test")
    scan = simulate(load_published_rig(), scene, tmp_path / "scan")
    program = """
    from polysight.cli.main import main
    scan, out = sys.argv[1:]
    assert main(["image", scan, "--out", out]) == 0
    assert main(["process", scan, "--out", out]) == 0
    # A file was locked: LK_NBLCK, one byte.
    assert (2, 1) in locked
    assert {"renameat2", "kernels"} <= asked
    import polysight
    print(polysight.open_scan(out).materials().sizes["patch"])
    assert main(["export", out, "--csv", "--mat", "--out", out + "-export"]) == 0
    """
    # It prints the number of patches.
    assert "\n2\n" in run_hidden(program, scan, tmp_path / "products")
    assert {path.name for path in (tmp_path / "products-export").iterdir()} == {"image.mat", "materials.csv"}
    assert not list(tmp_path.glob(".products*"))
