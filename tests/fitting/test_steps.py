"""Steps of texels and placement together, by both steppers: that they are the same, find what was planted, and go on from what was kept."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from bbfit.fitting.config import FitConfig
from bbfit.fitting.levels import Targets, resize_textures
from bbfit.fitting.movement import Movement
from bbfit.fitting.steps import Stepper
from bbfit.geometry.cloud import BillboardCloud
from bbfit.operators.adam.fused import AdamFused
from bbfit.operators.adam.reference import AdamReference, alpha_loss
from bbfit.operators.drawing import fused
from bbfit.operators.drawing.fused import schedule
from bbfit.operators.drawing.projection import project
from bbfit.operators.drawing.reference import render_reference
from bbfit.operators.image_loss.reference import image_loss_reference
from bbfit.views.dataset import ViewDataset
from bbfit.views.view_set import ViewSet

pytestmark = pytest.mark.usefixtures("poison")
STEPPERS = pytest.mark.parametrize("backend", ["reference", "fused"])
PLACEMENT = ("centers", "rights", "ups", "half_extents")
# The default preset's losses at the levels where billboards move.
DEFAULT = FitConfig(sharpness_weight=0, binarization_weight=0, colors="joint")
CONFIGS = {"thesis": FitConfig(preset="thesis"), "l1": FitConfig(preset="thesis", loss="l1"), "default": DEFAULT}
# Colors that are fitted on their own find planted billboards less exactly.
ALL = CONFIGS | {"views": replace(DEFAULT, colors="views")}
# The test clouds' billboards are two meters wide.
REACH = 1.0


@pytest.fixture(scope="module")
def views(views_folder: Path) -> ViewSet:
    """Views of ``known_cloud``."""
    return ViewDataset.load(views_folder).train


@pytest.fixture(scope="module")
def displaced(known_cloud: BillboardCloud) -> BillboardCloud:
    """``known_cloud`` with both billboards up to 10 cm and 6 degrees off, differently; a texel is 7 cm."""
    numbers = 0.2 * torch.rand(2, 8, generator=torch.Generator().manual_seed(3), dtype=torch.float64) - 0.1
    numbers[:, 6:] = 0
    return Movement(known_cloud, REACH).placed(numbers, known_cloud.texels).to(torch.float32)


def stepper_of(backend: str, cloud: BillboardCloud, targets: Targets, config: FitConfig, movement: Movement | None = None) -> Stepper:
    """A stepper with the operators of a backend."""
    return Stepper(cloud, targets, replace(config, backend=backend), movement)


def chosen(index: int, count: int) -> list[int]:
    """Four views from around the tree, others in every step."""
    return [(3 * index + 5 * i) % count for i in range(4)]


def advance(
    stepper: Stepper, views: ViewSet, steps: range, total: int, rate: float = 1e-3, placement_learning_rate: float = 0.02
) -> list[Tensor]:
    """Steps of a cosine schedule; the losses."""
    losses = []
    for index in steps:
        fall = 0.5 * (1 + math.cos(math.pi * index / total))
        losses.append(stepper.step(chosen(index, len(views)), rate * fall, placement_learning_rate * fall))
    return losses


def off(cloud: BillboardCloud, truth: BillboardCloud) -> float:
    """The furthest that a corner is from where it should be, in meters."""
    corners = [
        torch.cat(
            [
                one.centers + x * one.half_extents[:, :1] * one.rights + y * one.half_extents[:, 1:] * one.ups
                for x in (-1, 1)
                for y in (-1, 1)
            ]
        )
        for one in (cloud, truth)
    ]
    return float((corners[0] - corners[1]).norm(dim=-1).max())


@pytest.mark.parametrize("halvings", [0, 1])
@pytest.mark.parametrize("config", ALL.values(), ids=ALL.keys())
def test_both_steppers_move_billboards_alike(displaced: BillboardCloud, views: ViewSet, config: FitConfig, halvings: int) -> None:
    """The first step tells the gradients' signs, six of them also their sizes: Adam divides each by what came before.

    By then the numbers are about 0.1 and, from float32 placements and sums of another order, 3e-5 apart (measured); the allowed 1e-3 is a
    twentieth of one step. After some dozens of steps the paths may part: what a sample's gradient is jumps from texel to texel.
    """
    targets, moves = Targets.at(views, halvings), []
    for backend in ("reference", "fused"):
        movement = Movement(displaced, REACH)
        stepper = stepper_of(backend, displaced, targets, config.resolve(), movement)
        first = advance(stepper, views, range(1), 60)
        begun = movement.parameters.clone()
        losses = torch.stack([loss.double() for loss in first + advance(stepper, views, range(1, 6), 60)])
        moves.append((begun, movement.parameters.clone(), losses, stepper.texels.detach().clone()))
    (begun, moved, losses, texels), others = moves[0], moves[1]
    torch.testing.assert_close(others[0], begun, atol=1e-6, rtol=0)
    torch.testing.assert_close(begun[:, :6].abs(), torch.full((2, 6), 0.02, dtype=torch.float64), atol=1e-6, rtol=0)
    assert moved.abs().max() > 0.08
    torch.testing.assert_close(others[1], moved, atol=1e-3, rtol=0)
    torch.testing.assert_close(others[2], losses, atol=1e-4, rtol=1e-3)
    # A texel moves by its rate whatever its gradient, and some gradients are nothing but rounding.
    assert float((others[3] - texels).abs().mean()) < 1e-4


@STEPPERS
@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
def test_planted_billboards_are_found_again(
    known_cloud: BillboardCloud, displaced: BillboardCloud, views: ViewSet, backend: str, config: FitConfig
) -> None:
    """From 20 cm at the furthest corner to 1 cm (measured: 0.7 to 1.0); a texel is 7 cm. The textures are right, and may hardly change."""
    before = off(displaced, known_cloud)
    stepper = stepper_of(backend, displaced, Targets.at(views, 0), config.resolve(), Movement(displaced, REACH))
    losses = advance(stepper, views, range(60), 60)
    assert before > 0.15 and off(stepper.cloud, known_cloud) < 0.1 * before
    assert float(losses[-1]) < 0.2 * float(losses[0])
    assert float((stepper.texels.detach() - known_cloud.texels).abs().max()) < 60 * 1e-3


@STEPPERS
def test_billboards_that_stay_do_not_find_it(known_cloud: BillboardCloud, displaced: BillboardCloud, views: ViewSet, backend: str) -> None:
    """The same steps with a rate of 0: the placement is the start's to the bit, and so is what is kept of it; texels move nevertheless."""
    movement = Movement(displaced, REACH)
    stepper = stepper_of(backend, displaced, Targets.at(views, 0), FitConfig(preset="thesis").resolve(), movement)
    advance(stepper, views, range(10), 10, placement_learning_rate=0.0)
    assert not movement.parameters.any() and not stepper.tensors()["movement"].any()
    for name in PLACEMENT:
        assert torch.equal(getattr(stepper.cloud, name), getattr(displaced, name)), name
    assert off(stepper.cloud, known_cloud) == off(displaced, known_cloud) > 0.15
    assert not torch.equal(stepper.cloud.texels, displaced.texels)


