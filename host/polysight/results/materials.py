"""Content of materials.json: patches with all their figures, the error budget, and the library and model of the names.

The structs are the file format: a field that is UNSET is absent in the file, and unknown keys are ignored.

A figure of a patch is declared once in :class:`PatchFigures`, together with a :class:`Column`, which has its name, unit
and title. A figure is either a field, with the column in its annotation, or is computed from fields by `derive` or
`derive_if_known`. Tables, exports, datasets and pages render all columns, in the order of declaration.
"""

# Without `from __future__ import annotations`, Python evaluates each annotation at its declaration: a column gets its
# position there.

import cmath
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import count
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Generic, NamedTuple, Self, TypeVar, get_args, get_origin, get_type_hints, overload

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET, UnsetType

from polysight.results.json_files import convert, format_one_line, read_object
from polysight.results.verdict import Verdict, read_verdict
from polysight_shared.findings import Finding

Pair = tuple[float | None, float | None]
Number = float | None
Text = str | None
V = TypeVar("V")
# Counts the columns in the order of their declarations.
_positions = count()


@dataclass(frozen=True)
class Column:
    """Name and presentation of a figure of a patch.

    Attributes
    ----------
    name
        Column of the CSV and MATLAB table; "" leaves it out.
    about
        Description in a few words.
    unit
        Unit of the value; "1" for a pure number, "" for text.
    variable
        Name of the variable in datasets; "" leaves it out. None: the same as `name`.
    title, digits
        Heading in tables for people ("": not shown there), and digits after the decimal point.
    optional
        True if datasets omit the figure when no patch has a value.
    position
        Place in the order of the declarations; it is counted and need not be given.
    """

    name: str
    about: str = ""
    unit: str = "1"
    variable: str | None = None
    title: str = ""
    digits: int | None = None
    optional: bool = False
    position: int = field(default_factory=_positions.__next__, compare=False)


@dataclass(frozen=True)
class Figure:
    """A declared figure: the attribute of the patch, its type without None, and its column."""

    attribute: str
    kind: type
    column: Column

    @property
    def variable(self) -> str:
        """Name of the variable in datasets; "" if it is not one."""
        if self.column.variable is None:
            return self.column.name
        return self.column.variable

    def values(self, patches: "Sequence[PatchFigures]") -> list[Any]:
        """Return the value of each patch; None where it is not known."""
        values = [getattr(patch, self.attribute) for patch in patches]
        return [None if value is UNSET else value for value in values]

    def array(self, patches: "Sequence[PatchFigures]") -> npt.NDArray[Any]:
        """Return the values as an array: unknown text is empty, unknown numbers are NaN in both parts."""
        values = self.values(patches)
        if self.kind is str:
            return np.array([value or "" for value in values], np.str_)
        if self.kind is bool:
            return np.array(values, np.bool_)
        if self.kind is complex:
            dtype = np.complex128
            unknown = complex(np.nan, np.nan)
        else:
            dtype = np.float64
            unknown = np.nan
        return np.array([unknown if value is None else value for value in values], dtype)

    def format(self, patch: "PatchFigures") -> str:
        """Return the value for people, with its unit; a dash if it is not known."""
        value = getattr(patch, self.attribute)
        if value is None or value is UNSET:
            return "–"
        text = str(value)
        if self.column.digits is not None:
            # Adding zero after rounding removes the sign of a negative zero.
            text = f"{round(float(value), self.column.digits) + 0.0:.{self.column.digits}f}"
        unit = {"1": "", "degree": "°"}.get(self.column.unit, f" {self.column.unit}")
        return f"{text}{unit}".strip()


class Derived(Generic[V]):
    """A figure of a patch that is computed from others, as a property with its type and column."""

    def __init__(self, kind: type, compute: "Callable[[PatchFigures], V]", column: Column) -> None:
        self.kind = kind
        self.column = column
        self._compute = compute

    @overload
    def __get__(self, patch: None, owner: type) -> Self: ...
    @overload
    def __get__(self, patch: "PatchFigures", owner: type) -> V: ...
    def __get__(self, patch: "PatchFigures | None", owner: type) -> Self | V:
        if patch is None:
            return self
        return self._compute(patch)


