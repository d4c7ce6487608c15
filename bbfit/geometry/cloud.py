"""The billboard cloud: N textured rectangles in space, as a struct of arrays, stored in one file."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bbfit.checks import InputError, check_choice, check_count, check_file, check_shape, fail
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.light import Light
from bbfit.inputs import LARGEST, reading
from bbfit.scratch import named_in_utf8

FORMAT, FORMAT_WITH_MAPS = "bbfit billboard cloud 1", "bbfit billboard cloud 2"
TENSORS = ("centers", "rights", "ups", "half_extents", "texture_sizes", "two_sided", "texels")
"""Names of the tensors that every cloud has."""
# Prefix of the names of a light's tensors in a file.
_LIGHT = "light."
_EXPECTED = "expected a file written by bbfit fit"
_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class BillboardCloud:
    """N textured rectangles (Décoret et al. 2003, "Billboard Clouds for Extreme Model Simplification").

    The front of a billboard is the side that its normal, ``right x up``, points to. A one-sided entry shows the same texture from both
    sides. A two-sided entry has two textures, each drawn only when the camera is on its side. Both are stored as seen from the front,
    so equal texels of both are at the same point in space.

    Texture row 0 is at the top. The rectangle spans the texels' outer *edges*; beyond the outermost texel centers the picture fades
    to transparent over one texel, exactly as bilinear filtering does in an atlas with a transparent margin.
    """

    centers: Tensor
    """Rectangle centers in meters, [N, 3]."""
    rights: Tensor
    """Unit vectors from texture left to right, [N, 3]."""
    ups: Tensor
    """Unit vectors from texture bottom to top, perpendicular to ``rights``, [N, 3]."""
    half_extents: Tensor
    """Half width and half height in meters, [N, 2]."""
    texture_sizes: Tensor
    """Texture height and width in texels, int64 [N, 2]."""
    two_sided: Tensor
    """Whether there is a separate back texture, bool [N]."""
    texels: Tensor
    """Straight-alpha display-referred RGBA in [0, 1], [P, 4]: per billboard its front texture row by row, then its back texture if any."""
    alpha: AlphaMode = field(default_factory=AlphaMode)
    """The alpha mode of renders, scores and exports."""
    surface: Tensor | None = None
    """Maps of a cloud that takes the light of a program, [P, 4] in [0, 1]; ``None`` if the light is baked into the texels' color.
    Channels 0 and 1 are the components of the normal along right and up, as (n + 1) / 2; the third points to the viewer's side. Channel 2
    is occlusion, the share of the sky that lights the texel (1 in the open). Channel 3 is translucency, the share of the light that
    passes through. The texels' color is then base color, the reflectance, as display-referred sRGB."""
    light: Light | None = None
    """The light, a batch of one, in which a cloud with maps is drawn unless another is given; ``None`` for other clouds."""

    def __post_init__(self) -> None:
        check_shape("centers", tuple(self.centers.shape), (None, 3))
        n = len(self.centers)
        check_shape("rights", tuple(self.rights.shape), (n, 3))
        check_shape("ups", tuple(self.ups.shape), (n, 3))
        check_shape("half_extents", tuple(self.half_extents.shape), (n, 2))
        check_shape("texture_sizes", tuple(self.texture_sizes.shape), (n, 2))
        check_shape("two_sided", tuple(self.two_sided.shape), (n,))
        if self.texture_sizes.dtype != torch.int64 or (self.texture_sizes < 1).any():
            fail("texture_sizes", f"expected int64 values of at least 1, got {self.texture_sizes.dtype}")
        check_choice("two_sided's dtype", self.two_sided.dtype, (torch.bool,))
        check_shape("texels", tuple(self.texels.shape), (sum(self._texel_counts), 4))
        if (self.surface is None) != (self.light is None):
            fail("light", "expected one exactly if there is a surface")
        if self.surface is not None and self.light is not None:
            check_shape("surface", tuple(self.surface.shape), (len(self.texels), 4))
            check_shape("light", (len(self.light),), (1,))

    def __len__(self) -> int:
        return self.centers.shape[0]

    @property
    def _texel_counts(self) -> list[int]:
        sizes, sides = self.texture_sizes.tolist(), self.two_sided.tolist()
        return [h * w * (1 + two) for (h, w), two in zip(sizes, sides, strict=True)]

    @property
    def normals(self) -> Tensor:
        """Unit normals, [N, 3]."""
        return torch.linalg.cross(self.rights, self.ups)

    @property
    def tangent_normals(self) -> Tensor:
        """The unit normals of a cloud with maps in the axes (right, up, towards the viewer's side) of their texture, [P, 3]."""
        assert self.surface is not None
        across = 2 * self.surface[:, :2] - 1
        across = across / across.norm(dim=-1, keepdim=True).clamp_min(1)
        return torch.cat([across, (1 - across.square().sum(-1, keepdim=True)).clamp_min(0).sqrt()], -1)

    @property
    def translucent(self) -> bool:
        """Whether light passes through a texel, in 8 bits."""
        return self.surface is not None and bool((255 * self.surface[:, 3] > 0.5).any())

    @property
    def vertex_count(self) -> int:
        """Vertices of the billboards as rectangles: four for each texture. An export with other outlines has others."""
        return 4 * (len(self) + int(self.two_sided.sum()))

    @property
    def texel_density(self) -> float:
        """Texels per meter along a side, of all textures together; 0 for an empty cloud."""
        area = float((4 * self.half_extents.prod(-1) * (1 + self.two_sided.long())).sum())
        return math.sqrt(len(self.texels) / area) if len(self) else 0.0

    @property
    def _tensors(self) -> dict[str, Any]:
        """All tensors by name."""
        return {name: getattr(self, name) for name in TENSORS} | ({} if self.surface is None else {"surface": self.surface})

    def textures(self, values: Tensor | None = None) -> list[Tensor]:
        """The textures as views into ``texels``, or into other values of the texels, [P, C]: N tensors of [S, h, w, C]; S = 1 or 2 (front,
        back)."""
        parts = (self.texels if values is None else values).split(self._texel_counts)
        sizes, sides = self.texture_sizes.tolist(), self.two_sided.tolist()
        return [part.reshape(1 + two, h, w, -1) for part, (h, w), two in zip(parts, sizes, sides, strict=True)]

    def to(self, target: torch.device | torch.dtype | str) -> BillboardCloud:
        """Move to a device, or convert the floating-point tensors to a dtype."""
        moved = self._tensors
        for name, tensor in moved.items():
            if not isinstance(target, torch.dtype) or tensor.is_floating_point():
                moved[name] = tensor.to(target)
        return replace(self, **moved)

    def with_texels(self, texels: Tensor) -> BillboardCloud:
        """The same rectangles with other texels, [P, 4]."""
        return replace(self, texels=texels)

    def baked(self, texels: Tensor) -> BillboardCloud:
        """The same rectangles without maps, with texels, [P, 4], that contain the light."""
        return replace(self, texels=texels, surface=None, light=None)

    def without_textures(self) -> BillboardCloud:
        """The same rectangles with transparent texels, which take no memory, and no maps; do not write to them."""
        return self.baked(self.texels.new_zeros(1, 4).expand(len(self.texels), 4))

    def opaque(self) -> BillboardCloud:
        """The same without translucency, as programs show it that know none."""
        return replace(self, surface=self.surface * self.surface.new_tensor([1, 1, 1, 0])) if self.surface is not None else self

    def take(self, kept: Iterable[int]) -> BillboardCloud:
        """Some of the billboards, in the given order."""
        kept, taken = list(kept), dict[str, Any]()
        for name, tensor in self._tensors.items():
            if name in ("texels", "surface"):
                textures = self.textures(tensor)
                taken[name] = torch.cat([textures[n].reshape(-1, 4) for n in kept]) if kept else tensor[:0]
            else:
                taken[name] = tensor[kept]
        return replace(self, **taken)

    def parts(self, count: int) -> list[BillboardCloud]:
        """The billboards in ``count`` clouds of equal numbers."""
        each = len(self) // count
        return [self.take(range(part * each, (part + 1) * each)) for part in range(count)] if count > 1 else [self]

    @staticmethod
    def joined(clouds: Sequence[BillboardCloud]) -> BillboardCloud:
        """The billboards of several clouds in one, with the alpha mode and the light of the first; all have maps or none has."""
        tensors: dict[str, Any] = {name: torch.cat([cloud._tensors[name] for cloud in clouds]) for name in clouds[0]._tensors}
        return replace(clouds[0], **tensors)

    def check(self) -> None:
        """Require what every finished cloud is: of floats, within a sane distance of the origin, of unit axes, and of texels in [0, 1].

        Raises ``InputError`` with the name of the tensor that is not.
        """
        self.check_rectangles()
        check_choice("texels's dtype", self.texels.dtype, (self.centers.dtype,))
        for name, values in {"texels": self.texels, "surface": self.surface}.items():
            if values is not None and not ((values >= 0) & (values <= 1)).all():  # NaN is neither
                fail(name, "expected values in [0, 1]")
        if self.surface is not None:
            check_choice("surface's dtype", self.surface.dtype, (self.centers.dtype,))

    def check_rectangles(self) -> None:
        """The part of :meth:`check` that does not look at the texels."""
        vectors = {name: getattr(self, name) for name in ("centers", "rights", "ups", "half_extents")}
        for name, tensor in vectors.items():
            check_choice(f"{name}'s dtype", tensor.dtype, (torch.float32, torch.float64) if name == "centers" else (self.centers.dtype,))
            if not tensor.isfinite().all():
                fail(name, "expected finite values")
        if (self.centers.abs() > LARGEST).any():
            fail("centers", f"expected at most {LARGEST:g} meters from the origin")
        if ((self.half_extents <= 0) | (self.half_extents > LARGEST)).any():
            fail("half_extents", f"expected more than 0 and at most {LARGEST:g} meters")
        for name in ("rights", "ups"):
            if ((vectors[name].double().norm(dim=-1) - 1).abs() > _UNIT_TOLERANCE).any():
                fail(name, "expected unit vectors")
        if ((self.rights.double() * self.ups.double()).sum(-1).abs() > _UNIT_TOLERANCE).any():
            fail("ups", "expected vectors perpendicular to rights")

    def save(self, path: str | Path) -> None:
        """Write one ``.safetensors`` file, completely or not at all. Raises the errors of :meth:`check`: it writes nothing damaged."""
        from bbfit.files import write_tensors

        self.check()
        tensors = self._tensors | {f"{_LIGHT}{name}": value for name, value in (vars(self.light) if self.light else {}).items()}
        tensors = {name: value.detach().cpu().clone(memory_format=torch.contiguous_format) for name, value in tensors.items()}
        alpha = json.dumps({"kind": self.alpha.kind, "cutoff": self.alpha.cutoff})
        form = FORMAT if self.surface is None else FORMAT_WITH_MAPS
        write_tensors(path, tensors, {"format": f"{form} {alpha}"})  # in one entry, because the order of several is not defined

    @staticmethod
    def load(path: str | Path) -> BillboardCloud:
        """Read a file that :meth:`save` wrote.

        Raises
        ------
        MissingFileError, InputError
            If the file is missing, empty, not a billboard cloud or damaged, or holds values that no cloud has (:meth:`check`).
        """
        from safetensors import safe_open

        if (inside := Path(path) / "cloud.safetensors").is_file():  # a run's folder
            fail("cloud", f"{path} is a folder", f"give the file {inside}")
        path = check_file("cloud", path)
        if path.suffix.lower() in (".glb", ".gltf", ".obj"):
            fail("cloud", f"{path} is a model", "give the cloud.safetensors of its run")
        with reading("cloud", path, _EXPECTED):
            with named_in_utf8(path) as named, safe_open(named, framework="pt") as file:
                form = (file.metadata() or {}).get("format", "")
                kind = next((kind for kind in (FORMAT, FORMAT_WITH_MAPS) if form == kind or form.startswith(f"{kind} ")), None)
                if kind is None:
                    fail("cloud", f"{path} is not a billboard cloud", _EXPECTED)
                has_maps = kind == FORMAT_WITH_MAPS
                tensors = {name: file.get_tensor(name) for name in (*TENSORS, *(("surface",) if has_maps else ()))}
                of_light = {entry.name: file.get_tensor(f"{_LIGHT}{entry.name}") for entry in fields(Light)} if has_maps else {}
            try:
                light = Light(**of_light) if has_maps else None
                cloud = BillboardCloud(**tensors, alpha=AlphaMode(**json.loads(form[len(kind) :] or "{}")), light=light)
                cloud.check()
            except InputError as error:
                fail("cloud", f"{path} is damaged ({error})", _EXPECTED)
            return cloud


