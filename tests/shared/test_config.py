"""The rig file: complete and checked; errors name file, key, value and rule."""

import math
from pathlib import Path

import pytest
import tomli_w
from tests.support.paths import RIG_FILE
from tests.support.refusals import expect_refusal

from polysight_shared import geometry
from polysight_shared.config import DEBOUNCE_TICKS_US, Image, Instrument, MountStep, Section, load_instrument
from polysight_shared.errors import ConfigError, ErrorCode, make_missing_path_error
from polysight_shared.tables import decode, read_toml, to_builtins


def test_the_published_rig_survives_toml(rig: Instrument, tmp_path: Path):
    path = tmp_path / "copy.toml"
    path.write_text(tomli_w.dumps(to_builtins(rig)))
    assert load_instrument(path) == rig


def test_paths_are_relative_to_the_rig_file_and_no_path_stays_empty(rig: Instrument, tmp_path: Path):
    table = to_builtins(rig)
    table["pi"]["key_dir"] = ""
    table["radar"] |= {"firmware": "", "trace_dir": "traces"}
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(table))
    loaded = load_instrument(path)
    assert (loaded.pi.key_dir, loaded.radar.firmware) == (str(tmp_path), "")
    assert loaded.radar.trace_dir == str(tmp_path / "traces")


def test_no_section_of_the_rig_can_be_changed(rig: Instrument):
    sections = [getattr(rig, name) for name in rig.__struct_fields__]
    for section in (rig, *(s for s in sections if isinstance(s, Section))):
        for name in section.__struct_fields__:
            with pytest.raises(AttributeError):
                setattr(section, name, getattr(section, name))


def test_published_chirp(rig: Instrument):
    assert rig.chirp.swept_hz == pytest.approx(4.622e9, rel=1e-4)
    assert rig.chirp.first_sample_hz == pytest.approx(76.282e9, rel=1e-5)
    assert rig.frame_bytes * rig.burst.pulses == 65536


def test_mounts_reproduce_the_published_antenna_positions(rig: Instrument):
    h, v = rig.receivers
    assert geometry.tx_position_m(rig) == pytest.approx((-0.7055, 0.0974, 0.0130), abs=6e-5)
    assert geometry.rx_positions_m(rig, h)[0] == pytest.approx((0.6843, 0.1035, 0.0094), abs=6e-5)
    assert geometry.rx_positions_m(rig, v)[0] == pytest.approx((0.6836, 0.1337, 0.0104), abs=6e-5)
    assert geometry.direct_path_m(rig, h)[0] == pytest.approx(1.390, abs=5e-4)
    assert geometry.incidence_deg(rig, h) == pytest.approx(55.0, abs=0.1)


@pytest.mark.parametrize(
    "step",
    [
        {},
        {"turn_deg": 3.0},
        {"about": "x"},
        {"shift_mm": [0.0, 0.0, 1.0], "turn_deg": 3.0},
        {"shift_mm": [0.0, 0.0, 1.0], "about": "x"},
        {"shift_mm": [0.0, 0.0, 1.0], "turn_deg": 3.0, "about": "x"},
    ],
    ids=str,
)
def test_a_mount_step_is_a_whole_shift_or_a_whole_turn(step):
    with pytest.raises(ConfigError, match="mount step"):
        decode(step, MountStep, "a mount")


@pytest.mark.parametrize(("axis", "first", "second"), [("x", 1, 2), ("y", 2, 0), ("z", 0, 1)])
def test_a_mount_turns_right_handed_about_each_axis(axis: str, first: int, second: int):
    mount = (MountStep(turn_deg=30.0, about=axis),)
    images = [geometry.transform_to_rig(tuple(1000.0 * (i == k) for i in range(3)), mount) for k in range(3)]
    expected = [[float(i == k) for i in range(3)] for k in range(3)]
    for k, cosine_at, sine_at, sign in ((first, first, second, 1.0), (second, second, first, -1.0)):
        expected[k][cosine_at] = math.cos(math.pi / 6)
        expected[k][sine_at] = sign * 0.5
    for image, row in zip(images, expected, strict=True):
        assert image == pytest.approx(row)


