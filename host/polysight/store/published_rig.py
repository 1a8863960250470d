"""Settings of the published data set as a rig: grid, burst, chirp, distances and mount angles.

`read_settings` reads the JSON files of a scan, `build_rig` puts their values into a rig file, and `mirror_rig` swaps x
and y for scans that were recorded column by column.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from polysight_shared import files
from polysight_shared.config import Board, Instrument, MountStep
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.tables import Count, NonNegative, Positive, decode

# The two files with a scan's settings.
COLLECTION = "data_collection_cfg.json"
DEVICES = "devices_comm_cfg.json"


# Where the keys of these files are explained, for error messages.
_KEYS = "docs/how-to/authors-data.md names them"
# Chosen, to refuse typing errors: distances of positions in mm, their number, and angles in degrees.
_Step = Annotated[float, msgspec.Meta(gt=0, le=100)]
_Positions = Annotated[int, msgspec.Meta(ge=1, le=99_999)]
_Angle = Annotated[float, msgspec.Meta(ge=-360, le=360)]


class ChirpConfig(msgspec.Struct, frozen=True):
    """One of `chirp_configs`, in SI or in the units of TI's tools (GHz, MHz/us, us, ksps)."""

    # Start frequency and slope.
    f0: Positive
    slope: Positive
    # Times from the start of the ramp.
    ramp_time: Positive
    adc_start_time: NonNegative
    # Samples of a chirp, and their rate.
    num_adc: Count
    Fs: Positive


class Collection(msgspec.Struct, frozen=True):
    """The settings of a data collection, as in its JSON files. Lengths in mm, times in ms, angles in degrees.

    Of the lengths `board_dist` alone is in metres. `total_x` and `total_y` are numbers of positions, and `dx` and `dy`
    their distances; `num_trigger` is the number of pulses at a position, `period_frame` the time between them, and
    `num_chirp` the number of chirps of a pulse. `moving_direction` is "row" (along x) or "col". With
    `packet_zero_filling` the file of a row has zeros where packets were lost, otherwise nothing. Angles and offsets
    that are None stay those of the base rig. `num_adc` is not used, the number of samples is that of `chirp_configs`; a
    file without it is not a file of the published program.
    """

    dx: _Step
    dy: _Step
    total_x: _Positions
    total_y: _Positions
    num_trigger: Count
    period_frame: Positive
    num_adc: Count
    object_distance: Positive
    board_dist: Positive | None = None
    txboard_angle_y: _Angle | None = None
    rxboard_v_angle_y: _Angle | None = None
    rxboard_angle_y: _Angle | None = None
    rxboard_angle_z: _Angle | None = None
    rxboard_tilt_offset: tuple[float, float, float] | None = None
    moving_direction: str = "row"
    num_chirp: int = 1
    packet_zero_filling: bool = True
    description: str = ""
    chirp_configs: tuple[ChirpConfig, ...] = ()

    @property
    def by_columns(self) -> bool:
        """True if the stage ran along y, column after column."""
        return self.moving_direction == "col"


class Rig(NamedTuple):
    """The rig of a scan, whose x points from TX to RX, and notices on settings whose sign in the file was reversed."""

    instrument: Instrument
    notices: tuple[str, ...]


def read_json(path: Path, missing_ok: bool = False) -> dict[str, Any]:
    """Read a JSON object; with `missing_ok`, {} for a missing file. Raises DataError if it is not an object."""
    if missing_ok and not path.exists():
        return {}
    cause = "the download is not complete"
    remedy = "fetch the file again"
    try:
        content = files.read_json(path)
    except (OSError, ValueError) as e:
        raise DataError(f"{path}: not JSON: {e}", cause, remedy, code=ErrorCode.FILE_DAMAGED) from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: not a JSON object", cause, remedy, code=ErrorCode.FILE_FOREIGN)
    return content


