"""`polysight card` against simulated cards: the hop that does not work, and writing the EEPROM."""

import io
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.support.paths import POLYSIGHT
from tests.support.processes import HANG_S, Bench, Ended, wait_for

from polysight.jobs import devices
from polysight_simulators.faults import Faults

NEW_MAC = "12:34:56:78:90:13"


@pytest.fixture
def card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ended]:
    """Function that runs `polysight card ...` in the folder of the rig file."""

    def run(*words: str, typed: str = "") -> Ended:
        monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
        return Bench(tmp_path).run_here("card", *words)

    return run


def read_verdicts(process: Ended) -> dict[str, dict[str, dict[str, str]]]:
    """Return what was found of each hop, by the name of the board and of the hop."""
    return {s["name"]: {hop["hop"]: hop for hop in s["hops"]} for s in json.loads(process.out)}


def test_the_state_of_every_hop_to_every_card_is_reported(cards, card):
    cards("LS", "RH", "RV")
    process = card("--json")
    assert process.status == 0, process.err
    surveys = json.loads(process.out)
    assert [(s["name"], s["ok"], s["fpga_version"], s["silent_hop"]) for s in surveys] == [
        (name, True, "2.8", "") for name in ("LS", "RH", "RV")
    ]
    for name, hops in read_verdicts(process).items():
        for hop in ("host", "route", "link", "card"):
            assert hops[hop]["verdict"] == "ok"
        # LS transmits: its data is not received.
        buffer_verdict = "not checked" if name == "LS" else "ok"
        assert hops["buffer"]["verdict"] in (buffer_verdict, "warning")
        assert hops["radar"]["verdict"] == "not checked"
        receiver = hops["receiver"]
        if name == "LS":
            assert receiver["verdict"] == "not checked"
        elif receiver["verdict"] == "ok":
            assert "real-time priority" in receiver["found"]
        else:
            # The message names the missing right and the remedy.
            assert receiver["verdict"] == "warning"
            assert receiver["why"]
            assert "limits.d" in receiver["remedy"]
    text = card().out
    for part in ("RH (receive_h)", "not recorded", "replies, FPGA 2.8", "bytes granted", "polysight doctor", "core"):
        assert part in text


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["program", "RH", "--mac", "01:00:00:00:00:01", "--yes"], "not the MAC address of one machine"),
        (["program", "RH", "--mac", "12:34", "--yes"], "MAC address"),
        (["program", "RX", "--mac", NEW_MAC, "--yes"], "no board 'RX'"),
        (["program", "RH", "--mac", NEW_MAC, "--at", "127.0.0.1:x", "--yes"], "ADDRESS:PORT"),
        (["program", "RH", "--mac", NEW_MAC], "confirmed with ''"),
        (["reset", "RX"], "no board 'RX'"),
    ],
)
def test_refused_commands_write_nothing_to_a_card(cards, card, words, error):
    running_cards = cards("RH")
    earlier_network = running_cards.endpoints["RH"].card.network
    process = card(*words)
    assert process.status == 2, process
    assert error in process.err
    assert "\n  do: " in process.err
    running_cards.power_cycle("RH")
    assert running_cards.endpoints["RH"].card.network == earlier_network


def program_card(power_cycle: Callable[[], None], folder: Path, typed: str, *words: str) -> str:
    """Run `polysight card program`, and switch the card off and on at its request; return the output."""
    output = folder / "output.txt"
    with output.open("w") as out:
        command = [str(POLYSIGHT), "card", "program", *words, "--mac", NEW_MAC, "--wait", str(HANG_S)]
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=out, stderr=subprocess.STDOUT, text=True, cwd=folder
        )
        assert process.stdin is not None
        with process.stdin:
            process.stdin.write(typed + "\n")
        wait_for(
            lambda: process.poll() is not None or "looking for it" in output.read_text(), "the search for the card"
        )
        assert process.poll() is None, output.read_text()
        power_cycle()
        assert process.wait(HANG_S) == 0, output.read_text()
    return output.read_text()


def test_a_new_card_gets_its_boards_addresses(cards, rig, tmp_path):
    """The card's default address is changed to the board's, with confirmation, and checked after a power cycle."""
    # The new card has the addresses of board LS, and is to get those of RV.
    board_at_default = rig.by_name("LS")
    board = rig.by_name("RV")
    running_cards = cards(more=(board_at_default,))
    address = f"{board_at_default.card_address}:{board_at_default.command_port}"
    options = ("--at", address)
    text = program_card(lambda: running_cards.power_cycle("LS"), tmp_path, board.card_address, "RV", *options)
    for part in ("cannot be read back", NEW_MAC, "switch the card off and on", "FPGA 2.8", f"at {board.card_address}"):
        assert part in text
    assert running_cards.endpoints["LS"].card.network == running_cards.card_network(board)._replace(
        mac=bytes.fromhex(NEW_MAC.replace(":", ""))
    )


def test_a_card_that_keeps_its_address_must_have_been_off(cards, card, rig, tmp_path, monkeypatch):
    running_cards = cards("RH", RH=Faults(boot_s=HANG_S))
    endpoint = running_cards.endpoints["RH"]
    monkeypatch.setattr(devices, "_REPLY_TIMEOUT_S", HANG_S)
    options = ("--mac", NEW_MAC, "--yes", "--wait", "1")
    process = card("program", "RH", *options)
    assert process.status == 5
    assert "written, but the card was not switched off" in process.err
    options = ("--mac", NEW_MAC, "--yes", "--wait", "0")
    process = card("program", "RH", *options)
    assert process.status == 0
    assert "`polysight card` shows" in process.out

    def power_cycle() -> None:
        """The card is off until three requests, a complete round, are lost."""
        running_cards.power_cycle("RH")
        wait_for(lambda: endpoint.counts["requests_unheard"] > 3, "requests to a card that is off")
        endpoint._boots_until_s = 0.0

    assert "it answers at" in program_card(power_cycle, tmp_path, rig.by_name("RH").card_address, "RH")
    assert endpoint.card.network.mac.hex(":") == NEW_MAC


def test_a_card_or_its_radar_is_reset(cards, card):
    """A reset of the card starts its counters again; one of the radar does not."""
    running_cards = cards("RH")
    running_cards.endpoints["RH"].card._packetiser.sequence = 77
    process = card("reset", "RH", "--radar")
    assert process.status == 0
    assert "armed again" in process.out
    assert running_cards.endpoints["RH"].card._packetiser.sequence == 77
    process = card("reset", "RH")
    assert process.status == 0, process
    assert "configures it again" in process.out
    assert running_cards.endpoints["RH"].card._packetiser.sequence == 1


def test_listening_ends_with_a_complete_row_for_any_counters_of_the_card(cards, card, rig):
    """The card is reset first: if its counters continue, the beginning of its record is not known.

    The radars send more than a row, but not more than the receive buffer holds.
    """
    running_cards = cards("LS", "RH", "RV", streamed_bytes=rig.row_bytes + rig.card.payload_bytes)
    packetiser = running_cards.endpoints["RH"].card._packetiser
    packetiser.sequence = 77_777
    packetiser.byte_count = 77_776 * packetiser.payload_bytes
    # The limit is an hour: listening must end with the row.
    process = card("--listen", "3600", "--json")
    for name in ("RH", "RV"):
        radar = read_verdicts(process)[name]["radar"]
        assert radar["verdict"] == "ok", radar
        assert f"{rig.row_bytes} bytes" in radar["found"]
