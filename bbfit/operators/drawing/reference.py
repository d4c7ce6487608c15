"""Drawing in torch, the specification: kornia's perspective warp of each plane, depth order per pixel, the over operator."""

from __future__ import annotations

import torch
from kornia.geometry.transform import warp_perspective
from torch import Tensor
from torch.nn.functional import pad

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.homography import pixel_depth, signed_distance, texel_to_pixel
from bbfit.operators.drawing.compositing import composite, layer_weights, opacity, thresholds

# A plane is edge-on, and not drawn, if the camera's distance to it is below this share of its distance to the billboard's center.
EDGE_ON = 1e-5
# Most attempts to move a plane off a horizon through a pixel's center; one is nearly always enough.
NUDGES = 8


def render_reference(cloud: BillboardCloud, camera: Camera) -> Tensor:
    """Draw a billboard cloud: premultiplied RGBA, [V, H, W, 4] ([H, W, 4] for a single camera), in the cloud's dtype.

    Each texture is filtered bilinearly with straight alpha, as engines do, and then premultiplied. A margin of one transparent texel in the
    color of its neighbor surrounds it. The alpha mode of the cloud turns filtered alpha into opacity (without a gradient in the mode
    ``hash``). A plane shows nothing edge-on and behind the camera. Differentiable in texels and placement.

    Parameters
    ----------
    cloud
        N >= 0 billboards.
    camera
        One camera or V cameras.
    """
    if len(cloud) == 0:
        views = len(camera.batch())
        image = cloud.texels.new_zeros(views, camera.height, camera.width, 4) + cloud.texels.sum()  # of no texels, so that backward() works
    else:
        colors, alphas, depths = _layers(cloud, camera)
        image = composite(colors, alphas, depths, nested=cloud.alpha.nested).permute(0, 2, 3, 1)
    return image if camera.batched else image[0]


def render_layers_reference(cloud: BillboardCloud, camera: Camera) -> tuple[list[Tensor], list[Tensor]]:
    """Draw the layers of N >= 1 billboards, which :func:`joined_layers` joins to the picture of :func:`render_reference`.

    Returns
    -------
    colors : list of Tensor
        Straight colors of the layers, N of [V, 3, H, W].
    weights : list of Tensor
        Weights of the layers in the image, N of [V, 1, H, W].
    """
    colors, alphas, depths = _layers(cloud, camera)
    return colors, layer_weights(alphas, depths, nested=cloud.alpha.nested)


def joined_layers(colors: list[Tensor], weights: list[Tensor]) -> Tensor:
    """The picture of layers with straight colors [V, 3, H, W] and weights [V, 1, H, W]: premultiplied RGBA, [V, H, W, 4]."""
    parts = [torch.cat([color, torch.ones_like(weight)], 1) * weight for color, weight in zip(colors, weights, strict=True)]
    return sum(parts[1:], parts[0]).permute(0, 2, 3, 1)


