"""Models with maps in the real Babylon.js: it shows what bbfit shows in the same light."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from browser_viewer import open_program
from glb_edit import with_min_filter
from noise_scene import noise_cloud
from playwright.sync_api import Browser
from test_lights import BILINEAR
from test_lit import with_maps

from bbfit.evaluation.metrics import psnr
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.geometry.camera import Camera
from bbfit.geometry.light import Light, sky
from bbfit.images import over_color


@pytest.mark.parametrize("handed", ["left", "right"])
@pytest.mark.parametrize("alpha", ["mask", "blend"])
def test_babylon_lights_maps_as_bbfit_does(
    alpha: str, handed: str, chromium: tuple[Browser, ThreadPoolExecutor], around: Camera, tmp_path: Path
) -> None:
    """Five views under five suns, one-sided and two-sided billboards, in scenes of either hand.

    Measured: mask at least 35.5 dB, blend 53.9 dB; with the sun on the other side at most 23.6 dB. With Babylon.js's own anisotropic
    filtering of level 4, masks are at 31.9 dB and blended ones at 42.9 dB.
    """
    lights = Light.of(sky(5, 40.0), 1.8 * torch.pi, 0.4, (1.0, 0.9, 0.8))
    opposite = Light(lights.sun_directions * torch.tensor([-1.0, 1.0, -1.0]), *list(vars(lights).values())[1:])
    config = ExportConfig(profile="babylon", alpha=alpha, outline="rectangle", mipmaps=False)  # type: ignore[arg-type]
    with open_program(*chromium, "babylon", f"handed={handed}&anisotropy=1") as babylon:
        for two_sided in (False, True):
            model = shipped_model(with_maps(noise_cloud(3 if alpha == "mask" else 1, texels=32, two_sided=two_sided)), config)
            (path,) = model.save(tmp_path / f"{two_sided}.glb")
            show = babylon.show(with_min_filter(path, BILINEAR), around, light=lights)
            own, other = (over_color(model.draw(around, light).double()).numpy() for light in (lights, opposite))
            assert psnr(own, show.images) >= 33
            assert psnr(other, show.images) < 28
            (material,) = show.materials
            assert (material.kind, material.side, material.transparent) == ("PBRMaterial", "front", alpha == "blend") and not show.warnings
