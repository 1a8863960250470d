"""Declaration of the rig file `instrument.toml`: every setting of the instrument with its type, limits and rules.

`load_instrument` reads it. An unknown key, a wrong type or a broken rule is refused with file, key, value and rule.
The comments of `instrument.toml` at the top of the repository explain the keys that it has; others are explained here.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from polysight_shared.raster import Burst, Grid, Stage
from polysight_shared.tables import Count, NonNegative, Positive, Section, decode, read_toml, require, to_builtins

Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]
# Number of a line of the Pi's GPIO chip, as gpioinfo counts.
GpioLine = Annotated[int, msgspec.Meta(ge=0, le=63)]
# Millimetres, up to 10 m (chosen: a rig stands in a room), and degrees. The limits also refuse NaN and infinities.
Coordinate = Annotated[float, msgspec.Meta(ge=-10_000.0, le=10_000.0)]
Angle = Annotated[float, msgspec.Meta(ge=-360.0, le=360.0)]
# X, y, z.
Vector = tuple[Coordinate, Coordinate, Coordinate]
# A part of an amplitude relative to the wave that it leaks from.
Leakage = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
# Deviation of a frequency: the radar has 76 to 81 GHz.
Deviation = Annotated[float, msgspec.Meta(ge=-5e9, le=5e9)]
# Corners of the two high-pass filters that an AWR2243 has (docs/spec/mmwavelink.md).
HPF_FIRST_KHZ = (175.0, 235.0, 350.0, 700.0)
HPF_SECOND_KHZ = (350.0, 700.0, 1400.0, 2800.0)
# The kernel debounces by ticks of 4 ms: this much after the debounce time it has certainly read the level.
DEBOUNCE_TICKS_US = 5_000
# 2000 x 2000: imaging holds some 200 bytes a pixel, and an image of 9999 x 9999 took all memory of a PC.
MAX_PIXELS = 4_000_000
# The wavelength is 4 mm; the imager's FFTs over a lattice of pixels take more memory the smaller a pixel is. Both
# limits are chosen.
MIN_PIXEL_MM = 0.05
MAX_PIXEL_MM = 100.0
# The range gate's matrices grow as the square of an image's size: one of 400 m took all memory of a PC.
MAX_IMAGE_MM = 4_000.0
# Seconds, up to a day: the system's calls take no number of milliseconds above 2^31.
Timeout = Annotated[float, msgspec.Meta(gt=0, le=86_400.0)]
PixelSize = Annotated[float, msgspec.Meta(ge=MIN_PIXEL_MM, le=MAX_PIXEL_MM)]
# Silence after which a card sends a packet that is not full (docs/spec/dca1000.md, observed).
CARD_TAIL_S = 2.0
# GPIO lines of a Pi's header that are MOSI and MISO of each SPI controller.
_MOSI = {"/dev/spidev0": 10, "/dev/spidev1": 20}
_MISO = {"/dev/spidev0": 9, "/dev/spidev1": 19}
# Shortest and longest pulse by SPI, which is one bit: at 2 MHz and at 500 kHz.
SPI_WIDTH_US = (0.5, 2.0)


class Chirp(Section, frozen=True):
    """FMCW chirp and ADC window (AWR2243 profile). Times count from the start of the ramp."""

    # Transmit frequency at the start of the ramp.
    start_hz: Positive
    slope_hz_per_s: Positive
    # First ADC sample.
    adc_start_us: NonNegative
    # ADC samples of a chirp.
    samples: Count
    sample_rate_hz: Positive
    ramp_end_us: Positive
    # Intermediate frequencies that the ADC keeps: 0 to 0.9 sample rates (complex1x), or -0.45 to 0.45 (complex2x).
    if_mode: Literal["complex1x", "complex2x"] = "complex1x"
    # Corners of the two high-pass filters of the receivers; 0 for none.
    hpf1_khz: float = 175.0
    hpf2_khz: float = 350.0
    # Samples that are used, from the first up to, but without, the second: the published rig's chirp bends in its last
    # 20 us.
    linear_samples: tuple[int, int] = (0, 192)

    def __post_init__(self) -> None:
        window_us = self.samples / self.sample_rate_hz * 1e6
        require(
            self.adc_start_us + window_us <= self.ramp_end_us,
            f"adc_start_us = {self.adc_start_us} and samples / sample_rate_hz = {window_us:.2f} us"
            f" must end inside the ramp, ramp_end_us = {self.ramp_end_us}",
        )
        # The radar has 76 to 81 GHz; 0.1 GHz above is let pass (chosen). `radar.control = "native"` checks it exactly.
        top = self.start_hz + self.slope_hz_per_s * self.ramp_end_us * 1e-6
        require(
            self.start_hz >= 76e9 and top <= 81.1e9,
            f"start_hz, slope_hz_per_s and ramp_end_us give {self.start_hz:.4g}..{top:.5g} Hz; it must be 76..81.1 GHz",
        )
        none = ", or 0 for no filter (simulated rigs only)"
        require(self.hpf1_khz in (0.0, *HPF_FIRST_KHZ), f"hpf1_khz must be one of {HPF_FIRST_KHZ}{none}")
        require(self.hpf2_khz in (0.0, *HPF_SECOND_KHZ), f"hpf2_khz must be one of {HPF_SECOND_KHZ}{none}")
        # At least 12 samples: three whole blocks of the decimation by four (chosen).
        a, b = self.linear_samples
        require(
            a >= 0 and a + 12 <= b <= self.samples,
            f"linear_samples = [{a}, {b}] must be a range of at least 12 within 0..samples = {self.samples}",
        )

    @property
    def first_sample_hz(self) -> float:
        """Transmit frequency at the first ADC sample."""
        return self.start_hz + self.slope_hz_per_s * self.adc_start_us * 1e-6

    @property
    def hz_per_sample(self) -> float:
        """Transmit frequency step from one ADC sample to the next."""
        return self.slope_hz_per_s / self.sample_rate_hz

    @property
    def swept_hz(self) -> float:
        """Bandwidth swept within the ADC window."""
        return self.hz_per_sample * self.samples


class Pi(Section, frozen=True):
    """Raspberry Pi: lines, sockets, journal. SYNC_IN is the radars' input whose rising edges start frames."""

    # Label or path of the GPIO chip.
    gpio_chip: str = "pinctrl-bcm2711"
    # Trigger of the stage, rising edge.
    trigger_in: GpioLine = 26
    # SYNC_IN: one line; more only in old files.
    sync_out: tuple[GpioLine, ...] = (22,)
    # "fanout": libgpiod sets one line. "spi": MOSI of the SPI controller. Of old files: "lines" is as "fanout" with one
    # line; "gpiomem", and several lines, are refused when the lines are opened.
    wiring: Literal["fanout", "lines", "gpiomem", "spi"] = "fanout"
    # A hardware one-shot sets the width of the pulses instead of the GPIO line.
    one_shot: bool = False
    # Return wire of SYNC_IN, MISO with "spi"; None: pulses are sent, not seen.
    pulses_in: GpioLine | None = None
    # Where the Pi answers commands, and where it publishes events (ZeroMQ).
    command_address: str = "tcp://127.0.0.1:5601"
    event_address: str = "tcp://127.0.0.1:5602"
    journal_dir: str = "journal"
    # Folder of the CURVE keys of both sides, which addresses beyond this machine need. A relative path counts from the
    # rig file's folder.
    key_dir: str = "keys"
    # Period of the Pi's heartbeat.
    heartbeat_ms: Count = 500
    trigger_bias: Literal["pull-down", "pull-up", "disabled", "as-is"] = "pull-down"
    # Debouncing of the trigger by the kernel; 0: none.
    trigger_debounce_us: Annotated[int, msgspec.Meta(ge=0)] = 0
    # Not used; old rig files have it.
    gpiomem: str = "/dev/gpiomem"
    spi_device: str = "/dev/spidev0.0"
    # Period of the host's heartbeat; 0: none.
    host_heartbeat_ms: Annotated[int, msgspec.Meta(ge=0)] = 100

    def __post_init__(self) -> None:
        require(len(self.sync_out) > 0, "sync_out needs at least one line")
        require(self.trigger_in not in self.sync_out, "trigger_in must not be one of sync_out")
        require(
            self.wiring not in ("fanout", "spi") or len(self.sync_out) == 1,
            f'wiring = "{self.wiring}" drives exactly one line in sync_out',
        )
        require(
            self.pulses_in not in (self.trigger_in, *self.sync_out), "pulses_in must be a line of its own, or left out"
        )
        controller = self.spi_device.rpartition(".")[0]
        if self.wiring == "spi" and controller in _MOSI:
            mosi = _MOSI[controller]
            miso = _MISO[controller]
            require(self.sync_out == (mosi,), f"MOSI of {self.spi_device} is GPIO {mosi}: sync_out = [{mosi}]")
            require(
                self.pulses_in in (None, miso),
                f"MISO of {self.spi_device} is GPIO {miso}: pulses_in must be {miso}, or left out",
            )

    @property
    def pulse_source(self) -> str:
        """Say who makes the pulses of SYNC_IN, their spacing and skew, and whether they are seen at the connector."""
        # 105 is `PiFault.PULSE_TOO_LONG`.
        source = "libgpiod on one line; without a one-shot: pulses above 4 us end a row (105)"
        spacing = "spacing by the program, each event has its lateness"
        if self.wiring == "spi":
            source = "SPI controller (MOSI)"
            spacing = "widths and spacing by its clock, which `polysight-pi check` measures"
        elif self.one_shot:
            source = "libgpiod on one line, widths by a one-shot"
        pulses = "sent, not seen: pi.pulses_in is not wired"
        if self.pulses_in is not None:
            pulses = f"counted at the connector by GPIO {self.pulses_in}"
        return f"{source}; {spacing}; one clock buffer, skew of the boards below 1 ns; pulses {pulses}"


