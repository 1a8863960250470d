"""Verdict on a processed scan, from the evidence of recording, rig and scene; error budget of its results."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from polysight.imaging import PlaneEstimate
from polysight.materials import NOT_PASSIVE, Classifier, MaterialsResult
from polysight.process.quality import Quality
from polysight.results import (
    ErrorBudget,
    IncidenceError,
    LeakageError,
    MetalScore,
    PlaneError,
    Verdict,
    brightness_reasons,
    direct_path_reasons,
    incidence_reasons,
    leakage_reasons,
    level_reasons,
    metal_reasons,
    passivity_reasons,
    plane_reasons,
    recording_reasons,
    signal_reasons,
    tilt_reasons,
    verdict_of,
)
from polysight_shared.findings import Finding


def recording_verdict(quality: Quality) -> list[Finding]:
    """Return reasons from recording and synchronisation: rows, frames, manifest, and the direct path of each board."""
    coverage = quality.coverage()
    positions = sum(b.positions for b in quality.boards.values())
    masked = sum(b.positions_masked for b in quality.boards.values())
    missing: list[Finding] = []
    for name, board in quality.boards.items():
        share = 1 - board.positions_masked / board.positions if board.positions else 0.0
        # Positions without a whole frame have no direct path either; do not count that loss twice.
        received = board.frames_share
        missing += direct_path_reasons(
            name, board.direct_snr_db, board.residual("averaged"), share / received if received else 1.0
        )
    recorded = recording_reasons(coverage, masked / positions if positions else 1.0)
    return recorded + missing


def judge(
    quality: Quality, found: MaterialsResult, plane: PlaneEstimate | None, classifier: Classifier | None
) -> Verdict:
    """Return the verdict on a processed scan.

    Parameters
    ----------
    quality
        Figures of all rows.
    found
        Patches, metal reference and joint inversion.
    plane
        Plane of the plates; None if it was not estimated.
    classifier
        The classifier that named the patches; None without naming.
    """
    reasons = recording_verdict(quality)
    refused = {r.patch.label: r.refused.what for r in found.patches if r.refused is not None}
    gaining = {
        r.patch.label: r.refused.what
        for r in found.patches
        if r.refused is not None and r.refused.what in NOT_PASSIVE and r.permittivity.value is not None
    }
    reasons += signal_reasons({k: v for k, v in refused.items() if k not in gaining}, len(found.patches))
    reasons += passivity_reasons(gaining)
    metal = found.metal
    if found.patches and metal.evidence is not None:
        e, patch = metal.evidence, "the given box" if metal.label is None else f"patch {metal.label}"
        enough = e.enough and (metal.given or metal.label not in refused)
        reasons += metal_reasons(patch, enough, enough and e.sure, metal.given, e.against, e.others == 0)
    if found.prior.channels_known:
        gains = {"H": found.calibrated.metal_h, "V": found.calibrated.metal_v}
        reasons += level_reasons({channel: _median_level(gain) for channel, gain in gains.items()})
    reasons += leakage_reasons(found.prior.leakage_measured, found.inversion.leakage_determined, _leakage_error(found))
    if plane is not None:
        std = float(np.degrees(found.prior.theta_std_rad))
        tilt = (float(np.degrees(plane.tilt_rad[0])), float(np.degrees(plane.tilt_rad[1])))
        reasons += plane_reasons(plane.known, 1e3 * plane.offset_m, tilt, std)
    judged = {r.patch.label for r in found.patches if r.refused is None}
    reasons += tilt_reasons({k: float(np.degrees(found.tilts.across_rad(k))) for k in judged})
    reasons += brightness_reasons({k: ln for k, ln in found.brightness_off.items() if k in judged})
    if classifier is not None and len(classifier.angles_deg) == 1:
        angle = float(np.degrees(np.mean(found.theta_rad)))
        reasons += incidence_reasons(angle, float(classifier.angles_deg[0]))
    return verdict_of(reasons)


def _median_level(gain: npt.NDArray[np.complexfloating] | complex | None) -> float | None:
    """Median of metal's magnitude where it is known; a reference plate need not cover the image. None: nowhere."""
    if gain is None:
        return None
    magnitude = np.abs(np.asarray(gain))
    known = magnitude[np.isfinite(magnitude)]
    return float(np.median(known)) if known.size else None


def _leakage_error(found: MaterialsResult) -> float:
    """Return the median relative error of the permittivities due to leakage; 0 without permittivities."""
    parts = []
    for r in found.patches:
        e = r.permittivity
        if e.value is not None and e.covariance is not None and e.shares:
            share = e.shares.get("leakage", 0.0) + e.shares.get("brightness", 0.0)
            parts.append(float(np.sqrt(share * np.trace(e.covariance) / 2)) / abs(e.value))
    return float(np.median(parts)) if parts else 0.0


def error_budget(found: MaterialsResult, plane: PlaneEstimate | None) -> ErrorBudget:
    """Return `error_budget` of materials.json: leakage, incidence angle, plane and evidence for metal."""
    i, prior = found.inversion, found.prior
    source = "prior and scene"
    if prior.leakage_measured:
        source = "measured"
    elif i.leakage_determined:
        source = "scene"
    evidence = found.metal.evidence
    metal = None
    if evidence is not None:
        ratio_db = evidence.channel_ratio_db
        ratio_db = None if ratio_db is None else round(ratio_db, 2)
        metal = MetalScore(score=round(evidence.score, 2), others=evidence.others, channel_ratio_db=ratio_db)
    angle = float(np.degrees(np.mean(found.theta_rad) + i.theta_error_rad))
    return ErrorBudget(
        leakage=LeakageError(
            h=(round(i.leakage[0].real, 5), round(i.leakage[0].imag, 5)),
            v=(round(i.leakage[1].real, 5), round(i.leakage[1].imag, 5)),
            std=(round(i.leakage_std[0], 5), round(i.leakage_std[1], 5)),
            source=source,
        ),
        incidence=IncidenceError(deg=round(angle, 4), std_deg=round(float(np.degrees(i.theta_std_rad)), 4)),
        plane=PlaneError() if plane is None else msgspec.convert(plane.to_dict(), PlaneError),
        metal=metal,
    )
