"""The two cores of a simulated AWR2243: their states, the effect of each command, messages and firmware images.

The table in docs/spec/mmwavelink.md ("The stand-in") has the answers in each state, with the sections of TI's document
("ICD", revision 2.23). Messages are encoded independently of the host's codec, after that document and received ones.

Firmware images have TI's file format without a program, that of public copies of TI's `xwr22xx_metaImage.bin` (7,940
bytes): `MSTR`, length without the CRC at byte 20, `MEND`, an `RPRC` part for the main core at byte 128 and one for the
RF core after it, CRC-32 at the end. A part has its ROM version at offset 56 and the patch version at 72: major, minor,
build, debug, year, month, day.
"""

import binascii
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

# First bytes of a message to the device, of the host's signal that it is ready, and of a message from the device.
TO_DEVICE = bytes.fromhex("34122143")
HOST_READY = bytes.fromhex("78566587")
FROM_DEVICE = bytes.fromhex("badccdab")
# Kinds of messages.
RESPONSE = 1
NACK = 2
EVENT = 3

# Received from real devices (TI E2E forum, threads 670135, 752121, 1267477): data of the event of a fault of the main
# core, and of the power-up of a first-generation board with its flash empty or written.
FAULT_DATA = bytes.fromhex("05000000800000fe") + bytes(16) + b"\xff" * 6 + bytes(2)
OLD_UP_EMPTY = bytes.fromhex("00000000ff7c0c000000000000000000")
OLD_UP_WRITTEN = bytes.fromhex("10aa0500") + bytes(16)
# Duration of the power-up in units of 5 ns, that of OLD_UP_WRITTEN. It is the first word of a power-up's event; the
# boot status and the failed self-tests follow.
POWER_UP_TIME = 0x5AA10


def compute_ones_sum(head: bytes) -> int:
    """Compute the ones-complement sum of 16-bit words; 0xFFFF over a header with its checksum (ICD 2.3.2)."""
    total = sum(struct.unpack(f"<{len(head) // 2}H", head))
    while total > 0xFFFF:
        total = (total & 0xFFFF) + (total >> 16)
    return total


def encode_message(direction: int, kind: int, number: int, body: bytes, count: int, sequence: int, wide: bool) -> bytes:
    """Encode a message with a CRC of 32 (`wide`) or 16 bits (ICD 2.3); the latter has its acknowledgement bits set.

    `direction`: code of sender and receiver, four bits; `kind`: such as RESPONSE; `number`: message id; `body`: `count`
    encoded sub-blocks; `sequence`: the host's number of the command, four bits.
    """
    # Bits 2 and 3: acknowledgement. Bits 10 and 11: length of the CRC, 0 for 16 bits, 1 for 32.
    flags = sequence << 12 | 0xC
    crc_bytes = 2
    if wide:
        flags = sequence << 12 | 1 << 10
        crc_bytes = 4
    head = struct.pack("<5H", direction | kind << 4 | number << 6, 12 + len(body) + crc_bytes, flags, 0, count)
    head += struct.pack("<H", 0xFFFF - compute_ones_sum(head))
    crc = zlib.crc32(head + body).to_bytes(4, "little")
    if not wide:
        crc = binascii.crc_hqx(head + body, 0xFFFF).to_bytes(2, "little")
    return FROM_DEVICE + head + body + crc


# Bits of the boot status, ICD table 7.3.
METAHEADER_NOT_FOUND = 1 << 6
METAHEADER_CRC_FAILURE = 1 << 30
MSSIMAGE_NOT_FOUND = 1 << 28
# Versions: major, minor, build, debug, year, month, day. Then the offsets of the two parts of an image.
_ROM = bytes((2, 2, 1, 7, 20, 3, 17))
_MAIN_PATCH = bytes((2, 2, 2, 0, 20, 7, 29))
_RF_PATCH = bytes((2, 2, 4, 0, 22, 7, 6))
_MAIN_OFFSET = 0x80
_RF_OFFSET = 0x880


