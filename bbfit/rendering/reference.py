"""The specification of what a billboard cloud looks like: kornia's perspective warp of each plane, depth order, the over operator.

Differentiable in the texels and in the placement. Written to be read; faster renderers prove themselves against it.
"""

from __future__ import annotations

import torch
from kornia.geometry.transform import warp_perspective
from torch import Tensor
from torch.nn.functional import pad

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.homography import signed_distance, texel_depth, texel_to_pixel
from bbfit.rendering.compositing import composite

# A plane is edge-on, and so not drawn, when the camera is nearer to it than this share of its distance to the billboard's centre.
EDGE_ON = 1e-5


def render_reference(cloud: BillboardCloud, camera: Camera) -> Tensor:
    """Draw a billboard cloud.

    Each texture is filtered bilinearly with straight alpha, as engines do, then premultiplied; a margin of one transparent texel in the
    colour of its neighbour surrounds it. Pixels whose ray meets the plane behind the camera, or a plane seen edge-on, show nothing.

    Returns
    -------
    Premultiplied RGBA, [V, H, W, 4] ([H, W, 4] for a single camera), in the cloud's dtype.
    """
    cameras = camera.batch().to(cloud.texels.dtype)
    views, height, width = len(cameras), cameras.height, cameras.width
    if len(cloud) == 0:
        image = torch.zeros(views, height, width, 4, dtype=cloud.texels.dtype, device=cloud.texels.device)
        return image if camera.batched else image[0]

    distance = signed_distance(cloud, cameras)  # [V, N]
    reach = torch.ones_like(distance)
    if not cameras.orthographic:
        reach = (cameras.position[:, None] - cloud.centers).norm(dim=-1)
    visible = distance.abs() > EDGE_ON * reach
    identity = torch.eye(3, dtype=distance.dtype, device=distance.device)
    # Replacing singular matrices *before* they are inverted keeps every gradient finite.
    matrices = torch.where(visible[..., None, None], texel_to_pixel(cloud, cameras), identity)
    drawn, depth = _plane_depth(matrices.detach(), texel_depth(cloud, cameras).detach(), visible, height, width)

    sources = _facing_textures(cloud, distance.detach() >= 0)
    # The margin shifts texel coordinates by one.
    shift = torch.tensor([[1.0, 0, -1], [0, 1, -1], [0, 0, 1]], dtype=matrices.dtype, device=matrices.device)
    if len({source.shape for source in sources}) == 1:  # one call for all planes: kornia works on batch entries in parallel
        stacked = warp_perspective(
            torch.cat(sources), (matrices @ shift).transpose(0, 1).flatten(0, 1), (height, width),
            mode="bilinear", padding_mode="zeros", align_corners=True,
        )  # fmt: skip
        warped = list(stacked.split(views))
    else:
        warped = [
            warp_perspective(
                source, matrices[:, n] @ shift, (height, width),
                mode="bilinear", padding_mode="zeros", align_corners=True,
            )
            for n, source in enumerate(sources)
        ]  # fmt: skip
    colours, alphas = zip(*(layer.split((3, 1), 1) for layer in warped), strict=True)
    shown = [alpha * mask for alpha, mask in zip(alphas, drawn, strict=True)]
    image = composite(list(colours), shown, list(depth)).permute(0, 2, 3, 1)
    return image if camera.batched else image[0]


def _facing_textures(cloud: BillboardCloud, front: Tensor) -> list[Tensor]:
    """Per billboard the texture that each view sees, with its margin: N tensors [V, 4, h + 2, w + 2]."""
    sources = []
    for n, texture in enumerate(cloud.textures()):
        padded = pad(texture.permute(0, 3, 1, 2), (1, 1, 1, 1), mode="replicate")
        margin = torch.ones_like(padded[0])
        margin[3] = pad(torch.ones_like(texture[0, ..., 3]), (1, 1, 1, 1))
        padded = padded * margin
        sources.append(padded.expand(len(front), -1, -1, -1) if len(texture) == 1 else padded[(~front[:, n]).long()])
    return sources


def _plane_depth(matrices: Tensor, depth_rows: Tensor, visible: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Where each plane is met in front of the camera, bool [N, V, 1, H, W], and at what depth, [N, V, 1, H, W]."""
    to_texel = torch.linalg.inv(matrices).transpose(0, 1)  # [N, V, 3, 3]
    y = torch.arange(height, dtype=matrices.dtype, device=matrices.device)[:, None]
    x = torch.arange(width, dtype=matrices.dtype, device=matrices.device)
    # H^-1 (x, y, 1) is the texel times 1 / scale; its third coordinate and its depth are both linear in the pixel.
    rows = torch.stack([to_texel[..., 2, :], (depth_rows.transpose(0, 1)[..., None, :] @ to_texel)[..., 0, :]])
    a, b, c = (rows[..., i, None, None, None] for i in range(3))
    scale, scaled_depth = a * x + b * y + c
    depth = scaled_depth / scale
    drawn = visible.mT[..., None, None, None] & (depth > 0) & depth.isfinite() & (scale.abs() > 1e-12)
    return drawn, torch.where(drawn, depth, torch.inf)
