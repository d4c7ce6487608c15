"""Casting rays at a textured triangle mesh on the CPU, with gradients, by Mitsuba's ray tracer (Embree) and Dr.Jit (LLVM).

Mitsuba provides the scene with its acceleration structure, and arrays that are compiled and differentiated. Its integrators are not used,
because its emitters have no opacity. Colors are blended along each ray instead, surface by surface, which is the depth peeling of
Hasselgren et al. 2021 without rasterizer passes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.checks import fail
from bbfit.geometry.camera import Camera

VARIANT = "llvm_ad_rgb"
LAYERS = 8
"""Largest number of surfaces blended along a ray; surfaces behind them are ignored."""
FAINT = 1 / 512
"""Transmittance below which a ray ends."""
STEP_ON = 1e-5
"""How far behind a surface a ray goes on, as a part of the mesh's longest side."""


def pixel_rays(camera: Camera, places: Tensor, grid: int) -> tuple[Tensor, Tensor]:
    """Rays of one camera through ``grid`` x ``grid`` cells of every pixel: origins in meters and unit directions in world space.

    Both are float32 [H·W·grid², 3]. ``places`` are where in its cell each ray passes, right and down in [0, 1], [H·W·grid², 2]: pixel by
    pixel, in it row by row.
    """
    rows, columns = torch.arange(camera.height * grid), torch.arange(camera.width * grid)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    cells = torch.stack([x, y], -1).reshape(camera.height, grid, camera.width, grid, 2).transpose(1, 2).reshape(-1, 2)
    return rays_through(camera, (cells + places) / grid - 0.5)  # a pixel spans half a pixel to either side of its center


def rays_through(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor]:
    """Rays through points of a camera's picture: pixel coordinates [S, 2] to origins and unit directions, float32 [S, 3] each."""
    to_world, to_camera = camera.camera_to_world.float(), torch.linalg.inv(camera.intrinsics).float()
    inside = points.float() @ to_camera[:, :2].mT + to_camera[:, 2]
    if camera.orthographic:
        origins = inside[:, :2] @ to_world[:3, :2].mT + to_world[:3, 3]
        return origins, to_world[:3, 2].expand_as(origins)
    directions = torch.nn.functional.normalize(inside @ to_world[:3, :3].mT, dim=-1)
    return to_world[:3, 3].expand_as(directions), directions


@functools.cache
def _libraries() -> tuple[Any, Any]:
    """Mitsuba, set (for the whole process) to compile with LLVM, and Dr.Jit."""
    try:
        import drjit
        import mitsuba
    except ImportError:
        fail("learned mesh", "Mitsuba is not installed", "pip install 'bbfit[rivals]'")
    try:
        mitsuba.set_variant(VARIANT)
    except ImportError as error:
        hint = "install it (Debian 12: apt-get install libllvm19) or name the library in DRJIT_LIBLLVM_PATH"
        fail("learned mesh", f"Mitsuba cannot use LLVM ({str(error).splitlines()[0]})", hint)
    return mitsuba, drjit