def make_image(size: int = 7940, *, rom: bytes = _ROM) -> bytes:
    """Make an image of `size` bytes from which a simulated board boots, with the versions above.

    The four words between `MSTR` and the length mean nothing here.
    """
    filler = bytes(n * 7 % 251 for n in range(size - 4))
    image = bytearray(filler)
    head = struct.pack("<4s5I", b"MSTR", 2, 0x37, 0, 0, size - 4)
    image[:_MAIN_OFFSET] = head.ljust(0x5C, b"\0") + b"MEND".ljust(0x24, b"\0")
    for offset, patch in ((_MAIN_OFFSET, _MAIN_PATCH), (_RF_OFFSET, _RF_PATCH)):
        image[offset : offset + 0x60] = b"RPRC".ljust(0x38, b"\0") + rom.ljust(0x10, b"\0") + patch.ljust(0x18, b"\0")
    return bytes(image) + zlib.crc32(image).to_bytes(4, "little")


def find_boot_errors(image: bytes) -> int:
    """Return the status bits of a boot from this image (ICD table 7.3); 0 if it succeeds."""
    if image[:4] != b"MSTR":
        return METAHEADER_NOT_FOUND | MSSIMAGE_NOT_FOUND
    length = int.from_bytes(image[20:24], "little")
    if len(image) < length + 4 or zlib.crc32(image[:length]) != int.from_bytes(image[length : length + 4], "little"):
        return METAHEADER_CRC_FAILURE
    return 0


def encode_patch_version(image: bytes, main: bool) -> bytes:
    """Return the last six bytes of a version answer (ICD tables 5.66, 5.157): major, minor, date, build and debug.

    `main`: of the main core's part of the image, otherwise of the RF core's.
    """
    start = _MAIN_OFFSET if main else _RF_OFFSET
    offset = start + 0x48
    major, minor, build, debug, *date = image[offset : offset + 7]
    return bytes((major, minor, *date, build << 4 | debug))


# Durations of boot, RF power-up, RF calibration and erasing the flash, and the delay of the events `TRIGGER_READY` and
# `FRAME_END`, in this order. All are chosen: real timing is not known.
BOOT_S = 0.05
RF_UP_S = 0.02
RF_INIT_S = 0.3
ERASE_S = 4.0
READY_S = 1e-3
# Sub-block numbers of events.
UP_MAIN = 0x5000
UP_RF = 0x5001
MAIN_FAULT = 0x5002
BOOTED = 0x5005
CALIBRATED = 0x1004
TRIGGER_READY = 0x100B
FRAME_END = 0x100F
RF_FAULT = 0x1002
# Sub-block numbers of commands (ICD 5).
DOWNLOAD = 0x4080
SET_EVENT_CHECKSUM = 0x404C
POWER_UP_RF = 0x4000
READ_MAIN_VERSION = 0x40E0
READ_RF_VERSION = 0x0220
READ_DIE = 0x0223
READ_TEMPERATURES = 0x02EA
SET_LDO_BYPASS = 0x02CC
INIT_RF = 0x00C0
START_OR_STOP_FRAMES = 0x0140
READ_PROFILE = 0x0120
READ_CHIRP = 0x0121
READ_FRAME = 0x0122
# Error numbers of the ICD's tables 5.1, 7.1 and 7.2.
UNKNOWN_COMMAND = 3
WRONG_LENGTH = 4
INVALID_INPUT = 5
WRONG_STATE = 6
PROFILE_OUT_OF_RANGE = 35
CHIRP_END_OUT_OF_RANGE = 60
CHIRP_END_BEFORE_START = 61
CHIRP_PROFILE_OUT_OF_RANGE = 62
CHIRP_PROFILE_UNDEFINED = 63
FRAME_WHILE_ARMED = 83
# More sub-block numbers of commands: settings that are stored, and calibration data.
PROFILE = 0x0100
CHIRP = 0x0101
FRAME = 0x0102
STREAM_SET = 0x0103
STREAM = 0x0104
SAVE = 0x00AB
RESTORE = 0x008B
# Calibration data come in three parts.
CHUNK_BYTES = 224
CHUNKS = 3
# Number of data bytes of each sub-block. Numbers without a name are those of settings that are only stored; the others
# are explained in docs/spec/mmwavelink.md: 0x0080 channels, 0x0082 ADC output, 0x4041 data format, 0x40C0 frame size.
DATA_BYTES = {
    0x0080: 8, 0x0082: 8, 0x0083: 4, 0x0085: 4, 0x0086: 12, 0x0089: 12, RESTORE: 228, 0x008D: 16, SAVE: 4, INIT_RF: 0,
    PROFILE: 44, CHIRP: 20, FRAME: 24, STREAM_SET: 20, STREAM: 4, READ_PROFILE: 4, READ_CHIRP: 4, READ_FRAME: 0,
    START_OR_STOP_FRAMES: 4,
    READ_RF_VERSION: 0, READ_DIE: 0, SET_LDO_BYPASS: 4, READ_TEMPERATURES: 0, POWER_UP_RF: 0,
    0x4041: 12, 0x4042: 8, 0x4043: 4,
    0x4044: 4, 0x4045: 4, 0x4046: 4, SET_EVENT_CHECKSUM: 12, 0x40C0: 8, READ_MAIN_VERSION: 0,
}  # fmt: skip
# Commands without which frames do not start.
_BEFORE_FRAMES = (
    0x0080, 0x0082, 0x0086, INIT_RF, PROFILE, CHIRP, FRAME, 0x4041, 0x4042, 0x4043, 0x4044, 0x4045, 0x40C0,
)  # fmt: skip
# Commands that are accepted before the RF power-up.
_WITHOUT_RF = (DOWNLOAD, SET_EVENT_CHECKSUM, POWER_UP_RF, READ_MAIN_VERSION)


