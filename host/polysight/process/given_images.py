"""Find materials in images that another program formed: an `.npz` file, or a folder `labels/<scan>` of published data.

`read_given_images` reads the images of H and V and lists what had to be assumed; `analyse_given_images` finds materials
and verdict as for a recorded scan. For such images neither rows nor direct path nor antennas are known: the incidence
angle is taken from the option, the file or the rig file, in this order, and the verdict is "usable with care" at best.
"""

from __future__ import annotations

import time
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import scipy

from polysight import materials
from polysight.imaging import UNKNOWN_PLANE, Antennas, Illumination, Images, illumination_geometry
from polysight.polarimetry import (
    IncidenceChoice,
    PlaneReference,
    incidence_on_planes,
    plane_reference,
    specular_incidence_rad,
)
from polysight.process.inputs import Inputs, convert_boxes_to_patches, explain_unnamed, load_classifier
from polysight.process.judge import scene_reasons
from polysight.process.save import Findings, assemble_result
from polysight.products import IMAGE, SCAN, ProcessedScan
from polysight.results import GivenImages, IncidenceAngles, ScanFacts, ScanQuality, join_reasons, reason
from polysight.settings import Settings
from polysight.store import open_npz, versions
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode, make_missing_path_error
from polysight_shared.files import read_json
from polysight_shared.findings import Finding

NPZ = ".npz"
# Arrays of an .npz file: required, optional, and the error of P = H / V, which only image.npz of this program has.
CHANNEL_ARRAYS = ("h", "v")
AXES = ("x_m", "y_m")
OPTIONAL_ARRAYS = ("valid", "incidence_deg", "simulated", "conjugate", "raised_m")
ERROR_ARRAY = "p_sigma"
# Images in a folder of the published data.
SAR_FILES = ("sar_h.npy", "sar_v.npy")
MIN_PIXELS = 8
"""Least rows and columns of an image: one more than the smallest patch has, 14 mm in seven pixels of 2 mm."""
MAX_UNEVENNESS = 0.01
"""Largest relative deviation of the distance of two pixels from the mean one, and of the pitch in y from that in x;
chosen."""
OTHER_SIGN = 0.3
"""Prior probability that the phases of another program's images have the opposite sign of ours (a permittivity is
eps' - j eps''), if the file does not say it. Chosen: the patches decide where they can."""
PUBLISHED_OTHER_SIGN = 0.05
"""The same for published images, which `restore_phase_sign` conjugates on reading; chosen."""
MOST_RAISED_M = 0.1
"""Largest distance of a plate's plane from that of the others; chosen."""
LEAST_PHASE_RAD = 1e-4
"""The phase of V against H must differ from 0 and from pi by more than this in some pixel. Chosen: noise alone gives
far more."""
LEAST_PEAK = 1e-9
MOST_PEAK = 1e9
"""Range of a channel's largest amplitude: squares, and their squares, stay within single precision."""
_EXPECTED_CONTENT = (
    "expected h, v complex [ny, nx]; optional x_m [nx], y_m [ny], valid and raised_m [ny, nx], incidence_deg,"
    " simulated, conjugate"
)
# Distances of the object plane between which `place_rig` looks for an incidence angle; chosen.
_NEAREST_MM = 60.0
_FARTHEST_MM = 1e5


@dataclass(frozen=True)
class GivenPair:
    """A pair of images as read.

    Attributes
    ----------
    path
        File or folder.
    images
        Both channels, with ascending axes; their ratio `p` is None.
    x_m, y_m
        The axes in the order of the file, which boxes in pixels refer to.
    labels
        Boxes of the folder `labels/<scan>`; None without any.
    incidence_deg
        Angle in the file; None without one.
    simulated
        True if the file says so.
    assumed
        What the file does not say and was assumed, one sentence each.
    other_sign
        Probability a priori that the phases of `images` have the other sign; 0 if the file says which one.
    """

    path: Path
    images: Images
    x_m: npt.NDArray[np.float64]
    y_m: npt.NDArray[np.float64]
    labels: materials.Labels | None
    incidence_deg: float | None
    simulated: bool
    assumed: tuple[str, ...]
    other_sign: float = OTHER_SIGN

    @property
    def scan_id(self) -> str:
        """Name of the images: that of the file or folder."""
        if self.path.suffix == NPZ:
            return self.path.stem
        return self.path.name

    def boxes(self, hand_labels: materials.Labels | None) -> materials.Labels | None:
        """Return drawn boxes, or else those that came with the images, mm from the image centre; None without any."""
        labels = self.labels
        if hand_labels is not None:
            labels = hand_labels
        if labels is None:
            return None
        return labels.convert_to_mm(self.x_m, self.y_m)


