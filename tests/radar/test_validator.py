"""Each constraint of the radar holds for the published chirp, and is named when a value of the rig file breaks it."""

import math
import re

import msgspec
import pytest
from hypothesis import example, given, settings, strategies as st
from tests.support.radar.boards import change_radar_table, make_native_rig
from tests.support.refusals import expect_refusal

from polysight.radar.commands import check_constraints, direct_if_hz, list_constraints, make_program
from polysight_shared.config import Instrument, NativeRadar
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.geometry import direct_path_m

# Frames of a row of the published rig: 350 positions with 16 pulses each.
FRAMES = 350 * 16


def change_rig(rig: Instrument, table: str, **values) -> Instrument:
    """Return the rig with other values in a table, without the checks of the rig file's types."""
    part = msgspec.structs.replace(getattr(rig, table))
    for key, value in values.items():
        msgspec.structs.force_setattr(part, key, value)
    copied_rig = msgspec.structs.replace(rig)
    msgspec.structs.force_setattr(copied_rig, table, part)
    return copied_rig


def list_broken_constraints(rig: Instrument, frames: int = FRAMES) -> set[str]:
    return {c.name for c in list_constraints(rig, frames) if not c.holds}


def change_receiver(rig: Instrument, **values) -> Instrument:
    boards = tuple(msgspec.structs.replace(b, **values) if b.name == "RH" else b for b in rig.boards)
    return msgspec.structs.replace(rig, boards=boards)


def test_the_published_chirp_with_centred_receivers_holds(rig):
    check_constraints(rig, FRAMES)
    assert list_broken_constraints(rig) == set()


# Name of a constraint, and the table of the rig file with values that break it
BROKEN_CONSTRAINTS = [
    ("frame period", "burst", {"period_us": 450.0}),
    ("inter-frame time", "burst", {"period_us": 728.0}),
    ("pulse width", "burst", {"width_us": 4.1}),
    ("chirps", "burst", {"chirps": 0}),
    ("chirps", "burst", {"chirps": 256}),
    ("ramp", "chirp", {"ramp_end_us": -1.0}),
    ("pulse width", "burst", {"width_us": 0.02}),
    ("ADC window", "chirp", {"ramp_end_us": 126.0}),
    ("sample memory", "chirp", {"samples": 1025}),
    ("samples", "chirp", {"samples": 31}),
    ("sample rate", "chirp", {"sample_rate_hz": 1.9e6}),
    ("sample rate", "chirp", {"sample_rate_hz": 23e6}),
    ("sample rate step", "chirp", {"sample_rate_hz": 2.1502e6}),
    ("slope", "chirp", {"slope_hz_per_s": 267e12}),
    ("ADC start", "chirp", {"adc_start_us": 41.0}),
    ("ramp", "chirp", {"ramp_end_us": 5001.0}),
    ("idle", "radar", {"idle_us": 5300.0}),
    ("high-pass filters", "chirp", {"hpf1_khz": 0.0}),
    ("high-pass filters", "chirp", {"hpf2_khz": 0.0}),
    ("RX gain", "radar", {"rx_gain_db": -1}),
    ("RX gain", "radar", {"rx_gain_db": 54}),
    ("RX gain", "radar", {"rx_gain_db": 30}),
    ("RX gain step", "radar", {"rx_gain_db": 31}),
    ("TX back-off", "radar", {"tx_backoff_db": 21}),
    ("sweep of RH", "chirp", {"ramp_end_us": 128.6}),
    ("start frequency of RH", "chirp", {"start_hz": 75.99e9}),
]


@pytest.mark.parametrize(("name", "table", "values"), BROKEN_CONSTRAINTS)
def test_a_broken_constraint_is_reported_with_formula_limits_and_value(rig, name, table, values):
    invalid_rig = change_rig(rig, table, **values)
    assert name in list_broken_constraints(invalid_rig)
    with pytest.raises(ConfigError) as caught:
        check_constraints(invalid_rig, FRAMES)
    result = next(c for c in list_constraints(invalid_rig, FRAMES) if c.name == name and not c.holds)
    assert str(result) in str(caught.value)
    assert result.formula in str(result)
    assert f"{result.value:.12g}" in str(result)
    assert result.remedy in str(caught.value)


def test_the_lowest_start_frequency_is_the_lowest_code_of_the_radar(rig):
    """The lowest code of TI's interface control document stands for a little less than 76 GHz."""
    lowest_code = 0x5471C71B
    hz_per_code = 3.6e9 / 2**26
    transmitter = msgspec.structs.replace(rig.transmitter, start_offset_hz=0.0)
    for start_hz, holds in (
        (76e9, True),
        (lowest_code * hz_per_code, True),
        ((lowest_code - 1) * hz_per_code, False),
    ):
        changed_rig = change_rig(rig, "chirp", start_hz=start_hz)
        assert (f"start frequency of {transmitter.name}" not in list_broken_constraints(changed_rig)) is holds


