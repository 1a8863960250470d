"""Access by token and address, limits of size and time; refused requests change nothing and do not block others."""

import http.client
import json
import shutil
import socket
import ssl
import subprocess
import threading
import time
from contextlib import ExitStack
from itertools import cycle, islice
from pathlib import Path
from urllib.request import urlopen

import pytest
from tests.support.page.asking import TOKEN, ask, compute_digest, get, post, send_raw
from tests.support.page.live_view import serve_folder
from tests.support.processes import HANG_S
from tests.support.products import write_judged_products
from tests.support.refusals import expect_refusal

from polysight.serve import ServerAddress, guard, server
from polysight.serve.front import ConnectionLimit, CountedConnection
from polysight.serve.guard import TOKEN_HEADER, Access
from polysight_shared.errors import ErrorCode

SECRET = "nobody may read this"
# Names that contain a name of this server, an address of the network (the server is bound to loopback), and names that
# are no names of hosts.
FOREIGN_HOSTS = ("evil.example", "127.0.0.1.evil.example", "localhost.evil.example:80", "192.168.1.7", "", "[", "a:b:c")
# Everything that can be read of a scan, as paths below /api/.
READ_PATHS = ("scan", "result", "thumbnail", "state", "map/h_amplitude", "file/image.npz", "probe", "file/secret.txt")


@pytest.fixture
def scans(finished_scan: Path, tmp_path: Path) -> Path:
    """A folder with a scan that was processed, next to a file that must not be served."""
    shutil.copytree(finished_scan, tmp_path / "scans" / "one")
    write_judged_products(tmp_path / "scans" / "one" / "products", "care")
    (tmp_path / "secret.txt").write_text(SECRET)
    (tmp_path / "scans" / "out").symlink_to(tmp_path)
    return tmp_path / "scans"


def test_requests_with_the_host_name_of_another_server_are_refused(scans):
    with serve_folder(scans, TOKEN) as view:
        for host in ("localhost", "localhost:8080", "127.0.0.1", f"127.0.0.1:{view.port}", "[::1]:80"):
            assert ask(view, "/api/scans", Host=host)[0] == 200, host
        for host in FOREIGN_HOSTS:
            for path in ("/", "/api/scans", "/base.css"):
                assert ask(view, path, Host=host)[0] == 400, host
            assert post(view, "/api/control/abort?scan=one", Host=host)[0] == 400


def test_pages_of_other_sites_cannot_read_or_command(scans):
    """Other sites include pages of another port of this machine, and of this address with https."""
    own_origin = "http://127.0.0.1"
    with serve_folder(scans, TOKEN) as view:
        digest_before = compute_digest(scans)
        for origin in ("https://evil.example", "null", own_origin, f"{own_origin}:1", f"https://127.0.0.1:{view.port}"):
            status, reported = post(view, "/api/notes?scan=one", {"notes": "mine"}, Origin=origin)
            assert (status, reported["code"]) == (403, ErrorCode.ORIGIN_FOREIGN), origin
        # The browser says itself where the page is from; "same-site" is another port of this machine.
        for site in ("cross-site", "same-site"):
            assert post(view, "/api/notes?scan=one", {"notes": "mine"}, Sec_Fetch_Site=site)[0] == 403
            assert ask(view, "/api/scans", Sec_Fetch_Site=site)[0] == 403
        for path, expected in (("/", 200), ("/api/scans", 403), ("/api/bar/phase", 403)):
            status, _, headers = ask(view, path, Origin="https://evil.example")
            assert status == expected
            assert not [name for name in headers if name.startswith("access-control")]
            assert "default-src 'self'" in headers["content-security-policy"]
            assert "unsafe" not in headers["content-security-policy"]
        assert compute_digest(scans) == digest_before
        assert post(view, "/api/notes?scan=one", {"notes": "mine"}, Origin=f"{own_origin}:{view.port}")[0] == 200


def test_with_the_name_of_a_proxy_that_ends_tls_the_origin_may_be_https(scans):
    """Origin and Host must still agree, with their ports. The cookie is then sent over https only."""
    access = Access(TOKEN, loopback=False, hosts=("lab.example.org",), control=True)
    with serve_folder(scans, access=access) as view:
        for host, origin, expected in (
            ("lab.example.org", "https://lab.example.org", 200),
            ("lab.example.org:8443", "https://lab.example.org:8443", 200),
            ("lab.example.org", "https://evil.example", 403),
            ("lab.example.org", "https://lab.example.org:8443", 403),
            ("127.0.0.1", "https://127.0.0.1", 403),
        ):
            status, _, headers = ask(
                view, "/api/session", "POST", {}, Host=host, Origin=origin, **{TOKEN_HEADER: TOKEN}
            )
            assert status == expected, (host, origin)
            if status == 200:
                assert "; secure" in headers["set-cookie"].lower()


