"""The rules of the verdict: each function turns one kind of evidence into findings, none if the evidence is good.

A finding says what was found, why it matters and what to do; `join_reasons` joins them to a verdict. Its level is
`none`, no result (limits with NONE), or `care`, use the result with care (limits with CARE). All limits are constants
of this module, chosen where no source is given. The chosen `weight` of a finding orders those of one level, largest
first. P is H / V relative to metal.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from polysight.results.verdict import Coverage, is_known, reason
from polysight_shared.findings import Finding

FILLED_SHARE = 0.5
"""Share of the image's pixels in one region that is no patch, above which it fills the image."""
FEW_POSITIONS = 0.5
"""Share of positions that are absent, masked or without a direct path, above which there is no result."""
SOME_POSITIONS = 0.005
"""Share of masked, reconstructed or clipped positions above which the result needs care."""
SOME_CHIRPS = 0.05
"""Share of chirps left out as clipped or disturbed above which the result needs care."""
RECONSTRUCTION_NONE = 0.15
"""Expected error of an image with reconstructed positions, above which there is no result. True errors of points stay
below twice the expected ones (tests/imaging/test_sparse.py); those of nine simulated plates were 0.1 to 1.2 times."""
DIRECT_SNR_NONE_DB = -14.0
"""Direct path over noise in one sample of one chirp and channel, below which it counts as missing."""
DIRECT_SNR_CARE_DB = 0.0
"""Ratio below which the direct path counts as weak. The simulated rig has 5.5 dB, as the phase errors of the
POLySIGHT paper suggest."""
DIRECT_LEVELS = (0.4, 3.0)
"""Range of metal's brightness relative to the direct path; in published data both are equal within a factor of 1.5."""
DIRECT_PHASE_CARE_RAD = 0.05
"""Standard deviation of the object's phase from position to position; usually 0.004."""
PLANE_FAR_MM = 3.0
PLANE_TILT_DEG = 0.5
"""Distance and tilt of the plates' plane against the rig file, above which the result needs care."""
PLANE_GATE_MM = 13.0
"""Distance at which the plates lie at the edge of the range gate."""
IMAGE_SHIFT_MM = 1.0
"""Distance of the images of H and V above which boards are out of place; undisturbed scenes have up to 0.6 mm."""
DRIFT_CARE = 0.035
"""Drift of ln(V / H) between plates above which the result needs care, each part."""
DRIFT_LIKELY = 0.9
"""Probability of a drift above which it is reported. Below it may as well be slopes of the plates themselves: the
errors contain it. It is reported for two of 40 undisturbed scenes of the independent generator, for seven without this
limit."""
HALO_CARE = 0.005
"""Halo of V around the metal above which a receiver is overdriven."""
BACKGROUND_CARE = 0.04
"""Error of P by objects behind the plates above which the result needs care: about 3 % of a permittivity."""
RIPPLE_CARE = 0.03
"""Scatter of V / H inside plates above which the result needs care; undisturbed scenes have up to 0.012."""
DISTURBED_CARE = 0.025
"""Error of a permittivity by slopes of V / H within its own plate, above which the verdict reports the plate. In 40
undisturbed scenes of the independent generator it is 0.009 at most, above 0.025 in nine of twelve with a second
path."""
FRINGES_CARE = 0.5
"""Probability of fringes above which they are reported: undisturbed scenes have less than 0.01."""
MOVED_CARE = 0.9
"""Probability that boards have turned above which it is reported; its prior is a half. With 0.8 two of eight
undisturbed scenes of another author's generator exceeded that (0.81 and 0.87)."""
RELIEF_CARE_RAD = 0.035
"""Scatter of the phase of H inside plates above which they are uneven; flat ones have up to 0.005, tilted ones 0.03."""
PLATE_ACROSS_DEG = 0.5
"""Tilt of a plate across the plane of incidence; turns the polarisation by 0.4 degrees: 3 to 6 % of a permittivity."""
BRIGHTNESS_CARE = 0.2
"""ln of |H| over that of a half space: rough, tilted, high plates stay within 0.13 (simulated), thin sheets to 0.5."""
LEAKAGE_SHARE = 0.02
"""Relative error of permittivities by leakage, above which the result needs care."""
LIBRARY_ANGLE_DEG = 0.3
"""Difference from the library's angle; the ratio of a material changes by 3 % in 0.3 degrees."""
PAINT_REPORTED = 0.2
"""Probability of a painted metal reference from which on the verdict reports it; chosen."""
MOST_OUTSHINING_DB = 6.0
"""Largest level of a plate relative to metal: a factor of two by thickness, tilt and illumination (published
pictures)."""