def _layers(cloud: BillboardCloud, camera: Camera) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Straight colors [V, 3, H, W], opacities and depths, both [V, 1, H, W], of each billboard in V views."""
    cameras = camera.batch().to(cloud.texels.dtype)
    views, height, width = len(cameras), cameras.height, cameras.width
    visible = drawable(cloud, cameras)
    drawn, depth = _plane_depth(cloud, cameras, visible)

    identity = torch.eye(3, dtype=depth.dtype, device=depth.device)
    # Replacing singular matrices *before* they are inverted keeps every gradient finite.
    matrices = torch.where(visible[..., None, None], texel_to_pixel(cloud, cameras), identity)
    # The margin shifts texel coordinates by one.
    shift = torch.tensor([[1.0, 0, -1], [0, 1, -1], [0, 0, 1]], dtype=matrices.dtype, device=matrices.device)
    matrices = (matrices @ shift).transpose(0, 1)  # [N, V, 3, 3]
    sources = _facing_textures(cloud, signed_distance(cloud, cameras).detach() >= 0)
    even = (height + height % 2, width + width % 2)  # squares of 2 x 2 pixels may reach beyond the picture
    if len({source.shape for source in sources}) == 1:  # one call for all planes: kornia works on batch entries in parallel
        warped = list(_warp(torch.cat(sources), matrices.flatten(0, 1), *even).split(views))
    else:
        warped = [_warp(source, matrix, *even) for source, matrix in zip(sources, matrices, strict=True)]
    colors, alphas = zip(*((layer[:, :3, :height, :width], layer[:, 3:]) for layer in warped), strict=True)
    if cloud.alpha.kind == "hash":
        opaque = _hashed(cloud, [alpha[..., :height, :width] for alpha in alphas], signed_distance(cloud, cameras) >= 0)
    else:
        opaque = [opacity(alpha, cloud.alpha)[..., :height, :width] for alpha in alphas]
    return list(colors), [alpha * mask for alpha, mask in zip(opaque, drawn, strict=True)], list(depth)


def drawable(cloud: BillboardCloud, cameras: Camera) -> Tensor:
    """Whether each view can show each billboard, bool [V, N]: it is not edge-on and has an area."""
    distance = signed_distance(cloud, cameras).detach()
    reach = torch.ones_like(distance)
    if not cameras.orthographic:
        reach = (cameras.position[:, None] - cloud.centers.detach()).norm(dim=-1)
    return (distance.abs() > EDGE_ON * reach) & (cloud.half_extents.detach() != 0).all(-1)


def _warp(sources: Tensor, matrices: Tensor, height: int, width: int) -> Tensor:
    """Warp each source [B, 4, h, w] by its texel-to-pixel matrix [B, 3, 3]: straight RGBA, [B, 4, H, W].

    Texels on the horizon of a plane lie at infinity. If the horizon runs exactly through a pixel's center (for example of a plane parallel
    to the optical axis, in a picture of odd width), kornia divides by zero, and one such pixel makes the plane's whole gradient NaN. The
    plane is then moved by a few rounding errors of a pixel coordinate, in float32 by a millionth of the picture.
    """
    eps = torch.finfo(matrices.dtype).eps
    for _ in range(NUDGES):
        warped = warp_perspective(
            sources, matrices, (height, width), mode="bilinear", padding_mode="zeros", align_corners=True
        )  # fmt: skip
        broken = ~warped[:, 3].isfinite().flatten(1).all(1)
        if not broken.any():
            break
        nudge = torch.eye(3, dtype=matrices.dtype, device=matrices.device)
        nudge[0, 2], nudge[1, 2] = 10 * eps * width, 7 * eps * height
        matrices = torch.where(broken[:, None, None], nudge @ matrices, matrices)
    return warped


def _facing_textures(cloud: BillboardCloud, front: Tensor) -> list[Tensor]:
    """The texture of each billboard that each view sees, with its margin: N tensors [V, 4, h + 2, w + 2]."""
    sources = []
    for n, texture in enumerate(cloud.textures()):
        color, alpha = texture.permute(0, 3, 1, 2).split((3, 1), 1)
        padded = torch.cat([pad(color, (1, 1, 1, 1), mode="replicate"), pad(alpha, (1, 1, 1, 1))], 1)
        sources.append(padded.expand(len(front), -1, -1, -1) if len(texture) == 1 else padded[(~front[:, n]).long()])
    return sources


def _hashed(cloud: BillboardCloud, alphas: list[Tensor], front: Tensor) -> list[Tensor]:
    """Layers [V, 1, H, W] of the mode ``hash``; ``front`` [V, N] is whether a view sees the front."""
    height, width = alphas[0].shape[2:]
    y, x = torch.meshgrid(*(torch.arange(side, device=front.device) for side in (height, width)), indexing="ij")
    first, opaque = 0, []
    for n, ((h, w), two) in enumerate(zip(cloud.texture_sizes.tolist(), cloud.two_sided.tolist(), strict=True)):
        sides = torch.stack([thresholds(x, y, first), thresholds(x, y, first + two * h * w)])
        chosen = sides[(~front[:, n]).long()][:, None]  # [V, 1, H, W]
        opaque.append((alphas[n].detach() >= chosen).to(alphas[n]))
        first += h * w * (1 + two)
    return opaque


def _plane_depth(cloud: BillboardCloud, cameras: Camera, visible: Tensor) -> tuple[Tensor, Tensor]:
    """Whether a pixel's ray meets each plane in front of the camera, bool [N, V, 1, H, W], and at what depth, [N, V, 1, H, W]."""
    rows = torch.stack(pixel_depth(cloud, cameras)).detach().transpose(1, 2)  # [2, N, V, 3]
    y = torch.arange(cameras.height, dtype=rows.dtype, device=rows.device)[:, None]
    x = torch.arange(cameras.width, dtype=rows.dtype, device=rows.device)
    a, b, c = (rows[..., i, None, None, None] for i in range(3))
    numerator, denominator = a * x + b * y + c
    depth = numerator / denominator
    drawn = visible.mT[..., None, None, None] & (depth > 0) & depth.isfinite()
    return drawn, torch.where(drawn, depth, torch.inf)
