"""The files that a Wavefront OBJ refers to."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

_LIBRARY = re.compile(rb"^\s*mtllib\s+(.+?)\s*$", re.MULTILINE)
_MAP = re.compile(rb"^\s*(?:map_\w+|bump|disp|decal|norm|refl)\s+(.+?)\s*$", re.MULTILINE | re.IGNORECASE)


def obj_files(path: Path) -> list[Path]:
    """The material libraries of an OBJ and the textures of those, as far as they exist, in the order in which they are named.

    Programs differ in how they read names with spaces and the options before a texture's name. Each file that any reading gives counts.
    """
    files = list[Path]()
    for library in _existing(path.parent, _LIBRARY.findall(path.read_bytes())):
        files += [library, *_existing(library.parent, _MAP.findall(library.read_bytes()))]
    return list(dict.fromkeys(files))


def _existing(folder: Path, names: list[bytes]) -> Iterator[Path]:
    for name in names:
        text = name.decode(errors="replace").replace("\\", "/")
        words = text.split()
        for start in range(len(words)):
            if "\0" not in text and (file := folder / (" ".join(words[start:]) if start else text)).is_file():
                yield file
                break
