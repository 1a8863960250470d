"""Rules of requests, token and processes, without a server: each rule at its limit."""

import asyncio
import json
import stat
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import Request
from tests.support.processes import wait_for
from tests.support.refusals import expect_refusal

from polysight.serve import site as site_module
from polysight.serve.guard import Access, Guard, cookie_name, read_host_name, tell_error
from polysight.serve.server import ServerAddress, _check_scan_folder, draw_code, load_token, serve
from polysight.serve.site import ChangingList, ListedScan, Sizes
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode

TOKEN = "a-token-of-24-characters"
CONTROLLED = Access(token=TOKEN, control=True)
OUTSIDE = Access(token=TOKEN, loopback=False, hosts=("rig",), control=True)


def ask(
    access: Access, method: str = "GET", path: str = "/api/scans", body: bytes = b"", query: bytes = b"", **headers: str
) -> tuple[int, bytes]:
    """Send a request through the guard; return its status, and the body that the application received."""
    seen: list[bytes] = []
    sent: list[dict[str, Any]] = []

    async def application(_: Any, receive: Any, send: Any) -> None:
        message = await receive()
        seen.append(message.get("body", b""))
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body"})

    parts = [body[: len(body) // 2], body[len(body) // 2 :]]

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

    async def send(message: Any) -> None:
        sent.append(message)

    given = {"host": "127.0.0.1:8080"} | {name.replace("_", "-"): value for name, value in headers.items()}
    scope = {
        "type": "http", "method": method, "path": path, "raw_path": path.encode(), "query_string": query,
        "scheme": "http", "server": ("127.0.0.1", 8080),
        "headers": [(name.encode(), value.encode()) for name, value in given.items()],
    }  # fmt: skip
    asyncio.run(Guard(application, access)(scope, receive, send))
    return sent[0]["status"], b"".join(seen)


@pytest.mark.parametrize(
    ("access", "host", "status"),
    [
        (CONTROLLED, "localhost:1", 200), (CONTROLLED, "127.0.0.9", 200), (CONTROLLED, "[::1]:80", 200),
        (CONTROLLED, "192.168.0.5", 400), (CONTROLLED, "rig", 400), (CONTROLLED, "", 400),
        (OUTSIDE, "192.168.0.5:80", 200), (OUTSIDE, "rig:80", 200), (OUTSIDE, "evil.example", 400),
    ],
)  # fmt: skip
def test_a_request_names_this_server(access, host, status):
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
        ("GET", "/api/scans", CONTROLLED, {}, 200),
        ("GET", "/api/scans", OUTSIDE, {}, 401),
        ("GET", "/api/scans", OUTSIDE, {"x_polysight_token": TOKEN}, 200),
        ("GET", "/api/scans", OUTSIDE, {"x_polysight_token": TOKEN[:-1]}, 401),
        ("GET", "/api/scans", OUTSIDE, {"cookie": f"polysight-8080={OUTSIDE.session}"}, 200),
        ("GET", "/api/scans", OUTSIDE, {"cookie": f"polysight-8081={OUTSIDE.session}"}, 401),
        ("GET", "/api/scans", OUTSIDE, {"cookie": f"polysight-8080={TOKEN}"}, 401),
        ("GET", "/api/page", OUTSIDE, {}, 200),
        ("GET", "/", OUTSIDE, {}, 200),
        ("HEAD", "/", OUTSIDE, {}, 200),
        ("PUT", "/", CONTROLLED, {"x_polysight_token": TOKEN}, 405),
        ("POST", "/", CONTROLLED, {"x_polysight_token": TOKEN}, 405),
        ("POST", "/api/stop", CONTROLLED, {}, 403),
        ("POST", "/api/stop", CONTROLLED, {"x_polysight_token": TOKEN}, 200),
        ("POST", "/api/stop", CONTROLLED, {"cookie": f"polysight-8080={CONTROLLED.session}"}, 403),
        ("POST", "/api/stop", Access(token=TOKEN), {"x_polysight_token": TOKEN}, 403),
        ("POST", "/api/session", Access(token=TOKEN), {"x_polysight_token": TOKEN}, 200),
        # Without a token no one controls, and everyone reads.
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
        ("GET", {"origin": "http://other", "sec_fetch_site": "same-origin"}, 200),
        ("POST", {"origin": "http://other", "sec_fetch_site": "same-origin"}, 403),
        ("GET", {"sec_fetch_site": "cross-site"}, 403),
        ("GET", {"sec_fetch_site": "same-site"}, 403),
        ("GET", {"sec_fetch_site": "none"}, 200),
        ("POST", {"origin": "http://127.0.0.1:8080", "sec_fetch_site": "same-origin"}, 200),
    ],
)
def test_pages_of_other_sites_may_not_ask(method, headers, status):
    assert ask(CONTROLLED, method, x_polysight_token=TOKEN, **headers)[0] == status


def test_a_declared_name_may_be_encrypted_elsewhere():
    for origin, status in (("https://rig", 200), ("http://rig", 200), ("ftp://rig", 403)):
        assert ask(OUTSIDE, host="rig", origin=origin, x_polysight_token=TOKEN)[0] == status


