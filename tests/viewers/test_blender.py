"""Exported models in the real Blender: its importer and Cycles show what an independent viewer in float64 computes from the file.

Cycles filters textures as bbfit does, as displayed and without mip levels: masked models and single billboards are the same to five
digits. Two things are not. Blender blends layers in linear light, bbfit and engines as displayed, so that three crossing blended
billboards are 27 to 37 dB apart. And Cycles culls nothing: of a two-sided billboard it shows either face by chance (16 dB).
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from blender_viewer import render_blender
from noise_scene import expected, noise_cloud

from bbfit.evaluation.metrics import psnr
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import export
from bbfit.geometry.camera import Camera, orthographic_intrinsics
from bbfit.images import over_color
from bbfit.operators.drawing.reference import render_reference


@pytest.mark.parametrize(("alpha", "count"), [("mask", 3), ("blend", 1)])
def test_blender_shows_a_glb(alpha: str, count: int, around: Camera, tmp_path: Path) -> None:
    config = ExportConfig(alpha=alpha)  # type: ignore[arg-type]
    (glb,) = export(noise_cloud(count, texels=32), tmp_path / "model.glb", config)
    # Measured 112.7 and 115.9 dB, which is 16-bit PNGs' rounding; half a pixel of shift leaves 21.7 and 31.9. A masked pixel on the very
    # edge may one day fall to the other side; one of them, black on white, leaves 42.
    assert psnr(expected(glb, around), render_blender(glb, around)) >= 42


def test_blender_shows_an_obj(around: Camera, tmp_path: Path) -> None:
    """Blended, the only thing that an OBJ can ask for; colors are emitted, as ``illum 0`` asks and the importer does not do."""
    cloud = noise_cloud(1, texels=32)
    model, *_ = export(cloud, tmp_path / "model.obj")
    (glb,) = export(cloud, tmp_path / "model.glb")
    # Measured 60.5 dB: the importer has Blender filter premultiplied colors. Lit and without light, as it comes, it has 17.4.
    assert psnr(expected(glb, around), render_blender(model, around)) >= 48


def test_blender_shows_a_parallel_projection(around: Camera, tmp_path: Path) -> None:
    """The independent viewer has none; bbfit's reference renderer has."""
    cloud = noise_cloud(1, texels=32)
    intrinsics = orthographic_intrinsics(2.6, 64, 56) + torch.tensor([[0.0, 0, 3.3], [0, 0, -2.6], [0, 0, 0]])
    camera = Camera(around.world_to_camera[:1], intrinsics[None], 64, 56, orthographic=True)
    (glb,) = export(cloud, tmp_path / "model.glb")
    target = over_color(render_reference(cloud, camera)).numpy()
    assert psnr(target, render_blender(glb, camera)) >= 48  # measured 61.3, of the exporter's 8 bits; half a pixel of shift leaves 35
