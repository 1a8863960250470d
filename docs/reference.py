"""`python -m docs.reference --out DIR`: the documentation as static pages, its links checked.

The API reference is made from the docstrings with pdoc, pages and notebooks by `docs.site`.

A package that names its public functions (`__all__`, or `from ... import A as A`) has one page with these; another one
has a page for each module.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import pkgutil
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from types import ModuleType
from unittest import mock
from urllib.parse import unquote

import numpy.typing as npt
import pdoc.doc
import pdoc.render
from docs.site import build_site

# The rooms hold what public functions return: verdicts, scores, forecasts, processed scans.
ROOMS = ("materials", "planning", "products", "results", "imaging", "polarimetry")
PACKAGES = (
    "polysight",
    *(f"polysight.{room}" for room in ROOMS),
    "polysight_shared",
    "polysight_simulators",
    "polysight_pi",
)

# Start of the index's navigation, with a link to the other pages.
_NAVIGATION = '<nav class="pdoc"><p><a href="docs/README.html">How-tos, notebooks, gallery, formats</a></p>'
# An array's type as Python shows it once it is evaluated.
_ARRAY = re.compile(r"numpy\.ndarray\[tuple\[(?:typing\.)?Any, \.\.\.\], numpy\.dtype\[(?:numpy\.)?([\w.]+)\]\]")
# The function itself: `build` replaces the one in `inspect`.
_as_evaluated = inspect.formatannotation
# Links to base classes that have no place of their own.
_TO_PRIVATE = re.compile(r'<a href="[^"#]*#_[^"]*">(.*?)</a>')


def list_modules(name: str) -> Iterator[str]:
    """Names of a module and of everything in it that has a page of its own. Imports them."""
    module = import_module(name)
    yield name
    names = getattr(module, "__all__", None) or list_public_imports(module)
    for public in names:
        # A lazy name is imported now, for pdoc to see it.
        setattr(module, public, getattr(module, public))
    if names:
        # pdoc takes no other imported name for a public one.
        vars(module)["__all__"] = names
    elif hasattr(module, "__path__"):
        yield from (page for child in _children(module) for page in list_modules(child))


def list_public_imports(module: ModuleType) -> list[str]:
    """Names that a module imports as themselves, which makes them public (PEP 484)."""
    imports = (node for node in ast.walk(ast.parse(inspect.getsource(module))) if isinstance(node, ast.ImportFrom))
    return [alias.name for node in imports for alias in node.names if alias.asname == alias.name]


def _children(package: ModuleType) -> Iterator[str]:
    """Names of the public modules in a package."""
    for found in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        if not found.name.rpartition(".")[2].startswith("_"):
            yield found.name


def format_type(annotation: object) -> str:
    """Return a type as it is written in the sources: the union behind `ArrayLike` has 400 letters."""
    text = _as_evaluated(annotation)
    array_like = _as_evaluated(npt.ArrayLike).removeprefix("typing.").removeprefix("Union[").removesuffix("]")
    text = text.replace(array_like, "ArrayLike").replace("Union[ArrayLike]", "ArrayLike")
    text = text.replace("Union[ArrayLike, NoneType]", "ArrayLike | None")
    text = _ARRAY.sub(r"NDArray[\1]", text)
    return text.replace("xarray.core.dataset.Dataset", "xarray.Dataset").replace("typing.", "")


def build(names: Sequence[str], out: Path) -> list[Path]:
    """Write the pages of these modules, an index and a search index into `out`; returns the pages."""
    pdoc.render.configure(docformat="numpy", show_source=False, footer_text="polysight, from its docstrings")
    # Those of named tuples, which are shown as they are written.
    warnings.filterwarnings("ignore", "Error parsing type annotation")
    modules = {name: pdoc.doc.Module.from_name(name) for name in names}
    pages = []
    for name, module in modules.items():
        _hide_metadata_routing(module)
        page = out / f"{name.replace('.', '/')}.html"
        page.parent.mkdir(parents=True, exist_ok=True)
        # The types of variables, and those of parameters.
        with (
            mock.patch.object(pdoc.doc, "formatannotation", format_type),
            mock.patch.object(inspect, "formatannotation", format_type),
        ):
            html = pdoc.render.html_module(module, modules)
        page.write_text(_TO_PRIVATE.sub(r"\1", html), encoding="utf-8")
        pages.append(page)
    index = out / "index.html"
    index.write_text(pdoc.render.html_index(modules).replace('<nav class="pdoc">', _NAVIGATION, 1), encoding="utf-8")
    (out / "search.js").write_text(pdoc.render.search_index(modules), encoding="utf-8")
    return [*pages, index]


def _hide_metadata_routing(module: pdoc.doc.Module) -> None:
    """Leave out the methods that scikit-learn adds to every estimator, with pages of its own about their making."""
    for member in module.members.values():
        if isinstance(member, pdoc.doc.Class):
            for name in [name for name in member.members if name.startswith("set_") and name.endswith("_request")]:
                del member.members[name]


class _Page(HTMLParser):
    """Links and anchors of an HTML page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect `href` of links and `id` of any element."""
        table = dict(attrs)
        if tag == "a" and table.get("href"):
            self.links.append(str(table["href"]))
        if table.get("id"):
            self.anchors.add(str(table["id"]))


def link_faults(out: Path) -> list[str]:
    """Links between the pages below `out` whose file or anchor is not there: `page: link`."""
    pages = {path.resolve(): _Page(path.read_text(encoding="utf-8")) for path in sorted(out.rglob("*.html"))}
    faults = []
    for path, page in pages.items():
        for link in page.links:
            is_elsewhere = "://" in link and not link.startswith("file:")
            if is_elsewhere or link.startswith(("mailto:", "data:")):
                continue
            name, _, anchor = unquote(link).partition("#")
            target = (path.parent / name).resolve() if name else path
            is_other_file = target.suffix != ".html" and target.is_file()
            if is_other_file:
                continue
            known = pages.get(target)
            if known is None or (anchor and anchor not in known.anchors):
                faults.append(f"{path.relative_to(out.resolve())}: {link}")
    return faults


def main(argv: Sequence[str] | None = None) -> int:
    """Build the reference; 0 only when every link in it leads somewhere."""
    parser = argparse.ArgumentParser(
        prog="python -m docs.reference",
        description="Make the API reference from the docstrings, and check its links.",
        epilog="example:\n  python -m docs.reference --out out/docs",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the pages")
    parser.add_argument("--quick", action="store_true", help="without results of notebooks, without the gallery")
    args = parser.parse_args(argv)
    if args.out.exists() and not args.out.is_dir():
        parser.error(f"--out {args.out}: not a folder")
    names = list(dict.fromkeys(name for package in PACKAGES for name in list_modules(package)))
    build(names, args.out)
    pages = build_site(args.out, run=not args.quick)
    faults = link_faults(args.out)
    for fault in faults:
        sys.stdout.write(f"broken link: {fault}\n")
    sys.stdout.write(
        f"{args.out / 'index.html'}: {len(names)} modules, {len(pages)} pages, {len(faults)} broken links\n"
    )
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