def is_given_images(path: Path) -> bool:
    """Return true for an `.npz` file, and for a folder with the published `sar_h.npy` or `sar_v.npy`."""
    if path.suffix == NPZ and not path.is_dir():
        return True
    return path.is_dir() and any((path / name).exists() for name in SAR_FILES)


def read_given_images(path: Path, rig: Instrument) -> GivenPair:
    """Read a pair of images; the rig file's pixel is assumed where the file has no axes.

    Raises DataError if a file or array is missing, or has a wrong type, shape or value.
    """
    if path.is_dir():
        return _read_folder(path, rig)
    if not path.exists():
        raise make_missing_path_error(path)
    arrays = _read_arrays(path)
    _check_channels(path, arrays)
    assumed: list[str] = []
    h = arrays["h"]
    v = arrays["v"]
    x_m = _make_axis(path, arrays, "x_m", h.shape[1], rig, assumed)
    y_m = _make_axis(path, arrays, "y_m", h.shape[0], rig, assumed)
    _check_square(path, x_m, y_m)
    unused = sorted(set(arrays) - {*CHANNEL_ARRAYS, *AXES, *OPTIONAL_ARRAYS, "p", ERROR_ARRAY})
    if unused:
        assumed.append(f"not used: {', '.join(unused)}")
    valid = _find_valid(path, arrays)
    angle = _number(path, arrays, "incidence_deg")
    images = _sort_axes(h, v, valid, x_m, y_m)
    if "raised_m" in arrays:
        images = replace(images, raised_m=_find_raised(path, arrays, x_m, y_m))
    simulated = bool(_number(path, arrays, "simulated") or False) or _is_simulated_product(path)
    conjugate_flag = _number(path, arrays, "conjugate")
    # Only our own images hold the error of P.
    is_sign_known = conjugate_flag is not None or ERROR_ARRAY in arrays
    if conjugate_flag:
        images = conjugate(images)
    return GivenPair(
        path=path,
        images=images,
        x_m=x_m,
        y_m=y_m,
        labels=None,
        incidence_deg=angle,
        simulated=simulated,
        assumed=tuple(assumed),
        other_sign=0.0 if is_sign_known else OTHER_SIGN,
    )


def conjugate(images: Images) -> Images:
    """Return the images with the other sign of all phases."""
    return replace(images, h=images.h.conj(), v=images.v.conj())


def _is_simulated_product(path: Path) -> bool:
    """Return true for an image.npz of this program if the scan.json beside it says that its data is simulated."""
    if path.name != IMAGE:
        return False
    try:
        facts = read_json(path.with_name(SCAN))
    except (OSError, ValueError, DataError):
        return False
    return isinstance(facts, dict) and facts.get("simulated") is True


