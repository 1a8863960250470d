"""A scan of the simulated rig whose radars the host configures and arms itself, over their simulated USB chips."""

from __future__ import annotations

from polysight.host.acquisition.scan import run_scan
from polysight.host.store.validation import validate
from tests.support.pattern_rig import COLUMNS, PULSES, ROWS, counts, small_table, start_rig

ROW_PULSES = COLUMNS * PULSES


def small_rig(bench, *faults: str, burst: dict | None = None):
    """The simulated rig, running, under native control; its rig file."""
    table = small_table()
    table["radar"] = {"control": "native", "native": {b["name"]: {"usb_serial": b["name"]} for b in table["boards"]}}
    table["burst"] |= burst or {}
    for board in table["boards"]:
        board["start_offset_hz"] = 0.0 if board["role"] == "transmit" else 790e3
    return start_rig(bench, table, *faults)


def test_rows_come_whole_and_the_manifest_holds_what_the_radars_were_told(bench):
    rig, instrument = small_rig(bench)
    result = run_scan(instrument, bench.folder / "scan")
    assert result.exit_status == "success"
    assert validate(bench.folder / "scan") == []
    first, *rows = result.folder.facts("radars")
    assert set(first["boards"]) == {"LS", "RH", "RV"}
    for answer in first["boards"].values():
        assert answer["state"] == "configured"
        assert answer["rf_firmware"] != ""
        assert answer["calibration"]["passed"]
        assert answer["boot"] == {"power_up_us": 1856.08, "boot_errors": 0, "tests_failed": 0, "cure": ""}  # from RAM
    assert len({answer["die_id"] for answer in first["boards"].values()}) == 3
    assert any("no image header" in line for line in first["boards"]["RH"]["events"])  # its flash was empty
    assert "direct_if_hz" in first
    assert [r["row"] for r in rows if all(b["state"] == "done" for b in r["boards"].values())] == [0, 1, 2]
    start = "4001080001000000"
    for fact in rows:
        assert all(sum(start in sent for sent in b["sent"]) >= 1 for b in fact["boards"].values())
        assert all(b["temperatures_c"]["rx1"] for b in fact["boards"].values())
    for board in counts(bench, rig).values():
        assert board["rearmed"] == ROWS + result.retakes
        if result.retakes == 0:
            assert board["unarmed"] == 0


def test_a_fatal_event_ends_the_row_and_the_board_is_reset_for_its_next_take(bench):
    rig, instrument = small_rig(bench, f"RH.radar_fault_pulses=[{ROW_PULSES + 5}]")
    result = run_scan(instrument, bench.folder / "scan")
    assert result.exit_status == "success"
    assert result.retakes >= 1
    rejected = result.folder.facts("row_rejected")[0]
    assert rejected["row"] == 1
    assert any(r.startswith("RH: the radar has stopped: RF core fault") for r in rejected["reasons"])
    assert validate(bench.folder / "scan") == []
    power_up = "00400400"
    sent = [s for f in result.folder.facts("radars") for s in f["boards"]["RH"]["sent"]]
    assert sum(power_up in s for s in sent) == 2
    others = [s for f in result.folder.facts("radars") for s in f["boards"]["RV"]["sent"]]
    assert sum(power_up in s for s in others) == 1
    rig.end()


def test_a_transmitter_that_missed_a_pulse_is_noticed_though_nothing_of_it_is_recorded(bench):
    rig, instrument = small_rig(bench, "LS.miss_pulses=[3]")
    result = run_scan(instrument, bench.folder / "scan")
    assert result.exit_status == "success"
    rejected = result.folder.facts("row_rejected")[0]
    assert rejected["row"] == 0
    assert "LS: the radar still waits for pulses, it missed some" in rejected["reasons"]
    assert validate(bench.folder / "scan") == []
    rig.end()


def test_one_pulse_a_position_makes_a_frame_of_many_chirps(bench):
    """`[burst] pulses = 1, chirps = 4`: a quarter of the pulses, the same chirps, rows as whole as before."""
    burst = {"pulses": 1, "chirps": PULSES, "chirp_us": 228.51, "period_us": 1500.0}
    rig, instrument = small_rig(bench, burst=burst)
    result = run_scan(instrument, bench.folder / "scan")
    assert result.exit_status == "success"
    assert validate(bench.folder / "scan") == []
    assert {row.pulses for row in result.folder.committed().values()} == {COLUMNS}
    data = result.folder.read_row("RH", 0)
    assert data.frames_expected == ROW_PULSES
    words = data.payload.view("<u4") & 0x0FFFFFFF
    assert (words == range(words[0], words[0] + words.size)).all()  # the pattern counts on through every chirp
    rig.end()
