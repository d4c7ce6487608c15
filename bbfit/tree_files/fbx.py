"""The files that an FBX refers to: textures, and the caches of animations."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

from bbfit.inputs import InputLimits
from bbfit.tree_files.references import existing

# In a binary FBX, a string follows the name of its record as the letter S, its length in four bytes, and its characters. The value of a
# property with the type XRefUrl follows a second string, which holds flags.
_BINARY = re.compile(rb"(?:RelativeFilename|Relative[ ]?FileName|File[Nn]ame|XRefUrlS[\x00-\x08]\x00\x00\x00.{0,8}?)S(.{4})", re.DOTALL)
_TEXT = re.compile(rb"(?:RelativeFilename|File[Nn]ame)\s*:\s*\"([^\"\r\n]*)\"|\"XRefUrl\",[^,\r\n]*,[^,\r\n]*,\s*\"([^\"\r\n]*)\"")
_LONGEST = 4096


def fbx_files(path: Path, limits: InputLimits) -> list[Path]:
    """The existing files to which an FBX refers, in the order of their names in the file.

    An FBX names a texture by an absolute and by a relative path. A program that finds neither looks for the name in the folder of the FBX.
    An absolute path, often of another machine, is ignored if the FBX's own folder has that file. Raises ``InputError`` if a file lies
    outside that folder and ``limits`` do not allow it.
    """
    data = path.read_bytes()
    names = list[bytes]()
    for match in _BINARY.finditer(data):
        length = int.from_bytes(match[1], "little")
        if 0 < length <= _LONGEST:
            names.append(data[match.end() : match.end() + length])
    names += [text or url for text, url in _TEXT.findall(data)]
    texts = [name.decode(errors="surrogateescape").replace("\\", "/") for name in dict.fromkeys(names) if b"\0" not in name]
    named = dict.fromkeys([*texts, *(PurePosixPath(text).name for text in texts)])
    own = existing(path, [name for name in named if limits.admits(path.parent / name, path.parent)], path.parent, limits)
    found = {file.name for file in own}
    return [*own, *existing(path, [name for name in named if PurePosixPath(name).name not in found], path.parent, limits)]