@STEPPERS
@pytest.mark.parametrize("still", [False, True])
def test_without_a_rate_a_movement_makes_no_difference(displaced: BillboardCloud, views: ViewSet, backend: str, still: bool) -> None:
    """Neither does a rate without a movement: the texels are the same."""
    config, targets = FitConfig(preset="thesis").resolve(), Targets.at(views, 0)
    with_movement = stepper_of(backend, displaced, targets, config, Movement(displaced, REACH))
    without = stepper_of(backend, displaced, targets, config)
    advance(with_movement, views, range(5), 5, placement_learning_rate=0.0)
    advance(without, views, range(5), 5, placement_learning_rate=0.0 if still else 0.1)
    assert "movement" not in without.tensors()
    torch.testing.assert_close(with_movement.texels.detach(), without.texels.detach(), atol=1e-6, rtol=0)
    for name in PLACEMENT:
        assert torch.equal(getattr(without.cloud, name), getattr(displaced, name)), name


@pytest.mark.parametrize(
    ("backend", "placement_learning_rate"),
    [("reference", 0.02), ("reference", 0.0), ("fused", 0.02), ("fused", 0.0)],
)
@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS.keys())
def test_a_step_returns_the_loss_of_the_cloud_before_the_update(
    displaced: BillboardCloud, views: ViewSet, backend: str, placement_learning_rate: float, config: FitConfig
) -> None:
    """Before the step's update, of billboards that have moved, also in a step that does not move them."""
    config, targets = config.resolve(), Targets.at(views, 0)
    stepper = stepper_of(backend, displaced, targets, config, Movement(displaced, REACH))
    advance(stepper, views, range(6), 60)
    cloud, picked = stepper.cloud, chosen(6, len(views))
    weights = [getattr(config, name) or 0.0 for name in ("ssim_weight", "sharpness_weight") if hasattr(config, name)]
    assert config.loss is not None

    def loss(cloud: BillboardCloud) -> float:
        image = render_reference(cloud, targets.cameras[picked])
        return float(image_loss_reference(image, targets.pictures(picked), config.loss, *weights))

    reported = float(stepper.step(picked, 1e-3, placement_learning_rate))
    assert reported == pytest.approx(loss(cloud), rel=1e-3)
    assert abs(loss(displaced) - reported) > 0.05 * reported  # where it began is another loss
    if not placement_learning_rate:
        assert all(torch.equal(getattr(stepper.cloud, name), getattr(cloud, name)) for name in PLACEMENT)


