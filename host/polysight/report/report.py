"""Write `report.html`, one self-contained page with inline images, and the same figures as files.

Tables are plain dicts (caption, head, rows) for the page's template. The columns of the patches' figures are those that
`polysight.results.PatchFigures` declares with a title.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from polysight.materials import UNKNOWN
from polysight.products import REPORT, ProcessedScan
from polysight.report.figures import FIGURES, figures, masked_positions
from polysight.report.style import colours_of, patch_colour, patch_label, plate_label
from polysight.report.surface import surface_figure
from polysight.results import (
    ErrorBudget,
    Figure,
    IncidenceError,
    LeakageError,
    PatchFigures,
    PermittivityFigures,
    PlaneError,
    ScanQuality,
    figures_of,
    percent,
    plain,
)
from polysight.surfaces import SURFACE, read_surface
from polysight_shared.config import Instrument
from polysight_shared.files import write_atomically
from polysight_shared.geometry import incidence_deg

DASH = "–"
NOT_ON_HARDWARE = "Nothing of this instrument has run on hardware yet."
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
_NOT_LISTED = ("synchronisation", "raw_crc32", "masked_columns", "rows_recorded")
UNITS = {"hz": "Hz", "rad": "rad", "deg": "°", "s": "s", "db": "dB", "mm": "mm", "m": "m", "bytes": "bytes"}


def write_report(out_dir: Path, scan: ProcessedScan) -> Path:
    """Write `report.html` and `figures/*.png` into a folder; return the path of the page."""
    pictures = figures(scan)
    surface = read_surface(out_dir / SURFACE) if (out_dir / SURFACE).exists() else None
    if surface is not None:
        pictures["surface"] = surface_figure(surface)
    for name, data in pictures.items():
        write_atomically(out_dir / "figures" / f"{name}.png", data)
    page = out_dir / REPORT
    write_atomically(page, render(scan, pictures).encode("utf-8"))
    return page


def render(scan: ProcessedScan, pictures: dict[str, bytes]) -> str:
    """Return the page as text, with the given PNG figures inline."""
    environment = Environment(
        loader=PackageLoader("polysight.report", "."),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["code"] = _code
    colours = colours_of(scan)
    rows = [_row(patch, colours) for patch in scan.segments]
    names_found = {row["truth"] for row in rows}
    alt = {
        **FIGURES,
        "materials": "Material map",
        "truth": "True plates",
        "permittivity": "Permittivity plot",
        "permittivity_map": "Map of the permittivity and its error",
        "coverage": "Masked positions",
        "surface": "Surfaces from three sides",
    }
    centre = [f"{(float(a[0]) + float(a[-1])) * 500:.1f}" for a in (scan.x_m, scan.y_m)]
    materials = scan.materials if scan.judged else None
    budget = (scan.materials and scan.materials.error_budget) or None
    return environment.get_template("report.html").render(
        scan=scan,
        title=f"Scan {scan.scan_id}".strip(),
        simulated=scan.stamped,
        notes=_notes(scan),
        metal_how=materials.metal_reference.how if materials and materials.metal_reference else "",
        library=materials.library if materials else "",
        images={key: base64.b64encode(pictures[key]).decode("ascii") if key in pictures else "" for key in alt},
        alt=alt,
        lead=_lead(scan),
        keys=key_numbers(scan, rows),
        centre=centre,
        verdict=scan.verdict,
        remedies=_remedies(rows),
        rows=rows,
        headings=[figure.column.title for figure in _shown_figures(scan)],
        with_errors=any(patch.permittivity and patch.permittivity.spread for patch in scan.segments),
        budget=None if budget is None else budget_table(budget),
        replaced=_replaced_names(scan),
        missed=[plate.name for plate in scan.plates if plate.name not in names_found] if rows else [],
        quality=quality_tables(plain(scan.quality)),
        coverage=coverage_sentence(masked_positions(scan)),
        config=[] if scan.rig is None else _config(scan.rig),
        rig_file=tomli_w.dumps(scan.facts.instrument) if scan.facts.instrument else "",
        provenance=_provenance(scan),
    )


def _notes(scan: ProcessedScan) -> list[str]:
    """Return the sentences at the top: damage of the manifest, and why nothing was named."""
    notes = [scan.quality.coverage.damage if scan.quality.coverage else "", NOT_ON_HARDWARE]
    if scan.materials is not None and scan.materials.model is None:
        notes.append(scan.materials.library)
    return [note for note in notes if note]


def _config(rig: Instrument) -> list[tuple[str, str]]:
    """Return a short summary of the rig file: name and text."""
    chirp, grid, leakage = rig.chirp, rig.grid, rig.polarimetry
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


def _provenance(scan: ProcessedScan) -> list[tuple[str, str]]:
    processed = scan.facts.processed_utc or ""
    if not processed:
        return []
    moment = datetime.fromisoformat(processed).strftime("%Y-%m-%d %H:%M:%S UTC")
    return [("scan", scan.scan_id), ("processed", moment), *(scan.facts.versions or {}).items()]


def _shown_figures(scan: ProcessedScan) -> list[Figure]:
    """Return the declared figures of patches that have a heading in tables for people."""
    kind = type(scan.segments[0]) if scan.segments else PatchFigures
    return [figure for figure in figures_of(kind) if figure.column.title]


def _code(words: str) -> Markup:
    """Escape text and mark `commands` in it as code."""
    parts = [escape(part) for part in words.split("`")]
    return Markup("").join(Markup("<code>{}</code>").format(part) if i % 2 else part for i, part in enumerate(parts))


def _remedies(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the measurements that would shrink the errors, each with the patches that it helps."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row["do"]:
            found.setdefault((row["dominated_by"], row["do"]), []).append(str(row["label"]))
    return [{"what": what, "do": do, "patches": ", ".join(labels)} for (what, do), labels in found.items()]


def _replaced_names(scan: ProcessedScan) -> list[str]:
    """Return `patch 1: ?? is NAME` for each name that the figures' fonts cannot draw."""
    pairs = [(patch_label(patch), patch.name) for patch in scan.segments if patch.name]
    pairs += [(plate_label(plate, number), plate.name) for number, plate in enumerate(scan.plates, 1)]
    return [f"{label} is {name}" for label, name in pairs if label != name]