def test_only_simulated_radars_may_have_no_filters(rig):
    native = {n: NativeRadar(usb_serial=f"tcp://127.0.{k}.1:2000") for k, n in enumerate(rig.radar.native)}
    served = change_radar_table(rig, native=native)
    assert list_broken_constraints(change_rig(served, "chirp", hpf1_khz=0.0, hpf2_khz=0.0)) == set()


# Numbers of the rig file: table and key.
FLOATS = [("chirp", key) for key in ("start_hz", "slope_hz_per_s", "adc_start_us", "sample_rate_hz", "ramp_end_us")]
FLOATS += [("burst", "period_us"), ("burst", "width_us"), ("burst", "chirp_us"), ("radar", "idle_us")]
INTS = [
    ("chirp", "samples"),
    ("burst", "pulses"),
    ("burst", "chirps"),
    ("radar", "rx_gain_db"),
    ("radar", "tx_backoff_db"),
]
ANY_FLOAT = st.one_of(st.floats(), st.sampled_from([0.0, -1.0, 1e30, -1e12, 1e308, float("nan"), float("inf")]))
ANY_INT = st.one_of(st.integers(-70_000, 70_000), st.integers())


@settings(deadline=None, max_examples=60)
@given(
    st.dictionaries(st.sampled_from(FLOATS), ANY_FLOAT, max_size=2),
    st.dictionaries(st.sampled_from(INTS), ANY_INT, max_size=2),
    st.one_of(st.just(790e3), ANY_FLOAT),
    st.integers(-1, 70_000),
)
# The start frequency and the offset together are infinite.
@example({("chirp", "start_hz"): 9e307}, {}, 9e307, 0)
def test_any_rig_file_is_refused_or_can_be_encoded(floats, ints, offset_hz, frames):
    rig = change_receiver(make_native_rig(), start_offset_hz=offset_hz)
    unusable_numbers = floats | ints
    for table in sorted({table for table, _ in unusable_numbers}):
        rig = change_rig(
            rig, table, **{key: value for (section, key), value in unusable_numbers.items() if section == table}
        )
    if all(c.holds for c in list_constraints(rig, frames)):
        for board in rig.boards:
            for sent in make_program(rig, board).make_frame_commands(frames):
                sent.block()
    else:
        with pytest.raises(ConfigError):
            check_constraints(rig, frames)


@pytest.mark.parametrize(("frames", "holds"), [(0, False), (1, True), (65535, True), (65536, False)])
def test_a_row_has_1_to_65535_frames(rig, frames, holds):
    """The radar's field has 16 bits, and its value 0 would mean endless frames."""
    assert ("frames" not in list_broken_constraints(rig, frames)) is holds


def test_too_little_time_between_the_pulses_of_the_published_burst_is_a_broken_constraint(rig, monkeypatch):
    monkeypatch.setattr("polysight.radar.commands.TRIGGER_MARGIN_US", 149.0)
    assert list_broken_constraints(rig) == {"pulse gap"}


def test_the_shortest_burst_period_leaves_300_us_after_the_chirps(rig):
    """A frame is idle time, ramp and 10 ns; 300 us follow (the radar's least), and 200 us to the next pulse."""
    shortest_us = 100.0 + 128.5 + 0.01 + 300.0 + 200.0
    assert "inter-frame time" not in list_broken_constraints(change_rig(rig, "burst", period_us=shortest_us + 1e-6))
    assert "inter-frame time" in list_broken_constraints(change_rig(rig, "burst", period_us=shortest_us - 1e-3))


@pytest.mark.parametrize(("chirp_us", "holds"), [(228.51, True), (228.5, False), (300.0, False)])
def test_the_chirp_spacing_must_be_that_of_the_radar(rig, chirp_us, holds):
    """The radar's spacing is idle + ramp + 10 ns; the rig file must have the same."""
    burst = msgspec.structs.replace(rig.burst, pulses=1, chirps=16, chirp_us=chirp_us, period_us=6000.0)
    many = msgspec.structs.replace(rig, burst=burst)
    assert ("chirp spacing" not in list_broken_constraints(many)) is holds
    result = next(c for c in list_constraints(many, FRAMES) if c.name == "chirp spacing")
    # The idle time that the remedy advises keeps the constraint: "set radar.idle_us to 99.99, or ...".
    (advised_idle_us,) = re.findall(r"radar\.idle_us to ([\d.]+),", result.remedy)
    changed_rig = change_radar_table(many, idle_us=float(advised_idle_us))
    assert "chirp spacing" not in list_broken_constraints(changed_rig)


