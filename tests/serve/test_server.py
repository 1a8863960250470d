"""The server: access to commands, access to pages, and slow pages."""

import gc
import hmac
import json
import re
import socket
import sys
import threading
from contextlib import suppress
from typing import get_args

import pytest
import segno
import uvicorn
from tests.support.page.asking import TOKEN, ask
from tests.support.page.live_view import open_control, serve_view
from tests.support.processes import HANG_S, wait_for

from polysight.acquisition.control import ScanCommand
from polysight.cli.main import build_parser
from polysight.serve.commands import Format
from polysight.serve.front import BACKLOG, STATIC, EndingServer
from polysight.serve.guard import TOKEN_HEADER, Access
from polysight.serve.server import (
    REMOTE_ADDRESS,
    ServerAddress,
    describe_server,
    draw_code,
    find_addresses,
    make_access,
)
from polysight_shared.errors import ErrorCode


@pytest.fixture
def desk(growing):
    """A running scan without events so far: its folder, and the object that receives the commands."""
    growing.grow_until("scan_started")
    with open_control(growing.path) as stop:
        yield growing.path, stop


def test_only_a_post_with_the_token_in_its_header_commands_a_scan(desk, watching):
    """A token in the address does not count: addresses are stored in histories and logs."""
    folder, stop = desk
    with serve_view(watching(folder, control=True), TOKEN) as view:
        for headers in ({}, {TOKEN_HEADER: ""}, {TOKEN_HEADER: TOKEN + "s"}, {TOKEN_HEADER: TOKEN[:-1]}):
            for command in ScanCommand:
                status, body, _ = ask(view, f"/api/control/{command}?token={TOKEN}", "POST", **headers)
                assert status == 403
                assert "token" in json.loads(body)["what"]
        for method in ("GET", "HEAD", "PUT", "DELETE", "OPTIONS", "TRACE", "PATCH"):
            assert ask(view, "/api/control/abort", method, **{TOKEN_HEADER: TOKEN})[0] in (404, 405)
        assert not stop.after_row
        assert not stop.paused
        for command, is_paused_after in ((ScanCommand.PAUSE, True), (ScanCommand.CONTINUE, False)):
            assert ask(view, f"/api/control/{command}", "POST", **{TOKEN_HEADER: TOKEN})[0] == 200
            assert stop.paused is is_paused_after
        assert ask(view, "/api/control/destroy", "POST", **{TOKEN_HEADER: TOKEN})[0] == 400


def test_a_view_is_read_only_unless_control_is_allowed(desk, watching):
    folder, stop = desk
    watch = watching(folder)
    with serve_view(watch) as view:
        for headers in ({}, {TOKEN_HEADER: ""}, {TOKEN_HEADER: TOKEN}):
            status, body, _ = ask(view, "/api/control/abort", "POST", **headers)
            assert (status, json.loads(body)["code"]) == (403, ErrorCode.READ_ONLY)
    assert json.loads(watch.state.data)["control"] is False
    assert not stop.after_row


def test_tokens_are_compared_in_constant_time(desk, watching, monkeypatch):
    """The standard library has such a comparison. If it says that the right token differs, the command is refused."""
    compared = []

    def record_and_deny(given: bytes, expected: bytes) -> bool:
        compared.append((given, expected))
        return False

    monkeypatch.setattr(hmac, "compare_digest", record_and_deny)
    folder, _ = desk
    with serve_view(watching(folder, control=True), TOKEN) as view:
        assert ask(view, "/api/control/pause", "POST", **{TOKEN_HEADER: TOKEN})[0] == 403
    assert (TOKEN.encode(), TOKEN.encode()) in compared


def test_a_command_to_a_finished_scan_is_refused_with_a_remedy(finished_scan, watching):
    with serve_view(watching(finished_scan, control=True), TOKEN) as view:
        status, body, _ = ask(view, "/api/control/pause", "POST", **{TOKEN_HEADER: TOKEN})
    assert status == 409
    assert "polysight resume" in json.loads(body)["do"]


def test_by_default_only_this_machine_reaches_the_server():
    args = build_parser().parse_args(["preview", "scans/one"])
    assert (args.host, args.port) == ("127.0.0.1", 8080)
    assert args.control is False
    assert all(ServerAddress(host).loopback for host in (args.host, "localhost", "::1", "127.3.2.1"))
    assert not any(ServerAddress(host).loopback for host in ("0.0.0.0", "::", "192.168.33.30", "pi.lab"))


def test_the_page_loads_nothing_from_other_servers():
    """The one address in its files is the name of the SVG format, which is not loaded."""
    for path in STATIC.iterdir():
        addresses = set(re.findall(r"https?://[^\s\"'<)]+", path.read_text(encoding="utf-8")))
        assert addresses <= {"http://www.w3.org/2000/svg"}, path
    assert 'src="' in (STATIC / "frame.html").read_text()


def has_rows(rows):
    """Function that is true of a state whose pictures have this number of rows."""

    def has_these_rows(state):
        pictures = state.get("pictures")
        return pictures is not None and pictures["rows"] == rows

    return has_these_rows


