"""What the doctor makes of frames: simulated ones, with one fault each."""

import dataclasses

import numpy as np
import pytest

from polysight.host.doctor import check_capture as check_direct_path
from polysight.host.doctor import check_capture as check_skew
from polysight.host.doctor.bench import Captured
from polysight.host.doctor.check_capture import check_direct_path as direct_path_of
from polysight.host.doctor.check_capture import check_level, check_radar
from tests.support.doctor.case import FRAMES, RIG, bench_of, frames_of, signal_of
from tests.support.rigs import programmed_rig


def judged(board="RH", rig=RIG, **disturbances):
    return check_direct_path.judge(rig, rig.by_name(board), signal_of(board, rig, **disturbances))


def captured(words, **changes):
    valid = np.ones(len(words), bool)
    from polysight.host.capture.receiver import RowCapture

    zeros = dict.fromkeys((f for f in RowCapture.__struct_fields__), 0)
    row = {**zeros, "missing": [], "located": True, "reason": "", "holes": [], "slipped": False}
    row |= {"expected": words.nbytes, "bytes": words.nbytes, "packets": 9, **changes}
    return {"RH": Captured(words, valid, RowCapture(**row))}


def test_a_direct_path_where_it_should_be():
    for name in ("RH", "RV"):
        found = judged(name)
        assert found.verdict == "ok", found
        assert found.facts["heard"] == FRAMES


def test_no_direct_path():
    found = judged(direct_loss_db=60.0)
    assert found.verdict == "error"
    assert "no direct path" in found.found
    assert "line of sight" in found.remedy


@pytest.mark.parametrize("offset_hz", [2.6e6, -900e3])
def test_a_direct_path_beyond_the_band_is_called_an_alias_and_gets_an_offset(offset_hz):
    rig = programmed_rig(offset_hz)
    found = judged("RH", rig)
    assert found.verdict == "error"
    better = float(found.remedy.split("= ")[1].split(" ")[0])
    assert better == pytest.approx(rig_offset_for_the_middle("RH"), abs=1e3)


def rig_offset_for_the_middle(name):
    from polysight.host.radar.constraints import direct_if_hz

    return 0.45 * RIG.chirp.sample_rate_hz - direct_if_hz(programmed_rig(0.0), programmed_rig(0.0).by_name(name))


def test_a_direct_path_at_the_edge_of_the_band():
    found = judged("RH", RIG, if_offset_hz=-850e3)
    assert found.verdict == "error"
    assert "start_offset_hz" in found.remedy


def test_a_direct_path_that_the_rig_file_did_not_expect():
    """The board was programmed 490 kHz higher than the rig file says; its crystal's share is told apart."""
    found = judged("RH", programmed_rig(300e3), if_offset_hz=490e3, crystal_ppm={"receive_h": 1.5})
    assert found.verdict == "warning"
    assert float(found.remedy.split("= ")[1].split(" ")[0]) == pytest.approx(790e3, abs=5 * 2.1e-9 / 32**0.5 * 38.8e12)


@pytest.mark.parametrize(("skew_ns", "verdict"), [(0.0, "ok"), (-13.0, "warning"), (21.5, "error")])
def test_trigger_skew_between_the_boards_is_recovered(skew_ns, verdict):
    skew = {"sync_skew_ns": {"receive_h": 1.0 - skew_ns / 2, "receive_v": 1.0 + skew_ns / 2}}
    found = check_skew.judge_skew(RIG, {name: signal_of(name, **skew) for name in ("RH", "RV")})
    assert found.facts["skew_ns"] == pytest.approx(skew_ns, abs=5 * found.facts["standard_error_ns"])
    assert found.verdict == verdict
    assert found.facts["later_ns"]["RH"] == pytest.approx(1.0 - skew_ns / 2, abs=2.5)


@pytest.mark.parametrize("ppm", [-2.0, 0.0, 1.5])
def test_a_crystal_is_told_from_a_late_trigger(ppm):
    signal = signal_of("RH", crystal_ppm={"receive_h": ppm}, sync_skew_ns={"receive_h": 3.0})
    assert signal.crystal_ppm(RIG) == pytest.approx(ppm, abs=0.15)
    mean, unsure = signal.start_delay_s(RIG)
    assert mean * 1e9 == pytest.approx(3.0, abs=5 * unsure * 1e9 + 0.3)


def test_clipping():
    bench = bench_of()
    bench.captured = captured(frames_of("RH", adc_full_scale=1.2))
    assert check_level(bench, RIG.by_name("RH")).verdict == "error"
    some = frames_of("RH")
    assert check_level(dataclasses.replace(bench, captured=captured(some)), RIG.by_name("RH")).verdict == "ok"
    some = np.repeat(some, 8, axis=0)
    some[3, 5, 0, 1] = 32767  # one chirp of 256
    found = check_level(dataclasses.replace(bench, captured=captured(some)), RIG.by_name("RH"))
    assert (found.verdict, found.facts["clipped_chirps"]) == ("warning", 1)


def test_a_receiver_that_is_asleep():
    bench = bench_of()
    words = frames_of("RH")
    words[..., 2] = 0
    bench.captured = captured(words)
    assert "RX is off" in check_level(bench, RIG.by_name("RH")).why


@pytest.mark.parametrize(
    ("changes", "verdict", "words"),
    [
        ({}, "ok", ""),
        ({"packets": 0, "bytes": 0}, "error", "not streaming"),
        ({"packets": 0, "bytes": 0, "strangers": 5}, "error", "5 packets came from another"),
        ({"bytes": 4096, "slipped": True, "reason": "missed"}, "error", "missed pulses"),
        ({"missing": [(0, 1456)], "gap_bytes": 1456, "bytes": 9}, "warning", "lost on the way"),
        ({"card_status": 1 << 7}, "error", "dropped data before"),
        ({"strangers": 3}, "warning", "same data port"),
    ],
)
def test_what_became_of_the_frames(changes, verdict, words):
    bench = bench_of()
    bench.captured = captured(frames_of("RH"), **changes)
    found = check_radar(bench, RIG.by_name("RH"))
    assert found.verdict == verdict
    assert words in found.why


def test_the_transmitter_is_not_asked_for_a_direct_path():
    assert direct_path_of(bench_of(), RIG.by_name("LS")).verdict == "not checked"
