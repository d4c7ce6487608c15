"""Where levels of detail take over, once they must also draw faster: against trying all of them at many sizes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from billboard_scene import crossing_billboards, write_views

from bbfit.evaluation.switching import Candidate, DrawingCost, Switch, _fastest, cloud_candidate, mesh_cost, switches
from bbfit.exporting.config import ExportConfig, LodConfig
from bbfit.exporting.model import shipped_model
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera, look_at, orthographic_intrinsics
from bbfit.views.view_set import ViewSet


def test_fewer_triangles_are_faster_below_the_scale_at_which_both_cost_the_same() -> None:
    tree, planes = DrawingCost(100_000, 50.0), DrawingCost(2_000, 400.0)
    scale = planes.faster_below(tree, 8.0)
    assert planes.at(scale, 8.0) == pytest.approx(tree.at(scale, 8.0))
    assert planes.at(0.99 * scale, 8.0) < tree.at(0.99 * scale, 8.0) and planes.at(1.01 * scale, 8.0) > tree.at(1.01 * scale, 8.0)
    assert planes.faster_below(DrawingCost(100_000, 400.0), 8.0) == math.inf  # everywhere
    assert tree.faster_below(planes, 8.0) == planes.faster_below(planes, 8.0) == 0  # nowhere


@pytest.mark.parametrize("seed", range(20))
def test_the_level_that_is_shown_is_the_fastest_whose_error_is_hidden(seed: int) -> None:
    """At every scale; and a level that is left out is the fastest at none."""
    random = np.random.default_rng(seed)
    triangles = sorted(map(int, random.integers(10, 100_000, 6)), reverse=True)
    tree, *costs = (DrawingCost(count, float(random.uniform(10, 2000))) for count in triangles)
    bounds = sorted(map(float, np.exp(random.uniform(np.log(1), np.log(300), 5))), reverse=True)
    price = float(np.exp(random.uniform(np.log(0.1), np.log(100))))
    found = [Switch(scale=scale, cost=cost) for scale, cost in zip(bounds, costs, strict=True)]
    chosen = _fastest([[switch] for switch in found], price, tree)
    kept = [switch for switch in chosen if switch]
    assert [switch.scale for switch in kept] == sorted((switch.scale for switch in kept), reverse=True)
    for scale in np.exp(np.linspace(np.log(0.1), np.log(500), 400)):
        acceptable = [tree, *(switch.cost for switch in found if scale <= switch.scale)]
        shown = [tree, *(switch.cost for switch in kept if scale <= switch.scale)][-1]
        assert shown.at(scale, price) == min(cost.at(scale, price) for cost in acceptable)


def test_of_several_outlines_the_fastest_where_the_level_takes_over_is_taken() -> None:
    tree, many, few = DrawingCost(100_000, 50.0), DrawingCost(500, 100.0), DrawingCost(16, 300.0)
    for scale, outline in [(30.0, "pieces"), (1.0, "rectangle")]:
        outlines = [Switch(scale, outline="pieces", cost=many), Switch(scale, outline="rectangle", cost=few)]
        (chosen,) = _fastest([outlines], 1.0, tree)
        assert chosen and (chosen.outline, chosen.scale) == (outline, scale)


def test_a_level_waits_for_a_finer_one_only_without_speed(tmp_path: Path) -> None:
    """The finer candidate is gray; the coarser one is what the views show."""
    views = write_views(tmp_path, crossing_billboards())
    shown = ViewSet.joined([views.train, views.test])
    exact = Candidate(shown.draw, lambda: {None: DrawingCost(10, 100.0)})
    gray = Candidate(lambda camera: 0.2 * shown.draw(camera), lambda: {None: DrawingCost(100, 100.0)})
    first, second = switches([gray, exact], views, LodConfig())
    assert first and second and first.scale == second.scale < second.silhouette_scale
    tree = DrawingCost(100_000, 100.0)
    left_out, alone = switches([gray, exact], views, LodConfig(fragments_per_triangle=1.0), tree=tree)
    assert left_out is None and alone and alone.scale > first.scale


@pytest.mark.parametrize("export", [ExportConfig(alpha_cutoff=0.9), ExportConfig(alpha="blend", profile="three")], ids=["cutoff", "blend"])
def test_errors_are_those_of_the_model_that_is_shipped(tmp_path: Path, export: ExportConfig) -> None:
    cloud = replace(crossing_billboards(), alpha=AlphaMode("mask"))
    views = write_views(tmp_path, cloud)
    draw, camera = cloud_candidate(cloud, views.train, export).draw, views.train.cameras[0]
    own = (draw(camera) - shipped_model(cloud, export).draw(camera)).abs()
    default = (draw(camera) - shipped_model(cloud).draw(camera)).abs()
    assert float(own.mean()) < 1e-4 < 1e-3 < float(default.mean())


@pytest.mark.parametrize("size", [32, 64])
def test_the_cost_of_a_mesh_is_its_triangles_and_their_area_in_square_meters(size: int) -> None:
    """Two squares of one square meter, one behind the other, seen straight on by parallel rays."""
    corners = torch.tensor([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]], dtype=torch.float64)
    square = corners[torch.tensor([[0, 1, 2], [0, 2, 3]])]
    camera = Camera(
        look_at(torch.tensor([[0.0, 0.0, 5.0]], dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)),
        orthographic_intrinsics(4.0, size, size)[None],
        size,
        size,
        orthographic=True,
    )
    views = ViewSet.from_arrays(torch.zeros(1, size, size, 4), camera)
    cost = mesh_cost(torch.cat([square, square - torch.tensor([0.0, 0.0, 1.0])]).numpy(), views)
    assert cost.triangles == 4 and cost.fragments == pytest.approx(2.0)