RECONSTRUCT = "`polysight process SCAN --sparse --out DIR` reconstructs them"
"""Advice for positions without data. Images of separate plates then have a small error, which is stated."""


def judge_recording(coverage: Coverage, masked_share: float = 0.0, is_filled: bool = False) -> list[Finding]:
    """Judge rows, frames and manifest against the plan; `masked_share` of the recorded positions is masked.

    `is_filled`: the positions without data were reconstructed.
    """
    # A reconstruction is not advised at the level "none": of so many missing positions it would be mostly invented.
    advice = {"care": "" if is_filled else f"; {RECONSTRUCT}", "none": ""}
    reasons = []
    if coverage.rows_planned:
        rows_absent = 1 - coverage.rows_recorded / coverage.rows_planned
    else:
        rows_absent = 1.0
    if coverage.rows_recorded < coverage.rows_planned:
        level = "none" if rows_absent > FEW_POSITIONS else "care"
        missing = coverage.rows_planned - coverage.rows_recorded
        reasons.append(reason(
            level, f"{missing} of {coverage.rows_planned} rows are absent ({100 * rows_absent:.1f} % of the positions)",
            "the scan was stopped, or rows were lost; plates there are missing or distorted",
            f"`polysight resume SCAN` records the missing rows{advice[level]}", weight=5 + rows_absent,
        ))  # fmt: skip
    reasons += [
        reason("care", fault, "a recorded row is missing in the images", "run `polysight validate SCAN`", weight=6.0)
        for fault in coverage.manifest
    ]
    if coverage.frames_planned:
        frames_absent = 1 - coverage.frames_received / coverage.frames_planned
    else:
        frames_absent = 1.0
    # The frames of absent rows are subtracted: these rows were judged above.
    lost_share = max(masked_share, frames_absent - rows_absent)
    if lost_share > SOME_POSITIONS:
        level = "none" if lost_share > FEW_POSITIONS else "care"
        reasons.append(reason(
            level, f"{100 * lost_share:.1f} % of the recorded positions or frames are masked",
            "packets were lost, or the direct path was not found there",
            f"look at each board's frames in the report; `polysight doctor` checks the network{advice[level]}",
            4 + lost_share,
        ))  # fmt: skip
    return reasons


def judge_reconstruction(boards: Iterable[tuple[str, float, float | None]]) -> list[Finding]:
    """Judge reconstructed positions by board: its name, their share, and the expected error of its image."""
    reasons = []
    for board, missing_share, image_error in boards:
        if missing_share <= SOME_POSITIONS:
            continue
        if not is_known(image_error):
            level = "none"
            error = "too few rows were recorded to measure its error"
        else:
            level = "none" if image_error > RECONSTRUCTION_NONE else "care"
            error = f"its image is expected to be wrong by {100 * image_error:.1f} %"
        reasons.append(reason(
            level, f"{100 * missing_share:.1f} % of the positions of {board} were reconstructed: {error}",
            "a reconstruction is right only where the scene is mostly empty, such as separate plates",
            "record the missing rows, or scan with a smaller step (`polysight plan`)", 3 + missing_share,
        ))  # fmt: skip
    return reasons


def judge_left_out_chirps(board: str, clipped: float, disturbed: float, positions_clipped: float) -> list[Finding]:
    """Judge one board's shares of chirps that were left out, and of positions without data because all were clipped."""
    reasons = []
    if clipped > SOME_CHIRPS or positions_clipped > SOME_POSITIONS:
        reasons.append(reason(
            "care", f"{board}: {100 * clipped:.1f} % of the chirps are clipped, {100 * positions_clipped:.1f} % of the"
            " positions have no others",
            "the echo or the direct path overdrives the receiver; bright plates lose their strongest positions",
            "lower `rx_gain_db` and scan again", 4 + clipped,
        ))  # fmt: skip
    if disturbed > SOME_CHIRPS:
        reasons.append(reason(
            "care", f"{board}: {100 * disturbed:.1f} % of the chirps are left out, unlike the others of their burst",
            "another radar transmits in the same band, a cable is loose, or the direct path is very weak",
            "switch other radars off; scan again", 3 + disturbed,
        ))  # fmt: skip
    return reasons