class MountStep(Section, frozen=True):
    """One step of a mount, which leads from a board's frame to the rig's: a shift, or a right-handed rotation."""

    # Vector that is added; None for a rotation.
    shift_mm: Vector | None = None
    # Angle and axis; None for a shift.
    turn_deg: Angle | None = None
    about: Literal["x", "y", "z"] | None = None

    def __post_init__(self) -> None:
        has_angle = self.turn_deg is not None
        has_axis = self.about is not None
        has_shift = self.shift_mm is not None
        require(
            has_angle == has_axis and has_shift != has_angle,
            "a mount step is either { shift_mm = [x, y, z] } or { turn_deg = a, about = axis }",
        )


class Antennas(Section, frozen=True):
    """Antenna positions in the frame of a board, millimetres from RX1."""

    rx_mm: Annotated[tuple[Vector, ...], msgspec.Meta(min_length=1)]
    tx_mm: Annotated[tuple[Vector, ...], msgspec.Meta(min_length=1)]


class Board(Section, frozen=True):
    """One radar board and its capture card."""

    # Name of the board's folder in a scan.
    name: str
    # H is the s-polarised wave, V the p-polarised one.
    role: Literal["transmit", "receive_h", "receive_v"]
    # IP addresses of the card, and of the host's interface to it.
    card_address: str
    host_address: str
    # UDP ports: of commands on the card and of their replies on the host; of samples on the host (a card sends them
    # from its port 1024).
    command_port: Port
    data_port: Port
    # From the board's frame (RX1 is zero) to the rig's, in order.
    mount: tuple[MountStep, ...]
    # False: its samples are not stored.
    record: bool = True
    # Index in `antennas.tx_mm`, of the transmitting board.
    tx_antenna: Annotated[int, msgspec.Meta(ge=0)] = 1
    # Deviation of its chirp's start from `chirp.start_hz`.
    start_offset_hz: Deviation = 0.0
    # Place in `antennas.rx_mm`, counted from 1, of each recorded RX; empty: in their order.
    rx_order: tuple[Annotated[int, msgspec.Meta(ge=1)], ...] = ()


