"""Checks of captured frames: simulated ones, each with one fault."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from tests.support.doctor.case import FRAMES, RIG, make_context, make_direct_signal, simulate_frames
from tests.support.rigs import make_programmed_rig

from polysight.capture.placement import Losses, PacketCounts
from polysight.capture.receiver import RowCapture
from polysight.doctor.context import CapturedFrames
from polysight.doctor.rig_checks import check_radar
from polysight.doctor.signal_checks import check_direct_path, check_level, judge_direct_path, judge_skew
from polysight.radar.commands import direct_if_hz
from polysight.radar.control import BoardState, RadarState


def judge_signal(board="RH", rig=RIG, **disturbances):
    return judge_direct_path(rig, rig.by_name(board), make_direct_signal(board, rig, **disturbances))


def make_context_with_frames(words, **row):
    """A context in which RH captured these frames; `row` replaces counts of the receiver."""
    counts = dict.fromkeys(RowCapture.__struct_fields__, 0) | {
        "missing": [],
        "reason": "",
        "holes": [],
        "slipped": False,
    }
    counts |= {"located": True, "expected": words.nbytes, "bytes": words.nbytes}
    counts |= {"counts": PacketCounts(placed=9), "losses": Losses(), **row}
    return make_context(captured={"RH": CapturedFrames(words, np.ones(len(words), bool), RowCapture(**counts))})


def test_a_direct_path_at_the_expected_if_is_ok():
    for name in ("RH", "RV"):
        findings = judge_signal(name)
        assert findings.level == "ok", findings
        assert findings.facts["heard"] == FRAMES


def test_a_missing_direct_path_is_an_error():
    findings = judge_signal(direct_loss_db=60.0)
    assert findings.level == "error"
    assert "if_hz" not in findings.facts
    assert f"in {FRAMES - findings.facts['heard']} of {FRAMES} chirps" in findings.what


@pytest.mark.parametrize(("board", "order"), [("RH", (4, 3, 2, 1)), ("RV", (4, 3, 2, 1)), ("RH", (2, 1, 3, 4))])
def test_rx_in_another_order_are_an_error_with_that_order(board, order):
    words = simulate_frames(board)[..., [k - 1 for k in order]]
    finding = check_direct_path(
        make_context(captured={board: make_context_with_frames(words).captured["RH"]}), RIG.by_name(board)
    )
    assert finding.level == "error"
    assert f"rx_order = {list(order)}" in finding.do


@pytest.mark.parametrize("offset_hz", [2.6e6, -900e3])
def test_a_direct_path_beyond_the_band_is_an_error_with_a_better_start_offset(offset_hz):
    rig = make_programmed_rig(offset_hz)
    findings = judge_signal("RH", rig)
    assert findings.level == "error"
    unshifted = make_programmed_rig(0.0)
    middle = 0.45 * RIG.chirp.sample_rate_hz - direct_if_hz(unshifted, unshifted.by_name("RH"))
    assert read_offset(findings) == pytest.approx(middle, abs=1e3)


def read_offset(finding):
    """The start_offset_hz that the remedy gives."""
    return float(finding.do.split("= ")[1].split(" ")[0])


def test_a_direct_path_at_the_edge_of_the_band_is_an_error():
    findings = judge_signal("RH", RIG, if_offset_hz=-850e3)
    assert findings.level == "error"
    assert read_offset(findings) == pytest.approx(RIG.by_name("RH").start_offset_hz + 850e3, abs=100e3)


def test_another_start_frequency_than_in_the_rig_file_is_recovered():
    """The board was programmed 490 kHz higher than the rig file says; its crystal's share is removed."""
    findings = judge_signal("RH", make_programmed_rig(300e3), if_offset_hz=490e3, crystal_ppm={"receive_h": 1.5})
    assert findings.level == "warning"
    assert read_offset(findings) == pytest.approx(790e3, abs=5 * 2.1e-9 / 32**0.5 * 38.8e12)


@pytest.mark.parametrize(("skew_ns", "verdict"), [(0.0, "ok"), (-13.0, "warning"), (21.5, "error")])
def test_trigger_skew_between_the_boards_is_recovered(skew_ns, verdict):
    skew = {"sync_skew_ns": {"receive_h": 1.0 - skew_ns / 2, "receive_v": 1.0 + skew_ns / 2}}
    finding = judge_skew(RIG, {name: make_direct_signal(name, **skew) for name in ("RH", "RV")})
    assert finding.facts["skew_ns"] == pytest.approx(skew_ns, abs=5 * finding.facts["standard_error_ns"])
    assert finding.level == verdict
    assert finding.facts["later_ns"]["RH"] == pytest.approx(1.0 - skew_ns / 2, abs=2.5)


