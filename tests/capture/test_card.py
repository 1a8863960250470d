"""The control client with a card that answers from another port, late, wrongly, or not at all."""

import itertools
import select
import time
from types import SimpleNamespace

import pytest
from hypothesis import given, strategies as st
from tests.support.capture.cards import reply
from tests.support.processes import HANG_S, wait_for
from tests.support.refusals import expect_refusal

from polysight.capture import card, dca1000
from polysight.capture.card import CardClient, EepromSettings, program_eeprom, survey_cards
from polysight.capture.dca1000 import Code, Status
from polysight.capture.network import neighbour_mac
from polysight_shared.config import Card
from polysight_shared.errors import ErrorCode
from polysight_simulators.cards import Network
from polysight_simulators.faults import Faults

# No bit of the status is set.
NO_STATUS = Status(0)
# Version 2.8 as the card encodes it: the major number in bits 0 to 6, the minor one in bits 7 to 13.
VERSION_2_8 = 2 | 8 << 7


def wait_until_readable(client: CardClient) -> None:
    """Wait until a datagram waits in the socket of the client."""
    readable, _, _ = select.select([client], [], [], HANG_S)
    assert readable


def test_a_card_is_configured_with_the_bytes_that_a_real_card_accepted(scripted_card):
    def answer(code, _):
        if code == Code.VERSION:
            return [reply(code, VERSION_2_8)]
        return [reply(code)]

    client, card = scripted_card(answer)
    client.check_alive()
    client.configure(Card())
    assert str(client.read_version()) == "2.8"
    client.record_start()
    client.record_stop()
    client.reset_fpga()
    client.reset_radar()
    assert card.seen == [
        (Code.ALIVE, b""),
        (Code.CONFIGURE_FPGA, bytes.fromhex("01010102031e")),
        (Code.CONFIGURE_PACKET, bytes.fromhex("be05350c0000")),
        (Code.VERSION, b""),
        (Code.RECORD_START, b""),
        (Code.RECORD_STOP, b""),
        (Code.RESET_FPGA, b""),
        (Code.RESET_RADAR, b""),
    ]


@pytest.mark.parametrize("source_port", [1024, 4098, 0])
def test_replies_and_status_count_from_any_source_port(scripted_card, source_port):
    """Only the address identifies a card, so the socket is not connected to one port."""
    client, _ = scripted_card(
        lambda code, _: [reply(Code.STATUS, Status.NO_LVDS_DATA), reply(code, VERSION_2_8)], source_port=source_port
    )
    assert str(client.read_version()) == "2.8"
    assert client.take_status() == Status.NO_LVDS_DATA
    assert client.strangers == 0
    with pytest.raises(OSError, match="not connected"):
        client._socket.getpeername()


def test_status_messages_are_not_replies(scripted_card):
    client, card = scripted_card(
        lambda code, _: [reply(Code.STATUS, Status.LVDS_BUFFER_FULL), reply(Code.VERSION, 1), b"noise", reply(code)]
    )
    client.check_alive()
    assert client.take_status() == Status.LVDS_BUFFER_FULL
    client.record_start()
    card.say(reply(Code.STATUS, Status.RECORD_COMPLETED))
    wait_for(lambda: Status.RECORD_COMPLETED in client.take_status(), "the status")
    assert client.take_status() == Status.LVDS_BUFFER_FULL | Status.RECORD_COMPLETED
    assert client.strangers == 2


def test_a_command_whose_reply_was_lost_is_sent_again(scripted_card):
    client, card = scripted_card(lambda code, _: [reply(code)], unanswered=[(Code.ALIVE, 1)])
    client.check_alive()
    assert [c for c, _ in card.seen] == [Code.ALIVE, Code.ALIVE]


