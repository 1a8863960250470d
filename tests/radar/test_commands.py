"""Commands are encoded as by TI's library; codes are the nearest; values that exceed their field are refused."""

import hashlib
import struct

import pytest
from hypothesis import given, strategies as st

from polysight.radar import commands as c
from polysight.radar.calibration_data import InitCalibrations, RestoreCalibration, SaveCalibration
from polysight.radar.firmware import split_into_chunks
from polysight.radar.messages import command, decode, encode

# The chirp of the published rig, and one with other values in every field that may differ.
PUBLISHED = c.Profile(
    start_hz=76.01e9,
    slope_hz_per_s=38.816929e12,
    idle_us=100.0,
    adc_start_us=7.0,
    ramp_end_us=128.5,
    samples=256,
    sample_rate_hz=2.15e6,
    hpf1_khz=175.0,
    hpf2_khz=350.0,
    rx_gain_db=30,
    rf_gain_target_db=30,
)
OTHER = c.Profile(
    start_hz=76.01087e9,
    slope_hz_per_s=38.816929e12,
    idle_us=100.0,
    adc_start_us=6.5,
    ramp_end_us=128.5,
    samples=512,
    sample_rate_hz=5e6,
    hpf1_khz=350.0,
    hpf2_khz=2800.0,
    rx_gain_db=40,
    rf_gain_target_db=36,
    tx_backoff_db=3,
)
# What TI's mmWaveLink library writes to its SPI driver for these parameters (run apart from this project). The messages
# request an acknowledgement, as this project's do.
VECTORS: list[tuple[c.Command, str]] = [
    (c.DEVICE_CONFIGURATION, "3412214385802000000400000100597b4c401000010000000000000000000000bf4a972a"),
    (c.RF_POWER_UP, "3412214305801400001400000100e56b00400400f1e663c9"),
    (c.Channels(tx=0b010), "3412214301011c00002400000100e1da80000c000f0002000000200063bd8fee"),
    (c.AdcOutput("complex1x"), "3412214301011c00003400000100e1ca82000c000200010000000000f1fde42d"),
    (c.AdcOutput("complex2x"), "3412214301011c00004400000100e1ba82000c000200020000000000ed524a69"),
    (c.LdoBypass(), "341221438105180000540000010065a6cc0208000000000019a7ce6f"),
    (c.LdoBypass(bypass=True), "34122143810518000064000001006596cc020800010000007fa1e435"),
    (c.DataFormat(), "3412214385802000007400000100590b414010000f0002000100000000000000cc565a60"),
    (c.LOW_POWER_OFF, "3412214301011800008400000100e57a83000800000000001a845d5e"),
    (c.APLL_BANDWIDTH, "3412214301012400009400000100d96a8d001400010826090000000000000000000000000a1a13dd"),
    (c.RF_DEVICE, "341221430101200000a400000100dd5a86001000050000000000000001000000e20bc2f4"),
    (c.RF_INIT, "341221438101140000b400000100694ac00004004867aad4"),
    (
        PUBLISHED,
        "341221430102400000c400000100bd3900013000000000004a9f745410270000bc0200003232000000000000000000002403000000016608000000001e0000004e5a5104",
    ),
    (
        OTHER,
        "341221430102400000d400000100bd290001300000000000a4de7454102700008a020000323200000303030000000000240300000002881302030000a800000045fc8d4f",
    ),
    (c.Chirp(tx=0b010), "341221430102280000e400000100d519010118000000000000000000000000000000000000000200aa998d3b"),
    (c.DATA_PATH, "3412214385801c0000f4000001005c8b42400c00010100020000000046a469ae"),
    (c.DATA_PATH_CLOCK, "3412214385801800000400000100617b4440080001010000e10cb60d"),
    (c.HSI_CLOCK, "3412214301011800001400000100e5ea8500080009000000ddef4a25"),
    (c.LANE_ENABLE, "3412214385801800002400000100615b434008000f000000c1a45aec"),
    (c.LVDS_LANES, "3412214385801800003400000100614b45400800000001006f51ef83"),
    (
        c.Frame(frames=5600, period_us=1300.0, samples=256),
        "3412214301022c00004400000100d1b902011c000000000000000100e0150002a0f703000200000000000000c512bb5b",
    ),
    (c.FrameApply(samples=256), "3412214385811c000054000001005d2ac0400c00010000000002000002cbcd89"),
    (
        c.Frame(frames=350, period_us=10000.0, samples=256, loops=16, trigger_delay_us=2.0),
        "3412214301022c00006400000100d19902011c0000000000000010005e01000280841e000200000090010000b0a60481",
    ),
    (c.FrameApply(samples=256, chirps=16), "3412214385811c000074000001005d0ac0400c00100000000002000056c726ac"),
    (c.FrameControl(c.START), "3412214381021800008400000100657940010800010000005e5b90a3"),
    (c.FrameControl(c.STOP_AT_FRAME_END), "34122143810218000094000001006569400108000000000005e18ef3"),
    (c.FrameControl(c.STOP_WHILE_WAITING), "341221438102180000a4000001006559400108000400000051177a9e"),
    (c.GET_RF_VERSION, "341221434104140000b400000100a947200204009e8d2da9"),
    (c.GET_MAIN_VERSION, "34122143c581140000c40000010024bae04004006c141ab5"),
    (c.GET_TEMPERATURES, "34122143c105140000d4000001002926ea020400fd69edbf"),
]