@pytest.mark.parametrize("ppm", [-2.0, 0.0, 1.5])
def test_a_crystal_and_a_late_trigger_are_distinguished(ppm):
    signal = make_direct_signal("RH", crystal_ppm={"receive_h": ppm}, sync_skew_ns={"receive_h": 3.0})
    assert signal.crystal_ppm(RIG) == pytest.approx(ppm, abs=0.15)
    mean, unsure = signal.start_delay_s(RIG)
    assert mean * 1e9 == pytest.approx(3.0, abs=5 * unsure * 1e9 + 0.3)


@pytest.mark.parametrize("offset_hz", [2.6e6, -900e3])
def test_the_start_times_of_aliased_direct_paths_lack_no_sample_rate(offset_hz):
    """RH alone is programmed beyond the band; a sample rate of IF is 55 ns."""
    shifted_rig = make_programmed_rig(offset_hz)
    rig = make_programmed_rig()
    rig = msgspec.structs.replace(rig, boards=[shifted_rig.by_name("RH") if b.name == "RH" else b for b in rig.boards])
    finding = judge_skew(rig, {name: make_direct_signal(name, rig) for name in ("RH", "RV")})
    assert finding.level == "ok", finding
    assert finding.facts["later_ns"]["RH"] == pytest.approx(0.0, abs=2.5)


def test_clipped_chirps_are_an_error_and_a_few_a_warning():
    assert (
        check_level(make_context_with_frames(simulate_frames("RH", adc_full_scale=1.2)), RIG.by_name("RH")).level
        == "error"
    )
    words = np.repeat(simulate_frames("RH"), 8, axis=0)
    assert check_level(make_context_with_frames(words), RIG.by_name("RH")).level == "ok"
    words[3, 5, 0, 1] = 32767  # one chirp of 256
    finding = check_level(make_context_with_frames(words), RIG.by_name("RH"))
    assert (finding.level, finding.facts["clipped_chirps"]) == ("warning", 1)


@pytest.mark.parametrize("rms", [0, 6])
def test_an_rx_without_a_signal_is_an_error(rms):
    words = simulate_frames("RH")
    words[..., 2] = np.rint(np.random.default_rng(0).normal(0, rms, words.shape[:-1]))
    finding = check_level(make_context_with_frames(words), RIG.by_name("RH"))
    assert (finding.level, finding.facts["rms"][2]) == ("error", pytest.approx(rms * np.sqrt(2), rel=0.1))
    assert finding.what.startswith("no signal in RX3:")


@pytest.mark.parametrize(
    ("row", "verdict"),
    [
        ({}, "ok"),
        ({"counts": PacketCounts(), "bytes": 0}, "error"),
        ({"counts": PacketCounts(), "bytes": 0, "strangers": 5}, "error"),
        ({"bytes": 4096, "slipped": True, "reason": "missed"}, "error"),
        ({"missing": [(0, 1456)], "losses": Losses(gaps=1, gap_bytes=1456), "bytes": 9}, "warning"),
        ({"card_status": 1 << 7}, "error"),
        ({"strangers": 3}, "warning"),
    ],
    ids=["complete", "silent", "another card's packets", "missed pulses", "lost packets", "full card", "two cards"],
)
def test_frames_that_are_missing_are_an_error_and_lost_packets_a_warning(row, verdict):
    assert check_radar(make_context_with_frames(simulate_frames("RH"), **row), RIG.by_name("RH")).level == verdict


@pytest.mark.parametrize("state", RadarState)
def test_with_complete_frames_only_a_fault_of_the_radar_itself_is_an_error(state):
    context = make_context_with_frames(simulate_frames("RH"))
    context.captured["RH"] = replace(context.captured["RH"], radar=BoardState(state, "hot"))
    finding = check_radar(context, RIG.by_name("RH"))
    assert finding.level == ("error" if state is RadarState.FAULT else "ok")
    assert ("hot" in finding.what) is (state is RadarState.FAULT)


def test_frames_of_several_chirps_are_counted_as_frames():
    context = make_context_with_frames(simulate_frames("RH"))
    chirps = 4
    context.loaded_rig = make_programmed_rig(
        burst={"pulses": 2, "chirps": chirps, "chirp_us": 143.0, "period_us": 2800.0}
    )
    context.captured["RH"].valid[5] = False
    facts = check_radar(context, RIG.by_name("RH")).facts
    assert (facts["frames_expected"], facts["frames"]) == (FRAMES // chirps, FRAMES // chirps - 1)


def test_the_transmitter_has_no_direct_path():
    assert check_direct_path(make_context(), RIG.by_name("LS")).level == "note"
