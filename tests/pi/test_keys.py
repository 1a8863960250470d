"""CURVE keys: only allowed clients connect, keys are found by the rig file, and the Pi's secret stays on the Pi.

CURVE is ZeroMQ's encryption. Each end has a pair of keys: NAME.key is public, and NAME.key_secret has both.
"""

import errno
import shutil
import threading
from pathlib import Path

import msgspec
import pytest
import zmq
from tests.support.paths import REPO, RIG_FILE
from tests.support.processes import HANG_S, wait_for
from tests.support.refusals import expect_refusal as expect_refused
from tests.support.rigs import load_published_rig
from zmq.auth import load_certificate

from polysight.acquisition.pi_client import PiClient
from polysight_pi import checks
from polysight_pi.checks import run_check
from polysight_pi.cli import main
from polysight_pi.keys import allow_client, make_keys, read_allowed, revoke_client
from polysight_pi.service import Server
from polysight_shared import messages as m
from polysight_shared.config import load_instrument
from polysight_shared.errors import DeviceError, ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.sockets import HOST_KEYS, HandshakeMonitor, create_requester
from polysight_shared.tables import decode, to_builtins

# An address that other machines can reach (192.0.2.0/24 is reserved for documentation).
REMOTE_ADDRESS = "tcp://192.0.2.1:5601"


class HelloExecutor:
    """A minimal executor that only answers Hello, for tests of connections."""

    crash = None
    unresponsive_s = 0.0
    status = m.StatusReply(
        state="idle", homed=False, x_mm=0.0, y_mm=0.0, scan_id="", row_index=-1, take=0, points=0, pulses=0,
        last_seq=0, fault=0, reason="",
    )  # fmt: skip
    hello = m.HelloReply(pi_release="1", firmware="fake", backend="wires", state="idle", scan_id="", last_seq=0)

    def submit(self, command, answer):
        raise AssertionError(command, answer)

    def host_alive(self, scan_id, owner):
        raise AssertionError(scan_id + owner)


@pytest.fixture
def served_pi(tmp_path):
    """A Pi's sockets on all addresses, with keys in `keys`; they serve until the test's end."""
    make_keys(tmp_path / "keys")
    make_keys(tmp_path / "other")
    every_address = "tcp://0.0.0.0:*"
    server = Server(every_address, every_address, tmp_path / "keys", heartbeat_ms=50)
    thread = threading.Thread(target=server.run, args=(HelloExecutor(),))
    thread.start()
    yield server
    server.stop()
    thread.join()
    server.close()


@pytest.fixture
def context():
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield context
    context.destroy(linger=0)


@pytest.fixture
def make_client(context):
    """Function that connects a client; it returns the socket, and a function that is True once its key was refused."""
    sockets = []

    def make(kind, address, secret_of_host, public_of_pi):
        socket = context.socket(kind)
        socket.curve_publickey, socket.curve_secretkey = load_certificate(secret_of_host)
        socket.curve_serverkey, _ = load_certificate(public_of_pi)
        refusals = HandshakeMonitor(socket)
        sockets.append((refusals, socket))
        socket.connect(address.replace("0.0.0.0", "127.0.0.1"))
        return socket, refusals.is_refused

    yield make
    for refusals, socket in sockets:
        refusals.close()
        socket.close(linger=0)


# The client's secret key, and the public key that it takes for the Pi's.
KEYS = {
    "allowed": ("keys/host.key_secret", "keys/pi.key"),
    "another Pi's key": ("keys/host.key_secret", "other/pi.key"),
    "a key that was not allowed": ("other/host.key_secret", "keys/pi.key"),
}


@pytest.mark.parametrize("key_case", KEYS)
def test_only_allowed_keys_connect(tmp_path, served_pi, make_client, key_case):
    secret_of_host, public_of_pi = (tmp_path / name for name in KEYS[key_case])
    client, refused = make_client(zmq.REQ, served_pi.command_address, secret_of_host, public_of_pi)
    client.send(m.pack(m.Hello()))
    listener, _ = make_client(zmq.SUB, served_pi.event_address, secret_of_host, public_of_pi)
    listener.subscribe(b"")
    if key_case == "allowed":
        assert client.poll(HANG_S * 1e3)
        assert isinstance(m.unpack_reply(client.recv()), m.HelloReply)
        assert not refused()
        assert listener.poll(HANG_S * 1e3)
        return
    # A Pi that cannot decrypt the greeting says nothing, which cannot be distinguished from a Pi that is off.
    if key_case != "another Pi's key":
        wait_for(refused, "the refusal")
    assert not listener.poll(300)
    assert not client.poll(0)


def test_a_revoked_client_is_disconnected_immediately_and_the_others_stay(tmp_path, served_pi, make_client):
    """The client's next command is refused although it is connected, and it cannot connect again."""
    keys = tmp_path / "keys"
    public, secret = allow_client(keys, "laptop")
    assert secret.stat().st_mode & 0o077 == 0
    assert set(read_allowed(keys).values()) == {"host", "laptop"}
    clients = {
        name: make_client(zmq.REQ, served_pi.command_address, keys / f"{name}.key_secret", keys / "pi.key")
        for name in ("host", "laptop")
    }

    def ask(name):
        socket, _ = clients[name]
        socket.send(m.pack(m.Hello()))
        assert socket.poll(HANG_S * 1e3)
        return m.unpack_reply(socket.recv())

    assert [type(ask(name)) for name in clients] == [m.HelloReply, m.HelloReply]
    revoke_client(keys, "laptop")
    reply = ask("laptop")
    assert isinstance(reply, m.Refused)
    assert reply.number == PiFault.NOT_OWNER
    assert isinstance(ask("host"), m.HelloReply)
    old_client, refused = make_client(zmq.REQ, served_pi.command_address, secret, keys / "pi.key")
    old_client.send(m.pack(m.Hello()))
    wait_for(refused, "the refusal")
    with expect_refused(ErrorCode.KEY_UNKNOWN, "laptop"):
        revoke_client(keys, "laptop")
    with expect_refused(ErrorCode.NAME_TAKEN, "host"):
        allow_client(keys, "host")
    assert public.is_file()