def judge_dead_rx(board: str, dead: Mapping[int, Sequence[int]], rows: int) -> list[Finding]:
    """Judge a board's RX without a signal: `dead` maps their numbers to the rows in which they gave none.

    `rows` is the number of rows that the board recorded.
    """
    reasons = []
    # RX that gave no signal in the same rows are reported together.
    for dead_rows in dict.fromkeys(tuple(value) for value in dead.values()):
        names = [f"RX{rx}" for rx, value in dead.items() if tuple(value) == dead_rows]
        some = ""
        if len(dead_rows) < rows:
            some = f" in {len(dead_rows)} of {rows} rows, first in row {dead_rows[0]}"
        reasons.append(reason(
            "care", f"{' and '.join(names)} of {board} {'gives' if len(names) == 1 else 'give'} no signal{some}",
            "it gives only noise, zeros or less than a hundredth of the others' power: its antenna, mixer or "
            "connection is dead; the whole image is made from the board's other RX",
            "the results are valid, with more noise; `polysight doctor` shows each RX: reset the board, or replace "
            "it", weight=3.2,
        ))  # fmt: skip
    return reasons


def judge_rx_order(board: str, order: Sequence[int]) -> list[Finding]:
    """Judge a board's RX: `order` are the places in the rig file, from 1, of those recorded in another order."""
    if not order:
        return []
    moved_rx = [f"RX{k} is RX{place}" for k, place in enumerate(order, 1) if k != place]
    return [reason(
        "none", f"the RX of {board} are recorded in another order than the rig file's: {', '.join(moved_rx)}",
        "the phases of direct path and echo fit these places; lanes are exchanged, or a program lists the RX in its own"
        " order; the image of the board is wrong",
        f"write rx_order = {list(order)} for {board} ([[boards]] of the rig file, and of the scan's own copy), or"
        " correct the order where it is made; process again", weight=10.5,
    )]  # fmt: skip


def judge_direct_path(board: str, snr_db: float | None, phase_rad: float | None, found_share: float) -> list[Finding]:
    """Judge one board's direct path: its level over noise, the residual phase, and the share of positions with one."""
    if 1 - found_share > FEW_POSITIONS or (is_known(snr_db) and snr_db < DIRECT_SNR_NONE_DB):
        return [reason(
            "none", f"{board}: the direct path is missing ({100 * found_share:.0f} % of the positions have one)",
            "without it no position is synchronised, and the images are meaningless",
            "clear the line of sight from transmitter to receiver; check that the transmitter is on", weight=10.0,
        )]  # fmt: skip
    reasons = []
    if is_known(snr_db) and snr_db < DIRECT_SNR_CARE_DB:
        reasons.append(reason(
            "care", f"{board}: the direct path is weak, {snr_db:.0f} dB over noise in one chirp (5 dB are usual)",
            "it is partly blocked, or the antennas point elsewhere; it is the reference of all phases",
            "clear the line of sight; check the antennas' direction", weight=3.0,
        ))  # fmt: skip
    if is_known(phase_rad) and phase_rad > DIRECT_PHASE_CARE_RAD:
        reasons.append(reason(
            "care", f"{board}: residual phase {phase_rad:.3f} rad from position to position (0.004 is usual)",
            "a weak direct path, or a strong reflector near it", "look at the synchronisation table of the report",
            weight=2.5,
        ))  # fmt: skip
    return reasons


def judge_levels(levels: Mapping[str, float | None]) -> list[Finding]:
    """Judge metal's brightness relative to the direct path in each channel (None: not known)."""
    reasons = []
    for channel, level in levels.items():
        if is_known(level) and level > 0 and not DIRECT_LEVELS[0] <= level <= DIRECT_LEVELS[1]:
            weak = level > DIRECT_LEVELS[1]
            state = "weak" if weak else "strong"
            problem = f"{channel}: the direct path is {state}: metal is {20 * np.log10(level):+z.0f} dB relative to it"
            if weak:
                cause = "something in its way weakens the direct path; the object disturbs its estimate"
            else:
                cause = (
                    "the object is far weaker than the direct path: the antennas point elsewhere, or it is not metal"
                )
            do = "clear the line of sight from transmitter to receivers, and check the antennas' direction"
            reasons.append(reason("care", problem, cause, do, weight=3.5))
    return reasons


