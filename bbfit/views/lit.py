"""Views under any sun and sky, from pictures under one light at a time."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import torch
from torch import Tensor

from bbfit.checks import check_range
from bbfit.geometry.light import Light, from_z_up
from bbfit.images import sum_of_lights
from bbfit.views.view_set import ViewSet

SAME_SUN = 1e-3
"""Distance of unit vectors up to which two suns are the same."""


@dataclass(frozen=True)
class LitViews:
    """V cameras that see the tree under an even sky, and E pictures in which one of them sees it under a single sun.

    Light adds up, in linear light, so a weighted sum of two of them is the picture under both (Debevec et al. 2000, "Acquiring the
    Reflectance Field of a Human Face", section 3.3). The pictures have 8 bits; the sums are rounded to 8 bits again.
    """

    skies: ViewSet
    """V pictures under the sky alone."""
    suns: ViewSet
    """E pictures under one sun alone; their ``light`` is that of the pictures."""
    cameras: tuple[int, ...]
    """Index of the sky's picture with the camera of each sun's picture, E of them."""
    albedo: ViewSet | None = None
    """V pictures of the diffuse color of the surfaces, if there are any."""
    normal: ViewSet | None = None
    """V pictures of the normals of the surfaces, as (normal + 1) / 2 in a Z-up world, if there are any."""

    def __len__(self) -> int:
        return len(self.suns)

    @property
    def directions(self) -> Tensor:
        """Unit vectors towards the sun of each picture, Y up, float64 [E, 3]."""
        assert self.suns.light is not None
        return self.suns.light.sun_directions

    def under(self, sun_strength: float, ambient: float) -> ViewSet:
        """The E views under their sun and the sky, of strengths as in :class:`~bbfit.geometry.light.Light`, each at least 0."""
        check_range("sun_strength", sun_strength, 0, 1e6)
        check_range("ambient", ambient, 0, 1e6)
        of_sun, of_sky = self.suns.light, self.skies.light
        assert of_sun is not None and of_sky is not None
        parts = {
            self.suns.paths[index]: (
                self.skies.paths[camera],
                ambient / float(of_sky.ambients[camera]),
                sun_strength / float(of_sun.sun_strengths[index]),
            )
            for index, camera in enumerate(self.cameras)
        }

        def read(path: Path) -> Tensor:
            sky, sky_factor, sun_factor = parts[path]
            pictures = [self.skies.read(sky).numpy(), self.suns.read(path).numpy()]
            return torch.from_numpy(sum_of_lights(pictures, [sky_factor, sun_factor]))

        colors, ones = of_sun.sun_colors, torch.ones(len(self), dtype=torch.float64)
        light = Light(of_sun.sun_directions, sun_strength * ones, colors, ambient * ones)
        return ViewSet(self.suns.paths, self.suns.cameras, read, light)

    def other_suns(self, baked: Light) -> list[int]:
        """The pictures under another sun than that of a light, a batch of one."""
        return torch.nonzero((self.directions - baked.sun_directions[0]).norm(dim=-1) > SAME_SUN)[:, 0].tolist()

    def normals(self, index: int) -> Tensor:
        """The normals that one of the V cameras sees, Y up, float32 [H, W, 3]; they have unit length where one surface fills a pixel."""
        assert self.normal is not None
        return torch.stack(from_z_up((2 * self.normal.image(index)[..., :3].float() / 255 - 1).unbind(-1)), -1)  # type: ignore[arg-type]

    @property
    def fingerprint(self) -> str:
        """SHA-256 over all pictures, cameras and lights."""
        parts = [self.skies, self.suns, *(views for views in (self.albedo, self.normal) if views is not None)]
        digest = sha256(repr((self.cameras, [len(part) for part in parts])).encode())
        for part in parts:
            digest.update(part.fingerprint.encode())
        for light in (self.skies.light, self.suns.light):
            assert light is not None
            digest.update(light.fingerprint.encode())
        return digest.hexdigest()
