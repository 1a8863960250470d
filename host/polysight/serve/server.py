"""`polysight serve` and `polysight preview`: bind, lower the priority, print the address, serve until Ctrl-C."""

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
from dataclasses import dataclass
from pathlib import Path

import uvicorn
from starlette.applications import Starlette

from polysight.catalogue import Scans
from polysight.page import Watch
from polysight.serve.app import make_app
from polysight.serve.connections import HEAD_BYTES, KEEP_ALIVE_S, MAX_CONNECTIONS, TimeoutProtocol
from polysight.serve.guard import Access
from polysight.serve.programs import Programs
from polysight.serve.site import Site
from polysight.serve.watches import Watches
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DeviceError

NICE = 10  # priority of the server, below capture and scan
_END_S = 1  # to close connections


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
    access = _access(place, listener, control)
    config = None if config is None else config.absolute()
    site = Site(Scans(root.absolute()), access, Watches(control), programs, config)
    threading.Thread(target=site.scans.list, name="first list", daemon=True).start()  # cached before the page asks
    return _run(site, place, listener, f"scans in {root}")


def preview(folder: Path, place: Place, control: bool) -> int:
    """Serve the live view of one scan folder until Ctrl-C; returns the exit status. Raises as :func:`serve`."""
    place.check()
    listener = _bind(place)
    lower_priority()
    folder = folder.absolute()
    watch = Watch(folder, control)
    watch.start()
    access = _access(place, listener, control)
    site = Site(Scans(folder.parent, folder.name), access, Watches(control, {folder.name: watch}))
    return _run(site, place, listener, f"live view of {folder}")


def _access(place: Place, listener: socket.socket, control: bool) -> Access:
    token = secrets.token_urlsafe(18) if control or not place.loopback else ""
    here = {place.host, socket.gethostname(), str(listener.getsockname()[0])}
    hosts = () if place.loopback else tuple(here - {"0.0.0.0", "::"})
    return Access(token, place.loopback, (*hosts, *place.hosts), control, place.certificate is not None)


def _run(site: Site, place: Place, listener: socket.socket, what: str) -> int:
    try:
        sys.stderr.write(_welcome(site, place, listener, what))
        sys.stderr.flush()
        server(make_app(site), site, place).run(sockets=[listener])
    finally:
        site.close()
        listener.close()
    return 0


def server(app: Starlette, site: Site, place: Place | None = None) -> uvicorn.Server:
    """Build a server with timeouts and without logging, which stops within a second."""
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    place = place or Place()
    config = uvicorn.Config(
        app,
        http=TimeoutProtocol,
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        proxy_headers=False,  # an address that a client claims to have is not its address
        server_header=False,
        h11_max_incomplete_event_size=HEAD_BYTES,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=_END_S,
        ssl_certfile=None if place.certificate is None else str(place.certificate),
        ssl_keyfile=None if place.key is None else str(place.key),
    )
    made = uvicorn.Server(config)
    site.ending = lambda: made.should_exit
    return made


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
        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 1 << 16), most))  # connections are files
    with contextlib.suppress(OSError):
        os.nice(NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _welcome(site: Site, place: Place, listener: socket.socket, what: str) -> str:
    host, port = str(listener.getsockname()[0]), listener.getsockname()[1]
    shown = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname(), "::1": "localhost"}.get(host, host)
    token, scheme = site.access.token, "http" if place.certificate is None else "https"
    address = f"{scheme}://[{shown}]:{port}/" if ":" in shown else f"{scheme}://{shown}:{port}/"
    lines = [f"{what}: {address}{f'#token={token}' if token else ''}"]
    if site.access.control:
        lines.append("anyone with this address and its token can start, pause and stop scans")
    else:
        lines.append("read-only; --control adds buttons to pause and stop the scan")
    if not place.loopback:
        plain = "; nothing is encrypted: --certificate and --key do that" if place.certificate is None else ""
        lines.append(f"anyone who reaches this machine and has the token can read all scans{plain}")
    return "\n".join(lines) + "\nCtrl-C ends the page; started programs go on\n"
