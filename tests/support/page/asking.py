"""HTTP requests to a server of the live view: usual ones, and any bytes."""

import hashlib
import http.client
import json
import socket
from pathlib import Path
from typing import Any

from polysight.serve.guard import TOKEN_HEADER
from tests.support.processes import HANG_S

TOKEN = "the-right-token"


def ask(
    view: Any, path: str, method: str = "GET", body: Any = None, **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    """Send a request; return status, body, and headers with names in lower case.

    A `body` that is not bytes is sent as JSON. In the names of `headers` an underscore stands for a hyphen.
    """
    connection = http.client.HTTPConnection("127.0.0.1", view.port, timeout=HANG_S)
    raw = body if isinstance(body, bytes | None) else json.dumps(body).encode()
    try:
        connection.request(method, path, raw, {k.replace("_", "-"): v for k, v in headers.items()})
        reply = connection.getresponse()
        return reply.status, reply.read(), {k.lower(): v for k, v in reply.getheaders()}
    finally:
        connection.close()


def get(view: Any, path: str, **headers: str) -> Any:
    """Return the JSON of a request that must succeed."""
    status, body, _ = ask(view, path, **headers)
    assert status == 200, (path, status, body)
    return json.loads(body)


def post(view: Any, path: str, body: Any = None, token: str = TOKEN, **headers: str) -> tuple[int, Any]:
    """Send a POST with the token; return status and JSON."""
    status, raw, _ = ask(view, path, "POST", {} if body is None else body, **{TOKEN_HEADER: token, **headers})
    return status, json.loads(raw)


def send_raw(view: Any, data: bytes, limit_s: float = HANG_S) -> bytes:
    """Send bytes; return everything received until the server closes the connection."""
    with socket.create_connection(("127.0.0.1", view.port), limit_s) as s:
        s.sendall(data)
        out = b""
        while part := _receive(s):
            out += part
        return out


def _receive(s: socket.socket) -> bytes:
    try:
        return s.recv(65536)
    except ConnectionResetError:
        return b""


def compute_digest(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file below a folder, or the target of a link, by name."""
    digests = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            digests[name] = f"-> {path.readlink()}"
        elif path.is_file():
            digests[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return digests
