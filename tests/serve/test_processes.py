"""The processes of `polysight serve`: commands are answered even if the other processes fail, and after a restart.

The server's own process answers the pages. The *door* accepts all connections, answers commands to a running scan
itself, and hands everything else over. The *reading process* reads scans, with a low priority.
"""

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
from tests.support.page.asking import ask, get, post
from tests.support.page.live_view import open_control
from tests.support.processes import HANG_S, wait_for
from tests.support.products import write_judged_products
from tests.support.refusals import expect_refusal

from polysight.serve import server
from polysight.serve.door import MOST_SILENT, is_command
from polysight.serve.guard import TOKEN_HEADER
from polysight.serve.server import TOKEN_BYTES, ServerAddress, load_token, preview, serve
from polysight_shared.errors import ErrorCode


@dataclass
class Server:
    """A server that runs as its command."""

    program: subprocess.Popen[str]
    port: int
    token: str

    def reading_process(self) -> int | None:
        """Process id of the reading process, the child with a lower priority; None while there is none."""
        return self._find_child(lambda priority: priority > 0)

    def door(self) -> int | None:
        """Process id of the door, the child with the priority of the server; None while there is none."""
        return self._find_child(lambda priority: priority == 0)

    def _find_child(self, is_wanted: Callable[[int], bool]) -> int | None:
        our_priority = os.getpriority(os.PRIO_PROCESS, self.program.pid)
        children = Path(f"/proc/{self.program.pid}/task").glob("*/children")
        # A process may end while it is examined.
        with suppress(FileNotFoundError, ProcessLookupError):
            for pid in map(int, " ".join(path.read_text() for path in children).split()):
                # The tracker of the standard library's shared resources is not a process of the server.
                if b"resource_tracker" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    continue
                if is_wanted(os.getpriority(os.PRIO_PROCESS, pid) - our_priority):
                    return pid
        return None


@contextmanager
def run_server(root: Path, state: Path, *options: str, command: str = "serve") -> Iterator[Server]:
    """Run the command for the scans below `root`, with its token in `state`, until the block ends."""
    words = [sys.executable, "-m", "polysight", command, str(root), "--port", "0", *options]
    environment = os.environ | {"XDG_STATE_HOME": str(state)}
    program = subprocess.Popen(words, cwd=state, env=environment, stderr=subprocess.PIPE, text=True)
    try:
        assert program.stderr is not None
        for line in program.stderr:
            if address := re.search(r":(\d+)/#token=(\S+)", line):
                yield Server(program, int(address[1]), address[2])
                break
    finally:
        program.terminate()
        program.wait()
        if program.stderr is not None:
            program.stderr.close()


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    write_judged_products(tmp_path / "scans" / "one" / "products", "care")
    (tmp_path / "scans" / "one" / "program").mkdir()
    (tmp_path / "state").mkdir()
    return tmp_path / "scans"


def test_a_scan_is_aborted_while_the_reading_process_is_frozen_killed_and_started_again(scans, tmp_path):
    with run_server(scans, tmp_path / "state") as server, open_control(scans / "one") as stop:
        wait_for(lambda: ask(server, "/api/scans")[0] == 200, "the list")
        first_process = server.reading_process()
        assert first_process is not None
        os.kill(first_process, signal.SIGSTOP)
        assert post(server, "/api/control/pause?scan=one", token="wrong")[0] == 403
        assert post(server, "/api/control/pause?scan=one", token=server.token)[0] == 200
        assert stop.paused
        assert [(s["name"], s["state"]) for s in get(server, "/api/running")] == [("one", "running")]
        os.kill(first_process, signal.SIGKILL)
        assert post(server, "/api/control/abort?scan=one", token=server.token)[0] == 200
        assert stop.now
        assert "the page" in stop.asker
        wait_for(lambda: server.reading_process() not in (None, first_process), "another one")
        wait_for(lambda: ask(server, "/api/scans")[0] == 200, "the list again")