@pytest.mark.parametrize(("length", "status"), [(65_536, 200), (65_537, 413)])
def test_a_body_has_at_most_64_kilobytes(length, status):
    body = b"x" * length
    found, seen = ask(CONTROLLED, "POST", "/api/stop", body, x_polysight_token=TOKEN)
    assert (found, seen) == (status, body if status == 200 else b"")
    # As announced, before anything is read
    assert ask(CONTROLLED, "POST", "/api/stop", content_length=str(length), x_polysight_token=TOKEN)[0] == status
    huge = "9" * 5000
    assert ask(CONTROLLED, "POST", "/api/stop", b"x", content_length=huge, x_polysight_token=TOKEN)[0] == 200


def test_a_head_has_at_most_16_kilobytes():
    """Path, question, and names and values of headers count."""
    used = len("/api/scans") + len("q=1") + len("host") + len("127.0.0.1:8080") + len("x-more")
    for length, status in ((16_384 - used, 200), (16_385 - used, 431)):
        assert ask(CONTROLLED, query=b"q=1", x_more="x" * length)[0] == status


def test_the_cookie_has_the_name_of_the_port():
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
    answer = asyncio.run(tell_error(request, error))
    content = json.loads(bytes(answer.body))
    assert answer.status_code == status
    assert {"code", "what", "why", "do"} == set(content)


@pytest.fixture
def token_file(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "polysight" / "token"


def test_a_token_is_made_once_and_only_its_user_reads_it(token_file):
    token = load_token()
    assert len(token) == 24
    assert load_token() == token
    assert stat.S_IMODE(token_file.stat().st_mode) == 0o600
    assert [path.name for path in token_file.parent.iterdir()] == ["token"]


@pytest.mark.parametrize(
    ("length", "mode", "is_taken"),
    [(18, 0o600, True), (17, 0o600, False), (24, 0o640, False), (24, 0o604, False), (24, 0o400, True)],
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


def test_a_folder_of_scans_elsewhere_is_not_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    with expect_refusal(ErrorCode.FILE_FOREIGN):
        serve(tmp_path / "file", ServerAddress(), None)
    for folder, control in ((Path("new"), False), (Path("a/new"), True), (tmp_path.parent / "new", True)):
        with expect_refusal(ErrorCode.FILE_MISSING):
            serve(folder, ServerAddress(), None, control)
        assert not folder.exists()


def test_a_live_view_is_of_a_folder_in_which_a_scan_can_begin(tmp_path, capsys):
    _check_scan_folder(tmp_path)
    assert "no scan is in" in capsys.readouterr().err
    (tmp_path / "operator.json").write_text("{}")
    (tmp_path / ".hidden").write_text("")
    _check_scan_folder(tmp_path)
    _check_scan_folder(tmp_path / "missing")
    assert "does not exist yet" in capsys.readouterr().err
    (tmp_path / "other").write_text("")
    with expect_refusal(ErrorCode.FILE_FOREIGN, "other"):
        _check_scan_folder(tmp_path)


@pytest.mark.parametrize("text", ["x", "http://192.168.0.5:8080/#token=abcdefghijklmnopqrstuvwx"])
def test_a_code_has_two_rows_of_modules_in_a_line(text):
    segno = pytest.importorskip("segno")
    rows = [list(row) for row in segno.make(text, error="l").matrix_iter()]
    lines = draw_code(text).splitlines()
    blocks = [line.removeprefix("\033[38;5;16;48;5;231m").removesuffix("\033[0m") for line in lines]
    upper = [[int(block in "\u2580\u2588") for block in line] for line in blocks]
    lower = [[int(block in "\u2584\u2588") for block in line] for line in blocks]
    drawn = [row for pair in zip(upper, lower, strict=True) for row in pair]
    assert drawn[: len(rows)] == rows
    assert not any(map(any, drawn[len(rows) :]))


@pytest.mark.parametrize(("age_s", "max_age_s", "counts"), [(5.0, 20.0, 1), (21.0, 20.0, 2), (5.0, 4.0, 2)])
def test_a_size_is_counted_again_when_it_is_old(tmp_path, monkeypatch, age_s, max_age_s, counts):
    now = [1000.0]
    counted: list[Path] = []
    monkeypatch.setattr(site_module, "time", type("Clock", (), {"monotonic": staticmethod(lambda: now[0])}))

    def count(folder: Path) -> int:
        counted.append(folder)
        return 7

    monkeypatch.setattr(site_module.catalogue, "folder_bytes", count)
    sizes = Sizes()
    assert sizes.read_size(tmp_path, max_age_s) is None
    wait_for(lambda: not sizes._counting_since, "the count")
    now[0] += age_s
    assert sizes.read_size(tmp_path, max_age_s) == 7
    wait_for(lambda: not sizes._counting_since, "the count")
    assert len(counted) == counts


def test_a_stamp_of_another_server_or_of_no_state_gets_the_whole_list():
    changing = ChangingList()
    scan = ListedScan(name="a", state="finished", bytes=1)
    stamp = changing.update([scan], "").stamp
    origin, _, number = stamp.partition("-")
    assert number == "1"
    assert not changing.update([scan], stamp).whole
    assert [found.name for found in changing.update([scan], f"{origin}-0").scans] == ["a"]
    for wrong in (
        "",
        origin,
        f"{origin}-",
        f"{origin}--1",
        f"{origin}-01",
        f"{origin}-x",
        f"other-{number}",
        f"{origin}-\u0661",
    ):
        assert changing.update([scan], wrong).whole
    gone = changing.update([], stamp)
    assert (gone.gone, gone.scans, gone.whole) == (["a"], [], False)
    assert changing.update([], gone.stamp).gone == []