def test_a_reply_that_waits_while_the_program_is_stopped_is_not_lost(scripted_card, monkeypatch):
    """The program is delayed after its request, or the machine sleeps: it reads the reply after the timeout."""
    client, card_of_board = scripted_card(lambda code, _: [reply(code)])
    requests = []
    # Each reading of the clock is longer after the one before than any timeout.
    clock_s = itertools.count(0.0, 1e6)

    def encode(code, data):
        requests.append(code)
        return dca1000.encode_request(code, data)

    def monotonic() -> float:
        # After the request time passes only when the reply waits in the socket; then the timeout is over.
        if requests:
            wait_until_readable(client)
        return next(clock_s)

    monkeypatch.setattr(card, "dca1000", SimpleNamespace(**vars(dca1000) | {"encode_request": encode}))
    monkeypatch.setattr(card, "time", SimpleNamespace(monotonic=monotonic))
    client.check_alive()
    assert [code for code, _ in card_of_board.seen] == [Code.ALIVE]


def test_a_flood_of_replies_of_another_code_ends_a_command_with_an_error(scripted_card, monkeypatch):
    """The socket is never empty; the clock shows the end of the timeout."""
    client, _ = scripted_card(lambda *_: [])
    datagrams = itertools.repeat((reply(Code.VERSION), (client.board.card_address, 1024)))
    flood = SimpleNamespace(
        recvfrom=lambda _: next(datagrams), sendto=lambda *_: None, close=client.close, fileno=client.fileno
    )
    monkeypatch.setattr(client, "_socket", flood)
    monkeypatch.setattr(card.select, "select", lambda readable, *_: (readable, [], []))
    monkeypatch.setattr(card, "time", SimpleNamespace(monotonic=itertools.count(0.0, 1e3).__next__))
    with expect_refusal(ErrorCode.NO_ANSWER, "ALIVE"):
        client.check_alive()
    assert client.take_status() == NO_STATUS


def test_record_start_is_never_sent_twice_without_a_stop(scripted_card):
    client, card = scripted_card(lambda code, _: [reply(code)], unanswered=[(Code.RECORD_START, 1)])
    client.record_start()
    assert [c for c, _ in card.seen] == [Code.RECORD_START, Code.RECORD_STOP, Code.RECORD_START]


def test_a_refusal_is_an_error_except_that_of_a_stop(scripted_card):
    """A card that does not record refuses to stop."""
    refused = 1
    client, _ = scripted_card(lambda code, _: [reply(code, refused)])
    client.record_stop()
    with expect_refusal(ErrorCode.REFUSED_BY_PEER, "CONFIGURE_FPGA"):
        client.configure(Card())


def test_the_error_of_a_silent_card_names_it_after_three_requests(scripted_card):
    client, card = scripted_card(lambda *_: [], unanswered=[(Code.ALIVE, n) for n in (1, 2, 3)])
    with expect_refusal(ErrorCode.NO_ANSWER, "RV", ":4202", "ALIVE", "EEPROM"):
        client.check_alive()
    wait_for(lambda: len(card.seen) == 3, "three requests")


def test_a_command_port_in_use_is_an_error_with_the_command_that_finds_its_user(scripted_card):
    client, _ = scripted_card(lambda *_: [])
    with expect_refusal(ErrorCode.BUSY, client.board.command_port, "ss -ulnp"):
        CardClient(client.board, 1.0)


def test_a_late_status_between_the_start_and_its_reply_does_not_end_the_record(scripted_card):
    """The status is that of the previous record."""

    def answer(code, number):
        is_second_start = code == Code.RECORD_START and number == 2
        if is_second_start:
            return [reply(Code.STATUS, Status.RECORD_COMPLETED), reply(code)]
        return [reply(code)]

    client, _ = scripted_card(answer)
    client.record_start()
    client.record_stop()
    client.record_start()
    assert client.take_status() == NO_STATUS


def test_a_late_status_before_the_start_does_not_end_the_record(scripted_card):
    """The status is that of the previous record; it comes after the stop."""
    client, card = scripted_card(lambda code, _: [reply(code)])
    client.record_start()
    client.record_stop()
    card.say(reply(Code.STATUS, Status.RECORD_COMPLETED | Status.DDR_FULL))
    wait_until_readable(client)
    client.record_start()
    assert client.take_status() == NO_STATUS


def test_wait_for_a_completed_record_has_a_timeout(scripted_card):
    def answers(code, _):
        yield reply(code)
        if code == Code.RECORD_STOP:
            time.sleep(0.1)
            yield reply(Code.STATUS, Status.RECORD_COMPLETED)

    client, _ = scripted_card(answers)
    client.record_start()
    client.record_stop()
    client.wait_completed(HANG_S)
    assert client.take_status() == Status.RECORD_COMPLETED
    client.record_start()
    client.wait_completed(0.05)
    assert client.take_status() == NO_STATUS