def test_a_command_is_answered_while_the_pages_are_frozen_and_many_connections_are_silent(scans, tmp_path):
    """A page that was requested meanwhile is answered when the pages' process continues."""
    with run_server(scans, tmp_path / "state") as server, open_control(scans / "one") as stop, ExitStack() as clients:
        assert ask(server, "/api/page")[2]["connection"] == "close"
        # A reading process that has just begun still has the priority of the door, by which that is found.
        wait_for(lambda: server.reading_process() is not None, "the reading process")
        door = server.door()
        assert door is not None
        # Ctrl-C and the end of a session reach all processes of a terminal. The door ignores them: the server ends it.
        os.kill(door, signal.SIGTERM)
        os.kill(door, signal.SIGINT)
        os.kill(server.program.pid, signal.SIGSTOP)
        try:
            reading = clients.enter_context(socket.create_connection(("127.0.0.1", server.port), HANG_S))
            reading.sendall(b"GET /api/page HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            # More connections without a request than the door keeps.
            for _ in range(MOST_SILENT + 100):
                clients.enter_context(socket.create_connection(("127.0.0.1", server.port), HANG_S))
            assert post(server, "/api/control/abort?scan=one", token=server.token)[0] == 200
            assert stop.now
        finally:
            os.kill(server.program.pid, signal.SIGCONT)
        assert reading.recv(100).startswith(b"HTTP/1.1 200")


def test_preview_shows_and_controls_its_scan_only(scans, tmp_path):
    """Pause and resume are tested in e2e/test_operator_page, a killed scan in tests/page."""
    (tmp_path / "scans" / "two").mkdir()
    with run_server(scans / "one", tmp_path / "state", "--control", command="preview") as server:
        state = get(server, "/api/state")
        assert state["control"]
        assert not state["running"]
        assert state["status"]["headline"] == "No scan here yet"
        with open_control(scans / "one") as stop:
            assert post(server, "/api/control/pause", token=server.token)[0] == 200
            assert stop.paused
        assert ask(server, "/api/scan?scan=two")[0] == 404


# A program with a server that interrupts itself, as Ctrl-C does, when it forks. Arguments: numbers of the forks ("12"),
# the hook of `os.register_at_fork` (before or after the fork, in the parent or the child), and the command line.
# It also reports a child that lives longer than the temporary folder with the sockets of the processes.
INTERRUPT_AT_FORKS = """
import multiprocessing, os, signal, sys, tempfile
from polysight.cli.main import main
remove = tempfile.TemporaryDirectory.cleanup
def cleanup(folder):
    remove(folder)
    for process in multiprocessing.active_children():
        sys.stderr.write(f"{process.name} outlives the folder of its socket\\n")
tempfile.TemporaryDirectory.cleanup = cleanup
forks = iter("123")
def interrupt():
    if next(forks) in sys.argv[1]:
        signal.raise_signal(signal.SIGINT)
os.register_at_fork(**{sys.argv[2]: interrupt})
sys.exit(main(sys.argv[3:]))
"""


# A program with a server that interrupts itself while asyncio makes its event loop.
INTERRUPT_IN_LOOP = """
import os, signal, socket, sys
from polysight.cli.main import main
server = os.getpid()
make_pair = socket.socketpair
def socketpair(*args):
    # The event loop's own pair is the first that it makes.
    if os.getpid() == server and "asyncio" in sys._getframe(1).f_code.co_filename:
        sys.stderr.write("interrupted\\n")
        signal.raise_signal(signal.SIGINT)
    return make_pair(*args)
socket.socketpair = socketpair
sys.exit(main(sys.argv[1:]))
"""


def serve_interrupted(forks: str, where: str, folder: Path) -> tuple[int, str]:
    """Interrupt a server at these forks, at the hook `where`; return its exit status and stderr."""
    words = [sys.executable, "-c", INTERRUPT_AT_FORKS, forks, where, "serve", str(folder), "--port", "0"]
    environment = os.environ | {"XDG_STATE_HOME": str(folder)}
    messages = ""
    with subprocess.Popen(words, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True) as program:
        assert program.stderr is not None
        for line in program.stderr:
            messages += line
            if line.startswith("Ctrl-C"):
                program.send_signal(signal.SIGINT)
    return program.returncode, messages


# The server forks twice when it starts: for the door and for the reading process.
@pytest.mark.parametrize("fork", ["1", "2"])
def test_an_interrupt_at_a_fork_is_not_lost(tmp_path, fork):
    """Python ignores exceptions of functions that it calls at a fork: the server would continue."""
    status, messages = serve_interrupted(fork, "after_in_parent", tmp_path)
    # The status of a program that Ctrl-C ended, as shells report it.
    assert status == 128 + signal.SIGINT
    assert messages.splitlines() == ["polysight serve: starting", "polysight serve: stopped"]


def test_an_interrupt_in_a_new_process_causes_no_traceback(tmp_path):
    """Ctrl-C reaches all processes of a terminal, also one that has just been forked; the server ends that process."""
    status, messages = serve_interrupted("12", "after_in_child", tmp_path)
    assert status == 128 + signal.SIGINT
    assert "Traceback" not in messages
    assert "Exception ignored" not in messages


def test_an_interrupt_while_the_event_loop_is_made_ends_the_server_as_any_other(tmp_path):
    """Just after the address is printed, an interrupt could leave an unfinished event loop, with a traceback."""
    words = [sys.executable, "-c", INTERRUPT_IN_LOOP, "serve", str(tmp_path), "--port", "0"]
    environment = os.environ | {"XDG_STATE_HOME": str(tmp_path)}
    program = subprocess.run(words, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True)
    assert program.returncode == 128 + signal.SIGINT
    assert program.stderr.endswith("interrupted\npolysight serve: stopped\n")


@pytest.mark.parametrize(
    ("head", "is_answered"),
    [
        (b"POST /api/control/abort?scan=one HTTP/1.1\r\nX-Polysight-Token: right\r\n\r\n{}", True),
        (b"POST /api/control/abort?scan=one HTTP/1.1\r\nx-polysight-token:right\r\nHost: a\r\n\r\n", True),
        (b"POST /api/control/abort?scan=one HTTP/1.1\r\nX-Polysight-Token: wrong\r\n\r\n", False),
        # A head that has not ended, and a token in the body.
        (b"POST /api/control/abort?scan=one HTTP/1.1\r\nX-Polysight-Token: right\r\n", False),
        (b"POST /api/control/abort?scan=one HTTP/1.1\r\nHost: a\r\n\r\nX-Polysight-Token: right", False),
        # Not a command to a scan.
        (b"POST /api/notes?scan=one HTTP/1.1\r\nX-Polysight-Token: right\r\n\r\n", False),
    ],
)
def test_the_door_answers_only_whole_commands_with_the_right_token(head, is_answered):
    assert is_command(head, b"right") == is_answered


def test_the_token_survives_a_restart_and_no_other_user_can_read_it(scans, tmp_path, monkeypatch):
    with run_server(scans, tmp_path / "state") as server:
        token = server.token
        status, _, headers = ask(server, "/api/session", "POST", {}, **{TOKEN_HEADER: token})
        assert status == 200
        cookie = headers["set-cookie"]
    path = tmp_path / "state" / "polysight" / "token"
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.read_text() == token
    with run_server(scans, tmp_path / "state") as server:
        assert server.token == token
        _, _, headers = ask(server, "/api/session", "POST", {}, **{TOKEN_HEADER: token})
        # The cookie's name has the port, which is another one now; its secret follows from the token.
        assert cookie.partition("=")[2] == headers["set-cookie"].partition("=")[2]
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    path.chmod(0o644)
    with expect_refusal(ErrorCode.VALUE_INVALID, path):
        load_token()
    path.chmod(0o600)
    path.write_text(token[: TOKEN_BYTES - 1])
    with expect_refusal(ErrorCode.VALUE_INVALID, path):
        load_token()
    path.write_text(token[:TOKEN_BYTES])
    assert load_token() == token[:TOKEN_BYTES]


def test_behind_a_reverse_proxy_reading_needs_the_token_too(scans, tmp_path):
    """All its clients seem to come from this machine, so their address does not show who they are."""
    with run_server(scans, tmp_path / "state", "--allow-host", "lab.example.org") as server:
        token = {TOKEN_HEADER: server.token}
        for host in ("lab.example.org", "127.0.0.1"):
            for path in ("/api/scans", "/api/running"):
                assert ask(server, path, Host=host, X_Forwarded_For="10.0.0.7")[0] == 401
            assert ask(server, "/api/running", Host=host, **token)[0] == 200
            assert ask(server, "/", Host=host)[0] == 200
        assert ask(server, "/", Host="elsewhere.example.org", **token)[0] == 400


def test_a_missing_folder_of_scans_is_made_in_the_current_folder_only(tmp_path):
    """One elsewhere may be on a drive that is not mounted: scans would fill the drive below its mount point."""
    with run_server(Path("scans"), tmp_path) as server:
        assert get(server, "/api/scans")["scans"] == []
    assert (tmp_path / "scans").is_dir()
    for folder, control in ((tmp_path / "drive" / "scans", True), (Path("only-shown"), False)):
        with expect_refusal(ErrorCode.FILE_MISSING, folder, "mkdir -p"):
            serve(folder, ServerAddress(), config=None, control=control)
        assert not folder.exists()
    (tmp_path / "scene.toml").touch()
    with expect_refusal(ErrorCode.FILE_FOREIGN, tmp_path / "scene.toml", "is not a folder"):
        serve(tmp_path / "scene.toml", ServerAddress(), config=None, control=True)


@pytest.mark.parametrize("folder", ["scans", "pictures"])
def test_a_folder_of_something_else_than_a_scan_has_no_live_view(scans, folder):
    (scans.parent / "pictures").mkdir()
    (scans.parent / "pictures" / "one.jpg").touch()
    with expect_refusal(ErrorCode.FILE_FOREIGN, scans.parent / folder) as caught:
        preview(scans.parent / folder, ServerAddress(port=0), control=False)
    # For a folder of scans the error offers the scan in it.
    offers_scan = f"polysight preview {scans / 'one'}" in str(caught.value)
    assert offers_scan == (folder == "scans")


@pytest.mark.parametrize(("folder", "words"), [("ones", "did you mean 'one'"), ("tomorrow", "waits"), ("new", "waits")])
def test_the_live_view_reports_that_no_scan_has_begun(scans, capsys, monkeypatch, folder, words):
    """The scan may begin later, or the folder is mistyped. For the folder of a scan nothing is reported."""
    monkeypatch.setattr(server, "_run", lambda *_: 0)
    (scans / "new").mkdir()
    assert preview(scans / folder, ServerAddress(port=0), control=False) == 0
    assert preview(scans / "one", ServerAddress(port=0), control=False) == 0
    message = capsys.readouterr().err
    assert words in message
    assert message.count("note: ") == 1
