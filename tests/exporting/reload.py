"""Building a cloud again from nothing but the quads of a model file."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from bbfit.geometry.cloud import BillboardCloud


def rebuild(corners: NDArray[np.float64], uvs: NDArray[np.float64], culled: NDArray[np.bool_], image: NDArray[np.uint8]) -> BillboardCloud:
    """A cloud from quads: corners [Q, 4, 3], texture coordinates from the top left [Q, 4, 2], which are culled [Q], and the texture.

    A culled quad is the front of a billboard, and the next one its back.
    """
    height, width = image.shape[:2]
    fields: list[list] = [[], [], [], [], [], [], []]
    quad = 0
    while quad < len(corners):
        points = corners[quad]
        # The texel coordinates of glTF's and OBJ's corners: texel centers at halves.
        low, high = (uvs[quad] * [width, height]).min(0), (uvs[quad] * [width, height]).max(0)
        size = np.rint(high - low).astype(int) - 1
        textures = []
        for side in range(1 + culled[quad]):
            start = (uvs[quad + side] * [width, height]).min(0) + 0.5
            assert abs(start - np.rint(start)).max() < 1e-3, "a texture lies between the atlas's texels"
            x, y = np.rint(start).astype(int)
            textures.append(image[y : y + size[1], x : x + size[0]].reshape(-1, 4) / 255.0)
        if culled[quad]:
            back, front = corners[quad + 1], points
            match = [int(np.linalg.norm(front - point, axis=-1).argmin()) for point in back]
            assert np.array_equal(back, front[match]), "front and back are not at one place"
            offset = uvs[quad + 1] - uvs[quad][match]
            assert abs(offset - offset[0]).max() < 1e-6, "the back's texture is turned or mirrored"
            turn = np.cross(front[1] - front[0], front[2] - front[0]) @ np.cross(back[1] - back[0], back[2] - back[0])
            assert turn < 0, "front and back wind the same way"
        # The axes follow the texture, wherever the corners start.
        along_x, along_y = _gradient(points, uvs[quad])
        extents = np.array([np.linalg.norm(along_x) * (high - low)[0] / width, np.linalg.norm(along_y) * (high - low)[1] / height]) / 2
        values = (
            points.mean(0),
            along_x / np.linalg.norm(along_x),
            -along_y / np.linalg.norm(along_y),
            extents * size / (size + 1),
            size[::-1],
            culled[quad],
            np.concatenate(textures),
        )
        for field, value in zip(fields, values, strict=True):
            field.append(value)
        quad += 1 + int(culled[quad])
    *stacked, texels = (np.concatenate(f) if f is fields[-1] else np.stack(f) for f in fields)
    return BillboardCloud(*(torch.from_numpy(np.ascontiguousarray(array)) for array in (*stacked, texels)))


def _gradient(points: NDArray[np.float64], uvs: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How a point moves with u and with v."""
    solution = np.linalg.lstsq(np.concatenate([uvs, np.ones((4, 1))], -1), points, rcond=None)[0]
    return solution[0], solution[1]
