"""xatlas in a process of its own: rectangles packed, and triangle meshes cut into charts.

When xatlas (0.0.11) is torn down it tells its threads to end without taking their lock. A thread that is about to wait misses this, and the
caller waits for it forever: on a busy machine once in some thousand times. This process ends without tearing anything down.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bbfit.checks import fail

if TYPE_CHECKING:
    import xatlas

MARGIN = 2
"""Texels between a chart and the texels of other charts, on each side."""
# A chart's cost up to which it grows. By xatlas' default of 2 a visual hull has 5% more vertices.
_CHART_COST = 8.0
# Attempts at a density that fits the texture.
_PACKINGS = 24


def packed(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pack rectangles of given widths and heights, at least 2, without overlap: int64 [R, 2] to their corners, from 0 on, int64 [R, 2].

    Raises ``CalledProcessError`` if the process fails, after its messages have gone to this process's standard error.
    """
    boxes = np.array(_answer("_pack", cells.tolist()), dtype=np.int64)
    assert boxes.shape == (len(cells), 4) and np.array_equal(boxes[:, :2] + cells, boxes[:, 2:]), "xatlas scaled or split the atlas"
    return boxes[:, :2] - boxes[:, :2].min(0)


def unfolded(
    points: NDArray[np.float64], faces: NDArray[np.int64], texels: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Cut a mesh of vertices in meters, [P, 3], and triangles, [F, 3], into charts, and pack them on a texture of ``texels`` x ``texels``.

    All charts have nearly the same number of texels per meter. The same mesh gives the same charts. Vertices without triangles are dropped.
    The result is the given vertex of each new vertex, [Q]; triangles of new vertices in the given order, [F, 3]; and texture coordinates
    in [0, 1], [Q, 2]. Raises ``InputError`` if there is no room for a margin around each chart, and the error of :func:`packed`.
    """
    charts = _answer("_unfold", {"points": points.tolist(), "faces": faces.tolist(), "texels": texels})
    if charts is None:
        fail("texels", f"{texels} are too few for the margins of the charts", "give a larger texture or fewer vertices")
    sources, corners, uvs = charts
    return np.array(sources, dtype=np.int64), np.array(corners, dtype=np.int64), np.array(uvs)


def _answer(task: str, question: Any) -> Any:
    # The process finds its modules wherever this process does.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", f"from {__name__} import _main, {task}; _main({task})"]
    done = subprocess.run(command, input=json.dumps(question).encode(), stdout=subprocess.PIPE, env=environment, check=True)
    return json.loads(done.stdout)


def _main(task: Any) -> None:
    answer, _atlas = task(json.load(sys.stdin))  # which is alive until the process ends
    with os.fdopen(1, "w") as pipe:
        json.dump(answer, pipe)
    os._exit(0)


def _pack(cells: list[list[int]]) -> tuple[list[list[float]], xatlas.Atlas]:
    import xatlas

    atlas = xatlas.Atlas()
    # xatlas rounds a chart's extent up to whole texels and takes one texel more, for the half texels on either side of its outline.
    charts = [np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32) for w, h in np.array(cells) - 1]
    # It takes charts at equal addresses for copies of one mesh, so all of them must stay alive until it has packed them.
    triangles = [np.array([[0, 1, 2], [0, 2, 3]], np.uint32) for _ in charts]
    for chart, triangle in zip(charts, triangles, strict=True):
        atlas.add_uv_mesh(chart, triangle)
    options = xatlas.PackOptions()
    options.padding = 0
    options.bilinear = False
    options.rotate_charts = False
    options.rotate_charts_to_axis = False
    options.bruteForce = True
    options.max_chart_size = 0
    options.texels_per_unit = 1.0
    options.resolution = 0
    atlas.generate(pack_options=options)
    scale = np.array([atlas.width, atlas.height])
    corners = [atlas[n][2] * scale for n in range(len(charts))] if atlas.atlas_count == 1 else []
    return [[*np.floor(corner.min(0)).tolist(), *np.ceil(corner.max(0)).tolist()] for corner in corners], atlas


def _unfold(mesh: dict[str, Any]) -> tuple[list[Any] | None, xatlas.Atlas]:
    import xatlas

    atlas, texels = xatlas.Atlas(), mesh["texels"]
    atlas.add_mesh(np.array(mesh["points"], np.float32), np.array(mesh["faces"], np.uint32))
    charts, options = xatlas.ChartOptions(), xatlas.PackOptions()
    charts.max_cost = _CHART_COST
    options.padding = 2 * MARGIN
    options.bruteForce = True
    options.resolution = texels  # a first guess: the atlas may come out larger
    for _ in range(_PACKINGS):
        atlas.generate(charts, options)
        side = max(atlas.width, atlas.height)
        if side <= texels and atlas.atlas_count == 1:
            sources, corners, uvs = atlas[0]
            uvs = uvs.astype(np.float64) * [atlas.width, atlas.height] / texels
            return [sources.tolist(), corners.tolist(), uvs.tolist()], atlas
        options.resolution, options.texels_per_unit = 0, atlas.texels_per_unit * min(0.98, texels / side)
    return None, atlas
