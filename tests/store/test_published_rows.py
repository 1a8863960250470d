"""Missing data of the published raw rows is masked and counted; unmasked data is as sent."""

import json

import msgspec
import numpy as np
import pytest
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.jobs.process import process_rows
from polysight.store.open import open_source
from polysight.store.published import RowLosses
from polysight.store.published_rig import mirror_rig
from polysight_shared.config import Burst, Grid
from polysight_shared.errors import ErrorCode
from polysight_shared.geometry import direct_path_m, incidence_deg, rx_positions_m, tx_position_m
from polysight_shared.raster import plan_raster
from polysight_simulators.scene import AuthorsLayout

# A small grid; with 3 frames of 4096 bytes at each position no burst ends with a packet of 1456 bytes.
COLUMNS = 9
ROWS = 4
PULSES = 3
BASE = load_published_rig()
RIG = msgspec.structs.replace(
    BASE,
    grid=Grid(columns=COLUMNS, rows=ROWS, step_x_mm=2.0, step_y_mm=2.0),
    burst=Burst(pulses=PULSES, period_us=1500.0),
)
FRAME = RIG.frame_bytes
BURST = PULSES * FRAME
PACKET = 1456


def make_plan(by_columns):
    """Return the plan of the grid, or of the same grid scanned column by column."""
    grid = RIG.grid
    if by_columns:
        grid = Grid(columns=ROWS, rows=COLUMNS, step_x_mm=2.0, step_y_mm=2.0)
    return plan_raster(grid)


def record(folder, skipped=None, lost=None, zero_filling=True, by_columns=False):
    """Write random rows in the published layout.

    `skipped`: positions whose pulse was missed, by board and row; `lost`: byte ranges that were lost. Returns the
    folder and the sent data, {(board, row): bytes of the whole row}.
    """
    layout = AuthorsLayout(
        path=folder,
        rig=RIG,
        scan_id="scan",
        started_s=1.7e9,
        zero_filling=zero_filling,
        by_columns=by_columns,
        skipped=skipped,
    )
    layout.start()
    sent = {}
    for row in make_plan(by_columns):
        payloads = {}
        for k, board in enumerate(RIG.boards):
            rng = np.random.default_rng([k, row.index])
            payloads[board.name] = rng.integers(1, 2**15, (row.points * PULSES, 256, 8)).astype(np.int16)
            sent[board.name, row.index] = payloads[board.name].view(np.uint8).ravel()
        gaps = {b.name: (lost or {}).get((b.name, row.index), []) for b in RIG.boards}
        layout.write_row(row, payloads, gaps)
    return layout.folder, sent


def list_byte_ranges(*numbers):
    """Return the bytes of packets of a row, by their numbers."""
    return [(k * PACKET, (k + 1) * PACKET) for k in numbers]


def check(data, sent):
    """Check that unmasked bytes are those that were sent; return the mask, bool [byte]."""
    mask = np.zeros(sent.size, bool) if data.mask is None else data.mask
    np.testing.assert_array_equal(data.payload[~mask], sent[~mask])
    assert not data.payload[mask].any()
    return mask


