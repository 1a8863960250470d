"""Radar samples from DCA1000 capture cards: control, reception, placement by byte count, decoding.

* Control: `CardClient` sends commands to a card over UDP (`dca1000` has the formats); `survey_cards` checks each hop.
* Reception: `ReceiverProcess` drives one process per card (`receiver_process`), which logs packets (`packet_log`) and
  writes a row's file and index (`segment`); `RowCapture` lists missing bytes and counts dropped packets.
* Placement: `record_search` finds the row's record among its packets, `placement` puts their payload in place,
  `earlier_records` keeps what is known of earlier records; `packet_file` stores packets to place a row again.
* Decoding: `row_words` converts payload to samples; `inspect_bin` and `inspect_pcap` examine a recording.
"""

from polysight.capture.card import CardClient, EepromSettings, program_eeprom
from polysight.capture.dca1000 import CARD_SOURCE_PORT, MAX_PAYLOAD_BYTES, Code, Status, Version
from polysight.capture.decode import decode_row, raw_words, row_words, valid_frames
from polysight.capture.inspect import CardReport, Layout, Report, inspect_bin, inspect_pcap, is_pcap, kind_of
from polysight.capture.network import check_receive_buffer, route_interface, silent_radar
from polysight.capture.packet_file import PACKETS, Evidence, read_packets, write_packets
from polysight.capture.placement import Placed, place_record
from polysight.capture.receiver import Progress, ReceiverProcess, RowCapture
from polysight.capture.scheduling import PRIORITY_REMEDY, receiver_cores, take_priority
from polysight.capture.segment import read_index, write_durably, write_error, write_index
from polysight.capture.survey import CardSurvey, survey_cards

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
    "Layout",
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
    "write_error",
    "write_index",
    "write_packets",
]
