"""`polysight card` against simulated cards: the hop that does not work, and writing the EEPROM."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import tomli_w
from tests.support.paths import POLYSIGHT
from tests.support.processes import LIMIT_S, Bench, Ended, wait_for

from polysight_shared.tables import to_builtins
from polysight_simulators.cards import bound_udp
from polysight_simulators.faults import Faults

NEW_MAC = "12:34:56:78:90:13"


@pytest.fixture
def card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ended]:
    """Runs `polysight card ...` beside the rig file."""

    def run(*words: str, typed: str = "") -> Ended:
        monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
        return Bench(tmp_path).here("card", *words)

    return run


def verdicts(done: Ended) -> dict[str, dict[str, dict[str, str]]]:
    """Hops by board and name."""
    return {s["name"]: {hop["hop"]: hop for hop in s["hops"]} for s in json.loads(done.out)}


def test_every_hop_of_every_card(cards, card):
    cards("LS", "RH", "RV")
    done = card("--json")
    assert done.status == 0, done.err
    surveys = json.loads(done.out)
    assert [(s["name"], s["ok"], s["fpga_version"], s["silent_hop"]) for s in surveys] == [
        (name, True, "2.8", "") for name in ("LS", "RH", "RV")
    ]
    for name, hops in verdicts(done).items():
        for hop in ("host", "route", "link", "card"):
            assert hops[hop]["verdict"] == "ok"
        received = "not checked" if name == "LS" else "ok"
        assert hops["buffer"]["verdict"] in (received, "warning")
        assert hops["radar"]["verdict"] == "not checked"
        receiver = hops["receiver"]
        if name == "LS":
            assert receiver["verdict"] == "not checked"
        elif receiver["verdict"] == "ok":
            assert "real-time priority" in receiver["found"]
        else:
            # A right is missing: which, and what to do
            assert (receiver["verdict"], receiver["why"] != "") == ("warning", True)
            assert "limits.d" in receiver["remedy"]
    text = card().out
    for part in ("RH (receive_h)", "not recorded", "replies, FPGA 2.8", "bytes granted", "polysight doctor", "core"):
        assert part in text


def test_a_mute_card_is_named_and_its_neighbour_is_sound(cards, card):
    running_cards = cards("RH", "RV", RV=Faults(mute=True))
    done = card("--json")
    assert done.status == 1
    hops = verdicts(done)
    assert hops["RH"]["card"]["verdict"] == "ok"
    assert hops["RV"]["card"]["verdict"] == "error"
    assert "did not answer ALIVE" in hops["RV"]["card"]["found"]
    assert hops["RV"]["card"]["remedy"]
    assert hops["RV"]["receiver"]["verdict"] == "not checked"
    # Nobody plays LS
    assert [s["silent_hop"] for s in json.loads(done.out)] == ["card", "", "card"]
    assert running_cards.endpoints["RV"].counts["requests"] > 0
    text = card().out
    assert "error       card" in text
    assert "not checked receiver, buffer, radar" in text


def test_a_port_in_use_and_a_radar_that_does_not_stream(cards, card, rig):
    cards("RH", streams=True)
    cards("LS", "RV")
    done = card("--listen", "1", "--json")
    assert done.status == 1
    hops = verdicts(done)
    assert hops["RH"]["radar"]["verdict"] == "ok", hops["RH"]["radar"]
    assert int(hops["RH"]["radar"]["found"].split()[0]) > 100
    assert hops["RV"]["radar"]["verdict"] == "error"
    assert "not streaming" in hops["RV"]["radar"]["why"]
    board = rig.by_name("RV")
    with bound_udp(board.host_address, board.data_port):
        hop = verdicts(card("--json"))["RV"]["receiver"]
    assert (hop["verdict"], "is in use" in hop["found"], "ss -ulnp" in hop["remedy"]) == ("error", True, True)


def test_a_buffer_below_two_bursts_is_an_error_with_a_remedy(cards, card, rig, tmp_path):
    cards("LS", "RH", "RV")
    table = to_builtins(rig)
    table["card"]["receive_buffer_bytes"] = 8192
    (tmp_path / "instrument.toml").write_text(tomli_w.dumps(table))
    done = card("--json")
    assert done.status == 1
    hop = verdicts(done)["RH"]["buffer"]
    assert (hop["verdict"], "less than two bursts" in hop["found"]) == ("error", True)
    assert "sysctl -w net.core.rmem_max=" in hop["remedy"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["program", "RH", "--mac", "01:00:00:00:00:01", "--yes"], "not the MAC address of one machine"),
        (["program", "RH", "--mac", "12:34", "--yes"], "MAC address"),
        (["program", "RX", "--mac", NEW_MAC, "--yes"], "no board 'RX'"),
        (["program", "RH", "--mac", NEW_MAC, "--at", "127.0.0.1:x", "--yes"], "ADDRESS:PORT"),
        (["program", "RH", "--mac", NEW_MAC], "confirmed with ''"),
        (["reset", "RX"], "no board 'RX'"),
    ],
)
def test_refused_commands_write_nothing(cards, card, words, says):
    running_cards = cards("RH")
    state_before = running_cards.endpoints["RH"].card.network
    done = card(*words)
    assert done.status == 2, done
    assert says in done.err
    assert "\n  do: " in done.err
    running_cards.power_cycle("RH")
    assert running_cards.endpoints["RH"].card.network == state_before


def program_card(made, name: str, folder: Path, typed: str, *words: str) -> str:
    """What `polysight card program` says while the card `name` is switched off and on once it asks for that."""
    answer = folder / "told.txt"
    with answer.open("w") as out:
        command = [str(POLYSIGHT), "card", "program", *words, "--mac", NEW_MAC, "--wait", str(LIMIT_S)]
        done = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=out, stderr=subprocess.STDOUT, text=True, cwd=folder
        )
        assert done.stdin is not None
        with done.stdin:
            done.stdin.write(typed + "\n")
        wait_for(lambda: done.poll() is not None or "looking for it" in answer.read_text(), "the search for the card")
        assert done.poll() is None, answer.read_text()
        made.power_cycle(name)
        assert done.wait(LIMIT_S) == 0, answer.read_text()
    return answer.read_text()


def test_a_new_card_gets_its_boards_addresses(cards, rig, tmp_path):
    """From the address all cards are sold with to the board's own, typed, and seen there after a power cycle."""
    old = rig.by_name("LS")
    board = rig.by_name("RV")
    running_cards = cards(more=(old,))
    address = f"{old.card_address}:{old.command_port}"
    options = ("--at", address)
    text = program_card(running_cards, "LS", tmp_path, board.card_address, "RV", *options)
    for part in ("cannot be read back", NEW_MAC, "switch the card off and on", "FPGA 2.8", f"at {board.card_address}"):
        assert part in text
    assert running_cards.endpoints["LS"].card.network == running_cards.card_network(board)._replace(
        mac=bytes.fromhex(NEW_MAC.replace(":", ""))
    )


def test_a_card_that_stays_where_it_was_must_have_been_off(cards, card, rig, tmp_path):
    running_cards = cards("RH", RH=Faults(boot_s=4.0))
    options = ("--mac", NEW_MAC, "--yes", "--wait", "1")
    done = card("program", "RH", *options)
    assert done.status == 5
    assert "written, but the card was not switched off" in done.err
    options = ("--mac", NEW_MAC, "--yes", "--wait", "0")
    done = card("program", "RH", *options)
    assert (done.status, "`polysight card` tells" in done.out) == (0, True)
    assert "it answers at" in program_card(running_cards, "RH", tmp_path, rig.by_name("RH").card_address, "RH")
    assert running_cards.endpoints["RH"].card.network.mac.hex(":") == NEW_MAC


def test_reset(cards, card):
    running_cards = cards("RH")
    running_cards.endpoints["RH"].card._packetiser.sequence = 77
    done = card("reset", "RH", "--radar")
    assert (done.status, "armed again" in done.out) == (0, True)
    assert running_cards.endpoints["RH"].card._packetiser.sequence == 77
    done = card("reset", "RH")
    assert (done.status, "configures it anew" in done.out) == (0, True), done
    assert running_cards.endpoints["RH"].card._packetiser.sequence == 1
