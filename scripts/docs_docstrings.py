"""Griffe extension for the API pages: convert bbfit's docstrings to Markdown.

The docstrings follow numpydoc, with roles of reStructuredText. Section headings become bold titles, entries of sections become lists, and
roles become links to the public names that the pages describe.
"""

from __future__ import annotations

import re
from inspect import cleandoc
from typing import Any

import griffe

import bbfit

_ROLE = re.compile(r":\w+:`~?([\w.]+)`")
_TITLE = re.compile(r"^(\w[\w ]*)\n-{3,}\n", re.MULTILINE)
# An entry of a section starts at the margin. Its description is indented.
_ENTRY = re.compile(r"^(\*{0,2}\w[\w, ]*?)(?: : (.*)|)$")


def markdown(text: str) -> str:
    """Convert a docstring to Markdown."""
    parts = _TITLE.split(cleandoc(text))
    pieces = [parts[0].strip()]
    for title, body in zip(parts[1::2], parts[2::2], strict=True):
        is_list = title in ("Parameters", "Raises") or re.match(r"\S.*\n +\S", body) is not None
        pieces.append(f"**{title}**\n\n{_entries(body) if is_list else body.strip()}")
    return _marked_up("\n\n".join(pieces))


def _entries(body: str) -> str:
    """Convert entries, which are ``name`` or ``name : text`` with indented descriptions, to a Markdown list."""
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
    """A public name as a link to its entry, and any other name as code."""
    name = path.rpartition(".")[2]
    if name in bbfit.__all__:
        home = getattr(bbfit, name).__module__
        return f"[`{name}`][{home}.{name}]"
    return f"`{name}`"


class Docstrings(griffe.Extension):
    """Convert every docstring of a package after griffe has loaded it."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Convert the docstrings of ``pkg``. Griffe calls this method."""
        self._rewrite(pkg)

    def _rewrite(self, item: griffe.Object | griffe.Alias) -> None:
        if item.is_alias:
            return
        if item.docstring is not None:
            item.docstring.value = markdown(item.docstring.value)
        for member in item.members.values():
            self._rewrite(member)
