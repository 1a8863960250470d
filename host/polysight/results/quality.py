"""Quality of a processed scan: the content of quality.json and scan.json.

The structs are the file formats: a field that is UNSET is absent in the file, and unknown keys are ignored.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from msgspec import UNSET, UnsetType

from polysight.results.json_files import convert, read_object
from polysight.results.verdict import Coverage, Verdict, read_verdict

# Values along x and y; None: unlimited, which JSON lacks.
Pair = tuple[float | None, float | None]


class Backlash(msgspec.Struct, frozen=True):
    """Shift of odd rows towards +x relative to the plan, and its standard deviation, mm."""

    shift: float
    std: float


class PhaseJump(msgspec.Struct, frozen=True, order=True):
    """A jump of the phase of a board's echo: the row that it comes before, and its size in radians."""

    row: int
    angle_rad: float


class RemovedDrift(msgspec.Struct, frozen=True, kw_only=True):
    """A drift of the phase of one board over the rows that was removed from the images.

    Attributes
    ----------
    board
        The board that drifts.
    range_rad, rms_rad
        Largest difference of the drift between two plates, and its root mean square over the plates.
    left_rad
        Standard deviation of what is left at a plate against another one.
    """

    board: str
    range_rad: float
    rms_rad: float
    left_rad: float


class FrequencyRange(msgspec.Struct, frozen=True):
    """Intermediate frequency of the direct path over all positions, Hz."""

    median: float
    min: float
    max: float


class Residual(msgspec.Struct, frozen=True):
    """Standard deviations after a stage of synchronisation; of the amplitude relative to its mean."""

    frequency_std_hz: float | None = None
    phase_std_rad: float | None = None
    amplitude_std: float | None = None