class Card(Section, frozen=True):
    """DCA1000 settings common to all boards."""

    # Packet size as it is sent to the card (0x0B in docs/spec/dca1000.md); 1470 makes packets of 1456 bytes of samples.
    packet_bytes: Annotated[int, msgspec.Meta(ge=24, le=1470)] = 1470
    # Pause of the card between two packets.
    packet_delay_us: NonNegative = 25.0
    # Buffer that the host requests for each card's socket.
    receive_buffer_bytes: Count = 8 << 20

    @property
    def payload_bytes(self) -> int:
        """Samples in a full packet, bytes: all but 14 bytes of headers (docs/spec/dca1000.md)."""
        return self.packet_bytes - 14


class NativeRadar(Section, frozen=True):
    """One board under `radar.control = "native"`.

    It is identified by `usb_serial`, or by `usb_path`, the position of its plug ("1-4.2": bus, then the hub's ports).
    With `die_id`, another board at this place is refused. `ldo_bypass` can destroy a board with 1.3 V RF supplies:
    before the radars start, the host checks that `ldo_bypass_acknowledged` repeats `usb_serial`, which must be given.
    """

    usb_serial: str = ""
    ldo_bypass: bool = False
    ldo_bypass_acknowledged: str = ""
    usb_path: Annotated[str, msgspec.Meta(pattern=r"^([0-9]+-[0-9]+(\.[0-9]+)*)?$")] = ""
    die_id: Annotated[str, msgspec.Meta(pattern=r"^([0-9a-f]{8}(-[0-9a-f]{8}){3})?$")] = ""

    def __post_init__(self) -> None:
        require(bool(self.usb_serial) != bool(self.usb_path), "each of radar.native needs usb_serial or usb_path")

    @property
    def place(self) -> str:
        """`usb_serial` (a serial number, or `tcp://address:port` of a server), or `usb:` and the path."""
        return self.usb_serial or f"usb:{self.usb_path}"


