"""What a frame's time consists of: the least squares of measured frames."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import numpy as np

from bbfit.reporting.frame_tables import FrameCosts, FrameRow

# Fewest frames for three unknowns.
_LEAST_ROWS = 6


def frame_costs(rows: Sequence[FrameRow]) -> tuple[FrameCosts, ...]:
    """The time of a tree, of a triangle and of a fragment in each program whose fragments were counted in at least six fields.

    The times are not negative, and explain the frames' times with the least squares of relative errors, so that fast frames count as much
    as slow ones (Lawson and Hanson 1974, "Solving least squares problems", chapter 23). The time of an empty frame is left out.
    """
    from scipy.optimize import nnls

    found = list[FrameCosts]()
    for program in dict.fromkeys(row.program for row in rows):
        counted = [row for row in rows if row.program == program and row.fragments]
        if len(counted) < _LEAST_ROWS:
            continue
        shares = np.array([[row.count, row.triangles, row.fragments] for row in counted]) / [[row.ms] for row in counted]
        scales = shares.max(0)
        times, _ = nnls(shares / scales, np.ones(len(counted)))
        tree, triangle, fragment = (1e6 * times / scales).tolist()
        errors = np.abs(shares @ (times / scales) - 1).tolist()
        found.append(FrameCosts(program, tree, triangle, fragment, median(errors), len(counted)))
    return tuple(found)
