"""The rig file: complete, checked, and every refusal names file, key, value and rule."""

import math
from pathlib import Path

import pytest
import tomli_w

from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import ConfigError
from polysight.shared.geometry import direct_path_m, incidence_deg, rx_positions_m, specular_midpoint_m, tx_position_m
from polysight.shared.tables import decode, read_toml, to_builtins
from tests.support.rigs import rig_with

RIG = Path(__file__).resolve().parents[2] / "instrument.toml"


def test_the_published_rig_survives_toml(rig: Instrument, tmp_path: Path):
    path = tmp_path / "copy.toml"
    path.write_text(tomli_w.dumps(to_builtins(rig)))
    assert load_instrument(path) == rig


def test_published_chirp(rig: Instrument):
    assert rig.chirp.swept_hz == pytest.approx(4.622e9, rel=1e-4)
    assert rig.chirp.first_sample_hz == pytest.approx(76.282e9, rel=1e-5)
    assert rig.frame_bytes * rig.burst.pulses == 65536


def test_mounts_reproduce_the_published_antenna_positions(rig: Instrument):
    h, v = rig.receivers
    assert tx_position_m(rig) == pytest.approx((-0.7055, 0.0974, 0.0130), abs=6e-5)
    assert rx_positions_m(rig, h)[0] == pytest.approx((0.6843, 0.1035, 0.0094), abs=6e-5)
    assert rx_positions_m(rig, v)[0] == pytest.approx((0.6836, 0.1337, 0.0104), abs=6e-5)
    assert direct_path_m(rig, h)[0] == pytest.approx(1.390, abs=5e-4)
    assert incidence_deg(rig, h) == pytest.approx(55.0, abs=0.1)


def test_angles_of_incidence_and_reflection_are_equal_at_the_midpoint(rig: Instrument):
    for board in rig.receivers:
        rx, mid = rx_positions_m(rig, board)[0], specular_midpoint_m(rig, board)
        out = math.degrees(math.atan2(math.hypot(mid[0] - rx[0], mid[1] - rx[1]), mid[2] - rx[2]))
        assert out == pytest.approx(incidence_deg(rig, board), abs=1e-9)


@pytest.mark.parametrize(
    ("table", "key", "value", "words"),
    [
        ("chirp", "start_hertz", 1.0, "start_hertz"),
        ("chirp", "start_hz", "fast", "chirp.start_hz = 'fast'"),
        ("chirp", "samples", 400, "must end inside the ramp"),
        ("chirp", "hpf1_khz", 180.0, "hpf1_khz must be one of"),
        ("burst", "period_us", 200.0, "at least 300 us"),
        ("burst", "width_us", 5.0, r"0\.025\.\.4 us"),
        ("pi", "trigger_in", 10, "trigger_in must not be one of sync_out"),
        ("pi", "sync_out", [22, 23], "drives exactly one line"),
        ("pi", "trigger_bias", "up", "pi.trigger_bias = 'up'"),
        ("pi", "trigger_debounce_us", 10, "swallows every trigger"),
        ("grid", "columns", 4000, "do not fit stage.travel_x_mm"),
        ("grid", "rows", 0, "grid.rows = 0"),
        ("stage", "accel_mm_s2", -1.0, "accel_mm_s2 = -1.0"),
    ],
)
def test_every_refusal_names_file_key_and_rule(table: str, key: str, value: object, words: str):
    raw = read_toml(RIG)
    raw[table][key] = value
    with pytest.raises(ConfigError, match=words) as caught:
        decode(raw, Instrument, "my.toml")
    assert "my.toml" in str(caught.value)


def test_a_missing_table_and_a_second_transmitter_are_refused():
    raw = read_toml(RIG)
    raw["boards"][1]["role"] = "transmit"
    with pytest.raises(ConfigError, match="exactly one with role"):
        decode(raw, Instrument, "my.toml")
    raw = read_toml(RIG)
    del raw["chirp"]
    with pytest.raises(ConfigError, match="chirp"):
        decode(raw, Instrument, "my.toml")


def test_missing_file_bad_toml_and_binary_are_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match="no such file"):
        load_instrument(tmp_path / "none.toml")
    bad = tmp_path / "bad.toml"
    bad.write_text("a = = 1")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_instrument(bad)
    bad.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_instrument(bad)


@pytest.mark.parametrize(
    ("table", "key", "value", "named"),
    [
        ("chirp", "ramp_end_us", 10.0, ["adc_start_us", "sample_rate_hz", "ramp_end_us"]),
        ("chirp", "slope_hz_per_s", 1e14, ["start_hz", "slope_hz_per_s"]),
        ("chirp", "linear_samples", [0, 5], ["linear_samples", "samples"]),
        ("grid", "columns", 9000, ["grid.columns", "grid.step_x_mm", "stage.travel_x_mm", "stage.centre_x_mm"]),
        ("stage", "speed_mm_s", 900.0, ["grid.columns", "stage.speed_mm_s", "stage.accel_mm_s2"]),
    ],
)
def test_a_rule_between_keys_names_all_of_them(table, key, value, named):
    with pytest.raises(ConfigError) as e:
        rig_with(**{table: {key: value}})
    assert all(name in e.value.what for name in named)
    assert "top level" not in str(e.value)
