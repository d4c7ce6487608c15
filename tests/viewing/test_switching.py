"""Which level of detail is shown."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from bbfit.evaluation.silhouettes import worst_silhouette
from bbfit.fitting.initialize import pixels_a_meter
from bbfit.geometry.cloud import BillboardCloud
from bbfit.viewing.levels import Level, choose_level, choose_levels, field_levels, takes_over
from bbfit.views import ViewDataset


def test_the_coarsest_level_that_may_be_is_shown(known_cloud: BillboardCloud) -> None:
    levels = [Level(None, math.inf), Level(known_cloud, 40.0), Level(known_cloud, 10.0), Level(known_cloud, None)]
    scales = [100.0, 40.0, 39.9, 10.0, 9.9]
    assert [choose_level(levels, scale) for scale in scales] == [0, 0, 1, 1, 2]
    np.testing.assert_array_equal(choose_levels(levels, np.array(scales)), [0, 0, 1, 1, 2])
    assert levels[1].distance(800.0) == 20.0
    assert levels[3].distance(800.0) is None


def test_a_cloud_takes_over_where_its_error_is_a_pixel(views_folder: Path, known_cloud: BillboardCloud) -> None:
    """As levels of detail in a file do; and from the size of the views on if it is smaller there."""
    views = ViewDataset.load(views_folder).train
    moved = BillboardCloud(**{**vars(known_cloud), "centers": known_cloud.centers + torch.tensor([0.4, 0.0, 0.0])})
    error = worst_silhouette(moved, views)
    assert error > 2
    assert takes_over(moved, views) == pytest.approx(float(pixels_a_meter(views.cameras)) / (1.15 * error))
    assert takes_over(known_cloud, views) == float(pixels_a_meter(views.cameras))
    assert takes_over(moved, views, stop=lambda: True) == float(pixels_a_meter(views.cameras))


def test_far_trees_of_a_field_have_halved_textures(known_cloud: BillboardCloud) -> None:
    """Each with a texel for every pixel; the original is no level of a field."""
    large = doubled(known_cloud, 3)
    found = field_levels([Level(None, math.inf), Level(large, None)])
    assert all(level.cloud is large for level in found)
    assert [level.halvings for level in found] == [0, 1, 2, 3]
    density = large.texel_density
    assert [level.scale for level in found] == [math.inf, density / 2, density / 4, density / 8]
    assert len({level.mark for level in found}) == 1


def test_a_field_goes_on_where_the_levels_of_a_file_end(known_cloud: BillboardCloud) -> None:
    fine, coarse = doubled(known_cloud, 3), doubled(known_cloud.take([0]), 3)
    found = field_levels([Level(None, math.inf), Level(fine, 50.0, 1), Level(coarse, 8.0, 2)])
    assert [(level.cloud is coarse, level.halvings) for level in found] == [(False, 0), (True, 2), (True, 3)]
    assert found[1].scale == 8.0
    assert found[2].scale is not None
    assert found[2].scale <= 8.0


def doubled(cloud: BillboardCloud, times: int) -> BillboardCloud:
    """The same rectangles with finer textures of nothing."""
    sizes = cloud.texture_sizes << times
    return BillboardCloud(**{**vars(cloud), "texture_sizes": sizes, "texels": torch.zeros(int(sizes.prod(-1).sum()), 4)})
