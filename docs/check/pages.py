"""What a page holds: links, anchors, code blocks and words in code type, each with its line."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).resolve().parents[2]
MARKS = {
    "rig": "beside the simulated rig",
    "run": "a Python block that is run, not only read",
    "hardware": "needs hardware, or changes a machine",
    "minutes": "takes long",
    "asks": "asks before it changes something",
}
"""Words of a comment above a block, `<!-- check: minutes -->`: how its commands are run, or why they are not."""
_MARK = re.compile(r"<!-- check: ([a-z ]+) -->")
SHELLS = ("sh", "bash", "console")
_HTML_TARGET = re.compile(r'(?:src|href)="([^"]+)"')
_HTML_ANCHOR = re.compile(r'(?:id|name)="([^"]+)"')


@dataclass(frozen=True)
class Block:
    """A fenced block: its first line of content (from 1), the words of its info string, its text."""

    line: int
    info: tuple[str, ...]
    text: str

    @property
    def language(self) -> str:
        """First word of the info string."""
        return self.info[0] if self.info else ""

    @property
    def kept_back(self) -> str:
        """Why the block is not run; empty when it is."""
        if self.language not in (*SHELLS, "python"):
            return "not marked as a shell block"
        return "; ".join(MARKS[m] for m in self.info[1:] if m in MARKS and m not in ("rig", "run"))

    @property
    def is_run(self) -> bool:
        """Whether `--run` runs it."""
        return (self.language in SHELLS and not self.kept_back) or self.info == ("python", "run")

    def shell_lines(self) -> list[tuple[int, str]]:
        """The lines that a shell is given, each with its line in the page. With `$ ` prompts, only those."""
        lines = list(enumerate(self.text.splitlines(), self.line))
        if self.language != "console" and not any(x.startswith("$ ") for _, x in lines):
            return lines
        taken: list[tuple[int, str]] = []
        for number, text in lines:
            if text.startswith("$ ") or (text.startswith("> ") and taken and taken[-1][1].endswith("\\")):
                taken.append((number, text[2:]))
        return taken

    def commands(self) -> list[tuple[int, str]]:
        """Its commands, joined over line ends in quotes and after a backslash; no comments, no here-documents."""
        commands: list[tuple[int, str]] = []
        goes_on = False
        end_of_document = ""
        for number, text in self.shell_lines():
            if end_of_document:
                end_of_document = "" if text.strip() == end_of_document else end_of_document
            elif goes_on:
                first, begun = commands[-1]
                commands[-1] = first, begun.removesuffix("\\") + "\n" * (not begun.endswith("\\")) + text
            elif text.strip() and not text.lstrip().startswith("#"):
                commands.append((number, text))
            goes_on = bool(commands) and (commands[-1][1].endswith("\\") or _is_open(commands[-1][1]))
            if not goes_on and (document := re.search(r"<<-?\s*['\"]?(\w+)", text)):
                end_of_document = document[1]
        return commands


@dataclass(frozen=True)
class Page:
    """A Markdown file: (line, target) of links and images, names of anchors, blocks, and (line, text) in code type."""

    path: Path
    links: tuple[tuple[int, str], ...]
    anchors: frozenset[str]
    blocks: tuple[Block, ...]
    spans: tuple[tuple[int, str], ...]

    @property
    def name(self) -> str:
        """The path from the root."""
        return self.path.relative_to(ROOT).as_posix() if self.path.is_relative_to(ROOT) else str(self.path)


def all_pages(root: Path = ROOT) -> list[Path]:
    """README and every page of docs: those that docs/README.md links to in its order, then the others."""
    index = root / "docs/README.md"
    found = sorted((root / "docs").rglob("*.md"))
    if index.exists():
        order = [(index.parent / target).resolve() for _, target in read_page(index).links]
        found.sort(key=lambda p: order.index(p.resolve()) if p.resolve() in order else len(order))
    return [root / "README.md", *found]


def _is_open(command: str) -> bool:
    """True if a quotation continues on the next line."""
    try:
        shlex.split(command, comments=True)
    except ValueError:
        return True
    return False


def make_slug(heading: str, used: dict[str, int]) -> str:
    """The anchor that GitHub gives a heading."""
    slug = re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")
    used[slug] = used.get(slug, -1) + 1
    return f"{slug}-{used[slug]}" if used[slug] else slug


def inline_parts(token: Token) -> Iterator[Token]:
    """The parts of a line, those inside links and images too."""
    for child in token.children or ():
        yield child
        yield from inline_parts(child)


@cache
def read_page(path: Path) -> Page:
    """Parse a page."""
    links: list[tuple[int, str]] = []
    anchors: set[str] = set()
    blocks: list[Block] = []
    spans: list[tuple[int, str]] = []
    used: dict[str, int] = {}
    tokens = MarkdownIt("commonmark").enable("table").parse(path.read_text(encoding="utf-8"))
    for number, token in enumerate(tokens):
        line = token.map[0] + 1 if token.map else 0
        if token.type == "fence":
            before = tokens[number - 1] if number else None
            mark = _MARK.fullmatch(before.content.strip()) if before and before.type == "html_block" else None
            words = [*token.info.split(), *(mark[1].split() if mark else ())]
            blocks.append(Block(line + 1, tuple(words), token.content))
        elif token.type == "code_block":
            blocks.append(Block(line, (), token.content))
        for part in (token, *inline_parts(token)):
            if part.type in ("html_block", "html_inline"):
                links += [(line, t) for t in _HTML_TARGET.findall(part.content)]
                anchors.update(_HTML_ANCHOR.findall(part.content))
            elif part.type in ("link_open", "image"):
                links.append((line, str(part.attrGet("href") or part.attrGet("src") or "")))
            elif part.type == "code_inline":
                spans.append((line, part.content))
        if token.type == "heading_open":
            heading = "".join(p.content for p in inline_parts(tokens[number + 1]) if p.type in ("text", "code_inline"))
            anchors.add(make_slug(heading, used))
    return Page(path, tuple(links), frozenset(anchors), tuple(blocks), tuple(spans))
