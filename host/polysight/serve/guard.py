"""Access checks of every request: Host, Origin, token, size of head and body; safe headers on every answer.

One middleware in front of the application. Reading below /api/ needs the token too, unless the server is bound to
loopback without further host names. The token comes in a header, which no form, link or image of another page can send;
requests that only read (images, event streams) may bring the session's cookie instead. How many connections may be open
is limited in `front`.

`HANDLERS` turn errors into answers: a code for programs and the three parts that people read.
"""

from __future__ import annotations

import hmac
import ipaddress
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request, cookie_parser
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode, PolysightError, convert_os_error

TOKEN_HEADER = "X-Polysight-Token"
# Largest head (address and headers) and largest body of a request; chosen, far above what the page sends.
HEAD_BYTES = 1 << 14
BODY_BYTES = 1 << 16
# Headers of every answer: a browser loads nothing from elsewhere, shows the page in no frame, and stores nothing.
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob:; object-src 'none'; base-uri 'none';"
    " form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Cache-Control": "no-store",
}
# With these a page finds out that its token is missing.
OPEN_PATHS = ("/api/page",)


@dataclass(frozen=True)
class Access:
    """Access rules of one server.

    Attributes
    ----------
    token
        Needed for control, and for reading below /api/ unless `loopback`; "": no one controls, everyone reads.
    loopback
        True if the server is bound to this machine only, and has no further names: behind a proxy, which needs one,
        requests of all machines come from this one.
    hosts
        Further host names of the server.
    control
        True if POST requests other than `/api/session` are allowed.
    secure
        True with TLS.
    """

    token: str = ""
    loopback: bool = True
    hosts: tuple[str, ...] = ()
    control: bool = False
    secure: bool = False

    @property
    def session(self) -> str:
        """Secret of the session cookie: it follows from the token, and so survives a restart as that does."""
        return hmac.new(self.token.encode(), b"session of the operator's page", "sha256").hexdigest()

    def accepts_host(self, host: str) -> bool:
        """True if a `Host` header has a name of this server or any address; bound to loopback, a loopback address."""
        name = read_host_name(host)
        if name in ("localhost", *self.hosts):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        # A page of another site reaches this server by a name of its own that resolves here, and not by an address.
        return address.is_loopback or not self.loopback

    def has_token(self, headers: Headers) -> bool:
        """True if the request has the token; compared in constant time."""
        token = headers.get(TOKEN_HEADER, "")
        return bool(self.token) and hmac.compare_digest(token.encode(), self.token.encode())

    def has_session(self, scope: Scope) -> bool:
        """True if the request has the session's cookie; compared in constant time."""
        if not self.token:
            return False
        cookies = cookie_parser(Headers(scope=scope).get("cookie", ""))
        return hmac.compare_digest(cookies.get(cookie_name(scope), "").encode(), self.session.encode())


def read_host_name(host: str) -> str:
    """Return the name or address in a `Host` header, without its port."""
    if host.startswith("["):
        return host[1:].partition("]")[0]
    if ":" in host:
        return host.rpartition(":")[0]
    return host


def cookie_name(scope: Scope) -> str:
    """Name of the session's cookie, with the port that is served: servers on other ports of a machine share cookies."""
    _, port = scope.get("server") or ("", 0)
    return f"polysight-{port or 0}"


class Guard:
    """The middleware; `app` sees only requests that pass."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse the request, or pass it on."""
        if scope["type"] != "http":
            return
        headers = Headers(scope=scope)
        refusal = self._check_head(scope, headers) or self._check_token(scope, headers)
        if refusal is None and scope["method"] == "POST":
            body = await _read_body(receive)
            receive = _replay(body or b"", receive)
            if body is None:
                refusal = refuse_body()
        application = self._app
        if refusal:
            application = _close_after(refusal)
        await application(scope, receive, _add_headers(send))

    def _check_head(self, scope: Scope, headers: Headers) -> Response | None:
        """Return the refusal of a request for its size, host, method or origin; None if these are allowed."""
        method = scope["method"]
        line_bytes = len(scope.get("raw_path") or scope["path"]) + len(scope.get("query_string", b""))
        if line_bytes + sum(len(name) + len(value) for name, value in scope["headers"]) > HEAD_BYTES:
            problem = f"The head is longer than {HEAD_BYTES} bytes"
            return refuse(431, ErrorCode.MESSAGE_INVALID, problem, "no page sends so much", "send less")
        if not self._access.accepts_host(headers.get("host", "")):
            return refuse(
                400, ErrorCode.HOST_UNKNOWN, "This server has another name", "the request names another host",
                "open the address that it printed; --allow-host NAME adds one",
            )  # fmt: skip
        is_api = scope["path"].startswith("/api/")
        schemes = [scope.get("scheme", "http")]
        if read_host_name(headers.get("host", "")) in self._access.hosts:
            # A declared name may be a proxy's, where the encryption ends.
            schemes.append("https")
        if method not in ("GET", "HEAD", "POST") or (method == "POST" and not is_api):
            return refuse(405, ErrorCode.MESSAGE_INVALID, f"{method} is not supported here", "", "use the page")
        if is_api and not _is_same_site(headers, schemes, writes=method == "POST"):
            return refuse(
                403, ErrorCode.ORIGIN_FOREIGN, "The request comes from a page of another site", "only this server's own"
                " pages may ask", "use the page that this server serves",
            )  # fmt: skip
        # int() may refuse thousands of digits; a body with a length of 19 or more digits is measured while it is read.
        length = headers.get("content-length", "0")
        if length.isdecimal() and len(length) < 19 and int(length) > BODY_BYTES:
            return refuse_body()
        return None

    def _check_token(self, scope: Scope, headers: Headers) -> Response | None:
        """Return the refusal of a request without the token or session that it needs; None if it is allowed."""
        access = self._access
        path = scope["path"]
        if scope["method"] != "POST":
            is_open = access.loopback or not access.token or path in OPEN_PATHS or not path.startswith("/api/")
            if is_open or access.has_session(scope) or access.has_token(headers):
                return None
            return _refuse_token(401)
        if not access.control and path != "/api/session":
            return refuse(
                403, ErrorCode.READ_ONLY, "This view is read-only", "it was started so",
                "for buttons start `serve` without --read-only, or `preview` with --control",
            )  # fmt: skip
        if access.has_token(headers):
            return None
        return _refuse_token(403)