@STEPPERS
@pytest.mark.parametrize("halvings", [0, 1])
def test_going_on_from_what_was_kept_is_going_on(displaced: BillboardCloud, views: ViewSet, backend: str, halvings: int) -> None:
    """To the bit, texels and placement alike."""
    config, targets = FitConfig(preset="thesis", loss="backgrounds", ssim_weight=0.02).resolve(), Targets.at(views, halvings)

    def fresh() -> Stepper:
        return stepper_of(backend, displaced, targets, config, Movement(displaced, REACH))

    whole, first, resumed = fresh(), fresh(), fresh()
    losses = advance(whole, views, range(12), 12, rate=0.05)
    advance(first, views, range(5), 12, rate=0.05)
    kept = {name: tensor.clone() for name, tensor in first.tensors().items()}
    advance(first, views, range(5, 8), 12, rate=0.05)
    advance(resumed, views, range(3), 12, rate=0.05)  # what it did before must not show
    resumed.restore(kept, 5)
    again = advance(resumed, views, range(5, 12), 12, rate=0.05)
    assert [float(loss) for loss in again] == [float(loss) for loss in losses[5:]]
    assert resumed.tensors().keys() == whole.tensors().keys() >= {"texels", "movement"}
    for name, tensor in whole.tensors().items():
        assert torch.equal(resumed.tensors()[name], tensor), name
    for name in (*PLACEMENT, "texels"):
        assert torch.equal(getattr(resumed.cloud, name), getattr(whole.cloud, name)), name
    assert off(whole.cloud, displaced) > 0.05


@STEPPERS
def test_a_steppers_cloud_is_a_copy(displaced: BillboardCloud, views: ViewSet, backend: str) -> None:
    start = displaced.texels.clone()
    stepper = stepper_of(backend, displaced, Targets.at(views, 0), FitConfig(preset="thesis").resolve(), Movement(displaced, REACH))
    advance(stepper, views, range(2), 60)
    cloud = stepper.cloud
    texels, centers = cloud.texels.clone(), cloud.centers.clone()
    advance(stepper, views, range(2, 4), 60)
    assert torch.equal(cloud.texels, texels) and torch.equal(cloud.centers, centers)
    assert not torch.equal(stepper.cloud.texels, texels) and not torch.equal(stepper.cloud.centers, centers)
    assert torch.equal(displaced.texels, start)
    assert all(getattr(cloud, name).dtype == torch.float32 and not getattr(cloud, name).requires_grad for name in (*PLACEMENT, "texels"))


