"""A scan resumes with a rig file that differs in the connection settings only."""

import copy
from collections.abc import Iterator
from typing import Any

import pytest
import tomli_w
from tests.support.page.live_view import add_fact, begin_history
from tests.support.rigs import load_rig_table
from tests.support.store.facts import load_facts

from polysight.acquisition.scan import resume_scan
from polysight.cli.main import main
from polysight.store.scan_folder import (
    CHANGEABLE_BOARD_KEYS,
    ScanFolder,
    check_same_scan,
    extract_connection,
    with_connection,
)
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError
from polysight_shared.tables import decode, to_builtins


@pytest.fixture(scope="module")
def begun() -> Instrument:
    table = load_rig_table()
    table["radar"] |= {"servers": {b["name"]: f"192.168.33.1:{70 + k}" for k, b in enumerate(table["boards"])}}
    return decode(table, Instrument, "begun")


def list_leaves(node: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Yield each value of a table with the keys that lead to it."""
    if isinstance(node, dict):
        items = node.items()
    elif isinstance(node, list):
        items = enumerate(node)
    else:
        items = None
    if items is None:
        yield path, node
    for key, value in items or ():
        yield from list_leaves(value, (*path, key))


def make_other_value(value: Any) -> Any:
    if isinstance(value, bool):
        return not value
    if isinstance(value, int | float):
        return value + 1
    return value + "1"


def may_change(path: tuple[str | int, ...]) -> bool:
    """True for settings of the connection, which a resumed scan takes from the given rig file."""
    board = path[0] == "boards" and path[2] in CHANGEABLE_BOARD_KEYS
    return board or path[0] in ("pi", "limits") or path[:2] == ("radar", "servers")


def is_without_effect(path: tuple[str | int, ...]) -> bool:
    """True for settings that may differ and are not taken over.

    The host does not use the port of the stage, and the scan has a copy of its calibration.
    """
    return path[0] == "calibration" or path in (("stage", "port"), ("stage", "baud"))


def test_every_key_is_taken_up_or_refused_by_name(begun):
    """Each number, text and switch of the rig file is changed alone."""
    accepted = 0
    refused = 0
    for path, value in list_leaves(to_builtins(begun)):
        table = copy.deepcopy(to_builtins(begun))
        node: Any = table
        for key in path[:-1]:
            node = node[key]
        node[path[-1]] = make_other_value(value)
        try:
            given_rig = decode(table, Instrument, "given")
        except ConfigError:
            # A value that no rig file may have.
            continue
        assert given_rig != begun
        if may_change(path):
            check_same_scan(begun, given_rig, "mine.toml")
            assert with_connection(begun, extract_connection(given_rig)) == given_rig
            accepted += 1
        elif is_without_effect(path):
            check_same_scan(begun, given_rig, "mine.toml")
            assert with_connection(begun, extract_connection(given_rig)) == begun
        else:
            name = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")
            with pytest.raises(ConfigError) as e:
                check_same_scan(begun, given_rig, "mine.toml")
            assert f"{name} is {value!r} in the scan and {make_other_value(value)!r} there" in e.value.what
            refused += 1
    # A rig file has about a hundred values: both kinds were tested.
    assert accepted > 20
    assert refused > 40


def move_rig(rig: Instrument) -> Instrument:
    """Return the rig with other addresses and another limit."""
    table = to_builtins(rig)
    table["pi"] |= {"command_address": "tcp://10.1.2.3:4", "event_address": "tcp://10.1.2.3:5"}
    table["boards"][1] |= {"card_address": "10.1.2.9"}
    table["limits"] |= {"row_retakes": 7}
    return decode(table, Instrument, "moved")


def test_new_connection_settings_are_used_from_then_on(undisturbed_scan, tmp_path):
    """Readers use them, and later resumes without options. The first settings are still in the manifest."""
    small = undisturbed_scan.copy(tmp_path / "moved")
    scan = ScanFolder.load(small.path)
    begun = scan.instrument
    moved_rig = move_rig(scan.instrument)
    with small._connect_pi():
        assert resume_scan(small.path, rig_now=moved_rig).folder.instrument == moved_rig
        assert resume_scan(small.path).folder.instrument == moved_rig
    scan = ScanFolder.load(small.path)
    assert scan.instrument == moved_rig
    started = load_facts(scan, "scan_started")[0]
    first, second = load_facts(scan, "scan_resumed")
    assert decode(started["instrument"], Instrument, "begun") == begun
    assert first["rig"] == extract_connection(moved_rig)
    assert "rig" not in second
    history = begin_history(started)
    for fact in (first, second):
        add_fact(history, fact)
    assert history.instrument == moved_rig
    assert small.rows() == undisturbed_scan.digests
    assert small.image() == undisturbed_scan.final_image


def test_another_rig_is_refused_before_anything_is_written(undisturbed_scan, tmp_path, capsys):
    small = undisturbed_scan.copy(tmp_path / "other")
    manifest_before = (small.path / "manifest.jsonl").read_bytes()
    table = to_builtins(move_rig(ScanFolder.load(small.path).instrument))
    table["grid"] |= {"columns": 5}
    table["chirp"] |= {"samples": table["chirp"]["samples"] - 1}
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(table))
    assert main(["resume", str(small.path), "--config", str(tmp_path / "rig.toml")]) == ConfigError.exit_status
    messages = capsys.readouterr().err
    assert "grid.columns is 3 in the scan and 5 there" in messages
    assert "chirp.samples" in messages
    assert "pi." not in messages.partition("why:")[0]
    assert (small.path / "manifest.jsonl").read_bytes() == manifest_before