def test_addresses_in_the_eeprom_have_their_last_byte_first():
    settings = EepromSettings(
        host_address="192.168.33.30",
        card_address="192.168.33.181",
        card_mac="12:34:56:78:90:13",
        command_port=4200,
        data_port=4201,
    )
    host = "1e 21 a8 c0"
    card_itself = "b5 21 a8 c0"
    mac = "13 90 78 56 34 12"
    # 4200 is 0x1068, and 4201 is 0x1069.
    ports = "68 10 69 10"
    assert settings.encode().hex(" ") == f"{host} {card_itself} {mac} {ports}"


@given(
    net=st.tuples(st.integers(1, 223), st.integers(0, 255), st.integers(0, 255)),
    ends=st.lists(st.integers(1, 254), min_size=2, max_size=2, unique=True),
    mac=st.binary(min_size=5, max_size=5).filter(any),
    ports=st.lists(st.integers(1025, 65535), min_size=2, max_size=2, unique=True),
)
def test_the_card_decodes_the_settings_sent(net, ends, mac, ports):
    host, card = (".".join(map(str, (*net, end))) for end in ends)
    settings = EepromSettings(host, card, (b"\2" + mac).hex(":"), *ports)
    read = Network.decode(settings.encode())
    assert tuple(read) == (host, card, b"\2" + mac, *ports)
    assert card in settings.text()


@pytest.mark.parametrize(
    "addresses",
    [
        {"card_address": "192.168.33.30"},
        {"card_address": "192.168.34.180"},
        {"card_address": "192.168.33.255"},
        {"card_address": "192.168.33"},
        {"host_address": "224.0.0.1", "card_address": "224.0.0.2"},
        {"card_mac": "01:00:00:00:00:01"},
        {"card_mac": "00:00:00:00:00:00"},
        {"card_address": "192.168.33.0"},
        {"card_mac": "12:34"},
        {"card_mac": "12:34:56:78:90:12:34"},
        {"card_mac": "wrong"},
        {"command_port": 1024},
        {"data_port": 1024},
        {"data_port": 65536},
        {"data_port": 4096},
    ],
)
def test_a_card_that_could_not_be_reached_is_refused(addresses):
    usable_addresses = {"host_address": "192.168.33.30", "card_address": "192.168.33.180"}
    EepromSettings(**usable_addresses)
    EepromSettings(**usable_addresses, command_port=1025, data_port=65535)
    with expect_refusal(ErrorCode.VALUE_INVALID):
        EepromSettings(**(usable_addresses | addresses))


def read_settings(client: CardClient) -> EepromSettings:
    return EepromSettings.of_board(client.board, "12:34:56:78:90:13")


def make_answers(status: int = 0, answer: int = 0):
    """Answers of a card that reports `status` and replies `answer` when it is to write its EEPROM."""

    def answers(code: int, _: int) -> list[bytes]:
        if code != Code.CONFIGURE_EEPROM:
            return [reply(code)]
        if status:
            return [reply(Code.STATUS, status), reply(code, answer)]
        return [reply(code, answer)]

    return answers


def test_the_eeprom_is_written_once_after_a_confirmation(scripted_card):
    client, card = scripted_card(make_answers())
    settings = read_settings(client)
    program_eeprom(client, settings, settings.confirmation)
    assert card.seen == [(Code.ALIVE, b""), (Code.CONFIGURE_EEPROM, settings.encode())]


@pytest.mark.parametrize("confirmed", ["", "yes", "192.168.33.180"])
def test_without_the_right_confirmation_nothing_is_sent(scripted_card, confirmed):
    client, card = scripted_card(make_answers())
    with expect_refusal(ErrorCode.VALUE_INVALID, client.board.card_address):
        program_eeprom(client, read_settings(client), confirmed)
    assert card.seen == []