def test_a_frame_of_many_chirps_needs_a_longer_period(rig):
    # As after a single chirp, 300 us must follow, and 200 us to the next pulse.
    chirps_us = 16 * 228.51
    for period, holds in ((chirps_us + 500.0 + 1e-3, True), (chirps_us + 499.0, False)):
        burst = msgspec.structs.replace(rig.burst, pulses=1, chirps=16, chirp_us=228.51, period_us=period)
        assert ("inter-frame time" not in list_broken_constraints(msgspec.structs.replace(rig, burst=burst))) is holds


def test_the_bypass_of_a_boards_regulators_has_to_be_confirmed_by_its_serial_number(rig):
    """With the usual 1.3 V on its RF supplies the bypass may destroy a chip, and a USB path does not name the board."""
    native = {**rig.radar.native, "RH": NativeRadar(usb_path="1-4.2", ldo_bypass=True)}
    invalid_rig = change_radar_table(rig, native=native)
    assert list_broken_constraints(invalid_rig) == {"LDO bypass of RH"}


def test_the_serial_number_of_another_board_does_not_confirm_the_bypass(rig):
    def acknowledge_bypass(acknowledged: str) -> Instrument:
        native = {**rig.radar.native, "RH": NativeRadar("FTRH", ldo_bypass=True, ldo_bypass_acknowledged=acknowledged)}
        return change_radar_table(rig, native=native)

    for serial in ("", "FTRV"):
        assert list_broken_constraints(acknowledge_bypass(serial)) == {"LDO bypass of RH"}
    assert list_broken_constraints(acknowledge_bypass("FTRH")) == set()
    with expect_refusal(ErrorCode.VALUE_INVALID, "LDO bypass"):
        check_constraints(acknowledge_bypass("yes"), FRAMES)


def test_expected_if_is_slope_times_path_plus_offset(rig):
    for name in ("RH", "RV"):
        board = rig.by_name(name)
        mean_m = math.fsum(direct_path_m(rig, board)) / 4
        expected = rig.chirp.slope_hz_per_s * mean_m / 299_792_458 + board.start_offset_hz
        # Two frequencies are rounded to codes of 53.6 Hz.
        assert direct_if_hz(rig, board) == pytest.approx(expected, abs=120.0)


@pytest.mark.parametrize(("mode", "offset", "holds"), [
    ("complex1x", 0.0, False), ("complex1x", 790e3, True), ("complex1x", 1.7e6, False),
    ("complex2x", 0.0, True), ("complex2x", -1.1e6, False), ("complex2x", 700e3, False),
])  # fmt: skip
def test_the_direct_path_lies_within_the_sampled_band(rig, mode, offset, holds):
    """From 0 to the sample rate, 2.15 MHz, in complex1x; in complex2x half of it to either side of 0, with a margin."""
    changed_rig = change_rig(change_receiver(rig, start_offset_hz=offset), "chirp", if_mode=mode, ramp_end_us=128.4)
    assert ("IF budget of RH" not in list_broken_constraints(changed_rig)) is holds


def test_the_remedy_of_the_if_budget_centres_the_direct_path(rig):
    changed_rig = change_receiver(rig, start_offset_hz=0.0)
    result = next(c for c in list_constraints(changed_rig, FRAMES) if c.name == "IF budget of RH")
    offset = float(re.findall(r"[\d.]+", result.remedy)[-1])
    changed_rig = change_receiver(rig, start_offset_hz=offset)
    middle_of_band_hz = 0.45 * rig.chirp.sample_rate_hz
    found_hz = direct_if_hz(changed_rig, changed_rig.by_name("RH"))
    # Frequencies are rounded to codes of 53.6 Hz.
    assert found_hz == pytest.approx(middle_of_band_hz, abs=60.0)


def test_every_constraint_has_a_test(rig):
    tested = {name for name, _, _ in BROKEN_CONSTRAINTS}
    # Constraints with a test of their own
    tested |= {"frames", "pulse gap", "LDO bypass of RH", "IF budget of RH"}
    names = {constraint.name for constraint in list_constraints(rig, FRAMES)}
    # The constraints of one board are the same for the others.
    names_of_other_boards = {name for name in names if name.endswith((" of LS", " of RV"))}
    assert names - names_of_other_boards == tested


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("size", "is_usable"), [(1e29, True), (1.1e30, False), (math.inf, False), (math.nan, False)])
def test_of_an_extreme_number_only_the_number_is_reported(rig, sign, size, is_usable):
    receiver = rig.receivers[0]
    extreme_receiver = msgspec.structs.replace(receiver, start_offset_hz=sign * size)
    boards = tuple(extreme_receiver if b is receiver else b for b in rig.boards)
    names = [c.name for c in list_constraints(msgspec.structs.replace(rig, boards=boards), 4) if not c.holds]
    assert (names == [f"boards.{receiver.name}.start_offset_hz"]) == (not is_usable)
