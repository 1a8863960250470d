"""Access checks of every request: Host, Origin, token, rate of wrong tokens, size and time of the body; safe headers.

One middleware in front of the application. Reading needs the token too unless the server is bound to loopback. The
token comes in a header, which no form, link or image of another page can send; requests that only read (images, event
streams) may bring the session's cookie instead.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import secrets
import time
from collections import OrderedDict
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from polysight.serve.connections import HEAD_BYTES, TRUSTED
from polysight_shared.error_codes import ErrorCode

TOKEN_HEADER = "X-Polysight-Token"
BODY_BYTES, BODY_S = 1 << 16, 10.0
TRIES, TRIES_A_SECOND = 20.0, 5.0
"""Wrong tokens that one address may send at once, and per second; requests with an open session are not limited."""
_ADDRESSES = 4096  # remembered at most
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
_OPEN_PATHS = ("/api/session", "/api/page")  # with these a page finds out that its token is missing


@dataclass(frozen=True)
class Access:
    """Access rules of one server.

    Attributes
    ----------
    token
        Needed for control, and for reading unless `loopback`; "": nobody controls, everybody reads.
    loopback
        True if the server is bound to this machine only.
    hosts
        Further host names of the server.
    control
        True if POST requests are allowed.
    secure
        True with TLS.
    session
        Secret of the session cookie, new at each start of the server.
    """

    token: str = ""
    loopback: bool = True
    hosts: tuple[str, ...] = ()
    control: bool = False
    secure: bool = False
    session: str = field(default_factory=lambda: secrets.token_urlsafe(18))

    def knows_host(self, host: str) -> bool:
        """True if a `Host` header names this server (a foreign name that resolves to it does not)."""
        name = _name_of(host)
        if name in ("localhost", *self.hosts):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return address.is_loopback or not self.loopback  # an address: no foreign name led here

    def holds_token(self, headers: Headers) -> bool:
        """True if the request has the token; compared in constant time."""
        given = headers.get(TOKEN_HEADER, "")
        return bool(self.token) and hmac.compare_digest(given.encode(), self.token.encode())

    def holds_session(self, scope: Scope) -> bool:
        """True if the request has the cookie of an open session."""
        given = cookie_parser(Headers(scope=scope).get("cookie", "")).get(cookie_name(scope), "")
        return hmac.compare_digest(given.encode(), self.session.encode())


def cookie_name(scope: Scope) -> str:
    """Name of the session's cookie, with the port that is served: servers on other ports of a machine share cookies."""
    return f"polysight-{(scope.get('server') or ('', 0))[1] or 0}"


def _name_of(host: str) -> str:
    """`Host` without its port."""
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.rpartition(":")[0] if ":" in host else host


class WrongTokens:
    """Counts wrong tokens by address: each has a bucket of tries that fills again."""

    def __init__(self) -> None:
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def spent(self, address: str) -> bool:
        """True if this address must wait."""
        return self._left(address) < 1

    def note(self, address: str) -> None:
        """One more wrong token."""
        self._buckets[address] = (self._left(address) - 1, time.monotonic())
        self._buckets.move_to_end(address)
        while len(self._buckets) > _ADDRESSES:
            self._buckets.popitem(last=False)

    def _left(self, address: str) -> float:
        left, at = self._buckets.get(address, (TRIES, 0.0))
        return min(TRIES, left + (time.monotonic() - at) * TRIES_A_SECOND)


