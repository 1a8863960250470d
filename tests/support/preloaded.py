"""Start our programs as forks of a process that has imported their modules, because the import takes most of the time.

`install` replaces `subprocess.Popen` in the process that runs the tests. It sends our commands to a server: a child
process with all our modules loaded, without threads and sockets. The program is a fork of the server, and a real
process with its own arguments, environment, folder, files and signals. Other commands are started as usual, and so are
ours if their environment changes how Python starts.

The program is a child of the process that called `Popen`, as if that process had started it itself. For that, the
server forks a middle process, the middle process forks the program and ends, and the calling process adopts the orphan.
So the caller gets the exit status, `getppid` is the caller, and a program that asked for a signal at the end of its
parent (PR_SET_PDEATHSIG) gets it when the caller ends. A program that starts others gets a server of its own, forked
before the program begins. Workers of pytest-xdist are started in the same way, and import none of our modules again.
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
# Libraries that our modules import only when a function needs them.
LIBRARIES = (
    "h5py", "jinja2", "matplotlib.backends.backend_agg", "matplotlib.figure", "matplotlib.image", "numpy.testing",
    "scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.stats", "skimage.measure",
    "sklearn.discriminant_analysis", "sklearn.model_selection", "sklearn.neighbors", "uvicorn", "xarray",
)  # fmt: skip
# Name of a worker of pytest-xdist, which execnet starts by `python -u -c CODE`
WORKER = "worker"
# A script that runs one of our programs and kills it at given file operations:
# `python killed_at.py HITS OPERATIONS polysight scan ...`
KILLED_AT = str(Path(__file__).with_name("killed_at.py"))
# Programs that start other programs of ours, and commands of `polysight` that do
STARTING_OTHERS = ("polysight_simulators.rig", "polysight_simulators", WORKER)
COMMANDS_STARTING_OTHERS = frozenset({"demo", "doctor", "process", "resume", "scan", "serve"})
# Beginnings of the names of environment variables that have an effect only when a process starts
READ_AT_START = ("PYTHON", "LD_", "LC_", "LANG", "OMP_", "OPENBLAS_", "MPL", "MALLOC_")
# A new program gets its files with the descriptors that Popen asks for, all below this number. Until the fork has
# closed its other descriptors below it, it keeps these files as copies with numbers from this one on. A process may
# usually have descriptors up to 1023 (`ulimit -n`).
FIRST_SPARE = 700
# Length of the server's own command line. A program's arguments are written over it for `ps`, which shows only this
# many bytes of them.
COMMAND_LINE_BYTES = 8000
# Size of the buffer for a request, with the whole environment of the program
REQUEST_BYTES = 1 << 20
# Files that can be sent with a request
MOST_FILES = 64
# Size of the buffer for a process id in decimal digits; Linux has at most seven.
PID_BYTES = 32
# Default of Popen's argument `process_group`: the new process stays in the group of its parent.
GROUP_OF_PARENT = -1
# <linux/prctl.h>
PR_SET_CHILD_SUBREAPER = 36


class Request(NamedTuple):
    """A program to start. Its open files are sent with the request."""

    words: list[str]
    environment: dict[str, str]
    folder: str
    # Numbers that the sent files get in the program, in their order.
    descriptors: list[int]
    new_session: bool
    # `preexec_fn` of Popen
    prepare: Callable[[], object] | None


def program_name(words: list[str]) -> str:
    """The module or script of one of our commands, or WORKER; "" for any other command."""
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
    """True for a program that may start other programs of ours, so that it needs a server.

    Other programs get none, because one more fork takes as long as a short command.
    """
    name = program_name(words)
    is_command = name == KILLED_AT or name == "polysight"
    return name in STARTING_OTHERS or (is_command and not COMMANDS_STARTING_OTHERS.isdisjoint(words))


def can_be_sent(function: Callable[[], object] | None) -> bool:
    """True if a function to be called in the new process can be sent to the server by its name, or if there is none."""
    return function is None or function.__module__.partition(".")[0] in PACKAGES


def select_start_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables that have an effect only when a process starts."""
    return {name: value for name, value in environment.items() if name.startswith(READ_AT_START)}


