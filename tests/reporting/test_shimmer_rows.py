"""The rows of shimmer in the report's page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from billboard_scene import crossing_billboards, write_views

from bbfit.evaluation.report import ShimmerScore
from bbfit.evaluation.scoring import evaluate_model
from bbfit.exporting.model import shipped_model
from bbfit.geometry.alpha import AlphaMode
from bbfit.reporting.html import RunFacts, report_page


def test_page_has_a_row_for_each_size_and_none_without_turned_views(tmp_path: Path) -> None:
    views = write_views(tmp_path, crossing_billboards()).test
    model = shipped_model(replace(crossing_billboards(), alpha=AlphaMode("mask")))
    facts = RunFacts("tree", {}, {}, {}, {}, [0.2, 0.1])
    report = evaluate_model(model, views)
    assert "shimmer" not in report_page(report, model, views, facts, model.glb)
    scores = (ShimmerScore(128, 96, 0.02, 1.2345, 0.987), ShimmerScore(64, 48, 0.0, None, None))
    page = report_page(replace(report, shimmer=scores), model, views, facts, model.glb)
    assert "<tr><td>128 x 96 pixels</td><td>→ 1</td><td>1.234</td><td>0.987</td></tr>" in page
    assert "<tr><td>64 x 48 pixels</td><td>→ 1</td><td>none</td></tr>" in page
