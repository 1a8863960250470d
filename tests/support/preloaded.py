"""Start our programs as forks of a process that has imported them: an import takes longer than most programs.

`install` replaces `subprocess.Popen` in the process that runs the tests. Commands of ours are sent to the server, a
child process with all our modules loaded, no thread and no socket. The program is a fork of it: a real process with its
own arguments, environment, folder, files, and signals. Every other command, and one whose environment changes how
Python starts, is started as always.

The program is the child of the process that asked, as if that had started it: the server forks twice, the middle one
ends, and the asking process adopts its orphans meanwhile. Exit status, `getppid` and signals at a parent's end work. So
each program that starts others itself has a server of its own, forked before the program begins. So are the workers of
pytest-xdist: they fork their programs from the same server, and import nothing of ours again.
"""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import gc
import importlib
import inspect
import os
import pickle
import pkgutil
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
import types
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from execnet.gateway_io import popen_bootstrapline

REPO = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
PACKAGES = ("polysight_shared", "polysight_pi", "polysight_simulators", "polysight", "polysight_papers")
# Loaded by functions of ours, when they are called.
LIBRARIES = (
    "h5py", "jinja2", "matplotlib.backends.backend_agg", "matplotlib.figure", "matplotlib.image", "numpy.testing",
    "scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.stats", "skimage.measure",
    "sklearn.discriminant_analysis", "sklearn.model_selection", "sklearn.neighbors", "uvicorn", "xarray",
)  # fmt: skip
# Name for a worker of pytest-xdist, which execnet starts by `python -u -c CODE`.
WORKER = "worker"
# Runs a program of ours: `python killed_at.py HITS PLACES polysight scan ...`.
KILLED_AT = str(Path(__file__).with_name("killed_at.py"))
# Programs that start other programs of ours, and commands of `polysight` that do.
STARTING_OTHERS = ("polysight_simulators.rig", "polysight_simulators", WORKER)
COMMANDS_STARTING_OTHERS = frozenset({"demo", "doctor", "process", "resume", "scan", "serve"})
# Variables that affect only a new process.
READ_AT_START = ("PYTHON", "LD_", "LC_", "LANG", "OMP_", "OPENBLAS_", "MPL", "MALLOC_")
# Descriptors below this number are the program's own; above are copies of those that are passed to it.
FIRST_SPARE = 700
# Length of the server's own command line, over which a program's arguments are written.
ROOM_FOR_WORDS = 8000
# <linux/prctl.h>
PR_SET_CHILD_SUBREAPER = 36


class Request(NamedTuple):
    """A program to start. Its files come along, as the descriptors of these numbers."""

    words: list[str]
    environment: dict[str, str]
    folder: str
    descriptors: list[int]
    new_session: bool
    prepare: Callable[[], object] | None


def program_name(words: list[str]) -> str:
    """The module or script of a command of ours, WORKER, or an empty string."""
    program = Path(words[0])
    if program.parent != BIN:
        return ""
    if program.name in ("polysight", "polysight-pi"):
        return program.name
    if words[1:] == ["-u", "-c", popen_bootstrapline]:
        return WORKER
    if words[1:2] == [KILLED_AT]:
        return KILLED_AT
    is_module = program.name.startswith("python") and len(words) > 2 and words[1] == "-m"
    if is_module and words[2].partition(".")[0] in PACKAGES:
        return words[2]
    return ""


def may_start_others(words: list[str]) -> bool:
    """True for a program that may start others of ours, and gets a server; a fork takes as long as a short command."""
    name = program_name(words)
    is_command = name == KILLED_AT or name == "polysight"
    return name in STARTING_OTHERS or (is_command and not COMMANDS_STARTING_OTHERS.isdisjoint(words))


def is_ours(function: Callable[[], object] | None) -> bool:
    """True if a function to be called in the new process can be sent to the server by its name."""
    return function is None or function.__module__.partition(".")[0] in PACKAGES


