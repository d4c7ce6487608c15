"""The files that a Wavefront OBJ refers to."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

_LIBRARY = re.compile(rb"^\s*mtllib\s+(.+?)\s*$", re.MULTILINE)
_MAP = re.compile(rb"^\s*(?:map_\w+|bump|disp|decal|norm|refl)\s+(.+?)\s*$", re.MULTILINE | re.IGNORECASE)


def obj_files(path: Path) -> list[Path]:
    """The material libraries of an OBJ and their textures, in the order of their names in the files. Missing files are omitted.

    Programs differ in how they parse names with spaces and the options before a texture's name. This function returns every file that
    some parser would open: the rest of the line, the rest of the line after any word, and each single word.
    """
    files = list[Path]()
    for library in _existing(path.parent, _LIBRARY.findall(path.read_bytes())):
        files += [library, *_existing(library.parent, _MAP.findall(library.read_bytes()))]
    return list(dict.fromkeys(files))


def _existing(folder: Path, names: list[bytes]) -> Iterator[Path]:
    for name in names:
        text = name.decode(errors="surrogateescape").replace("\\", "/")
        words = text.split()
        readings = [text, *(" ".join(words[start:]) for start in range(1, len(words))), *words]
        yield from (folder / reading for reading in readings if "\0" not in reading and (folder / reading).is_file())
