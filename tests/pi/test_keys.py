"""CURVE keys: who knows them gets in, where they are looked for, and that the Pi's secret never has to leave it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import zmq
from zmq.auth import load_certificate

from polysight.pi_controller import checks
from polysight.pi_controller.cli import main
from polysight.pi_controller.finding import attempt
from polysight.pi_controller.keys import COPY, make_keys
from polysight.pi_controller.server import Server
from polysight.shared.config import load_instrument
from polysight.shared.errors import ConfigError
from polysight.shared.sockets import HOST_KEYS, requester
from polysight.shared.tables import decode, to_builtins
from tests.support.paths import REPO, RIG_FILE

ELSEWHERE = "tcp://192.0.2.1:5601"


@pytest.mark.parametrize("right", [True, False])
def test_curve_lets_in_who_knows_the_key(tmp_path, right):
    make_keys(tmp_path / "keys")
    make_keys(tmp_path / "other")
    server = Server("tcp://0.0.0.0:*", "tcp://0.0.0.0:*", tmp_path / "keys", 500, "wires")
    context = zmq.Context()
    client = context.socket(zmq.REQ)
    client.curve_publickey, client.curve_secretkey = load_certificate(tmp_path / "keys" / "host.key_secret")
    client.curve_serverkey = load_certificate(tmp_path / ("keys" if right else "other") / "pi.key")[0]
    client.connect(server.command_address.replace("0.0.0.0", "127.0.0.1"))
    client.send(b"x", zmq.NOBLOCK)
    assert bool(server._commands.poll(5000 if right else 300)) == right
    context.destroy(linger=0)
    server.close()


@pytest.mark.parametrize("right", [True, False])
def test_curve_lets_hear_who_knows_the_key(tmp_path, right):
    make_keys(tmp_path / "keys")
    make_keys(tmp_path / "other")
    server = Server("tcp://0.0.0.0:*", "tcp://0.0.0.0:*", tmp_path / "keys", 500, "wires")
    context = zmq.Context()
    listener = context.socket(zmq.SUB)
    listener.subscribe(b"")
    listener.curve_publickey, listener.curve_secretkey = load_certificate(tmp_path / "keys" / "host.key_secret")
    listener.curve_serverkey = load_certificate(tmp_path / ("keys" if right else "other") / "pi.key")[0]
    listener.connect(server.event_address.replace("0.0.0.0", "127.0.0.1"))
    heard = False
    for _ in range(600 if right else 10):  # until the subscription has arrived
        server.publish([b"event"])
        server.drain()
        if heard := bool(listener.poll(50)):
            break
    assert heard == right
    context.destroy(linger=0)
    server.close()


def test_the_host_needs_what_it_is_told_to_copy_and_no_more(tmp_path):
    """The files that every text names are enough to talk to the Pi, and its secret is not among them."""
    made = {p.name for p in make_keys(tmp_path / "keys")}
    assert "pi.key_secret" in made - set(HOST_KEYS)
    (tmp_path / "host").mkdir()
    for name in HOST_KEYS:
        shutil.copy(tmp_path / "keys" / name, tmp_path / "host")
    server = Server("tcp://0.0.0.0:*", "tcp://0.0.0.0:*", tmp_path / "keys", 500, "wires")
    port = server.command_address.rpartition(":")[2]
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    # The kernel takes any of this machine's own addresses; 0.0.0.0 is none of the loopback ones.
    client = requester(context, f"tcp://0.0.0.0:{port}", tmp_path / "host")
    client.send(b"x")
    assert server._commands.poll(60_000)
    context.destroy(linger=0)
    server.close()
    install = (REPO / "docs/how-to/install.md").read_text(encoding="utf-8")
    assert f"tar -c -C /etc/polysight/keys {' '.join(HOST_KEYS)} |" in install
    for text in (install, COPY, (REPO / "host/doctor/check_pi.py").read_text(encoding="utf-8")):
        assert "copy the folder" not in text
        assert "copy its folder" not in text


def test_a_relative_key_dir_counts_from_the_rig_files_folder(tmp_path, monkeypatch):
    """Whatever the working folder is, also for who resumes a scan by its manifest."""
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


def test_a_host_without_keys_is_told_to_copy_not_to_make_a_second_set(tmp_path):
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    with pytest.raises(ConfigError) as e:
        requester(context, ELSEWHERE, tmp_path)
    context.destroy(linger=0)
    assert e.value.remedy.startswith("copy the Pi's pi.key and host.key_secret here")
    assert str(tmp_path) in e.value.remedy
    assert "polysight-pi keys" not in e.value.remedy


def test_an_ordinary_user_is_told_whose_keys_they_are(config, monkeypatch, capsys):
    """Another user's folder: an error with what to do, no trace."""
    stat = Path.stat

    def refuse(path, **more):
        if path.name.endswith(".key_secret"):
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, **more)

    monkeypatch.setattr(Path, "stat", refuse)
    assert main(["keys", "--config", str(config)]) == 2
    said = capsys.readouterr().err
    assert "Permission denied" in said
    assert "sudo -u polysight" in said
    found = attempt("keys", lambda: checks._keys(config.parent / "keys", (ELSEWHERE,)))
    assert (found.verdict, "sudo -u polysight" in found.remedy) == ("fail", True)
    assert "pi.key_secret: Permission denied" in found.found