def test_an_image_has_at_most_four_million_pixels():
    assert Image(columns=2000, rows=2000).rows == 2000
    with pytest.raises(ValueError, match="4000000"):
        Image(columns=2000, rows=2001)


def test_angles_of_incidence_and_reflection_are_equal_at_the_midpoint(rig: Instrument):
    for board in rig.receivers:
        rx = geometry.rx_positions_m(rig, board)[0]
        mid = geometry.specular_midpoint_m(rig, board)
        out = math.degrees(math.atan2(math.hypot(mid[0] - rx[0], mid[1] - rx[1]), mid[2] - rx[2]))
        assert out == pytest.approx(geometry.incidence_deg(rig, board), abs=1e-9)


@pytest.mark.parametrize(
    ("table", "key", "value", "code", "named"),
    [
        ("chirp", "start_hertz", 1.0, ErrorCode.KEY_UNKNOWN, ["start_hertz"]),
        ("chirp", "start_hz", "fast", ErrorCode.TYPE_WRONG, ["chirp.start_hz", "'fast'"]),
        ("chirp", "samples", 400, ErrorCode.VALUE_INVALID, ["adc_start_us", "sample_rate_hz", "ramp_end_us"]),
        ("chirp", "ramp_end_us", 10.0, ErrorCode.VALUE_INVALID, ["adc_start_us", "sample_rate_hz", "ramp_end_us"]),
        ("chirp", "slope_hz_per_s", 1e14, ErrorCode.VALUE_INVALID, ["start_hz", "slope_hz_per_s"]),
        ("chirp", "linear_samples", [0, 5], ErrorCode.VALUE_INVALID, ["linear_samples", "samples"]),
        ("chirp", "hpf1_khz", 180.0, ErrorCode.VALUE_INVALID, ["hpf1_khz", 175.0]),
        ("burst", "period_us", 200.0, ErrorCode.VALUE_INVALID, ["period_us", 300]),
        ("burst", "width_us", 5.0, ErrorCode.VALUE_INVALID, ["width_us", 0.025, 4]),
        ("image", "pixel_mm", 1e-4, ErrorCode.VALUE_INVALID, ["image.pixel_mm"]),
        ("image", "pixel_mm", 1e4, ErrorCode.VALUE_INVALID, ["image.pixel_mm"]),
        ("image", "columns", 30_000, ErrorCode.VALUE_INVALID, ["30000 x 150 pixels"]),
        ("image", "columns", 10_000, ErrorCode.VALUE_INVALID, ["image.columns", "image.pixel_mm", 20_000, 4_000]),
        ("pi", "trigger_in", 22, ErrorCode.VALUE_INVALID, ["trigger_in", "sync_out"]),
        ("pi", "sync_out", [22, 23], ErrorCode.VALUE_INVALID, ["sync_out", "wiring"]),
        ("pi", "trigger_bias", "up", ErrorCode.VALUE_INVALID, ["pi.trigger_bias", "'up'"]),
        ("pi", "trigger_debounce_us", 10, ErrorCode.VALUE_INVALID, ["trigger_debounce_us", "trigger_width_us"]),
        ("grid", "columns", 4000, ErrorCode.VALUE_INVALID, ["grid.columns", "grid.step_x_mm", "stage.travel_x_mm"]),
        ("grid", "columns", 9000, ErrorCode.VALUE_INVALID, ["stage.centre_x_mm"]),
        ("grid", "rows", 0, ErrorCode.VALUE_INVALID, ["grid.rows"]),
        ("stage", "accel_mm_s2", -1.0, ErrorCode.VALUE_INVALID, ["accel_mm_s2", -1.0]),
        ("burst", "pulses", 1_000_000_000, ErrorCode.VALUE_INVALID, ["burst.pulses", 65536]),
        ("limits", "command_timeout_s", 1e12, ErrorCode.VALUE_INVALID, ["limits.command_timeout_s", 86400]),
        ("limits", "end_of_record_s", 1e12, ErrorCode.VALUE_INVALID, ["limits.end_of_record_s", 86400]),
        ("stage", "speed_mm_s", 900.0, ErrorCode.VALUE_INVALID, ["grid.columns", "stage.speed_mm_s"]),
    ],
)
def test_a_broken_rule_names_the_file_and_every_key(table: str, key: str, value: object, code: ErrorCode, named: list):
    raw = read_toml(RIG_FILE)
    raw[table][key] = value
    with expect_refusal(code, "my.toml", *named):
        decode(raw, Instrument, "my.toml")


