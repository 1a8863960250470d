"""Bytes of real devices, published by their users (TI E2E forum), with their meaning."""

from __future__ import annotations

# AWR2243, refused 0x0105 (advanced frame) with error 62; the commands had a 32-bit CRC. E2E 1096533.
AWR2243_ERROR = bytes.fromhex("badccdab1200180000a400000100d45b000008003e000501ad6a9e9b")
# AWR1243, power-up with an empty flash, and with TI's image written to it; its answer to RF power-up. E2E 670135.
AWR1243_UP_EMPTY = bytes.fromhex("badccdab36a022000c00000001009a5f0050140000000000ff7c0c0000000000000000000280")
AWR1243_UP_WRITTEN = bytes.fromhex(
    "badccdab36a026000c0000000100965f0050180010aa05000000000000000000000000000000000063d6"
)
AWR1243_RF_UP = bytes.fromhex("badccdab16800e000c0000000000cf7f6c90")
# AWR1243, refused the first part of a firmware file, without saying why. E2E 752121.
AWR1243_ERROR = bytes.fromhex("badccdab16000e000c0000000100ceffcbcd")
# AWR2243, main core fault while its firmware was loaded; the start then succeeds. E2E 1267477. The forum's text lost a
# digit among the zeros: their number is that of the length, and the CRC is right with it.
_FAULT_BEGIN, _FAULT_END = "badccdab36a032000c00000001008a5f0250240005000000800000fe", "ffffffffffff0000f4b5"
AWR2243_FAULT = bytes.fromhex(_FAULT_BEGIN) + bytes(54 - 28 - 10) + bytes.fromhex(_FAULT_END)

ALL = {
    "AWR2243 error": AWR2243_ERROR,
    "AWR1243 power-up, flash empty": AWR1243_UP_EMPTY,
    "AWR1243 power-up, flash written": AWR1243_UP_WRITTEN,
    "AWR1243 RF power-up": AWR1243_RF_UP,
    "AWR1243 error without a body": AWR1243_ERROR,
    "AWR2243 main core fault": AWR2243_FAULT,
}