def _lead(scan: ProcessedScan) -> str:
    ny, nx = scan.h.shape
    pixel_mm = abs(float(scan.x_m[1] - scan.x_m[0])) * 1e3
    what = "simulated scan" if scan.stamped else "scan"
    return (
        f"Co- and cross-polarised images of a {what}, {nx} × {ny} pixels of {pixel_mm:g} mm: "
        "reflectivity, materials and quality of the data."
    )


def _row(patch: PatchFigures, colours: dict[str, str]) -> dict[str, Any]:
    """Format one line of the materials table."""
    truth, e = patch.truth, patch.permittivity
    name = patch.name or ("metal reference" if patch.metal_reference else f"patch {patch.label}")
    row: dict[str, Any] = {
        "label": patch.label,
        "name": name,
        "where": f"{patch.centre_x_mm:.0f}, {patch.centre_y_mm:.0f}".replace("-", "−"),
        "size": f"{patch.width_mm:.0f} × {patch.height_mm:.0f}",
        "colour": patch_colour(patch, colours),
        "metal_reference": patch.metal_reference and bool(patch.name),
        "drawn_as": patch.box or "",
        "refused": patch.refused is not None,
        "why_refused": patch.refused_text or "",
        "truth": truth.name if truth else "",
        "strange": truth is not None and patch.name == UNKNOWN and not truth.in_library,
        "right": truth is not None and (truth.name == patch.name or (patch.metal_reference and truth.metal)),
        "why": patch.why,
        "votes": _share(patch.confidence, 0),
        "real": "metal-like" if patch.metal_like else DASH,
        "loss": DASH,
        **dict.fromkeys(("real_error", "loss_error", "real_range", "loss_range", "dominated_by", "share", "do"), ""),
        "true_real": ("metal" if truth.metal else DASH) if truth else DASH,
        "true_loss": DASH,
        "error": DASH,
        "relative_error": None,
        "pixels": patch.pixels_used,
        "shown": [figure.shown(patch) for figure in figures_of(type(patch)) if figure.column.title],
    }
    if e is not None:
        row |= _estimate(e)
    if patch.true_permittivity is not None:
        row["true_real"] = f"{patch.true_permittivity.real:.2f}"
        row["true_loss"] = f"{-patch.true_permittivity.imag:.2f}"
        if e is not None:
            row["relative_error"] = e.real / patch.true_permittivity.real - 1
            # Adding zero after rounding removes the sign of a negative zero.
            row["error"] = f"{round(100 * row['relative_error'], 1) + 0.0:+.1f} %"
    return row


