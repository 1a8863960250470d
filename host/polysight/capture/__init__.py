"""Radar samples from DCA1000 capture cards: control, reception, placement by byte count, decoding.

* Control: `CardClient` sends commands to a card over UDP; `survey_cards` checks each hop to it (`card`, `network`).
* Reception: `ReceiverProcess` drives one process per card (`receiver`, `receiver_process`), which logs packets and
  writes a row's files (`row_files`); `RowCapture` lists missing bytes and counts dropped packets.
* Placement: `placement` decides which packets (`packet_log`) are the row, and where each byte belongs.
* Formats: `dca1000` has those of the card, `view_row_words` converts payload to samples; `inspect_bin` and
  `inspect_pcap`
  examine a recording.
"""

from polysight.capture.card import CardClient, CardSurvey, EepromSettings, program_eeprom, survey_cards
from polysight.capture.dca1000 import (
    CARD_SOURCE_PORT,
    MAX_PAYLOAD_BYTES,
    PACKET_TIME_US,
    Code,
    Status,
    Version,
    decode_row,
    encode_row_words,
    valid_frames,
    view_row_words,
)
from polysight.capture.inspect import (
    SILENT_SHARE,
    CardReport,
    Layout,
    Report,
    inspect_bin,
    inspect_pcap,
    is_pcap,
    recognise_format,
)
from polysight.capture.network import check_receive_buffer, explain_silent_radar, route_interface
from polysight.capture.placement import Evidence, PlacedRecord, place_record
from polysight.capture.receiver import (
    PRIORITY_REMEDY,
    Progress,
    ReceiverProcess,
    RowCapture,
    receiver_cores,
    take_priority,
)
from polysight.capture.row_files import (
    PACKETS_SUFFIX,
    make_write_error,
    read_index,
    read_packets,
    write_durably,
    write_index,
    write_packets,
)