class Guard:
    """The middleware; `app` sees nothing that does not pass."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access
        self._wrong = WrongTokens()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse the request, or pass it on."""
        if scope["type"] != "http":
            return
        headers = Headers(scope=scope)
        refusal = self._refusal(scope, headers)
        scope[TRUSTED] = self._access.holds_token(headers) or self._access.holds_session(scope)
        if refusal is not None:
            await _closing(refusal)(scope, receive, _with_headers(send))
            return
        try:
            await self._app(scope, _limited(receive), _with_headers(send))
        except BodyError as e:
            answer = refused(e.status, ErrorCode.MESSAGE_INVALID, e.what, "", "send less, or sooner")
            await _closing(answer)(scope, receive, _with_headers(send))

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        """The refusal of a request; None if it is allowed."""
        method, path = scope["method"], scope["path"]
        line = len(scope.get("raw_path") or path) + len(scope.get("query_string", b""))
        if line + sum(len(name) + len(value) for name, value in scope["headers"]) > HEAD_BYTES:
            what = f"The head is longer than {HEAD_BYTES} bytes"
            return refused(431, ErrorCode.MESSAGE_INVALID, what, "no page sends so much", "send less")
        if not self._access.knows_host(headers.get("host", "")):
            return refused(
                400, ErrorCode.HOST_UNKNOWN, "This server has another name", "the request names another host",
                "open the address that it printed; --allow-host NAME adds one",
            )  # fmt: skip
        if method not in ("GET", "HEAD", "POST"):
            return refused(405, ErrorCode.MESSAGE_INVALID, f"{method} is not supported", "", "use GET or POST")
        if not path.startswith("/api/"):
            wrong = refused(405, ErrorCode.MESSAGE_INVALID, "A page takes no POST", "", "use GET")
            return wrong if method == "POST" else None
        if not _same_site(headers, scope.get("scheme", "http"), writes=method == "POST"):
            return refused(
                403, ErrorCode.ORIGIN_FOREIGN, "The request comes from a page of another site", "only this server's own"
                " pages may ask", "use the page that this server serves",
            )  # fmt: skip
        if length_of(headers) > BODY_BYTES:
            return refused(413, ErrorCode.MESSAGE_INVALID, f"More than {BODY_BYTES} bytes", "", "send less")
        return self._unknown(scope, headers)

    def _unknown(self, scope: Scope, headers: Headers) -> Response | None:
        """The refusal of a request without the token or session that it needs; None if it is allowed."""
        access, writes = self._access, scope["method"] == "POST"
        if writes and not access.control and scope["path"] != "/api/session":
            return refused(
                403, ErrorCode.READ_ONLY, "This view is read-only", "it was started so",
                "start it with --control to have buttons",
            )  # fmt: skip
        if not writes and (access.loopback or not access.token or scope["path"] in _OPEN_PATHS):
            return None
        client = str((scope.get("client") or ("",))[0])
        session = access.holds_session(scope)
        if not writes and session:
            return None
        if not session and self._wrong.spent(client):
            what = "Too many wrong tokens came from your address"
            answer = refused(429, ErrorCode.BUSY, what, "somebody is guessing", "try again in a second")
            answer.headers["Retry-After"] = "1"
            return answer
        if access.holds_token(headers):
            return None
        self._wrong.note(client)
        status = 403 if writes else 401
        return refused(
            status, ErrorCode.TOKEN_WRONG, "The token is wrong or missing", "another server start has another token",
            "open the address that the server printed when it started",
        )  # fmt: skip


def refused(status: int, code: ErrorCode, what: str, why: str, do: str) -> Response:
    """An error as JSON: its code, and the three parts that people read."""
    return JSONResponse({"code": code, "what": what, "why": why, "do": do}, status)


def _closing(answer: Response) -> Response:
    """The same answer, after which the connection is closed: the rest of the request is not read."""
    answer.headers["Connection"] = "close"
    return answer


def length_of(headers: Headers) -> int:
    """Content-Length of a request; 0 if it is missing or wrong."""
    text = headers.get("content-length", "0")
    return int(text) if text.isdecimal() and len(text) < 19 else 0


def _same_site(headers: Headers, scheme: str, writes: bool) -> bool:
    """True if the request comes from a page of this server, or from no page."""
    if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
        return False
    origin = headers.get("origin")
    if origin is None:
        return True
    parts = urlsplit(origin)
    same = parts.netloc == headers.get("host", "") and parts.scheme == scheme
    return same if writes else same or "sec-fetch-site" in headers


class BodyError(Exception):
    """The body of a request is too large or too slow."""

    def __init__(self, status: int, what: str) -> None:
        super().__init__(what)
        self.status, self.what = status, what


def _limited(receive: Receive) -> Receive:
    """Receive the body with the limits of size and time."""
    taken, begun, whole = 0, time.monotonic(), False

    async def limited() -> Message:
        nonlocal taken, whole
        if whole:
            return await receive()  # an event stream waits here until its page disconnects
        try:
            message = await asyncio.wait_for(receive(), max(0.05, BODY_S - (time.monotonic() - begun)))
        except TimeoutError:
            raise BodyError(408, f"The body did not come within {BODY_S:g} s") from None
        taken += len(message.get("body", b""))
        if taken > BODY_BYTES:
            raise BodyError(413, f"More than {BODY_BYTES} bytes")
        whole = not message.get("more_body", False)
        return message

    return limited


def _with_headers(send: Send) -> Send:
    """Send the security headers with every answer."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sending