def _estimate(e: PermittivityFigures) -> dict[str, str]:
    """Format a permittivity with its errors and their main source."""
    row = {"real": f"{e.real:.2f}", "loss": f"{e.loss:.2f}"}
    if e.spread is not None:
        row["real_error"], row["loss_error"] = f"± {e.spread.real_std:.2f}", f"± {e.spread.loss_std:.2f}"
    if e.real_p30_p70 and e.imag_p30_p70:
        (r0, r1), (i0, i1) = e.real_p30_p70, e.imag_p30_p70
        row["real_range"], row["loss_range"] = f"({r0:.2f} … {r1:.2f})", f"({-i1:.2f} … {-i0:.2f})"
    share = e.shares.get(e.dominated_by or "")
    row["dominated_by"], row["do"] = e.dominated_by or "", e.do or ""
    row["share"] = "" if share is None else f"{100 * share:.0f} %"
    return row


def coverage_sentence(masks: dict[str, npt.NDArray[np.bool_]]) -> str:
    """Say how many positions of each board are masked; "" if that is not known."""
    if not masks:
        return ""
    if not any(m.any() for m in masks.values()):
        return "Every position of every board has data."
    counts = [f"{name} {int(m.sum())} of {m.size} ({m.mean():.2%})" for name, m in masks.items()]
    return f"Positions without data, left out of the images: {', '.join(counts)}."


def imaging_table(imaging: Any) -> Table | None:
    """Return the table of `imaging` of quality.json, a column for each board; None without it."""
    boards = {k: v for k, v in imaging.items() if isinstance(v, dict)} if isinstance(imaging, dict) else {}
    if not boards:
        return None
    rows = [
        _cells(heading, *(_number(board.get(key), " × " if key.endswith("_mm") else ", ") for board in boards.values()))
        for key, heading in _IMAGING_ROWS
        if any(key in board for board in boards.values())
    ]
    caption = "Imaging. The point response is computed for the middle of the image, with taper and mask as they are."
    for notice in imaging.get("notices", ()):
        caption += f" {notice}."
    return {"caption": caption, "head": ["Board", *map(str, boards)], "rows": rows}


def _is_unknown(value: Any) -> bool:
    """True for None, and for numbers that are not finite: just computed figures have them where files have null."""
    return value is None or (isinstance(value, float | np.floating) and not np.isfinite(value))


def _share(value: float | None, digits: int) -> str:
    return "–" if value is None or _is_unknown(value) else f"{100 * value:.{digits}f} %"


