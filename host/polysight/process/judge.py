"""Form the verdict on a processed scan, and the error budget of its results.

The rules in `results` make a finding of a figure; this module takes the figures from the recording (`Quality`) and from
the scene (`MaterialsResult`) and applies them. The reasons of the verdict are the findings that lower it.
"""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
import numpy.typing as npt

from polysight.imaging import PlaneEstimate
from polysight.materials import NOT_PASSIVE, SMEAR, STRONGER_V_REASON, Classifier, MaterialsResult, find_copies
from polysight.process.quality import Quality, RowFigures
from polysight.results import (
    ErrorBudget,
    IncidenceError,
    LeakageError,
    MetalScore,
    PlaneError,
    Verdict,
    check_plate,
    check_reasons,
    join_reasons,
    row_rules,
    rules,
)
from polysight_shared.config import CheckPlate
from polysight_shared.findings import Finding


def recording_verdict(quality: Quality) -> list[Finding]:
    """Return reasons from recording and synchronisation: rows, frames, manifest, and the direct path of each board."""
    coverage = quality.coverage()
    # With RX in another order the direct path is lost, so that positions are masked: these are not reported, too.
    boards_in_order = [board for board in quality.boards.values() if not board.rx_order]
    positions = sum(b.positions for b in boards_in_order)
    masked = sum(b.positions_masked for b in boards_in_order)
    missing = row_rules.judge_displaced_rows(quality.find_displaced_rows().rms_mm)
    if quality.drift is not None:
        missing += row_rules.judge_phase_drift(quality.drift.range_rad, quality.drift.left_rad)
    jumps = {
        name: of_board for name, of_board in quality.find_phase_jumps().items() if not quality.boards[name].rx_order
    }
    missing += row_rules.judge_phase_jumps(jumps)
    for name, board in quality.boards.items():
        if board.rx_order:
            missing += rules.judge_rx_order(name, board.rx_order)
            continue
        share_with_path = _divide(board.positions - board.positions_masked, board.positions, default=0.0)
        received = _divide(board.frames_received, board.frames_expected, default=0.0)
        # Positions without a whole frame have no direct path either: count only those that were received.
        share_of_received = _divide(share_with_path, received, default=1.0)
        missing += rules.judge_direct_path(name, board.direct_snr_db, board.residual("averaged"), share_of_received)
        missing += _report_disturbances(name, list(board.figures.values()))
        missing += rules.judge_dead_rx(name, board.dead_rx, len(board.rows))
    share_masked = _divide(masked, positions, default=0.0 if len(boards_in_order) < len(quality.boards) else 1.0)
    recorded = rules.judge_recording(coverage, share_masked, is_filled=bool(quality.filled))
    filled = [(board, e.missing_share, e.image_error) for board, e in quality.filled.items()]
    return recorded + missing + rules.judge_reconstruction(filled)


def _divide(part: float, whole: float, default: float) -> float:
    """Return part / whole; `default` if there is no whole."""
    if not whole:
        return default
    return part / whole


def _report_disturbances(name: str, rows: list[RowFigures]) -> list[Finding]:
    """Return reasons from the chirps of a board that were left out."""
    chirps = sum(r.frames_received for r in rows)
    positions = sum(r.positions for r in rows)
    clipped = sum(r.chirps_clipped for r in rows)
    disturbed = sum(r.chirps_disturbed for r in rows)
    positions_clipped = sum(r.positions_clipped for r in rows)
    return rules.judge_left_out_chirps(
        name,
        clipped=clipped / max(1, chirps),
        disturbed=disturbed / max(1, chirps),
        positions_clipped=positions_clipped / max(1, positions),
    )


def judge(
    quality: Quality,
    result: MaterialsResult,
    plane: PlaneEstimate | None,
    classifier: Classifier | None,
    check: CheckPlate,
) -> Verdict:
    """Return the verdict on a processed scan.

    Parameters
    ----------
    quality
        Figures of all rows.
    result
        Patches, metal reference and joint inversion.
    plane
        Plane of the plates; None if it was not estimated.
    classifier
        The classifier that named the patches; None without naming.
    check
        The rig file's plate of known permittivity.
    """
    reasons = recording_verdict(quality)
    if any(board.rx_order for board in quality.boards.values()):
        # The board's image is wrong: whatever the scene shows is a consequence.
        return join_reasons(reasons)
    tilt_deg = (0.0, 0.0)
    if "metal_reference" in quality.notes:
        tilt_deg = quality.notes["metal_reference"].tilt_deg
    reasons += scene_reasons(
        result, plane, classifier, tilt_deg, has_gaps=quality.lacks_positions, has_drift=quality.drift is not None
    )
    if check.name:
        reasons += check_reasons(check_plate(check, result.rows()))
    return join_reasons(reasons)