@pytest.mark.parametrize(("backend", "adam"), [("auto", AdamFused), ("fused", AdamFused), ("reference", AdamReference)])
def test_the_backend_selects_the_operators(displaced: BillboardCloud, views: ViewSet, backend: str, adam: type) -> None:
    config, movement = FitConfig(preset="thesis", backend=backend).resolve(), Movement(displaced, REACH)
    stepper = Stepper(displaced, Targets.at(views, 0), config, movement)
    assert type(stepper.state) is adam
    stepper.step([0], 1e-3, 0.02)
    assert movement.parameters.any()


GROUPED = CONFIGS | {
    "all weights": FitConfig(ssim_weight=0.05, sharpness_weight=20, binarization_weight=0.1, sparsity_weight=0.05),
    "only sharpness": FitConfig(preset="thesis", sharpness_weight=20),
}


@pytest.fixture(scope="module")
def several(known_cloud: BillboardCloud) -> list[BillboardCloud]:
    """Three clouds of two billboards each, all displaced, repainted and of other sizes, the last one with a back as well.

    All but the second fill their last block of texels.
    """
    clouds = []
    for n, sizes in enumerate(([[36, 30], [36, 30]], [[21, 17], [23, 15]], [[30, 32], [24, 22]])):
        generator = torch.Generator().manual_seed(n)
        numbers = 0.2 * torch.rand(2, 8, generator=generator, dtype=torch.float64) - 0.1
        cloud = Movement(known_cloud, REACH).placed(numbers, known_cloud.texels).to(torch.float32)
        cloud = resize_textures(cloud, torch.tensor(sizes))
        if n == 2:
            first, second = (texture.reshape(-1, 4) for texture in cloud.textures())
            cloud = replace(cloud, two_sided=torch.tensor([True, False]), texels=torch.cat([first, first.flip(0), second]))
        noise = torch.rand(cloud.texels.shape, generator=generator)
        clouds.append(cloud.with_texels(torch.where(cloud.texels[:, 3:] > 0, 0.7 * cloud.texels + 0.2 * noise, 0)))
    return clouds


def of_group(cloud: BillboardCloud, number: int) -> BillboardCloud:
    """One of several clouds of two billboards that are joined."""
    return cloud.take([2 * number, 2 * number + 1])