class RayCaster:
    """A mesh of fixed triangles and texture coordinates whose vertices can move."""

    def __init__(self, faces: Tensor, uvs: Tensor) -> None:
        """Take triangles, int64 [F, 3], and texture coordinates, [P, 2]; ``move`` gives it vertices."""
        mi, _ = _libraries()
        mesh = mi.Mesh("mesh", len(uvs), len(faces))
        self._faces, self._uvs = mi.UInt32(_flat(faces, np.uint32)), mi.Float(_flat(uvs))
        parameters = mi.traverse(mesh)
        parameters["faces"] = self._faces
        parameters.update()
        self._scene = mi.load_dict({"type": "scene", "mesh": mesh})
        self._parameters = mi.traverse(self._scene)
        self._vertices, self._step = mi.Float(0), mi.Float(0)

    def move(self, vertices: Tensor) -> None:
        """Give the vertices their places in meters, [P, 3]."""
        mi, dr = _libraries()
        self._vertices = mi.Float(_flat(vertices))
        self._step = dr.opaque(mi.Float, float(np.ptp(vertices.detach().numpy(), axis=0).max()) * STEP_ON)
        self._parameters["mesh.vertex_positions"] = self._vertices
        self._parameters.update()

    def colors(self, origins: Tensor, directions: Tensor, texture: Tensor) -> Tensor:
        """What rays see, premultiplied RGBA, float32 [S, 4].

        Origins and unit directions are [S, 3], the texture is straight RGBA in [0, 1], [h, w, 4].
        """
        mi, dr = _libraries()
        seen = self._trace(_points(origins), _points(directions), self._vertices, mi.TensorXf(_array(texture)), attached=False)
        dr.eval(seen)
        return torch.from_numpy(np.stack([channel.numpy() for channel in seen], -1))

    def gradients(
        self, origins: Tensor, directions: Tensor, texture: Tensor, samples: int, loss: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Gradients of a loss on pixels, each the mean of ``samples`` successive rays, which are as for ``colors``.

        ``loss`` maps the pixels, [S / ``samples``, 4], to its derivative by them. The result is this derivative, and the gradients by the
        vertices, [P, 3], with fixed silhouettes, and by the texture, [h, w, 4].
        """
        mi, dr = _libraries()
        vertices, texels = mi.Float(self._vertices), mi.TensorXf(_array(texture))
        dr.enable_grad(vertices, texels)
        seen = self._trace(_points(origins), _points(directions), vertices, texels, attached=True)
        pixels = [dr.block_sum(channel, samples) / samples for channel in seen]
        dr.eval(pixels)
        by_pixel = loss(torch.from_numpy(np.stack([channel.numpy() for channel in pixels], -1)))
        surrogate = mi.Float(0)
        for channel, weight in zip(pixels, by_pixel.unbind(-1), strict=True):
            surrogate += dr.sum(channel * mi.Float(_flat(weight)))
        dr.backward(surrogate)
        by_vertex = torch.from_numpy(dr.grad(vertices).numpy()).reshape(-1, 3)
        return by_pixel, by_vertex, torch.from_numpy(dr.grad(texels).numpy())

    def _trace(self, origins: Any, directions: Any, vertices: Any, texels: Any, *, attached: bool) -> list[Any]:
        """Blend the surfaces along rays, nearest first: four channels, premultiplied."""
        mi, dr = _libraries()
        texture = mi.Texture2f(texels, use_accel=False, filter_mode=dr.FilterMode.Linear, wrap_mode=dr.WrapMode.Clamp)
        through, active, start = mi.Float(1), mi.Bool(True), mi.Point3f(origins)
        seen = [mi.Float(0) for _ in range(4)]
        for layer in range(LAYERS):
            with dr.suspend_grad():
                hit = self._scene.ray_intersect_preliminary(mi.Ray3f(start, directions), coherent=layer == 0, active=active)
                active = active & hit.is_valid()
                corners = dr.gather(mi.Vector3u, self._faces, hit.prim_index, active)
                u, v = (dr.select(active, part, 0) for part in hit.prim_uv)  # where nothing is hit they can be anything
            if attached:
                places = [dr.gather(mi.Point3f, vertices, corner, active) for corner in corners]
                moved = _barycentric(dr, places, origins, directions)
                u, v = (dr.replace_grad(old, new) for old, new in zip((u, v), moved, strict=True))
            first, second, third = (dr.gather(mi.Point2f, self._uvs, corner, active) for corner in corners)
            texel = texture.eval(first + (second - first) * u + (third - first) * v, active)
            alpha = dr.select(active, texel[3], 0)
            weight = through * alpha
            seen = [*(seen[channel] + weight * texel[channel] for channel in range(3)), seen[3] + weight]
            through = through * (1 - alpha)
            with dr.suspend_grad():
                active = active & (through > FAINT)
                start = dr.select(active, start + directions * (hit.t + self._step), start)
        return seen


def _barycentric(dr: Any, places: list[Any], origins: Any, directions: Any) -> tuple[Any, Any]:
    """Coordinates of rays' hits with triangles (Möller and Trumbore 1997), differentiable in the triangles' corners."""
    first, along, across = places[0], places[1] - places[0], places[2] - places[0]
    normal = dr.cross(directions, across)
    volume, offset = dr.dot(along, normal), origins - first
    scale = dr.rcp(dr.select(dr.abs(volume) > 1e-12, volume, 1))  # seen edge-on, or no hit at all
    return dr.dot(offset, normal) * scale, dr.dot(directions, dr.cross(offset, along)) * scale


def _points(values: Tensor) -> Any:
    mi, _ = _libraries()
    return mi.Point3f(np.ascontiguousarray(values.detach().numpy().T, dtype=np.float32))


def _array(values: Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(values.detach().numpy(), dtype=np.float32)


def _flat(values: Tensor, dtype: type[np.generic] = np.float32) -> NDArray[Any]:
    return np.ascontiguousarray(values.detach().numpy(), dtype=dtype).ravel()