class BoardQuality(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of one receiver over the recorded rows.

    Attributes
    ----------
    bytes_missing
        Bytes of the raw data that never came.
    chirps_clipped, chirps_disturbed
        Numbers of received chirps that were left out: because the receiver clipped them, and because they differ from
        the others of their burst (another radar, or silence).
    positions_clipped
        Masked positions of which all chirps were clipped.
    dead_rx
        Number of an RX, from 1, to the rows in which it gave no signal and was left out of the images.
    rx_order
        Places in the rig file of the recorded RX, counted from 1, if they were recorded in another order; else empty.
    phase_jumps
        Jumps of the phase of the echo that were removed from the images, in the order of rows.
    masked_columns
        Row to half-open ranges [start, stop) of masked columns.
    rows_recorded
        Numbers of the recorded rows.
    raw_crc32
        Row to the CRC of the raw data that it was made from.
    synchronisation
        Stage to its residuals.
    """

    # Numbers of frames, which are counted in chirps: most frames hold one. `frames_masked` were received incompletely.
    frames_expected: int = 0
    frames_received: int = 0
    bytes_missing: int = 0
    positions: int | UnsetType = UNSET
    # Positions without valid samples.
    positions_masked: int | UnsetType = UNSET
    frames_masked: int = 0
    chirps_clipped: int = 0
    chirps_disturbed: int = 0
    positions_clipped: int = 0
    dead_rx: dict[int, list[int]] = {}
    rx_order: list[int] = []
    phase_jumps: list[PhaseJump] = []
    direct_path_hz: FrequencyRange | UnsetType = UNSET
    # Power of the direct path over noise in one sample of one chirp; None if the noise is unknown.
    direct_path_snr_db: float | None = None
    # Shift of odd rows towards +x, from echoes; None if undetermined.
    stage_backlash_mm: Backlash | None = None
    masked_columns: dict[int, list[tuple[int, int]]] | UnsetType = UNSET
    rows_recorded: list[int] | UnsetType = UNSET
    raw_crc32: dict[int, str] | UnsetType = UNSET
    synchronisation: dict[str, Residual] = {}


class BoardImaging(msgspec.Struct, frozen=True, kw_only=True):
    """Aperture of one receiver and its response to a point in the middle of the image, for (x, y).

    `masked` is the share of the tapered aperture without data, and `loss_db` the loss of the sum of a point's echoes
    that results from it. `frequencies` is the number of samples of a position after the range gate.
    """

    positions: int = 0
    masked_positions: int = 0
    rows_without_data: int = 0
    masked: float = 0.0
    frequencies: int = 0
    loss_db: float | UnsetType = UNSET
    # Width of the response at half power.
    point_width_mm: Pair | UnsetType = UNSET
    # The geometry's limit of the width, without taper.
    point_limit_mm: Pair | UnsetType = UNSET
    # The POLySIGHT paper's estimate r lambda / L of the width.
    point_paper_mm: Pair | UnsetType = UNSET
    # Strongest sidelobe, relative to the peak.
    point_sidelobe_db: Pair | UnsetType = UNSET


class ReconstructedPositions(msgspec.Struct, frozen=True, kw_only=True):
    """Reconstructed positions of one receiver, and their errors.

    Attributes
    ----------
    missing_share
        Share of the positions that were reconstructed.
    residual
        Share of the recorded samples that the reconstruction does not explain.
    prediction_error
        Error of predicted samples relative to recorded ones, in an image of recorded positions that were left out of
        the fit; None if there were too few.
    image_error
        Expected error of the whole image relative to that of a scan of all positions: the prediction error times the
        part of the image that comes from reconstructed positions; None as above.
    """

    missing_share: float = 0.0
    residual: float = 0.0
    prediction_error: float | None = None
    image_error: float | None = None


class IncidenceAngles(msgspec.Struct, frozen=True, kw_only=True):
    """The incidence angle used, the other kind, and the effect of the choice on the permittivities.

    `pixel_deg` are the least, median and largest angle of the pixels.
    """

    used: str = ""
    # The one angle for the whole image.
    one_deg: float | None = None
    pixel_deg: tuple[float | None, ...] = ()
    # Between `one_deg` and the angle of a valid pixel.
    largest_difference_deg: float | None = None
    # |eps_other / eps - 1| of the patch `of_patch`, which changes most with the other kind of angle.
    largest_permittivity_change: float | UnsetType = UNSET
    of_patch: int | UnsetType = UNSET


class MetalPlate(msgspec.Struct, frozen=True, kw_only=True):
    """Variation of the gains over a metal plate that was scanned separately.

    `how` says in words where the gains are from; `sub_bands` is the number of parts of the sweep with own gains.
    """

    how: str = ""
    # Share of the pixels with valid gains.
    share_of_plane: float | None = None
    # Standard deviations over the valid pixels: gains of H and V, then H / V.
    h_variation_db: float | None = None
    v_variation_db: float | None = None
    ratio_variation_db: float | None = None
    ratio_variation_deg: float | None = None
    # Standard deviation of each part of V / H over the plate: noise and speckle.
    spread: float | None = None
    # Rise of the plate along the plane of incidence and across it, as it was scanned.
    tilt_deg: Pair = (0.0, 0.0)
    sub_bands: int | UnsetType = UNSET


class CalibrationSource(msgspec.Struct, frozen=True):
    """A calibration file that was used."""

    file: str
    made_utc: str
    simulated: bool


class Recording(msgspec.Struct, frozen=True, kw_only=True):
    """Recording of published data: direction of the rows, losses by board, state of the data cubes by board,
    notices.
    """

    direction: str = ""
    boards: dict[str, dict[str, int]] | UnsetType = UNSET
    notices: list[str] = []
    cubes: dict[str, str] | UnsetType = UNSET


class GivenImages(msgspec.Struct, frozen=True, kw_only=True):
    """Images of another program that were processed instead of rows.

    `incidence_from` is "option", "file" or "rig file"; `assumed` lists what had to be assumed. `other_sign` is the
    probability that the phases have the other sign than was taken.
    """

    file: str
    incidence_from: str
    assumed: list[str] = []
    other_sign: float = 0.0


class RawDropped(msgspec.Struct, frozen=True):
    """The scan whose raw data was deleted after these products were made."""

    scan_id: str = ""
    scan: str = ""
    dropped_utc: str = ""


class ScanQuality(msgspec.Struct, frozen=True, kw_only=True):
    """Content of quality.json. `imaging` holds an entry for each board, and `notices`."""

    boards: dict[str, BoardQuality] = {}
    coverage: Coverage | UnsetType = UNSET
    # Wall time; stages that run in parallel add up.
    seconds_per_stage: dict[str, float] = {}
    verdict: Verdict | UnsetType | None = UNSET
    # Share of interior pixels with the correct name, in a simulated scene.
    pixel_accuracy: float | UnsetType | None = UNSET
    calibration: dict[str, CalibrationSource] | UnsetType = UNSET
    recording: Recording | UnsetType = UNSET
    rows_retaken: int | UnsetType = UNSET
    rows_incomplete: list[int] | UnsetType = UNSET
    imaging: dict[str, BoardImaging | list[str]] | UnsetType = UNSET
    # Root mean square of the distances of rows from where they were commanded, if the rows are displaced.
    rows_displaced_mm: float | UnsetType = UNSET
    phase_drift: RemovedDrift | UnsetType = UNSET
    # Reconstructed positions by board.
    sparse: dict[str, ReconstructedPositions] | UnsetType = UNSET
    incidence: IncidenceAngles | UnsetType = UNSET
    metal_reference: MetalPlate | UnsetType = UNSET
    raw_dropped: RawDropped | UnsetType = UNSET
    given_images: GivenImages | UnsetType = UNSET

    def __post_init__(self) -> None:
        """Leave out what depends on names or permittivities if the verdict allows none."""
        if self.verdict and not self.verdict.usable:
            if self.pixel_accuracy is not UNSET:
                msgspec.structs.force_setattr(self, "pixel_accuracy", None)
            if self.incidence is not UNSET:
                angles_only = msgspec.structs.replace(self.incidence, largest_permittivity_change=UNSET)
                msgspec.structs.force_setattr(self, "incidence", angles_only)

    @classmethod
    def read(cls, path: Path) -> ScanQuality:
        """Read a file; without it nothing is known. Raises DataError if it is damaged."""
        return cls.decode(read_object(path) or {}, path)

    @classmethod
    def decode(cls, content: dict[str, Any], path: Path = Path("quality.json")) -> ScanQuality:
        """Return the content of a file as a struct; `path` is for messages. Raises DataError if it is damaged."""
        return convert({**content, "verdict": read_verdict(content)}, cls, path)


class RxGain(msgspec.Struct, frozen=True):
    """Gain and phase of a receiving antenna relative to its board's first."""

    gain_db: float | None
    phase_deg: float | None


class ScanFacts(msgspec.Struct, frozen=True, kw_only=True):
    """Content of scan.json: identity and origin of the products.

    `instrument` is the rig that the images were formed with, as the tables of its file; `rx_gains` were divided out.
    """

    scan_id: str | UnsetType = UNSET
    simulated: bool | UnsetType = UNSET
    processed_utc: str | UnsetType = UNSET
    versions: dict[str, str] | UnsetType = UNSET
    rx_gains: dict[str, list[RxGain]] = {}
    instrument: dict[str, Any] | UnsetType = UNSET

    @classmethod
    def read(cls, path: Path) -> ScanFacts:
        """Read a file; without it nothing is known. Raises DataError if it is damaged."""
        return convert(read_object(path) or {}, cls, path)