def judge_patches(
    refused: Mapping[int, str], patches: int, left_out: int = 0, filled_share: float = 0.0
) -> list[Finding]:
    """Judge the patches; `refused` maps numbers of patches that are not plates to why (noise, several materials).

    `left_out` bright regions of a plate's size do not stand out enough to be patches, or touch a larger patch;
    `filled_share` is the share of the image's pixels in the largest of them.
    """
    if patches == 0 and filled_share > FILLED_SHARE:
        return [reason(
            "none", f"one region fills {100 * filled_share:.0f} % of the image: no edge of a plate is in it",
            "if a plate is as large as the image, there is no background from which it stands out; a table, a wall or "
            "noise alone look the same, so the region does not count as a patch",
            "image a larger area (image.columns, image.rows), lay a smaller plate, or"
            " draw a box on it (polysight label; process --labels)", weight=9.0,
        )]  # fmt: skip
    if patches == 0:
        return [reason(
            "none", "no patch was found", "nothing in the image stands out from its background",
            "check that the object lies on the plane and in the image (polysight image)", weight=9.0,
        )]  # fmt: skip
    if len(refused) == patches:
        faults = sorted(set(refused.values()))
        return [reason(
            "none", f"none of the {patches} patches is a plate: {'; '.join(faults)}",
            "there is no flat object on the plane, or the data are noise",
            "look at the images; check the direct path and the range profile (polysight doctor)", weight=9.0,
        )]  # fmt: skip
    patches_by_reason: dict[str, list[int]] = {}
    for label, fault in refused.items():
        patches_by_reason.setdefault(fault, []).append(label)
    if left_out:
        left_out_notes = [
            reason(
                "good",
                f"{left_out} region{'s' * (left_out > 1)} of a plate's size within 25 dB of the brightest: no patch",
                "no brighter than the background scatters (sidelobes, clutter, weak plates), or it touches a patch",
                "lay plates apart; draw a box where a plate lies (polysight label; process --labels)",
                weight=0.5,
            )
        ]
    else:
        left_out_notes = []
    return left_out_notes + [
        reason(
            "care",
            f"patch{'es' * (len(labels) > 1)} {', '.join(map(str, labels))} not judged: {fault}",
            "results hold for one flat plate per patch",
            "move the plates apart, or draw their boxes (polysight label; process --labels)",
            weight=2.0,
        )
        for fault, labels in patches_by_reason.items()
    ]


def judge_metal(
    patch: str,
    is_likely: bool,
    is_certain: bool,
    is_given: bool,
    contradicted: bool,
    only_patch: bool,
    culprit: int | None = None,
    painted: float = 0.0,
    paint_mm: float = 0.0,
) -> list[Finding]:
    """Judge the metal reference `patch` ("patch 3").

    `is_likely` and `is_certain` say if the other patches show that it is metal, `contradicted` if its own V / H against
    the direct path shows that it is not. With `only_patch` there are no others. `culprit` is the patch that fits the
    reference least, if patches speak against it. `is_given`: the user chose the reference. `painted` is the probability
    that it is metal with a coating, which is `paint_mm` thick.
    """
    do = "lay a metal plate into the scene and name it (--metal-box X0,Y0,X1,Y1), or use `polysight calibrate metal`"
    if is_given and contradicted:
        return [reason(
            "care" if is_likely or only_patch else "none",
            f"the given metal reference ({patch}) does not look like metal",
            "relative to the direct path it reflects less of V than of H; no metal does this", do, weight=8.0,
        )]  # fmt: skip
    # This comes before paint: if other patches speak against the metal, a dielectric explains them better than a
    # coating.
    if is_given and culprit is not None and not is_likely:
        return [reason(
            "care",
            f"the given metal reference ({patch}) may not be metal: relative to it, patch {culprit} and others have "
            "unusual values",
            "the others fit a dielectric reference better; thin plates, liquids, or H and V of different places may "
            "also cause this",
            f"check that {patch} is bare metal; look at patch {culprit}: fit it as a layer, or leave it out",
            weight=4.4,
        )]  # fmt: skip
    paint = []
    if painted > PAINT_REPORTED:
        given = "given " if is_given else ""
        paint = [reason(
            "care",
            f"the {given}metal reference ({patch}) may be painted: probability {painted:.2f}, {paint_mm:.2f} mm",
            "relative to it all patches have the same additional phase of V / H; a coating on metal causes this, "
            "and also a wet plate instead of metal; permittivities are corrected for a coating, with its error",
            f"take the paint or film off {patch}, or use bare metal", weight=2.7,
        )]  # fmt: skip
    if is_given or is_certain:
        return paint
    if is_likely:
        doubt = reason(
            "care", f"the metal reference ({patch}) is probably metal, but this is not certain",
            "a wet or conducting plate could look like it; all permittivities depend on it", do, weight=2.8,
        )  # fmt: skip
        return [doubt, *paint]
    cause = "relative to it the other patches are impossible materials, or too few of them give evidence"
    if only_patch:
        cause = "nothing else in the scene can show that it is metal"
    return [reason("none", f"no metal reference: {patch} is not shown to be metal", cause, do, weight=8.0)]


