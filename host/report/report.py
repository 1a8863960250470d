"""`report.html`: one self-contained page, images inline, and the same figures as files."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from polysight.host.products import write_atomically
from polysight.host.report.context import ReportContext
from polysight.host.report.figures import FIGURES, UNKNOWN_COLOUR, colours_of, figures, patch_label, plate_label
from polysight.host.report.tables import coverage_sentence, key_numbers, masked_positions, quality_tables, text

DASH = "–"


def write_report(out_dir: Path, ctx: ReportContext) -> Path:
    """Write `report.html` and `figures/*.png` into a folder.

    Returns
    -------
    Path
        of the page.
    """
    pictures = figures(ctx)
    for name, data in pictures.items():
        write_atomically(out_dir / "figures" / f"{name}.png", data)
    page = out_dir / "report.html"
    write_atomically(page, render(ctx, pictures).encode("utf-8"))
    return page


def render(ctx: ReportContext, pictures: dict[str, bytes]) -> str:
    """The page as text, with the given PNG figures inline."""
    environment = Environment(
        loader=PackageLoader("polysight.host.report", "."),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    rows = [_row(r, colours_of(ctx)) for r in ctx.materials]
    seen = {r["truth"] for r in rows}
    alt = {
        **FIGURES,
        "materials": "Material map",
        "truth": "True plates",
        "permittivity": "Permittivity plot",
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
        rows=rows,
        replaced=_replaced_names(ctx),
        missed=[str(t["name"]) for t in ctx.truth or [] if str(t["name"]) not in seen] if rows else [],
        quality=quality_tables(ctx.quality),
        coverage=coverage_sentence(masked_positions(ctx)),
        config=[(k, text(v)) for k, v in ctx.config.items()],
        provenance=[(k, text(v)) for k, v in ctx.provenance.items()],
    )


def _replaced_names(ctx: ReportContext) -> list[str]:
    """`patch 1: ?? is NAME` for each name that the figures' fonts do not have."""
    pairs = [(patch_label(r), str(r["name"])) for r in ctx.materials if r.get("name")]
    pairs += [(plate_label(t, k), str(t["name"])) for k, t in enumerate(ctx.truth or [], 1)]
    return [f"{label} is {name}" for label, name in pairs if label != name]


def _lead(ctx: ReportContext) -> str:
    ny, nx = ctx.h.shape
    pixel = abs(float(ctx.x_m[1] - ctx.x_m[0])) * 1e3
    what = "simulated scan" if ctx.simulated else "scan"
    return (
        f"Co- and cross-polarised images of a {what}, {nx} × {ny} pixels of {pixel:g} mm: "
        "what reflects where, what it is made of, and how good the data were."
    )


def _row(r: dict[str, Any], colours: dict[str, str]) -> dict[str, Any]:
    """One line of the materials table, formatted."""
    name = str(r.get("name") or f"patch {r['label']}")
    truth = r.get("truth") or None
    e = r.get("permittivity")
    true_eps = truth["permittivity"] if truth else None
    ratio = r.get("ratio")
    p = complex(ratio["real"], ratio["imag"]) if ratio else None
    out: dict[str, Any] = {
        "label": r["label"],
        "name": name,
        "colour": colours.get(name, UNKNOWN_COLOUR),
        "metal_reference": bool(r.get("metal_reference")),
        "truth": str(truth["name"]) if truth else "",
        "right": bool(truth) and truth is not None and truth["name"] == r.get("name"),
        "votes": DASH if r.get("confidence") is None else f"{100 * r['confidence']:.0f} %",
        "real": "metal-like" if r.get("metal_like") else DASH,
        "loss": DASH,
        "real_error": "",
        "loss_error": "",
        "real_range": "",
        "loss_range": "",
        "true_real": ("metal" if truth["metal"] else DASH) if truth else DASH,
        "true_loss": DASH,
        "error": DASH,
        "relative_error": None,
        "p_abs": DASH if p is None else f"{abs(p):.2f}",
        "p_arg": DASH if p is None else f"{np.degrees(np.angle(p)):.1f}°".replace("-0.0°", "0.0°"),
        "pixels": r.get("interior_pixels", r.get("pixels", DASH)),
    }
    if e:
        (r0, r1), (i0, i1) = e["real_p30_p70"], e["imag_p30_p70"]
        out["real"], out["loss"] = f"{e['real']:.2f}", f"{-e['imag']:.2f}"
        real_std, loss_std = e.get("real_std"), e.get("imag_std")
        out["real_error"] = "" if real_std is None else f"± {real_std:.2f}"
        out["loss_error"] = "" if loss_std is None else f"± {loss_std:.2f}"
        out["real_range"], out["loss_range"] = f"({r0:.2f} … {r1:.2f})", f"({-i1:.2f} … {-i0:.2f})"
    if true_eps:
        out["true_real"], out["true_loss"] = f"{true_eps['real']:.2f}", f"{-true_eps['imag']:.2f}"
        if e:
            out["relative_error"] = e["real"] / true_eps["real"] - 1
            out["error"] = f"{100 * out['relative_error']:+.1f} %"
    return out
