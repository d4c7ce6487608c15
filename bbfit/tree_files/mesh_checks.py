"""Checks of trees as OBJ and STL before a program loads them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from bbfit.inputs import InputLimits, reading
from bbfit.tree_files.extent import check_points

_STL_HEADER, _STL_TRIANGLE = 84, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def check_obj(path: Path, limits: InputLimits) -> None:
    """Check the number of vertices of an OBJ."""
    with reading("tree", path, "export the tree again"):
        data = path.read_bytes()
        limits.at_most("max_input_vertices", "tree", path, sum(data.count(b"v" + blank) for blank in (b" ", b"\t")), "vertices")


def check_stl(path: Path, limits: InputLimits) -> None:
    """Check the number of vertices of an STL, three for each triangle, and where those of a binary one are."""
    with reading("tree", path, "export the tree again"), np.errstate(all="ignore"):
        data = path.read_bytes()
        count = struct.unpack_from("<I", data, _STL_HEADER - 4)[0] if len(data) >= _STL_HEADER else 0
        is_binary = len(data) == _STL_HEADER + _STL_TRIANGLE.itemsize * count
        limits.at_most("max_input_vertices", "tree", path, 3 * count if is_binary else data.count(b"vertex"), "vertices")
        if is_binary:
            check_points(path, np.frombuffer(data, _STL_TRIANGLE, count, _STL_HEADER)["corners"].reshape(-1, 3))
