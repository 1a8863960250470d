"""Write `report.html`, one self-contained page with inline images, and the same figures as files.

Tables are plain dicts (caption, head, rows) for the page's template. The table of patches has a column for each figure
(a number of a patch) that the type of the patches, `polysight.results.PatchFigures` or a subclass, declares with a
title.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w
from jinja2 import Environment, PackageLoader, StrictUndefined, Template, select_autoescape
from markupsafe import Markup, escape

from polysight.materials import UNKNOWN
from polysight.products import REPORT, ProcessedScan
from polysight.report.figures import FIGURES, draw_figures, find_masked_positions, surface_figure
from polysight.report.style import assign_colours, patch_colour, patch_label, plate_label
from polysight.results import (
    ErrorBudget,
    Figure,
    IncidenceError,
    LeakageError,
    PatchFigures,
    PermittivityFigures,
    PlaneError,
    ScanQuality,
    list_declared_figures,
    percent,
    to_plain,
)
from polysight.surfaces import SURFACE, read_surface
from polysight_shared.config import Instrument
from polysight_shared.files import write_atomically
from polysight_shared.geometry import incidence_deg

# Shown where a value is not known.
DASH = "–"
NOT_ON_HARDWARE = "Nothing of this instrument has run on hardware yet."
# Key of `BoardImaging` and heading of each line of the table of imaging.
_IMAGING_ROWS: tuple[tuple[str, str], ...] = (
    ("masked_positions", "Positions masked"),
    ("rows_without_data", "Rows without any data"),
    ("loss_db", "Loss of a point's sum by masked positions (dB)"),
    ("frequencies", "Frequency samples after the range gate"),
    ("point_width_mm", "Point response at half power, x × y (mm)"),
    ("point_limit_mm", "Geometry's limit without taper, x × y (mm)"),
    ("point_paper_mm", "The paper's r λ / L, x × y (mm)"),
    ("point_sidelobe_db", "Strongest sidelobe, x, y (dB)"),
)
Table = dict[str, Any]
# Alternative texts of the pictures, for readers who cannot see them, by file name.
ALTERNATIVE_TEXTS = {
    **FIGURES,
    "materials": "Material map",
    "truth": "True plates",
    "permittivity": "Permittivity plot",
    "permittivity_map": "Map of the permittivity and its error",
    "coverage": "Masked positions",
    "surface": "Surfaces from three sides",
}
# Keys of a board's quality that are shown in another table or in a map, or that only programs read.
_NOT_LISTED = ("synchronisation", "raw_crc32", "masked_columns", "rows_recorded")
# Last word of a key to the unit of its value.
UNITS = {"hz": "Hz", "rad": "rad", "deg": "°", "s": "s", "db": "dB", "mm": "mm", "m": "m", "bytes": "bytes"}


def write_report(out_dir: Path, scan: ProcessedScan) -> Path:
    """Write `report.html` and `figures/*.png` into a folder; return the path of the page."""
    pictures = draw_figures(scan)
    if (out_dir / SURFACE).exists():
        pictures["surface"] = surface_figure(read_surface(out_dir / SURFACE))
    for name, data in pictures.items():
        write_atomically(out_dir / "figures" / f"{name}.png", data)
    page = out_dir / REPORT
    write_atomically(page, render(scan, pictures).encode("utf-8"))
    return page


@cache
def _load_template() -> Template:
    """Return the page's template. It is compiled once for all reports of a program, which takes 0.1 s."""
    environment = Environment(
        loader=PackageLoader("polysight.report", "."),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["code"] = _mark_commands
    return environment.get_template("report.html")


def render(scan: ProcessedScan, pictures: dict[str, bytes]) -> str:
    """Return the page as text, with the given PNG figures inline."""
    colours = assign_colours(scan)
    rows = [_format_patch_row(patch, colours) for patch in scan.segments]
    plates_found = {row["truth"] for row in rows}
    # The image's centre in the rig frame, mm.
    centre = [f"{1e3 * (float(axis[0]) + float(axis[-1])) / 2:z.1f}" for axis in (scan.x_m, scan.y_m)]
    metal_how = ""
    library = ""
    if scan.materials is not None and scan.judged:
        library = scan.materials.library
        if scan.materials.metal_reference:
            metal_how = scan.materials.metal_reference.how
    budget = None
    if scan.materials is not None and scan.materials.error_budget:
        budget = make_budget_table(scan.materials.error_budget)
    missed_plates: list[str] = []
    if rows:
        missed_plates = [plate.name for plate in scan.plates if plate.name not in plates_found]
    config = [] if scan.rig is None else _summarise_rig(scan.rig)
    return _load_template().render(
        scan=scan,
        title=f"Scan {scan.scan_id}".strip(),
        simulated=scan.stamped,
        notes=_list_notes(scan),
        metal_how=metal_how,
        library=library,
        images={key: base64.b64encode(pictures.get(key, b"")).decode("ascii") for key in ALTERNATIVE_TEXTS},
        alt=ALTERNATIVE_TEXTS,
        lead=_write_lead(scan),
        keys=list_key_numbers(scan, rows),
        centre=centre,
        verdict=scan.verdict,
        remedies=_list_remedies(rows),
        rows=rows,
        headings=[figure.column.title for figure in _select_shown_figures(scan)],
        with_errors=any(patch.permittivity and patch.permittivity.spread for patch in scan.segments),
        budget=budget,
        replaced=_list_replaced_names(scan),
        missed=missed_plates,
        quality=make_quality_tables(to_plain(scan.quality)),
        coverage=describe_coverage(find_masked_positions(scan)),
        config=config,
        rig_file=tomli_w.dumps(scan.facts.instrument or {}),
        provenance=_list_provenance(scan),
    )


def _list_notes(scan: ProcessedScan) -> list[str]:
    """Return the sentences at the top: damage of the manifest, no run on hardware yet, why nothing was named."""
    notes = [NOT_ON_HARDWARE]
    if scan.quality.coverage and scan.quality.coverage.damage:
        notes.insert(0, scan.quality.coverage.damage)
    # If nothing was named, `model` is None, and `library` is the sentence that says why.
    if scan.materials is not None and scan.materials.model is None and scan.materials.library:
        notes.append(scan.materials.library)
    return notes


def _summarise_rig(rig: Instrument) -> list[tuple[str, str]]:
    """Return a short summary of the rig file: name and text."""
    chirp = rig.chirp
    grid = rig.grid
    leakage = rig.polarimetry
    measured = "not measured"
    if leakage.leakage_std is not None:
        measured = (
            f"H {complex(*leakage.leakage_h):.3g}, V {complex(*leakage.leakage_v):.3g},"
            f" +- {leakage.leakage_std:g} (rig file)"
        )
    swept = f"{chirp.first_sample_hz / 1e9:.3f} GHz + {chirp.swept_hz / 1e9:.3f} GHz in {chirp.samples} samples"
    return [
        ("rig", rig.name),
        ("incidence", f"{incidence_deg(rig, rig.receivers[0]):.1f} degrees"),
        ("chirp", swept),
        ("grid", f"{grid.columns} x {grid.rows} positions, {grid.step_x_mm:g} x {grid.step_y_mm:g} mm"),
        ("burst", f"{rig.burst}, stage at {rig.stage.speed_mm_s:g} mm/s"),
        ("leakage", measured),
    ]


def _list_provenance(scan: ProcessedScan) -> list[tuple[str, str]]:
    """Return scan, time of processing and versions of the packages: name and text; none for products without a time."""
    processed = scan.facts.processed_utc or ""
    if not processed:
        return []
    moment = datetime.fromisoformat(processed).strftime("%Y-%m-%d %H:%M:%S UTC")
    return [("scan", scan.scan_id), ("processed", moment), *(scan.facts.versions or {}).items()]


def _select_shown_figures(scan: ProcessedScan) -> list[Figure]:
    """Return the declared figures of patches that have a heading in tables for people."""
    kind = type(scan.segments[0]) if scan.segments else PatchFigures
    return [figure for figure in list_declared_figures(kind) if figure.column.title]


def _mark_commands(words: str) -> Markup:
    """Escape text and mark `commands` in it as code."""
    parts = [escape(part) for part in words.split("`")]
    # Every second part was between two backquotes.
    parts[1::2] = [Markup("<code>{}</code>").format(part) for part in parts[1::2]]
    return Markup("").join(parts)


def _list_remedies(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the measurements that would reduce the errors, each with the patches whose errors it would reduce."""
    patches_by_remedy: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row["do"]:
            patches_by_remedy.setdefault((row["dominated_by"], row["do"]), []).append(str(row["label"]))
    return [
        {"what": problem, "do": do, "patches": ", ".join(labels)} for (problem, do), labels in patches_by_remedy.items()
    ]


def _list_replaced_names(scan: ProcessedScan) -> list[str]:
    """Return `patch 1: ?? is NAME` for each name that the figures' fonts cannot draw."""
    pairs = [(patch_label(patch), patch.name) for patch in scan.segments if patch.name]
    pairs += [(plate_label(plate, number), plate.name) for number, plate in enumerate(scan.plates, 1)]
    return [f"{label} is {name}" for label, name in pairs if label != name]


def _write_lead(scan: ProcessedScan) -> str:
    """Return the sentence below the title: size of the images and of their pixels."""
    ny, nx = scan.h.shape
    pixel_mm = abs(float(scan.x_m[1] - scan.x_m[0])) * 1e3
    kind = "simulated scan" if scan.stamped else "scan"
    return (
        f"s- and p-polarised images (H and V) of a {kind}, {nx} × {ny} pixels of {pixel_mm:g} mm: "
        "reflectivity, materials and quality of the data."
    )


def _format_patch_row(patch: PatchFigures, colours: dict[str, str]) -> dict[str, Any]:
    """Format one line of the materials table: key of the template to text.

    `truth`, `true_real`, `true_loss` and `error` come from the true plate at this place. `right` is true if the name is
    the true one, `strange` if the patch was rightly called unknown, because the library does not contain its material.
    `votes` is the confidence, `drawn_as` the name of the box that the operator drew, `do` the measurement that would
    reduce the error most.
    """
    truth = patch.truth
    estimate = patch.permittivity
    name = patch.name or f"patch {patch.label}"
    if patch.metal_reference and not patch.name:
        name = "metal reference"
    row: dict[str, Any] = {
        "label": patch.label,
        "name": name,
        "where": f"{patch.centre_x_mm:z.0f}, {patch.centre_y_mm:z.0f}".replace("-", "−"),
        "size": f"{patch.width_mm:.0f} × {patch.height_mm:.0f}",
        "colour": patch_colour(patch, colours),
        "metal_reference": patch.metal_reference and bool(patch.name),
        "drawn_as": patch.box or "",
        "refused": patch.refused is not None,
        "why_refused": patch.refused_text or "",
        "truth": "",
        "strange": False,
        "right": False,
        "why": patch.why,
        "votes": _format_share(patch.confidence, 0),
        "real": DASH,
        "loss": DASH,
        **dict.fromkeys(("real_error", "loss_error", "real_range", "loss_range", "dominated_by", "share", "do"), ""),
        "true_real": DASH,
        "true_loss": DASH,
        "error": DASH,
        "relative_error": None,
        "pixels": patch.pixels_used,
        "shown": [figure.format(patch) for figure in list_declared_figures(type(patch)) if figure.column.title],
    }
    if patch.metal_like:
        row["real"] = "metal-like"
    if truth is not None:
        row["truth"] = truth.name
        row["strange"] = patch.name == UNKNOWN and not truth.in_library
        row["right"] = truth.name == patch.name or (patch.metal_reference and truth.metal)
        if truth.metal:
            row["true_real"] = "metal"
    if estimate is not None:
        row |= _format_estimate(estimate)
    if patch.true_permittivity is not None:
        row["true_real"] = f"{patch.true_permittivity.real:.2f}"
        row["true_loss"] = f"{-patch.true_permittivity.imag:z.2f}"
        if estimate is not None:
            row["relative_error"] = estimate.real / patch.true_permittivity.real - 1
            # Adding zero after rounding removes the sign of a negative zero.
            row["error"] = f"{round(100 * row['relative_error'], 1) + 0.0:+z.1f} %"
    return row


def _format_estimate(estimate: PermittivityFigures) -> dict[str, str]:
    """Format a permittivity with its errors, the 30th and 70th percentile of its pixels, and the main error source."""
    row = {"real": f"{estimate.real:z.2f}", "loss": f"{estimate.loss:z.2f}"}
    if estimate.spread is not None:
        row["real_error"] = f"± {estimate.spread.real_std:.2f}"
        row["loss_error"] = f"± {estimate.spread.loss_std:.2f}"
    if estimate.real_p30_p70 and estimate.imag_p30_p70:
        real_p30, real_p70 = estimate.real_p30_p70
        imag_p30, imag_p70 = estimate.imag_p30_p70
        row["real_range"] = f"({real_p30:.2f} … {real_p70:.2f})"
        row["loss_range"] = f"({-imag_p70:.2f} … {-imag_p30:.2f})"
    row["dominated_by"] = estimate.dominated_by or ""
    row["do"] = estimate.do or ""
    share = estimate.shares.get(row["dominated_by"])
    row["share"] = "" if share is None else f"{100 * share:.0f} %"
    return row


def describe_coverage(masks: dict[str, npt.NDArray[np.bool_]]) -> str:
    """Return a sentence on the number of masked positions of each board; "" if `masks` is empty.

    `masks` maps a board to bool [row, column].
    """
    if not masks:
        return ""
    if not any(m.any() for m in masks.values()):
        return "Every position of every board has data."
    counts = [f"{name} {int(m.sum())} of {m.size} ({m.mean():.2%})" for name, m in masks.items()]
    return f"Positions without data, left out of the images: {', '.join(counts)}."


def make_imaging_table(imaging: Any) -> Table | None:
    """Return the table of `imaging` of quality.json, a column for each board; None without it."""
    if not isinstance(imaging, dict):
        return None
    boards = {k: v for k, v in imaging.items() if isinstance(v, dict)}
    if not boards:
        return None
    rows = []
    for key, heading in _IMAGING_ROWS:
        if any(key in board for board in boards.values()):
            between = " × " if key.endswith("_mm") else ", "
            rows.append(_format_cells(heading, *(_format_number(board.get(key), between) for board in boards.values())))
    caption = "Imaging. The point response is computed for the middle of the image, with taper and mask as they are."
    for notice in imaging.get("notices", ()):
        caption += f" {notice}."
    return {"caption": caption, "head": ["Board", *map(str, boards)], "rows": rows}


def _is_unknown(value: Any) -> bool:
    """True for None, and for numbers that are not finite, which files store as null."""
    return value is None or (isinstance(value, float | np.floating) and not np.isfinite(value))


def _format_share(value: float | None, digits: int) -> str:
    """Return a share as percent; a dash if it is not known."""
    if value is None or _is_unknown(value):
        return DASH
    return f"{100 * value:.{digits}f} %"


def _format_number(value: Any, between: str = " × ") -> str:
    """Return a number with three digits, a pair joined by `between`; a dash if it is not known."""
    if _is_unknown(value):
        return DASH
    if isinstance(value, list | tuple):
        return between.join(_format_number(v) for v in value)
    if isinstance(value, float):
        return f"{value:z.3g}"
    return str(value)


def format_value(value: Any) -> str:
    """Format a value for reading: grouped thousands, few digits, yes and no, lists with commas."""
    if _is_unknown(value):
        return DASH
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        if abs(int(value)) < 10000:
            return str(int(value))
        return f"{int(value):,}".replace(",", "\u202f")
    if isinstance(value, float | np.floating):
        number = float(value)
        if number == int(number) and abs(number) < 1e15:
            return format_value(int(number))
        if abs(number) < 1000:
            return f"{number:.3g}"
        return f"{number:,.0f}".replace(",", "\u202f")
    if isinstance(value, dict):
        return ", ".join(f"{k}: {format_value(number)}" for k, number in value.items()) or DASH
    if isinstance(value, list | tuple):
        return ", ".join(format_value(number) for number in value) or "none"
    return str(value)


def format_heading(key: str) -> str:
    """Format a key as a heading: `RH if_hz` becomes `RH IF (Hz)`."""
    words = key.replace("_", " ").split()
    unit = ""
    if len(words) > 1 and words[-1] in UNITS:
        unit = f" ({UNITS[words.pop()]})"
    words = ["IF" if word == "if" else word for word in words]
    return " ".join(words) + unit


def list_key_numbers(scan: ProcessedScan, rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the main numbers of the report, which are shown at its top: value and text."""
    out: list[dict[str, str]] = []

    def add(value: str, what: str) -> None:
        out.append({"value": value, "text": what})

    if count := scan.named_plates:
        note = ""
        if count.strange:
            note = f", {count.strange} recognised as not in the library"
        add(f"{count.right} of {count.plates}", f"plates named right{note}")
    elif rows:
        add(str(len(rows)), "patches found")
    accuracy = None if scan.materials is None else scan.materials.pixel_accuracy
    if accuracy is not None:
        expected = scan.expected_accuracy
        note = ""
        if expected is not None:
            note = f"; their own confidence expects {_format_share(expected, 1)}"
        add(_format_share(accuracy, 1), f"of interior pixels named right{note}")
    errors = [abs(r["relative_error"]) for r in rows if r["relative_error"] is not None]
    if errors:
        add(f"{100 * float(np.median(errors)):.1f} %", f"median error of ε′, worst {100 * max(errors):.1f} %")
    for share, description in _compute_received_shares(scan.quality):
        add(share, description)
    if seconds := scan.quality.seconds_per_stage:
        total_s = sum(seconds.values())
        duration = f"{total_s:.1f} s"
        if total_s >= 100:
            duration = f"{total_s / 60:.1f} min"
        add(duration, "of processing, all stages")
    return out


def _compute_received_shares(quality: ScanQuality) -> list[tuple[str, str]]:
    """Return the received shares of planned rows and frames, or without `coverage` of frames of recorded rows."""
    if coverage := quality.coverage:
        share = percent(coverage.frames_received, coverage.frames_planned, 2)
        shares = [(share, f"of {format_value(coverage.frames_planned)} planned frames received")]
        if coverage.rows_absent:
            shares.insert(0, (f"{coverage.rows_recorded} of {coverage.rows_planned}", "rows recorded"))
        return shares
    expected = sum(board.frames_expected for board in quality.boards.values())
    received = sum(board.frames_received for board in quality.boards.values())
    if not expected:
        return []
    return [(percent(received, expected, 2), f"of {format_value(expected)} frames of recorded rows received")]


def make_quality_tables(quality: dict[str, Any]) -> list[Table]:
    """Return tables of boards, synchronisation, imaging and times of quality.json, then one of all other keys."""
    shown_elsewhere = {"boards", "seconds_per_stage", "imaging", "verdict", "error_budget"}
    boards = quality.get("boards")
    parts = (
        _tabulate_boards(boards),
        _tabulate_residuals(boards),
        make_imaging_table(quality.get("imaging")),
        _tabulate_seconds(quality.get("seconds_per_stage")),
    )
    out = [part for part in parts if part]
    if other_entries := {k: v for k, v in quality.items() if k not in shown_elsewhere}:
        flat_entries = _flatten(other_entries, nested=False)
        rows = [_format_cells(format_heading(k), format_value(v)) for k, v in flat_entries.items()]
        out.append({"caption": "Rows, masked data and other figures.", "head": [], "rows": rows})
    return out


# Text of each `source` of `LeakageError`.
_SOURCES = {
    "measured": "measured (rig file)",
    "prior and scene": "not measured; estimated from its prior and the scene",
    "scene": "estimated from the scene",
}


def make_budget_table(budget: ErrorBudget) -> Table | None:
    """Return the table of the error budget: leakage, plane, angle, evidence for metal; None without any of them."""
    rows = [*_tabulate_leakage(budget.leakage), *_tabulate_incidence(budget.incidence), *_tabulate_plane(budget.plane)]
    metal = budget.metal
    if metal is not None and metal.score is not None:
        evidence = f"score {_format_with_sign(metal.score, 1)} from {metal.others} other patches"
        if metal.channel_ratio_db is not None:
            evidence += f"; V over H {_format_with_sign(metal.channel_ratio_db, 1)} dB relative to the direct path"
        rows.append(_format_cells("Evidence that the reference is metal", evidence))
    if not rows:
        return None
    caption = "What the errors of the permittivities were computed with. ± is a standard deviation."
    return {"caption": caption, "head": [], "rows": rows}


def _tabulate_leakage(leakage: LeakageError | None) -> list[dict[str, Any]]:
    """Return the lines of the error budget about leakage."""
    if leakage is None:
        return []
    rows = [_format_cells("Leakage", _SOURCES.get(leakage.source, leakage.source))]
    std_h, std_v = leakage.std or (None, None)
    for channel, value, std in (("H", leakage.h, std_h), ("V", leakage.v, std_v)):
        if value is not None and value[0] is not None and value[1] is not None:
            sign = "+" if value[1] >= 0 else "−"
            number = f"{_format_with_sign(value[0], 3)} {sign} {abs(value[1]):.3f}i"
            if std is not None:
                number += f" ± {std:.3f}"
            rows.append(_format_cells(f"Leakage of {channel}, relative to its own channel", number))
    return rows


def _tabulate_incidence(incidence: IncidenceError | None) -> list[dict[str, Any]]:
    """Return the line of the error budget about the incidence angle."""
    if incidence is None or incidence.deg is None:
        return []
    angle = f"{incidence.deg:.2f}°"
    if incidence.std_deg is not None:
        angle += f" ± {incidence.std_deg:.2f}°"
    return [_format_cells("Incidence angle", angle)]


def _tabulate_plane(plane: PlaneError | None) -> list[dict[str, Any]]:
    """Return the lines of the error budget about the plane of the plates."""
    if plane is None:
        return []
    if not plane.known:
        return [_format_cells("Plane of the plates", "not found; that of the rig file is used")]
    offset = f"{_format_with_sign(plane.offset_mm or 0.0, 1)} mm"
    if plane.offset_std_mm:
        offset += f" ± {plane.offset_std_mm:.1f} mm"
    rows = [_format_cells("Plane of the plates, relative to the rig file", offset)]
    if plane.tilt_deg and plane.tilt_deg[0] is not None and plane.tilt_deg[1] is not None:
        tilt = f"{_format_with_sign(plane.tilt_deg[0], 2)}° in x, {_format_with_sign(plane.tilt_deg[1], 2)}° in y"
        rows.append(_format_cells("Tilt of the plane", tilt))
    if plane.by and plane.plates:
        rows.append(_format_cells("Plane found by", f"{plane.by} of {plane.plates} plates"))
    elif plane.by:
        rows.append(_format_cells("Plane found by", plane.by))
    return rows


def _format_with_sign(value: float, digits: int) -> str:
    """Format a number with its sign, a true minus, and no negative zero."""
    return f"{round(float(value), digits) + 0.0:+.{digits}f}".replace("-", "−")


def _format_cells(*cells: str, share: float | None = None) -> dict[str, Any]:
    """Return a line of a table; `share` is the length of its bar in percent, None without a bar."""
    return {"cells": list(cells), "share": share}


def _tabulate_boards(boards: Any) -> Table | None:
    """Return a table with a line for each figure and a column for each board; None without boards.

    It is narrow enough for a phone.
    """
    if not isinstance(boards, dict) or not boards:
        return None
    flat_boards = {name: _flatten_board(board) for name, board in boards.items()}
    keys = dict.fromkeys(k for board in flat_boards.values() for k in board)
    rows = [
        _format_cells(format_heading(k), *(format_value(board.get(k)) for board in flat_boards.values())) for k in keys
    ]
    caption = "Frames by board, of the recorded rows. Missing data are masked, never interpolated."
    return {"caption": caption, "head": ["Board", *map(str, boards)], "rows": rows}


def _flatten_board(board: dict[str, Any]) -> dict[str, Any]:
    """Flatten a board's figures: `direct_path_hz` {median} becomes `direct_path_median_hz`."""
    out: dict[str, Any] = {}
    for key, value in board.items():
        if key in _NOT_LISTED:
            continue
        if not isinstance(value, dict):
            out[key] = value
            continue
        stem, _, unit = key.rpartition("_")
        for part, number in value.items():
            if unit in UNITS:
                out[f"{stem}_{part}_{unit}"] = number
            else:
                out[f"{key}_{part}"] = number
    return out


def _tabulate_residuals(boards: Any) -> Table | None:
    """Return a table of `synchronisation`: a line for each stage, a column for each quantity; None if empty."""
    if not isinstance(boards, dict):
        return None
    flat_residuals: dict[str, dict[str, Any]] = {}
    for name, board in boards.items():
        for stage, quantities in (board.get("synchronisation") or {}).items():
            flat_residuals.setdefault(stage, {}).update(_flatten({name: quantities}))
    if not flat_residuals:
        return None
    keys = list(dict.fromkeys(k for v in flat_residuals.values() for k in v))
    rows = [
        _format_cells(format_heading(stage), *(format_value(v.get(k)) for k in keys))
        for stage, v in flat_residuals.items()
    ]
    # The caption says that the figures are standard deviations.
    head = ["After stage", *(format_heading(key.replace("_std", "")) for key in keys)]
    caption = (
        "Residual (standard deviation) after each stage of synchronisation: of one chirp as received and aligned, of"
        " the direct path in a position's average, and of the object referenced to it; amplitude relative to its mean."
    )
    return {"caption": caption, "head": head, "rows": rows}


def _flatten(value: dict[str, Any], prefix: str = "", nested: bool = True) -> dict[str, Any]:
    """Return path to value for nested dicts; only one level deep if `nested` is false."""
    out: dict[str, Any] = {}
    for k, v in value.items():
        name = f"{prefix} {k}".strip()
        if isinstance(v, dict) and v and (nested or not prefix):
            out |= _flatten(v, name, nested)
        else:
            out[name] = v
    return out


def _tabulate_seconds(seconds: Mapping[str, float] | None) -> Table | None:
    """Return the table of times with a bar each, relative to the longest; None without any."""
    if not seconds:
        return None
    longest = max([*seconds.values(), 1e-9])
    rows = [
        _format_cells(format_heading(k), f"{v:.2f} s", share=round(100 * v / longest, 1)) for k, v in seconds.items()
    ]
    return {"caption": "Time by stage.", "head": [], "rows": rows}