def _number(value: Any, between: str = " × ") -> str:
    if _is_unknown(value):
        return "–"
    if isinstance(value, list | tuple):
        return between.join(_number(v) for v in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def text(value: Any) -> str:
    """Format a value for reading: grouped thousands, few digits, yes and no, lists with commas."""
    if _is_unknown(value):
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{int(value):,}".replace(",", "\u202f") if abs(int(value)) >= 10000 else str(int(value))
    if isinstance(value, float | np.floating):
        v = float(value)
        if v == int(v) and abs(v) < 1e15:
            return text(int(v))
        return f"{v:.3g}" if abs(v) < 1000 else f"{v:,.0f}".replace(",", "\u202f")
    if isinstance(value, dict):
        return ", ".join(f"{k}: {text(v)}" for k, v in value.items()) or "–"
    if isinstance(value, list | tuple):
        return ", ".join(text(v) for v in value) or "none"
    return str(value)


def pretty(key: str) -> str:
    """Format a key as a heading: `RH if_hz` becomes `RH IF (Hz)`."""
    words = key.replace("_", " ").split()
    unit = UNITS.get(words[-1]) if len(words) > 1 else None
    if unit:
        words = words[:-1]
    out = " ".join({"if": "IF", "std": ""}.get(w, w) for w in words).replace("  ", " ").strip()
    return f"{out} ({unit})" if unit else out


def key_numbers(scan: ProcessedScan, rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the headline figures: value and text."""
    out: list[dict[str, str]] = []

    def add(value: str, what: str) -> None:
        out.append({"value": value, "text": what})

    if count := scan.plates_named:
        aside = f", {count.strange} recognised as not in the library" if count.strange else ""
        add(f"{count.right} of {count.plates}", f"plates named right{aside}")
    elif rows:
        add(str(len(rows)), "patches found")
    accuracy = scan.materials and scan.materials.pixel_accuracy
    if accuracy is not None:
        expected = scan.expected_accuracy
        aside = "" if expected is None else f"; their own confidence expects {_share(expected, 1)}"
        add(_share(accuracy, 1), f"of interior pixels named right{aside}")
    errors = [abs(r["relative_error"]) for r in rows if r["relative_error"] is not None]
    if errors:
        add(f"{100 * float(np.median(errors)):.1f} %", f"median error of ε′, worst {100 * max(errors):.1f} %")
    for value, what in _received(scan.quality):
        add(value, what)
    if seconds := scan.quality.seconds_per_stage:
        total = sum(seconds.values())
        add(f"{total:.1f} s" if total < 100 else f"{total / 60:.1f} min", "of processing, all stages")
    return out


def _received(quality: ScanQuality) -> list[tuple[str, str]]:
    """Return shares of rows and frames received: of the plan, or of recorded rows in products without `coverage`."""
    if coverage := quality.coverage:
        share = percent(coverage.frames_received, coverage.frames_planned, 2)
        frames = (share, f"of {text(coverage.frames_planned)} planned frames received")
        recorded = (f"{coverage.rows_recorded} of {coverage.rows_planned}", "rows recorded")
        return [recorded, frames] if coverage.rows_absent else [frames]
    expected = sum(board.frames_expected for board in quality.boards.values())
    received = sum(board.frames_received for board in quality.boards.values())
    if not expected:
        return []
    return [(percent(received, expected, 2), f"of {text(expected)} frames of recorded rows received")]


def quality_tables(quality: dict[str, Any]) -> list[Table]:
    """Return tables of the known parts of quality.json, then one of all other keys."""
    known = {"boards", "seconds_per_stage", "imaging", "verdict", "error_budget"}
    boards = quality.get("boards")
    parts = (
        _boards(boards),
        _residuals(boards),
        imaging_table(quality.get("imaging")),
        _seconds(quality.get("seconds_per_stage")),
    )
    out = [part for part in parts if part]
    if rest := {k: v for k, v in quality.items() if k not in known}:
        flat = _flatten(rest, nested=False)
        rows = [_cells(pretty(k), text(v)) for k, v in flat.items()]
        out.append({"caption": "Rows, masked data and other figures.", "head": [], "rows": rows})
    return out


_SOURCES = {
    "measured": "measured (rig file)",
    "prior and scene": "not measured; estimated from its prior and the scene",
    "scene": "estimated from the scene",
}


def budget_table(budget: ErrorBudget) -> Table | None:
    """Return the table of the error budget: leakage, plane, angle, evidence for metal; None without any of them."""
    rows = [*_leakage_rows(budget.leakage), *_incidence_rows(budget.incidence), *_plane_rows(budget.plane)]
    metal = budget.metal
    if metal is not None and metal.score is not None:
        evidence = f"score {_signed(metal.score, 1)} from {metal.others} other patches"
        if metal.channel_ratio_db is not None:
            evidence += f"; V over H {_signed(metal.channel_ratio_db, 1)} dB relative to the direct path"
        rows.append(_cells("Evidence that the reference is metal", evidence))
    if not rows:
        return None
    caption = "What the errors of the permittivities were computed with. ± is a standard deviation."
    return {"caption": caption, "head": [], "rows": rows}


def _leakage_rows(leakage: LeakageError | None) -> list[dict[str, Any]]:
    if leakage is None:
        return []
    rows = [_cells("Leakage", _SOURCES.get(leakage.source, leakage.source))]
    stds = leakage.std or (None, None)
    for channel, value, std in (("H", leakage.h, stds[0]), ("V", leakage.v, stds[1])):
        if value is not None and value[0] is not None and value[1] is not None:
            error = "" if std is None else f" ± {std:.3f}"
            sign = "+" if value[1] >= 0 else "−"
            number = f"{_signed(value[0], 3)} {sign} {abs(value[1]):.3f}i{error}"
            rows.append(_cells(f"Leakage of {channel}, relative to its own channel", number))
    return rows


def _incidence_rows(incidence: IncidenceError | None) -> list[dict[str, Any]]:
    if incidence is None or incidence.deg is None:
        return []
    error = "" if incidence.std_deg is None else f" ± {incidence.std_deg:.2f}°"
    return [_cells("Incidence angle", f"{incidence.deg:.2f}°{error}")]


def _plane_rows(plane: PlaneError | None) -> list[dict[str, Any]]:
    if plane is None:
        return []
    if not plane.known:
        return [_cells("Plane of the plates", "not found; that of the rig file is used")]
    error = f" ± {plane.offset_std_mm:.1f} mm" if plane.offset_std_mm else ""
    offset = f"{_signed(plane.offset_mm or 0.0, 1)} mm{error}"
    rows = [_cells("Plane of the plates, relative to the rig file", offset)]
    if plane.tilt_deg and plane.tilt_deg[0] is not None and plane.tilt_deg[1] is not None:
        tilt = f"{_signed(plane.tilt_deg[0], 2)}° in x, {_signed(plane.tilt_deg[1], 2)}° in y"
        rows.append(_cells("Tilt of the plane", tilt))
    if plane.by:
        rows.append(_cells("Plane found by", plane.by + (f" of {plane.plates} plates" if plane.plates else "")))
    return rows


def _signed(value: float, digits: int) -> str:
    """Format a number with its sign, a true minus, and no negative zero."""
    return f"{round(float(value), digits) + 0.0:+.{digits}f}".replace("-", "−")


def _cells(*cells: str, share: float | None = None) -> dict[str, Any]:
    return {"cells": list(cells), "share": share}


def _boards(boards: Any) -> Table | None:
    """Return a table with a line for each figure and a column for each board: narrow enough for a phone."""
    if not isinstance(boards, dict) or not boards:
        return None
    flat = {name: _numbers_of(board) for name, board in boards.items()}
    keys = dict.fromkeys(k for board in flat.values() for k in board)
    rows = [_cells(pretty(k), *(text(board.get(k)) for board in flat.values())) for k in keys]
    caption = "Frames by board, of the recorded rows. Missing data are masked, never interpolated."
    return {"caption": caption, "head": ["Board", *map(str, boards)], "rows": rows}


def _numbers_of(board: dict[str, Any]) -> dict[str, Any]:
    """Flatten a board's figures: `direct_path_hz` {median} becomes `direct_path_median_hz`."""
    out: dict[str, Any] = {}
    for key, value in board.items():
        if key in _NOT_LISTED:
            continue
        stem, _, unit = key.rpartition("_")
        for part, number in value.items() if isinstance(value, dict) else ():
            out[f"{stem}_{part}_{unit}" if unit in UNITS else f"{key}_{part}"] = number
        if not isinstance(value, dict):
            out[key] = value
    return out


def _residuals(boards: Any) -> Table | None:
    """Return a table of `synchronisation` of all boards: a line for each stage, a column for each quantity."""
    flat: dict[str, dict[str, Any]] = {}
    for name, board in boards.items() if isinstance(boards, dict) else ():
        for stage, quantities in (board.get("synchronisation") or {}).items():
            flat.setdefault(stage, {}).update(_flatten({name: quantities}))
    if not flat:
        return None
    keys = list(dict.fromkeys(k for v in flat.values() for k in v))
    rows = [_cells(pretty(stage), *(text(v.get(k)) for k in keys)) for stage, v in flat.items()]
    head = ["After stage", *map(pretty, keys)]
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
        deeper = isinstance(v, dict) and v and (nested or not prefix)
        out.update(_flatten(v, name, nested) if deeper else {name: v})
    return out


def _seconds(seconds: Mapping[str, float] | None) -> Table | None:
    if not seconds:
        return None
    longest = max([*seconds.values(), 1e-9])
    rows = [_cells(pretty(k), f"{v:.2f} s", share=round(100 * v / longest, 1)) for k, v in seconds.items()]
    return {"caption": "Time by stage.", "head": [], "rows": rows}