def _read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Read all arrays of an .npz file. Raises DataError if it is damaged, or is not an .npz file."""
    try:
        with open_npz(path) as archive:
            return {name: archive[name] for name in archive}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as e:
        raise DataError(
            f"{path}: cannot be read as images: {e}", _EXPECTED_CONTENT, "write it with numpy.savez(path, h=h, v=v)",
            code=ErrorCode.FILE_UNREADABLE,
        ) from None  # fmt: skip


def _check_channels(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Raise DataError unless h and v are complex images of one shape."""
    missing = [name for name in CHANNEL_ARRAYS if name not in arrays]
    if missing:
        names = ", ".join(arrays) or "nothing"
        raise DataError(
            f"{path}: no {' and no '.join(missing)}; it contains {names}", _EXPECTED_CONTENT,
            "save the s-polarised channel as h and the p-polarised one as v", code=ErrorCode.KEY_MISSING,
        )  # fmt: skip
    for name in CHANNEL_ARRAYS:
        array = arrays[name]
        if array.dtype.kind != "c":
            raise DataError(
                f"{path}: {name} contains {array.dtype}, not complex numbers",
                "the phase between H and V is needed for a permittivity",
                "save the complex image, not its magnitude", code=ErrorCode.TYPE_WRONG,
            )  # fmt: skip
        if array.ndim != 2 or min(array.shape) < MIN_PIXELS:
            raise DataError(
                f"{path}: {name} has the shape {_shape(array)}",
                f"an image has two axes [ny, nx], each of {MIN_PIXELS} pixels or more",
                "save one image per channel", code=ErrorCode.MISMATCH,
            )  # fmt: skip
    h = arrays["h"]
    v = arrays["v"]
    if h.shape != v.shape:
        raise DataError(
            f"{path}: h is {_shape(h)}, v is {_shape(v)}", "both channels need the same pixels",
            "form both images on one grid", code=ErrorCode.MISMATCH,
        )  # fmt: skip


def _shape(array: npt.NDArray[Any]) -> str:
    """Return an array's shape as text: `150 x 150`."""
    return " x ".join(map(str, array.shape)) or "a single number"


