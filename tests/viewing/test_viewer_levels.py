"""The sizes at which levels of detail are shown. The page chooses by them, see ``test_page.py``."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from bbfit.evaluation.silhouettes import worst_silhouette
from bbfit.exporting.model import shipped_model
from bbfit.fitting.initialize import pixels_per_meter
from bbfit.geometry.cloud import BillboardCloud
from bbfit.viewing.levels import ViewerLevel, field_levels, largest_scale
from bbfit.views.dataset import ViewDataset


def test_a_cloud_takes_over_where_its_error_is_a_pixel(views_folder: Path, known_cloud: BillboardCloud) -> None:
    """As levels of detail in a file do; and from the size of the views on if it is smaller there."""
    views = ViewDataset.load(views_folder).train
    moved = BillboardCloud(**{**vars(known_cloud), "centers": known_cloud.centers + torch.tensor([0.4, 0.0, 0.0])})
    error = worst_silhouette(shipped_model(moved).draw, views)
    assert error > 2
    assert largest_scale(moved, views) == pytest.approx(float(pixels_per_meter(views.cameras)) / (1.15 * error))
    assert largest_scale(known_cloud, views) == float(pixels_per_meter(views.cameras))
    assert largest_scale(moved, views, is_stopped=lambda: True) == float(pixels_per_meter(views.cameras))


def test_far_trees_of_a_field_have_halved_textures(known_cloud: BillboardCloud) -> None:
    """Each with a texel for every pixel; the original is no level of a field."""
    large = doubled(known_cloud, 3)
    levels = field_levels([ViewerLevel(None, math.inf), ViewerLevel(large, None)])
    assert all(level.cloud is large for level in levels)
    assert [level.halvings for level in levels] == [0, 1, 2, 3]
    density = large.texel_density
    assert [level.scale for level in levels] == [math.inf, density / 2, density / 4, density / 8]


def test_a_field_goes_on_where_the_levels_of_a_file_end(known_cloud: BillboardCloud) -> None:
    fine, coarse = doubled(known_cloud, 3), doubled(known_cloud.take([0]), 3)
    levels = field_levels([ViewerLevel(None, math.inf), ViewerLevel(fine, 50.0, 1), ViewerLevel(coarse, 8.0, 2)])
    assert [(level.cloud is coarse, level.halvings) for level in levels] == [(False, 0), (True, 2), (True, 3)]
    assert levels[1].scale == 8.0
    assert levels[2].scale is not None
    assert levels[2].scale <= 8.0


def doubled(cloud: BillboardCloud, times: int) -> BillboardCloud:
    """The same rectangles with finer textures of nothing."""
    sizes = cloud.texture_sizes << times
    return BillboardCloud(**{**vars(cloud), "texture_sizes": sizes, "texels": torch.zeros(int(sizes.prod(-1).sum()), 4)})
