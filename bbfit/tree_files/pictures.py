"""The textures of a tree: how large they are is read from their headers, before a program decodes them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from bbfit.images import picture_header
from bbfit.inputs import InputLimits

# The pixels of all textures of a tree together may be as many as those of this many of the largest.
_TEXTURES = 16


def check_pictures(path: Path, pictures: Iterable[Path | bytes], limits: InputLimits) -> None:
    """Require that the textures of the tree ``path`` have no more pixels than ``limits`` allow. They are files or the contents of files.

    Files that are no pictures, or of a format that takes as much memory as its file, are not checked.
    """
    total = 0
    for picture in dict.fromkeys(pictures):
        name, data = (f"a picture in {path}", picture) if isinstance(picture, bytes) else (picture, None)
        header = picture_header("tree", name, limits, data)
        total += header.width * header.height if header else 0
    limits.at_most("max_input_pixels", "tree", f"all pictures of {path} together", -(-total // _TEXTURES), f"pixels per {_TEXTURES}")