def scene_reasons(
    result: MaterialsResult,
    plane: PlaneEstimate | None,
    classifier: Classifier | None,
    reference_tilt_deg: tuple[float, float] = (0.0, 0.0),
    has_gaps: bool = False,
    has_drift: bool = False,
) -> list[Finding]:
    """Return reasons from the scene and its images; parameters are those of :func:`judge`.

    `reference_tilt_deg` is the tilt of a metal plate that was scanned separately. `has_gaps`: positions have no data,
    and were not reconstructed. `has_drift`: a drift of the phase was removed.
    """
    reasons: list[Finding] = []
    refused = {r.patch.label: r.refused.what for r in result.patches if r.refused is not None}
    no_half_spaces = _find_no_half_spaces(result)
    smears = {label: SMEAR for label, what in refused.items() if what == SMEAR.what}
    objects = [r.patch for r in result.patches if r.patch.label not in smears]
    no_plates = {k: v for k, v in refused.items() if k not in no_half_spaces and k not in smears}
    # Patches and images.
    left_out = result.segmentation.left_out
    usable = max(1, int(result.calibrated.usable.sum()))
    filled_share = max((float(mask.sum()) / usable for mask in left_out), default=0.0)
    reasons += rules.judge_patches(no_plates, len(objects), len(left_out), filled_share)
    reasons += rules.judge_smears(smears)
    pixel_mm = abs(float(result.calibrated.x_m[1] - result.calibrated.x_m[0])) * 1e3
    copies = find_copies(objects, result.calibrated.h, result.calibrated.v, pixel_mm)
    if copies is not None:
        reasons += rules.judge_copies(copies.labels, copies.shift_mm, copies.level_db, has_gaps)
    reasons += rules.judge_image_shift(result.apart_mm, has_drift)
    if result.drift is not None:
        reasons += rules.judge_drift(*result.drift.largest_drift(), result.drift.drifts)
        reasons += rules.judge_fringes(result.drift.fringes, has_gaps, result.behind)
    reasons += rules.judge_halo(result.halo)
    reasons += rules.judge_background(result.behind)
    reasons += rules.judge_flatness(result.ripple, result.relief_rad, bool(result.boxes), has_gaps)
    reasons += rules.judge_disturbed_plates(result.errors_by_disturbance(), has_gaps)
    reasons += rules.judge_passivity(no_half_spaces)
    # Many plates with more V than H: the channels may be exchanged.
    plates = len(result.patches) - len(no_plates) - (result.metal.label is not None)
    reasons += rules.judge_exchange([k for k, v in no_half_spaces.items() if v.what == STRONGER_V_REASON], plates)
    reasons += _judge_metal(result, refused)
    # Levels of metal relative to the direct path, boards, leakage, and the plane.
    light = result.calibrated.illumination
    if result.prior.channels_known and (light is None or light.known):
        gains = {"H": result.calibrated.metal_h, "V": result.calibrated.metal_v}
        reasons += rules.judge_levels({channel: _measure_median_level(gain) for channel, gain in gains.items()})
    tilted = rules.judge_reference_tilt(reference_tilt_deg)
    # A tilted reference looks like boards that have turned.
    reasons += tilted or rules.judge_moved_boards(result.inversion.moved)
    reasons += rules.judge_leakage(
        result.prior.leakage_measured, result.inversion.leakage_determined, _estimate_leakage_error(result)
    )
    if plane is not None:
        std = float(np.degrees(result.prior.theta_std_rad))
        tilt = (float(np.degrees(plane.tilt_rad[0])), float(np.degrees(plane.tilt_rad[1])))
        tilt_std = (float(np.degrees(plane.tilt_std_rad[0])), float(np.degrees(plane.tilt_std_rad[1])))
        reasons += rules.judge_plane(plane.known, 1e3 * plane.offset_m, tilt, std, tilt_std)
    # Plates that have a permittivity: their tilts and brightness, and the angle of the library.
    judged = {r.patch.label for r in result.patches if r.refused is None}
    reasons += rules.judge_tilts({k: float(np.degrees(result.tilts.across_rad(k))) for k in judged})
    reasons += rules.judge_brightness({k: ln for k, ln in result.brightness_off.items() if k in judged})
    if classifier is not None and len(classifier.angles_deg) == 1:
        angle = float(np.degrees(np.mean(result.theta_rad)))
        reasons += rules.judge_incidence(angle, float(classifier.angles_deg[0]))
    return reasons


