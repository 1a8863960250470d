"""Estimate the error common to all patches of a scan, together with the materials of the patches.

A leakage or gain error moves all patches alike, and a patch gives information on it only if its material is known. So
the error and the materials are estimated in turns (expectation maximisation). If the library's materials lie in a row,
a common error can shift every plate to its neighbour and fit nearly as well; iterations that start at zero error find
only one of these explanations. Here they start at the error that would make any one patch any one material, and each
explanation found is weighted with its evidence (Laplace's approximation; MacKay, Information Theory, Inference, and
Learning Algorithms, chapter 27).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from polysight.materials.samples import Real

_ROUNDS, _FIRST_ROUNDS = 30, 3
_TURNS = 2  # alternations of the error and the likelihood of none of the materials
_STARTS, _TRIED = 100, 6  # the most plausible starts, and the best of them for all patches
_UNLIKELY = 12.0  # log evidence below the best one's, after the first rounds, to drop an explanation
_SAME = 1.0  # standard deviations within which two explanations are the same
_LN_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class CommonError:
    """An error common to the patches of a scan, with its covariance and its effect on each patch.

    `design` [patch, d, q] converts the error's q numbers to deviations; `value` [q]; `covariance` [q, q]; `precision`
    [q, q] is that of the prior.
    """

    design: Real
    value: Real
    covariance: Real
    precision: Real

    @property
    def shift(self) -> Real:
        """Deviations by the error, [patch, d]."""
        return np.asarray(self.design @ self.value, np.float64)

    @property
    def spread(self) -> Real:
        """Their covariances, [patch, d, d]."""
        return np.asarray(self.design @ self.covariance @ self.design.mT, np.float64)


@dataclass(frozen=True)
class Patches:
    """Deviations of patches from materials.

    `mean` [patch, materials, d] of their means, `own` [patch, materials, d, d] the covariances of the patches' own
    errors, `informative` bool [patch]: usable to estimate the common error.
    """

    mean: Real
    own: Real
    informative: npt.NDArray[np.bool_]


def explanations(
    seen: Patches, before: CommonError, none: Callable[[CommonError], Real]
) -> list[tuple[float, CommonError]]:
    """Return the common errors that explain a scan, each with its probability, the likeliest first.

    `before` is the prior of the error; `none` returns minus twice the log likelihood [patch] of none of the materials
    under an error. With fewer than two informative patches the result is the prior.
    """
    at = np.flatnonzero(seen.informative)
    if at.size < 2:
        return [(1.0, before)]
    cost = none(before)
    first = [_alternate(seen, start, cost, _FIRST_ROUNDS) for start in (before, *_starts(seen, before, cost))]
    found: list[tuple[float, CommonError]] = []
    for evidence, start in _distinct([(_evidence(seen, e, cost), e) for e in first]):
        if found and evidence < found[0][0] - _UNLIKELY:
            continue
        error, cost_of_none = start, cost
        for _ in range(_TURNS):
            cost_of_none = none(error)
            error = _alternate(seen, error, cost_of_none, _ROUNDS)
        found.append((_evidence(seen, error, cost_of_none), error))
    found = _distinct(found)
    weight = np.exp(np.array([e for e, _ in found]) - found[0][0])
    return [(float(w), error) for w, (_, error) in zip(weight / weight.sum(), found, strict=True)]


def costs(d: Real, covariances: Real) -> tuple[Real, Real]:
    """Return squared distances and minus twice the log likelihoods of deviations [n, materials, d], [n, materials]."""
    inverse = np.linalg.inv(covariances)
    q = np.sum(d * (inverse @ d[..., None])[..., 0], axis=-1)
    return q, q - np.linalg.slogdet(inverse)[1] + d.shape[2] * _LN_2PI


def probabilities(cost: Real, none: Real) -> Real:
    """Return the probability of every material and, last, of none of them, [n, materials + 1]."""
    every = np.concatenate([cost, none[:, None]], axis=1)
    w = np.exp(-0.5 * (every - every.min(axis=1, keepdims=True)))
    return w / w.sum(axis=1, keepdims=True)


def _starts(seen: Patches, before: CommonError, none: Real) -> list[CommonError]:
    """Return start values: the error that makes one patch one material, for the best of all such pairs."""
    at = np.flatnonzero(seen.informative)
    mean, g = seen.mean[at], before.design[at][:, None]  # [patch, materials, d], [patch, 1, d, q]
    inverse = np.linalg.inv(seen.own[at])
    constant = -np.linalg.slogdet(inverse)[1] + mean.shape[2] * _LN_2PI
    weighed = g.mT @ inverse
    covariance = np.linalg.inv(before.precision + weighed @ g)
    value = (covariance @ weighed @ mean[..., None])[..., 0]

    def distances(errors: Real) -> Real:
        """Squared distances [..., patch, materials] under errors [..., q], and of the errors themselves [...]."""
        off = mean - (before.design[at] @ errors[..., None, :, None])[..., None, :, 0]
        return np.einsum("...pkd,pkde,...pke->...pk", off, inverse, off, optimize=True)

    prior = np.einsum("pkq,qr,pkr->pk", value, before.precision, value)
    own = (mean - (g @ value[..., None])[..., 0])[..., None]
    surprise = prior + (own.mT @ inverse @ own)[..., 0, 0]
    nearest = np.unravel_index(np.argsort(surprise, axis=None)[:_STARTS], surprise.shape)
    each = 0.5 * distances(value[nearest]) + constant  # half: the start is about as uncertain as a patch
    fit = np.minimum(each.min(axis=-1), none[at]).sum(axis=-1) + prior[nearest]
    starts = zip(fit, value[nearest], covariance[nearest], strict=True)
    found = [(-float(f), replace(before, value=v, covariance=c)) for f, v, c in starts]
    return [error for _, error in _distinct(found, _TRIED)]


def _alternate(seen: Patches, error: CommonError, none: Real, rounds: int) -> CommonError:
    """Estimate the error from the patches' deviations, alternating with the probabilities of their materials.

    Patches that are probably none of the materials have little weight.
    """
    at = np.flatnonzero(seen.informative)
    design, precision, g = error.design, error.precision, error.design[at]
    mean, own = seen.mean[at], seen.own[at]
    for _ in range(rounds):
        _, cost = costs(mean - error.shift[at][:, None], own + error.spread[at][:, None])
        middle, information = _moments(mean, own, probabilities(cost, none[at])[:, :-1])
        covariance = np.linalg.inv(precision + np.sum(g.mT @ information @ g, axis=0))
        combined = np.sum(g.mT @ (information @ middle[:, :, None]), axis=0)[:, 0]
        before, value = error.value, covariance @ combined
        error = CommonError(design, value, covariance, precision)
        if np.abs(design @ (value - before)).max() < 1e-7:
            break
    return error


def _evidence(seen: Patches, error: CommonError, none: Real) -> float:
    """Return the log evidence of an explanation up to a constant, by Laplace's approximation."""
    at = np.flatnonzero(seen.informative)
    _, cost = costs(seen.mean[at] - error.shift[at][:, None], seen.own[at])
    every = -0.5 * np.concatenate([cost, none[at, None]], axis=1)
    top = every.max(axis=1)
    likelihood = float(np.sum(top + np.log(np.exp(every - top[:, None]).sum(axis=1))))
    prior = -0.5 * float(error.value @ error.precision @ error.value)
    return likelihood + prior + 0.5 * float(np.linalg.slogdet(error.covariance)[1])


