"""A hook of MkDocs: the roles of Sphinx in docstrings become plain code on the pages of the site."""

from __future__ import annotations

import re
from typing import Any


def on_page_content(html: str, **_: Any) -> str:
    """Replace a role, such as ``:meth:`~Camera.project```, with the last part of its name."""
    return re.sub(r":(?:attr|class|data|func|meth|mod):<code>~?(?:[\w.]*\.)?(\w+)</code>", r"<code>\1</code>", html)