def judge_dark_reference(patch: str, brightest: int, brighter_db: float) -> list[Finding]:
    """Judge a metal reference `patch` ("patch 3") that another patch outshines in H by `brighter_db`."""
    if not brighter_db > MOST_OUTSHINING_DB:
        return []
    return [reason(
        "care",
        f"the given metal reference ({patch}) is {brighter_db:.0f} dB darker in H than patch {brightest}",
        "nothing reflects more than metal: it is not metal, it is tilted, or its box is not on it",
        "look at the picture of H in the report, and give the box of the metal", weight=5.0,
    )]  # fmt: skip


def judge_leakage(measured: bool, estimated: bool, relative_error: float) -> list[Finding]:
    """Judge leakage that was not `measured`: it was `estimated` from the scene, or is not known.

    `relative_error` is its median effect on the permittivities.
    """
    if measured or relative_error < LEAKAGE_SHARE:
        return []
    source = "estimated from the scene" if estimated else "never measured; its prior is used"
    if is_known(relative_error):
        share = f"{100 * relative_error:.0f} %"
    else:
        share = "an unknown share"
    return [reason(
        "care",
        f"leakage was {source}: permittivities are uncertain by {share}, names less reliable",
        "the rig file has no leakage_std: leakage up to 0.1 of any phase is possible",
        "measure it once with metal strips: `polysight leakage` (docs/how-to/calibration.md)", weight=1.5,
    )]  # fmt: skip


def judge_plane(
    is_known_plane: bool,
    offset_mm: float,
    tilt_deg: tuple[float, float],
    theta_std_deg: float,
    tilt_std_deg: tuple[float, float] = (0.0, 0.0),
) -> list[Finding]:
    """Judge the position of the plates' plane against the rig file; a tilt counts beyond its standard deviation."""
    if not is_known_plane or not all(map(is_known, (offset_mm, *tilt_deg))):
        error = ""
        if is_known(theta_std_deg):
            error = f", +-{theta_std_deg:.2f} degrees"
        return [reason(
            "care",
            f"the plane was not found; the angle is the rig file's{error}",
            "no patch has a clear echo", "measure the plane's distance, or scan a flat plate (polysight focus)",
            weight=2.0,
        )]  # fmt: skip
    if abs(offset_mm) > PLANE_GATE_MM:
        return [reason(
            "none", f"the plates lie {offset_mm:+z.0f} mm off the rig file's plane",
            "they are at the edge of the range gate",
            "measure geometry.object_distance_mm and correct the rig file", weight=7.0,
        )]  # fmt: skip
    reasons = []
    certain_tilt = max(abs(t) - std for t, std in zip(tilt_deg, tilt_std_deg, strict=True))
    tilt = max(abs(t) for t in tilt_deg)
    if abs(offset_mm) > PLANE_FAR_MM:
        reasons.append(reason(
            "care", f"the plates lie {offset_mm:+z.1f} mm off the rig file's plane; the angle was corrected for it",
            "the object is at another distance, or object_distance_mm is wrong",
            "correct geometry.object_distance_mm in the rig file", weight=1.6,
        ))  # fmt: skip
    if certain_tilt > PLANE_TILT_DEG:
        reasons.append(reason(
            "care", f"the plates' plane is tilted by {tilt:.1f} degrees",
            "tilted plates reflect past the scanned positions",
            "lay the plates parallel to the stage", weight=1.4,
        ))  # fmt: skip
    return reasons


