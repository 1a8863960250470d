"""Scans of the simulated rig in which the host arms the radars for each row: by control servers, or over USB.

An armed radar sends a frame of chirps at each trigger pulse. In place of echoes the rig sends a counter, so that each
word of the data is known.
"""

import json
from typing import Any

import tomli_w
from tests.support.rigs import MID_BAND_OFFSET_HZ, load_rig_table
from tests.support.store.facts import load_facts

from polysight.acquisition.progress import ScanResult
from polysight.acquisition.scan import run_scan
from polysight.store.validation import validate
from polysight_shared.config import load_instrument

# First bytes of the command that starts frames, as hexadecimal words of two bytes, low byte first: its ID 0x0140, its
# length of 8 bytes, the action 1 (start), and 0.
START_FRAMES = "4001080001000000"
COLUMNS = 8
ROWS = 3
CHIRPS = 4
# Ports of the control servers of the transmitting and of the two receiving radars.
PORTS = {"LS": 5000, "RH": 5001, "RV": 5002}


def scan_three_rows(bench, radar: dict[str, Any], burst: dict[str, Any]) -> ScanResult:
    """Scan three rows of eight positions; check that they are complete and that radars were armed once for each row."""
    table = load_rig_table()
    table["grid"] |= {"columns": COLUMNS, "rows": ROWS}
    table["burst"] |= burst
    table["limits"] |= {"end_of_record_s": 1.0, "row_retakes": 2, "command_timeout_s": 5.0}
    table["radar"] = radar
    for board in table["boards"]:
        board["start_offset_hz"] = 0.0 if board["role"] == "transmit" else MID_BAND_OFFSET_HZ
    (bench.folder / "rig.toml").write_text(tomli_w.dumps(table))
    options = ("--config", "rig.toml", "--dir", bench.folder / "rig", "--pattern", "--time-scale", "40", "--with-pi")
    rig = bench.start("python", "-m", "polysight_simulators.rig", *options)
    config = bench.folder / rig.wait_ready()
    result = run_scan(load_instrument(config), bench.folder / "scan")
    rig.end()
    assert result.exit_status == "success"
    assert validate(bench.folder / "scan") == []
    # Each simulated card writes what its radar did at its end.
    board_counts: dict[str, Any] = {}
    for path in (bench.folder / "rig").glob("cards-*.json"):
        board_counts |= json.loads(path.read_text())["boards"]
    for counts in board_counts.values():
        assert counts["rearmed"] == ROWS + result.retakes
        if result.retakes == 0:
            # Trigger pulses that came while the radar was not armed.
            assert counts.get("unarmed", 0) == 0
    return result


def test_control_servers_arm_each_row_once(bench):
    servers = {board: f"127.0.0.1:{port}" for board, port in PORTS.items()}
    scan_three_rows(bench, {"control": "line_server", "servers": servers}, {"pulses": CHIRPS})


def test_native_radars_make_a_frame_of_many_chirps_at_each_pulse(bench):
    """`[burst] pulses = 1, chirps = 4`; the manifest has the commands to the radars and their answers."""
    burst = {"pulses": 1, "chirps": CHIRPS, "chirp_us": 228.51, "period_us": 1500.0}
    native = {board: {"usb_serial": board} for board in PORTS}
    result = scan_three_rows(bench, {"control": "native", "native": native}, burst)
    assert {row.pulses for row in result.folder.committed_rows().values()} == {COLUMNS}
    data = result.folder.read_row("RH", 0)
    assert data.frames_expected == COLUMNS * CHIRPS
    # The counter continues through all chirps. It has 28 bits of each word.
    counter = data.payload.view("<u4") & (2**28 - 1)
    first_count = counter[0]
    assert (counter == range(first_count, first_count + counter.size)).all()
    # The first fact was stored after the radars were configured, the others after each row.
    configured, *rows = load_facts(result.folder, "radars")
    for answer in configured["boards"].values():
        assert answer["state"] == "configured"
        assert answer["rf_firmware"] != ""
        assert answer["calibration"]["passed"]
        # The simulated radar boots from RAM, in this time.
        assert answer["boot"] == {"power_up_us": 1856.08, "boot_errors": 0, "tests_failed": 0, "cure": ""}
        # Its flash was empty.
        assert any("no image header" in line for line in answer["events"])
    die_ids = {answer["die_id"] for answer in configured["boards"].values()}
    assert len(die_ids) == len(PORTS)
    assert "direct_if_hz" in configured
    rows_done = []
    for fact in rows:
        states = {board["state"] for board in fact["boards"].values()}
        if states == {"done"}:
            rows_done.append(fact["row"])
    assert rows_done == list(range(ROWS))
    for fact in rows:
        for board in fact["boards"].values():
            assert any(START_FRAMES in sent for sent in board["sent"])
            assert board["temperatures_c"]["rx1"]