@dataclass
class Cores:
    """Both cores and the serial flash.

    Attributes
    ----------
    now, event
        Clock in seconds, and a function that sends an event: number, data, delay in s.
    flash, ram
        Images in the serial flash and downloaded to RAM; empty: none.
    die_number
        Part of the die id, which identifies the board; 0: the id is all zeros.
    supply_v
        Voltage of the RF supplies; LDO bypass above 1.1 V makes the board `destroyed`.
    erase_s
        Duration of erasing the flash.
    fault_at
        When the main core reports its harmless fault: "power-up", "download" or "never".
    first_generation
        Boots and refuses like an AWR1243.
    hardware_bits
        Bits added to the status of a boot from flash.
    main_rom, rf_rom
        ROM versions of the cores: major, minor, build, debug.
    executed
        Numbers of the commands that succeeded, in order.
    settings, profiles, chirps
        Data of the last sub-block of each number; of profiles and chirps by their index.
    armings
        How often frames were started.
    """

    now: Callable[[], float]
    event: Callable[[int, bytes, float], None]
    flash: bytes = b""
    ram: bytes = b""
    die_number: int = 1
    supply_v: float = 1.3
    erase_s: float = ERASE_S
    fault_at: str = "power-up"
    first_generation: bool = False
    hardware_bits: int = 0
    # Bits of the self-tests of the RF core that pass.
    passing_rf_tests: int = 0x07FFFFFF
    # Bits of the RF calibrations that pass.
    passing_calibrations: int = 0x1FFE
    main_rom: tuple[int, int, int, int] = (2, 2, 1, 7)
    rf_rom: tuple[int, int, int, int] = (2, 2, 1, 7)
    destroyed: bool = False
    executed: list[int] = field(default_factory=list)
    settings: dict[int, bytes] = field(default_factory=dict)
    profiles: dict[int, bytes] = field(default_factory=dict)
    chirps: dict[int, bytes] = field(default_factory=dict)
    armings: int = 0

    def __post_init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Reset: clear RAM and settings, keep the flash."""
        self.ram = b""
        # The flash's image from which the main core booted; empty: from ROM alone.
        self._booted = b""
        self.main_up = False
        self.rf_up = False
        self.calibrated = False
        self.crc32_events = False
        # Frames that SYNC_IN will still start; negative: without end.
        self.frames_left = 0
        # Frames are started and wait for SYNC_IN, or run without end by a software trigger.
        self.armed = False
        # When the frame in progress ends, by the clock `now`.
        self.frame_ends = -1.0
        # File type and missing bytes of the download in progress; None: no download.
        self._file: tuple[int, int] | None = None
        # Parts of calibration data that came so far, by their number.
        self._restored: dict[int, bytes] = {}
        # Content of the download so far.
        self._received = b""
        for table in (self.settings, self.profiles, self.chirps):
            table.clear()

    def boot(self) -> None:
        """Boot in functional mode: ROM, then the flash's image if it is complete (ICD 5.21.1); report it by events."""
        self.main_up = True
        broken = find_boot_errors(self.flash)
        self._booted = b"" if broken else self.flash
        if self.first_generation:
            self.event(UP_MAIN, OLD_UP_EMPTY if broken else OLD_UP_WRITTEN, BOOT_S)
        else:
            self.event(UP_MAIN, struct.pack("<IQQ", POWER_UP_TIME, broken | self.hardware_bits, 0), BOOT_S)
        if self.fault_at == "power-up":
            self.event(MAIN_FAULT, FAULT_DATA, BOOT_S + 1e-3)

    def execute(self, number: int, data: bytes, remaining: int) -> tuple[int, bytes, float]:
        """Execute a command; return error number (0: none; ICD table 5.1, 7.1, 7.2), answer, and extra delay in s.

        `number`, `data`: of its sub-block; `remaining`: parts of a file that follow.
        """
        if number == DOWNLOAD:
            return self._download(data, remaining)
        # A first-generation board does not know the PLL bandwidths, 0x008D.
        if number not in DATA_BYTES or (self.first_generation and number == 0x008D):
            return UNKNOWN_COMMAND, b"", 0.0
        if len(data) != DATA_BYTES[number]:
            return WRONG_LENGTH, b"", 0.0
        if not self.main_up or (number not in _WITHOUT_RF and not self.rf_up):
            return WRONG_STATE, b"", 0.0
        error, answer = self._dispatch(number, data)
        if not error:
            self.executed.append(number)
            self.settings[number] = data
        return error, answer, 0.0

    def _dispatch(self, number: int, data: bytes) -> tuple[int, bytes]:
        """Execute a command of right size and state; return error number and answer."""
        if number == START_OR_STOP_FRAMES:
            return self._start_or_stop(struct.unpack_from("<H", data)[0]), b""
        if number == FRAME and self.armed:
            return FRAME_WHILE_ARMED, b""
        if number in (READ_PROFILE, READ_CHIRP, READ_FRAME):
            return self._read_back(number, data)
        if number in (PROFILE, CHIRP):
            return self._store_profile_or_chirps(number, data), b""
        if number in (SAVE, RESTORE):
            return self._save_or_restore_calibration(number, data)
        return 0, self._apply_setting_or_query(number, data)

    def _apply_setting_or_query(self, number: int, data: bytes) -> bytes:
        """Execute a command that cannot fail; return its answer, b"" for none."""
        if number == SET_EVENT_CHECKSUM:
            self.crc32_events = data[0] == 1
        elif number == POWER_UP_RF:
            # A first-generation board without a patch never reports the power-up, as observed.
            if self._choose_image() or not self.first_generation:
                self.rf_up = True
                # Self-tests, and the duration of the power-up; chosen.
                self.event(UP_RF, struct.pack("<4I", self.passing_rf_tests, 2000, 0, 0), RF_UP_S)
        elif number == INIT_RF:
            self.calibrated = True
            self._report_calibration(self.passing_calibrations)
        elif number == SET_LDO_BYPASS and data[0] & 1 and self.supply_v > 1.1:
            self.destroyed = True
        elif number in (READ_RF_VERSION, READ_MAIN_VERSION):
            rom = self.main_rom if number == READ_MAIN_VERSION else self.rf_rom
            # Three bytes of the hardware (chosen), the ROM's version, and its date as in _ROM.
            return bytes((1, 2, 0, *rom, 20, 3, 17)) + self._find_patch_version(main=number == READ_MAIN_VERSION)
        elif number == READ_DIE:
            if not self.die_number:
                return bytes(32)
            # The words are arbitrary, but differ from board to board.
            return struct.pack("<8I", 0x5EED0000 + self.die_number, 0xD1E, 2243, self.die_number, 0, 0, 0, 0)
        elif number == READ_TEMPERATURES:
            # Device time in ms, then degrees Celsius of ten sensors; chosen.
            return struct.pack("<I10h", int(self.now() * 1e3) & 0xFFFFFFFF, 41, 41, 42, 42, 45, 46, 45, 40, 43, 0)
        return b""

    def _choose_image(self) -> bytes:
        """Return the image that the cores run: the downloaded one, else the flash's; b"" without."""
        if self.ram and not find_boot_errors(self.ram):
            return self.ram
        return self._booted

    def _find_patch_version(self, main: bool) -> bytes:
        """Return the patch version of a core as in a version answer; zeros without a patch."""
        image = self._choose_image()
        if image:
            return encode_patch_version(image, main)
        return bytes(6)

    def _report_calibration(self, passed: int) -> None:
        """Send the event with the calibrations that passed, as bits; temperature and duration in it are chosen."""
        self.event(CALIBRATED, struct.pack("<IIhHII", passed, passed, 41, 0, 500, 0), RF_INIT_S)

    def _store_profile_or_chirps(self, number: int, data: bytes) -> int:
        """Store a profile (0..3), or chirps (0..511) of one (ICD tables 5.24, 5.26); return an error number."""
        # The data of chirps begin with the first, the last and their profile; those of a profile with its number.
        first, last, profile = struct.unpack_from("<3H", data)
        if number == PROFILE:
            if first > 3:
                return PROFILE_OUT_OF_RANGE
            self.profiles[first] = data
            return 0
        if last > 511:
            return CHIRP_END_OUT_OF_RANGE
        if first > last:
            return CHIRP_END_BEFORE_START
        if profile not in self.profiles:
            if profile > 3:
                return CHIRP_PROFILE_OUT_OF_RANGE
            return CHIRP_PROFILE_UNDEFINED
        for chirp in range(first, last + 1):
            self.chirps[chirp] = data
        return 0

    def _read_back(self, number: int, data: bytes) -> tuple[int, bytes]:
        """Read back a setting in the form in which it was sent (ICD 5.6.1..5.6.6)."""
        stored_data = {
            READ_PROFILE: lambda: self.profiles.get(struct.unpack_from("<H", data)[0]),
            READ_CHIRP: lambda: self.chirps.get(struct.unpack_from("<H", data)[0]),
            READ_FRAME: lambda: self.settings.get(FRAME),
        }[number]()
        if stored_data is None:
            return INVALID_INPUT, b""
        return 0, stored_data

    def _save_or_restore_calibration(self, number: int, data: bytes) -> tuple[int, bytes]:
        """Save or restore 672 bytes of calibration in three parts (ICD 5.2.11, 5.3.2); return error number and answer.

        The data begin with the status bits, twice. If both differ in what was restored, no calibration passes.
        """
        _, part = struct.unpack_from("<2H", data)
        if part >= CHUNKS:
            return INVALID_INPUT, b""
        if number == SAVE:
            if not self.calibrated:
                return WRONG_STATE, b""
            # Status bits, eight unused bytes, temperature, and arbitrary bytes that differ from board to board; chosen.
            head = struct.pack("<2I8xh", self.passing_calibrations, self.passing_calibrations, 41)
            filler_range = range(CHUNKS * CHUNK_BYTES - len(head))
            calibration_data = head + bytes((self.die_number * 31 + n) & 0xFF for n in filler_range)
            return 0, struct.pack("<2H", CHUNKS, part) + calibration_data[CHUNK_BYTES * part : CHUNK_BYTES * (part + 1)]
        self._restored[part] = data[4:]
        if len(self._restored) == CHUNKS:
            status, copy = struct.unpack_from("<2I", self._restored[0])
            self._restored.clear()
            self._report_calibration(status if status == copy else 0)
        return 0, b""

    def _start_or_stop(self, action: int) -> int:
        """Start (1) or stop frames (0; 4: immediately). Return 0, 21 (not started) or 23 (invalid command)."""
        if action == 1:
            return self._start()
        if action not in (0, 4):
            return 23
        if not self.armed:
            return 21
        if action == 4 and self.now() < self.frame_ends:
            # Type, code and line of the firmware; the values are chosen.
            self.event(RF_FAULT, struct.pack("<BBH", 3, 2, 815) + bytes(28), 0.0)
        self.armed = False
        self.event(FRAME_END, b"", READY_S)
        return 0

    def _start(self) -> int:
        """Arm the radar for SYNC_IN, or run the frames of a software trigger.

        Returns the error number: 0, 20 (armed already), or 22 (settings are missing).
        """
        if self.armed:
            return 20
        if not self.calibrated or any(n not in self.settings for n in _BEFORE_FRAMES):
            return 22
        _, _, _, _, frames, _, period, trigger = struct.unpack_from("<6HIH", self.settings[FRAME])
        self.frames_left = frames or -1
        self.armed = True
        self.frame_ends = -1.0
        self.armings += 1
        # Software trigger: they start immediately (ICD table 5.27), frames without a number until they are stopped.
        if trigger == 1:
            self.frames_left = 0
            self.armed = frames == 0
            if frames:
                self.event(FRAME_END, b"", frames * period * 5e-9)
        else:
            self.event(TRIGGER_READY, b"", READY_S)
        return 0

    def period_s(self) -> float:
        """Return the frame period, seconds."""
        return struct.unpack_from("<I", self.settings[FRAME], 12)[0] * 5e-9

    def _download(self, data: bytes, remaining: int) -> tuple[int, bytes, float]:
        """Store a part of a file (ICD 5.18.1); return error number, answer, and extra delay in s.

        A file of type 0 goes to RAM and boots when it is complete; the first part of another one (4 to 7) erases the
        flash, whose content is checked only at boot. `remaining`: how many parts follow. Errors: 7, the length is not
        the one announced; 8, unknown type of file.
        """
        if not self.main_up:
            return WRONG_STATE, b"", 0.0
        first = self._file is None
        if self._file is None:
            kind, length = struct.unpack_from("<II", data)
            if kind not in (0, 4, 5, 6, 7):
                return 8, b"", 0.0
            self._file = (kind, length)
            self._received = b""
            data = data[8:]
            if kind:
                self.flash = b""
            if self.fault_at == "download":
                self.event(MAIN_FAULT, FAULT_DATA, 0.0)
        kind, missing = self._file
        self._received += data
        if kind:
            self.flash = self._received
        missing -= len(data)
        self._file = (kind, missing)
        if (missing <= 0) != (remaining == 0) or missing < 0:
            self._file = None
            return 7, b"", 0.0
        if missing == 0:
            self._file = None
            if kind == 0:
                self._boot_from_ram()
        self.executed.append(DOWNLOAD)
        return 0, b"", self.erase_s if first and kind else 0.0

    def _boot_from_ram(self) -> None:
        """Take the download as the image in RAM, and report its boot."""
        self.ram = self._received
        self.event(BOOTED, struct.pack("<IQQ", POWER_UP_TIME, find_boot_errors(self.ram), 0), BOOT_S)
