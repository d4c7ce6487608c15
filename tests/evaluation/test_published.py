"""The thesis's figures, by the sums that the thesis itself gives."""

from __future__ import annotations

import pytest

from bbfit.evaluation.published import RATIOS_PERCENT, Experiment, published_figures

# Figure 11, the column "Averages" of some of its lines.
MEANS = {
    ("base", "l2"): (2.89e-5, 0.999993633, 90.599, 16.714),
    ("base", "l1"): (3.10e-5, 0.999992201, 89.933, 14.355),
    ("bounded", "l2"): (2.96e-5, 0.999993107, 90.395, 17.608),
    ("bounded", "l1"): (3.17e-5, 0.999991618, 89.753, 14.009),
    ("double", "l2"): (2.89e-5, 0.999993727, 90.629, 16.827),
    ("double", "l1"): (3.19e-5, 0.999991893, 89.729, 14.109),
    ("double bounded", "l2"): (3.13e-5, 0.999990636, 89.680, 16.834),
    ("double bounded", "l1"): (3.14e-5, 0.999991976, 89.797, 13.088),
}
# And its last line but three, "Total Averages": PSNR by species and number of billboards.
PSNRS = {
    "quaking_aspen": {2: 92.269, 3: 92.833, 4: 93.032},
    "weeping_willow": {2: 87.800, 3: 88.180, 4: 88.160},
    "acer": {2: 89.416, 3: 89.214, 4: 89.676},
}


@pytest.mark.parametrize(("kind", "means"), MEANS.items())
def test_a_lines_mean_is_the_one_that_the_thesis_prints(kind: tuple[str, str], means: tuple[float, ...]) -> None:
    own = [figures for experiment, figures in published_figures().items() if (experiment.variant, experiment.loss) == kind]
    assert len(own) == 9
    # As far as the figures, and their mean, are rounded.
    for name, mean, rounding in zip(("rmse", "ssim", "psnr", "sre"), means, (1e-7, 5.1e-8, 1e-3, 1e-3), strict=True):
        assert sum(getattr(figures, name) for figures in own) / 9 == pytest.approx(mean, abs=rounding)


def test_a_columns_mean_is_the_one_that_the_thesis_prints() -> None:
    for species, counts in PSNRS.items():
        for count, mean in counts.items():
            own = [
                figures.psnr
                for experiment, figures in published_figures().items()
                if (experiment.species, experiment.billboards) == (species, count)
            ]
            assert len(own) == 8 and sum(own) / 8 == pytest.approx(mean, abs=1e-3)


def test_figures_are_found_by_their_experiment() -> None:
    figures = published_figures()[Experiment("acer", 3, "double bounded", "l2")]
    assert (figures.rmse, figures.ssim, figures.psnr, figures.sre) == (4.18e-5, 0.9999753, 85.531, 16.043)


def test_ratios_go_by_the_vertices() -> None:
    """Table 1's ratios are proportional to the model's vertices, up to their rounding."""
    for ratios in RATIOS_PERCENT.values():
        for vertices, ratio in ratios.items():
            assert ratio == pytest.approx(ratios[8] * vertices / 8, rel=0.01)