@pytest.mark.parametrize(
    ("status", "answer", "unanswered", "code"),
    [
        (Status.EEPROM_FAILURE, 0, [], ErrorCode.REFUSED_BY_PEER),
        (0, 1, [], ErrorCode.REFUSED_BY_PEER),
        (0, 0, [(Code.CONFIGURE_EEPROM, 1)], ErrorCode.NO_ANSWER),
    ],
)
def test_a_card_that_could_not_write_its_eeprom_is_not_asked_again(scripted_card, status, answer, unanswered, code):
    client, card = scripted_card(make_answers(status, answer), unanswered=unanswered)
    settings = read_settings(client)
    with expect_refusal(code):
        program_eeprom(client, settings, settings.confirmation)
    wait_for(lambda: len(card.seen) > 1, "the command")
    assert [code for code, _ in card.seen] == [Code.ALIVE, Code.CONFIGURE_EEPROM]


@pytest.mark.parametrize(("repeats", "answers", "is_alone"), [(0, 1, True), (0, 2, False), (1, 2, True), (1, 3, False)])
def test_a_late_answer_is_not_taken_for_that_of_a_second_card(scripted_card, monkeypatch, repeats, answers, is_alone):
    """The answer to the first request comes with that to the second one: one card has answered both.

    More answers than requests show a second card with the same address.
    """
    client, _ = scripted_card(
        lambda code, _: [reply(code, VERSION_2_8)] * answers,
        # The first requests get no answer, and are repeated.
        unanswered=[(Code.VERSION, n) for n in range(1, 1 + repeats)],
    )
    if is_alone:
        client.require_alone()
    else:
        monkeypatch.setattr(card, "_TWIN_S", HANG_S)
        with expect_refusal(ErrorCode.VALUES_CONFLICT, f"{answers} answers"):
            client.require_alone()


def test_a_second_card_with_the_same_address_is_refused(rig, cards, monkeypatch):
    """Both cards answer one request. The client waits until the second answer comes; one card alone sends none."""
    _, single_board, twin_board = rig.boards
    cards(single_board.name, twin_board.name, **{twin_board.name: Faults(twin=True)})
    with CardClient(single_board, HANG_S) as client:
        client.require_alone()
    monkeypatch.setattr(card, "_TWIN_S", HANG_S)
    with (
        CardClient(twin_board, HANG_S) as client,
        expect_refusal(ErrorCode.VALUES_CONFLICT, "2 answers to one request"),
    ):
        client.require_alone()


def test_a_card_with_another_mac_address_is_refused_at_the_next_record(scripted_card, monkeypatch):
    """Cards were exchanged, or a second one answers now. It is not an error if the kernel has forgotten the address."""
    client, _ = scripted_card(lambda code, _: [reply(code, 0)])
    neighbours = {"mac": "12:34:56:78:90:12"}
    monkeypatch.setattr(card, "neighbour_mac", lambda _: neighbours["mac"])
    client.require_alone()
    client.record_start()
    for forgotten in (None, ""):
        neighbours["mac"] = forgotten
        client.record_start()
    neighbours["mac"] = "12:34:56:78:90:13"
    with expect_refusal(ErrorCode.VALUES_CONFLICT, "12:34:56:78:90:12 and 12:34:56:78:90:13"):
        client.record_start()


def test_a_second_card_of_any_board_is_reported(rig, cards, monkeypatch):
    names = [board.name for board in rig.boards]
    cards(*names, **dict.fromkeys(names, Faults(twin=True)))
    monkeypatch.setattr(card, "_TWIN_S", HANG_S)
    assert [survey.failed_hop for survey in survey_cards(rig)] == ["card"] * len(names)


def test_mac_addresses_of_cards_are_read_from_the_kernel(tmp_path):
    table = tmp_path / "proc/net/arp"
    table.parent.mkdir(parents=True)
    # Flag 0x2: the address is complete; 0x0: the kernel has asked and got no answer.
    line = "192.168.33.180   0x1         {}         12:34:56:78:90:12     *        eth0"
    table.write_text("IP address HW type Flags HW address Mask Device\n" + line.format("0x2"))
    assert neighbour_mac("192.168.33.180", tmp_path) == "12:34:56:78:90:12"
    assert neighbour_mac("192.168.33.181", tmp_path) is None
    table.write_text("IP address HW type Flags HW address Mask Device\n" + line.format("0x0"))
    assert neighbour_mac("192.168.33.180", tmp_path) == ""