def test_a_host_with_a_refused_key_gets_that_error_and_not_a_timeout(tmp_path, served_pi, context):
    # The Pi's public key, and a secret key of which the Pi knows nothing.
    (tmp_path / "mine").mkdir()
    shutil.copy(tmp_path / "keys" / "pi.key", tmp_path / "mine")
    shutil.copy(tmp_path / "other" / "host.key_secret", tmp_path / "mine")
    port = served_pi.command_address.rpartition(":")[2]
    events = served_pi.event_address.rpartition(":")[2]
    rig = load_published_rig()
    replace = msgspec.structs.replace
    pi = replace(
        rig.pi, command_address=f"tcp://0.0.0.0:{port}", event_address=f"tcp://0.0.0.0:{events}",
        key_dir=str(tmp_path / "mine"),
    )  # fmt: skip
    client = PiClient(context, replace(rig, pi=pi, limits=replace(rig.limits, command_timeout_s=0.6)))
    with client, expect_refused(ErrorCode.REFUSED_BY_PEER, tmp_path / "mine"):
        client.hello()


def test_a_server_without_keys_is_not_reported_as_refusing_the_key_of_this_host(tmp_path, context):
    """Either end may notice first that keys are missing.

    If the server does, it only disconnects, and the client connects again.
    """
    make_keys(tmp_path)
    rig = load_published_rig()
    replace = msgspec.structs.replace
    with context.socket(zmq.ROUTER) as keyless:
        address = f"tcp://0.0.0.0:{keyless.bind_to_random_port('tcp://127.0.0.1')}"
        pi = replace(rig.pi, command_address=address, event_address=address, key_dir=str(tmp_path))
        client = PiClient(context, replace(rig, pi=pi, limits=replace(rig.limits, command_timeout_s=0.6)))
        codes = []

        def is_reported() -> bool:
            with pytest.raises(DeviceError) as caught:
                client.hello()
            codes.append(caught.value.code)
            return codes[-1] is ErrorCode.MISMATCH

        with client:
            wait_for(is_reported, "that it has no keys")
        assert ErrorCode.REFUSED_BY_PEER not in codes


def test_without_a_list_the_host_key_is_allowed(tmp_path):
    make_keys(tmp_path)
    (tmp_path / "allowed_clients").unlink()
    assert list(read_allowed(tmp_path).values()) == ["host"]


def test_the_files_to_copy_are_enough_for_the_host(tmp_path, served_pi, context):
    """The Pi's secret key is not among the files for the host."""
    copied_names = {p.name for p in (tmp_path / "keys").iterdir()}
    assert "pi.key_secret" in copied_names - set(HOST_KEYS)
    (tmp_path / "host").mkdir()
    for name in HOST_KEYS:
        shutil.copy(tmp_path / "keys" / name, tmp_path / "host")
    port = served_pi.command_address.rpartition(":")[2]
    # A client uses keys for addresses other than loopback. The kernel connects 0.0.0.0, which is not one, to this
    # machine.
    client = create_requester(context, f"tcp://0.0.0.0:{port}", tmp_path / "host")
    client.send(m.pack(m.Hello()))
    assert client.poll(HANG_S * 1e3)
    client.close()
    install = (REPO / "docs/how-to/install.md").read_text(encoding="utf-8")
    assert f"tar -c -C /etc/polysight/keys {' '.join(HOST_KEYS)} |" in install


def test_a_relative_key_dir_counts_from_the_rig_files_folder(tmp_path, monkeypatch):
    """Keys are not read from the working folder, also when a scan is resumed with its manifest."""
    text = (RIG_FILE).read_text(encoding="utf-8")
    (tmp_path / "rig").mkdir()
    path = tmp_path / "rig" / "mine.toml"
    path.write_text(text.replace('key_dir = "/etc/polysight/keys"', 'key_dir = "keys"'))
    for folder in (tmp_path, tmp_path / "rig"):
        monkeypatch.chdir(folder)
        rig = load_instrument(path.relative_to(folder))
        assert rig.pi.key_dir == str(tmp_path / "rig" / "keys")
        assert decode(to_builtins(rig), type(rig), "manifest").pi.key_dir == rig.pi.key_dir
    path.write_text(text)
    assert load_instrument(path).pi.key_dir == "/etc/polysight/keys", "an absolute one stays"


def test_keys_of_another_user_are_an_error_with_its_remedy(config, monkeypatch, capsys):
    stat = Path.stat

    def refuse(path, **more):
        if path.name.endswith(".key_secret"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return stat(path, **more)

    monkeypatch.setattr(Path, "stat", refuse)
    assert main(["keys", "--config", str(config)]) == DeviceError.exit_status
    messages = capsys.readouterr().err
    assert "Permission denied" in messages
    assert "sudo -u polysight" in messages
    finding = run_check("keys", checks._check_keys, config.parent / "keys", (REMOTE_ADDRESS,))
    assert finding.level == "error"
    assert "sudo -u polysight" in finding.do
    assert "pi.key_secret: Permission denied" in finding.what
