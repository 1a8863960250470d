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
"""Weight of the patches' evidence on the sign of the phases. Patches that are not half spaces may
favour the wrong one: by 5 (natural logarithm) in a scene with liquids behind walls. The plates of the published picture
favour the right one by 4 in total.
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

    `prior_probability` is the probability of the other sign before the patches are considered. The values of the given
    sign are kept; their covariances are those of the mixture of both signs, about these values.
    """
    log_odds = SIGN_EVIDENCE * (mirrored.log_evidence - as_given.log_evidence) + scipy.special.logit(prior_probability)
    probability = float(scipy.special.expit(log_odds))
    if probability < UNLIKELY_SIGN:
        return as_given, probability
    pairs = zip(as_given.patches, mirrored.patches, strict=True)
    patches = tuple(_join_estimates(patch, other_estimate, probability) for patch, other_estimate in pairs)
    return replace(as_given, patches=patches), probability


def _join_estimates(patch: PatchEstimate, other_estimate: PatchEstimate, probability: float) -> PatchEstimate:
    """Return an estimate whose covariances include another one, which is right with this probability."""

    def join(middle: complex, covariance: Real, other_middle: complex, other_covariance: Real) -> Real:
        # Mean square about `middle` of a mixture of two distributions.
        shift = split_complex(other_middle - middle)
        return (1 - probability) * covariance + probability * (other_covariance + np.outer(shift, shift))

    ratio_covariance = join(
        patch.inverse_ratio,
        patch.inverse_ratio_covariance,
        other_estimate.inverse_ratio,
        other_estimate.inverse_ratio_covariance,
    )
    # The evidence contains the ratio that decides the name of the patch.
    evidence = patch.evidence
    if evidence is not None and other_estimate.evidence is not None:
        other = (other_estimate.evidence.inverse_ratio, other_estimate.evidence.covariance)
        cases = tuple(
            replace(case, covariance=join(case.inverse_ratio, case.covariance, *other)) for case in evidence.cases
        )
        joined = join(evidence.inverse_ratio, evidence.covariance, *other)
        evidence = replace(evidence, covariance=joined, cases=cases)
    joined_estimate = replace(patch, inverse_ratio_covariance=ratio_covariance, evidence=evidence)
    if patch.permittivity is None or patch.covariance is None:
        return joined_estimate
    if other_estimate.permittivity is None or other_estimate.covariance is None:
        return joined_estimate
    covariance = join(patch.permittivity, patch.covariance, other_estimate.permittivity, other_estimate.covariance)
    # The share of the sign is its part of the variance; the shares of the other sources become smaller by this factor.
    share_of_others = float(np.trace(patch.covariance) / np.trace(covariance))
    shares = {source: min(share_of_others, 1.0) * share for source, share in patch.shares.items()}
    if shares:
        shares[PHASE_SIGN] = max(0.0, 1.0 - share_of_others)
    half_widths_68 = None
    if patch.half_widths_68 is not None:
        widening = np.sqrt(np.diag(covariance) / np.diag(patch.covariance))
        half_widths_68 = (patch.half_widths_68[0] * float(widening[0]), patch.half_widths_68[1] * float(widening[1]))
    return replace(joined_estimate, covariance=covariance, half_widths_68=half_widths_68, shares=shares)
