"""Why a patch has its name: one sentence for a reader who knows materials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from polysight.host.materials.classify import UNKNOWN, Classifier, NamedPatch
from polysight.host.materials.permittivity import format_permittivity


def add_explanation(
    named: NamedPatch, permittivity: complex | None, covariance: npt.NDArray[np.float64] | None, classifier: Classifier
) -> NamedPatch:
    """The same patch with the reason of its name.

    Parameters
    ----------
    named
        As the classifier named it.
    permittivity, covariance
        eps' - j eps'' of the patch, and [2, 2] of its real and imaginary part; None where it has none.
    classifier
        Whose library is compared with.
    """
    name = named.verdict
    known, found = classifier.permittivities, _estimate(permittivity, covariance)
    nearest = name.name if name.name != UNKNOWN else name.nearest
    like = "" if nearest is None else _with_permittivity(nearest, known.get(nearest))
    if name.name == UNKNOWN:
        near = f"; nearest: {like}" if like else ""
        why = f"not in the library: {found}{near}" if found else f"not in the library{near}"
    else:
        others = [f"{n} {100 * p:.0f} %" for n, p in name.probabilities.items() if n not in (name.name, UNKNOWN)][:2]
        told = f"{found} is what the library's {like} looks like" if found else f"it looks like the library's {like}"
        alone = "; no other material comes near" if name.probabilities else ""  # neighbours alone do not tell
        why = told + (f"; it could also be {' or '.join(others)}" if others else alone)
    return replace(named, verdict=replace(name, why=why))


def _estimate(permittivity: complex | None, covariance: npt.NDArray[np.float64] | None) -> str:
    if permittivity is None:
        return ""
    text = f"permittivity {format_permittivity(permittivity)}"
    if covariance is None or not np.isfinite(covariance).all():
        return text
    real, loss = np.sqrt(np.diag(covariance))
    return f"{text} (+- {real:.2f}, {loss:.2f})"


def _with_permittivity(name: str, permittivity: complex | None) -> str:
    return name if permittivity is None else f"{name} ({format_permittivity(permittivity)})"
