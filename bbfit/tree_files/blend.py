"""The files that a .blend refers to: linked libraries, pictures, and caches of geometry."""

from __future__ import annotations

import contextlib
import gzip
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from bbfit.checks import fail
from bbfit.inputs import InputLimits, reading
from bbfit.tree_files.references import existing

_HINT = "open the file in Blender and save it again"
# Blocks of libraries, images, movie clips, cache files and volumes. Each contains its path as text that ends with a zero byte.
_BLOCKS = {b"LI\0\0", b"IM\0\0", b"MC\0\0", b"CF\0\0", b"VO\0\0"}
_PATH = re.compile(rb"(?:(?<=\0)|^)([^\0]*[/\\][^\0]*)\0")
_LONGEST_PATH, _LONGEST_BLOCK, _PIECE = 1024, 1 << 16, 1 << 20


def blend_files(path: Path, limits: InputLimits) -> list[Path]:
    """The existing files to which a .blend and its linked libraries refer, without running Blender, which would open them.

    Raises ``InputError`` if the file is no .blend or is damaged, or if a file lies outside its folder and ``limits`` do not allow it.
    """
    files, waiting = list[Path](), [path]
    while waiting:
        source = waiting.pop(0)
        with reading("tree", source, _HINT), _opened(source) as file:
            names = _names(file, limits.max_input_bytes)
        for other in existing(source, names, path.parent, limits):
            if other not in files and not other.samefile(path):
                files.append(other)
                waiting += [other] if other.suffix.lower() == ".blend" else []
    return files


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """The uncompressed contents of a .blend as a file."""
    with path.open("rb") as file:
        start = file.read(4)
        file.seek(0)
        if start[:2] == b"\x1f\x8b":  # compressed by Blender before 3.0
            with gzip.open(file) as unpacked:
                yield unpacked  # type: ignore[misc]
        elif start == b"\x28\xb5\x2f\xfd":
            try:
                import zstandard
            except ImportError:
                fail("tree", f"{path} is compressed, and the package zstandard is not installed", "install it, or save without compression")
            with zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True) as unpacked:
                yield unpacked
        else:
            yield file


def _names(file: BinaryIO, most: int) -> list[str]:
    """The paths in the blocks of a .blend of at most ``most`` bytes. A leading ``//`` stands for the folder of the file."""
    start = file.read(12)
    if not start.startswith(b"BLENDER"):
        raise ValueError("it is not a .blend")
    if start[7:9].isdigit():  # since Blender 5.0: the size of the header, then "-", two digits and the version
        file.read(int(start[7:9]) - len(start))
        header, length_at = struct.Struct("<4xiQqq"), 2
    else:
        order, wide = "<" if start[8:9] == b"v" else ">", start[7:8] == b"-"
        header, length_at = struct.Struct(f"{order}4xi{'Q' if wide else 'I'}ii"), 0
    names, total = list[str](), 0
    while not (block := file.read(header.size)).startswith(b"ENDB"):
        if len(block) < header.size:
            raise ValueError("it is cut short")
        length = header.unpack(block)[length_at]
        total += header.size + length
        if length < 0 or total > most:
            raise ValueError(f"a block has {length:,} bytes")
        data = file.read(min(length, _LONGEST_BLOCK)) if block[:4] in _BLOCKS else b""
        names += [text.decode(errors="surrogateescape") for text in _PATH.findall(data) if len(text) <= _LONGEST_PATH]
        rest = length - len(data)
        while rest > 0 and (skipped := len(file.read(min(rest, _PIECE)))):
            rest -= skipped
    texts = (name.replace("\\", "/") for name in names)
    return list(dict.fromkeys("./" + text[2:] if text.startswith("//") else text for text in texts))