def test_a_server_for_other_machines_needs_the_token_for_reading_too(scans):
    access = Access(TOKEN, loopback=False, control=True)
    with serve_folder(scans, access=access) as view:
        # The page itself has no data; it asks the operator for the token.
        assert ask(view, "/")[0] == 200
        for path in (
            "scans",
            "scan?scan=one",
            "result?scan=one",
            "state?scan=one",
            "events?scan=one",
            "file/report.html",
        ):
            assert ask(view, f"/api/{path}")[0] == 401, path
        # "known": the request came with the token or the session's cookie.
        assert not get(view, "/api/page")["known"]
        assert get(view, "/api/scans", **{TOKEN_HEADER: TOKEN})["scans"]
        status, _, headers = ask(view, "/api/session", "POST", **{TOKEN_HEADER: TOKEN})
        cookie = headers["set-cookie"]
        assert status == 200
        # No script reads the cookie, and no page of another site makes the browser send it.
        assert "httponly" in cookie.lower()
        assert "samesite=strict" in cookie.lower()
        cookie = cookie.partition(";")[0]
        assert get(view, "/api/scans", Cookie=cookie)["scans"]
        # The cookie allows reading only.
        assert ask(view, "/api/notes?scan=one", "POST", {}, Cookie=cookie)[0] == 403
        assert get(view, "/api/scans", Host=f"192.168.7.7:{view.port}", Cookie=cookie)["scans"]
        # A router may forward another port to this one: the cookie's name has this server's, whatever Host says.
        assert get(view, "/api/page", Host="192.168.7.7:9000", Cookie=cookie)["known"]


def test_large_bodies_and_heads_are_refused_and_change_no_file(scans):
    with serve_folder(scans, TOKEN) as view:
        digest_before = compute_digest(scans)
        large = b"x" * (guard.BODY_BYTES + 1)
        status, _, _ = ask(view, "/api/notes?scan=one", "POST", large, **{TOKEN_HEADER: TOKEN})
        assert status == 413
        head = f"POST /api/notes?scan=one HTTP/1.1\r\nHost: 127.0.0.1\r\n{TOKEN_HEADER}: {TOKEN}\r\n"
        # A body in chunks announces no total length: each chunk has its own in hexadecimal, and one of 0 is the last.
        chunks = b"%x\r\n%s\r\n" % (len(large), large) * 3
        chunked_request = f"{head}Transfer-Encoding: chunked\r\n\r\n".encode() + chunks + b"0\r\n\r\n"
        assert b" 413 " in send_raw(view, chunked_request)[:40]
        # Heads just above the guard's limit of 16 KiB, and far above: those uvicorn refuses itself (400), or it closes
        # the connection before its answer has been read.
        for size in (17_000, 70_000, 1 << 20):
            answer = send_raw(view, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"y" * size + b"\r\n\r\n")[:40]
            assert b" 400 " in answer or b" 431 " in answer or answer == b""
        assert compute_digest(scans) == digest_before


def test_other_clients_with_unfinished_requests_or_unread_answers_do_not_block_the_operator(scans):
    """300 clients send a part of the head of a request. 100 clients ask for 300 pages each, and read none."""
    pages = b"GET /common.js HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 300
    with serve_folder(scans, TOKEN) as view, ExitStack() as clients:
        operator = http.client.HTTPConnection("127.0.0.1", view.port, timeout=HANG_S)
        for k in range(400):
            client = clients.enter_context(socket.create_connection(("127.0.0.1", view.port), HANG_S))
            client.setblocking(False)
            if k % 4 == 0:
                client.send(pages)
            else:
                begin_of_head = b"GET / HTTP/1.1\r\nHo"
                client.send(begin_of_head[: k % len(begin_of_head)])
            if k % 50 == 0:
                operator.request("GET", "/api/scans")
                assert operator.getresponse().read()
        assert get(view, "/api/scans")["scans"]
        assert post(view, "/api/notes?scan=one", {"notes": "n"})[0] == 200
        operator.close()