def judge_copies(
    labels: Sequence[int], shift_mm: tuple[float, float], level_db: float, has_gaps: bool = False
) -> list[Finding]:
    """Judge patches, with these `labels`, that are shifted and weaker copies of the plates.

    `has_gaps`: positions have no data, and were not reconstructed.
    """
    if not labels:
        return []
    place_text = f"x {shift_mm[0]:+z.0f}, y {shift_mm[1]:+z.0f} mm away and {-level_db:.0f} dB weaker"
    if has_gaps:
        return [reason(
            "care", f"patches {', '.join(map(str, labels))} may repeat the plates, {place_text}",
            "positions without data repeat the plates in the image; these patches may be plates that are distorted",
            f"record the missing positions; {RECONSTRUCT}", weight=3.5,
        )]  # fmt: skip
    return [reason(
        "care", f"patches {', '.join(map(str, labels))} repeat the plates, {place_text}",
        "a second path in addition to the direct path (multipath) modulates the scan; the plates are disturbed equally",
        "take reflectors away from the line between transmitter and receivers, or cover them with absorber", weight=4.5,
    )]  # fmt: skip


def judge_image_shift(apart_mm: tuple[float, float], has_drift: bool = False) -> list[Finding]:
    """Judge where the image of V lay relative to that of H (x, y); `has_drift`: a drift of the phase was removed."""
    distance = float(np.hypot(*apart_mm))
    if not is_known(distance) or distance <= IMAGE_SHIFT_MM:
        return []
    cause = "boards are out of place by a few millimetres, or all plates lie high; the images were aligned"
    do = "measure where the antennas are (`polysight calibrate direct-path`) and correct the rig file"
    if has_drift:
        cause = "the drift of a phase moves an image, and some of it is left; the images were aligned"
        do = "remove the cause of the drift of the phase first; if this remains, measure where the antennas are"
    return [reason(
        "care",
        f"the images of H and V were {distance:.1f} mm apart (x {apart_mm[0]:+z.1f}, y {apart_mm[1]:+z.1f} mm)",
        cause, do, weight=1.9,
    )]  # fmt: skip


def judge_drift(amplitude: float, phase_rad: float, probability: float) -> list[Finding]:
    """Judge the drift of V / H over the scan: its largest root mean square at a plate, and how likely there is one."""
    if not (is_known(amplitude) and is_known(phase_rad)) or max(amplitude, phase_rad) <= DRIFT_CARE:
        return []
    if not probability > DRIFT_LIKELY:
        return []
    return [reason(
        "care", f"V / H drifts by {100 * amplitude:.0f} % and {np.degrees(phase_rad):.0f} degrees between the plates",
        "the gains of the boards change during the scan (temperature); it is corrected to about a half",
        "let the boards warm up for half an hour; put the metal into the middle of the scan", weight=2.7,
    )]  # fmt: skip


def judge_fringes(probability: float, has_gaps: bool = False, behind: float = 0.0) -> list[Finding]:
    """Judge fringes of a second path, by their probability; `has_gaps` as in :func:`judge_copies`.

    `behind` is the error by objects behind the plates, as in :func:`judge_background`; a large one explains the
    fringes.
    """
    if not is_known(probability) or probability <= FRINGES_CARE:
        return []
    what = "V / H changes over the scan in fringes, by more than the plates can explain"
    if has_gaps:
        return [reason(
            "care", what, "positions without data cause this in the image", "record the missing positions; "
            f"{RECONSTRUCT}",
            weight=2.8,
        )]  # fmt: skip
    if is_known(behind) and behind > BACKGROUND_CARE:
        return [reason(
            "care", what, "objects behind the plates shine through them and cause this; a second path causes "
            "it, too",
            "cover objects behind the plates with absorber, or move them 300 mm away", weight=2.8,
        )]  # fmt: skip
    return [reason(
        "care", what,
        "a second path in addition to the direct path (multipath) or an overdriven receiver changes the gains; "
        "bright edges of the plates, and a table that shines through them, look alike",
        "take reflectors away from the line between transmitter and receivers; cover objects behind the plates with "
        "absorber", weight=3.0,
    )]  # fmt: skip


