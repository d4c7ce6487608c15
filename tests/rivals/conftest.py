"""A small tree-like thing without any symmetry, lit from all around, and how finely it is baked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.visual.material import PBRMaterial

from bbfit.blender.config import ViewsConfig
from bbfit.rivals.baking import BakeConfig

# A red post on the origin, a green arm along +X at its top, a blue foot along +Z: low and high corner, color.
BOXES = (
    ((-0.2, 0.0, -0.2), (0.2, 2.0, 0.2), (200, 30, 30)),
    ((0.2, 1.5, -0.1), (1.3, 1.8, 0.1), (30, 200, 30)),
    ((-0.1, 0.0, 0.2), (0.1, 0.3, 0.8), (30, 30, 200)),
)


@pytest.fixture(scope="session")
def thing_glb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The boxes as a .glb, matt."""
    path = tmp_path_factory.mktemp("thing") / "thing.glb"
    meshes = []
    for low, high, color in BOXES:
        mesh = trimesh.creation.box(bounds=np.array([low, high]))
        material = PBRMaterial(name=str(color), baseColorFactor=[*color, 255], metallicFactor=0.0, roughnessFactor=1.0)
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
        meshes.append(mesh)
    trimesh.Scene(meshes).export(str(path))
    return path


@pytest.fixture(scope="session")
def coarse() -> BakeConfig:
    """Twenty texels a meter, one light path a texel."""
    return BakeConfig(20.0, views=ViewsConfig(samples=4, denoise=False))
