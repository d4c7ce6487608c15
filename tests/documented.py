"""What README.md and the pages in docs/ tell a reader to run: blocks of code, read from the Markdown."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
"""The README and all pages of the site."""
SITE = ["build", "--strict"]
"""How mkdocs builds the site."""
FENCE = re.compile(r"^( *)(```+)(.*)$")


@dataclass(frozen=True)
class Block:
    """One fenced block of code."""

    page: Path
    """The file that it stands in."""
    line: int
    """Number of its first line of code."""
    language: str
    """What follows the fence."""
    text: str
    """The code."""

    @property
    def commands(self) -> list[list[str]]:
        """The words of each command, comments left out."""
        lines = self.text.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """All fenced blocks of a page, in order."""
    found: list[Block] = []
    opened: tuple[int, str, str, str] | None = None
    lines: list[str] = []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        fence = FENCE.match(line)
        if opened is None and fence:
            opened, lines = (number + 1, fence[1], fence[2], fence[3].strip()), []
        elif opened and fence and fence[2] == opened[2] and not fence[3].strip():
            found.append(Block(page, opened[0], opened[3], "\n".join(lines) + "\n"))
            opened = None
        elif opened:
            lines.append(line.removeprefix(opened[1]))
    assert opened is None, f"{page.name}: a block that begins at line {opened and opened[0]} does not end"
    return found


def prose(page: Path) -> str:
    """The text of a page without its fenced blocks."""
    kept, inside = [], False
    for line in page.read_text(encoding="utf-8").splitlines():
        if FENCE.match(line):
            inside = not inside
        elif not inside:
            kept.append(line)
    return "\n".join(kept)