def judge_disturbed_plates(errors: Mapping[int, float], has_gaps: bool = False) -> list[Finding]:
    """Judge plates that something disturbs: patch number to the error of its permittivity by slopes of its V / H.

    `has_gaps` as in :func:`judge_copies`.
    """
    above = {label: error for label, error in errors.items() if is_known(error) and error > DISTURBED_CARE}
    if not above:
        return []
    patches = f"patch {min(above)}" if len(above) == 1 else f"patches {', '.join(map(str, sorted(above)))}"
    cause = "they are uneven, or a second path in addition to the direct path, or clipping, lays copies of plates there"
    action = "use even plates; take reflectors away from the line between transmitter and receivers"
    if has_gaps:
        cause = "positions without data lay weak copies of the plates over them"
        action = f"record the missing positions; {RECONSTRUCT}"
    return [reason(
        "care", f"V / H changes within {patches}: an error of up to {100 * max(above.values()):.0f} % in permittivity",
        cause, action, weight=2.5,
    )]  # fmt: skip


def judge_reference_tilt(tilt_deg: tuple[float, float]) -> list[Finding]:
    """Judge the tilt of a metal plate that was scanned separately, along the plane of incidence and across it."""
    largest_tilt_deg = max(tilt_deg, key=abs)
    if not is_known(largest_tilt_deg) or abs(largest_tilt_deg) <= PLATE_ACROSS_DEG:
        return []
    return [reason(
        "care", f"the metal plate of the reference scan was tilted by {largest_tilt_deg:+z.1f} degrees",
        "the polarisation turns with it, in all plates equally, as if the boards had turned; corrected to a quarter",
        "lay the metal plate parallel to the stage, and scan it again", weight=4.1,
    )]  # fmt: skip


def judge_moved_boards(probability: float) -> list[Finding]:
    """Judge the probability that the mount has moved since its leakage was measured."""
    if not is_known(probability) or probability <= MOVED_CARE:
        return []
    return [reason(
        "care", f"boards have turned since their leakage was measured, with a probability of {probability:.2f}",
        "the patches fit materials only with another leakage; theirs is estimated and counted in the error bars",
        "fix the boards and measure the leakage again: `polysight leakage` (docs/how-to/calibration.md)", weight=4.0,
    )]  # fmt: skip


def judge_halo(level: float) -> list[Finding]:
    """Judge the halo of V around the metal: its amplitude relative to the metal."""
    if not is_known(level) or level <= HALO_CARE:
        return []
    return [reason(
        "care", f"V has a halo around the metal, {20 * np.log10(level):.0f} dB, that H does not have",
        "the receiver of V is overdriven (clipping): the metal's V is too weak, its neighbours are disturbed",
        "lower the gain of the receivers (rx_gain_db), or use a smaller piece of metal", weight=4.2,
    )]  # fmt: skip


def judge_background(relative_std: float) -> list[Finding]:
    """Judge what lies behind the plates: the error of each part of ln(V / H) that it makes in the usual patch."""
    if not is_known(relative_std) or relative_std <= BACKGROUND_CARE:
        return []
    return [reason(
        "care", f"objects behind the plates disturb P by {100 * relative_std:.0f} %, which the error bars contain",
        "a table, a wall or a holder behind them returns waves too, and they add to those of the plates",
        "cover it with absorber, or move it 300 mm away from the plates", weight=2.9,
    )]  # fmt: skip


def judge_flatness(
    ripple: tuple[float, float], relief_rad: float, is_boxed: bool = False, has_gaps: bool = False
) -> list[Finding]:
    """Judge how well flat plates fit: `ripple` is the usual scatter of ln|V / H| and of its phase inside plates,
    `relief_rad` that of the phase of H.

    A flat plate has one V / H, and a phase of H that is a plane. `is_boxed`: the plates' boxes were given; boxes
    that reach within 3 mm of the plates' edges add the edges' ripple. `has_gaps` as in :func:`judge_copies`.
    """
    if is_known(relief_rad) and relief_rad > RELIEF_CARE_RAD:
        return [reason(
            "care", f"plates are rough, wavy or bent: the phase of H scatters by {np.degrees(relief_rad):.0f} degrees",
            "H and V see an uneven surface from different places; the errors are larger, and include this scatter",
            "lay flat plates, or press them onto a plane", weight=2.1,
        )]  # fmt: skip
    if not all(map(is_known, ripple)) or max(ripple) <= RIPPLE_CARE:
        return []
    cause = (
        "uneven plates or bright edges, a second path in addition to the direct path, interference, or a small "
        "aperture cause this"
    )
    action = "use even plates; take reflectors away from the line between transmitter and receivers; scan a larger area"
    if has_gaps:
        cause = "positions without data cause this in the image"
        action = f"record the missing positions; {RECONSTRUCT}"
    if is_boxed:
        cause = f"boxes that reach the plates' edges, {cause}"
        action = f"draw the boxes at least 6 mm inside the plates; if it stays, {action}"
    ripple_deg = np.degrees(ripple[1])
    return [reason(
        "care", f"V / H ripples by {100 * ripple[0]:.0f} % and {ripple_deg:.0f} degrees inside the plates",
        cause, action, weight=2.4,
    )]  # fmt: skip


