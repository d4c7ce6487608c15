"""A finished fit that has too many bytes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from bbfit.budget.sizes import finest_within_bytes, fitted_within_bytes, model_bytes, within_bytes
from bbfit.checks import InputError
from bbfit.evaluation.scoring import views_psnr
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.model import shipped_model
from bbfit.fitting.config import FitConfig
from bbfit.fitting.loop import FitResult, fit
from bbfit.views.dataset import ViewDataset

EXPORT = ExportConfig(outline="rectangle")


@pytest.fixture(scope="module")
def views() -> ViewDataset:
    return ViewDataset.load(Path(__file__).resolve().parents[2] / "data" / "views")


@pytest.fixture(scope="module")
def result(views: ViewDataset) -> FitResult:
    return fit(views, FitConfig(billboards=4, placement="even", steps=160))


def test_a_fit_with_few_enough_bytes_is_left_alone(views: ViewDataset, result: FitResult) -> None:
    assert fitted_within_bytes(views, result, model_bytes(result.cloud, EXPORT), EXPORT) is result.cloud


@pytest.mark.parametrize("share", [0.98, 0.8, 0.5])
def test_too_many_bytes_are_fitted_away(views: ViewDataset, result: FitResult, share: float) -> None:
    """Which is better than to resize textures, with or without a palette, and uses nearly all of the limit; the planes stay.

    Masks are drawn as they are fitted, with smooth edges. With hard edges, resizing gains because it blurs.
    """
    limit = int(share * model_bytes(result.cloud, EXPORT))
    cloud = fitted_within_bytes(views, result, limit, EXPORT)
    assert 0.93 * limit < model_bytes(cloud, EXPORT) <= limit
    assert torch.equal(cloud.rights, result.cloud.rights) and torch.equal(cloud.ups, result.cloud.ups)
    psnr = views_psnr(shipped_model(cloud).antialiased().draw, views.train)
    for palette, less in ((0, 0.5), (result.config.palette, 0.1)):  # measured 0.74 and 0.22, and more
        resized = within_bytes(result.cloud, limit, EXPORT, palette=palette)
        assert model_bytes(resized, EXPORT) <= limit
        assert psnr > views_psnr(shipped_model(resized).antialiased().draw, views.train) + less


def test_a_limit_below_the_rectangles_is_refused(views: ViewDataset, result: FitResult) -> None:
    with pytest.raises(InputError, match=r"^bytes: 1,000 are too few: \d,\d+ are needed without textures"):
        fitted_within_bytes(views, result, 1000, EXPORT)


def test_a_limit_is_spent_on_the_finest_outline(result: FitResult) -> None:
    """With enough bytes it is the default's. A byte less than an outline takes leaves the next one, and below the last nothing changes."""
    outlines = ExportConfig().outlines()
    assert outlines[0].resolve() == ExportConfig().resolve() and outlines[-1] == ExportConfig(outline="hull", corners=5)
    sizes = [model_bytes(result.cloud, outline) for outline in outlines]
    assert len(set(sizes)) == len(sizes) == 5
    for limit in (*sizes, *(size - 1 for size in sizes), 10**9):
        finest = next((outline for outline, size in zip(outlines, sizes, strict=True) if size <= limit), outlines[-1])
        model = finest_within_bytes(result.cloud, outlines, limit)
        assert model.config == finest.resolve() and len(model.glb) == sizes[outlines.index(finest)]


def test_outlines_that_are_far_too_large_are_not_made(result: FitResult, monkeypatch: pytest.MonkeyPatch) -> None:
    made, limit = [], model_bytes(result.cloud, EXPORT) // 2
    monkeypatch.setattr("bbfit.budget.sizes.shipped_model", lambda *args, **more: made.append(args[1]) or shipped_model(*args, **more))
    finest_within_bytes(result.cloud, (ExportConfig(outline="pieces"), EXPORT), limit)
    assert made == [EXPORT]
