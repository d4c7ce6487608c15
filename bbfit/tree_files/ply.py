"""Checks of a tree as PLY (Turk 1994) before a program loads it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bbfit.inputs import InputLimits, reading
from bbfit.tree_files.extent import check_points

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_LONGEST_HEADER = 1 << 16
# Faces for each vertex.
_FACES = 4


def check_ply(path: Path, limits: InputLimits) -> None:
    """Check the header of a PLY, the numbers of its vertices and faces, and where the vertices are.

    Headers that this module does not understand are left to the program that loads the file, unless they announce more than there is.
    """
    with reading("tree", path, "export the tree again"), np.errstate(all="ignore"):
        data = path.read_bytes()
        header, end, _ = data[:_LONGEST_HEADER].partition(b"end_header")
        body = data[len(header) + len(end) :].lstrip(b"\r").removeprefix(b"\n")
        lines = [line.split() for line in header.decode("latin-1").splitlines() if line.strip()]
        elements = _elements(lines)
        for element in elements:
            if element.count > len(body):
                raise ValueError(f"it has fewer bytes than the {element.count} entries of {element.name} that it announces")
            most = element.count if element.name == "vertex" else element.count // _FACES
            limits.at_most("max_input_vertices", "tree", path, most, "vertices, or faces for them")
        encoding = next((line[1] for line in lines if line[0] == "format" and len(line) > 1), "")
        if end and elements and elements[0].name == "vertex" and (points := _positions(elements[0], encoding, body)) is not None:
            check_points(path, points)


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[list[str]]


def _elements(lines: list[list[str]]) -> list[_Element]:
    elements = list[_Element]()
    for line in lines:
        if line[0] == "element":
            if len(line) != 3 or not line[2].isdecimal():
                raise ValueError("its header is damaged")
            elements.append(_Element(line[1], int(line[2]), []))
        elif line[0] == "property" and elements:
            elements[-1].properties.append(line[1:])
    return elements


def _positions(vertices: _Element, encoding: str, body: bytes) -> NDArray[np.floating] | None:
    """The positions of the vertices, [P, 3]. ``None`` if they are stored in a way that this module does not understand."""
    if any(len(entry) != 2 or entry[0] not in _TYPES for entry in vertices.properties):
        return None
    names = [name for _, name in vertices.properties]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        return None
    if encoding == "ascii":
        words = [line.split() for line in body.splitlines()[: vertices.count]]
        return np.array([[float(row[names.index(axis)]) for axis in "xyz"] for row in words]).reshape(-1, 3)
    order = ">" if encoding == "binary_big_endian" else "<"
    layout = np.dtype([(name, order + _TYPES[kind]) for kind, name in vertices.properties])
    rows = np.frombuffer(body, layout, vertices.count)
    return np.stack([np.asarray(rows[axis], np.float64) for axis in "xyz"], -1)