def derive(kind: type[V], compute: "Callable[[PatchFigures], V]", column: Column) -> Derived[V]:
    """Declare a figure that every patch has."""
    return Derived(kind, compute, column)


def derive_if_known(
    kind: type[V], source: "str | Callable[[PatchFigures], V | None]", column: Column
) -> Derived[V | None]:
    """Declare a figure that some patches lack.

    `source` is a function of the patch, or a path of attributes ("permittivity.real"). The figure is None if an
    attribute on the path is None or UNSET.
    """
    if isinstance(source, str):
        return Derived(kind, partial(_follow, source.split(".")), column)
    return Derived(kind, source, column)


def _follow(path: Sequence[str], value: Any) -> Any:
    """Follow a path of attributes from `value` and return the last one; None if one of them is None or UNSET."""
    for name in path:
        value = getattr(value, name)
        if value is None or value is UNSET:
            return None
    return value


@lru_cache
def list_declared_figures(kind: type["PatchFigures"]) -> tuple[Figure, ...]:
    """Return the figures declared in a class of patches, in the order of their declaration."""
    figures = [
        Figure(name, member.kind, member.column)
        for ancestor in kind.__mro__
        for name, member in vars(ancestor).items()
        if isinstance(member, Derived)
    ]
    for name, hint in get_type_hints(kind, include_extras=True).items():
        if get_origin(hint) is Annotated:
            field_type, *extras = get_args(hint)
            value_types = [part for part in get_args(field_type) if part not in (NoneType, UnsetType)]
            value_type = value_types[0] if value_types else field_type
            figures += [Figure(name, value_type, column) for column in extras if isinstance(column, Column)]
    return tuple(sorted(figures, key=lambda figure: figure.column.position))


class ComplexNumber(msgspec.Struct, frozen=True):
    """A complex number; None for parts that are not finite."""

    real: float | None
    imag: float | None

    @classmethod
    def from_complex(cls, value: complex | None) -> "ComplexNumber | None":
        """Return a finite number; otherwise None."""
        if value is None or not (math.isfinite(value.real) and math.isfinite(value.imag)):
            return None
        return cls(float(value.real), float(value.imag))

    @property
    def value(self) -> complex:
        """The value as a complex number; unknown parts are NaN."""
        parts = [math.nan if part is None else part for part in (self.real, self.imag)]
        return complex(*parts)


class _NameShare(NamedTuple):
    """A name, and its probability or share of the pixels."""

    name: str | None = None
    share: float | None = None


def level_db(ratio: complex | None) -> float | None:
    """Return the level of a ratio, dB; None for zero and for an unknown ratio."""
    if not ratio:
        return None
    return 20 * math.log10(abs(ratio))


class PermittivityFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Permittivity of a patch and its errors.

    Attributes
    ----------
    real, imag
        eps' and -eps'' (minus the loss).
    real_p30_p70, imag_p30_p70
        30th to 70th percentile of the pixels.
    real_std, imag_std
        Standard errors: 1.96 of them hold 95 %.
    half_widths_68
        Half widths of the intervals about `real` and `imag` that hold 68 %. They are mostly smaller than the standard
        errors, because the errors have heavier tails than a normal distribution. None in products of old releases.
    covariance
        [2][2] of (`real`, `imag`). Since the loss is -`imag`, the covariance of `real` and the loss is minus the mixed
        term.
    shares, dominated_by
        Share of each source in the variance, and the largest source.
    do
        Measurement that would reduce the error most.
    """

    real: float
    imag: float
    real_p30_p70: tuple[float, float] | None = None
    imag_p30_p70: tuple[float, float] | None = None
    real_std: float | None = None
    imag_std: float | None = None
    half_widths_68: tuple[float, float] | None = None
    covariance: list[list[float | None]] | None = None
    shares: dict[str, float] = {}
    dominated_by: str | None = None
    do: str | None = None

    @property
    def value(self) -> complex:
        """Permittivity eps' - j eps''."""
        return complex(self.real, self.imag)

    @property
    def loss(self) -> float:
        """Loss eps''."""
        return -self.imag

    @property
    def spread(self) -> "PermittivitySpread | None":
        """Error of (eps', eps''); None if it is not known."""
        covariance = self.covariance
        if covariance is not None:
            real = covariance[0][0]
            mixed = covariance[0][1]
            imag = covariance[1][1]
            if real is not None and mixed is not None and imag is not None:
                # Adding zero removes the sign of a negative zero.
                return PermittivitySpread(math.sqrt(real), math.sqrt(imag), covariance=-mixed + 0.0)
        if self.real_std is None or self.imag_std is None:
            return None
        return PermittivitySpread(self.real_std, self.imag_std)