def read_settings(path: Path) -> Collection:
    """Read the settings of an `unsynced/<scan>` or `raw/<scan>` folder. Raises DataError or ConfigError."""
    content = {**read_json(path / DEVICES, missing_ok=True), **read_json(path / COLLECTION)}
    settings = decode(content, Collection, str(path / COLLECTION), keys=_KEYS)
    if settings.moving_direction not in ("row", "col") or not settings.chirp_configs or settings.num_chirp != 1:
        raise DataError(
            f"{path}: moving_direction {settings.moving_direction!r}, {len(settings.chirp_configs)} chirp configs,"
            f" {settings.num_chirp} chirps a frame",
            "only scans by row or by column with one chirp a frame are read",
            "this scan cannot be processed",
            code=ErrorCode.VALUE_INVALID,
        )
    return settings


def build_rig(settings: Collection, base: Instrument, path: Path) -> Rig:
    """Return the base rig with the scan's settings; values missing in the JSON stay the base's. Raises ConfigError."""
    chirp = settings.chirp_configs[0]
    grid = {"columns": settings.total_x, "rows": settings.total_y, "step_x_mm": settings.dx, "step_y_mm": settings.dy}
    # The authors' stage had room for the grid.
    travel = (
        max(base.stage.travel_x_mm, settings.total_x * settings.dx + 2 * base.stage.run_up_mm(settings.dx)),
        max(base.stage.travel_y_mm, settings.total_y * settings.dy + 2 * base.stage.run_up_mm(settings.dy)),
    )
    table = msgspec.to_builtins(base)
    table["grid"] = grid
    table["stage"] |= {"travel_x_mm": travel[0], "travel_y_mm": travel[1]}
    table["stage"] |= {"centre_x_mm": travel[0] / 2, "centre_y_mm": travel[1] / 2}
    table["burst"] |= {"pulses": settings.num_trigger, "period_us": settings.period_frame * 1e3}
    table["geometry"]["object_distance_mm"] = settings.object_distance
    table["chirp"] |= {
        "start_hz": _scale_if_below(chirp.f0, limit=1e6, factor=1e9),
        "slope_hz_per_s": _scale_if_below(chirp.slope, limit=1e6, factor=1e12),
        "ramp_end_us": _scale_if_below(chirp.ramp_time, limit=1, factor=1e6),
        "adc_start_us": _scale_if_below(chirp.adc_start_time, limit=1e-2, factor=1e6),
        "samples": chirp.num_adc,
        "sample_rate_hz": _scale_if_below(chirp.Fs, limit=1e5, factor=1e3),
        "linear_samples": [min(n, chirp.num_adc) for n in base.chirp.linear_samples],
    }
    rig = decode(table, Instrument, f"the rig that {path / COLLECTION} describes", keys=_KEYS)
    notices: list[str] = []
    boards = tuple(msgspec.structs.replace(b, mount=_adapt_mount(b, settings, notices)) for b in rig.boards)
    return Rig(msgspec.structs.replace(rig, boards=boards), tuple(notices))


def _scale_if_below(value: float, limit: float, factor: float) -> float:
    """Return a value in the wanted unit: the authors' files have some in SI, some in the units of TI's tools.

    In the wanted unit every real chirp has at least `limit`. A smaller value is therefore in the other unit, and is
    multiplied by `factor` (0 stays 0).
    """
    if value < limit:
        return value * factor
    return value


