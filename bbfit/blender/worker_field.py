"""Render a field of copies of a tree. This module runs in the worker's process.

``worker.py`` imports it by path, so it does not import bbfit.
"""

from __future__ import annotations

import resource
import time
from typing import Any

import numpy as np

# (x, y, z) of glTF's world, Y up -> (x, -z, y) of Blender's.
TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def plant(path: str) -> int:
    """Put copies of all objects with a surface into the scene in place of them; they share their data. Return the number of copies.

    ``path`` is a file of matrices: float32 [N, 16], column after column, for a world with Y up.
    """
    import bpy
    from mathutils import Matrix

    scene = bpy.context.scene
    originals = [item for item in scene.objects if item.type == "MESH" and not item.hide_render]
    places = TO_Z_UP @ np.fromfile(path, np.float32).reshape(-1, 4, 4).transpose(0, 2, 1).astype(float) @ TO_Z_UP.T
    for original in originals:
        own = np.array(original.matrix_world)
        for number, place in enumerate(places):
            copy = bpy.data.objects.new(f"copy {number}", original.data)
            copy.matrix_world = Matrix((place @ own).tolist())
            scene.collection.objects.link(copy)
        original.hide_render = original.hide_viewport = True
    return len(places)


def timed(render: Any) -> dict[str, Any]:
    """Call a function that renders. Return its seconds, and the most memory in bytes that this process has had."""
    begun = time.perf_counter()
    render()
    return {"seconds": time.perf_counter() - begun, "bytes": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}