def test_of_too_many_connections_those_without_a_request_are_closed(scans, monkeypatch):
    """Connections that were answered, or whose request was not read yet, do not block new clients."""
    monkeypatch.setattr(server, "MAX_CONNECTIONS", 20)
    with serve_folder(scans, TOKEN) as view, ExitStack() as clients:
        operator = http.client.HTTPConnection("127.0.0.1", view.port, timeout=HANG_S)
        operator.request("GET", "/api/scans")
        assert operator.getresponse().read()
        stream = http.client.HTTPConnection("127.0.0.1", view.port, timeout=HANG_S)
        stream.request("GET", "/api/events?scan=one")
        events = stream.getresponse()
        assert events.readline().startswith(b"event: ")
        # Ten times as many silent clients as the limit.
        for _ in range(200):
            clients.enter_context(socket.create_connection(("127.0.0.1", view.port), HANG_S))
        operator.request("GET", "/api/scans")
        assert operator.getresponse().status == 200
        assert post(view, "/api/notes?scan=one", {"notes": "n"})[0] == 200
        # The stream continues; an event has a few lines.
        assert any(events.readline().startswith(b"event: ") for _ in range(20))
        operator.close()
        stream.close()


def test_when_every_connection_has_a_request_the_next_one_is_answered_as_busy(scans, monkeypatch):
    """A connection is not closed if its request has arrived when the connection is accepted."""
    monkeypatch.setattr(server, "MAX_CONNECTIONS", 4)
    monkeypatch.setattr(server, "ACCEPTED_AT_ONCE", 3)
    monkeypatch.setattr(CountedConnection, "has_unread_bytes", lambda _: True)
    answers = []
    with serve_folder(scans, TOKEN) as view, ExitStack() as clients:
        # The server answers 503 from its limit and two rounds of accepting on: connections that it closed for others
        # count a little longer.
        for _ in range(4 + 2 * 3):
            stream = http.client.HTTPConnection("127.0.0.1", view.port, timeout=HANG_S)
            clients.callback(stream.close)
            stream.request("GET", "/api/events?scan=one")
            answers.append(stream.getresponse().status)
    assert answers == [200] * 9 + [503]


def test_too_many_connections_close_silent_ones_and_none_with_unread_bytes():
    """A request that was sent is read, even if the connection is closed afterwards."""

    class Connection:
        """Replaces a connection of the server, and also its transport, with the members that the limit uses."""

        def __init__(self, unread: bool) -> None:
            self.unread = unread
            self.is_working = False
            self.is_closed = False
            self.transport = self

        def has_unread_bytes(self) -> bool:
            return self.unread

        def close(self) -> None:
            self.is_closed = True

    limit = ConnectionLimit(2)
    connections = [Connection(unread) for unread in (True, False, False, False)]
    for connection in connections:
        limit.add(connection)
        for closed in connections:
            if closed.is_closed and closed in limit._silent:
                limit.remove(closed)
    assert [connection.is_closed for connection in connections] == [False, True, True, False]


