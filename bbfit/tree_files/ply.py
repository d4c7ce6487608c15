"""The vertex positions of a PLY (Turk 1994)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


def ply_positions(data: bytes) -> NDArray[np.floating] | None:
    """The vertex positions of a PLY from its bytes, [P, 3]. ``None`` if the header or the data are damaged or not supported."""
    header, end, body = data.partition(b"end_header")
    lines = [line.split() for line in header.decode("latin-1").splitlines() if line.strip()]
    elements = [i for i, line in enumerate(lines) if line[0] == "element"]
    if not end or not elements or lines[elements[0]][1:2] != ["vertex"] or len(lines[elements[0]]) != 3:
        return None
    count = lines[elements[0]][2]
    last = elements[1] if len(elements) > 1 else len(lines)
    properties = [line[1:] for line in lines[elements[0] + 1 : last] if line[0] == "property"]
    encoding = next((line[1] for line in lines if line[0] == "format" and len(line) > 1), "")
    if not count.isdigit() or any(len(p) != 2 or p[0] not in _TYPES for p in properties):
        return None
    names = [name for _, name in properties]
    if not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        return None
    body = body.lstrip(b"\r").removeprefix(b"\n")
    try:
        if encoding == "ascii":
            words = [line.split() for line in body.splitlines()[: int(count)]]
            return np.array([[float(row[names.index(axis)]) for axis in "xyz"] for row in words]).reshape(-1, 3)
        order = ">" if encoding == "binary_big_endian" else "<"
        layout = np.dtype([(name, order + _TYPES[kind]) for kind, name in properties])
        rows = np.frombuffer(body, layout, int(count))
    except (ValueError, IndexError):
        return None
    return np.stack([np.asarray(rows[axis], np.float64) for axis in "xyz"], -1)