@pytest.mark.parametrize("by_columns", [False, True])
@pytest.mark.parametrize("zero_filling", [True, False])
@pytest.mark.parametrize("seed", range(6))
def test_of_missed_positions_and_lost_packets_exactly_the_missing_bytes_are_masked(
    tmp_path, seed, zero_filling, by_columns
):
    rng = np.random.default_rng(seed)
    plan = make_plan(by_columns)
    skipped = {}
    losses = {}
    for row in plan:
        for board in ("RH", "RV"):
            missing_positions = np.flatnonzero(rng.random(plan.columns) < 0.25)
            skipped[board, row.index] = set(missing_positions.tolist())
            remaining = (plan.columns - missing_positions.size) * BURST // PACKET
            numbers = np.flatnonzero(rng.random(remaining) < 0.03)
            losses[board, row.index] = list_byte_ranges(*numbers.tolist())
    folder, sent = record(tmp_path, skipped, losses, zero_filling, by_columns)
    scan = open_source(folder, BASE)
    assert list(scan.rows()) == list(range(plan.rows))
    for row in plan:
        for board in ("RH", "RV"):
            mask = check(scan.read_row(board, row.index), sent[board, row.index])
            missing_positions = skipped[board, row.index]
            missing = len(missing_positions) * BURST + sum(b - a for a, b in losses[board, row.index])
            assert mask.reshape(plan.columns, -1)[sorted(missing_positions)].all()
            # The transmitter's board missed no position, so that it shows the places of all. A row with fewer than
            # three positions may be masked as a whole.
            assert mask.sum() in (missing, mask.size)
            assert mask.sum() == missing or len(missing_positions) > plan.columns - 3
    answer = scan.recording_facts()["recording"].boards
    for board in ("RH", "RV"):
        assert answer[board]["positions_short"] == 0
        if not answer[board]["rows_not_placed"]:
            assert answer[board]["positions_missing"] == sum(len(skipped[board, r.index]) for r in plan)
            count = sum((b - a) // PACKET for r in plan for a, b in losses[board, r.index])
            assert answer[board]["packets_lost"] == count


@pytest.mark.parametrize("zero_filling", [True, False])
@pytest.mark.parametrize("first_sequence", [0, 1, 5000])
@pytest.mark.parametrize("lost", [{3}, {0}, {4, 5}, {75}], ids=str)
def test_lost_packets_are_masked_whatever_the_first_number(tmp_path, zero_filling, first_sequence, lost):
    # Packets 0 to 75; the last one, 75, is not full.
    assert -(-COLUMNS * BURST // PACKET) == 76
    folder, sent = record(tmp_path, lost={("RV", 2): list_byte_ranges(*lost)}, zero_filling=zero_filling)
    log = folder / "RV" / "0_2_log.csv"
    numbered = [line.partition(",") for line in log.read_text().splitlines()]
    log.write_text("".join(f"{int(number) - 1 + first_sequence},{rest}\n" for number, _, rest in numbered))
    data = open_source(folder, BASE).read_row("RV", 2)
    assert data.frames_expected == COLUMNS * PULSES
    assert data.missing == [(min(lost) * PACKET, min((max(lost) + 1) * PACKET, COLUMNS * BURST))]
    check(data, sent["RV", 2])


def test_a_header_line_of_a_log_is_skipped(tmp_path):
    folder, sent = record(tmp_path, {("RH", 0): {3}})
    log = folder / "RH" / "0_0_log.csv"
    log.write_text("seq,bytes,time\n" + log.read_text())
    assert check(open_source(folder, BASE).read_row("RH", 0), sent["RH", 0]).sum() == BURST


def test_only_rows_that_both_boards_have_are_read(tmp_path):
    folder, _ = record(tmp_path)
    (folder / "RV" / f"{COLUMNS - 1}_3.bin").unlink()
    scan = open_source(folder, BASE)
    assert list(scan.rows()) == [0, 1, 2]
    with expect_refusal(ErrorCode.NO_DATA, 3, "RV"):
        scan.read_row("RV", 3)


def test_files_that_contradict_each_other_are_refused(tmp_path):
    folder, _ = record(tmp_path, zero_filling=False)
    file = folder / "RH" / "0_0.bin"
    file.write_bytes(file.read_bytes()[:-100])
    with expect_refusal(ErrorCode.MISMATCH):
        open_source(folder, BASE).read_row("RH", 0)
    (folder / "RH" / "0_0_log.csv").write_text("1,1456,1.0\nnonsense\n")
    with expect_refusal(ErrorCode.FILE_DAMAGED, "0_0_log.csv", "nonsense"):
        open_source(folder, BASE).read_row("RH", 0)
    file.rename(folder / "RH" / "6_0.bin")
    with expect_refusal(ErrorCode.FILE_FOREIGN, "column 6"):
        open_source(folder, BASE)


@pytest.mark.parametrize("pulses", [1, 2, 4])
def test_settings_of_another_number_of_chirps_are_refused(tmp_path, pulses):
    folder, _ = record(tmp_path)
    file = folder / "data_collection_cfg.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"num_trigger": pulses}))
    with expect_refusal(ErrorCode.MISMATCH, f"num_trigger = {pulses}", f"{PULSES} chirps at each position"):
        open_source(folder, BASE)


@pytest.mark.parametrize("rows", [ROWS - 1, ROWS])
def test_rows_beyond_the_settings_are_left_out_with_a_notice(tmp_path, rows):
    folder, _ = record(tmp_path)
    file = folder / "data_collection_cfg.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"total_y": rows}))
    scan = open_source(folder, BASE)
    assert list(scan.rows()) == list(range(rows))
    notices = [notice for notice in scan.notices if "left out" in notice]
    assert len(notices) == (ROWS - rows) * len(BASE.boards)
    assert all(f"{ROWS - rows} files of rows beyond the {rows}" in notice for notice in notices)


def test_for_published_data_without_rows_the_remedy_is_not_to_resume(tmp_path):
    folder, _ = record(tmp_path)
    for file in (folder / "RV").iterdir():
        file.unlink()
    with expect_refusal(ErrorCode.NO_DATA, "fetch the files of both receiving boards again") as refusal:
        process_rows(open_source(folder, BASE), folder)
    assert "polysight resume" not in refusal.value.remedy


@pytest.mark.parametrize("missing_end", [{0}, {COLUMNS - 1}, {0, 1, 5}])
def test_the_other_boards_show_which_end_is_missing(tmp_path, missing_end):
    folder, sent = record(tmp_path, {("RH", 2): missing_end})
    scan = open_source(folder, BASE)
    mask = check(scan.read_row("RH", 2), sent["RH", 2])
    np.testing.assert_array_equal(mask.reshape(COLUMNS, -1).all(axis=1), np.isin(range(COLUMNS), list(missing_end)))
    assert scan.recording_facts()["recording"].boards["RH"]["positions_missing"] == len(missing_end)


def test_an_end_that_all_boards_miss_masks_the_row(tmp_path):
    folder, sent = record(tmp_path, {(b.name, 2): {0} for b in RIG.boards})
    scan = open_source(folder, BASE)
    for board in ("RH", "RV"):
        assert check(scan.read_row(board, 2), sent[board, 2]).all()
        assert scan.recording_facts()["recording"].boards[board]["rows_not_placed"] == 1


@pytest.mark.parametrize("first_sequence", [0, 1, 5000])
@pytest.mark.parametrize("zero_filling", [True, False])
def test_a_missed_pulse_within_a_position_masks_only_that_position(tmp_path, zero_filling, first_sequence):
    folder, sent = record(tmp_path, zero_filling=zero_filling)
    short = 4
    file = folder / "RH" / "0_0.bin"
    log = folder / "RH" / "0_0_log.csv"
    # The second of three frames of position 4 was never made.
    cut = slice(short * BURST + FRAME, short * BURST + 2 * FRAME)
    raw = np.delete(np.fromfile(file, np.uint8), cut)
    file.write_bytes(raw.tobytes())
    times = np.loadtxt(log, delimiter=",")
    late_s = times[-1, 2] - times[-2, 2]
    times[-1, 2] = times[-2, 2]
    lines = []
    for k, start in enumerate(range(0, raw.size, PACKET)):
        end = min(start + PACKET, raw.size) - 1
        true_end = end if end < cut.start else end + FRAME
        pulse_time = times[true_end // PACKET, 2] if true_end // PACKET < len(times) else times[-1, 2]
        # The card keeps the last bytes, which do not fill a packet, for a while.
        if end + 1 == raw.size:
            pulse_time += late_s
        lines.append(f"{k + first_sequence},{end + 1 - start},{pulse_time:.6f}")
    log.write_text("\n".join(lines))
    scan = open_source(folder, BASE)
    mask = check(scan.read_row("RH", 0), sent["RH", 0])
    np.testing.assert_array_equal(mask.reshape(COLUMNS, -1).all(axis=1), np.arange(COLUMNS) == short)
    assert mask.sum() == BURST
    assert scan._losses["RH"][0] == RowLosses(positions_short=1)


def test_without_a_log_zeros_are_lost_packets_and_a_short_row_is_masked(tmp_path):
    folder, sent = record(tmp_path, lost={("RV", 1): list_byte_ranges(3, 4, 10)})
    for log in (folder / "RV").glob("*_log.csv"):
        log.unlink()
    short = folder / "RV" / "0_0.bin"
    short.write_bytes(short.read_bytes()[:-BURST])
    scan = open_source(folder, BASE)
    mask = check(scan.read_row("RV", 1), sent["RV", 1])
    assert mask.sum() == 3 * PACKET
    assert check(scan.read_row("RV", 0), sent["RV", 0]).all()
    assert check(scan.read_row("RV", 2), sent["RV", 2]).sum() == 0
    answer = scan.recording_facts()["recording"].boards["RV"]
    assert (answer["packets_lost"], answer["rows_not_placed"], answer["rows_absent"]) == (3, 1, 0)


def test_columns_are_rows_of_the_mirrored_rig(tmp_path):
    folder, _ = record(tmp_path, by_columns=True)
    assert (folder / "RH" / "0_0.bin").exists()
    assert (folder / "RH" / f"1_{ROWS - 1}.bin").exists()
    scan = open_source(folder, BASE)
    assert (scan.plan.columns, scan.plan.rows) == (ROWS, COLUMNS)
    assert scan.recording_facts()["recording"].direction == "col"
    original_rig = mirror_rig(scan.instrument)
    assert (original_rig.grid.columns, original_rig.grid.rows) == (COLUMNS, ROWS)


def test_a_mirrored_rig_has_x_and_y_exchanged_and_the_same_paths():
    """Mirrored twice it is the same rig again."""
    mirrored = mirror_rig(BASE)
    assert mirror_rig(mirrored) == BASE
    assert incidence_deg(mirrored, mirrored.receivers[0]) == pytest.approx(incidence_deg(BASE, BASE.receivers[0]))
    assert tx_position_m(mirrored) == pytest.approx(
        (tx_position_m(BASE)[1], tx_position_m(BASE)[0], tx_position_m(BASE)[2])
    )
    for a, b in zip(BASE.receivers, mirrored.receivers, strict=True):
        assert direct_path_m(BASE, a) == pytest.approx(direct_path_m(mirrored, b))
        for p, q in zip(rx_positions_m(BASE, a), rx_positions_m(mirrored, b), strict=True):
            assert q == pytest.approx((p[1], p[0], p[2]))