def _make_axis(
    path: Path, arrays: Mapping[str, npt.NDArray[Any]], name: str, size: int, rig: Instrument, assumed: list[str]
) -> npt.NDArray[np.float64]:
    """Return the pixel centres [size] along one axis, metres; the rig file's pixel, centred, if the file has none.

    What is assumed is added to `assumed`. Raises DataError if the axis has another size or is not evenly spaced.
    """
    if name not in arrays:
        pixel_mm = rig.image.pixel_mm
        position = "row 0 is the lowest" if name == "y_m" else "column 0 is the leftmost"
        assumed.append(f"no {name}: pixels of {pixel_mm:g} mm (rig file), {position}")
        centred = np.arange(size, dtype=np.float64) - (size - 1) / 2
        return np.asarray(centred * pixel_mm / 1e3, np.float64)
    axis = arrays[name]
    if axis.dtype.kind not in "fiu" or axis.shape != (size,):
        raise DataError(
            f"{path}: {name} is {axis.dtype} {_shape(axis)}, the images have {size} pixels along it",
            "an axis has one pixel centre, in metres, for each row or column",
            f"save {name} with {size} numbers, or leave it out", code=ErrorCode.MISMATCH,
        )  # fmt: skip
    values = axis.astype(np.float64)
    steps = np.diff(values)
    pitch = float(steps.mean())
    if not np.isfinite(values).all() or pitch == 0 or float(np.abs(steps - pitch).max()) > MAX_UNEVENNESS * abs(pitch):
        raise DataError(
            f"{path}: {name} is not evenly spaced, or not finite", "pixels of one size are needed",
            "form the images on an even grid", code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return values


def _check_square(path: Path, x_m: npt.NDArray[np.float64], y_m: npt.NDArray[np.float64]) -> None:
    """Raise DataError unless pixels are square and of 0.1 to 20 mm: other numbers are a mistaken unit."""
    dx = abs(x_m[1] - x_m[0]) * 1e3
    dy = abs(y_m[1] - y_m[0]) * 1e3
    if not 0.1 <= dx <= 20 or abs(dx - dy) > MAX_UNEVENNESS * dx:
        raise DataError(
            f"{path}: pixels of {dx:.4g} x {dy:.4g} mm", "pixels must be square, of 0.1 to 20 mm; axes are in metres",
            "give x_m and y_m in metres, with one pitch", code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip


def _find_valid(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[np.bool_]:
    """Return the pixels to use, bool [ny, nx]: those in `valid` where a channel is not zero.

    Raises DataError if `valid` is not a mask of the image, one of its pixels is not finite, none is left, or a channel
    holds nothing or too small or large numbers.
    """
    h = arrays["h"]
    v = arrays["v"]
    valid = arrays.get("valid", np.ones(h.shape, bool))
    if valid.dtype.kind != "b" or valid.shape != h.shape:
        raise DataError(
            f"{path}: valid is {valid.dtype} {_shape(valid)}", f"expected bool {_shape(h)}",
            "save it as bool with the shape of h, or leave it out", code=ErrorCode.MISMATCH,
        )  # fmt: skip
    not_finite = valid & ~(np.isfinite(h) & np.isfinite(v))
    if not_finite.any():
        raise DataError(
            f"{path}: {int(not_finite.sum())} of {not_finite.size} pixels are not finite",
            "a pixel without data cannot be distinguished from a wrong one",
            "save valid (bool, [ny, nx]), false where there is no data", code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    for name, channel in (("h", h), ("v", v)):
        peak = float(np.abs(channel[valid]).max(initial=0.0))
        if peak and not LEAST_PEAK < peak < MOST_PEAK:
            raise DataError(
                f"{path}: the largest |{name}| is {peak:.3g}", f"expected {LEAST_PEAK:g} to {MOST_PEAK:g}",
                "multiply both channels by one number", code=ErrorCode.VALUE_INVALID,
            )  # fmt: skip
        # Only one channel is empty: the case of both follows below.
        if not peak and (h[valid] != 0).any() | (v[valid] != 0).any():
            raise DataError(
                f"{path}: {name} is zero everywhere", "materials are recognised by the ratio of both channels",
                "look at the program that made the images", code=ErrorCode.NO_DATA,
            )  # fmt: skip
    is_lit = valid & ((h != 0) | (v != 0))
    if not is_lit.any():
        raise DataError(
            f"{path}: no pixel contains data", "both channels are zero, or valid is false everywhere",
            "look at the program that made the images", code=ErrorCode.NO_DATA,
        )  # fmt: skip
    return is_lit


def _number(path: Path, arrays: Mapping[str, npt.NDArray[Any]], name: str) -> float | None:
    """Return a single number; None without that array. Raises DataError if it is not one finite number."""
    if name not in arrays:
        return None
    value = arrays[name]
    if value.size != 1 or value.dtype.kind not in "bfiu" or not np.isfinite(value).all():
        raise DataError(
            f"{path}: {name} is {value.dtype} {_shape(value)}", "expected one finite number",
            f"save {name} as one number, or leave it out", code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    return float(value.reshape(-1)[0])


def _sort_axes(
    h: npt.NDArray[Any],
    v: npt.NDArray[Any],
    valid: npt.NDArray[np.bool_],
    x_m: npt.NDArray[np.float64],
    y_m: npt.NDArray[np.float64],
) -> Images:
    """Return the pair with ascending axes, zero where it is not valid."""
    rows = slice(None, None, int(np.sign(y_m[1] - y_m[0])))
    columns = slice(None, None, int(np.sign(x_m[1] - x_m[0])))
    usable = valid[rows, columns]
    shown_h = np.where(usable, h[rows, columns], 0).astype(np.complex64)
    shown_v = np.where(usable, v[rows, columns], 0).astype(np.complex64)
    return Images(shown_h, shown_v, x_m[columns], y_m[rows], usable)


def _find_raised(
    path: Path, arrays: Mapping[str, npt.NDArray[Any]], x_m: npt.NDArray[np.float64], y_m: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Return how far behind the object plane each pixel was imaged, [ny, nx] with ascending axes, metres.

    Raises DataError if `raised_m` has another shape, or a value that is not finite or beyond `MOST_RAISED_M`.
    """
    raised_m = arrays["raised_m"]
    if raised_m.dtype.kind not in "fiu" or raised_m.shape != arrays["h"].shape:
        raise DataError(
            f"{path}: raised_m is {raised_m.dtype} {_shape(raised_m)}", f"expected numbers {_shape(arrays['h'])}",
            "save the distance behind the plane, metres, with the shape of h, or leave it out",
            code=ErrorCode.MISMATCH,
        )  # fmt: skip
    if not (np.abs(raised_m) <= MOST_RAISED_M).all():
        raise DataError(
            f"{path}: raised_m has values beyond +-{MOST_RAISED_M:g} m",
            "it is the distance of a plate's plane from that of the others", "save it in metres",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    steps = (slice(None, None, int(np.sign(axis[1] - axis[0]))) for axis in (y_m, x_m))
    return np.asarray(raised_m[tuple(steps)], np.float64)


def _read_folder(folder: Path, rig: Instrument) -> GivenPair:
    """Read `labels/<scan>`; row 0 of its images is the top of the published pictures, the largest y."""
    scan = materials.read_labelled_scan(folder)
    # It is not documented from which row the boxes count y, and whether rows are y at all: the images are turned so
    # that the boxes explain most of their brightness.
    orientation = materials.image_orientation([scan])
    scan = scan.orient(orientation)
    arrays = {"h": scan.h, "v": scan.v}
    _check_channels(folder, arrays)
    x_m = _make_axis(folder, arrays, "x_m", scan.h.shape[1], rig, [])
    y_m = _make_axis(folder, arrays, "y_m", scan.h.shape[0], rig, [])[::-1]
    assumed = [
        f"no geometry: pixels of {rig.image.pixel_mm:g} mm (rig file), row 0 is the highest; boxes: {orientation}"
    ]
    labels = None
    if scan.boxes:
        labels = materials.read_labels(materials.find_label_file(folder))
    images = _sort_axes(scan.h, scan.v, _find_valid(folder, arrays), x_m, y_m)
    return GivenPair(
        path=folder,
        images=images,
        x_m=x_m,
        y_m=y_m,
        labels=labels,
        incidence_deg=materials.find_angle_in_text([scan.description, scan.scan]),
        simulated=scan.simulated,
        assumed=tuple(assumed),
        other_sign=PUBLISHED_OTHER_SIGN,
    )


def place_rig(rig: Instrument, incidence_deg: float) -> Instrument:
    """Return the rig with its object plane where the specular incidence angle is the given one.

    Raises ConfigError if no distance of the plane gives this angle.
    """

    def place_plane(distance_mm: float) -> Instrument:
        geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=distance_mm)
        return msgspec.structs.replace(rig, geometry=geometry)

    def miss(distance_mm: float) -> float:
        """Return the angle at this distance minus the given one, degrees; it falls with the distance."""
        return float(np.degrees(specular_incidence_rad(place_plane(distance_mm)))) - incidence_deg

    if not miss(_NEAREST_MM) > 0 > miss(_FARTHEST_MM):
        raise ConfigError(
            f"an incidence angle of {incidence_deg:g} degrees", "the rig's geometry has no plane with this angle",
            "give an angle between 5 and 80 degrees", code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    distance_mm: Any = scipy.optimize.brentq(miss, _NEAREST_MM, _FARTHEST_MM, xtol=1e-9)
    return place_plane(float(distance_mm))


@dataclass(frozen=True)
class Angle:
    """Incidence angle of given images: degrees, and where it comes from ("option", "file" or "rig file")."""

    deg: float
    source: str


def choose_angle(pair: GivenPair, settings: Settings, rig: Instrument) -> Angle:
    """Return the angle of the option, of the file, or of the rig file.

    Raises ConfigError if one angle for each pixel is asked for: that needs the raster and the antennas.
    """
    if settings.incidence == "pixel":
        raise ConfigError(
            "--incidence pixel with given images", "the angle of a pixel needs the raster of a recorded scan",
            "give --incidence DEGREES, or leave it out", code=ErrorCode.VALUES_CONFLICT,
        )  # fmt: skip
    if settings.incidence_deg is not None:
        return Angle(settings.incidence_deg, "option")
    if pair.incidence_deg is not None:
        return Angle(pair.incidence_deg, "file")
    return Angle(float(np.degrees(specular_incidence_rad(rig))), "rig file")


def describe_illumination(images: Images, rig: Instrument) -> Illumination:
    """Return the illumination with which the phase of a plate gives its tilt (`Illumination.rise`), for this rig.

    The footprints are not known and taken as even: nothing is divided out. `moved_m` (how far a tilt moves the point
    that reflects) and `steepness_rad_m` (phase of a tilt along the plate) are those at each board's specular point.
    """
    chirp = rig.chirp
    middle_hz = chirp.first_sample_hz + chirp.hz_per_sample * float(np.mean(chirp.linear_samples))
    plane_m = rig.geometry.object_distance_mm / 1e3
    boards = [illumination_geometry(Antennas.from_rig(rig, board), plane_m, middle_hz) for board in rig.receivers]
    pitch_m = float(images.x_m[1] - images.x_m[0])
    return Illumination(
        footprints=np.ones((2, *images.h.shape), np.complex64),
        moved_m=np.stack([moved for moved, _ in boards]),
        steepness_rad_m=np.array([steepness for _, steepness in boards]),
        pixel_m=(pitch_m, pitch_m),
    )


def list_reasons_of_given_images(pair: GivenPair, angle: Angle) -> list[Finding]:
    """Return what limits the verdict on given images: no direct path, an assumed geometry, an assumed angle."""
    # The last number of a reason is its weight: those of one level are listed by falling weight.
    reasons = [reason(
        "care", "the images were given without a direct path",
        "gains of H against V, the recording and the plane of the plates cannot be checked",
        "process the recorded scan where there is one", 2.4,
    )]  # fmt: skip
    if pair.assumed:
        reasons.append(reason(
            "care", f"assumed, not in the file: {'; '.join(pair.assumed)}",
            "sizes and places of patches depend on it", "save x_m and y_m (metres) with the images", 1.1,
        ))  # fmt: skip
    if angle.source == "rig file":
        reasons.append(reason(
            "care", f"the incidence angle is not known: {angle.deg:.1f} degrees of the rig file were used",
            "|P| of a dielectric changes by a tenth in a degree",
            "give --incidence DEGREES, or save incidence_deg", 2.3,
        ))  # fmt: skip
    return reasons


TOLD_TILT_DEG = 0.5
"""Tilt of a plate across the plane of incidence above which the verdict reports that the correction of the turned
polarisations assumes the rig file's antennas; chosen."""


def turn_reasons(result: materials.MaterialsResult) -> list[Finding]:
    """Return what limits the verdict if plates are tilted: images do not show to which side the antennas are turned."""
    tilted = [
        r.patch.label
        for r in result.patches
        if r.refused is None and abs(np.degrees(result.tilts.across_rad(r.patch.label))) > TOLD_TILT_DEG
    ]
    if not tilted:
        return []
    return [reason(
        "care",
        f"tilted patches ({', '.join(map(str, tilted))}) were corrected for antennas turned as in the rig file",
        "a tilted plate turns the polarisations: with antennas turned to the other side the correction is reversed",
        "lay the plates flat, or process the recorded scan with its own rig file", 1.3,
    )]  # fmt: skip


REPORTED_PAINT = 0.2
REPORTED_SIGN = 0.02
"""Probabilities of paint and of the other sign above which the verdict reports them; chosen."""


def sign_reasons(other_sign: float, conjugated: bool, painted: float = 0.0) -> list[Finding]:
    """Return what limits the verdict if the sign of the phases is not known.

    `other_sign` is the probability of the sign that was not taken, `conjugated` is true if the file's sign was not
    taken; `painted` is the probability that the metal reference is painted if the phases are as given: paint and the
    other sign both change the phase of all ratios.
    """
    if other_sign < REPORTED_SIGN and not conjugated:
        return []
    treatment = "as they are"
    if conjugated:
        treatment = "the other way round"
    cause = "with the wrong sign losses are wrong; the error bars include both signs"
    if conjugated and painted > REPORTED_PAINT:
        cause += "; or the sign is as given, and the metal reference is painted"
    return [reason(
        "care",
        f"the sign of the phases is not known: used {treatment}, which is right with a probability of "
        f"{1 - other_sign:.2f}",
        cause,
        "save `conjugate` (true or false) with the images: docs/spec/given-images.md", 2.2,
    )]  # fmt: skip


def make_reference(pair: GivenPair) -> PlaneReference:
    """Return the metal reference that given images of a plate make. Raises DataError if they show none."""
    return plane_reference(pair.images, name=pair.scan_id)


def _check_phases(pair: GivenPair) -> None:
    """Raise DataError if V has the phase of H, or the opposite one, in all lit pixels.

    Magnitudes and real parts are such images, however they are stored. A plate of metal alone may be one, too.
    """
    lit = pair.images.valid
    product = pair.images.v[lit].astype(np.complex128) * np.conj(pair.images.h[lit])
    if (np.abs(product.imag) > LEAST_PHASE_RAD * np.abs(product)).any():
        return
    raise DataError(
        f"{pair.path}: no phase between h and v in any pixel", "the loss of a material is found from the phase of V "
        "relative to H",
        "save both complex images as they were formed, not magnitudes or real parts", code=ErrorCode.VALUE_INVALID,
    )  # fmt: skip


def analyse_given_images(
    pair: GivenPair,
    settings: Settings,
    inputs: Inputs,
    rig: Instrument,
    plates: tuple[materials.TruthPlate, ...] = (),
) -> tuple[ProcessedScan, Findings, str]:
    """Find the materials of given images; return the result, its findings, and why nothing was named, or "".

    `plates` are the true ones of a simulated scene, if known. Raises PolysightError as `polysight.pipeline.Pipeline`
    for a recorded scan.
    """
    started_s = time.perf_counter()
    _check_phases(pair)
    angle = choose_angle(pair, settings, rig)
    rig = place_rig(rig, angle.deg)
    classifier = load_classifier(settings, rig)
    images = replace(pair.images, illumination=describe_illumination(pair.images, rig))
    boxed = replace(inputs, labels=pair.boxes(inputs.labels))
    scene = convert_boxes_to_patches(settings, boxed, images.x_m, images.y_m)
    plane = inputs.reference
    if plane is not None and scene.metal is None:
        images = images.limit_to_area(plane.valid_on(images.x_m, images.y_m))
        scene = replace(scene, metal=plane)
    # `IncidenceChoice` takes the specular angle, and the angle of each pixel: without a raster these are the same.
    everywhere = incidence_on_planes(np.full(images.h.shape, np.radians(angle.deg)), images.raised_m, rig)
    optics = materials.Optics.from_rig(
        rig, IncidenceChoice("one", everywhere, everywhere), theta_std_rad=UNKNOWN_PLANE.incidence_std_rad(rig)
    )
    scene = replace(scene, plates=plates)
    optics = replace(optics, other_sign=pair.other_sign)
    result = materials.analyse(images, optics, scene, classifier)
    # If the other sign is likelier, all phases are turned and the scene is analysed again. `other_sign` of a result is
    # that of the sign which its images do not have.
    conjugated = result.other_sign > 0.5
    painted = result.inversion.painted
    if conjugated:
        images = conjugate(images)
        result = materials.analyse(images, replace(optics, other_sign=1 - pair.other_sign), scene, classifier)
    sign = sign_reasons(result.other_sign, conjugated, painted)
    limits = [*list_reasons_of_given_images(pair, angle), *sign, *turn_reasons(result)]
    # None: the plane of the plates was not estimated.
    verdict = join_reasons([*limits, *scene_reasons(result, None, classifier)])
    # With the verdict "no result" names and permittivities are withheld.
    if not verdict.usable:
        result = result.without_result()
    findings = Findings(images, result, verdict, UNKNOWN_PLANE, classifier, plates)
    quality = ScanQuality(
        seconds_per_stage={"materials": round(time.perf_counter() - started_s, 4)},
        verdict=verdict,
        pixel_accuracy=materials.pixel_accuracy(result),
        incidence=IncidenceAngles(used="one number for the image", one_deg=round(angle.deg, 4)),
        given_images=GivenImages(
            file=str(pair.path),
            incidence_from=angle.source,
            assumed=list(pair.assumed),
            other_sign=round(result.other_sign, 4),
        ),
    )
    facts = ScanFacts(
        scan_id=pair.scan_id,
        simulated=pair.simulated,
        processed_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        versions=versions(),
    )
    unnamed = explain_unnamed(settings, rig)
    return assemble_result(pair.path.parent, facts, quality, findings, unnamed), findings, unnamed
