"""Rectangles packed by xatlas, in a process of its own.

When xatlas (0.0.11) shuts down, it signals its threads to end without holding their lock. A thread that is about to wait misses the signal,
and the caller waits for it forever: on a busy machine about once in some thousand times. This process therefore exits without shutting
xatlas down.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
from numpy.typing import NDArray


def packed(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Non-overlapping places, int64 [R, 2] from 0 on, for rectangles of given whole widths and heights (at least 2), int64 [R, 2].

    Raises CalledProcessError if the process fails; its messages go to this process's standard error.
    """
    # It finds its modules where this process does, and nowhere else (-P), or a file named re.py in the working folder would run.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}
    command = [sys.executable, "-P", "-c", f"from {__name__} import _main; _main()"]
    # A session of its own: this process handles keyboard interrupts, and ends the other one.
    done = subprocess.run(
        command, input=json.dumps(cells.tolist()).encode(), stdout=subprocess.PIPE, env=environment, check=True, start_new_session=True
    )
    boxes = np.array(json.loads(done.stdout), dtype=np.int64)
    assert boxes.shape == (len(cells), 4) and np.array_equal(boxes[:, :2] + cells, boxes[:, 2:]), "xatlas scaled or split the atlas"
    return boxes[:, :2] - boxes[:, :2].min(0)


def _main() -> None:
    import xatlas

    cells = json.load(sys.stdin)
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
    with os.fdopen(1, "w") as answer:
        json.dump([[*np.floor(corner.min(0)), *np.ceil(corner.max(0))] for corner in corners], answer)
    os._exit(0)