def test_a_download_that_is_aborted_leaves_no_file_open(scans):
    """This holds even if the server ends before the answer is read."""
    large = scans / "one" / "products" / "report.html"
    large.write_bytes(b"x" * (16 << 20))

    def is_open() -> bool:
        return large in [fd.resolve() for fd in Path("/proc/self/fd").iterdir()]

    with serve_folder(scans, TOKEN) as view, ExitStack() as clients:
        for _ in range(3):
            client = clients.enter_context(socket.create_connection(("127.0.0.1", view.port), HANG_S))
            client.sendall(b"GET /api/file/report.html?scan=one HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert client.recv(100)
        assert is_open()
        client.close()
    assert not is_open()


# Names that a client may give for a scan: paths out of the folder as text and encoded, absolute ones, a link, control
# characters, and U+202E, which turns the direction of the text that follows.
HOSTILE_NAMES = (
    "..", "../secret.txt", "../../etc/passwd", "/etc/passwd", "one/../../secret.txt", "out", "out/scans/one", "%2e%2e",
    "one\x00", "one/",
    "./one", ".polysight", "one\\..", "", " ", "a" * 3000, "one/products", "..%2fsecret.txt", "\u202eeno",
)  # fmt: skip


def test_no_name_leads_out_of_the_folder(scans, tmp_path):
    from urllib.parse import quote

    with serve_folder(scans, TOKEN) as view:
        digest_before = compute_digest(tmp_path)
        for name in HOSTILE_NAMES:
            quoted_name = quote(name, safe="")
            for path in READ_PATHS:
                status, body, _ = ask(view, f"/api/{path}?scan={quoted_name}&x=0&y=0")
                assert status in (400, 404), (name, path, status, body[:200])
                assert SECRET.encode() not in body
            boxes = {"boxes": {"a": [0, 0, 9, 9]}}
            for path, content in (("notes", {"notes": "x"}), ("labels", boxes), ("control/abort", {})):
                status, _ = post(view, f"/api/{path}?scan={quoted_name}", content)
                assert status in (400, 404), (name, path)
        for name in ("../secret.txt", "..%2f..%2fmanifest.jsonl", "manifest.jsonl", "figures", "%00"):
            assert ask(view, f"/api/file/{name}?scan=one")[0] in (400, 404)
        assert compute_digest(tmp_path) == digest_before


def test_a_link_among_products_is_not_served(scans, tmp_path):
    (scans / "one" / "products" / "image.csv").symlink_to(tmp_path / "secret.txt")
    with serve_folder(scans) as view:
        assert "image.csv" not in [f["name"] for f in get(view, "/api/result?scan=one")["files"]]
        assert ask(view, "/api/file/image.csv?scan=one")[0] == 404


def test_a_served_report_runs_no_script_and_other_files_are_downloads(scans):
    (scans / "one" / "products" / "report.html").write_text("<script>fetch('/api/control/abort')</script>")
    with serve_folder(scans) as view:
        status, _, headers = ask(view, "/api/file/report.html?scan=one")
        policy = headers["content-security-policy"]
        assert status == 200
        assert "sandbox" in policy
        assert not {"allow-scripts", "script-src"} & {*policy.replace(";", " ").split()}
        assert "default-src 'none'" in policy
        assert headers["x-content-type-options"] == "nosniff"
        for name in ("image.npz", "materials.json"):
            content = (scans / "one" / "products" / name).read_bytes()
            assert ask(view, f"/api/file/{name}?scan=one")[1] == content
            answer_headers = ask(view, f"/api/file/{name}?scan=one", "HEAD")[2]
            assert int(answer_headers["content-length"]) == len(content)
            assert answer_headers["content-disposition"].startswith("attachment")
            assert answer_headers["content-type"] == "application/octet-stream"


# Every command, as paths below /api/. The first two are used with hostile methods and bodies.
POST_PATHS = ("control/abort?scan=one", "notes?scan=one", "labels?scan=one", "start", "train", "process?scan=one",
         "layers?scan=one", "concentration",
         "export?scan=one", "session", "doctor", "plan", "queue", "unqueue", "release", "again?scan=one",
         "archive?scan=one", "delete?scan=one")  # fmt: skip
# Invalid names of scans, paths, lengths of bodies, bodies of notes, and heads: a TLS greeting, other versions of HTTP
# and its version 2, too many headers, and no text at all.
WRONG_NAMES = ("..", "%2e%2e%2f", "/etc", "one%00", "a" * 9000, "%ff%fe")
WRONG_PATHS = ("../../etc/passwd", "..%2f..%2fetc/passwd", "static/../guard.py", "%00", "?" + "q" * 9000)
WRONG_LENGTHS = ("99999999999", "-1", "1e9", "0x10", "2, 3")
WRONG_NOTES = (b"[", b"[]", b"null", b'{"a":1}', b'{"notes":1}', b"\xff\xfe", b"[" * 5000,
            b'{"notes":"%s"}' % (b"x" * 30000))  # fmt: skip
WRONG_HEADS = (b"", b"\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03", b"GET / HTTP/9.9\r\n\r\n",
            b"GET /\r\n\r\n", b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 5000,
            b"\0" * 3000)  # fmt: skip


def list_hostile_requests(port: int) -> list[bytes]:
    """Malicious requests as bytes; some with the right token."""
    host_line = f"Host: 127.0.0.1:{port}"
    token = f"{TOKEN_HEADER}: {TOKEN}"

    def request(line: str, *headers: str, body: bytes = b"") -> bytes:
        return "\r\n".join([f"{line} HTTP/1.1", *headers, "", ""]).encode("latin-1") + body

    requests = list(WRONG_HEADS)
    for path in POST_PATHS:
        wrong_tokens = ("", "x", TOKEN[:-1], "\xff")
        refused_headers = [[host_line, f"{TOKEN_HEADER}: {wrong_token}"] for wrong_token in wrong_tokens]
        refused_headers += [
            [host_line],
            ["Host: evil.example", token],
            [host_line, token, "Sec-Fetch-Site: cross-site"],
        ]
        refused_headers += [[host_line, token, f"Origin: {origin}"] for origin in ("https://evil.example", "null")]
        requests += [
            request(f"POST /api/{path}", *headers, "Content-Length: 2", body=b"{}") for headers in refused_headers
        ]
    methods = ("GET", "PUT", "DELETE", "OPTIONS", "TRACE", "CONNECT", "BREW")
    requests += [request(f"{method} /api/{POST_PATHS[0]}", host_line, token) for method in methods]
    for path in ("scan", "result", "file/image.npz", "thumbnail"):
        requests += [request(f"GET /api/{path}?scan={name}", host_line) for name in WRONG_NAMES]
    requests += [request(f"GET /{path}", host_line) for path in WRONG_PATHS]
    notes = (f"POST /api/{POST_PATHS[1]}", host_line, token)
    requests += [request(*notes, f"Content-Length: {length}", body=b"{") for length in WRONG_LENGTHS]
    requests += [request(*notes, f"Content-Length: {len(body)}", body=body) for body in WRONG_NOTES]
    # A head that is too large, a change of the protocol, and two Host headers.
    for headers in ([f"X: {'y' * 40000}"], ["Upgrade: websocket", "Connection: Upgrade"], [host_line]):
        requests.append(request("GET /", host_line, *headers))
    return requests


@pytest.mark.slow
def test_a_thousand_hostile_requests_change_nothing_and_lock_no_client_out(scans, tmp_path):
    with serve_folder(scans, TOKEN) as view:
        digest_before = compute_digest(tmp_path)
        requests = list(islice(cycle(list_hostile_requests(view.port)), 1000))
        open_sockets: list[socket.socket] = []

        def send(part: list[bytes]) -> None:
            for data in part:
                attacker = socket.create_connection(("127.0.0.1", view.port), HANG_S)
                attacker.sendall(data)
                # The connection is left open, and its answer is not read.
                open_sockets.append(attacker)

        # Eight attackers share the requests; meanwhile the operator reads and opens sessions.
        threads = [threading.Thread(target=send, args=(requests[k::8],)) for k in range(8)]
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            assert get(view, "/api/scans")["scans"]
            assert post(view, "/api/session")[0] == 200
            time.sleep(0.01)
        for attacker in open_sockets:
            attacker.close()
        assert compute_digest(tmp_path) == digest_before
        assert post(view, "/api/notes?scan=one", {"notes": "the operator's", "tags": ["a"]})[0] == 200
        assert get(view, "/api/scan?scan=one")["notes"] == "the operator's"


@pytest.mark.parametrize("options", ["certificate", "key"])
def test_a_certificate_without_its_key_is_refused_before_the_files_are_read(tmp_path, options):
    with expect_refusal(ErrorCode.OTHER, "--certificate and --key"):
        ServerAddress(**{options: tmp_path / "missing.pem"}).check()


def test_with_a_certificate_everything_is_encrypted(scans, tmp_path):
    program = shutil.which("openssl")
    if program is None:
        pytest.skip("no openssl here to make a certificate with: apt-get install openssl")
    files = ["-keyout", tmp_path / "key.pem", "-out", tmp_path / "certificate.pem"]
    subject = ["-subj", "/CN=127.0.0.1", "-addext", "subjectAltName=IP:127.0.0.1"]
    command = [program, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *files, *subject]
    subprocess.run([str(w) for w in command], check=True, capture_output=True)
    # One file given for both is neither a certificate with its key.
    for file_name in ("key.pem", "certificate.pem"):
        with expect_refusal(ErrorCode.FILE_FOREIGN, tmp_path / file_name):
            ServerAddress(certificate=tmp_path / file_name, key=tmp_path / file_name).check()
    place = ServerAddress(port=0, certificate=tmp_path / "certificate.pem", key=tmp_path / "key.pem")
    with serve_folder(scans, access=Access(TOKEN, control=True, secure=True), server_address=place) as view:
        trusted = ssl.create_default_context(cafile=str(tmp_path / "certificate.pem"))
        with urlopen(f"https://127.0.0.1:{view.port}/api/scans", timeout=HANG_S, context=trusted) as reply:
            assert json.load(reply)["scans"]
        # A request without encryption gets no answer.
        assert b"HTTP" not in send_raw(view, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