def _adapt_mount(board: Board, settings: Collection, notices: list[str]) -> tuple[MountStep, ...]:
    """Return the base rig's mount with the angles and offsets of the scan; append to `notices` deviations from them.

    A setting replaces one step of the base rig, which is known by its place in the order of steps:

    - the first turn about y of the V board: `rxboard_v_angle_y`,
    - the last turn about z: `rxboard_angle_z`, the tilt of a receiver,
    - the last turn about y, towards the object: `txboard_angle_y` or `rxboard_angle_y`,
    - the last shift but one: `rxboard_tilt_offset`,
    - the last step, if it is a shift: half of `board_dist`, the distance between the boards' origins.
    """
    steps = list(board.mount)
    transmits = board.role == "transmit"
    key = "txboard_angle_y" if transmits else "rxboard_angle_y"
    facing_deg = getattr(settings, key)
    # The transmitter stands at negative x and faces +x, receivers the other way round.
    side = -1 if transmits else 1
    if facing_deg is not None and (turns := _list_turns(steps, "y")):
        # The normal of a board is (sin a, 0, cos a), and the object lies between the boards: the transmitter, at
        # negative x, needs a positive angle, a receiver a negative one. The other sign is that of the other sense of
        # rotation.
        if facing_deg * side > 0:
            notices.append(
                f"{board.name}: {key} = {facing_deg:g} would turn the board away from the object;"
                f" read with the other sense of rotation, {-facing_deg:g}"
            )
            facing_deg = -facing_deg
        steps[turns[-1]] = MountStep(turn_deg=facing_deg, about="y")
    if not transmits:
        if settings.rxboard_angle_z is not None and (turns := _list_turns(steps, "z")):
            steps[turns[-1]] = MountStep(turn_deg=settings.rxboard_angle_z, about="z")
        turns_y = _list_turns(steps, "y")
        if board.role == "receive_v" and settings.rxboard_v_angle_y is not None and len(turns_y) > 1:
            steps[turns_y[0]] = MountStep(turn_deg=settings.rxboard_v_angle_y, about="y")
        shifts = [i for i, step in enumerate(steps) if step.shift_mm is not None]
        if settings.rxboard_tilt_offset is not None and len(shifts) > 1:
            steps[shifts[-2]] = MountStep(shift_mm=settings.rxboard_tilt_offset)
    last_shift_mm = None
    if steps:
        last_shift_mm = steps[-1].shift_mm
    if settings.board_dist is not None and last_shift_mm is not None:
        steps[-1] = MountStep(shift_mm=(side * settings.board_dist * 1e3 / 2, last_shift_mm[1], last_shift_mm[2]))
    return tuple(steps)


def _list_turns(steps: list[MountStep], axis: str) -> list[int]:
    """Return the indices of the turns about an axis."""
    return [i for i, step in enumerate(steps) if step.about == axis]


def mirror_rig(rig: Instrument) -> Instrument:
    """Mirror the rig in x = y; mirroring twice gives the rig itself.

    The mirrored rig records row by row the same path lengths as the rig column by column. A turn about an axis becomes
    the opposite turn about the swapped axis.
    """
    stage = rig.stage
    grid = rig.grid
    image = rig.image
    replace = msgspec.structs.replace
    return replace(
        rig,
        grid=replace(grid, columns=grid.rows, rows=grid.columns, step_x_mm=grid.step_y_mm, step_y_mm=grid.step_x_mm),
        image=replace(image, columns=image.rows, rows=image.columns),
        stage=replace(
            stage,
            travel_x_mm=stage.travel_y_mm,
            travel_y_mm=stage.travel_x_mm,
            centre_x_mm=stage.centre_y_mm,
            centre_y_mm=stage.centre_x_mm,
        ),
        antennas=replace(
            rig.antennas,
            rx_mm=tuple((y, x, z) for x, y, z in rig.antennas.rx_mm),
            tx_mm=tuple((y, x, z) for x, y, z in rig.antennas.tx_mm),
        ),
        boards=tuple(replace(b, mount=tuple(_mirror_step(s) for s in b.mount)) for b in rig.boards),
    )


def _mirror_step(step: MountStep) -> MountStep:
    """Return the step, which is either a shift or a turn, mirrored in x = y."""
    if step.shift_mm is not None:
        x, y, z = step.shift_mm
        return MountStep(shift_mm=(y, x, z))
    axes: dict[str, Literal["x", "y", "z"]] = {"x": "y", "y": "x", "z": "z"}
    return MountStep(turn_deg=-(step.turn_deg or 0.0), about=axes[step.about or "z"])
