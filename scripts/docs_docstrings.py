"""Griffe extension for the API pages: bbfit's docstrings as Markdown.

Sections are headings underlined with dashes, parameters are ``name : text``, and names are marked up as in reStructuredText. They are
turned into bold titles, lists, and links to the public names that the pages have.
"""

from __future__ import annotations

import re
from inspect import cleandoc
from typing import Any

import griffe

import bbfit

_ROLE = re.compile(r":\w+:`~?([\w.]+)`")
_TITLE = re.compile(r"^(\w[\w ]*)\n-{3,}\n", re.MULTILINE)
# Parameters, and what is raised, start at the margin; what is said of them goes on indented.
_ENTRY = re.compile(r"^(\w[\w, ]*?)(?: : (.*)|)$")


def markdown(text: str) -> str:
    """A docstring as Markdown."""
    parts = _TITLE.split(cleandoc(text))
    pieces = [parts[0].strip()]
    for title, body in zip(parts[1::2], parts[2::2], strict=True):
        listed = title in ("Parameters", "Raises")
        pieces.append(f"**{title}**\n\n{_entries(body) if listed else body.strip()}")
    return _marked_up("\n\n".join(pieces))


def _entries(body: str) -> str:
    """``name : text`` and indented continuations as a Markdown list."""
    lines: list[str] = []
    for line in body.strip().splitlines():
        entry = _ENTRY.match(line)
        if entry and not line.startswith(" "):
            names = ", ".join(f"`{name}`" for name in entry[1].split(", "))
            lines.append(f"- {names}: {entry[2] or ''}".rstrip())
        else:
            lines.append(f"    {line.strip()}")
    return "\n".join(lines)


def _marked_up(text: str) -> str:
    text = _ROLE.sub(lambda role: _link(role[1]), text)
    return re.sub(r"(?<!`)``(?!`)", "`", text)


def _link(path: str) -> str:
    """A public name as a link to its entry, another one as code."""
    name = path.rpartition(".")[2]
    if name in bbfit.__all__:
        home = getattr(bbfit, name).__module__
        return f"[`{name}`][{home}.{name}]"
    return f"`{name}`"


class Docstrings(griffe.Extension):
    """Rewrites every docstring of a package once it is loaded."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Called by griffe with the whole package."""
        self._rewrite(pkg)

    def _rewrite(self, item: griffe.Object | griffe.Alias) -> None:
        if item.is_alias:
            return
        if item.docstring is not None:
            item.docstring.value = markdown(item.docstring.value)
        for member in item.members.values():
            self._rewrite(member)