def judge_tilts(across_deg: Mapping[int, float]) -> list[Finding]:
    """Judge the tilts of plates across the plane of incidence: patch number to degrees."""
    tilted = {label: angle for label, angle in across_deg.items() if is_known(angle) and abs(angle) > PLATE_ACROSS_DEG}
    if not tilted:
        return []
    steepest = max(tilted, key=lambda label: abs(tilted[label]))
    remark = ""
    if len(tilted) != 1:
        remark = f" ({len(tilted)} patches in all)"
    return [reason(
        "care", f"patch {steepest} rises by {tilted[steepest]:+z.1f} degrees across the plane of incidence{remark}",
        "the polarisation turns with it: 5 to 13 % of a permittivity per degree, corrected to about a quarter",
        "lay plates and metal flat; put spacers under the tilted one", weight=1.3,
    )]  # fmt: skip


def judge_passivity(refused: Mapping[int, Finding]) -> list[Finding]:
    """Judge patches that are not a passive half space: number to why."""
    labels: dict[str, list[int]] = {}
    for label, fault in refused.items():
        labels.setdefault(fault.what, []).append(label)
    reasons = []
    for patches in labels.values():
        fault = refused[patches[0]]
        subject = f"patch {patches[0]} has"
        if len(patches) > 1:
            subject = f"patches {', '.join(map(str, patches))} have"
        reasons.append(reason("care", f"{subject} no permittivity: {fault.what}", fault.why, fault.do, weight=2.2))
    return reasons


def judge_smears(smears: Mapping[int, Finding]) -> list[Finding]:
    """Judge patches that are smears and no objects: number to why."""
    if not smears:
        return []
    fault = next(iter(smears.values()))
    subject = f"patch {next(iter(smears))} is not an object, but"
    if len(smears) > 1:
        subject = f"patches {', '.join(map(str, smears))} are not objects, but each is"
    return [reason("care", f"{subject} {fault.what}", fault.why, fault.do, weight=1.9)]


def judge_exchange(stronger_v: Sequence[int], plates: int) -> list[Finding]:
    """Judge whether H and V are exchanged: `stronger_v` are the patches of `plates` that reflect more V than H.

    No half space does so, and of layers few do: two of them that are more than half of the plates have another cause.
    """
    if len(stronger_v) < 2 or 2 * len(stronger_v) <= plates:
        return []
    return [reason(
        "none", f"H and V may be exchanged: patches {', '.join(map(str, stronger_v))} reflect more V than H",
        "relative to metal no dielectric reflects p more than s; or the metal reference is a dielectric",
        "exchange the images or the boards (rig file, section `boards`), or name another metal reference", weight=8.5,
    )]  # fmt: skip


def judge_brightness(off: Mapping[int, float]) -> list[Finding]:
    """Judge brightness: patch number to ln of |H| over that of a half space of its permittivity."""
    reasons = []
    for label, ln in off.items():
        if is_known(ln) and abs(ln) > BRIGHTNESS_CARE:
            share = 100 * abs(float(np.expm1(ln)))
            than = "brighter" if ln > 0 else "darker"
            reasons.append(reason(
                "care", f"patch {label} is {share:.0f} % {than} than a half space of its permittivity",
                "it may be thin, layered, rough, or partly in a shadow; the permittivity of a thin plate is then wrong",
                "fit it as a layer (polysight permittivity --layer), or lay it flat, without objects near it",
                weight=1.7,
            ))  # fmt: skip
    return reasons


def judge_incidence(angle_deg: float, library_deg: float | None) -> list[Finding]:
    """Judge the incidence angle against the library's."""
    if not is_known(library_deg) or not is_known(angle_deg) or abs(angle_deg - library_deg) <= LIBRARY_ANGLE_DEG:
        return []
    return [reason(
        "care", f"the scan has an incidence angle of {angle_deg:.2f} degrees, the library {library_deg:.2f}",
        "the ratio of a material changes by 10 % in a degree: names may be wrong",
        "make a library at this angle, or move the plane", weight=1.8,
    )]  # fmt: skip
