"""The public versions of `fresnel`, `permittivity_from_ratio` and `multilayer`, for users' programs.

They add two things to the plain functions of `fresnel.py`, which the package itself uses: results of xarray's labelled
arrays are labelled, too, and an angle that is probably in degrees raises an error.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast, overload

import numpy as np
import numpy.typing as npt

from polysight.polarimetry.fresnel import (
    Complex,
    fresnel as plain_fresnel,
    multilayer as plain_multilayer,
    permittivity_from_ratio as plain_permittivity,
)
from polysight_shared.errors import ConfigError, ErrorCode

if TYPE_CHECKING:
    from xarray import DataArray

Function = TypeVar("Function", bound=Callable[..., Any])
# Values without labels. `ArrayLike` would accept a `DataArray`, too, and hide the first overloads.
Plain = complex | np.generic | npt.NDArray[Any] | Sequence[Any]


class _Fresnel(Protocol):
    """Type of :func:`fresnel`: labelled arrays if one of the arguments is labelled."""

    @overload
    def __call__(self, eps: DataArray, theta_rad: Plain | DataArray) -> tuple[DataArray, DataArray]: ...
    @overload
    def __call__(self, eps: Plain, theta_rad: DataArray) -> tuple[DataArray, DataArray]: ...
    @overload
    def __call__(self, eps: Plain, theta_rad: Plain) -> tuple[Complex, Complex]: ...


class _PermittivityFromRatio(Protocol):
    """Type of :func:`permittivity_from_ratio`: a labelled array if one of the arguments is labelled.

    `p` is the polarisation ratio r_s / r_p.
    """

    @overload
    def __call__(self, p: DataArray, theta_rad: Plain | DataArray) -> DataArray: ...
    @overload
    def __call__(self, p: Plain, theta_rad: DataArray) -> DataArray: ...
    @overload
    def __call__(self, p: Plain, theta_rad: Plain) -> Complex: ...


class _Multilayer(Protocol):
    """Type of :func:`multilayer`: labelled arrays if an argument is labelled, or is a list of labelled arrays.

    The function also returns labelled arrays for a list of labelled and plain entries. The type of such a list cannot
    be distinguished from that of a list of plain entries, so that its result is typed as plain.
    """

    @overload
    def __call__(
        self,
        eps: DataArray | list[DataArray],
        thickness_m: Plain | DataArray,
        frequency_hz: Plain | DataArray,
        theta_rad: Plain | DataArray,
    ) -> tuple[DataArray, DataArray]: ...
    @overload
    def __call__(
        self,
        eps: Plain,
        thickness_m: DataArray | list[DataArray],
        frequency_hz: Plain | DataArray,
        theta_rad: Plain | DataArray,
    ) -> tuple[DataArray, DataArray]: ...
    @overload
    def __call__(
        self, eps: Plain, thickness_m: Plain, frequency_hz: DataArray, theta_rad: Plain | DataArray
    ) -> tuple[DataArray, DataArray]: ...
    @overload
    def __call__(
        self, eps: Plain, thickness_m: Plain, frequency_hz: Plain, theta_rad: DataArray
    ) -> tuple[DataArray, DataArray]: ...
    @overload
    def __call__(
        self, eps: Plain, thickness_m: Plain, frequency_hz: Plain, theta_rad: Plain
    ) -> tuple[Complex, Complex]: ...


def keep_labels(*results: str) -> Callable[[Function], Function]:
    """Decorate a function of arrays that broadcast: with a `DataArray` among its arguments it returns `DataArray`s.

    `results` are the long names of the returned arrays. An argument may be a list of arrays. Dimensions broadcast by
    name; coordinates that arrays share must be equal, otherwise xarray raises a ValueError. Attributes are those of the
    first `DataArray`, with the result's own unit (1) and long name.
    """

    def decorate(function: Function) -> Function:
        @wraps(function)
        def call(*arguments: Any, **named: Any) -> Any:
            # Without an imported xarray no argument can be a DataArray.
            xarray = sys.modules.get("xarray")
            if xarray is None:
                return function(*arguments, **named)
            values = [*arguments, *named.values()]
            entries = [entry for value in values for entry in _list_entries(value)]
            if not any(isinstance(entry, xarray.DataArray) for entry in entries):
                return function(*arguments, **named)

            # xarray passes all arrays as one flat list; `compute` puts them back into the arguments.
            def compute(*arrays: Any) -> Any:
                remaining = iter(arrays)
                filled = [_fill(value, remaining) for value in values]
                keywords = dict(zip(named, filled[len(arguments) :], strict=True))
                return function(*filled[: len(arguments)], **keywords)

            # No result has dimensions other than those of the arguments.
            no_own_dims: list[list[str]] = [[] for _ in results]
            labelled = xarray.apply_ufunc(compute, *entries, output_core_dims=no_own_dims, keep_attrs="override")
            labelled_arrays = labelled if len(results) > 1 else (labelled,)
            for array, name in zip(labelled_arrays, results, strict=True):
                array.attrs |= {"units": "1", "long_name": name}
                array.name = None
            return labelled

        return call  # type: ignore[return-value]

    return decorate


def _list_entries(value: Any) -> list[Any]:
    """Return the entries of a list or tuple; anything else is one entry."""
    return list(value) if isinstance(value, list | tuple) else [value]


def _fill(value: Any, arrays: Iterator[Any]) -> Any:
    """Return the next array, or a list of as many arrays as `value` has entries."""
    if isinstance(value, list | tuple):
        return [next(arrays) for _ in value]
    return next(arrays)


def _refuse_degrees(function: Function) -> Function:
    """Decorate a function of `theta_rad`: raise ConfigError for an angle above pi / 2, which may be in degrees."""

    @wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        theta_rad = inspect.signature(function).bind(*arguments, **named).arguments["theta_rad"]
        largest = np.max(np.abs(np.asarray(theta_rad)), initial=0.0)
        if largest > np.pi / 2:
            raise ConfigError(
                f"theta_rad reaches {largest:g}",
                "an angle of incidence is at most pi / 2 (1.571) radians; this may be in degrees",
                "convert it with numpy.radians, or take `incidence_rad` of an image",
                code=ErrorCode.VALUE_INVALID,
            )
        return function(*arguments, **named)

    return call  # type: ignore[return-value]


_REFLECTION = ("s-polarised reflection coefficient", "p-polarised reflection coefficient")
fresnel: _Fresnel = cast(_Fresnel, _refuse_degrees(keep_labels(*_REFLECTION)(plain_fresnel)))


def _take_arrays_as_one_medium(function: Function) -> Function:
    """Decorate `multilayer`, which takes the first axis of an array as its media: a `DataArray` is a single medium."""

    @wraps(function)
    def call(eps: Any, thickness_m: Any, frequency_hz: Any, theta_rad: Any) -> Any:
        return function(_list_one_medium(eps), _list_one_medium(thickness_m), frequency_hz, theta_rad)

    return call  # type: ignore[return-value]


def _list_one_medium(value: Any) -> Any:
    """Return a `DataArray` in a list of one, anything else unchanged."""
    xarray = sys.modules.get("xarray")
    if xarray is not None and isinstance(value, xarray.DataArray):
        return [value]
    return value


multilayer: _Multilayer = cast(
    _Multilayer, _refuse_degrees(_take_arrays_as_one_medium(keep_labels(*_REFLECTION)(plain_multilayer)))
)
permittivity_from_ratio: _PermittivityFromRatio = cast(
    _PermittivityFromRatio, _refuse_degrees(keep_labels("relative permittivity")(plain_permittivity))
)
