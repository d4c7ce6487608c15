"""The score under light, of an upright square that has one color and one normal, so that every figure is known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from bbfit.checks import InputError
from bbfit.evaluation.light import LightScore, score_light
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import ShippedModel, shipped_model
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import SUNNY, Light, direction
from bbfit.geometry.orbit import Orbit
from bbfit.views.dataset import ViewDataset
from bbfit.views.lit import LitViews
from bbfit.views.view_set import ViewSet

SIZE, GRAY = 60, 188
BAKED = Light.of(direction(40, 30)[None], 2.0, 1.0)
# The baked sun, turned by a quarter, and another one.
SUNS = torch.stack([direction(130, 30), direction(300, 60)])


def cameras() -> Camera:
    """One in front and one behind, slightly above, of a square of two meters."""
    points = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3).double().numpy()
    return Orbit(2, (0.0, 5.0)).frame(points, target=torch.zeros(3).double(), width=SIZE, height=SIZE)[[0, 1]].to(torch.float64)


def square(tilt_degrees: float = 0.0, gray: int = GRAY) -> ShippedModel:
    """The square faces +Z; its normal is tilted upwards."""
    texels = torch.tensor([[gray / 255] * 3 + [1.0]]).repeat(64, 1)
    surface = torch.tensor([[0.5, 0.5 + 0.5 * math.sin(math.radians(tilt_degrees)), 1.0, 0.0]]).repeat(64, 1)
    axes = [torch.tensor([axis]) for axis in ([0.0, 0, 0], [1.0, 0, 0], [0.0, 1, 0], [1.0, 1])]
    cloud = BillboardCloud(*axes, torch.tensor([[8, 8]]), torch.zeros(1, dtype=torch.bool), texels, surface=surface, light=BAKED)
    return shipped_model(cloud, ExportConfig(alpha="blend", outline="rectangle", mipmaps=False))


def pictures(draw: list[Tensor], name: str, light: Light | None) -> ViewSet:
    """Pictures in bytes of the two cameras, again and again."""
    paths = tuple(Path(f"{name}{index}") for index in range(len(draw)))
    straight = [torch.cat([image[..., :3] / image[..., 3:].clamp_min(1e-3), image[..., 3:]], -1) for image in draw]
    content = {path: (255 * image).round().to(torch.uint8) for path, image in zip(paths, straight, strict=True)}
    every = cameras()[[index % 2 for index in range(len(draw))]]
    return ViewSet(paths, every, content.__getitem__, light)


@pytest.fixture(scope="module")
def lit() -> LitViews:
    """What the square with a normal that is tilted by 20 degrees shows under the sky, the baked sun and two other suns."""
    model, eyes = square(20.0), cameras()
    above = torch.tensor([[0.0, 1.0, 0.0]]).repeat(2, 1)
    suns = torch.cat([BAKED.sun_directions, SUNS]).repeat_interleave(2, 0)
    light, sky_light = Light.of(suns, math.pi, 0.0), Light.of(above, 0.0, 1.0)
    skies = pictures([model.draw(eyes[camera], sky_light[[camera]]) for camera in range(2)], "sky", sky_light)
    under = pictures([model.draw(eyes[index % 2], light[[index]]) for index in range(6)], "sun", light)
    shown = [model.surfaces(eyes[camera]) for camera in range(2)]
    albedo = pictures([torch.cat([image[..., :3], image[..., 6:]], -1) for image in shown], "albedo", None)
    x, y, z, alpha = (torch.stack(shown)[..., channel : channel + 1] for channel in (3, 4, 5, 6))
    z_up = torch.cat([(alpha + part) / 2 for part in (x, -z, y)] + [alpha], -1)
    return LitViews(skies, under, (0, 1) * 3, albedo, pictures(list(z_up), "normal", None))


def test_a_damaged_picture_under_a_sun_is_found_before_a_fit(lit: LitViews, views_folder: Path) -> None:
    def damaged(path: Path) -> torch.Tensor:
        raise InputError(f"image: {path} is cut short")

    views = ViewDataset.load(views_folder)
    replace(views, lit_test=lit).check()
    with pytest.raises(InputError, match=r"sun.* is cut short"):
        replace(views, lit_test=replace(lit, suns=replace(lit.suns, read=damaged))).check()


def scored(model: ShippedModel, lit: LitViews, *, baked: bool = False) -> LightScore:
    """The score of a model, or of its picture in the baked light."""
    score = score_light(lambda camera, light: model.draw(camera, BAKED if baked else light), lit, BAKED, model.surfaces)
    assert score is not None and score.r2 is not None and score.low is not None
    return score


def test_model_that_is_right_has_no_errors(lit: LitViews) -> None:
    """Up to the bytes of the pictures."""
    score = scored(square(20.0), lit)
    assert len(score.views) == 4 and score.psnr > 45 and score.low > 45 and score.r2 > 0.999 and score.flip < 0.01
    assert score.drift is not None and score.drift < 0.005
    assert score.albedo is not None and score.albedo < 0.005 and score.normal_degrees is not None and score.normal_degrees < 0.7


def test_errors_are_those_of_the_maps(lit: LitViews) -> None:
    """A normal that is off by 25 degrees, and a base color that is off by 30 of 255."""
    assert scored(square(45.0), lit).normal_degrees == pytest.approx(25, abs=0.7)
    score = scored(square(20.0, GRAY - 30), lit)
    assert score.albedo == pytest.approx(30 / 255, abs=0.005)
    assert score.normal_degrees == pytest.approx(0, abs=0.7)


def test_baked_colors_reproduce_no_change(lit: LitViews) -> None:
    score = scored(square(20.0), lit, baked=True)
    assert score.r2 == pytest.approx(0, abs=1e-6)
    assert score.psnr < scored(square(20.0), lit).psnr - 10


def test_drift_is_that_of_the_sun_turned_by_a_quarter(lit: LitViews) -> None:
    """The square under that sun against its picture in the baked light, computed by hand."""
    score = scored(square(20.0), lit, baked=True)
    assert [view.turned for view in score.views] == [True, True, False, False]
    albedo = ((GRAY / 255 + 0.055) / 1.055) ** 2.4

    def color(side: float, sun: Tensor, strength: float, ambient: float) -> float:
        normal = torch.tensor([0.0, math.sin(math.radians(20)), side * math.cos(math.radians(20))]).double()
        linear = albedo * (max(float(normal @ sun), 0) * strength / math.pi + ambient)
        return min(1.055 * linear ** (1 / 2.4) - 0.055, 1.0)

    differences = [color(side, SUNS[0], *SUNNY) - color(side, BAKED.sun_directions[0], 2.0, 1.0) for side in (1.0, -1.0)]
    assert score.drift == pytest.approx(math.hypot(*differences) / math.sqrt(2), abs=0.004)


def test_figures_by_sun_and_by_camera_are_means_of_views(lit: LitViews) -> None:
    score = scored(square(30.0), lit)
    content = score.to_json()
    assert LightScore.from_json(content) == score
    assert [(round(sun["azimuth_degrees"]), round(sun["elevation_degrees"])) for sun in content["suns"]] == [(130, 30), (300, 60)]
    assert [round(camera["elevation_degrees"]) for camera in content["cameras"]] == [0, 5]
    for group in (content["suns"], content["cameras"]):
        assert sum(entry["psnr"] for entry in group) / 2 == pytest.approx(score.psnr)
    views = score.views
    assert content["suns"][0]["psnr"] == pytest.approx((views[0].psnr + views[1].psnr) / 2)
    assert content["cameras"][0]["flip"] == pytest.approx((views[0].flip + views[2].flip) / 2)


def test_without_passes_or_other_suns(lit: LitViews) -> None:
    score = scored(square(20.0), replace(lit, albedo=None, normal=None))
    assert score.albedo is None and score.normal_degrees is None and score.r2 > 0.999  # type: ignore[operator]
    own = replace(lit, suns=lit.suns.take([0, 1]), cameras=(0, 1))
    assert score_light(square().draw, own, BAKED) is None