async def _read_body(receive: Receive) -> bytes | None:
    """Return the body of a request; None if it is too large. It is incomplete if the client disconnected."""
    body = bytearray()
    while True:
        message = await receive()
        body += message.get("body", b"")
        if len(body) > BODY_BYTES:
            return None
        if not message.get("more_body", False):
            return bytes(body)


def _replay(body: bytes, receive: Receive) -> Receive:
    """Give the application a body that was read already."""
    waiting = [body]

    async def receive_again() -> Message:
        if waiting:
            return {"type": "http.request", "body": waiting.pop(), "more_body": False}
        return await receive()

    return receive_again


def refuse_body() -> Response:
    """Return the refusal of a body that is too large."""
    problem = f"More than {BODY_BYTES} bytes"
    return _close_after(refuse(413, ErrorCode.MESSAGE_INVALID, problem, "no page sends so much", "send less"))


def _close_after(answer: Response) -> Response:
    """Return the answer, after which the connection is closed: the rest of the request is not read."""
    answer.headers["Connection"] = "close"
    return answer


def _refuse_token(status: int) -> Response:
    """Return the refusal of a request with a wrong or missing token."""
    return refuse(
        status, ErrorCode.TOKEN_WRONG, "The token is wrong or missing", "the address was opened without it, or it was"
        " replaced", "open the address that the server printed when it started",
    )  # fmt: skip


def _is_same_site(headers: Headers, schemes: Sequence[str], writes: bool) -> bool:
    """True if the request comes from a page of this server, or from no page."""
    if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
        return False
    origin = headers.get("origin")
    if origin is None:
        return True
    parts = urlsplit(origin)
    if parts.netloc == headers.get("host", "") and parts.scheme in schemes:
        return True
    # A browser that sends Sec-Fetch-Site has vouched for a request that only reads.
    return not writes and "sec-fetch-site" in headers


def _add_headers(send: Send) -> Send:
    """Add the security headers to every answer."""

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return send_with_headers


def refuse(status: int, code: ErrorCode, problem: str, why: str, do: str) -> Response:
    """Return an error as JSON: its code, and the three parts for people."""
    return JSONResponse({"code": code, "what": problem, "why": why, "do": do}, status)


async def answer_error(request: Request, e: Exception) -> Response:
    """Answer with an error that was raised. A file that cannot be written or read is not a defect of this program."""
    if isinstance(e, OSError):
        error = convert_os_error(e)
    else:
        error = e
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


# The page for a mistyped address. No script: it has nothing to ask.
NO_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>No such page · polysight</title>
<link rel="icon" href="/icon.svg">
<link rel="stylesheet" href="/base.css">
</head>
<body>
<main id="main">
<h1>There is no such page</h1>
<p>The address is wrong. Begin at <a href="/">the list of scans</a>.</p>
</main>
</body>
</html>
"""


async def answer_no_page(request: Request, e: Exception) -> Response:
    """Answer for an address that does not exist: with a page to a browser, as JSON to a program."""
    del e
    if not request.url.path.startswith("/api/") and "text/html" in request.headers.get("accept", ""):
        return HTMLResponse(NO_PAGE, 404)
    return refuse(404, ErrorCode.OTHER, "There is no such page", "the address is wrong", "begin at the list of scans")


async def _answer_disconnected(request: Request, e: Exception) -> Response:
    """Answer a client that disconnected in the middle of its request."""
    del request, e
    return Response(status_code=400)


async def _answer_defect(request: Request, e: Exception) -> Response:
    """Answer for an exception that nothing has foreseen; its traceback goes to stderr."""
    sys.stderr.write(f"{request.method} {request.url.path}\n{''.join(traceback.format_exception(e))}")
    sys.stderr.flush()
    problem = f"An internal error of the server: {type(e).__name__}"
    do = "report it, with the server's terminal output"
    return refuse(500, ErrorCode.OTHER, problem, "a defect of this program", do)


HANDLERS: dict[Any, Any] = {
    PolysightError: answer_error,
    OSError: answer_error,
    ClientDisconnect: _answer_disconnected,
    404: answer_no_page,
    Exception: _answer_defect,
}