def even_upright(
    count: int,
    *,
    axis: Tensor,
    half_extents: Tensor,
    texture_sizes: Tensor,
    sides: str = "one",
    gap: float = 0.0,
) -> BillboardCloud:
    """N >= 1 upright billboards at k·180°/N through a vertical axis, with transparent textures (thesis, section 4.2 and figures 2 and 4).

    ``axis`` is the point, [3], that all rectangles are centered on horizontally and vertically. ``half_extents`` in meters and
    ``texture_sizes`` (height and width in texels) are [2] or [N, 2]. ``sides`` is ``"one"``, ``"two"`` (front and back texture), or
    ``"pair"``: two one-sided rectangles ``gap`` meters apart along the normal, both always drawn (thesis, section 6.4). A pair stands next
    to each other: entries 2k (front) and 2k + 1 (back).
    """
    check_count("billboards", count)
    check_choice("sides", sides, ("one", "two", "pair"))
    angle = torch.arange(count, dtype=axis.dtype, device=axis.device) * (math.pi / count)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rights = torch.stack([angle.cos(), zero, -angle.sin()], -1)
    ups = torch.stack([zero, one, zero], -1)
    centers = axis.expand(count, 3)
    half_extents, texture_sizes = half_extents.expand(count, 2), texture_sizes.expand(count, 2)
    if sides == "pair":
        rights, ups, centers, half_extents, texture_sizes = (
            tensor.repeat_interleave(2, 0) for tensor in (rights, ups, centers, half_extents, texture_sizes)
        )
        offset = torch.tensor([gap / 2, -gap / 2], dtype=axis.dtype, device=axis.device).repeat(count)
        centers = centers + offset[:, None] * torch.linalg.cross(rights, ups)
    two = torch.full((len(centers),), sides == "two", device=axis.device)
    texel_count = int((texture_sizes.prod(-1) * (1 + two.long())).sum())
    return BillboardCloud(
        centers.clone(),
        rights,
        ups,
        half_extents.clone(),
        texture_sizes.clone(),
        two,
        torch.zeros(texel_count, 4, dtype=axis.dtype, device=axis.device),
    )
