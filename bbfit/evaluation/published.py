"""The results that the thesis reports, for comparison.

Its trees have the same species but are other trees, rendered at 1024 x 1024 pixels in another light. So its figures compare in tendency,
not to the second digit.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from bbfit.evaluation.measures import ThesisScale

_FIGURE_11 = Path(__file__).with_name("thesis_figure_11.csv")
RATIOS_PERCENT = {
    "acer": {8: 0.0071, 12: 0.0106, 16: 0.0141, 24: 0.0212, 32: 0.0283},
    "weeping_willow": {8: 0.000076, 12: 0.000114, 16: 0.000152, 24: 0.000228, 32: 0.000304},
    "quaking_aspen": {8: 0.00114, 12: 0.00171, 16: 0.00228, 24: 0.00342, 32: 0.00457},
}
"""Vertices of the model over those of the tree in per cent, by species and the model's vertices (thesis, table 1)."""


@dataclass(frozen=True)
class Experiment:
    """One of the thesis's 72 experiments (section 6)."""

    species: str
    """quaking_aspen, weeping_willow or acer."""
    billboards: int
    """2, 3 or 4."""
    variant: str
    """base, bounded, double or double bounded."""
    loss: str
    """l1 or l2."""


@cache
def published_figures() -> dict[Experiment, ThesisScale]:
    """The means over test views of the thesis's experiments (figure 11)."""
    with _FIGURE_11.open(newline="", encoding="utf-8") as file:
        return {
            Experiment(row["species"], int(row["billboards"]), row["variant"], row["loss"]): ThesisScale(
                **{name: float(row[name]) for name in ("rmse", "ssim", "psnr", "sre")}
            )
            for row in csv.DictReader(file)
        }