class Radar(Section, frozen=True):
    """Settings of arming the radars for the pulses of a row; paths are relative to the rig file's folder.

    `control`: `endless`: another program started the radars with an infinite number of frames. `line_server`: a line
    is sent to each board's control server before each row; `servers` has its `address:port` by board name. `native`:
    this host configures the boards over USB; the table `native` identifies each board by name, and the other keys
    apply to all. `firmware`: TI's image, downloaded to the boards' RAM at each start ("": use the firmware in their
    flash). `calibration_dir`: folder that stores the results of each board's RF init, which are restored at later
    starts ("": calibrate at each start). `trace_dir`: folder for logs of all traffic between host and boards, one file
    for each connection ("": no log). `slow_spi`: send words one by one at 1 MHz.
    """

    control: Literal["endless", "line_server", "native"] = "endless"
    servers: dict[str, Annotated[str, msgspec.Meta(pattern=r"^[^:\s]+:[0-9]{1,5}$")]] = msgspec.field(
        default_factory=dict
    )
    native: dict[str, NativeRadar] = msgspec.field(default_factory=dict)
    # Pause before each chirp.
    idle_us: Positive = 100.0
    rx_gain_db: int = 32
    rf_gain_target_db: Literal[30, 33, 36] = 30
    tx_backoff_db: Annotated[int, msgspec.Meta(ge=0)] = 0
    firmware: str = ""
    calibration_dir: str = ""
    trace_dir: str = ""
    slow_spi: bool = False

    def __post_init__(self) -> None:
        for board, address in self.servers.items():
            port = int(address.rpartition(":")[2])
            require(0 < port <= 65535, f"port {port} of radar.servers.{board} is outside 1..65535")
        places = [b.place for b in self.native.values()]
        require(len(set(places)) == len(places), f"each of radar.native needs its own usb_serial or path, not {places}")


class Geometry(Section, frozen=True):
    """Position of the object plane."""

    # Z of the plane in the rig frame, whose origin is midway between the origins of TX and H.
    object_distance_mm: Positive


class Image(Section, frozen=True):
    """Image grid, centred on the specular midpoint of TX and H."""

    columns: Count = 150
    rows: Count = 150
    pixel_mm: PixelSize = 2.0
    # Window over the aperture.
    apodisation: Literal["none", "kaiser", "taylor"] = "kaiser"

    def __post_init__(self) -> None:
        require(
            self.columns * self.rows <= MAX_PIXELS,
            f"{self.columns} x {self.rows} pixels are more than {MAX_PIXELS}",
        )
        longest_mm = max(self.columns, self.rows) * self.pixel_mm
        require(
            longest_mm <= MAX_IMAGE_MM,
            f"image.columns, image.rows x image.pixel_mm: {longest_mm:g} mm are more than {MAX_IMAGE_MM:g} mm",
        )


