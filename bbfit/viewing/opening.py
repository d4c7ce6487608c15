"""Opening a page on results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bbfit.viewing.originals import MOST_BYTES
from bbfit.viewing.subject import open_run

if TYPE_CHECKING:
    from bbfit.viewing.page import Page


def view(run: str | Path, *, host: str = "127.0.0.1", port: int = 8080, original_bytes: int = MOST_BYTES) -> Page:
    """Open a page on this machine that shows a run, or levels of detail, and return at once.

    The original and the billboards are side by side under one camera, with switches for the alpha mode, the planes' outlines and the
    level of detail, and fields of up to 10,000 trees with the time that a frame takes.

    Parameters
    ----------
    run : the folder of ``bbfit run``, ``bbfit fit`` or ``bbfit lod``.
    host : address to listen on; whoever reaches it sees the page. ``0.0.0.0`` is all addresses of this machine.
    port : the first of the ports to try; 0 is any free one.
    original_bytes : size of the original's file up to which it is sent to browsers.

    Returns
    -------
    The page, which listens until its ``close`` is called or the process ends; its ``url`` is where it is.

    Raises
    ------
    MissingFileError, InputError
        if the folder is none of these or damaged, or if the page cannot listen there.
    """
    from bbfit.viewing.page import Page

    subject = open_run(run, original_bytes=original_bytes)
    page = Page(host=host, port=port)
    page.show(subject)
    return page
