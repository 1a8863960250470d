"""Radar samples from DCA1000 capture cards: control, reception, placement by byte count, decoding.

`CardClient` controls a card over UDP, `survey_cards` tries each hop to it. One process a card (`receiver_process`,
driven by `ReceiverProcess`) places packets into the row's file; `RowCapture` says what is missing. `row_words` turns
payload into samples. `inspect_bin` and `inspect_pcap` say what is in any recording.
"""

from polysight.host.capture.card import CardClient, EepromSettings, program_eeprom
from polysight.host.capture.dca1000 import CARD_SOURCE_PORT, MAX_PAYLOAD_BYTES, Code, Status, Version
from polysight.host.capture.decode import decode_row, raw_words, row_words, valid_frames
from polysight.host.capture.file_kinds import kind_of
from polysight.host.capture.inspect import CardReport, Known, Report, inspect_bin
from polysight.host.capture.network import check_receive_buffer, route_interface, silent_radar
from polysight.host.capture.packet_file import PACKETS, Evidence, read_packets, write_packets
from polysight.host.capture.pcap import inspect_pcap, is_pcap
from polysight.host.capture.placement import Placed, place_record
from polysight.host.capture.receiver import Progress, ReceiverProcess, RowCapture
from polysight.host.capture.scheduling import PRIORITY_REMEDY, receiver_cores, take_priority
from polysight.host.capture.segment import read_index, write_durably, write_index
from polysight.host.capture.survey import CardSurvey, HopFinding, survey_cards

__all__ = [
    "CARD_SOURCE_PORT",
    "MAX_PAYLOAD_BYTES",
    "PACKETS",
    "PRIORITY_REMEDY",
    "CardClient",
    "CardReport",
    "CardSurvey",
    "Code",
    "EepromSettings",
    "Evidence",
    "HopFinding",
    "Known",
    "Placed",
    "Progress",
    "ReceiverProcess",
    "Report",
    "RowCapture",
    "Status",
    "Version",
    "check_receive_buffer",
    "decode_row",
    "inspect_bin",
    "inspect_pcap",
    "is_pcap",
    "kind_of",
    "place_record",
    "program_eeprom",
    "raw_words",
    "read_index",
    "read_packets",
    "receiver_cores",
    "route_interface",
    "row_words",
    "silent_radar",
    "survey_cards",
    "take_priority",
    "valid_frames",
    "write_durably",
    "write_index",
    "write_packets",
]
