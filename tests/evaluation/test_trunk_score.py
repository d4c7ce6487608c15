"""The score of the trunk below the crown."""

from __future__ import annotations

import pytest
import torch

from bbfit.evaluation.trunk import TrunkScore, TrunkView, measure_trunk, trunk_score


def tree(left: int = 37, right: int = 43) -> torch.Tensor:
    """A green crown 60 pixels wide on a brown trunk from column ``left`` to ``right``, premultiplied, float64 [100, 80, 4]."""
    picture = torch.zeros(100, 80, 4, dtype=torch.float64)
    picture[10:50, 10:70] = torch.tensor([0.2, 0.5, 0.1, 1.0], dtype=torch.float64)
    picture[50:80, left:right] = torch.tensor([0.4, 0.3, 0.2, 1.0], dtype=torch.float64)
    return picture


def test_only_what_is_below_the_crown_counts() -> None:
    worse = tree()
    worse[:52] = 0  # the crown and the twentieth below it
    assert measure_trunk("a", 0.0, tree(), worse) == TrunkView("a", 1.0, 0.0)
    beside = tree()
    beside[60:80, 0:3] = beside[60, 40]  # a haze to the side counts, also below the trunk's end
    one = measure_trunk("a", 0.0, tree(), beside)
    assert one is not None and one.iou == pytest.approx(28 * 6 / (28 * 6 + 20 * 3)) and one.delta_e == pytest.approx(0)


@pytest.mark.parametrize(("left", "right", "iou"), [(38, 42, 4 / 6), (37, 47, 6 / 10), (40, 46, 3 / 9)])
def test_a_thinned_a_doubled_and_a_shifted_trunk(left: int, right: int, iou: float) -> None:
    one = measure_trunk("a", 0.0, tree(), tree(left, right))
    assert one is not None and one.iou == pytest.approx(iou)


def test_another_color_and_a_missing_trunk() -> None:
    gray = tree()
    gray[..., :3] = 0.5 * gray[..., 3:]
    one, none = measure_trunk("a", 0.0, tree(), gray), measure_trunk("a", 0.0, tree(), torch.zeros_like(gray))
    assert one is not None and one.iou == 1 and one.delta_e is not None and one.delta_e > 10
    assert none == TrunkView("a", 0.0, None)


def test_trees_without_a_trunk_and_steep_views_have_no_score() -> None:
    assert measure_trunk("a", 31.0, tree(), tree()) is None and measure_trunk("a", -31.0, tree(), tree()) is None
    assert measure_trunk("a", 30.0, tree(), tree()) is not None
    assert measure_trunk("a", 0.0, tree(10, 70), tree()) is None
    assert trunk_score([None, None]) is None and trunk_score([]) is None


def test_the_worst_view_counts() -> None:
    score = trunk_score([TrunkView("a", 0.9, 2.0), None, TrunkView("b", 0.6, None), TrunkView("c", 0.9, 4.0)])
    assert score is not None and score.worst.name == "b" and score.iou == pytest.approx(0.8) and score.delta_e == 3
    content = score.to_json()
    assert list(content) == ["iou", "worst_iou", "delta_e", "worst_view", "views"]
    assert content["worst_iou"] == 0.6 and content["worst_view"] == "b"
    assert TrunkScore.from_json(content) == score
    with pytest.raises(ValueError, match="no views"):
        TrunkScore.from_json(content | {"views": []})
