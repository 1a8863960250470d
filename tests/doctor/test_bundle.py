"""The bundle has findings, versions, logs and manifests, and neither raw data nor keys."""

import json
import zipfile
from pathlib import Path

import pytest
import tomli_w
import zmq
from tests.support.rigs import load_rig_table
from tests.support.store.faulty_disk import FaultyDisk
from zmq.auth import create_certificates

from polysight.cli.main import main
from polysight.doctor.bundle import REDACTION, Redactor, write_bundle
from polysight.doctor.context import DoctorOptions, ok
from polysight_shared.config import load_instrument
from polysight_shared.errors import DeviceError

TOKEN = "f00dfacef00dfacef00dfacef00dface"


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A rig file with keys, a scan, logs and traces, each of which contains a key."""
    keys = tmp_path / "keys"
    keys.mkdir()
    create_certificates(keys, "host")
    create_certificates(keys, "pi")
    secret = (keys / "host.key_secret").read_text().split('secret-key = "')[1].split('"')[0]
    table = load_rig_table()
    table["pi"] |= {"key_dir": str(keys)}
    table["radar"] |= {"trace_dir": str(tmp_path / "traces")}
    (tmp_path / "instrument.toml").write_text(f"# {secret}\n{tomli_w.dumps(table)}")
    raw = tmp_path / "scans" / "one" / "raw" / "RH"
    raw.mkdir(parents=True)
    (raw / "0000.bin").write_bytes(b"RAWDATA" * 1000)
    lines = [json.dumps({"fact": "note", "n": n, "text": secret}) for n in range(200)]
    (raw.parents[1] / "manifest.jsonl").write_text("\n".join(lines) + "\n")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "pi.log").write_text(f"connected with {secret}\nserve?token={TOKEN}\n")
    (tmp_path / "traces").mkdir()
    (tmp_path / "traces" / "RH.jsonl").write_text(f'{{"curve_key": "{secret}"}}\n')
    (tmp_path / "secret").write_text(secret)
    return tmp_path


def read_contents(file: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture
def bundle(place: Path) -> dict[str, bytes]:
    rig = load_instrument(place / "instrument.toml")
    options = DoctorOptions(place / "instrument.toml", place / "scans")
    write_bundle(place / "found.zip", options, rig, [ok("all is well")], "ok all is well\n")
    return read_contents(place / "found.zip")


def test_the_bundle_has_no_key(place: Path, bundle: dict[str, bytes]) -> None:
    secret = (place / "secret").read_text()
    keys = [w for f in (place / "keys").iterdir() for w in f.read_text().split('"') if len(w) == 40]
    # Two public, two secret
    assert len({*keys}) == 4
    assert secret in keys
    for text in bundle.values():
        for key in (*keys, TOKEN):
            assert key.encode() not in text
    assert REDACTION.encode() in bundle["logs/0-pi.log"]


def test_the_bundle_has_no_raw_data(bundle: dict[str, bytes]) -> None:
    assert not any(b"RAWDATA" in text for text in bundle.values())
    assert not [name for name in bundle if name.endswith((".bin", ".idx", ".pkt", ".npz", ".npy"))]


def test_the_bundle_has_findings_versions_and_the_end_of_manifests_and_lists_its_files(
    bundle: dict[str, bytes],
) -> None:
    assert json.loads(bundle["findings.json"])[0]["found"] == "all is well"
    assert json.loads(bundle["versions.json"])["packages"]["numpy"]
    assert json.loads(bundle["network.json"])["interfaces"]
    assert b"Linux" in bundle["kernel.txt"]
    assert b"[grid]" in bundle["rig.toml"]
    manifest = bundle["scans/one.jsonl"].splitlines()
    assert [json.loads(line)["n"] for line in manifest] == list(range(140, 200))
    listed = bundle["README.txt"].decode()
    assert all(name.partition("/")[0] in listed for name in bundle if name != "README.txt")


def test_the_command_writes_a_bundle_although_the_rig_file_is_damaged(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text("grid = ")
    out = tmp_path / "found.zip"
    assert main(["doctor", "--config", str(tmp_path / "rig.toml"), "--out", str(tmp_path), "--bundle", str(out)]) == 1
    contents_of_bundle = read_contents(out)
    assert json.loads(contents_of_bundle["findings.json"])[0]["verdict"] == "error"
    assert contents_of_bundle["rig.toml"] == b"grid = "


def test_a_missing_folder_is_refused_before_the_checks_run(tmp_path: Path) -> None:
    assert main(["doctor", "--config", "none.toml", "--bundle", str(tmp_path / "not" / "found.zip")]) == 3


@pytest.mark.parametrize(
    "text",
    [
        'secret-key = "{}"',
        "token: {}",
        "psk={}",
        'wpa_psk = "{} and more"',
        'passphrase = "{} with words behind it"',
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
def test_the_value_of_a_name_like_key_or_token_is_removed(text: str) -> None:
    key = zmq.curve_keypair()[1].decode()
    for word in (key.replace('"', "a").replace("'", "a").replace(",", "a").replace("}", "a"), "short-but-secret"):
        assert word not in Redactor([])(text.format(word))


def test_a_key_with_equals_signs_is_removed_as_a_whole(tmp_path: Path) -> None:
    # Z85, the form of CurveZMQ's keys, has "=" among its characters: one piece between them may be short.
    key = "0123456789abc=0123456789abc=0123456789ab"
    (tmp_path / "host.key_secret").write_text(f'curve\n    secret-key = "{key}"\n')
    assert Redactor([tmp_path])(f"connected with {key}") == f"connected with {REDACTION}"


def test_tokens_of_known_forms_are_removed_without_a_name() -> None:
    assert "abcdefghijklmnop" not in Redactor([])("pushed with ghp_abcdefghijklmnopqrst")
    assert "pw99" not in Redactor([])("from http://u:pw99@host:80/x")


def test_other_text_is_kept() -> None:
    text = 'key_dir = "/home/lab/keys"\nkeyboard: none\nrows = 200'
    assert Redactor([])(text) == text


def test_a_bundle_that_cannot_be_written_leaves_the_earlier_one(tmp_path: Path) -> None:
    """Also on a full disk: no half archive."""
    file = tmp_path / "found.zip"
    file.write_bytes(b"earlier")
    with FaultyDisk(tmp_path, "short", 1)(), pytest.raises(DeviceError):
        write_bundle(file, DoctorOptions(tmp_path / "instrument.toml"), None, [ok("fine")], "fine")
    assert file.read_bytes() == b"earlier"
    assert list(tmp_path.iterdir()) == [file]
