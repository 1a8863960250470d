"""What is sent to somebody elsewhere: what helps, and neither raw data nor keys, wherever a key lies."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
import tomli_w
import zmq
from zmq.auth import create_certificates

from polysight.host.cli.main import main
from polysight.host.doctor.bench import Wanted, ok
from polysight.host.doctor.bundle import Redactor, write_bundle
from polysight.shared.config import load_instrument
from tests.support.rigs import rig_table

TOKEN = "f00dfacef00dfacef00dfacef00dface"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A rig file with keys, a scan, logs and traces, into each of which a key has found its way."""
    keys = tmp_path / "keys"
    keys.mkdir()
    create_certificates(keys, "host")
    create_certificates(keys, "pi")
    secret = (keys / "host.key_secret").read_text().split('secret-key = "')[1].split('"')[0]
    table = rig_table()
    table["pi"] |= {"key_dir": str(keys)}
    table["radar"] |= {"trace_dir": str(tmp_path / "traces")}
    (tmp_path / "instrument.toml").write_text(f"# {secret}\n{tomli_w.dumps(table)}")
    raw = tmp_path / "scans" / "one" / "raw" / "RH"
    raw.mkdir(parents=True)
    (raw / "0000.bin").write_bytes(b"RAWDATA" * 1000)
    lines = [json.dumps({"fact": "note", "n": n, "told": secret}) for n in range(200)]
    (raw.parents[1] / "manifest.jsonl").write_text("\n".join(lines) + "\n")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "pi.log").write_text(f"connected with {secret}\nserve?token={TOKEN}\n")
    (tmp_path / "traces").mkdir()
    (tmp_path / "traces" / "RH.jsonl").write_text(f'{{"curve_key": "{secret}"}}\n')
    (tmp_path / "secret").write_text(secret)
    return tmp_path


def contents(file: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def made(place: Path) -> dict[str, bytes]:
    rig = load_instrument(place / "instrument.toml")
    wanted = Wanted(place / "instrument.toml", place / "scans")
    write_bundle(place / "found.zip", wanted, rig, [ok("all is well")], "ok all is well\n")
    return contents(place / "found.zip")


def test_no_key_is_in_it_wherever_one_lies(place: Path) -> None:
    found = made(place)
    secret = (place / "secret").read_text()
    keys = [w for f in (place / "keys").iterdir() for w in f.read_text().split('"') if len(w) == 40]
    assert len({*keys}) == 4  # two public, two secret
    assert secret in keys
    for text in found.values():
        for key in (*keys, TOKEN):
            assert key.encode() not in text
    assert b"[removed]" in found["logs/0-pi.log"]


def test_no_raw_data_is_in_it(place: Path) -> None:
    found = made(place)
    assert not any(b"RAWDATA" in text for text in found.values())
    assert not [name for name in found if name.endswith((".bin", ".idx", ".pkt", ".npz", ".npy"))]


def test_what_helps_is_in_it_and_listed_in_it(place: Path) -> None:
    found = made(place)
    assert json.loads(found["findings.json"])[0]["found"] == "all is well"
    assert json.loads(found["versions.json"])["packages"]["numpy"]
    assert json.loads(found["network.json"])["interfaces"]
    assert b"Linux" in found["kernel.txt"]
    assert b"[grid]" in found["rig.toml"]
    manifest = found["scans/one.jsonl"].splitlines()
    assert [json.loads(line)["n"] for line in manifest] == list(range(140, 200))
    listed = found["README.txt"].decode()
    assert all(name.partition("/")[0] in listed for name in found if name != "README.txt")


def test_the_command_writes_it_also_of_a_rig_file_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text("grid = ")
    out = tmp_path / "found.zip"
    assert main(["doctor", "--config", str(tmp_path / "rig.toml"), "--out", str(tmp_path), "--bundle", str(out)]) == 1
    found = contents(out)
    assert json.loads(found["findings.json"])[0]["verdict"] == "error"
    assert found["rig.toml"] == b"grid = "


def test_a_folder_that_is_not_there_is_said_before_the_rig_is_walked(tmp_path: Path) -> None:
    assert main(["doctor", "--config", "none.toml", "--bundle", str(tmp_path / "not" / "found.zip")]) == 3


@pytest.mark.parametrize(
    "text",
    [
        'secret-key = "{}"',
        "token: {}",
        '{{"password": "{}"}}',
        "http://h/?token={}",
        "-----BEGIN A KEY-----\n{}\n",
        "Authorization: Bearer {}",
        "authorization=Basic {}",
        "sent bearer {}",
        'api_key="{}"',
        "APIKEY={}",
    ],
)
def test_what_is_called_a_key_is_taken_out_wherever_it_came_from(text: str) -> None:
    key = zmq.curve_keypair()[1].decode()
    for word in (key.replace('"', "a").replace("'", "a").replace(",", "a").replace("}", "a"), "short-but-secret"):
        assert word not in Redactor([])(text.format(word))


def test_tokens_of_well_known_forms_need_no_name() -> None:
    assert "abcdefghijklmnop" not in Redactor([])("pushed with ghp_abcdefghijklmnopqrst")
    assert "pw99" not in Redactor([])("from http://u:pw99@host:80/x")


def test_what_is_no_key_stays() -> None:
    text = 'key_dir = "/home/lab/keys"\nkeyboard: none\nrows = 200'
    assert Redactor([])(text) == text
