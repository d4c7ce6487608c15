"""A rival to billboards: a closed triangle mesh whose vertices and RGBA texture are learned from the views.

In the spirit of "Appearance-Driven Automatic 3D Model Simplification" (Hasselgren et al. 2021, with opacity in the texture, as for its
foliage) and "Extracting Triangular 3D Models, Materials, and Lighting From Images" (Munkberg et al. 2022), without their
normal maps, materials and lights: the texture is shown as it is. The start is the visual hull (``mesh_hull``), not a
tetrahedral grid, and the renderer a ray caster on the CPU (``mesh_rays``), not a rasterizer on a GPU.

Another start was measured and left out: the trunk, decimated, and cards through clusters of leaves, with 2,000 vertices in all. On
validation views of an acer it is at 26.9 dB and FLIP 0.048, a mean over backgrounds, and the hull at 27.4 dB and 0.050.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from bbfit.checks import check_count, check_shape, fail
from bbfit.geometry.camera import Camera
from bbfit.images import bleed_color, to_bytes
from bbfit.rivals.mesh_charts import unfold
from bbfit.rivals.mesh_hull import hull_surface
from bbfit.rivals.mesh_rays import RayCaster, pixel_rays
from bbfit.rivals.mesh_silhouettes import Surface, boundary_gradient
from bbfit.threads import one_thread
from bbfit.views.view_set import ViewSet

DRAW_GRID = 4
"""Samples along a pixel's side when a mesh is drawn: 16 a pixel, at the centers of a regular grid's cells."""
FIT_GRID = 2
"""The same while a mesh is learned, each at a random place in its cell."""
VERTEX_RATE = 0.012
"""Largest step of a vertex coordinate's latent, as a part of the mesh's longest side."""
TEXTURE_RATE = 0.03
"""Largest step of a texel's channel."""


@dataclass(frozen=True)
class LearnedMesh:
    """A triangle mesh with one RGBA texture, shown unlit and blended from both sides."""

    vertices: Tensor
    """Positions in meters, Y up, float32 [P, 3]; those on a seam of the texture occur once for each of its sides."""
    faces: Tensor
    """Vertices of each triangle, counter-clockwise from outside, int64 [F, 3]."""
    uvs: Tensor
    """Texture coordinates, float32 [P, 2]: (0, 0) is the outer corner of the top-left texel, (1, 1) that of the bottom-right one."""
    texture: Tensor
    """Straight-alpha display-referred RGBA, uint8 [h, w, 4]."""

    def __post_init__(self) -> None:
        check_shape("vertices", tuple(self.vertices.shape), (None, 3))
        check_shape("faces", tuple(self.faces.shape), (None, 3))
        check_shape("uvs", tuple(self.uvs.shape), (len(self.vertices), 2))
        check_shape("texture", tuple(self.texture.shape), (None, None, 4))

    def draw(self, camera: Camera) -> Tensor:
        """Draw one view by casting 16 rays a pixel: premultiplied RGBA in [0, 1], float32 [H, W, 4].

        Every surface on a ray is blended over those behind it. Raises ``InputError`` for a batch of cameras, or without Mitsuba or LLVM.
        """
        if camera.batched:
            fail("camera", "expected one camera, got a batch", "draw its cameras one by one")
        caster = RayCaster(self.faces, self.uvs)
        caster.move(self.vertices)
        center = torch.full((camera.height * camera.width * DRAW_GRID**2, 2), 0.5)
        colors = caster.colors(*pixel_rays(camera, center, DRAW_GRID), self.texture.float() / 255)
        return colors.reshape(camera.height, camera.width, -1, 4).mean(2)


