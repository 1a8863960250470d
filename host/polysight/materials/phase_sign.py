"""The sign of all phases of images that another program made: an unknown of their analysis, and a part of its errors.

With the wrong sign every loss is a gain. The joint inversion is solved with either sign; the evidence of the patches
shows which one is more probable; the errors include both, weighted by their probability. An `inverse_ratio` is V / H,
after all corrections r_p / r_s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.inversion import Inversion, RigPrior
from polysight.materials.kinds import PatchEstimate, PatchMeasurement, split_complex

Real = npt.NDArray[np.float64]

PHASE_SIGN = "phase sign"
SIGN_EVIDENCE = 0.5
"""Weight of the patches' evidence on the sign of the phases. Patches that are not half spaces may speak for the wrong
one: by 5 (natural logarithm) where liquids stood behind walls; the plates of the published picture speak by 4 in all.
"""
UNLIKELY_SIGN = 0.005
"""Probability of the other sign of the phases below which it is left out of the errors. Chosen: the intervals
given hold 68 and 95 %."""


def mirror_phases(measured: Sequence[PatchMeasurement], prior: RigPrior) -> tuple[list[PatchMeasurement], RigPrior]:
    """Return the patches and the prior for the other sign of all phases.

    Tilts are read from phases, too. The change over the sweep stays: images of other programs have none.
    """
    patches = [
        replace(patch, inverse_ratio=patch.inverse_ratio.conjugate(), rise=(-patch.rise[0], -patch.rise[1]))
        for patch in measured
    ]
    along, across = prior.metal_rise
    return patches, replace(prior, metal_rise=(-along, -across))


def join_signs(as_given: Inversion, mirrored: Inversion, prior_probability: float) -> tuple[Inversion, float]:
    """Return the solution with the errors by an unknown sign of all phases, and the probability of the other sign.

    `prior_probability` is that of the other sign before any patch was looked at. Values stay those of the sign as
    given; their covariances are those of both signs together, about these values.
    """
    log_odds = SIGN_EVIDENCE * (mirrored.log_evidence - as_given.log_evidence) + scipy.special.logit(prior_probability)
    probability = float(scipy.special.expit(log_odds))
    if probability < UNLIKELY_SIGN:
        return as_given, probability
    pairs = zip(as_given.patches, mirrored.patches, strict=True)
    patches = tuple(_join_estimates(patch, other, probability) for patch, other in pairs)
    return replace(as_given, patches=patches), probability


def _join_estimates(patch: PatchEstimate, other: PatchEstimate, probability: float) -> PatchEstimate:
    """Return an estimate whose covariances hold another one, which is the right one with this probability."""

    def join(middle: complex, covariance: Real, other_middle: complex, other_covariance: Real) -> Real:
        # Mean square about `middle` of a mixture of two distributions.
        shift = split_complex(other_middle - middle)
        return (1 - probability) * covariance + probability * (other_covariance + np.outer(shift, shift))

    ratio_covariance = join(
        patch.inverse_ratio, patch.inverse_ratio_covariance, other.inverse_ratio, other.inverse_ratio_covariance
    )
    # The ratio by which the patch gets its name.
    evidence = patch.evidence
    if evidence is not None and other.evidence is not None:
        joined = join(
            evidence.inverse_ratio, evidence.covariance, other.evidence.inverse_ratio, other.evidence.covariance
        )
        evidence = replace(evidence, covariance=joined)
    joined_estimate = replace(patch, inverse_ratio_covariance=ratio_covariance, evidence=evidence)
    if patch.permittivity is None or patch.covariance is None:
        return joined_estimate
    if other.permittivity is None or other.covariance is None:
        return joined_estimate
    covariance = join(patch.permittivity, patch.covariance, other.permittivity, other.covariance)
    # What the sign adds to the variance is its share; the shares of the other sources shrink accordingly.
    share_of_others = float(np.trace(patch.covariance) / np.trace(covariance))
    shares = {source: min(share_of_others, 1.0) * share for source, share in patch.shares.items()}
    if shares:
        shares[PHASE_SIGN] = max(0.0, 1.0 - share_of_others)
    half_widths_68 = None
    if patch.half_widths_68 is not None:
        wider = np.sqrt(np.diag(covariance) / np.diag(patch.covariance))
        half_widths_68 = (patch.half_widths_68[0] * float(wider[0]), patch.half_widths_68[1] * float(wider[1]))
    return replace(joined_estimate, covariance=covariance, half_widths_68=half_widths_68, shares=shares)