def _judge_metal(result: MaterialsResult, refused: Mapping[int, str]) -> list[Finding]:
    """Return reasons from the metal reference; `refused`: number of a patch to why it has no permittivity."""
    reasons: list[Finding] = []
    metal = result.metal
    if result.patches and metal.evidence is not None:
        evidence = metal.evidence
        patch = "the given box" if metal.label is None else f"patch {metal.label}"
        has_enough_evidence = evidence.enough and (metal.given or metal.label not in refused)
        reasons += rules.judge_metal(
            patch,
            is_likely=has_enough_evidence,
            is_certain=has_enough_evidence and evidence.sure,
            is_given=metal.given,
            contradicted=evidence.against,
            only_patch=evidence.others == 0,
            culprit=evidence.culprit,
            painted=result.inversion.painted,
            paint_mm=result.inversion.paint_mm,
        )
        if metal.given:
            reasons += rules.judge_dark_reference(patch, *_find_brightest(result))
    return reasons


def _find_no_half_spaces(result: MaterialsResult) -> dict[int, Finding]:
    """Return patch number to the reason why a patch is a plate but no half space (not noise or several materials)."""
    return {
        r.patch.label: r.refused
        for r in result.patches
        if r.refused is not None
        and (
            r.refused.what == STRONGER_V_REASON or (r.refused.what in NOT_PASSIVE and r.permittivity.value is not None)
        )
    }


def _find_brightest(result: MaterialsResult) -> tuple[int, float]:
    """Return the number of the brightest patch but the metal, and its median |H| relative to metal, dB; 0, 0: none."""
    levels_db = {}
    for patch_result in result.patches:
        h = np.abs(result.h[patch_result.patch.interior])
        levels = h[np.isfinite(h) & (h > 0)]
        if levels.size and patch_result.patch.label != result.metal.label:
            levels_db[patch_result.patch.label] = 20 * float(np.log10(np.median(levels)))
    brightest = max(levels_db, key=lambda label: levels_db[label], default=0)
    return brightest, levels_db.get(brightest, 0.0)


def _measure_median_level(gain: npt.NDArray[np.complexfloating] | complex | None) -> float | None:
    """Return the median magnitude of metal's gain where it is known; None if it is known nowhere.

    `gain` is a number, or an image [ny, nx] that a plate need not cover.
    """
    if gain is None:
        return None
    magnitude = np.abs(np.asarray(gain))
    magnitude = magnitude[np.isfinite(magnitude)]
    if magnitude.size == 0:
        return None
    return float(np.median(magnitude))


def _estimate_leakage_error(result: MaterialsResult) -> float:
    """Return the median relative error of the permittivities due to leakage; 0 without permittivities."""
    parts = []
    for patch_result in result.patches:
        estimate = patch_result.permittivity
        if estimate.value is not None and estimate.covariance is not None and estimate.shares:
            share = estimate.shares.get("leakage", 0.0)
            parts.append(float(np.sqrt(share * np.trace(estimate.covariance) / 2)) / abs(estimate.value))
    if parts:
        return float(np.median(parts))
    return 0.0


def error_budget(result: MaterialsResult, plane: PlaneEstimate | None) -> ErrorBudget:
    """Return `error_budget` of materials.json: leakage, incidence angle, plane and evidence for metal."""
    inversion = result.inversion
    source = "prior and scene"
    if result.prior.leakage_measured:
        source = "measured"
    elif inversion.leakage_determined:
        source = "scene"
    evidence = result.metal.evidence
    metal = None
    if evidence is not None:
        ratio_db = evidence.channel_ratio_db
        if ratio_db is not None:
            ratio_db = round(ratio_db, 2)
        metal = MetalScore(
            score=round(evidence.score, 2),
            others=evidence.others,
            channel_ratio_db=ratio_db,
            painted=round(inversion.painted, 3),
            paint_mm=round(inversion.paint_mm, 3),
        )
    leakage_h, leakage_v = inversion.leakage
    removed_h, removed_v = inversion.choose_leakage_to_remove(result.prior)
    std_h, std_v = inversion.leakage_std
    angle_deg = float(np.degrees(np.mean(result.theta_rad) + inversion.theta_error_rad))
    angle_std_deg = float(np.degrees(inversion.theta_std_rad))
    plane_error = PlaneError()
    if plane is not None:
        plane_error = msgspec.convert(plane.to_dict(), PlaneError)
    return ErrorBudget(
        leakage=LeakageError(
            h=_round_complex(leakage_h),
            v=_round_complex(leakage_v),
            std=(round(std_h, 5), round(std_v, 5)),
            source=source,
            removed_h=_round_complex(removed_h),
            removed_v=_round_complex(removed_v),
        ),
        incidence=IncidenceError(deg=round(angle_deg, 4), std_deg=round(angle_std_deg, 4)),
        plane=plane_error,
        metal=metal,
    )


def _round_complex(value: complex) -> tuple[float, float]:
    """Return real and imaginary part, rounded for the file."""
    return round(value.real, 5), round(value.imag, 5)