class Polarimetry(Section, frozen=True):
    """Cross-polar leakage of the receivers as [real, imaginary] amplitude, and the Gaussian filter against speckle.

    The leakage is used only with `leakage_std`, the measured standard error of each of its parts. Without it the
    leakage counts as not measured: `leakage_h` and `leakage_v` are ignored, and `leakage_prior` is its expected size.
    Its phases are those of time as exp(+j omega t), where a permittivity with losses is eps' - j eps''.
    """

    leakage_h: tuple[Leakage, Leakage] = (0.0, 0.0)
    leakage_v: tuple[Leakage, Leakage] = (0.0, 0.0)
    leakage_std: NonNegative | None = None
    # Rms magnitude of unmeasured leakage of any phase; 0.058 is the rms of amplitudes distributed uniformly up to 0.1.
    leakage_prior: NonNegative = 0.058
    # Standard error of the antennas' axes of polarisation, degrees: a bracket sets a board to about one.
    axis_std_deg: NonNegative = 1.0
    # Standard deviation of the filter, pixels.
    smooth_px: NonNegative = 1.5


class CalibrationFiles(Section, frozen=True):
    """Files of `polysight calibrate`, by its subcommands; "" for none. Paths are relative to the rig file's folder."""

    direct_path: str = ""
    hpf: str = ""
    metal: str = ""
    sphere: str = ""


class CheckPlate(Section, frozen=True):
    """A plate of known permittivity that lies at the same place in every scan; `name` "" for none.

    `permittivity` is [eps', eps''], `std` the standard deviation of each, `place_mm` a place on the plate (x, y) from
    the image's centre.
    """

    name: str = ""
    permittivity: tuple[Positive, NonNegative] = (1.0, 0.0)
    std: tuple[Positive, Positive] = (0.02, 0.02)
    place_mm: tuple[Coordinate, Coordinate] = (0.0, 0.0)


class Limits(Section, frozen=True):
    """Limits of a scan: retakes, timeouts, disk space, queue of rows."""

    # Further attempts at a row with faults.
    row_retakes: Annotated[int, msgspec.Meta(ge=0)] = 2
    # Longest wait for a reply of the Pi, a card or a board's control server.
    command_timeout_s: Timeout = 5.0
    # Silence of a card after which its record of a row counts as ended.
    end_of_record_s: Timeout = 3.0
    # Space that stays free on the disk of the scans.
    free_disk_bytes: Annotated[int, msgspec.Meta(ge=0)] = 1 << 30
    # Maximum number of rows that wait for processing while another is recorded.
    rows_waiting: Count = 8


class Notify(Section, frozen=True):
    """Who is notified of a scan's end: a command gets the text, a web address gets JSON. Not stored in scans."""

    command: str = ""
    url: Annotated[str, msgspec.Meta(pattern=r"^(https?://\S+)?$")] = ""


