"""The bundle of `polysight doctor`: a ZIP file for a report of a fault.

It has the findings of the checks, versions, logs and the ends of the scans' manifests, but no raw data and no keys.
"""

import json
import re
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

# Token of the operator's page
TOKEN = "f00dfacef00dfacef00dfacef00dface"
# Characters of a CurveZMQ key as text
KEY_LENGTH = 40
# Lines of the scan's manifest, and how many of them a bundle has at most.
MANIFEST_LINES = 200
BUNDLED_LINES = 60
# Exit statuses of `polysight doctor`: a check has found an error, and an input does not exist.
FOUND_AN_ERROR = 1
MISSING_INPUT = 3


@pytest.fixture
def rig_folder(tmp_path: Path) -> Path:
    """A folder with a rig file, keys, a scan, logs and traces. Each file except the raw data contains the same key."""
    keys = tmp_path / "keys"
    keys.mkdir()
    create_certificates(keys, "host")
    create_certificates(keys, "pi")
    _, _, text_after_name = (keys / "host.key_secret").read_text().partition('secret-key = "')
    secret = text_after_name.partition('"')[0]
    table = load_rig_table()
    table["pi"] |= {"key_dir": str(keys)}
    table["radar"] |= {"trace_dir": str(tmp_path / "traces")}
    (tmp_path / "instrument.toml").write_text(f"# {secret}\n{tomli_w.dumps(table)}")
    raw = tmp_path / "scans" / "one" / "raw" / "RH"
    raw.mkdir(parents=True)
    (raw / "0000.bin").write_bytes(b"RAWDATA" * 1000)
    lines = [json.dumps({"fact": "note", "n": n, "text": secret}) for n in range(MANIFEST_LINES)]
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
def bundle(rig_folder: Path) -> dict[str, bytes]:
    """Content of the files in the folder's bundle, by name."""
    rig = load_instrument(rig_folder / "instrument.toml")
    options = DoctorOptions(config=rig_folder / "instrument.toml", out=rig_folder / "scans")
    write_bundle(rig_folder / "found.zip", options, rig, [ok("all is well")], "ok all is well\n")
    return read_contents(rig_folder / "found.zip")


def test_the_bundle_has_no_key(rig_folder: Path, bundle: dict[str, bytes]) -> None:
    secret = (rig_folder / "secret").read_text()
    keys = set()
    for file in (rig_folder / "keys").iterdir():
        quoted_texts = file.read_text().split('"')
        keys |= {text for text in quoted_texts if len(text) == KEY_LENGTH}
    # A public and a secret one, of host and Pi.
    assert len(keys) == 4
    assert secret in keys
    for content in bundle.values():
        for key in (*keys, TOKEN):
            assert key.encode() not in content
    assert REDACTION.encode() in bundle["logs/0-pi.log"]


def test_the_bundle_has_no_raw_data(bundle: dict[str, bytes]) -> None:
    assert not any(b"RAWDATA" in content for content in bundle.values())
    assert not [name for name in bundle if name.endswith((".bin", ".idx", ".pkt", ".npz", ".npy"))]


def test_the_bundle_has_findings_versions_and_the_ends_of_manifests(bundle: dict[str, bytes]) -> None:
    assert json.loads(bundle["findings.json"])[0]["found"] == "all is well"
    assert json.loads(bundle["versions.json"])["packages"]["numpy"]
    assert json.loads(bundle["network.json"])["interfaces"]
    assert b"Linux" in bundle["kernel.txt"]
    assert b"[grid]" in bundle["rig.toml"]
    manifest = bundle["scans/one.jsonl"].splitlines()
    last_lines = list(range(MANIFEST_LINES - BUNDLED_LINES, MANIFEST_LINES))
    assert [json.loads(line)["n"] for line in manifest] == last_lines


def test_the_bundle_s_readme_lists_its_files_and_folders(bundle: dict[str, bytes]) -> None:
    readme = bundle["README.txt"].decode()
    for name in bundle:
        file_or_folder = name.partition("/")[0]
        assert file_or_folder in readme or name == "README.txt"


def test_the_command_writes_a_bundle_although_the_rig_file_is_damaged(tmp_path: Path) -> None:
    damaged_file = tmp_path / "rig.toml"
    damaged_file.write_text("grid = ")
    file = tmp_path / "found.zip"
    status = main(["doctor", "--config", str(damaged_file), "--out", str(tmp_path), "--bundle", str(file)])
    assert status == FOUND_AN_ERROR
    bundle = read_contents(file)
    assert json.loads(bundle["findings.json"])[0]["verdict"] == "error"
    assert bundle["rig.toml"] == b"grid = "


def test_a_missing_folder_for_the_bundle_is_refused_before_the_checks_run(tmp_path: Path) -> None:
    """Otherwise the missing rig file would be reported first, with another status."""
    file = tmp_path / "missing" / "found.zip"
    assert main(["doctor", "--config", "none.toml", "--bundle", str(file)]) == MISSING_INPUT


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
def test_the_value_after_a_word_such_as_key_or_token_is_removed(text: str) -> None:
    _, secret_key = zmq.curve_keypair()
    # A character that ends the value in one of these texts is replaced by a letter.
    key = re.sub(r"""["',}]""", "a", secret_key.decode())
    redact = Redactor([])
    for value in (key, "short-but-secret"):
        assert value not in redact(text.format(value))


def test_a_key_with_equals_signs_is_removed_as_a_whole(tmp_path: Path) -> None:
    # "=" is one of the characters of CurveZMQ's keys, and also separates a name from its value.
    key = "0123456789abc=0123456789abc=0123456789ab"
    (tmp_path / "host.key_secret").write_text(f'curve\n    secret-key = "{key}"\n')
    assert Redactor([tmp_path])(f"connected with {key}") == f"connected with {REDACTION}"


def test_tokens_of_github_and_passwords_in_addresses_are_removed() -> None:
    redact = Redactor([])
    assert "abcdefghijklmnop" not in redact("pushed with ghp_abcdefghijklmnopqrst")
    assert "pw99" not in redact("from http://u:pw99@host:80/x")


def test_other_text_is_kept() -> None:
    text = 'key_dir = "/home/lab/keys"\nkeyboard: none\nrows = 200'
    assert Redactor([])(text) == text


def test_a_full_disk_leaves_the_earlier_bundle_and_no_incomplete_one(tmp_path: Path) -> None:
    file = tmp_path / "found.zip"
    file.write_bytes(b"earlier")
    full_disk = FaultyDisk(tmp_path, fault="short", at=1)
    options = DoctorOptions(config=tmp_path / "instrument.toml")
    with full_disk(), pytest.raises(DeviceError):
        write_bundle(file, options, rig=None, findings=[ok("fine")], text="fine")
    assert file.read_bytes() == b"earlier"
    assert list(tmp_path.iterdir()) == [file]
