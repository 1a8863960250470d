"""Faults of a page that are found without running its commands."""

from __future__ import annotations

import ast
import importlib
import tomllib
from pathlib import Path
from urllib.parse import unquote

from docs.check.commands import OWN, command_faults, mention_faults
from docs.check.pages import MARKS, SHELLS, Block, Page, read_page


def page_faults(page: Page) -> list[str]:
    """Broken links and anchors, commands that do not exist, blocks that cannot be read: `page:line: what`."""
    found: list[tuple[int, str]] = []
    for line, target in page.links:
        found += [(line, fault) for fault in link_faults(page, target)]
    for block in page.blocks:
        found += block_faults(block)
    for line, text in page.spans:
        found += [(line, fault) for fault in mention_faults(text)]
    return [f"{page.name}:{line}: {fault}" for line, fault in found]


def link_faults(page: Page, target: str) -> list[str]:
    """A link within the repository: its file, and the anchor in it. Addresses elsewhere are not looked at."""
    if "://" in target or target.startswith("mailto:"):
        return []
    name, _, anchor = target.partition("#")
    file = (page.path.parent / unquote(name)).resolve() if name else page.path
    if not file.exists():
        return [f"link to {target}: no such file"]
    if anchor and (not file.name.endswith(".md") or anchor not in read_page(Path(file)).anchors):
        return [f"link to {target}: no such heading"]
    return []


def block_faults(block: Block) -> list[tuple[int, str]]:
    """Of one fenced block, by its language."""
    if block.language in SHELLS:
        marks = [
            (block.line, f"unknown mark {m!r}, there are {', '.join(MARKS)}") for m in block.info[1:] if m not in MARKS
        ]
        return marks + [(n, fault) for n, command in block.commands() for fault in command_faults(command)]
    if block.language == "":
        # In a list, a line left of its block ends list and block: the closing fence then opens another one.
        headings = [n for n, text in enumerate(block.text.splitlines(), block.line) if text.startswith("## ")]
        if headings:
            return [(headings[0], "a heading in a code block: indent every line of the block above it as its fences")]
        # What a program prints, or an indented example: a command may have a remark after two spaces.
        return [
            (n, f)
            for n, text in enumerate(block.text.splitlines(), block.line)
            for f in mention_faults(text.strip().split("  ")[0])
        ]
    try:
        if block.language == "toml":
            tomllib.loads(block.text)
        if block.language == "python":
            return _import_faults(block)
    except (SyntaxError, ValueError) as e:
        return [(block.line, f"{block.language} block: {e}")]
    return []


def _import_faults(block: Block) -> list[tuple[int, str]]:
    """Names that a Python block imports from us and that are not there."""
    faults: list[tuple[int, str]] = []
    for node in ast.walk(ast.parse(block.text)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in OWN:
            try:
                module = importlib.import_module(node.module)
            except ImportError as e:
                faults.append((block.line + node.lineno - 1, str(e)))
                continue
            missing = [a.name for a in node.names if not hasattr(module, a.name)]
            faults += [(block.line + node.lineno - 1, f"{node.module} has no {name}") for name in missing]
    return faults