def read_at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that only a new process takes notice of."""
    return {name: value for name, value in environment.items() if name.startswith(READ_AT_START)}


class Popen(subprocess.Popen):
    """`subprocess.Popen` that has commands of ours forked."""

    server: Server

    def _execute_child(self, *values: Any, **named: Any) -> None:
        """Start the program: as a fork if it is a plain command of ours, else as `subprocess` does."""
        start = super()._execute_child  # type: ignore[misc]
        bound_arguments = inspect.signature(start).bind(*values, **named).arguments
        if isinstance(bound_arguments["args"], str | bytes | os.PathLike):
            words = []
        else:
            words = [os.fsdecode(word) for word in bound_arguments["args"]]
        environment = dict(os.environ if bound_arguments["env"] is None else bound_arguments["env"])
        folder = os.fsdecode(bound_arguments["cwd"] or Path.cwd())
        is_plain = (
            not bound_arguments["shell"]
            and bound_arguments["executable"] is None
            and bound_arguments["process_group"] == -1
        )
        same_python = read_at_start(environment) == read_at_start(os.environ)
        forked = words and program_name(words) and is_plain and same_python and is_ours(bound_arguments["preexec_fn"])
        if not forked or not Path(folder).is_dir():
            start(*values, **named)
            return
        descriptors = [0, 1, 2, *bound_arguments["pass_fds"]]
        open_descriptors = [
            bound_arguments["p2cread"],
            bound_arguments["c2pwrite"],
            bound_arguments["errwrite"],
            *bound_arguments["pass_fds"],
        ]
        files = [number if file == -1 else file for number, file in zip(descriptors, open_descriptors, strict=True)]
        request = Request(
            words, environment, folder, descriptors, bound_arguments["start_new_session"], bound_arguments["preexec_fn"]
        )
        self.pid = Popen.server.start(request, files)
        self._child_created = True
        ends = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
        self._close_pipe_fds(*(bound_arguments[end] for end in ends))  # type: ignore[attr-defined]


class Server:
    """The server as seen by the process that asks. Threads may ask at the same time."""

    def __init__(self, connection: socket.socket | None = None, pid: int = 0) -> None:
        self._connection = connection
        self._pid = pid
        self._lock = threading.Lock()

    def start(self, request: Request, files: list[int]) -> int:
        """Have a program forked; return its process number."""
        with self._lock:
            if self._connection is None:
                self._connection, self._pid = start_server()
            adopt_orphans(True)
            try:
                socket.send_fds(self._connection, [pickle.dumps(tuple(request))], files)
                answer = self._connection.recv(32)
            finally:
                adopt_orphans(False)
        if not answer:
            raise OSError(f"the server of preloaded programs did not start {request.words}")
        return int(answer)

    def close(self) -> None:
        """End the server, if it was started."""
        if self._connection is not None:
            # A signal to the whole process group may have ended it.
            with suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)
                os.waitpid(self._pid, 0)
            self._connection.close()


def install(server: Server) -> None:
    """Have this process's commands of ours forked. A server without a connection starts with the first of them.

    A program that was forked has its server already.
    """
    if hasattr(subprocess.Popen, "server"):
        return
    Popen.server = server
    subprocess.Popen = Popen  # type: ignore[misc]


def close() -> None:
    """End the server of this process's commands."""
    subprocess.Popen.server.close()  # type: ignore[attr-defined]


def adopt_orphans(enabled: bool) -> None:
    """Become the parent of descendants whose parent ends, or stop being it."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, int(enabled), 0, 0, 0)


def start_server() -> tuple[socket.socket, int]:
    """Start the server as a new process; return the connection to it, and its number."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.set_inheritable(True)
    words = [sys.executable, __file__, str(theirs.fileno()), " " * ROOM_FOR_WORDS]
    with theirs:
        pid = os.posix_spawn(sys.executable, words, os.environ)
    return ours, pid


def preload() -> None:
    """Import our modules, and what they load when they are called."""
    modules = [
        module.name
        for package in PACKAGES
        for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}.")
    ]
    with warnings.catch_warnings():
        # As pytest does, whose workers import nothing of this themselves.
        warnings.simplefilter("error")
        for name in (*modules, *LIBRARIES):
            if not name.endswith("__main__"):
                with suppress(ImportError):
                    importlib.import_module(name)