class Popen(subprocess.Popen):
    """`subprocess.Popen` that lets a server fork our commands."""

    server: Server

    def _execute_child(self, *values: Any, **named: Any) -> None:
        """Start the program: as a fork if it is a plain command of ours, otherwise as `subprocess` does."""
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
            and bound_arguments["process_group"] == GROUP_OF_PARENT
        )
        is_our_command = bool(words) and program_name(words) != ""
        starts_alike = select_start_variables(environment) == select_start_variables(os.environ)
        can_be_forked = (
            is_our_command
            and is_plain
            and starts_alike
            and can_be_sent(bound_arguments["preexec_fn"])
            and Path(folder).is_dir()
        )
        if not can_be_forked:
            start(*values, **named)
            return
        descriptors = [0, 1, 2, *bound_arguments["pass_fds"]]
        open_descriptors = [
            bound_arguments["p2cread"],
            bound_arguments["c2pwrite"],
            bound_arguments["errwrite"],
            *bound_arguments["pass_fds"],
        ]
        # -1 means that the program inherits the descriptor with its own number.
        files = [number if file == -1 else file for number, file in zip(descriptors, open_descriptors, strict=True)]
        request = Request(
            words=words,
            environment=environment,
            folder=folder,
            descriptors=descriptors,
            new_session=bound_arguments["start_new_session"],
            prepare=bound_arguments["preexec_fn"],
        )
        self.pid = Popen.server.start(request, files)
        self._child_created = True
        ends = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
        self._close_pipe_fds(*(bound_arguments[end] for end in ends))  # type: ignore[attr-defined]


class Server:
    """The server as the process sees it that calls Popen. Several threads may use it at the same time."""

    def __init__(self, connection: socket.socket | None = None, pid: int = 0) -> None:
        self._connection = connection
        self._pid = pid
        self._lock = threading.Lock()

    def start(self, request: Request, files: list[int]) -> int:
        """Let the server fork a program; return its process id."""
        with self._lock:
            if self._connection is None:
                self._connection, self._pid = start_server()
            adopt_orphans(True)
            try:
                socket.send_fds(self._connection, [pickle.dumps(tuple(request))], files)
                answer = self._connection.recv(PID_BYTES)
            finally:
                adopt_orphans(False)
        if not answer:
            raise OSError(f"the server of preloaded programs did not start {request.words}")
        return int(answer)

    def close(self) -> None:
        """End the server, if it was started."""
        if self._connection is not None:
            # A signal to the whole process group may have ended the server already.
            with suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)
                os.waitpid(self._pid, 0)
            self._connection.close()


def install(server: Server) -> None:
    """From now on let this server fork the commands of ours that this process starts.

    The server itself is started with the first of these commands. A program that is a fork of a server may have a
    server already: then that one is kept.
    """
    if hasattr(subprocess.Popen, "server"):
        return
    Popen.server = server
    subprocess.Popen = Popen  # type: ignore[misc]


def close() -> None:
    """End this process's server."""
    subprocess.Popen.server.close()  # type: ignore[attr-defined]


def adopt_orphans(enabled: bool) -> None:
    """Become the parent of descendants whose parent ends, or stop being it."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, int(enabled), 0, 0, 0)


def start_server() -> tuple[socket.socket, int]:
    """Start the server as a new process; return the connection to it and its process id."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.set_inheritable(True)
    words = [sys.executable, __file__, str(theirs.fileno()), " " * COMMAND_LINE_BYTES]
    with theirs:
        pid = os.posix_spawn(sys.executable, words, os.environ)
    return ours, pid


def preload() -> None:
    """Import our modules, and the libraries that they import later."""
    modules = [
        module.name
        for package in PACKAGES
        for module in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}.")
    ]
    with warnings.catch_warnings():
        # pytest makes a warning an error. The workers are forks and import these modules no more, so that a warning
        # at an import would never reach pytest: it is an error here.
        warnings.simplefilter("error")
        for name in (*modules, *LIBRARIES):
            if not name.endswith("__main__"):
                with suppress(ImportError):
                    importlib.import_module(name)


