"""The addresses in a card's EEPROM: made from the rig file, shown, confirmed, written.

A card with wrong addresses answers nobody, and only its EEPROM switch brings the defaults back. So writing needs the
new card address repeated by whoever asks for it.
"""

from __future__ import annotations

import ipaddress
import struct
from dataclasses import dataclass

from polysight.host.capture.card import CardClient
from polysight.host.capture.dca1000 import Code, Status
from polysight.shared.config import Board
from polysight.shared.errors import ConfigError, DeviceError

_PORTS = struct.Struct("<HH")
DEFAULT_MAC = "12:34:56:78:90:12"
_OTHER_MAC = "give six bytes in hexadecimal, the first of them even, e.g. 12:34:56:78:90:13"


@dataclass(frozen=True)
class EepromSettings:
    """What command 0x04 writes. It takes effect when the card is next switched on.

    Raises
    ------
    ConfigError
        when a card with these settings could not be reached.
    """

    host_address: str
    card_address: str
    card_mac: str = DEFAULT_MAC
    command_port: int = 4096
    data_port: int = 4098

    def __post_init__(self) -> None:
        host, card = self._address(self.host_address), self._address(self.card_address)
        if host == card:
            raise self._wrong(f"host and card both have the address {card}")
        if int(host) >> 8 != int(card) >> 8:
            raise self._wrong(f"host {host} and card {card} are in different /24 subnets")
        for address in (host, card):
            if address.is_multicast or int(address) & 0xFF in (0, 0xFF):
                raise self._wrong(f"{address} is not the address of one machine")
        try:
            mac = self._mac()
        except ValueError:
            raise self._wrong(f"{self.card_mac!r} is not a MAC address such as {DEFAULT_MAC}", _OTHER_MAC) from None
        if len(mac) != 6 or mac[0] & 1 or not any(mac):
            raise self._wrong(f"{self.card_mac} is not the MAC address of one machine", _OTHER_MAC)
        for port in (self.command_port, self.data_port):
            if not 1024 < port <= 0xFFFF:
                raise self._wrong(f"port {port} is outside 1025..65535")
        if self.command_port == self.data_port:
            raise self._wrong(f"commands and data both use port {self.data_port}")

    @staticmethod
    def of_board(board: Board, card_mac: str = DEFAULT_MAC) -> EepromSettings:
        """The settings a board of the rig file needs. Cards on one network need different MAC addresses."""
        return EepromSettings(board.host_address, board.card_address, card_mac, board.command_port, board.data_port)

    @property
    def confirmation(self) -> str:
        """What must be repeated before anything is written: the address the card will have."""
        return self.card_address

    def encode(self) -> bytes:
        """The 18 bytes of the command: host, card and MAC address, each with its bytes reversed, and the ports."""
        parts = (self._address(self.host_address).packed, self._address(self.card_address).packed, self._mac())
        return b"".join(part[::-1] for part in parts) + _PORTS.pack(self.command_port, self.data_port)

    def text(self) -> str:
        """The settings for people."""
        return (
            f"card {self.card_address} ({self.card_mac}) answers to {self.host_address}:{self.command_port} and sends"
            f" data to port {self.data_port}, from when it is next switched on"
        )

    def _mac(self) -> bytes:
        return bytes.fromhex(self.card_mac.replace(":", "").replace("-", ""))

    def _address(self, text: str) -> ipaddress.IPv4Address:
        try:
            return ipaddress.IPv4Address(text)
        except ValueError:
            raise self._wrong(f"{text!r} is not an IPv4 address") from None

    @staticmethod
    def _wrong(what: str, remedy: str = "correct the board in instrument.toml") -> ConfigError:
        return ConfigError(f"EEPROM settings refused: {what}", "a card with them could not be reached", remedy)


def program_eeprom(card: CardClient, settings: EepromSettings, confirmed: str) -> None:
    """Write the settings into the card that `card` reaches now.

    Parameters
    ----------
    card
        Client of the card at its present address and ports.
    settings
        What it shall have after its next power-up.
    confirmed
        Must be `settings.confirmation`, as typed by whoever asks for it.

    Raises
    ------
    ConfigError
        when the confirmation is another; nothing was sent.
    DeviceError
        when the card is silent, refuses, or reports an EEPROM failure.
    """
    if confirmed != settings.confirmation:
        raise ConfigError(
            f"EEPROM not written: confirmed with {confirmed!r}, not {settings.confirmation!r}",
            settings.text(),
            f"repeat the card's new address, {settings.confirmation}, to write it",
        )
    card.alive()
    status = card.write_eeprom(settings.encode())
    if Status.EEPROM_FAILURE in status:
        raise DeviceError(
            f"card at {card.board.card_address} reports an EEPROM failure after {Code.CONFIGURE_EEPROM.name}",
            "the EEPROM could not be written",
            "write it again before switching the card off; its addresses may be damaged",
        )