def serve(connection: socket.socket) -> list[str]:
    """Fork a program for each request. Return in each program, which is prepared, with its arguments."""
    while True:
        try:
            message, files, _, _ = socket.recv_fds(connection, 1 << 20, 64)
        except ConnectionResetError:
            # The asking process was killed before it had read the last answer.
            os._exit(0)
        if not message:
            os._exit(0)
        near, far = socket.socketpair()
        middle = os.fork()
        if middle:
            far.close()
            for file in files:
                os.close(file)
            answer = near.recv(32)
            # From the end of the middle process on, the program's parent is the process that asked.
            os.waitpid(middle, 0)
            # The asking process may have been killed meanwhile: then there is no further request.
            with suppress(BrokenPipeError):
                connection.send(answer)
            near.close()
            continue
        if os.fork():
            os._exit(0)
        request = Request(*pickle.loads(message))
        spare = [move_descriptor_up(file) for file in files]
        for end in (connection, near):
            end.close()
        if may_start_others(request.words):
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            server = os.fork()
            if not server:
                for file in (ours.detach(), far.detach(), *files, *spare):
                    os.close(file)
                connection = theirs
                continue
            theirs.close()
            install(Server(socket.socket(fileno=move_descriptor_up(ours.detach())), server))
            atexit.register(Popen.server.close)
        become(request, spare, move_descriptor_up(far.detach()))
        return request.words


def move_descriptor_up(file: int) -> int:
    """Return a copy of a descriptor that lies above the program's own."""
    return fcntl.fcntl(file, fcntl.F_DUPFD_CLOEXEC, FIRST_SPARE)


def become(request: Request, files: list[int], starter: int) -> None:
    """Take over files, arguments, environment and folder; report the process id, and wait for the adoption."""
    os.closerange(0, FIRST_SPARE)
    for file, number in zip(files, request.descriptors, strict=True):
        os.dup2(file, number)
        os.close(file)
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        errors = "backslashreplace" if name == "stderr" else None
        stream = open(number, mode, 1 if name == "stderr" else -1, errors=errors, closefd=False)  # noqa: SIM115
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)
    show_in_process_list(request.words)
    if request.new_session:
        os.setsid()
    os.chdir(request.folder)
    os.environ.clear()
    os.environ.update(request.environment)
    time.tzset()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.write(starter, str(os.getpid()).encode())
    os.read(starter, 1)
    os.close(starter)
    if request.prepare is not None:
        request.prepare()


def show_in_process_list(words: list[str]) -> None:
    """Write the arguments over this process's own ones, see proc(5), `arg_start`."""
    # Fields 48 and 49 of proc_pid_stat(5): the addresses of the arguments; the first field here is the third.
    fields = Path("/proc/self/stat").read_bytes().rpartition(b")")[2].split()
    start = int(fields[45])
    end = int(fields[46])
    text = b"\0".join(map(os.fsencode, words))
    ctypes.memmove(start, text.ljust(end - start, b"\0"), end - start)


def run(words: list[str]) -> int:
    """Run a command as Python does; return its exit status."""
    try:
        if program_name(words) == WORKER:
            sys.path[0] = ""
            sys.modules["__main__"] = types.ModuleType("__main__")
            exec(words[3], vars(sys.modules["__main__"]))
        elif words[1:2] == ["-m"]:
            sys.path[0] = str(Path.cwd())
            sys.argv = words[2:]
            # A module that runs as the program is not yet imported; a package is.
            if not hasattr(sys.modules.get(words[2]), "__path__"):
                sys.modules.pop(words[2], None)
            runpy.run_module(words[2], run_name="__main__", alter_sys=True)
        elif words[1:2] == [KILLED_AT]:
            sys.argv = words[1:]
            runpy.run_path(KILLED_AT, run_name="__main__")
        else:
            sys.path[0] = str(BIN)
            sys.argv = words
            runpy.run_path(words[0], run_name="__main__")
    except SystemExit as e:
        if isinstance(e.code, str):
            sys.stderr.write(e.code + "\n")
        return e.code if isinstance(e.code, int) else int(e.code is not None)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except BaseException:  # noqa: BLE001
        sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
        return 1
    return 0


def end(status: int) -> None:
    """End as Python does, but without deleting all modules, which takes longer than most programs."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError:
        status = 120
    os._exit(status)


def main() -> int:
    """The server, and in its forks the programs."""
    sys.path[0] = str(REPO)
    # Both come to the whole process group. The server ends with the process that asks.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    connection = int(sys.argv[1])
    null_file = os.open(os.devnull, os.O_RDWR)
    for number in (0, 1):
        os.dup2(null_file, number)
    os.closerange(3, connection)
    os.closerange(connection + 1, FIRST_SPARE)
    preload()
    gc.freeze()
    return run(serve(socket.socket(fileno=connection)))


if __name__ == "__main__":
    end(main())
