"""One origin for each node, such that programs that sort by origins draw the nodes in the right order from all around.

Programs sort transparent objects from back to front by one number each: three.js by the depth of the center of the object's bounds along
the viewing direction, Babylon.js and Unity by its distance from the camera. For a camera that looks along f, sorting by depth draws node i
in front of node j correctly if f . (o_j - o_i) > 0. This is linear in the origins o; sorting by distance is nearly so.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bbfit.exporting.visibility import Overlaps, Rig

# Penalty on the distance of origins from their nodes' centers: the wrong share that all nodes at one radius of the tree are worth.
_PULL = 1e-2
# Softness of the order in the fit of origins, in radii of the tree, from step to step, and the most iterations of each step.
_SOFTNESS = (0.1, 0.05, 0.02)
_STEPS = 50


def sort_keys(cameras: Rig, origins: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The numbers that programs sort by: the depth and the distance of P points from V cameras in meters, both [V, P]."""
    depth = cameras.forwards @ origins.T - (cameras.forwards * cameras.eyes).sum(-1, keepdims=True)
    squared = (origins**2).sum(-1) - 2 * cameras.eyes @ origins.T + (cameras.eyes**2).sum(-1, keepdims=True)
    return depth, np.sqrt(np.maximum(squared, 1e-12))


def fit_origins(
    cameras: Rig, overlaps: Overlaps, middles: NDArray[np.float64], starts: list[NDArray[np.float64]], scale: float
) -> NDArray[np.float64]:
    """Fit the origins of K nodes, [K, 3], such that sorting by depth and sorting by distance both give the order along the rays.

    The overlaps are those of nodes in the pictures of the cameras. ``middles`` holds the centers of the nodes, and ``starts`` one or more
    guesses of the origins, [K, 3] each. ``scale`` is the tree's radius. All are in meters.

    L-BFGS (Byrd et al. 1995) minimizes the wrong share from the best of the starts. Sigmoids of decreasing softness replace the step
    between right and wrong. A penalty keeps origins near the centers of their nodes, so that bounds centered on them stay small. The best
    of the starts and of the results of each softness is returned.
    """
    from scipy.optimize import minimize
    from scipy.special import expit

    count, weight = len(middles), overlaps.weight
    front, back = (overlaps.camera * count + node for node in (overlaps.front, overlaps.back))

    def wrong(flat: NDArray[np.float64], softness: float) -> tuple[float, NDArray[np.float64]]:
        origins = flat.reshape(count, 3) * scale
        depth, distance = sort_keys(cameras, origins)
        total, slopes = 0.0, []
        for key in (depth, distance):
            behind = (key.ravel()[front] - key.ravel()[back]) / (softness * scale)  # positive where it is wrong
            chance = expit(behind)
            total += float(weight @ chance) / 2
            slope = weight * chance * (1 - chance) / (2 * softness)
            slopes.append((np.bincount(front, slope, key.size) - np.bincount(back, slope, key.size)).reshape(key.shape))
        by_distance = slopes[1] / distance
        gradient = slopes[0].T @ cameras.forwards + by_distance.sum(0)[:, None] * origins - by_distance.T @ cameras.eyes
        away = flat.reshape(count, 3) - middles / scale
        return total + _PULL * float((away**2).sum()) / count, (gradient + 2 * _PULL / count * away).ravel()

    def exact(origins: NDArray[np.float64]) -> float:
        right = [key.ravel()[front] < key.ravel()[back] for key in sort_keys(cameras, origins)]
        return float(weight @ (2.0 - right[0] - right[1])) / 2 + _PULL * float((((origins - middles) / scale) ** 2).sum()) / count

    origins = best = min(starts, key=exact)
    for softness in _SOFTNESS:
        result = minimize(wrong, (origins / scale).ravel(), (softness,), "L-BFGS-B", jac=True, options={"maxiter": _STEPS, "maxcor": 20})
        origins = result.x.reshape(count, 3) * scale
        best = min(best, origins, key=exact)
    return best