def learn_mesh(
    views: ViewSet,
    *,
    vertices: int = 500,
    texels: int = 512,
    steps: int = 600,
    size: int = 256,
    seed: int = 0,
    on_step: Callable[[int, float], None] | None = None,
) -> LearnedMesh:
    """Learn a mesh and its texture from views of a tree: visual hull, texture coordinates, then ``refine_mesh``.

    Parameters
    ----------
    views, steps, size, seed, on_step
        As for ``refine_mesh``; the views are from around the tree.
    vertices
        Upper bound on the vertices of the result, which comes close to it; vertices on seams count once for each side, as in a file.
    texels
        Width and height of the texture.

    Raises
    ------
    InputError
        If an argument is out of range, the views share no common silhouette, or Mitsuba, LLVM or fast-simplification is missing.
    """
    check_count("vertices", vertices, 20)
    check_count("texels", texels, 16)
    _check_plan(steps, size, seed)
    points, triangles = hull_surface(views)
    start = _within(points, triangles, vertices, texels)
    return refine_mesh(start, views, steps=steps, size=size, seed=seed, on_step=on_step)


def mesh_glb(mesh: LearnedMesh) -> bytes:
    """The mesh as a GLB file: unlit, blended, both sides shown, its texture a PNG whose unseen texels have their neighbors' colors."""
    import trimesh
    from PIL import Image

    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(bleed_color(mesh.texture).numpy()), alphaMode="BLEND", doubleSided=True, metallicFactor=0.0
    )
    uv = mesh.uvs.numpy() * [1, -1] + [0, 1]  # trimesh counts from below
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    made = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), visual=visual, process=False, validate=False)

    def unlit(tree: dict[str, Any]) -> None:
        tree["extensionsUsed"] = ["KHR_materials_unlit"]
        for each in tree["materials"]:
            each["extensions"] = {"KHR_materials_unlit": {}}

    data = trimesh.exchange.gltf.export_glb(trimesh.Scene([made]), include_normals=False, tree_postprocessor=unlit)
    assert isinstance(data, bytes)
    return data


def refine_mesh(
    start: LearnedMesh,
    views: ViewSet,
    *,
    steps: int = 600,
    size: int = 256,
    seed: int = 0,
    on_step: Callable[[int, float], None] | None = None,
) -> LearnedMesh:
    """Move a mesh's vertices and paint its texture so that it looks like the training views; triangles and texture coordinates stay.

    Each step draws one view and descends on the mean squared error of its premultiplied RGBA. Its gradient has two parts: that of what
    each sample sees, by automatic differentiation, and that of the silhouettes, by sampling points on them (Li et al. 2018, "Differentiable
    Monte Carlo Ray Tracing through Edge Sampling"). Vertices descend along smoothed gradients (Nicolet et al. 2021, "Large Steps in
    Inverse Rendering of Geometry"), texels by Adam (Kingma and Ba 2015). Threads add up gradients in any order, so that two runs of one
    seed are alike but not equal.

    The pictures drawn have a larger side of ``size`` pixels, the views' own at most, and half of it in the first half of the steps. The
    seed chooses the order of the views and the places of the samples. ``on_step`` is called after each step with the number of steps
    done and the step's loss. Raises ``InputError`` if an argument is out of range, or Mitsuba or LLVM is missing.
    """
    _check_plan(steps, size, seed)
    with one_thread():  # Dr.Jit has threads of its own; with both, a step took 2.5 times as long on two cores
        return _refined(start, views, steps, size, seed, on_step or (lambda step, loss: None))


def _check_plan(steps: int, size: int, seed: int) -> None:
    check_count("steps", steps, 0)
    check_count("size", size, 4)
    check_count("seed", seed, 0)