@dataclass(frozen=True)
class PermittivitySpread:
    """Standard deviations of eps' and of the loss eps'', and their covariance (None in products of old releases)."""

    real_std: float
    loss_std: float
    covariance: float | None = None

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        """Covariance matrix of (eps', eps''), [2, 2]; diagonal if the covariance is unknown."""
        mixed = self.covariance or 0.0
        return np.array([[self.real_std**2, mixed], [mixed, self.loss_std**2]])


class BandFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Ratio of a patch in one sub-band of the sweep; None if no pixel of the patch is usable in it.

    Attributes
    ----------
    first_hz, last_hz
        Transmit frequencies that it spans.
    ratio, amplitude_h
        Median of P and of abs(H), relative to metal.
    inverse_ratio_std, own_std
        Standard error of 1 / P, and its part not shared with other sub-bands.
    own_amplitude_std
        Relative standard error of abs(H), the part not shared with other sub-bands.
    covariance
        [2][2 K]: this 1 / P (real, imaginary) with those of all K sub-bands; None if one has no ratio.
    """

    first_hz: float
    last_hz: float
    ratio: ComplexNumber | None = None
    inverse_ratio_std: float | None = None
    own_std: float | None = None
    amplitude_h: float | None = None
    own_amplitude_std: float | None = None
    covariance: list[list[float]] | None = None


class TruthFigures(msgspec.Struct, frozen=True, kw_only=True):
    """The true plate of a simulated scene; `in_library` says if the library contains its material."""

    name: str
    metal: bool = False
    permittivity: ComplexNumber | None = None
    thickness_mm: float | None = None
    in_library: bool = True


# Index of a part of the permittivity in `half_widths_68`. The half width of the loss is that of the imaginary part.
_REAL = 0
_LOSS = 1


def _half_width_68(patch: "PatchFigures", part: int) -> float | None:
    """Return the half width of a part, `_REAL` or `_LOSS`; None if it is not known."""
    if patch.permittivity is None or patch.permittivity.half_widths_68 is None:
        return None
    return patch.permittivity.half_widths_68[part]


class PatchFigures(msgspec.Struct, frozen=True, kw_only=True):
    """One patch: an entry of `segments` in materials.json. P = H / V; lengths in mm from the image centre.

    Attributes
    ----------
    name
        Material of the library, "like ... (literature)", "possible layer" or "unknown".
    name_source
        "library" or "literature"; None without a name, or if the name is not a material.
    votes, probabilities
        Share of the pixels with each name, and probability of each name, `unknown` among them; likeliest first.
    literature
        Probability of each likely material of the literature.
    why
        Reason for the name in one sentence.
    distance
        Distance to the named material, in units of its threshold: above 1 is unknown.
    box_mm
        Bounding box: least x and y, largest x and y.
    outline_mm, pixels
        Outline of the patch and its number of pixels, with the edges that are left out of the other figures.
    amplitude_h
        Median of abs(H) relative to metal.
    refused
        Reason why the patch has neither name nor permittivity.
    truth
        The plate of a simulated scene.
    tilt_across_deg
        Tilt of the patch across the plane of incidence; its effect was removed from H and V.
    bands
        Ratios in the sub-bands of the sweep.
    """

    label: Annotated[int, Column("patch", "number of the patch in label", variable="")]
    name: Annotated[Text, Column("name", "material; empty where it was not named", "")] = None
    name_source: Annotated[Text, Column("name_source", "where the name is from: library or literature", "")] = None
    confidence: Annotated[Number, Column("confidence", "confidence in the name, 0 to 1")] = None
    runner_up = derive_if_known(str, "_second.name", Column("", "next likeliest material", "", "runner_up"))
    runner_up_share = derive_if_known(
        float, "_second.share", Column("", "probability of runner_up", "1", "runner_up_share")
    )
    votes: dict[str, float] = {}
    probabilities: dict[str, float] = {}
    literature: dict[str, float] = {}
    why: str = ""
    distance: Number = None
    metal_reference: Annotated[bool, Column("metal_reference", "True where the patch is the metal reference")] = False
    metal_like: Annotated[bool, Column("metal_like", "True where P is too close to metal for a permittivity")] = False
    box_mm: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    outline_mm: list[tuple[float, float]] = []
    centre_x_mm = derive(
        float, lambda patch: (patch.box_mm[0] + patch.box_mm[2]) / 2,
        Column("centre_x_mm", "middle of the patch, x", "mm", ""),
    )  # fmt: skip
    centre_y_mm = derive(
        float, lambda patch: (patch.box_mm[1] + patch.box_mm[3]) / 2,
        Column("centre_y_mm", "middle of the patch, y", "mm", ""),
    )  # fmt: skip
    width_mm = derive(
        float, lambda patch: patch.box_mm[2] - patch.box_mm[0], Column("width_mm", "extent along x", "mm")
    )
    height_mm = derive(
        float, lambda patch: patch.box_mm[3] - patch.box_mm[1], Column("height_mm", "extent along y", "mm")
    )
    pixels: int = 0
    interior_pixels: Annotated[int | None, Column("pixels", "number of pixels behind the numbers")] = None
    incidence_deg: Annotated[
        Number, Column("incidence_deg", "mean incidence angle of the patch", "degree", "patch_incidence_deg")
    ] = None
    permittivity: PermittivityFigures | None = None
    permittivity_value = derive_if_known(
        complex, "permittivity.value", Column("", "relative permittivity", "1", "permittivity")
    )
    permittivity_real = derive_if_known(float, "permittivity.real", Column("permittivity_real", "eps'", variable=""))
    permittivity_real_std = derive_if_known(
        float, "permittivity.spread.real_std",
        Column("permittivity_real_standard_error", "standard error of the permittivity, real part"),
    )  # fmt: skip
    permittivity_loss = derive_if_known(
        float, "permittivity.loss", Column("permittivity_loss", "loss eps''", variable="")
    )
    permittivity_loss_std = derive_if_known(
        float, "permittivity.spread.loss_std",
        Column("permittivity_loss_standard_error", "standard error of the permittivity, loss part"),
    )  # fmt: skip
    permittivity_covariance = derive_if_known(
        float, "permittivity.spread.covariance",
        Column("permittivity_real_loss_covariance", "covariance of the permittivity's real part and loss"),
    )  # fmt: skip
    permittivity_real_half_width_68 = derive_if_known(
        float, lambda patch: _half_width_68(patch, _REAL),
        Column("permittivity_real_half_width_68", "half width of the interval of 68 %, real part"),
    )  # fmt: skip
    permittivity_loss_half_width_68 = derive_if_known(
        float, lambda patch: _half_width_68(patch, _LOSS),
        Column("permittivity_loss_half_width_68", "half width of the interval of 68 %, loss"),
    )  # fmt: skip
    dominated_by = derive_if_known(
        str, "permittivity.dominated_by",
        Column("dominated_by", "what most of the permittivity's error comes from", ""),
    )  # fmt: skip
    refused: Finding | None = None
    refused_text = derive_if_known(
        str, lambda patch: patch.refused and format_one_line(patch.refused),
        Column("refused", "why the patch was not judged, and what to do", ""),
    )  # fmt: skip
    ratio: ComplexNumber | None = None
    p = derive_if_known(complex, "ratio.value", Column("", "median of P = H / V relative to metal", "1", "ratio"))
    p_real = derive_if_known(float, "p.real", Column("p_real", "real part of P", variable=""))
    p_imag = derive_if_known(float, "p.imag", Column("p_imag", "imaginary part of P", variable=""))
    p_abs_db = derive_if_known(float, lambda patch: level_db(patch.p), Column("p_abs_db", "level of P", "dB", ""))
    p_abs = derive_if_known(
        float, lambda patch: None if patch.p is None else abs(patch.p),
        Column("", "size of P", variable="", title="|P|", digits=2),
    )  # fmt: skip
    p_phase_deg = derive_if_known(
        float, lambda patch: None if patch.p is None else math.degrees(cmath.phase(patch.p)),
        Column("p_phase_deg", "phase of P", "degree", "", title="∠P", digits=1),
    )  # fmt: skip
    inverse_ratio_std: Annotated[
        Number,
        Column(
            "inverse_p_standard_error",
            "standard error of V / H, real and imaginary part each",
            variable="inverse_ratio_standard_error",
        ),
    ] = None
    amplitude_h: Number = None
    truth: TruthFigures | None = None
    true_name = derive_if_known(
        str, "truth.name", Column("true_name", "material of the simulated scene", "", optional=True)
    )
    true_permittivity = derive_if_known(
        complex, "truth.permittivity.value",
        Column("", "relative permittivity of the simulated scene", "1", "true_permittivity", optional=True),
    )  # fmt: skip
    true_permittivity_real = derive_if_known(
        float, "true_permittivity.real", Column("true_permittivity_real", variable="")
    )
    true_permittivity_loss = derive_if_known(
        float, lambda patch: None if patch.true_permittivity is None else -patch.true_permittivity.imag,
        Column("true_permittivity_loss", variable=""),
    )  # fmt: skip
    tilt_across_deg: float | UnsetType = UNSET
    bands: list[BandFigures] | UnsetType = UNSET
    box: Annotated[
        str | UnsetType, Column("drawn_as", "what a person called the box of the patch", "", optional=True)
    ] = UNSET
    # Old products do not have the number of pixels that were left after the edges.
    pixels_used = derive(
        int, lambda patch: patch.pixels if patch.interior_pixels is None else patch.interior_pixels,
        Column("", "pixels", "1", "", title="Pixels"),
    )  # fmt: skip

    @property
    def _second(self) -> "_NameShare":
        """The second likeliest name after `name`, by probability, or by votes in products without probabilities."""
        shares = self.probabilities or self.votes
        other_shares = [_NameShare(name, share) for name, share in shares.items() if name != self.name]
        return max(other_shares, key=lambda other: other.share or 0.0, default=_NameShare())

    def without_results(self) -> Self:
        """Return the patch without names, ratios, permittivity and truth.

        Place, size, incidence, tilt, the mark of the metal reference and the reason of a refusal are kept.
        """
        return msgspec.structs.replace(
            self, name=None, name_source=None, confidence=None, votes={}, probabilities={}, literature={}, why="",
            distance=None, metal_like=False,
            permittivity=None, ratio=None, inverse_ratio_std=None, amplitude_h=None, truth=None, bands=UNSET,
        )  # fmt: skip


class LeakageError(msgspec.Struct, frozen=True, kw_only=True):
    """Leakage of the other polarisation into H and V, relative to the wanted one, with its standard deviations.

    `source` is "measured", "scene", or "prior and scene" (hardly known). `removed_h` and `removed_v` are the leakage
    that was removed from the pixels of image.npz.
    """

    # Real and imaginary part.
    h: Pair | None = None
    v: Pair | None = None
    # Standard deviation of `h` and that of `v`.
    std: Pair | None = None
    source: str = ""
    removed_h: Pair | UnsetType = UNSET
    removed_v: Pair | UnsetType = UNSET


class IncidenceError(msgspec.Struct, frozen=True, kw_only=True):
    """Incidence angle after the joint inversion, and its standard deviation."""

    deg: float | None = None
    std_deg: float | None = None


class PlaneError(msgspec.Struct, frozen=True, kw_only=True):
    """Plane of the plates relative to the plane of the rig file; without values if `known` is False.

    `by` is "phase" or "range", the quantity from which it was found; `plates` is the number of plates that were used.
    """

    known: bool = False
    offset_mm: float | UnsetType = UNSET
    offset_std_mm: float | UnsetType | None = UNSET
    tilt_deg: Pair | UnsetType = UNSET
    tilt_std_deg: Pair | UnsetType = UNSET
    by: str | UnsetType = UNSET
    plates: int | UnsetType = UNSET
    # Distances behind this plane of the plates that were imaged on planes of their own.
    raised_mm: list[float] | UnsetType = UNSET


class MetalScore(msgspec.Struct, frozen=True, kw_only=True):
    """Evidence that the reference is metal.

    `score` is ln(evidence for metal / evidence for a dielectric) from the other patches, of which there are `others`;
    `channel_ratio_db` is V / H relative to the direct path. `painted` is the probability that the metal is painted,
    `paint_mm` the thickness of the paint in that case.
    """

    score: float | None = None
    others: int = 0
    channel_ratio_db: float | None = None
    painted: float | None = None
    paint_mm: float | None = None


class ErrorBudget(msgspec.Struct, frozen=True, kw_only=True):
    """Errors of the scan that the errors of the permittivities were computed from."""

    leakage: LeakageError | None = None
    incidence: IncidenceError | None = None
    plane: PlaneError | None = None
    metal: MetalScore | None = None


class MetalSource(msgspec.Struct, frozen=True, kw_only=True):
    """Origin of the metal reference in one sentence, and whether it is certainly metal."""

    how: str = ""
    certain: bool = False


class ScanMaterials(msgspec.Struct, frozen=True, kw_only=True):
    """Content of materials.json.

    Attributes
    ----------
    verdict
        None in products of earlier releases. With the level `none` the patches lose what `without_results` removes, so
        that no reader or writer of the results can show names or permittivities.
    library, model
        Description of the library that named the patches, and the name of the classifier.
    pixel_accuracy
        Share of interior pixels with the correct name, in a simulated scene.
    """

    scan_id: str | UnsetType = UNSET
    simulated: bool | UnsetType = UNSET
    verdict: Verdict | UnsetType | None = UNSET
    error_budget: ErrorBudget | UnsetType | None = UNSET
    metal_reference: MetalSource | UnsetType = UNSET
    library: str = ""
    model: str | None = None
    pixel_accuracy: float | None = None
    segments: list[PatchFigures] = []

    def __post_init__(self) -> None:
        if self.verdict and not self.verdict.usable:
            msgspec.structs.force_setattr(self, "pixel_accuracy", None)
            msgspec.structs.force_setattr(self, "segments", [patch.without_results() for patch in self.segments])

    @classmethod
    def read(cls, path: Path) -> "ScanMaterials | None":
        """Read a file; None if it does not exist (only images were made). Raises DataError if it is damaged."""
        content = read_object(path)
        if content is None:
            return None
        return cls.decode(content, path)

    @classmethod
    def decode(cls, content: dict[str, Any], path: Path = Path("materials.json")) -> Self:
        """Return the content of a file as a struct; `path` is for messages. Raises DataError if it is damaged."""
        segments = content.get("segments", [])
        if isinstance(segments, list):
            segments = [_decode_finding(segment) for segment in segments]
        return convert({**content, "verdict": read_verdict(content), "segments": segments}, cls, path)


def _decode_finding(segment: Any) -> Any:
    """Return an entry with `refused` as a :class:`Finding`; files have its parts as what, why and do."""
    if not isinstance(segment, dict) or not isinstance(segment.get("refused"), dict):
        return segment
    refused = segment["refused"]
    problem = str(refused.get("what", ""))
    cause = str(refused.get("why", ""))
    remedy = str(refused.get("do", ""))
    return {**segment, "refused": Finding("error", problem, cause, remedy)}
