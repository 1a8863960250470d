"""The rig file: complete and checked; errors name file, key, value and rule."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from tests.support.paths import RIG_FILE
from tests.support.refusals import expect_refusal

from polysight_shared import geometry
from polysight_shared.config import DEBOUNCE_TICKS_US, Image, Instrument, MountStep, Pi, Radar, Section, load_instrument
from polysight_shared.errors import ConfigError, ErrorCode, make_missing_path_error
from polysight_shared.tables import decode, read_toml, to_builtins


def test_the_published_rig_survives_toml(rig: Instrument, tmp_path: Path):
    path = tmp_path / "copy.toml"
    path.write_text(tomli_w.dumps(to_builtins(rig)))
    assert load_instrument(path) == rig


def test_paths_are_relative_to_the_rig_file_and_an_empty_path_stays_empty(rig: Instrument, tmp_path: Path):
    table = to_builtins(rig)
    table["pi"]["key_dir"] = ""
    table["radar"] |= {"firmware": "", "trace_dir": "traces"}
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(table))
    loaded = load_instrument(path)
    # For a folder, "" is the folder of the rig file; for a file, it is no file.
    assert loaded.pi.key_dir == str(tmp_path)
    assert loaded.radar.firmware == ""
    assert loaded.radar.trace_dir == str(tmp_path / "traces")


def test_no_section_of_the_rig_can_be_changed(rig: Instrument):
    values = [getattr(rig, name) for name in rig.__struct_fields__]
    sections = [value for value in values if isinstance(value, Section)]
    for section in (rig, *sections):
        for name in section.__struct_fields__:
            with pytest.raises(AttributeError):
                setattr(section, name, getattr(section, name))


def test_the_rig_file_has_the_published_chirp_and_burst(rig: Instrument):
    # The relative limits follow from the number of digits in the paper.
    assert rig.chirp.swept_hz == pytest.approx(4.622e9, rel=1e-4)
    assert rig.chirp.first_sample_hz == pytest.approx(76.282e9, rel=1e-5)
    # A burst of 16 frames of 4 KiB.
    assert rig.frame_bytes * rig.burst.pulses == 65536


def test_mounts_reproduce_the_published_antenna_positions(rig: Instrument):
    h, v = rig.receivers
    # Positions are published in tenths of a millimetre: they are rounded by up to 0.05 mm.
    rounding_m = 6e-5
    assert geometry.tx_position_m(rig) == pytest.approx((-0.7055, 0.0974, 0.0130), abs=rounding_m)
    assert geometry.rx_positions_m(rig, h)[0] == pytest.approx((0.6843, 0.1035, 0.0094), abs=rounding_m)
    assert geometry.rx_positions_m(rig, v)[0] == pytest.approx((0.6836, 0.1337, 0.0104), abs=rounding_m)
    # The paper gives the path to a millimetre. 0.1 degrees are a limit for the angle of 55 degrees.
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
    """A turn about x moves y towards z and z away from y, and so on for the other axes. It is by 30 degrees here."""
    mount = (MountStep(turn_deg=30.0, about=axis),)
    # Points 1 m along each axis. Positions on a board are in millimetres, positions in the rig in metres.
    points_mm = 1000.0 * np.eye(3)
    images_m = [geometry.transform_to_rig(tuple(point_mm), mount) for point_mm in points_mm]
    cosine = math.cos(math.radians(30.0))
    sine = 0.5
    expected_m = np.eye(3)
    expected_m[first, first] = cosine
    expected_m[first, second] = sine
    expected_m[second, second] = cosine
    expected_m[second, first] = -sine
    for image_m, row_m in zip(images_m, expected_m, strict=True):
        assert image_m == pytest.approx(row_m)


def test_an_image_has_at_most_four_million_pixels():
    assert Image(columns=2000, rows=2000).rows == 2000
    with pytest.raises(ValueError, match="4000000"):
        Image(columns=2000, rows=2001)


def test_angles_of_incidence_and_reflection_are_equal_at_the_midpoint(rig: Instrument):
    for board in rig.receivers:
        rx_x, rx_y, rx_z = geometry.rx_positions_m(rig, board)[0]
        middle_x, middle_y, middle_z = geometry.specular_midpoint_m(rig, board)
        across_m = math.hypot(middle_x - rx_x, middle_y - rx_y)
        reflection_deg = math.degrees(math.atan2(across_m, middle_z - rx_z))
        assert reflection_deg == pytest.approx(geometry.incidence_deg(rig, board), abs=1e-9)


@pytest.mark.parametrize(
    ("table", "key", "value", "code", "named"),
    # `named`: words of the error, the keys that do not fit together and limits.
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


@pytest.mark.parametrize(
    ("table", "within", "beyond"),
    # Limits of the radar, of a Pi and of its lines, and others; polysight_shared/config.py has their reasons.
    [
        ("chirp", {"linear_samples": [0, 12]}, {"linear_samples": [0, 11]}),
        ("chirp", {"linear_samples": [244, 256]}, {"linear_samples": [245, 257]}),
        ("chirp", {"linear_samples": [0, 12]}, {"linear_samples": [-1, 12]}),
        ("chirp", {"start_hz": 76e9}, {"start_hz": 75.999e9}),
        # 100 us of 41 MHz/us are 4.1 GHz: the ramp ends at 81.1 GHz.
        ("chirp", {"start_hz": 77e9, "samples": 192, "ramp_end_us": 100.0, "slope_hz_per_s": 41e12},
         {"start_hz": 77.001e9}),
        # 200 samples at 2 MHz take 100 us: with the start of 7 us they end with the ramp.
        ("chirp", {"adc_start_us": 7.0, "samples": 200, "sample_rate_hz": 2e6, "ramp_end_us": 107.0},
         {"adc_start_us": 7.001}),
        ("chirp", {"hpf1_khz": 0.0, "hpf2_khz": 0.0}, {"hpf2_khz": 175.0}),
        ("chirp", {"hpf1_khz": 700.0, "hpf2_khz": 2800.0}, {"hpf1_khz": 1400.0}),
        ("burst", {"period_us": 300.0}, {"period_us": 299.9}),
        ("burst", {"width_us": 0.025}, {"width_us": 0.024}),
        ("burst", {"width_us": 4.0}, {"width_us": 4.001}),
        # Two chirps of 100 us and the pause of 300 us between two frames.
        ("burst", {"chirps": 2, "chirp_us": 100.0, "period_us": 500.0}, {"period_us": 499.9}),
        ("burst", {"chirps": 1, "chirp_us": 0.0}, {"chirps": 2}),
        ("burst", {"pulses": 1}, {"pulses": 0}),
        ("grid", {"step_x_mm": 0.001}, {"step_x_mm": 0.0009}),
        ("grid", {"step_y_mm": 0.001}, {"step_y_mm": 5e-324}),
        ("image", {"columns": 2000, "rows": 10, "pixel_mm": 2.0}, {"columns": 2001}),
        ("image", {"columns": 10, "rows": 2000, "pixel_mm": 2.0}, {"rows": 2001}),
        ("image", {"columns": 10, "rows": 10, "pixel_mm": 0.05}, {"pixel_mm": 0.049}),
        ("image", {"columns": 10, "rows": 10, "pixel_mm": 100.0}, {"pixel_mm": 100.1}),
        ("stage", {"travel_x_mm": 1000.0, "centre_x_mm": 500.0}, {"centre_x_mm": 1000.1}),
        ("stage", {"travel_y_mm": 1000.0, "centre_y_mm": 500.0}, {"centre_y_mm": 1000.1}),
        ("pi", {"wiring": "spi", "sync_out": [10], "pulses_in": 9}, {"sync_out": [22]}),
        ("pi", {"wiring": "spi", "sync_out": [10], "pulses_in": 9}, {"pulses_in": 8}),
        ("pi", {"wiring": "spi", "spi_device": "/dev/spidev1.0", "sync_out": [20], "pulses_in": 19},
         {"sync_out": [10]}),
        ("pi", {"wiring": "spi", "spi_device": "/dev/own.0", "sync_out": [5], "pulses_in": 6}, {"pulses_in": 5}),
        ("pi", {"pulses_in": 5}, {"pulses_in": 26}),
        ("pi", {"trigger_in": 63}, {"trigger_in": 64}),
        ("card", {"packet_bytes": 1470}, {"packet_bytes": 1471}),
        ("card", {"packet_bytes": 24}, {"packet_bytes": 23}),
        ("limits", {"command_timeout_s": 86400.0}, {"command_timeout_s": 86401.0}),
        ("radar", {"servers": {"RH": "rig:65535"}}, {"servers": {"RH": "rig:65536"}}),
        ("radar", {"servers": {"RH": "rig:1"}}, {"servers": {"RH": "rig:0"}}),
        ("radar", {"servers": {"RH": "rig:1"}}, {"servers": {"unknown": "rig:1"}}),
        ("notify", {"url": "https://a.b/c"}, {"url": "ftp://a.b/c"}),
        ("antennas", {"rx_mm": [[1e4, -1e4, 0.0]]}, {"rx_mm": [[1.1e4, 0.0, 0.0]]}),
        ("antennas", {"rx_mm": [[0.0, 0.0, 0.0]]}, {"rx_mm": [[0.0, math.nan, 0.0]]}),
        ("antennas", {"rx_mm": [[0.0, 0.0, 0.0]]}, {"rx_mm": []}),
        ("polarimetry", {"leakage_h": [1.0, -1.0]}, {"leakage_h": [1.1, 0.0]}),
        ("polarimetry", {"leakage_v": [1.0, -1.0]}, {"leakage_v": [0.0, math.nan]}),
        ("check", {"place_mm": [1e4, -1e4]}, {"place_mm": [math.inf, 0.0]}),
    ],
)  # fmt: skip
def test_a_value_at_its_limit_is_taken_and_one_beyond_is_refused(table: str, within: dict, beyond: dict):
    """A rig with the values of `within` is accepted; with the changed value of `beyond` it is refused."""
    raw = read_toml(RIG_FILE)
    raw.setdefault(table, {}).update(within)
    decode(raw, Instrument, "my.toml")
    raw[table].update(beyond)
    with expect_refusal(ErrorCode.VALUE_INVALID, "my.toml"):
        decode(raw, Instrument, "my.toml")


@pytest.mark.parametrize(("width_us", "is_taken"), [(0.4, False), (0.5, True), (2.0, True), (2.1, False)])
def test_a_pulse_by_spi_is_as_wide_as_the_controller_can_send_a_bit(width_us: float, is_taken: bool):
    """From 0.5 to 2 us; a pulse by a GPIO line may have any of these widths."""
    raw = read_toml(RIG_FILE)
    raw["burst"]["width_us"] = width_us
    decode(raw, Instrument, "my.toml")
    raw["pi"].update(wiring="spi", sync_out=[10], pulses_in=9)
    if is_taken:
        decode(raw, Instrument, "my.toml")
        return
    with expect_refusal(ErrorCode.VALUE_INVALID, "burst.width_us"):
        decode(raw, Instrument, "my.toml")


@pytest.mark.parametrize(
    "refused_names",
    [
        # A name that is too long, or empty.
        ["x" * 65, "RV"], ["", "RV"],
        # One with a first character, or another one, that it may not have.
        [" RH", "RV"], ["-RH", "RV"], ["R/H", "RV"], ["RH\n", "RV"],
        # Two boards of one name.
        ["RV", "RV"],
    ],
)  # fmt: skip
def test_the_name_of_a_board_can_be_the_name_of_its_folder(refused_names: list[str]):
    raw = read_toml(RIG_FILE)
    receivers = raw["boards"][1:]
    for board, name in zip(receivers, ["x" * 64, "R.1-b c_"], strict=True):
        board["name"] = name
    decode(raw, Instrument, "my.toml")
    for board, name in zip(receivers, refused_names, strict=True):
        board["name"] = name
    with expect_refusal(ErrorCode.VALUE_INVALID, "name"):
        decode(raw, Instrument, "my.toml")


def test_boards_may_share_an_address_or_a_port_and_not_both():
    raw = read_toml(RIG_FILE)
    first, second = raw["boards"][1:]
    second["host_address"] = first["host_address"]
    second["data_port"] = first["data_port"] + 1
    decode(raw, Instrument, "my.toml")
    second["data_port"] = first["data_port"]
    with expect_refusal(ErrorCode.VALUE_INVALID, "host_address", "data_port"):
        decode(raw, Instrument, "my.toml")


@pytest.mark.parametrize(
    ("tables", "places"),
    [
        ([{"usb_serial": "A"}, {"usb_serial": "B"}], ["A", "B"]),
        ([{"usb_serial": "B"}, {"usb_path": "1-4.2"}], ["B", "usb:1-4.2"]),
        ([{"usb_serial": "A"}, {"usb_serial": "A"}], None),
        ([{"usb_path": "1-4"}, {"usb_path": "1-4"}], None),
        ([{"usb_serial": "A", "usb_path": "1-4"}], None),
        ([{}], None),
    ],
)
def test_each_board_at_usb_has_one_place_of_its_own(tables: list[dict[str, str]], places: list[str] | None):
    """Its place is a serial number or a path of the bus. `places` is None for tables that are refused."""
    raw = {"native": dict(zip("ab", tables, strict=False))}
    if places is not None:
        assert [board.place for board in decode(raw, Radar, "my.toml").native.values()] == places
        return
    with expect_refusal(ErrorCode.VALUE_INVALID, "usb_serial"):
        decode(raw, Radar, "my.toml")


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({}, ["libgpiod", "pulses above 4 us", "sent, not seen"]),
        ({"wiring": "gpiomem"}, ["libgpiod", "spacing by the program"]),
        ({"one_shot": True, "pulses_in": 5}, ["one-shot", "spacing by the program", "by GPIO 5"]),
        ({"wiring": "spi", "one_shot": True, "sync_out": (10,)}, ["SPI controller", "by its clock"]),
    ],
)
def test_the_words_for_the_source_of_pulses_say_how_they_are_made_and_seen(keys: dict[str, Any], words: list[str]):
    text = Pi(**keys).pulse_source
    assert all(word in text for word in words)


def test_pulses_need_a_line():
    with pytest.raises(ValueError, match="at least one line"):
        Pi(sync_out=())


def test_data_of_a_scan_are_counted(rig: Instrument):
    # A frame has 256 samples of four receivers. A sample has I and Q with 2 bytes each.
    assert rig.frame_bytes == 256 * 4 * (2 + 2)
    # A row has 350 positions of 16 frames.
    assert rig.row_bytes == 350 * 16 * rig.frame_bytes
    # Two boards record 200 rows.
    assert rig.recorded_row_bytes == 2 * rig.row_bytes
    assert rig.scan_bytes == 200 * rig.recorded_row_bytes
    # Data bytes of a full packet (docs/spec/dca1000.md).
    assert rig.card.payload_bytes == 1456


@pytest.mark.parametrize(
    ("step", "beyond"),
    [
        ({"turn_deg": 360.0, "about": "x"}, {"turn_deg": 361.0, "about": "x"}),
        ({"turn_deg": -360.0, "about": "x"}, {"turn_deg": math.nan, "about": "x"}),
        ({"shift_mm": [1e4, 0.0, -1e4]}, {"shift_mm": [0.0, 0.0, 1e300]}),
    ],
)
def test_a_mount_turns_at_most_once_around_and_shifts_at_most_ten_metres(step: dict[str, Any], beyond: dict[str, Any]):
    decode(step, MountStep, "my.toml")
    with expect_refusal(ErrorCode.VALUE_INVALID):
        decode(beyond, MountStep, "my.toml")


def test_a_board_has_the_name_asked_for(rig: Instrument):
    assert [rig.by_name(board.name) for board in rig.boards] == list(rig.boards)
    with pytest.raises(KeyError):
        rig.by_name("MM")


def test_antennas_of_a_board_are_those_of_the_table():
    """The table has three transmit antennas, counted from 0, and four receive antennas, counted from 1."""
    raw = read_toml(RIG_FILE)
    transmitter = next(board for board in raw["boards"] if board["role"] == "transmit")
    for tx_antenna in (0, 2):
        transmitter["tx_antenna"] = tx_antenna
        decode(raw, Instrument, "my.toml")
    for tx_antenna in (3, 4):
        transmitter["tx_antenna"] = tx_antenna
        with expect_refusal(ErrorCode.VALUE_INVALID, "tx_antenna"):
            decode(raw, Instrument, "my.toml")
    transmitter["tx_antenna"] = 1
    for rx_order, is_taken in (([4, 2, 1, 3], True), ([1, 2, 3], False), ([1, 2, 3, 3], False), ([2, 3, 4, 5], False)):
        transmitter["rx_order"] = rx_order
        if is_taken:
            decode(raw, Instrument, "my.toml")
            continue
        with expect_refusal(ErrorCode.VALUE_INVALID, "rx_order"):
            decode(raw, Instrument, "my.toml")


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ('name = "red \\u001b[31m"', "name"),
        ('[stage]\nport = "/dev/tty\\u0000"', "port"),
        ('[[boards]]\nname = "RH\\u009b"', "name"),
        ('"a\\u0007b" = 1', "a"),
        ('names = ["RH", "R\\rV"]', "names"),
    ],
)
def test_a_text_with_a_character_that_a_terminal_obeys_is_refused(tmp_path: Path, line: str, key: str):
    path = tmp_path / "rig.toml"
    path.write_text(line)
    with expect_refusal(ErrorCode.VALUE_INVALID, path, key, "control character") as refusal:
        read_toml(path)
    assert str(refusal.value).replace("\n", "").isprintable()
    path.write_text('command = """\nfirst\n\tsecond"""')
    assert read_toml(path) == {"command": "first\n\tsecond"}


@pytest.mark.parametrize("debounce_us", [2_000, 4_000])
def test_a_trigger_is_longer_than_the_debounce_by_the_steps_of_the_debounces_clock(debounce_us: int):
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
def test_a_byte_order_mark_and_line_ends_of_windows_are_read(tmp_path: Path, encoding: str, end: str):
    path = tmp_path / "rig.toml"
    path.write_bytes(f"a = 1{end}b = 'ü'{end}".encode(encoding))
    assert read_toml(path) == {"a": 1, "b": "ü"}


@pytest.mark.parametrize(
    ("line", "unknown_key", "suggestion"),
    [
        ("step_x_mm = 2.0", "stepx_mm = 2.0", "'step_x_mm'"),
        ("step_x_mm = 2.0", "samples = 2", "[chirp]"),
        ("step_x_mm = 2.0", "qqqq = 2", "'qqqq'"),
        ("[stage]", "[stagge]", "'stage'"),
    ],
)
def test_an_unknown_key_is_refused_with_a_suggestion(line, unknown_key, suggestion, tmp_path):
    text = RIG_FILE.read_text()
    assert text.count(f"\n{line}") == 1
    (tmp_path / "rig.toml").write_text(text.replace(f"\n{line}", f"\n{unknown_key}"))
    with expect_refusal(ErrorCode.KEY_UNKNOWN, suggestion):
        load_instrument(tmp_path / "rig.toml")


def test_a_missing_path_is_refused_with_a_similar_one(tmp_path):
    (tmp_path / "scan-7").mkdir()
    assert "'scan-7'" in str(make_missing_path_error(tmp_path / "scan-77"))
    assert str(tmp_path / "away") in make_missing_path_error(tmp_path / "away" / "scan-7").why
    (tmp_path / "file").touch()
    assert "is a file" in make_missing_path_error(tmp_path / "file").what
