"""The files that a Wavefront OBJ refers to."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

from bbfit.inputs import InputLimits
from bbfit.tree_files.references import existing

_LIBRARY = re.compile(rb"^\s*mtllib\s+(.+?)\s*$", re.MULTILINE)
_MAP = re.compile(rb"^\s*(?:map_\w+|bump|disp|decal|norm|refl)\s+(.+?)\s*$", re.MULTILINE | re.IGNORECASE)
_CONTINUED = re.compile(rb"\\\r?\n")


def obj_files(path: Path, limits: InputLimits) -> list[Path]:
    """The material libraries of an OBJ and their textures, in the order of their names in the files. Missing files are omitted.

    Programs differ in how they parse names with spaces and the options before a texture's name. This function returns every file that
    some parser would open: the rest of the line, the rest of the line after any word, each single word, and the names of these without
    their folders. Blender also opens a library with the name of the OBJ.
    Raises ``InputError`` if a file lies outside the folder of the OBJ and ``limits`` do not allow it.
    """
    files = list[Path]()
    for library in [*existing(path, _readings(_LIBRARY, path), path.parent, limits), path.with_suffix(".mtl")]:
        if library.is_file() and library not in files:
            readings = _readings(_MAP, library)
            # Blender looks for textures beside the library, trimesh beside the OBJ.
            files += [library, *existing(library, readings, path.parent, limits), *existing(path, readings, path.parent, limits)]
    return list(dict.fromkeys(files))


def _readings(statement: re.Pattern[bytes], path: Path) -> list[str]:
    """All readings of the names in the statements of a file."""
    data, readings = _CONTINUED.sub(b" ", path.read_bytes()), list[str]()
    for name in statement.findall(data):
        text = name.decode(errors="surrogateescape").replace("\\", "/")
        words = text.split()
        whole = [text, *(" ".join(words[start:]) for start in range(1, len(words))), *words]
        readings += [*whole, *(PurePosixPath(reading).name for reading in whole)]
    return list(dict.fromkeys(readings))
