"""Write `report.html`, one self-contained page with inline images, and the same figures as files."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape

from polysight.materials import UNKNOWN
from polysight.products import REPORT, permittivity_spread, refused_text, write_atomically
from polysight.report.context import ReportContext
from polysight.report.figures import FIGURES, figures
from polysight.report.style import colours_of, patch_colour, patch_label, plate_label
from polysight.report.tables import (
    budget_table,
    coverage_sentence,
    key_numbers,
    masked_positions,
    quality_tables,
    text,
)

DASH = "–"


def write_report(out_dir: Path, ctx: ReportContext) -> Path:
    """Write `report.html` and `figures/*.png` into a folder.

    Patches, verdict and error budget are those of the folder's materials.json, if it exists.

    Returns
    -------
    Path
        of the page.
    """
    ctx = ctx.with_products(out_dir)
    pictures = figures(ctx)
    for name, data in pictures.items():
        write_atomically(out_dir / "figures" / f"{name}.png", data)
    page = out_dir / REPORT
    write_atomically(page, render(ctx, pictures).encode("utf-8"))
    return page


def render(ctx: ReportContext, pictures: dict[str, bytes]) -> str:
    """Return the page as text, with the given PNG figures inline."""
    environment = Environment(
        loader=PackageLoader("polysight.report", "."),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    environment.filters["code"] = _code
    rows = [_row(r, colours_of(ctx)) for r in ctx.materials]
    seen = {r["truth"] for r in rows}
    alt = {
        **FIGURES,
        "materials": "Material map",
        "truth": "True plates",
        "permittivity": "Permittivity plot",
        "permittivity_map": "Map of the permittivity and its error",
        "coverage": "Masked positions",
    }
    centre = [f"{(float(a[0]) + float(a[-1])) * 500:.1f}" for a in (ctx.x_m, ctx.y_m)]
    return environment.get_template("report.html").render(
        ctx=ctx,
        images={key: base64.b64encode(pictures[key]).decode("ascii") if key in pictures else "" for key in alt},
        alt=alt,
        lead=_lead(ctx),
        keys=key_numbers(ctx, rows),
        centre=centre,
        verdict=ctx.verdict,
        remedies=_remedies(rows),
        rows=rows,
        with_errors=any(permittivity_spread(r.get("permittivity")) for r in ctx.materials),
        budget=budget_table(ctx.error_budget),
        replaced=_replaced_names(ctx),
        missed=[str(t["name"]) for t in ctx.truth or [] if str(t["name"]) not in seen] if rows else [],
        quality=quality_tables(ctx.quality),
        coverage=coverage_sentence(masked_positions(ctx)),
        config=[(k, text(v)) for k, v in ctx.config.items()],
        provenance=[(k, text(v)) for k, v in ctx.provenance.items()],
    )


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


def _replaced_names(ctx: ReportContext) -> list[str]:
    """Return `patch 1: ?? is NAME` for each name that the figures' fonts cannot draw."""
    pairs = [(patch_label(r), str(r["name"])) for r in ctx.materials if r.get("name")]
    pairs += [(plate_label(t, k), str(t["name"])) for k, t in enumerate(ctx.truth or [], 1)]
    return [f"{label} is {name}" for label, name in pairs if label != name]


def _lead(ctx: ReportContext) -> str:
    ny, nx = ctx.h.shape
    pixel = abs(float(ctx.x_m[1] - ctx.x_m[0])) * 1e3
    what = "simulated scan" if ctx.simulated else "scan"
    return (
        f"Co- and cross-polarised images of a {what}, {nx} × {ny} pixels of {pixel:g} mm: "
        "reflectivity, materials and quality of the data."
    )


def _row(r: dict[str, Any], colours: dict[str, str]) -> dict[str, Any]:
    """Format one line of the materials table."""
    truth = r.get("truth") or None
    e = r.get("permittivity")
    true_eps = truth["permittivity"] if truth else None
    ratio = r.get("ratio")
    p = complex(ratio["real"], ratio["imag"]) if ratio else None
    x0, y0, x1, y1 = r["box_mm"]
    is_metal = bool(r.get("metal_reference"))
    out: dict[str, Any] = {
        "label": r["label"],
        "name": str(r.get("name") or ("metal reference" if is_metal else f"patch {r['label']}")),
        "where": f"{(x0 + x1) / 2:.0f}, {(y0 + y1) / 2:.0f}".replace("-", "−"),
        "size": f"{x1 - x0:.0f} × {y1 - y0:.0f}",
        "colour": patch_colour(r, colours),
        "metal_reference": is_metal and bool(r.get("name")),
        "drawn_as": str(r.get("box") or ""),
        "refused": r.get("refused") or {},
        "why_refused": refused_text(r),
        "truth": str(truth["name"]) if truth else "",
        "strange": bool(truth) and r.get("name") == UNKNOWN and not truth.get("in_library", True),
        "right": truth is not None and (truth["name"] == r.get("name") or (is_metal and bool(truth.get("metal")))),
        "why": str(r.get("why") or ""),
        "votes": DASH if r.get("confidence") is None else f"{100 * r['confidence']:.0f} %",
        "real": "metal-like" if r.get("metal_like") else DASH,
        "loss": DASH,
        **dict.fromkeys(("real_error", "loss_error", "real_range", "loss_range", "dominated_by", "share", "do"), ""),
        "true_real": ("metal" if truth["metal"] else DASH) if truth else DASH,
        "true_loss": DASH,
        "error": DASH,
        "relative_error": None,
        "p_abs": DASH if p is None else f"{abs(p):.2f}",
        "p_arg": DASH if p is None else f"{np.degrees(np.angle(p)):.1f}°".replace("-0.0°", "0.0°"),
        "pixels": r.get("interior_pixels", r.get("pixels", DASH)),
    }
    if e:
        out |= _estimate(e)
    if true_eps:
        out["true_real"], out["true_loss"] = f"{true_eps['real']:.2f}", f"{-true_eps['imag']:.2f}"
        if e:
            out["relative_error"] = e["real"] / true_eps["real"] - 1
            out["error"] = f"{round(100 * out['relative_error'], 1) + 0.0:+.1f} %"  # + 0.0: no -0.0
    return out


def _estimate(e: dict[str, Any]) -> dict[str, str]:
    """Format a segment's permittivity with its errors and their main source."""
    out = {"real": f"{e['real']:.2f}", "loss": f"{-e['imag']:.2f}"}
    spread = permittivity_spread(e)
    if spread is not None:
        out["real_error"], out["loss_error"] = f"± {spread.real_std:.2f}", f"± {spread.loss_std:.2f}"
    if "real_p30_p70" in e and "imag_p30_p70" in e:
        (r0, r1), (i0, i1) = e["real_p30_p70"], e["imag_p30_p70"]
        out["real_range"], out["loss_range"] = f"({r0:.2f} … {r1:.2f})", f"({-i1:.2f} … {-i0:.2f})"
    main = e.get("dominated_by")
    share = (e.get("shares") or {}).get(main)
    out["dominated_by"], out["do"] = str(main or ""), str(e.get("do") or "")
    out["share"] = "" if share is None else f"{100 * share:.0f} %"
    return out