def _refined(start: LearnedMesh, views: ViewSet, steps: int, size: int, seed: int, on_step: Callable[[int, float], None]) -> LearnedMesh:
    surface, caster = Surface(start.vertices, start.faces), RayCaster(start.faces, start.uvs)
    latent, texture = surface.latent(start.vertices), start.texture.float() / 255
    vertex_rate = VERTEX_RATE * float((start.vertices.max(0).values - start.vertices.min(0).values).max())
    by_vertex, by_texel = _Adam(latent, shared=True), _Adam(texture, shared=False)
    random = torch.Generator().manual_seed(seed)
    order: list[int] = []
    for step in range(steps):
        order = order or torch.randperm(len(views), generator=random).tolist()
        index = order.pop()
        camera, target = _target(views, index, size if 2 * step >= steps else max(size // 2, 4))
        points = surface.points(latent)
        caster.move(points[surface.source])
        places = torch.rand(camera.height * camera.width * FIT_GRID**2, 2, generator=random)
        losses: list[float] = []

        def error(image: Tensor, target: Tensor = target, losses: list[float] = losses) -> Tensor:
            losses.append(float((image - target).square().mean()))
            return 2 * (image - target) / target.numel()

        rays = pixel_rays(camera, places, FIT_GRID)
        slope, moved, painted = caster.gradients(*rays, texture, FIT_GRID**2, error)
        inner = torch.zeros_like(points).index_add_(0, surface.source, moved)
        outer = boundary_gradient(surface, points, camera, slope, partial(caster.colors, texture=texture), random)
        rate = 0.5 * (1 + math.cos(math.pi * step / steps))
        latent = by_vertex.step(latent, surface.smoothed(inner + outer), vertex_rate * rate)
        texture = by_texel.step(texture, painted, TEXTURE_RATE * rate).clamp_(0, 1)
        on_step(step + 1, losses[0])
    final = surface.points(latent)[surface.source]
    return LearnedMesh(final, start.faces, start.uvs, torch.from_numpy(to_bytes(texture)))


class _Adam:
    """Adam (Kingma and Ba 2015), or AdamUniform (Nicolet et al. 2021): one step size for all, by the largest element."""

    def __init__(self, like: Tensor, *, shared: bool) -> None:
        self._mean, self._square, self._shared, self._count = torch.zeros_like(like), torch.zeros_like(like), shared, 0

    def step(self, values: Tensor, gradient: Tensor, rate: float) -> Tensor:
        self._count += 1
        self._mean.lerp_(gradient, 0.1)
        self._square.lerp_(gradient.square(), 0.01)
        square = self._square / (1 - 0.99**self._count)
        scale = (square.max() if self._shared else square).sqrt() + 1e-12
        return values - rate / (1 - 0.9**self._count) * self._mean / scale


def _target(views: ViewSet, index: int, size: int) -> tuple[Camera, Tensor]:
    """One view at a smaller size: its camera and its premultiplied RGBA, [pixels, 4]."""
    camera, picture = views.cameras[index], views.targets([index])
    scale = min(1.0, size / max(camera.width, camera.height))
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    small = functional.interpolate(picture.permute(0, 3, 1, 2), (height, width), mode="area")
    return camera.resized(width, height), small[0].permute(1, 2, 0).reshape(-1, 4)


def _within(points: NDArray[np.float64], triangles: NDArray[np.int64], vertices: int, texels: int) -> LearnedMesh:
    """The finest simplification (Garland and Heckbert 1997) of a surface that keeps to a number of vertices, found by halving."""
    try:
        import fast_simplification
    except ImportError:
        fail("learned mesh", "fast-simplification is not installed", "pip install 'bbfit[rivals]'")
    low, high, best = 4, min(2 * vertices, len(triangles)), None
    while low <= high:
        middle = (low + high) // 2
        places, faces = fast_simplification.simplify(points.astype(np.float32), triangles, target_count=middle)
        source, corners, uvs = unfold(places.astype(np.float64), faces.astype(np.int64), texels)
        if len(source) <= vertices:
            low, best = middle + 1, (places[source], corners, uvs)
        else:
            high = middle - 1
        if best is not None and len(best[0]) >= 0.98 * vertices:
            break
    if best is None:
        fail("vertices", f"{vertices} are too few for a closed mesh with texture coordinates", "allow more")
    texture = torch.full((texels, texels, 4), 128, dtype=torch.uint8)
    places, corners, uvs = best
    return LearnedMesh(torch.from_numpy(places).float(), torch.from_numpy(corners), torch.from_numpy(uvs).float(), texture)