@pytest.mark.parametrize("backend", ["reference", "fused"])
@pytest.mark.parametrize("moving", [True, False])
@pytest.mark.parametrize("halvings", [0, 1])
@pytest.mark.parametrize("config", GROUPED.values(), ids=GROUPED.keys())
def test_clouds_side_by_side_step_as_each_alone(
    several: list[BillboardCloud],
    views: ViewSet,
    config: FitConfig,
    halvings: int,
    moving: bool,
    backend: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To the bit, textures and placement alike; the losses are added up."""
    monkeypatch.setattr(fused, "MOST_TEXELS", 100)  # else the sums of gradients would have orders that depend on the sizes of all textures
    config, targets = replace(config, backend=backend).resolve(), Targets.at(views, halvings)
    if config.binarization_weight:  # what no view shows becomes crisp with what it shares a block with
        several = [several[0], several[2], several[1]]

    def fitted(cloud: BillboardCloud, groups: int) -> tuple[BillboardCloud, list[float]]:
        stepper = Stepper(cloud, targets, config, Movement(cloud, REACH) if moving else None, groups=groups)
        losses = advance(stepper, views, range(5), 60, rate=0.05)
        return stepper.cloud, [float(loss) for loss in losses]

    together, losses = fitted(BillboardCloud.joined(several), 3)
    alone = [fitted(cloud, 1) for cloud in several]
    for number, (cloud, _) in enumerate(alone):
        for name in (*PLACEMENT, "texels"):
            assert torch.equal(getattr(of_group(together, number), name), getattr(cloud, name)), (number, name)
        assert float((cloud.texels - several[number].texels).abs().max()) > 0.1
        assert (off(cloud, several[number]) > 0.05) == moving
    assert losses == pytest.approx([sum(those) for those in zip(*(each for _, each in alone), strict=True)], rel=1e-6)
    assert len({round(each[0], 5) for _, each in alone}) == 3


@pytest.mark.parametrize("backend", ["reference", "fused"])
@pytest.mark.parametrize(("weight", "measured"), [("binarization_weight", (1.0, 0.0)), ("sparsity_weight", (0.0, 1.0))])
def test_the_loss_of_alpha_is_the_same_side_by_side(
    several: list[BillboardCloud], views: ViewSet, backend: str, weight: str, measured: tuple[float, float]
) -> None:
    """It is a sum over texels and no mean over views: beside others a cloud becomes as crisp or sparse as alone, and more than without."""
    clouds = []
    for value in (1.0, 0.0):
        config = FitConfig(preset="thesis", backend=backend, **{weight: value}).resolve()  # type: ignore[arg-type]
        for joined, groups in (([several[2], several[0], several[1]], 3), ([several[2]], 1)):
            stepper = Stepper(BillboardCloud.joined(joined), Targets.at(views, 0), config, groups=groups)
            advance(stepper, views, range(10), 60, rate=0.02)
            clouds.append(of_group(stepper.cloud, 0))
    losses = [float(alpha_loss(cloud.texels, *measured)) for cloud in clouds]
    assert losses[0] == losses[1] < 0.9 * losses[2] and losses[2] == losses[3]


@pytest.mark.parametrize("backend", ["reference", "fused"])
def test_groups_go_on_from_what_was_kept(several: list[BillboardCloud], views: ViewSet, backend: str) -> None:
    config = FitConfig(preset="thesis", ssim_weight=0.02, backend=backend).resolve()
    joined, targets = BillboardCloud.joined(several), Targets.at(views, 1)
    whole, first, resumed = (Stepper(joined, targets, config, Movement(joined, REACH), groups=3) for _ in range(3))
    advance(whole, views, range(6), 60, rate=0.05)
    advance(first, views, range(3), 60, rate=0.05)
    resumed.restore({name: tensor.clone() for name, tensor in first.tensors().items()}, 3)
    advance(resumed, views, range(3, 6), 60, rate=0.05)
    for name in (*PLACEMENT, "texels"):
        assert torch.equal(getattr(resumed.cloud, name), getattr(whole.cloud, name)), name


@pytest.mark.parametrize("config", GROUPED.values(), ids=GROUPED.keys())
def test_groups_have_the_same_bytes_with_any_number_of_threads(several: list[BillboardCloud], views: ViewSet, config: FitConfig) -> None:
    joined, targets, before, results = BillboardCloud.joined(several), Targets.at(views, 0), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            stepper = Stepper(joined, targets, config.resolve(), Movement(joined, REACH), groups=3)
            losses = advance(stepper, views, range(4), 60, rate=0.05)
            results.append([*losses, *stepper.tensors().values()])
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(ours, first) for ours, first in zip(other, results[0], strict=True))


def test_groups_are_differentiated_at_once(several: list[BillboardCloud], views: ViewSet) -> None:
    """Every group's four views are a piece for a thread."""
    projection = project(BillboardCloud.joined(several), views.cameras[chosen(0, len(views))]).grouped(3)
    assert schedule(projection, torch.device("cpu")) == [[(0, 0, 4, 0, 40), (0, 4, 4, 0, 40), (0, 8, 4, 0, 40)]]