def serve(connection: socket.socket) -> list[str]:
    """Fork a program for each request, and return its arguments in that fork when it may run.

    Each process on the left forks the one on its right. The server never returns, the middle process ends at once, and
    a new server continues this loop with a connection of its own:

        server -> middle process -> program -> new server, if the program may start others
    """
    while True:
        try:
            message, files, _, _ = socket.recv_fds(connection, REQUEST_BYTES, MOST_FILES)
        except ConnectionResetError:
            # The calling process was killed before it had read the last answer.
            os._exit(0)
        if not message:
            os._exit(0)
        # The program reports its process id to the server by this pair of sockets.
        server_end, program_end = socket.socketpair()
        middle_pid = os.fork()
        is_server = middle_pid != 0
        if is_server:
            program_end.close()
            for file in files:
                os.close(file)
            answer = server_end.recv(PID_BYTES)
            # When the middle process has ended, the calling process becomes the parent of the program.
            os.waitpid(middle_pid, 0)
            # The calling process may have been killed meanwhile: then there is no further request.
            with suppress(BrokenPipeError):
                connection.send(answer)
            server_end.close()
            continue
        program_pid = os.fork()
        is_middle_process = program_pid != 0
        if is_middle_process:
            os._exit(0)
        # From here on this is the program.
        request = Request(*pickle.loads(message))
        passed_files = [move_descriptor_up(file) for file in files]
        connection.close()
        server_end.close()
        if may_start_others(request.words):
            end_of_program, end_of_new_server = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            new_server_pid = os.fork()
            is_new_server = new_server_pid == 0
            if is_new_server:
                for file in (end_of_program.detach(), program_end.detach(), *files, *passed_files):
                    os.close(file)
                connection = end_of_new_server
                continue
            end_of_new_server.close()
            connection_to_server = socket.socket(fileno=move_descriptor_up(end_of_program.detach()))
            install(Server(connection_to_server, new_server_pid))
            atexit.register(Popen.server.close)
        become(request, passed_files, move_descriptor_up(program_end.detach()))
        return request.words


def move_descriptor_up(file: int) -> int:
    """Return a copy of a descriptor, with a number that is not used for the program's own files."""
    return fcntl.fcntl(file, fcntl.F_DUPFD_CLOEXEC, FIRST_SPARE)


def become(request: Request, files: list[int], starter: int) -> None:
    """Take the files, arguments, environment and folder of a request; report the process id, and wait for the parent.

    `starter` is a socket to the server. It is closed when the calling process has become the parent.
    """
    os.closerange(0, FIRST_SPARE)
    for file, number in zip(files, request.descriptors, strict=True):
        os.dup2(file, number)
        os.close(file)
    # As at Python's own start: stderr is written line by line, and a character that the terminal lacks as its escape.
    streams = {
        "stdin": open(0, closefd=False),  # noqa: SIM115
        "stdout": open(1, "w", closefd=False),  # noqa: SIM115
        "stderr": open(2, "w", buffering=1, errors="backslashreplace", closefd=False),  # noqa: SIM115
    }
    for name, stream in streams.items():
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
    """Write the arguments over those with which this process was started, so that `ps` shows them."""
    # Fields 48 and 49 of proc_pid_stat(5) are the addresses of the arguments' start and end. After the program's name
    # in brackets the list begins with field 3.
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
            # Usually a module that is run as a program has not been imported before; a package with __main__ has.
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
        if e.code is None:
            return 0
        if isinstance(e.code, int):
            return e.code
        if isinstance(e.code, str):
            sys.stderr.write(e.code + "\n")
        return 1
    except KeyboardInterrupt:
        # The status that a shell reports for a program that a signal has ended
        return 128 + signal.SIGINT
    except BaseException:  # noqa: BLE001
        sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
        return 1
    return 0


def end(status: int) -> None:
    """End as Python does, but without freeing the memory of all modules, which takes longer than most programs."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError:
        # Python's exit status when it cannot write its last output.
        status = 120
    os._exit(status)


def main() -> int:
    """Run the server, and in each of its forks a program."""
    sys.path[0] = str(REPO)
    # These signals are sent to the whole process group, but the server must end after the process that uses it.
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
