"""What all tests share: one thread for each process, a small scene with views of it, and the folder of real trees beside the checkout."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

# The suite runs in as many processes as there are cores, and threads that wait for a core cost more than they gain. Libraries read this
# when they are imported, child processes inherit it.
os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import pytest
import torch
from dead_workers import pytest_testnodedown, pytest_xdist_newgateway  # noqa: F401 (hooks)
from own_process import pytest_runtest_makereport, pytest_runtest_protocol  # noqa: F401 (hooks)

from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud, even_upright
from bbfit.geometry.orbit import Orbit
from bbfit.images import to_bytes, unpremultiply, write_png
from bbfit.layout import split_views, write_transforms
from bbfit.operators.drawing.reference import render_reference

if TYPE_CHECKING:
    from playwright.sync_api import Browser

torch.set_num_threads(1)
gc.disable()  # until the tests are collected: most of what that makes stays, and to look for garbage in it takes a third of the time

TESTS = Path(__file__).resolve().parent
SHARED = TESTS.parent / "../shared"
# The markers of the tests in a folder or a module, by places below this folder; scripts/test --fast leaves all of them out.
MARKED = {
    "blender": (
        "blender",
        "library/test_building.py",
        "rivals/test_baking.py",
        "rivals/test_crossed_and_sliced.py",
        "rivals/test_octahedral.py",
        "sweep/test_scheduling.py",
        "test_comparison.py",
        "test_notebooks.py",
        "test_pipeline.py",
    ),
    "browser": (
        "forest/test_web_page.py",
        "frames/test_measurement.py",
        "reporting/test_html.py",
        "reporting/test_suns.py",
        "viewers",
        "viewing",
    ),
    "node": ("exporting/test_formats.py", "exporting/test_lod.py", "exporting/test_model.py", "library/test_shared_atlas.py"),
    "ray": ("sweep/test_cluster.py",),
    "slow": (
        "budget/test_choice.py",
        "exporting/test_atlas.py",
        "exporting/test_drawing.py",
        "exporting/test_hulls.py",
        "exporting/test_mips.py",
        "exporting/test_splitting.py",
        "fitting/test_loop.py",
        "fitting/test_max_texels.py",
        "fitting/test_moves.py",
        "fitting/test_search.py",
        "fitting/test_steps.py",
        "operators/test_fused.py",
        "operators/test_gradients.py",
        "operators/test_kernels.py",
        "reporting/test_plots.py",
        "rivals/test_learned_mesh.py",
        "rivals/test_radiance_field.py",
        "workers/test_local.py",
        "test_budget_runs.py",
        "test_cli.py",
        "test_docs.py",
        "test_options.py",
        "trees/test_mesh.py",
    ),
}
# The same for tests that use a fixture, directly or not.
MARKED_FIXTURES = {"stand_ins": "blender"}

# Modules that take long. They come first, so that no process is left with one of them when the others have nothing to do.
FIRST = (
    "test_readme.py",
    "test_comparison.py",
    "test_notebooks.py",
    "sweep/test_cluster.py",
    "sweep/test_scheduling.py",
    "fitting/test_search.py",
    "test_cli.py",
    "viewers/test_fits.py",
    "exporting/test_splitting.py",
    "operators/test_kernels.py",
    "operators/test_fused.py",
    "fitting/test_loop.py",
)

assert all((TESTS / place).exists() for place in (*FIRST, *sum(MARKED.values(), ()))), "a module has moved"


@cache
def markers_of(path: Path) -> list[str]:
    """Markers of all tests in a file."""
    place = path.relative_to(TESTS) if path.is_relative_to(TESTS) else path
    return [marker for marker, folders in MARKED.items() if any(place.is_relative_to(folder) for folder in folders)]


def pytest_collection_finish() -> None:
    """Look for garbage from now on."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by what they need, and put those that take long first."""
    places = {TESTS / place: index for index, place in enumerate(FIRST)}
    items.sort(key=lambda item: places.get(item.path, len(places)))
    for item in items:
        for marker in markers_of(item.path):
            item.add_marker(marker)
        for fixture, marker in MARKED_FIXTURES.items():
            if fixture in getattr(item, "fixturenames", ()):
                item.add_marker(marker)


@pytest.fixture
def shared() -> Path:
    """The folder with real trees and views; the test skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("the folder with real trees is not here")
    return SHARED


@pytest.fixture
def poison() -> Iterator[None]:
    """Memory that torch allocates without a value holds NaN, or the largest integer, so that reading it changes a result."""
    before = torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = True
    assert torch.empty(1).isnan().all() and torch.empty(1, dtype=torch.int32) == torch.iinfo(torch.int32).max
    yield
    torch.use_deterministic_algorithms(False)
    torch.utils.deterministic.fill_uninitialized_memory = before


@pytest.fixture(scope="session")
def chromium() -> Iterator[tuple[Browser, ThreadPoolExecutor]]:
    """A browser, which starts once, and the one thread that may speak to it."""
    from browser import open_browser

    with open_browser() as opened:
        yield opened


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