@pytest.mark.parametrize("debounce_us", [2_000, 4_000])
def test_a_trigger_outlasts_the_debounce_by_its_clocks_steps(debounce_us: int):
    raw = read_toml(RIG_FILE)
    raw["pi"]["trigger_debounce_us"] = debounce_us
    raw["stage"]["trigger_width_us"] = debounce_us + DEBOUNCE_TICKS_US
    assert decode(raw, Instrument, "my.toml").pi.trigger_debounce_us == debounce_us
    raw["stage"]["trigger_width_us"] -= 1
    with expect_refusal(ErrorCode.VALUE_INVALID, "trigger_width_us", "trigger_debounce_us"):
        decode(raw, Instrument, "my.toml")


def test_a_missing_table_and_a_second_transmitter_are_refused():
    raw = read_toml(RIG_FILE)
    raw["boards"][1]["role"] = "transmit"
    with expect_refusal(ErrorCode.VALUE_INVALID, "transmit"):
        decode(raw, Instrument, "my.toml")
    del raw["chirp"]
    with expect_refusal(ErrorCode.KEY_MISSING, "chirp"):
        decode(raw, Instrument, "my.toml")


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (None, ErrorCode.FILE_MISSING),
        (b"a = = 1", ErrorCode.FILE_DAMAGED),
        (b"\xff\xfe\x00", ErrorCode.FILE_UNREADABLE),
        ("# M\xfcnchen".encode("latin-1"), ErrorCode.FILE_UNREADABLE),
    ],
)
def test_a_missing_file_bad_toml_and_binary_data_are_refused(tmp_path: Path, content: bytes | None, code: ErrorCode):
    path = tmp_path / "rig.toml"
    if content is not None:
        path.write_bytes(content)
    with expect_refusal(code, path):
        load_instrument(path)


def test_a_file_in_another_encoding_is_reported_with_its_line(tmp_path: Path):
    path = tmp_path / "rig.toml"
    path.write_bytes("a = 1\n# M\xfcnchen\n".encode("latin-1"))
    with expect_refusal(ErrorCode.FILE_UNREADABLE, path, "line 2", "save it as UTF-8"):
        read_toml(path)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_files_of_editors_of_windows_are_read(tmp_path: Path, encoding: str, end: str):
    path = tmp_path / "rig.toml"
    path.write_bytes(f"a = 1{end}b = 'ü'{end}".encode(encoding))
    assert read_toml(path) == {"a": 1, "b": "ü"}


@pytest.mark.parametrize(
    ("line", "wrong", "suggestion"),
    [
        ("step_x_mm = 2.0", "stepx_mm = 2.0", "'step_x_mm'"),
        ("step_x_mm = 2.0", "samples = 2", "[chirp]"),
        ("step_x_mm = 2.0", "qqqq = 2", "'qqqq'"),
        ("[stage]", "[stagge]", "'stage'"),
    ],
)
def test_an_unknown_key_is_refused_with_a_suggestion(line, wrong, suggestion, tmp_path):
    text = RIG_FILE.read_text()
    assert text.count(f"\n{line}") == 1
    (tmp_path / "rig.toml").write_text(text.replace(f"\n{line}", f"\n{wrong}"))
    with expect_refusal(ErrorCode.KEY_UNKNOWN, suggestion):
        load_instrument(tmp_path / "rig.toml")


def test_a_missing_path_is_refused_with_a_similar_one(tmp_path):
    (tmp_path / "scan-7").mkdir()
    assert "'scan-7'" in str(make_missing_path_error(tmp_path / "scan-77"))
    assert str(tmp_path / "away") in make_missing_path_error(tmp_path / "away" / "scan-7").why
    (tmp_path / "file").touch()
    assert "is a file" in make_missing_path_error(tmp_path / "file").what
