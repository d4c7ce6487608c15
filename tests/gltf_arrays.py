"""The numbers of a glTF's accessors and the places of its nodes, by the glTF 2.0 specification and nothing of bbfit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def array(tree: dict[str, Any], contents: Sequence[bytes], number: int) -> NDArray[np.float64]:
    """The values of an accessor, [count, width], from the contents of the buffer views; normalized integers are in [-1, 1]."""
    accessor = tree["accessors"][number]
    view, kind, width = accessor["bufferView"], np.dtype(KINDS[accessor["componentType"]]), WIDTHS[accessor["type"]]
    stride = tree["bufferViews"][view].get("byteStride", kind.itemsize * width)
    shape, start = (accessor["count"], width), accessor.get("byteOffset", 0)
    values = np.ndarray(shape, kind, contents[view], start, (stride, kind.itemsize)).astype(np.float64)
    return np.maximum(values / np.iinfo(kind).max, -1) if accessor.get("normalized") else values


def matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    """The matrix of a node that is not turned, [4, 4], for columns."""
    assert "rotation" not in node and not ("matrix" in node and {"translation", "scale"} & node.keys())
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T
    placed = np.diag([*node.get("scale", (1, 1, 1)), 1.0])
    placed[:3, 3] = node.get("translation", (0, 0, 0))
    return placed