# Messages in which the library did not request an acknowledgement: their flags differ from ours, so that only the
# sub-block and the message id are compared. The profile's values are those of the library's codes.
_PROFILE = c.Profile(
    start_hz=1435384036 * c.START_HZ_PER_CODE,
    slope_hz_per_s=414 * c.SLOPE_HZ_PER_S_PER_CODE,
    idle_us=10.0,
    adc_start_us=7.0,
    ramp_end_us=60.0,
    samples=64,
    sample_rate_hz=5e6,
    hpf1_khz=175.0,
    hpf2_khz=350.0,
    rx_gain_db=40,
    rf_gain_target_db=36,
    index=3,
)
WITHOUT_ACKNOWLEDGEMENT: list[tuple[c.Command, str]] = [
    (c.READ_FRAME, "34122143410214000c24000001009dd922010400a14f580e"),
    (InitCalibrations(0x0B10), "34122143010120000c4400000100d1ba89001000100b00000000000000000000d0762e17"),
    (SaveCalibration(0), "34122143410118000c540000010099aaab0008000000000081be78de"),
    (SaveCalibration(1), "34122143410118000c6400000100999aab00080000000100c3eef525"),
    (SaveCalibration(2), "34122143410118000c7400000100998aab000800000002003e607ae6"),
    (
        RestoreCalibration(2, bytes((448 + k) * 7 % 251 for k in range(224))),
        "341221430101f8000ca400000100f9598b00e800030002007c838a91989fa6adb4bbc2c9d0d7dee5ecf3fa060d141b222930"
        "373e454c535a61686f767d848b9299a0a7aeb5bcc3cad1d8dfe6edf400070e151c232a31383f464d545b626970777e858c93"
        "9aa1a8afb6bdc4cbd2d9e0e7eef501080f161d242b323940474e555c636a71787f868d949ba2a9b0b7bec5ccd3dae1e8eff6"
        "020910171e252c333a41484f565d646b727980878e959ca3aab1b8bfc6cdd4dbe2e9f0f7030a11181f262d343b424950575e"
        "656c737a81888f969da4abb2b9c0c7ced5dce3eaf1f8040b121920272e353c434a51585f666d747b828990979ea5acb36df8"
        "cb05",
    ),
    (c.GET_DIE_ID, "34122143410414000c14000001009de723020400940f23a0"),
    (
        _PROFILE,
        "34122143010240000c2400000100b1d90001300003000000e4388e55e8030000bc0200007017000000000000000000009e01"
        "00004000881300000000a80000007f56dae3",
    ),
]