def test_clients_that_never_read_their_events_delay_no_other_client(growing, watching):
    watch = watching(growing.path, lapse_s=1e6)
    growing.touch_alive()
    with serve_view(watch) as view:
        deaf_clients = []
        for _ in range(8):
            connection = socket.socket()
            # A small buffer: the server cannot send everything to a client that does not read.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            connection.connect(("127.0.0.1", view.port))
            connection.sendall(b"GET /api/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            deaf_clients.append(connection)
        for rows in (1, 2, 3):
            growing.grow_until("row_committed")
            watch.wait_for(has_rows(rows))
            _, body, _ = ask(view, "/api/state")
            assert json.loads(body)["pictures"]["rows"] == rows
        for connection in deaf_clients:
            connection.close()


# A client that does not read the answer, and one whose request is not complete.
@pytest.mark.parametrize("request_head", [b"GET / HTTP/1.1\r\nHost: a\r\n\r\n", b"GET / HT"])
def test_connections_end_with_their_server(request_head):
    async def answer_much(_scope, _receive, send):
        await send({"type": "http.response.start", "status": 200})
        # 64 MiB, more than the system's buffers hold.
        await send({"type": "http.response.body", "body": bytes(1 << 26)})

    config = uvicorn.Config(answer_much, host="127.0.0.1", port=0, lifespan="off", log_config=None)
    config.timeout_graceful_shutdown = 0
    server = EndingServer(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    wait_for(lambda: server.started, "the server serves")
    address = server.servers[0].sockets[0].getsockname()
    with socket.create_connection(address) as deaf_client:
        deaf_client.sendall(request_head)
        wait_for(lambda: len(server.server_state.connections) == 1, "the server has the connection")
        server.should_exit = True
        thread.join(HANG_S)
        # Whatever is still open is reported as a ResourceWarning, which fails the test.
        gc.collect()
        assert not server.server_state.connections


def read_queue_length(listener: socket.socket) -> int:
    """Return how many connections the kernel queues for a listening socket, which is the limit given to `listen`.

    For these sockets Linux reports it in the field `tcpi_sacked` of `struct tcp_info`, bytes 28 to 31.
    """
    return int.from_bytes(listener.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 32)[28:32], sys.byteorder)


@pytest.mark.skipif(sys.platform != "linux", reason="struct tcp_info is Linux's")
def test_connections_wait_in_the_longest_queue_that_the_system_allows():
    """uvicorn is configured with a shorter queue, of 100 connections here."""

    async def ignore(_scope, _receive, _send):
        """No requests come."""

    with socket.create_server(("127.0.0.1", 0), backlog=BACKLOG) as listener:
        # The kernel shortens the requested length to its limit, net.core.somaxconn.
        longest = read_queue_length(listener)
        server = EndingServer(uvicorn.Config(ignore, lifespan="off", log_config=None, backlog=100))
        thread = threading.Thread(target=server.run, args=([listener],))
        thread.start()
        wait_for(lambda: server.started, "the server serves")
        length = read_queue_length(listener)
        server.should_exit = True
        thread.join(HANG_S)
    assert length == longest
    assert longest > 100


def show_on_terminal(text: str, black_text: bool) -> list[list[bool]]:
    """Return the rows of modules, True for dark, of a code on a terminal whose own text is black or white.

    A character shows two modules, one above the other, by half blocks of Unicode.
    """
    # Escape codes: the terminal's own colours, and black (16 of 256) on white (231). Values: whether the foreground is
    # dark, and the background.
    colours = {"0": (black_text, not black_text), "38;5;16;48;5;231": (True, False)}
    # Colours of the upper and the lower half of each character, 0 for the foreground and 1 for the background. The
    # characters are a space, the upper half, the lower half and the full block.
    blocks = {" ": (1, 1), "\u2580": (0, 1), "\u2584": (1, 0), "\u2588": (0, 0)}
    rows: list[list[bool]] = []
    dark = colours["0"]
    for line in text.splitlines():
        upper: list[bool] = []
        lower: list[bool] = []
        for code, block in re.findall(r"\033\[([0-9;]+)m|(.)", line):
            if code:
                dark = colours[code]
                continue
            top, bottom = blocks[block]
            upper.append(dark[top])
            lower.append(dark[bottom])
        rows += [upper, lower]
    return rows


@pytest.mark.parametrize("black_text", [True, False])
def test_a_qr_code_is_dark_on_light_whatever_the_terminal_s_colours_are(black_text):
    """A phone's camera does not read a code that is light on dark."""
    address = f"http://192.168.33.7:8080/#token={TOKEN}"
    expected = [[bool(module) for module in row] for row in segno.make(address, error="l").matrix_iter()]
    modules = show_on_terminal(draw_code(address), black_text)
    assert modules[: len(expected)] == expected
    # An odd number of rows is filled up with an empty one.
    assert not any(map(any, modules[len(expected) :]))


@pytest.mark.parametrize("control", [False, True])
@pytest.mark.parametrize(
    ("place", "is_private"),
    [
        (ServerAddress(), True),
        (ServerAddress("localhost"), True),
        (ServerAddress(hosts=("lab.example.org",)), False),
        (ServerAddress("0.0.0.0"), False),
        (ServerAddress("0.0.0.0", hosts=("lab.example.org",)), False),
    ],
    ids=str,
)
def test_clients_of_other_machines_need_the_token(place, is_private, control, tmp_path, monkeypatch):
    """Behind a reverse proxy all clients have this machine's address, also on a server without commands."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        access = make_access(place, listener, control)
    assert access.loopback is is_private
    assert bool(access.token) is (control or not is_private)


def test_a_server_of_all_interfaces_names_each_address_of_this_machine():
    addresses = find_addresses()
    text = describe_server(Access(TOKEN, loopback=False, control=True), "scans", ("0.0.0.0", 8080))
    for name in [*addresses, socket.gethostname()]:
        assert f"http://{name}:8080/#token={TOKEN}\n" in text
    for address in addresses:
        # Only an address of this machine can be bound.
        with socket.socket() as listener:
            listener.bind((address, 0))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect(REMOTE_ADDRESS)
        assert addresses[0] == probe.getsockname()[0]


def test_the_page_offers_every_format_of_exports():
    page = (STATIC / "scan.html").read_text(encoding="utf-8")
    assert set(re.findall(r'type="checkbox" name="(\w+)"', page)) == set(get_args(Format))
