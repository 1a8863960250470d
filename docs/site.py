"""Static pages of the documentation: every Markdown page, the gallery's pictures, and the notebooks with their results.

The links between pages stay, with `.html` for `.md` and `.ipynb`; pictures and other linked files are copied, so that
the folder can be moved.
"""

from __future__ import annotations

import contextlib
import html
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import nbformat
from docs.check.pages import ROOT, all_pages, inline_parts, make_slug
from docs.notebooks import run_notebook
from markdown_it import MarkdownIt

import polysight

NOTEBOOKS = ROOT / "examples" / "notebooks"
GALLERY = ROOT / "docs" / "gallery.md"
# A link or picture within the repository: attribute, file, anchor.
_TARGET = re.compile(r'((?:href|src)=")([^"#:]+)(#[^"]*)?"')
# The file that a block of the gallery writes.
_PICTURE = re.compile(r'"out/(gallery-\w+\.png)"')
_STYLE = (
    "body{max-width:60em;margin:2em auto;padding:0 1em;font:16px/1.55 system-ui,sans-serif}"
    "pre{background:#f4f6f9;padding:.8em;overflow-x:auto}img{max-width:100%}"
    "table{border-collapse:collapse}td,th{border:1px solid #ddd;padding:.3em .6em;text-align:left}"
)


def build_site(out: Path, *, run: bool) -> list[Path]:
    """Write all pages into `out`; with `run` the notebooks' results and the gallery's pictures, too."""
    made = [_write(path, out, _from_markdown(path)) for path in site_pages()]
    with tempfile.TemporaryDirectory(prefix="polysight-docs-") as name:
        folder = Path(name)
        notebooks = sorted(NOTEBOOKS.glob("*.ipynb"))
        made += [_write(path, out, _from_notebook(path, folder if run else None)) for path in notebooks]
        if run:
            polysight.simulate("examples/own-scene.toml", folder / "out" / "gallery")
            made.append(_write(GALLERY, out, draw_pictures(_from_markdown(GALLERY), folder, out)))
    return made


def site_pages() -> list[Path]:
    """Markdown files that become pages."""
    return [*all_pages(), ROOT / "CONTRIBUTING.md", ROOT / "tests/README.md"]


def _write(path: Path, out: Path, body: str) -> Path:
    """Write a page at its place below `out`."""
    page = out / path.relative_to(ROOT).with_suffix(".html")
    page.parent.mkdir(parents=True, exist_ok=True)
    pages = {*site_pages(), *NOTEBOOKS.glob("*.ipynb")}

    def turn(link: re.Match[str]) -> str:
        """Return a link relative to the page; a linked file that is not a page is copied to the pages' folder."""
        target = (path.parent / link[2]).resolve()
        if target in pages:
            place = Path(os.path.relpath(out / target.relative_to(ROOT).with_suffix(".html"), page.parent))
            return f'{link[1]}{place.as_posix()}{link[3] or ""}"'
        if (page.parent / link[2]).is_file():
            # A picture that was drawn for the page.
            return link[0]
        if target.is_file():
            copy = out / target.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(target.read_bytes())
            return f'{link[1]}{Path(os.path.relpath(copy, page.parent)).as_posix()}"'
        # The check of the links finds it.
        return link[0]

    title = html.escape(path.stem.replace("-", " "))
    head = f'<!doctype html><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
    index = Path(os.path.relpath(out / "docs/README.html", page.parent)).as_posix()
    reference = Path(os.path.relpath(out / "index.html", page.parent)).as_posix()
    top = f'<p><a href="{index}">Documentation</a> · <a href="{reference}">Reference</a></p>'
    page.write_text(head + top + _TARGET.sub(turn, body), encoding="utf-8")
    return page


def _from_markdown(path: Path) -> str:
    """Return a page's HTML; headings have the anchors that links name."""
    parser = MarkdownIt("commonmark", {"html": True}).enable("table")
    tokens = parser.parse(path.read_text(encoding="utf-8"))
    used: dict[str, int] = {}
    for number, token in enumerate(tokens):
        if token.type == "heading_open":
            heading = "".join(p.content for p in inline_parts(tokens[number + 1]) if p.type in ("text", "code_inline"))
            token.attrSet("id", make_slug(heading, used))
    return parser.renderer.render(tokens, parser.options, {})


def _from_notebook(path: Path, folder: Path | None) -> str:
    """Return a notebook's HTML; with its results, if a folder to run it in is given."""
    cells = nbformat.read(path, as_version=4).cells
    outputs = [""] * len(cells)
    if folder is not None:
        with contextlib.chdir(folder):
            _, outputs = run_notebook(path)
    parser = MarkdownIt("commonmark").enable("table")
    parts = []
    for cell, output in zip(cells, outputs, strict=True):
        source = (
            parser.render(cell.source) if cell.cell_type == "markdown" else f"<pre>{html.escape(cell.source)}</pre>"
        )
        parts.append(source + output)
    return "\n".join(parts)


def draw_pictures(body: str, folder: Path, out: Path) -> str:
    """Run the gallery's blocks in `folder`; return its page with a picture below each."""
    blocks = re.findall(r"<pre><code class=\"language-python\">(.*?)</code></pre>", body, re.DOTALL)
    for block in blocks:
        code = html.unescape(block)
        subprocess.run([sys.executable, "-c", code], cwd=folder, check=True)
        for name in _PICTURE.findall(code):
            picture = out / "docs" / name
            picture.write_bytes((folder / "out" / name).read_bytes())
            shown = f'<pre><code class="language-python">{block}</code></pre>'
            body = body.replace(shown, f'{shown}<img alt="simulated" src="{picture.name}">')
    return body
