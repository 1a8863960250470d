"""Rules of requests, token and processes, without a server: each rule at its limit."""

import asyncio
import json
import stat
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.requests import Request
from tests.support.processes import wait_for
from tests.support.refusals import expect_refusal

from polysight.serve import site as site_module
from polysight.serve.guard import Access, Guard, answer_error, cookie_name, read_host_name
from polysight.serve.server import ServerAddress, _check_scan_folder, draw_code, load_token, serve
from polysight.serve.site import ChangingList, ListedScan, Sizes
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode

TOKEN = "a-token-of-24-characters"
# Server that only programs of this machine can reach, and the same one reachable from the network under the name "rig".
LOCAL = Access(token=TOKEN, control=True)
REMOTE = Access(token=TOKEN, loopback=False, hosts=("rig",), control=True)
LOCAL_READ_ONLY = Access(token=TOKEN)


def ask(
    access: Access, method: str = "GET", path: str = "/api/scans", body: bytes = b"", query: bytes = b"", **headers: str
) -> tuple[int, bytes]:
    """Send a request through the guard; return its status, and the body that the application received."""
    received_bodies: list[bytes] = []
    sent: list[dict[str, Any]] = []

    async def application(_: Any, receive: Any, send: Any) -> None:
        message = await receive()
        received_bodies.append(message.get("body", b""))
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body"})

    # The server hands a body over in parts, as they arrive.
    parts = [body[: len(body) // 2], body[len(body) // 2 :]]

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

    async def send(message: Any) -> None:
        sent.append(message)

    # Names of headers have hyphens, which names of Python's arguments cannot have.
    all_headers = {"host": "127.0.0.1:8080"} | {name.replace("_", "-"): value for name, value in headers.items()}
    scope = {
        "type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": query,
        "scheme": "http", "server": ("127.0.0.1", 8080),
        "headers": [(name.encode(), value.encode()) for name, value in all_headers.items()],
    }  # fmt: skip
    asyncio.run(Guard(application, access)(scope, receive, send))
    return sent[0]["status"], b"".join(received_bodies)


@pytest.mark.parametrize(
    ("access", "host", "status"),
    [
        (LOCAL, "localhost:1", 200), (LOCAL, "127.0.0.9", 200), (LOCAL, "[::1]:80", 200),
        (LOCAL, "192.168.0.5", 400), (LOCAL, "rig", 400), (LOCAL, "", 400),
        # From the network any address is accepted: a page of another site that makes its own name resolve to this
        # server (DNS rebinding) is recognized by that name.
        (REMOTE, "192.168.0.5:80", 200), (REMOTE, "rig:80", 200), (REMOTE, "evil.example", 400),
    ],
)  # fmt: skip
def test_only_requests_whose_host_header_names_this_server_are_accepted(access, host, status):
    assert ask(access, host=host, x_polysight_token=TOKEN)[0] == status


@pytest.mark.parametrize(
    ("host", "name"),
    [("a:80", "a"), ("a", "a"), ("[::1]:80", "::1"), ("[::1]", "::1"), ("", ""), ("1.2.3.4:5", "1.2.3.4")],
)
def test_the_name_of_a_host_is_read_without_its_port(host, name):
    assert read_host_name(host) == name


@pytest.mark.parametrize(
    ("method", "path", "access", "headers", "status"),
    [
        # Programs of this machine read without the token, programs of other machines need it.
        ("GET", "/api/scans", LOCAL, {}, 200),
        ("GET", "/api/scans", REMOTE, {}, 401),
        ("GET", "/api/scans", REMOTE, {"x_polysight_token": TOKEN}, 200),
        ("GET", "/api/scans", REMOTE, {"x_polysight_token": TOKEN[:-1]}, 401),
        # Images and event streams can send no header, so the session's cookie is enough to read. Its name has the
        # port, and its value is not the token.
        ("GET", "/api/scans", REMOTE, {"cookie": f"polysight-8080={REMOTE.session}"}, 200),
        ("GET", "/api/scans", REMOTE, {"cookie": f"polysight-8081={REMOTE.session}"}, 401),
        ("GET", "/api/scans", REMOTE, {"cookie": f"polysight-8080={TOKEN}"}, 401),
        # The empty page, and the request by which it finds out that its token is missing.
        ("GET", "/api/page", REMOTE, {}, 200),
        ("GET", "/", REMOTE, {}, 200),
        ("HEAD", "/", REMOTE, {}, 200),
        # Only paths under /api/ take commands.
        ("PUT", "/", LOCAL, {"x_polysight_token": TOKEN}, 405),
        ("POST", "/", LOCAL, {"x_polysight_token": TOKEN}, 405),
        # A command needs the token in the header, which no form or link of another site can send; the browser adds
        # the cookie to any request, so that this is not enough.
        ("POST", "/api/stop", LOCAL, {}, 403),
        ("POST", "/api/stop", LOCAL, {"x_polysight_token": TOKEN}, 200),
        ("POST", "/api/stop", LOCAL, {"cookie": f"polysight-8080={LOCAL.session}"}, 403),
        # A server without control takes no command, but opens a session for reading.
        ("POST", "/api/stop", LOCAL_READ_ONLY, {"x_polysight_token": TOKEN}, 403),
        ("POST", "/api/session", LOCAL_READ_ONLY, {"x_polysight_token": TOKEN}, 200),
        # A server without a token takes no command, and every client may read.
        ("POST", "/api/stop", Access(control=True), {"x_polysight_token": ""}, 403),
        ("GET", "/api/scans", Access(loopback=False), {}, 200),
    ],
)
def test_who_may_read_and_who_may_control(method, path, access, headers, status):
    assert ask(access, method, path, **headers)[0] == status


@pytest.mark.parametrize(
    ("method", "headers", "status"),
    [
        ("GET", {"origin": "http://127.0.0.1:8080"}, 200),
        ("GET", {"origin": "https://127.0.0.1:8080"}, 403),
        ("GET", {"origin": "http://127.0.0.1:8081"}, 403),
        # Sec-Fetch-Site is set by the browser itself and cannot be forged by a page: it is believed for requests that
        # only read. Commands need the right origin too.
        ("GET", {"origin": "http://other", "sec_fetch_site": "same-origin"}, 200),
        ("POST", {"origin": "http://other", "sec_fetch_site": "same-origin"}, 403),
        ("GET", {"sec_fetch_site": "cross-site"}, 403),
        # Same site, but another origin: a page on another port of this machine.
        ("GET", {"sec_fetch_site": "same-site"}, 403),
        # The operator typed the address.
        ("GET", {"sec_fetch_site": "none"}, 200),
        ("POST", {"origin": "http://127.0.0.1:8080", "sec_fetch_site": "same-origin"}, 200),
    ],
)
def test_requests_of_pages_of_other_sites_are_refused(method, headers, status):
    assert ask(LOCAL, method, x_polysight_token=TOKEN, **headers)[0] == status


def test_a_configured_host_name_may_be_that_of_a_proxy_which_ends_tls():
    """The browser's origin is then https, while the request reaches this server as plain http."""
    for origin, status in (("https://rig", 200), ("http://rig", 200), ("ftp://rig", 403)):
        assert ask(REMOTE, host="rig", origin=origin, x_polysight_token=TOKEN)[0] == status


@pytest.mark.parametrize(("length", "status"), [(65_536, 200), (65_537, 413)])
def test_a_body_has_at_most_64_kilobytes(length, status):
    body = b"x" * length
    answered, received_body = ask(LOCAL, "POST", "/api/stop", body, x_polysight_token=TOKEN)
    assert answered == status
    expected_body = body if status == 200 else b""
    assert received_body == expected_body


@pytest.mark.parametrize(("length", "status"), [("65536", 200), ("65537", 413), ("9" * 5000, 200)])
def test_a_body_is_refused_by_its_announced_length_before_it_is_read(length, status):
    """A length of 19 or more digits, too long for `int` to be safe, is not read: then the bytes that arrive count."""
    answered, _ = ask(LOCAL, "POST", "/api/stop", b"x", content_length=length, x_polysight_token=TOKEN)
    assert answered == status


def test_a_head_has_at_most_16_kilobytes():
    """Path, query string, and names and values of headers count."""
    used = len("/api/scans") + len("q=1") + len("host") + len("127.0.0.1:8080") + len("x-more")
    for length, status in ((16_384 - used, 200), (16_385 - used, 431)):
        assert ask(LOCAL, query=b"q=1", x_more="x" * length)[0] == status


def test_the_name_of_the_session_cookie_has_the_port():
    """Browsers send cookies of a host to all its ports, so servers on two ports would overwrite each other's."""
    assert cookie_name({"server": ("a", 81)}) == "polysight-81"
    assert cookie_name({}) == "polysight-0"


@pytest.mark.parametrize(
    ("method", "error", "status"),
    [
        ("GET", ConfigError("a", code=ErrorCode.OTHER), 400),
        ("GET", DataError("a", code=ErrorCode.VALUE_INVALID), 404),
        ("POST", DataError("a", code=ErrorCode.VALUE_INVALID), 400),
        ("POST", DataError("a", code=ErrorCode.FILE_MISSING), 404),
        ("GET", DeviceError("a", code=ErrorCode.NO_ANSWER), 503),
        ("GET", DeviceError("a", code=ErrorCode.BUSY), 409),
    ],
)
def test_an_error_has_a_status_and_its_three_parts(method, error, status):
    request = Request({"type": "http", "method": method, "headers": [], "path": "/"})
    answer = asyncio.run(answer_error(request, error))
    content = json.loads(bytes(answer.body))
    assert answer.status_code == status
    assert {"code", "what", "why", "do"} == set(content)


@pytest.fixture
def token_file(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "polysight" / "token"


def test_a_token_is_made_once_and_only_its_user_reads_it(token_file):
    token = load_token()
    # 18 random bytes, 144 bits, as base64 with four characters for three bytes.
    assert len(token) == 24
    assert load_token() == token
    assert stat.S_IMODE(token_file.stat().st_mode) == 0o600
    assert [path.name for path in token_file.parent.iterdir()] == ["token"]


@pytest.mark.parametrize(
    ("length", "mode", "is_taken"),
    [
        # A token that this program makes has 24 characters; one of the user's own needs at least 18.
        (18, 0o600, True),
        (17, 0o600, False),
        # Readable for the group, for all users, and only for the owner.
        (24, 0o640, False),
        (24, 0o604, False),
        (24, 0o400, True),
    ],
)
def test_a_token_that_others_may_read_or_that_was_shortened_is_refused(token_file, length, mode, is_taken):
    token_file.parent.mkdir()
    token_file.write_text("x" * length + "\n")
    token_file.chmod(mode)
    if is_taken:
        assert load_token() == "x" * length
        return
    with expect_refusal(ErrorCode.VALUE_INVALID, token_file):
        load_token()


@pytest.mark.parametrize(
    ("host", "is_loopback"),
    [("127.0.0.1", True), ("127.9.9.9", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("rig", False)],
)
def test_only_this_machine_reaches_a_loopback_address(host, is_loopback):
    assert ServerAddress(host).loopback is is_loopback


def test_tls_needs_both_files(tmp_path):
    ServerAddress().check()
    for files in ({"certificate": tmp_path / "a"}, {"key": tmp_path / "a"}):
        with pytest.raises(ConfigError, match="both"):
            ServerAddress(**files).check()
    with expect_refusal(ErrorCode.FILE_MISSING, tmp_path / "a"):
        ServerAddress(certificate=tmp_path / "a", key=tmp_path / "b").check()


def test_a_missing_folder_of_scans_is_made_in_the_current_folder_only(tmp_path, monkeypatch):
    """One elsewhere may lie on a drive that is not mounted. Without control nothing is written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    with expect_refusal(ErrorCode.FILE_FOREIGN):
        serve(tmp_path / "file", ServerAddress(), config=None)
    for folder, control in ((Path("new"), False), (Path("a/new"), True), (tmp_path.parent / "new", True)):
        with expect_refusal(ErrorCode.FILE_MISSING):
            serve(folder, ServerAddress(), config=None, control=control)
        assert not folder.exists()


def test_a_live_view_of_a_folder_with_other_files_than_notes_is_refused(tmp_path, capsys):
    """A scan may begin later in an empty or missing folder, or one with the operator's notes or hidden files."""
    _check_scan_folder(tmp_path)
    assert "contains no scan yet" in capsys.readouterr().err

    # Written by the page before the scan, and by the system.
    (tmp_path / "operator.json").write_text("{}")
    (tmp_path / ".hidden").write_text("")
    _check_scan_folder(tmp_path)
    _check_scan_folder(tmp_path / "missing")
    assert "does not exist yet" in capsys.readouterr().err

    (tmp_path / "other").write_text("")
    with expect_refusal(ErrorCode.FILE_FOREIGN, "other"):
        _check_scan_folder(tmp_path)


@pytest.mark.parametrize("text", ["x", "http://192.168.0.5:8080/#token=abcdefghijklmnopqrstuvwx"])
def test_a_qr_code_has_two_rows_of_modules_in_each_line(text):
    """Half blocks show two modules in a character: the upper one, the lower one, both, or none (a space)."""
    segno = pytest.importorskip("segno")
    upper_half = "\u2580"
    lower_half = "\u2584"
    full_block = "\u2588"
    # Escape codes of a terminal: black on white (colours 16 and 231 of 256), and the end of that.
    black_on_white = "\033[38;5;16;48;5;231m"
    reset = "\033[0m"
    expected_rows = [list(row) for row in segno.make(text, error="l").matrix_iter()]

    drawn_rows = []
    for line in draw_code(text).splitlines():
        blocks = line.removeprefix(black_on_white).removesuffix(reset)
        drawn_rows.append([int(block in (upper_half, full_block)) for block in blocks])
        drawn_rows.append([int(block in (lower_half, full_block)) for block in blocks])

    assert drawn_rows[: len(expected_rows)] == expected_rows
    # An odd number of rows is filled up with an empty one.
    assert not any(map(any, drawn_rows[len(expected_rows) :]))


@pytest.mark.parametrize(("age_s", "max_age_s", "counts"), [(5.0, 20.0, 1), (21.0, 20.0, 2), (5.0, 4.0, 2)])
def test_a_size_is_counted_again_when_it_is_old(tmp_path, monkeypatch, age_s, max_age_s, counts):
    now_s = 1000.0
    counted: list[Path] = []
    # The test's clock in place of the module `time`, which measures the age of a size.
    monkeypatch.setattr(site_module, "time", SimpleNamespace(monotonic=lambda: now_s))

    def count(folder: Path) -> int:
        counted.append(folder)
        return 7

    monkeypatch.setattr(site_module.catalogue, "folder_bytes", count)
    sizes = Sizes()
    assert sizes.read_size(tmp_path, max_age_s) is None
    wait_for(lambda: not sizes._counting_since, "the count")
    now_s += age_s
    # The last count is returned immediately; a new one is made in the background if the last is too old.
    assert sizes.read_size(tmp_path, max_age_s) == 7
    wait_for(lambda: not sizes._counting_since, "the count")
    assert len(counted) == counts


def test_a_page_without_a_valid_stamp_gets_the_whole_list_and_others_the_changes():
    """A stamp names the server and the number of the list's state that a page has: "3f2a90c1-4"."""
    changing = ChangingList()
    scan = ListedScan(name="a", state="finished", bytes=1)
    stamp = changing.update([scan], "").stamp
    origin, _, number = stamp.partition("-")
    assert number == "1"
    assert not changing.update([scan], stamp).whole
    # State 0 is the empty list at the start.
    assert [changed.name for changed in changing.update([scan], f"{origin}-0").scans] == ["a"]
    for wrong_stamp in (
        "",
        origin,
        f"{origin}-",
        f"{origin}--1",
        f"{origin}-01",
        f"{origin}-x",
        f"other-{number}",
        # An Arabic 1, which Python's `int` reads.
        f"{origin}-\u0661",
    ):
        assert changing.update([scan], wrong_stamp).whole

    # The scan is removed: the first answer says so, and the next one for its stamp has nothing new.
    after_removal = changing.update([], stamp)
    assert not after_removal.whole
    assert after_removal.gone == ["a"]
    assert after_removal.scans == []
    assert changing.update([], after_removal.stamp).gone == []