@pytest.mark.parametrize(
    ("sent", "expected"),
    VECTORS + WITHOUT_ACKNOWLEDGEMENT,
    ids=lambda v: v.name if isinstance(v, c.Command) else "",
)
def test_bytes_are_those_of_ti_s_library(sent: c.Command, expected: str):
    message = decode(bytes.fromhex(expected))
    assert message.blocks == (sent.block(),)
    assert message.message_id == sent.block().message_id
    assert command((sent.block(),)).direction is message.direction
    if (sent, expected) in VECTORS:
        assert encode(command((sent.block(),), sequence=message.sequence)).hex() == expected


def test_parts_of_an_image_are_those_of_the_reference_encoder():
    """TI's library sent an image of 1000 bytes: the first message is compared by its digest, and the last one whole.

    The image begins with 224 bytes that count upwards and ends with 80 that count downwards; between them it is zero.
    Sequence numbers are those of the recorded messages.
    """
    image = bytes(range(8, 232)) + bytes(1000 - 224 - 80) + bytes(200 - n for n in range(80))
    parts = split_into_chunks(image)
    encoded_messages = []
    for (chunk, remaining), sequence in ((parts[0], 14), (parts[-1], 15)):
        encoded_messages.append(encode(command((chunk.block(),), sequence=sequence, remaining=remaining)))
    first, last = encoded_messages
    assert hashlib.sha256(first).hexdigest() == "24b45224df911dc384cd26e20ed5b00c5316b83765837a66500c679835f06942"
    assert last.hex() == (
        "341221430581640000f400000100948a80405400c8c7c6c5c4c3c2c1c0bfbebdbcbbbab9b8b7b6b5b4b3b2b1b0afaead"
        "acabaaa9a8a7a6a5a4a3a2a1a09f9e9d9c9b9a999897969594939291908f8e8d8c8b8a898887868584838281807f7e7d"
        "7c7b7a79d72b66b3"
    )


# Codes of 76 to 81 GHz, and of slopes up to 266 MHz/us (ICD 81 and 83).
@given(st.integers(0x5471C71C, 0x5A000000), st.integers(-5510, 5510))
def test_a_frequency_or_slope_gets_the_nearest_code(start: int, slope: int):
    assert c.start_code(start * c.START_HZ_PER_CODE) == start
    assert c.slope_code(slope * c.SLOPE_HZ_PER_S_PER_CODE) == slope
    # Nearly half a code more
    assert c.start_code((start + 0.49) * c.START_HZ_PER_CODE) == start


# Periods from 300 us to the largest that fits into 28 bits of 5 ns.
@given(st.integers(0, 65535), st.floats(300.0, 1.342e6), st.integers(1, 255))
def test_frames_can_be_decoded_from_their_bytes(frames: int, period_us: float, loops: int):
    data = c.Frame(frames=frames, period_us=period_us, samples=256, loops=loops).data()
    assert len(data) == 24
    _, _, _, decoded_loops, decoded_frames, _, period_ticks, trigger, _, _ = struct.unpack("<6HIHHI", data)
    assert (decoded_loops, decoded_frames) == (loops, frames)
    hardware_trigger = 2
    assert trigger == hardware_trigger
    # The period is rounded to the nearest tick: half a tick, and a little for the rounding of floats.
    tick_us = 0.005
    assert period_ticks * tick_us == pytest.approx(period_us, abs=0.52 * tick_us)


def test_a_value_that_exceeds_its_field_is_refused():
    with pytest.raises(ValueError, match="Frame"):
        c.Frame(frames=70_000, period_us=1300.0, samples=256).block()
    with pytest.raises(ValueError, match="Chirp"):
        c.Chirp(tx=-1).block()
