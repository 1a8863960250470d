"""`polysight serve` and `polysight preview`: the web application, its address, and the server until Ctrl-C.

uvicorn limits the number of connections and closes idle ones; each request passes the access checks of `guard`.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import resource
import secrets
import socket
import ssl
import sys
import threading
import traceback
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from polysight.catalogue import Scans
from polysight.page import Watch
from polysight.serve.control import control_routes
from polysight.serve.guard import HEAD_BYTES, Access, Guard, refuse
from polysight.serve.reading import reading_routes
from polysight.serve.site import Programs, Site, Watches
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError, DeviceError, PolysightError, os_error

STATIC = Path(__file__).parent / "static"
PAGES = {
    "/": "catalogue.html",
    "/scan": "scan.html",
    "/watch": "watch.html",
    "/new": "new.html",
    "/compare": "compare.html",
}
MEDIA_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
# Priority of the server, below capture and scan.
NICE = 10
# Connections that are answered at a time; a page holds up to six. Above it uvicorn answers 503.
MAX_CONNECTIONS = 2048
# Longer than the pages' intervals: a server that closes at the moment of the next request breaks it.
KEEP_ALIVE_S = 75
CLOSE_S = 1


@dataclass(frozen=True)
class Place:
    """Address of a server: port 0 is any that is free, `hosts` are further names, `certificate` and `key` PEM files."""

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


def serve(root: Path, place: Place, config: Path | None, control: bool = True) -> int:
    """Serve all scans under a folder until Ctrl-C; returns the exit status.

    Raises
    ------
    PolysightError
        if the folder or a file is missing, or the address cannot be bound.
    """
    place.check()
    if not root.is_dir():
        raise ConfigError(f"{root}: no such folder", "scans are listed under it", "make it, or give another")
    listener = _bind(place)
    programs = Programs() if control else None
    lower_priority()
    if config is not None:
        config = config.absolute()
    site = Site(Scans(root.absolute()), _access(place, listener, control), Watches(control), programs, config)
    # The list is cached before the page asks for it.
    threading.Thread(target=site.scans.list, name="first list", daemon=True).start()
    return _run(site, place, listener, f"scans in {root}")


def preview(folder: Path, place: Place, control: bool) -> int:
    """Serve the live view of one scan folder until Ctrl-C; returns the exit status. Raises as :func:`serve`."""
    place.check()
    listener = _bind(place)
    lower_priority()
    folder = folder.absolute()
    watch = Watch(folder, control)
    watch.start()
    watches = Watches(control, {folder.name: watch})
    site = Site(Scans(folder.parent, folder.name), _access(place, listener, control), watches)
    return _run(site, place, listener, f"live view of {folder}")


def _access(place: Place, listener: socket.socket, control: bool) -> Access:
    token = secrets.token_urlsafe(18) if control or not place.loopback else ""
    hosts = set(place.hosts)
    if not place.loopback:
        hosts |= {place.host, socket.gethostname(), str(listener.getsockname()[0])} - {"0.0.0.0", "::"}
    return Access(token, place.loopback, tuple(hosts), control, secure=place.certificate is not None)


def _bind(place: Place) -> socket.socket:
    family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((place.host, place.port))
        listener.listen(MAX_CONNECTIONS)
    except OSError as e:
        listener.close()
        raise DeviceError(
            f"{place.host}:{place.port} cannot be served: {e.strerror}",
            "another program holds this port, the address is not this machine's, or the port is below 1024",
            "give another --port; `ss -ltnp` shows who holds it",
        ) from None
    return listener


def lower_priority() -> None:
    """Give capture and scan the processor first, and have the kernel end this process first when memory runs out."""
    with contextlib.suppress(OSError, ValueError):
        # Connections are files.
        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 1 << 16), most))
    with contextlib.suppress(OSError):
        os.nice(NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _run(site: Site, place: Place, listener: socket.socket, what: str) -> int:
    try:
        sys.stderr.write(_welcome(site, place, listener, what))
        sys.stderr.flush()
        make_server(site, place).run(sockets=[listener])
    finally:
        site.close()
        listener.close()
    return 0


def _welcome(site: Site, place: Place, listener: socket.socket, what: str) -> str:
    host, port = listener.getsockname()[:2]
    name = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname(), "::1": "localhost"}.get(host, str(host))
    if ":" in name:
        name = f"[{name}]"
    scheme = "https" if site.access.secure else "http"
    token = f"#token={site.access.token}" if site.access.token else ""
    lines = [f"{what}: {scheme}://{name}:{port}/{token}"]
    if site.access.control:
        lines.append("anyone with this address and its token can start, pause and stop scans")
    else:
        lines.append("read-only; --control adds buttons to pause and stop the scan")
    if not place.loopback:
        plain = "" if site.access.secure else "; nothing is encrypted: --certificate and --key do that"
        lines.append(f"anyone who reaches this machine and has the token can read all scans{plain}")
    return "\n".join(lines) + "\nCtrl-C ends the page; started programs go on\n"


def make_server(site: Site, place: Place) -> uvicorn.Server:
    """Build the server of a site: limited, without logging, and stopping within a second."""
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    config = uvicorn.Config(
        make_app(site),
        http="h11",
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        # An address that a client claims to have is not its address.
        proxy_headers=False,
        server_header=False,
        h11_max_incomplete_event_size=HEAD_BYTES,
        limit_concurrency=MAX_CONNECTIONS,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=CLOSE_S,
        ssl_certfile=place.certificate,
        ssl_keyfile=place.key,
    )
    server = uvicorn.Server(config)
    site.is_ending = lambda: server.should_exit
    return server


# --- the application ---


def make_app(site: Site) -> Starlette:
    """Build the application of a site: static pages, GET and POST routes, error answers, behind the guard."""
    # They are small, and stay in memory.
    files = {
        path.name: Response(path.read_bytes(), media_type=MEDIA_TYPES[path.suffix])
        for path in STATIC.iterdir()
        if path.suffix in MEDIA_TYPES
    }
    files["favicon.ico"] = files["icon.svg"]

    async def show_page(request: Request) -> Response:
        path = request.url.path
        only = site.scans.only
        if path == "/" and only is not None:
            # A browser keeps the fragment, and the token in it.
            return RedirectResponse("/watch")
        if path in ("/scan", "/watch") and only is None and not request.query_params.get("scan"):
            return RedirectResponse("/")
        return files[PAGES[path]]

    async def send_file(request: Request) -> Response:
        answer = files.get(request.path_params["name"])
        if answer is not None:
            return answer
        return await _tell_no_page(request, DataError("no such file", "the address is wrong", "go to the first page"))

    routes = [Route(path, show_page) for path in PAGES]
    routes.append(Route("/{name}", send_file))
    routes += reading_routes(site) + control_routes(site)
    return Starlette(
        routes=routes,
        middleware=[Middleware(Guard, access=site.access)],
        exception_handlers={
            PolysightError: _tell_error,
            OSError: _tell_error,
            ClientDisconnect: _tell_nobody,
            404: _tell_no_page,
            Exception: _tell_defect,
        },
    )


async def _tell_error(request: Request, e: Exception) -> Response:
    # A file that cannot be written or read is no defect of this program.
    error = os_error(e) if isinstance(e, OSError) else e
    if not isinstance(error, PolysightError):
        raise e
    wrong_values = (ErrorCode.VALUE_INVALID, ErrorCode.VALUES_CONFLICT, ErrorCode.TYPE_WRONG, ErrorCode.KEY_MISSING)
    if isinstance(error, ConfigError) or (request.method == "POST" and error.code in wrong_values):
        status = 400
    elif isinstance(error, DataError):
        status = 404
    elif isinstance(error, DeviceError) and error.code is ErrorCode.NO_ANSWER:
        status = 503
    else:
        status = 409
    return refuse(status, error.code, error.what, error.why, error.remedy)


async def _tell_nobody(request: Request, e: Exception) -> Response:
    """The client disconnected in the middle of its request."""
    del request, e
    return Response(status_code=400)


async def _tell_no_page(request: Request, e: Exception) -> Response:
    del request, e
    return refuse(404, ErrorCode.OTHER, "There is no such page", "the address is wrong", "begin at the list of scans")


async def _tell_defect(request: Request, e: Exception) -> Response:
    sys.stderr.write(f"{request.method} {request.url.path}\n{''.join(traceback.format_exception(e))}")
    sys.stderr.flush()
    what = f"An internal error of the server: {type(e).__name__}"
    do = "report it, with the server's terminal output"
    return refuse(500, ErrorCode.OTHER, what, "a defect of this program", do)
