"""`polysight serve` and `polysight preview`: the address, the token, and the processes until Ctrl-C.

Three processes: this one answers requests for pages (`front`), a second one accepts connections and answers commands to
scans immediately (`door`; only with control, and without TLS, which hides the requests; otherwise this one does
both), and the reading process reads scans, behind a socket in a folder that only this user may enter. This process
starts the other two, restarts the reading process if it ends, and prints the server's addresses with the token, what
they allow, and a QR code for a phone.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import multiprocessing
import os
import secrets
import signal
import socket
import ssl
import stat
import struct
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import connection, resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.types import ASGIApp

from polysight.catalogue import NOTES_FILE, Scans, is_scan
from polysight.page import Watch
from polysight.serve.commands import command_routes, start_waiting
from polysight.serve.door import PagesServer, close_after_each, open_door
from polysight.serve.front import (
    BACKLOG,
    EndingServer,
    Front,
    Reader,
    make_app,
    make_command_app,
    make_counting_protocol,
)
from polysight.serve.guard import HANDLERS, HEAD_BYTES, Access
from polysight.serve.programs import Programs
from polysight.serve.reading import reading_routes
from polysight.serve.site import HIDDEN, Site, Watches
from polysight.serve.stage import StageControl
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode, quote, suggest_word
from polysight_shared.program import delay_interrupts, ignore_interrupts

# Nice value of the reading process, chosen: capture and scan have priority over it.
NICE = 10
# A browser opens up to six connections for a page. The number is chosen.
MAX_CONNECTIONS = 2048
# Connections that the event loop accepts in one round, before it reads from those that it has; chosen.
ACCEPTED_AT_ONCE = 128
# Idle connections are closed when there are too many, never for their age.
KEEP_ALIVE_S = 10**6
# Time that open connections have to end when the server stops; chosen.
CLOSE_S = 1
# Pause before the reading process is started again, so that one that fails immediately takes no processor.
RESTART_S = 1.0
# The cached list of scans, in the hidden folder of the scans.
LIST_INDEX = "list.json"
# Random bytes of a token: 144 bits, 24 characters in an address.
TOKEN_BYTES = 18


@dataclass(frozen=True)
class ServerAddress:
    """Address of a server: port 0 is any free one, `hosts` are further names, `certificate` and `key` PEM files."""

    host: str = "127.0.0.1"
    port: int = 8080
    hosts: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None

    @property
    def loopback(self) -> bool:
        """True if only this machine can reach the address."""
        try:
            return self.host == "localhost" or ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    def check(self) -> None:
        """Raise ConfigError for files of TLS that are missing, do not belong together or need a passphrase."""
        if self.certificate is None and self.key is None:
            return
        if self.certificate is None or self.key is None:
            raise ConfigError("--certificate and --key", "TLS needs both", "give both, or none")
        for path in (self.certificate, self.key):
            if not path.is_file():
                raise ConfigError(
                    f"{path}: no such file", "TLS needs a certificate and its key", "give PEM files",
                    code=ErrorCode.FILE_MISSING,
                )  # fmt: skip
        try:
            # An empty passphrase, or OpenSSL would ask for one at the terminal.
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(self.certificate, self.key, password="")
        except (OSError, ValueError) as e:
            raise ConfigError(
                f"{self.certificate} and {self.key}: cannot be used for TLS: {getattr(e, 'reason', None) or e}",
                "they are not PEM, do not belong together, are swapped, or the key has a passphrase",
                "give a certificate and its key without passphrase (openssl rsa -in KEY -out PLAIN)",
                code=ErrorCode.FILE_FOREIGN,
            ) from None


@dataclass(frozen=True)
class ServedScans:
    """Served scans: a folder of scans, or `only` one in it; programs are started with the rig file `config`."""

    root: Path
    only: str | None
    control: bool
    config: Path | None = None

    @property
    def starts(self) -> bool:
        """True if programs and scans can be started from the page."""
        return self.control and self.only is None and self.config is not None


def serve(root: Path, address: ServerAddress, config: Path | None, control: bool = True) -> int:
    """Serve all scans under a folder until Ctrl-C; returns the exit status.

    Raises
    ------
    PolysightError
        if the folder or a file of TLS is missing, the token's file is unsafe, or the address cannot be bound.
    """
    if not root.is_dir():
        _make_folder(root, control)
    if config is not None:
        config = config.absolute()
    shown_scans = ServedScans(root.absolute(), None, control, config)
    return _run(shown_scans, address, f"scans in {root}")


def _make_folder(root: Path, control: bool) -> None:
    """Make the folder of scans here. Raises ConfigError for one elsewhere, or without control."""
    if root.exists():
        raise ConfigError(
            f"{root}: is not a folder", "scans are listed under a folder", "give the folder of the scans",
            code=ErrorCode.FILE_FOREIGN,
        )  # fmt: skip
    if not control or root.absolute().parent != Path.cwd():
        raise ConfigError(
            f"{root}: no such folder",
            "scans are listed under it; a folder elsewhere may be on a drive that is not mounted, so it is not created",
            f"mkdir -p {quote(root)}, or give another",
            code=ErrorCode.FILE_MISSING,
        )
    root.mkdir()
    sys.stderr.write(f"polysight serve: made the folder {root}\n")


def preview(folder: Path, address: ServerAddress, control: bool) -> int:
    """Serve the live view of one scan folder, which may not exist yet, until Ctrl-C; returns the exit status.

    Raises as :func:`serve`; DataError for a folder that holds something else than a scan.
    """
    _check_scan_folder(folder)
    folder = folder.absolute()
    return _run(ServedScans(folder.parent, folder.name, control), address, f"live view of {folder}")


def _check_scan_folder(folder: Path) -> None:
    """Say on stderr that there is no scan yet. Raises DataError for a folder in which no scan can begin."""
    if is_scan(folder):
        return
    if not folder.exists():
        note = f"note: {folder} does not exist yet"
        try:
            question = suggest_word(folder.name, [path.name for path in folder.absolute().parent.iterdir()])
        except OSError:
            question = f"{folder.parent} does not exist either"
        sys.stderr.write(f"{note}; {question or 'the page waits for a scan to begin there'}\n")
        return
    other_files = [path.name for path in folder.iterdir() if path.name != NOTES_FILE and not path.name.startswith(".")]
    if not other_files:
        sys.stderr.write(f"note: {folder} contains no scan yet; the page waits until a scan begins\n")
        return
    remedy = "give the folder of one scan"
    scans_below = Scans(folder).list()
    if scans_below:
        newest = folder / scans_below[0].name
        remedy += f": polysight preview {quote(newest)}; polysight serve {quote(folder)} shows them all"
    raise DataError(
        f"{folder}: contains no scan, but {other_files[0]}", "each scan needs its own folder", remedy,
        code=ErrorCode.FILE_FOREIGN,
    )  # fmt: skip


def _run(shown: ServedScans, address: ServerAddress, what: str) -> int:
    """Serve until Ctrl-C: bind, start the other processes, print the address of `what`; return 0."""
    address.check()
    listener = _bind(address)
    try:
        access = make_access(address, listener, shown.control)
        with contextlib.ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="polysight-"))
            stage = None
            if shown.starts and shown.config is not None:
                stage = StageControl(shown.config)
            reader = Reader(Path(folder) / "reader")
            front = Front(Scans(shown.root, shown.only), access, shown.starts, reader, stage)
            _allow_files()
            reading = stack.enter_context(fork_first_reader(shown, Path(folder) / "reader", listener))
            door = None
            if access.control and not access.secure:
                # One request per connection: the door looks for commands in the first bytes of a connection only.
                commands = close_after_each(make_command_app(front))
                door = stack.enter_context(open_door(listener, access.token, _configure(commands)))
            stack.enter_context(_keep_reading_process(reading, shown, Path(folder) / "reader"))
            sys.stderr.write(describe_server(access, what, listener.getsockname()[:2]))
            sys.stderr.flush()
            server = make_server(front, address, door)
            # By itself it handles signals only once its event loop runs: Ctrl-C before that would interrupt the
            # creation of the loop, and leave it unfinished.
            with server.capture_signals():
                server.run(sockets=[listener])
    finally:
        listener.close()
    return 0


def make_access(address: ServerAddress, listener: socket.socket, control: bool) -> Access:
    """Return the access rules of the page; a token is required for control and for other machines."""
    # Behind a reverse proxy all clients have this machine's address.
    is_private = address.loopback and not address.hosts
    token = ""
    if control or not is_private:
        token = load_token()
    hosts = set(address.hosts)
    if not address.loopback:
        hosts |= {address.host, socket.gethostname(), str(listener.getsockname()[0])} - {"0.0.0.0", "::"}
    return Access(token, is_private, tuple(hosts), control, secure=address.certificate is not None)


def load_token() -> str:
    """Return the token of this user's servers, made at the first call: open pages keep control when a server restarts.

    Raises ConfigError if its file can be read by others, is another user's, not a plain file, or too short. If it is
    removed, the next server makes and prints a new one.
    """
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    path = Path(state) / "polysight" / "token"
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with contextlib.suppress(FileExistsError):
        part = path.with_name(f".token.{os.getpid()}")
        part.unlink(missing_ok=True)
        descriptor = os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
        with os.fdopen(descriptor, "w", encoding="ascii") as f:
            f.write(secrets.token_urlsafe(TOKEN_BYTES))
        # If two servers start at the same time, one of them makes the complete file, and the link of the other fails.
        try:
            os.link(part, path)
        finally:
            part.unlink()
    status = path.lstat()
    token = path.read_text(encoding="ascii", errors="replace").strip()
    is_safe = stat.S_ISREG(status.st_mode) and not status.st_mode & 0o077 and status.st_uid == os.getuid()
    # A token has 24 characters. One with fewer than `TOKEN_BYTES` was edited.
    if not is_safe or len(token) < TOKEN_BYTES:
        raise ConfigError(
            f"{path} cannot be used as a token", "other users may read it, another user owns it, or it was edited",
            "remove it: the next start makes another", code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return token


def _bind(address: ServerAddress) -> socket.socket:
    """Open the socket that listens. Raises DeviceError if the port is taken or not allowed."""
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((address.host, address.port))
        listener.listen(BACKLOG)
    except OSError as e:
        listener.close()
        raise DeviceError(
            f"{address.host}:{address.port} cannot be served: {e.strerror}",
            "another program uses this port, the address is not this machine's, or the port is below 1024",
            "give another --port; `ss -ltnp` shows which program uses it",
        ) from None
    return listener


@contextlib.contextmanager
def _keep_reading_process(first: BaseProcess, shown: ServedScans, path: Path) -> Iterator[None]:
    """Keep the reading process running for the block: the `first` one, which runs already, and others after it."""
    ended = threading.Event()
    # Threads do not survive a fork, and there are some now.
    context = multiprocessing.get_context("spawn")

    def keep_running() -> None:
        process = first
        while True:
            # `ended` is checked every 0.2 s (chosen).
            while process.is_alive() and not ended.is_set():
                process.join(0.2)
            if ended.wait(RESTART_S):
                process.terminate()
                process.join()
                return
            process = context.Process(target=run_reader, args=(shown, path), name="reading", daemon=True)
            # Start multiprocessing's resource tracker here: started by `start`, it would unblock Ctrl-C.
            resource_tracker.ensure_running()
            with delay_interrupts():
                process.start()

    keeper = threading.Thread(target=keep_running, name="keeper", daemon=True)
    keeper.start()
    try:
        yield
    finally:
        ended.set()
        keeper.join(10)


@contextlib.contextmanager
def fork_first_reader(shown: ServedScans, path: Path, listener: socket.socket) -> Iterator[BaseProcess]:
    """Fork the reading process for the block: it has what this process has loaded, and answers two seconds sooner.

    To be called before there are threads. The server's address is not its own: it closes `listener`. It ends before the
    folder of its socket is removed, also when Ctrl-C comes while it starts.
    """

    def run() -> None:
        listener.close()
        run_reader(shown, path)

    process = multiprocessing.get_context("fork").Process(target=run, name="reading", daemon=True)
    try:
        with delay_interrupts():
            process.start()
        yield process
    finally:
        if process.pid is not None:
            process.terminate()
            process.join()


def run_reader(shown: ServedScans, path: Path) -> None:
    """Run the reading process until it is ended, or the process that started it has ended."""
    # Ctrl-C ends the server, which ends this process; without this line it would end first, with a traceback.
    ignore_interrupts(signal.SIGINT)
    programs = None
    # Before the priority is lowered: started programs keep the present one.
    if shown.control and shown.only is None:
        programs = Programs()
    lower_priority()
    watches = Watches(shown.control)
    if shown.only is not None:
        watch = Watch(shown.root / shown.only, shown.control)
        watch.start()
        watches = Watches(shown.control, {shown.only: watch})
    index = None
    if shown.only is None:
        index = shown.root / HIDDEN / LIST_INDEX
    site = Site(Scans(shown.root, shown.only, index), watches, programs, shown.config)
    # The list is cached before the page asks for it.
    threading.Thread(target=site.scans.read_in_parts, name="first list", daemon=True).start()
    path.unlink(missing_ok=True)
    server = EndingServer(_configure(make_reader_app(site), uds=str(path)))
    site.is_ending = lambda: server.should_exit
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            connection.wait([parent.sentinel])
            server.should_exit = True

    threading.Thread(target=end_with_parent, name="parent", daemon=True).start()
    try:
        server.run()
    finally:
        site.close()


def make_reader_app(site: Site) -> Starlette:
    """Build the application of the reading process, with its queue of scans that wait; only `front` reaches it."""
    site.open_queue(lambda request: start_waiting(site, request))
    return Starlette(routes=reading_routes(site) + command_routes(site), exception_handlers=HANDLERS)


def lower_priority() -> None:
    """Give capture and scan the processor first, and have the kernel end this process first when memory runs out."""
    with contextlib.suppress(OSError):
        os.nice(NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _configure(app: ASGIApp, **more: object) -> uvicorn.Config:
    """Return the settings of all three servers: without logging, and stopping within `CLOSE_S`."""
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    return uvicorn.Config(
        app,
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        # An address that a client claims to have is not its address.
        proxy_headers=False,
        server_header=False,
        h11_max_incomplete_event_size=HEAD_BYTES,
        timeout_graceful_shutdown=CLOSE_S,
        **more,  # type: ignore[arg-type]
    )


def make_server(front: Front, address: ServerAddress, door: socket.socket | None = None) -> uvicorn.Server:
    """Build the server of the pages: it accepts connections, or takes them from the `door`."""
    app: ASGIApp = make_app(front)
    if door is not None:
        app = close_after_each(app)
    protocol = make_counting_protocol(MAX_CONNECTIONS)
    config = _configure(
        app,
        http=protocol,
        # Reached only when every connection has a request at work: then it answers 503. Connections that were
        # closed a moment ago still count there.
        limit_concurrency=MAX_CONNECTIONS + 2 * ACCEPTED_AT_ONCE,
        backlog=ACCEPTED_AT_ONCE,
        timeout_keep_alive=KEEP_ALIVE_S,
        ssl_certfile=address.certificate,
        ssl_keyfile=address.key,
    )
    if door is not None:
        return PagesServer(config, door, protocol)
    return EndingServer(config)


def _allow_files() -> None:
    """Allow as many open files as the system does, at most 65,536 (chosen): connections are files."""
    with contextlib.suppress(OSError, ValueError, ModuleNotFoundError):
        # A module of POSIX systems: the page's results are read on laptops, too.
        import resource

        _, max_files = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(max_files, 1 << 16), max_files))


# --- the text that a server prints when it starts ---

# linux/sockios.h
SIOCGIFADDR = 0x8915
# A documentation address (RFC 5737) and any port: it represents every network that is reached by the default route.
REMOTE_ADDRESS = ("203.0.113.1", 9)
# One character shows two modules of the code, the keys say whether the upper and the lower one are dark. Colours are
# given, black on white, since the terminal's own may be either way round and a camera reads no inverted code.
HALF_BLOCKS = {(0, 0): " ", (1, 0): "\u2580", (0, 1): "\u2584", (1, 1): "\u2588"}
BLACK_ON_WHITE = "\033[38;5;16;48;5;231m"
RESET = "\033[0m"


def describe_server(access: Access, what: str, bound: tuple[str, int]) -> str:
    """Return the text for a server of `what` ("scans") on the address and port to which its socket is `bound`."""
    host, port = bound
    if host in ("0.0.0.0", "::"):
        names = [*find_addresses(), socket.gethostname()]
    else:
        names = [host]
    scheme = "https" if access.secure else "http"
    token = f"#token={access.token}" if access.token else ""
    addresses = [f"{scheme}://{f'[{name}]' if ':' in name else name}:{port}/{token}" for name in names]
    lines = [f"{what}: {addresses[0]}"]
    if addresses[1:]:
        lines.append("in other networks of this machine, or by its name:")
        lines += [f"  {address}" for address in addresses[1:]]
    if access.control:
        lines.append("anyone with this address and its token can start, pause and stop scans")
    else:
        lines.append("read-only; buttons come with `serve` without --read-only, or `preview` with --control")
    if not ipaddress.ip_address(host).is_loopback:
        warning = "" if access.secure else "; nothing is encrypted; --certificate and --key add encryption"
        lines.append(f"anyone who reaches this machine and has the token can read all scans{warning}")
        if sys.stderr.isatty():
            lines.append(draw_code(addresses[0]))
    lines.append("Ctrl-C ends the page; programs that it started continue\n")
    return "\n".join(line for line in lines if line)


def find_addresses() -> list[str]:
    """Return the IPv4 addresses of this machine in its networks, that of the default route first.

    An interface with several addresses counts with its first. Other systems than Linux give that of the default route.
    """
    addresses: list[str] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        with contextlib.suppress(OSError):
            # A datagram socket that is connected sends nothing, and gets the address it would send from.
            probe.connect(REMOTE_ADDRESS)
            addresses.append(probe.getsockname()[0])
        with contextlib.suppress(OSError, ModuleNotFoundError):
            # A module of POSIX systems; this file is imported on others, too.
            import fcntl

            for _, interface in socket.if_nameindex():
                with contextlib.suppress(OSError):
                    answer = fcntl.ioctl(probe, SIOCGIFADDR, struct.pack("256s", interface.encode()))
                    # struct ifreq: name (16 bytes), family and port (4), address.
                    addresses.append(socket.inet_ntoa(answer[20:24]))
    return [address for address in dict.fromkeys(addresses) if not ipaddress.ip_address(address).is_loopback]


def draw_code(address: str) -> str:
    """Draw the address as a QR code, two rows of modules a line; "" without the library."""
    try:
        import segno
    except ImportError:
        return ""
    rows = [*segno.make(address, error="l").matrix_iter()]
    if len(rows) % 2:
        rows.append(bytearray(len(rows)))
    lines = []
    for upper, lower in zip(rows[::2], rows[1::2], strict=True):
        blocks = "".join(HALF_BLOCKS[pair] for pair in zip(upper, lower, strict=True))
        lines.append(f"{BLACK_ON_WHITE}{blocks}{RESET}")
    return "\n".join(lines)