def _distinct(found: list[tuple[float, CommonError]], most: int | None = None) -> list[tuple[float, CommonError]]:
    """Drop explanations that equal a likelier one; return at most `most`, the likeliest first."""
    out: list[tuple[float, CommonError]] = []
    for evidence, error in sorted(found, key=lambda f: -f[0]):
        if len(out) == most:
            break
        apart = [(error.value - kept.value, np.linalg.inv(kept.covariance)) for _, kept in out]
        if all(float(a @ inverse @ a) > _SAME**2 for a, inverse in apart):
            out.append((evidence, error))
    return out


def _moments(d: Real, covariances: Real, weight: Real) -> tuple[Real, Real]:
    """Return mean deviation [patch, d] and information [patch, d, d] of patches of uncertain material.

    They are those of the normal distribution with the moments of the mixture, less if it may be none of the materials.
    """
    known, weight = weight.sum(axis=1), weight + 1e-12
    share = weight / weight.sum(axis=1, keepdims=True)
    middle = np.einsum("pk,pkd->pd", share, d)
    off = d - middle[:, None]
    spread = np.einsum("pk,pkde->pde", share, covariances + off[..., :, None] * off[..., None, :])
    return middle, np.asarray(known[:, None, None] * np.linalg.inv(spread), np.float64)
