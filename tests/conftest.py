"""What all tests share: one thread each, a small scene with views of it, and the folder of real trees beside the checkout."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from dead_workers import pytest_testnodedown, pytest_xdist_newgateway  # noqa: F401 (hooks)
from own_process import pytest_runtest_protocol  # noqa: F401 (a hook)

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.orbit import Orbit
from bbfit.images import to_bytes, unpremultiply, write_png
from bbfit.layout import split_views, write_transforms
from bbfit.rendering.reference import render_reference

torch.set_num_threads(1)  # the suite runs in as many processes as there are cores

TESTS = Path(__file__).resolve().parent
SHARED = TESTS.parent / "../shared"
# What the tests of a folder or a module need, by their places below this folder; scripts/test --fast leaves all of them out. Modules of
# which only some tests need something mark these themselves.
NEEDS = {
    "blender": ("blender", "rivals/test_baking.py", "test_comparison.py"),
    "browser": ("viewers", "viewing"),
    "ray": ("sweep/test_cluster.py",),
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests with what they need."""
    for item in items:
        place = item.path.relative_to(TESTS)
        for need, places in NEEDS.items():
            if any(place.is_relative_to(folder) for folder in places):
                item.add_marker(need)


@pytest.fixture
def shared() -> Path:
    """The folder with real trees and views; the test skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("the folder with real trees is not here")
    return SHARED


def smooth_texture(height: int, width: int, seed: int) -> torch.Tensor:
    """A smooth straight-alpha texture that is opaque in the middle and fades to nothing, [h, w, 4]."""
    generator = torch.Generator().manual_seed(seed)
    color = torch.nn.functional.interpolate(
        torch.rand(1, 3, 4, 4, generator=generator), (height, width), mode="bicubic", align_corners=True
    )
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    alpha = (1.6 * (1 - (x**2 + y**2).sqrt() / 0.8)).clamp(0, 1)
    return torch.cat([color[0].permute(1, 2, 0).clamp(0, 1), alpha[..., None]], -1)


def write_views(folder: Path, cloud: BillboardCloud, camera: Camera, *, seed: int = 0) -> Path:
    """A views folder of renders of ``cloud``, in the layout that ``bbfit views`` writes."""
    (folder / "images").mkdir(parents=True)
    names = [f"images/{index:04d}.png" for index in range(len(camera))]
    for index, name in enumerate(names):
        write_png(folder / name, to_bytes(unpremultiply(render_reference(cloud, camera[index]))))
    write_transforms(folder, camera, names, *split_views(len(camera), seed))
    return folder


@pytest.fixture(scope="session")
def known_cloud() -> BillboardCloud:
    """Two crossed billboards with smooth textures, about the point (0.3, 1.2, -0.2)."""
    planes = even_upright(
        2,
        axis=torch.tensor([0.3, 1.2, -0.2]),
        half_extents=torch.tensor([1.0, 1.2]),
        texture_sizes=torch.tensor([36, 30]),
    )
    return planes.with_texels(torch.cat([smooth_texture(36, 30, seed).reshape(-1, 4) for seed in (1, 2)]))


@pytest.fixture(scope="session")
def ring(known_cloud: BillboardCloud) -> Camera:
    """Sixteen cameras around ``known_cloud``, 48 x 40 pixels."""
    extent = known_cloud.half_extents[0].tolist()
    points = known_cloud.centers[0].numpy() + [[x, y, z] for x in (-extent[0], extent[0]) for y in (-extent[1], extent[1]) for z in (-1, 1)]
    return Orbit(16).frame(points, target=known_cloud.centers[0].double(), width=48, height=40)


@pytest.fixture(scope="session")
def views_folder(tmp_path_factory: pytest.TempPathFactory, known_cloud: BillboardCloud, ring: Camera) -> Path:
    """Sixteen views of ``known_cloud`` on disk. Do not change it."""
    return write_views(tmp_path_factory.mktemp("known") / "views", known_cloud, ring)