class Instrument(Section, frozen=True):
    """All tables of the rig file."""

    name: str
    chirp: Chirp
    burst: Burst
    grid: Grid
    stage: Stage
    pi: Pi
    antennas: Antennas
    boards: tuple[Board, ...]
    geometry: Geometry
    card: Card = Card()
    radar: Radar = Radar()
    image: Image = Image()
    polarimetry: Polarimetry = Polarimetry()
    limits: Limits = Limits()
    calibration: CalibrationFiles = CalibrationFiles()
    notify: Notify = Notify()
    check: CheckPlate = CheckPlate()

    def __post_init__(self) -> None:
        for role in ("transmit", "receive_h", "receive_v"):
            n = sum(b.role == role for b in self.boards)
            require(n == 1, f'boards must contain exactly one board with role = "{role}", found {n}')
        # No Pi debounces in hardware; the kernel then reads the level some ticks after the edge.
        require(
            self.pi.trigger_debounce_us == 0
            or self.stage.trigger_width_us >= self.pi.trigger_debounce_us + DEBOUNCE_TICKS_US,
            f"stage.trigger_width_us must exceed pi.trigger_debounce_us by at least {DEBOUNCE_TICKS_US} us, or every"
            " trigger is suppressed; trigger_debounce_us = 0 disables it",
        )
        low_us, high_us = SPI_WIDTH_US
        require(
            self.pi.wiring != "spi" or low_us <= self.burst.width_us <= high_us,
            f'burst.width_us must be {low_us:g}..{high_us:g} us with wiring = "spi" (a bit of the controller)',
        )
        names = [b.name for b in self.boards]
        # Folders of a scan are named after them.
        for name in names:
            rule = "boards name must be 1..64 letters, digits, spaces, _ - or ., the first a letter, a digit or _"
            require(re.fullmatch(r"\w[\w .-]{0,63}", name) is not None, f"{rule}: {name!r}")
        require(len(set(names)) == len(names), f"board names must differ: {names}")
        # Only the pair must differ: boards may share one of the two.
        hosts = [(b.host_address, b.data_port) for b in self.boards]
        require(len(set(hosts)) == len(hosts), "each board needs its own host_address and data_port")
        unknown = sorted(set(self.radar.servers) - set(names))
        require(not unknown, f"radar.servers has unknown boards {unknown}; the boards are {names}")
        without_server = [n for n in names if n not in self.radar.servers]
        require(
            self.radar.control != "line_server" or not without_server,
            f'radar.control = "line_server" needs radar.servers for every board; it is missing for {without_server}',
        )
        require(
            self.radar.control != "native" or set(self.radar.native) == set(names),
            f'radar.control = "native" needs radar.native for each of the boards {names}, not {[*self.radar.native]}',
        )
        require(
            self.transmitter.tx_antenna < len(self.antennas.tx_mm),
            "boards.tx_antenna exceeds the antennas in antennas.tx_mm",
        )
        places = list(range(1, len(self.antennas.rx_mm) + 1))
        for board in self.boards:
            require(
                not board.rx_order or sorted(board.rx_order) == places,
                f"boards.rx_order of {board.name} must contain each of {places} once, not {list(board.rx_order)}",
            )
        misfit = self.stage.misfit(self.grid)
        require(not misfit, misfit)

    @property
    def transmitter(self) -> Board:
        """Transmitting board."""
        return self.by_role("transmit")

    @property
    def receivers(self) -> tuple[Board, Board]:
        """The two receiving boards: H (s-polarised) first, then V (p-polarised)."""
        return self.by_role("receive_h"), self.by_role("receive_v")

    @property
    def recorded(self) -> tuple[Board, ...]:
        """Boards that are recorded."""
        return tuple(b for b in self.boards if b.record)

    def by_role(self, role: str) -> Board:
        """Return the board with this role, one of `Board.role`."""
        return next(b for b in self.boards if b.role == role)

    def by_name(self, name: str) -> Board:
        """Return the board with this name. Raises KeyError if there is none."""
        for b in self.boards:
            if b.name == name:
                return b
        raise KeyError(name)

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame: chirps x samples x RX x (I, Q) x int16."""
        return self.burst.chirps * self.chirp.samples * len(self.antennas.rx_mm) * 2 * 2

    @property
    def row_bytes(self) -> int:
        """Bytes of one board in one complete row."""
        return self.grid.columns * self.burst.pulses * self.frame_bytes

    @property
    def recorded_row_bytes(self) -> int:
        """Bytes of all recorded boards in one complete row."""
        return len(self.recorded) * self.row_bytes

    @property
    def scan_bytes(self) -> int:
        """Bytes of raw data of a whole scan."""
        return self.grid.rows * self.recorded_row_bytes


def load_instrument(path: Path) -> Instrument:
    """Read and check a rig file; its relative paths become absolute, but for the Pi's own `pi.journal_dir`.

    Raises
    ------
    ConfigError
        with file, key, value and rule.
    """
    rig = decode(read_toml(path), Instrument, str(path))
    folder = path.parent.resolve()

    def resolve(name: str) -> str:
        if not name:
            return ""
        return str(folder / name)

    calibration = CalibrationFiles(**{kind: resolve(name) for kind, name in to_builtins(rig.calibration).items()})
    pi = msgspec.structs.replace(rig.pi, key_dir=str(folder / rig.pi.key_dir))
    radar = msgspec.structs.replace(
        rig.radar,
        firmware=resolve(rig.radar.firmware),
        calibration_dir=resolve(rig.radar.calibration_dir),
        trace_dir=resolve(rig.radar.trace_dir),
    )
    return msgspec.structs.replace(rig, pi=pi, radar=radar, calibration=calibration)
