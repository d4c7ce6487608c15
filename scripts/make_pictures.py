"""Write the pictures in docs/: python scripts/make_pictures.py [species] [acer] [modes] [light] [pages] [steps]

All but ``steps`` need Blender. ``pages`` also needs Chromium and playwright.

species    species.png: one view of every species that bbfit grows
acer       acer.png: held-out views of an acer over sky and grass, and the results of the thesis preset and of the default
modes      modes.png: held-out views of an oak and a fir, and the results of the thesis preset and of three alpha modes
light      light.png: a held-out camera's views of an aspen under three suns, and baked colors, baked maps and fitted maps
pages      report.png and view.png: the report of a run, and its page in ``bbfit view``
steps      steps.png: the parts of a training step, from the table in performance.md
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes

import bbfit
from bbfit.evaluation.backgrounds import BACKGROUNDS
from bbfit.evaluation.measures import Over
from bbfit.exporting.model import ShippedModel, shipped_model
from bbfit.images import over_color
from bbfit.reporting.suns import under_suns
from bbfit.trees.species import known_species

DOCS = Path(__file__).resolve().parents[1] / "docs"
PERFORMANCE = DOCS / "performance.md"
SEED = 1
SIZE = 480
# A thumbnail does not need millions of leaves.
LEAVES = {"weeping_willow": 0.3, "douglas_fir": 0.5, "silver_birch": 0.7}


def picture(name: str, folder: Path) -> np.ndarray:
    """Render a tree of the species over white, [H, W, 3]."""
    tree = folder / f"{name}.glb"
    bbfit.write_tree(bbfit.grow(name, seed=SEED, leaves=LEAVES.get(name, 1.0)), tree)
    bbfit.render_views(tree, folder / name, bbfit.ViewsConfig(count=2, size=SIZE, samples=64))
    views = bbfit.ViewDataset.load(folder / name)
    return over_color(views.train.targets([0])[0], 1.0).numpy()


def fitted(views: bbfit.ViewDataset, tree: Path, config: bbfit.FitConfig) -> ShippedModel:
    """A fitted model as ``bbfit fit`` exports it; a mask is drawn with smooth edges."""
    model = shipped_model(bbfit.fit(views, config, tree=tree).cloud, bbfit.RunConfig(fit=config).exports[-1])
    return model.antialiased() if model.cloud.alpha.kind == "mask" else model


def score(model: ShippedModel, views: bbfit.ViewDataset) -> Over:
    """Its score on the held-out views."""
    report = bbfit.evaluate(model.cloud, views.test, export=model.config)
    return (report.antialiased or report.mean).over


def show(axis: Axes, image: torch.Tensor, background: str, margin: int) -> None:
    """Show a picture over a background, without a margin of some pixels."""
    axis.imshow(over_color(image.clamp(0, 1), torch.tensor(BACKGROUNDS[background])).numpy()[margin:-margin, margin:-margin])
    axis.axis("off")


def acer() -> None:
    """Draw acer.png: held-out views over sky and grass, the thesis preset's billboards, and those of the default."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "acer.glb"
        bbfit.write_tree(bbfit.grow("acer", seed=2), tree)
        bbfit.render_views(tree, Path(folder) / "views", bbfit.ViewsConfig(size=512, elevations=(0.0,)))
        views = bbfit.ViewDataset.load(Path(folder) / "views")
        options = {"thesis preset": bbfit.FitConfig(preset="thesis", sides="two"), "default": bbfit.FitConfig()}
        models = {title: fitted(views, tree, config) for title, config in options.items()}
        figure, axes = plt.subplots(2, 3, figsize=(12, 8.4))
        for column, title in zip(axes.T, ("held-out view", *models), strict=True):
            model = models.get(title)
            if model is not None:
                mean = score(model, views).mean
                title += f": {len(model.glb) / 1000:.0f} kB, {mean.psnr:.2f} dB, FLIP {mean.flip:.3f}"
            column[0].set_title(title, fontsize=10)
            for axis, index, background in zip(column, (0, len(views.test) // 3), ("sky", "grass"), strict=True):
                image = views.test.targets([index])[0] if model is None else model.draw(views.test.cameras[index])
                show(axis, image, background, 40)
        figure.tight_layout()
        figure.savefig(DOCS / "acer.png", dpi=100)


def modes() -> None:
    """Draw modes.png: an oak over grass and a fir over sky, the thesis preset and three alpha modes."""
    options = {
        "thesis preset": bbfit.FitConfig(preset="thesis"),
        "mask": bbfit.FitConfig(),
        "coverage": bbfit.FitConfig(alpha="coverage"),
        "blend": bbfit.FitConfig(alpha="blend"),
    }
    figure, axes = plt.subplots(2, 1 + len(options), figsize=(13, 6.2))
    for row, (name, seed, background) in zip(axes, (("black_oak", 3, "grass"), ("douglas_fir", 6, "sky")), strict=True):
        with tempfile.TemporaryDirectory() as folder:
            tree = Path(folder) / f"{name}.glb"
            bbfit.write_tree(bbfit.grow(name, seed=seed), tree)
            bbfit.render_views(tree, Path(folder) / "views", bbfit.ViewsConfig(size=256, elevations=(0.0,)))
            views = bbfit.ViewDataset.load(Path(folder) / "views")
            row[0].set_title("held-out view", fontsize=10)
            show(row[0], views.test.targets([0])[0], background, 10)
            for axis, (title, config) in zip(row[1:], options.items(), strict=True):
                model = fitted(views, tree, config)
                mean = score(model, views).mean
                axis.set_title(f"{title}: {mean.psnr:.1f} dB, FLIP {mean.flip:.3f}", fontsize=10)
                show(axis, model.draw(views.test.cameras[0]), background, 10)
    figure.tight_layout()
    figure.savefig(DOCS / "modes.png", dpi=90)


def light() -> None:
    """Draw light.png: an aspen under three held-out suns, with baked colors, baked maps and fitted maps."""
    baked = bbfit.FitConfig(alpha="blend")
    maps = replace(baked, light="maps")
    options = {"baked": baked, "baked maps": replace(maps, map_steps=0), "fitted maps": maps}
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "aspen.glb"
        bbfit.write_tree(bbfit.grow("quaking_aspen"), tree)
        views = bbfit.ViewDataset.load(bbfit.render_views(tree, Path(folder) / "views", bbfit.ViewsConfig(size=512, suns=1)))
        draw_light(views, {title: bbfit.fit(views, config, tree=tree).cloud for title, config in options.items()})


def draw_light(views: bbfit.ViewDataset, clouds: dict[str, bbfit.BillboardCloud]) -> None:
    """Draw light.png from fitted clouds: a row for each sun."""
    lit = views.lit_test
    assert lit is not None
    figure, axes = plt.subplots(3, 1 + len(clouds), figsize=(9, 11.8))
    for column, (title, cloud) in zip(axes.T[1:], clouds.items(), strict=True):
        score = bbfit.evaluate(cloud, views.test, lit=lit).light
        assert score is not None
        column[0].set_title(f"{title}\n{score.psnr:.2f} dB, R² {score.r2:.2f}", fontsize=10)
        for row, shown in enumerate(under_suns(shipped_model(cloud), lit, score.views)):
            for axis, image in ((axes[row, 0], shown.target), (column[row], shown.image)):
                margin = image.shape[1] // 5
                axis.imshow(over_color(image).numpy()[:, margin:-margin])
                axis.axis("off")
    axes[0, 0].set_title("held-out view", fontsize=10)
    figure.tight_layout()
    figure.savefig(DOCS / "light.png", dpi=80)


def species() -> None:
    """Draw species.png with all species in two rows."""
    names = known_species()
    figure, axes = plt.subplots(2, len(names) // 2, figsize=(12, 6.9))
    with tempfile.TemporaryDirectory() as folder:
        for axis, name in zip(axes.flat, names, strict=True):
            figures = bbfit.load_species(name)
            axis.imshow(picture(name, Path(folder)))
            axis.set_title(f"{name}, {figures.scale:g} ± {figures.scale_v:g} m", fontsize=11)
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(DOCS / "species.png", dpi=100)


def pages() -> None:
    """Draw report.png and view.png: screenshots of the report and the page of an acer."""
    with tempfile.TemporaryDirectory() as folder:
        views = bbfit.ViewsConfig(count=60, size=512)
        config = bbfit.RunConfig(species="acer", grow=bbfit.GrowConfig(seed=2, detail=0.5), views=views)
        draw_pages(bbfit.run(None, Path(folder) / "acer", config).folder)


def draw_pages(run: Path) -> None:
    """Draw report.png and view.png of a run."""
    from playwright.sync_api import sync_playwright

    flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
    with sync_playwright() as driver, bbfit.view(run, port=0) as viewer:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        tab = browser.new_page(viewport={"width": 1180, "height": 1315})
        tab.goto((run / "report.html").resolve().as_uri())
        tab.screenshot(path=DOCS / "report.png")
        tab.close()
        tab = browser.new_page(viewport={"width": 1180, "height": 640})
        tab.goto(viewer.url)
        while not tab.evaluate("Boolean(window.bbfit?.viewer?.idle) && !bbfit.viewer.state.tree.measuring"):
            tab.wait_for_timeout(100)
        tab.screenshot(path=DOCS / "view.png")
        browser.close()


def steps() -> None:
    """Draw steps.png: the middle of each range in the table of the parts of a step, side by side."""
    rows = [line.strip("| ").split(" | ") for line in PERFORMANCE.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    first = next(index for index, row in enumerate(rows) if "differentiate" in row)
    names, bars = rows[first], rows[first + 2 : first + 4]
    figure, axis = plt.subplots(figsize=(9, 2.3))
    for row, (_, *cells) in enumerate(bars):
        left = 0.0
        for color, name, cell in zip(("#1f5f8b", "#a9c6da", "#c8501e", "#e3a17f", "#3f9e4d", "#8f6bc1"), names, cells, strict=True):
            width = float(np.mean([float(number) for number in cell.split(" to ")]))
            axis.barh(row, width, left=left, color=color, height=0.6, label=None if row else name)
            axis.text(left + width / 2, row, f"{width:.0f}", ha="center", va="center", fontsize=8, color="white")
            left += width
    axis.set_yticks(range(len(bars)), [label for label, *_ in bars])
    axis.invert_yaxis()
    axis.set_xlabel("milliseconds")
    axis.legend(loc="lower center", bbox_to_anchor=(0.5, 1), ncols=len(names), frameon=False, fontsize=8, handlelength=1)
    axis.spines[["top", "right"]].set_visible(b=False)
    figure.tight_layout()
    figure.savefig(DOCS / "steps.png", dpi=110)


if __name__ == "__main__":
    pictures = {"species": species, "acer": acer, "modes": modes, "light": light, "pages": pages, "steps": steps}
    for name in sys.argv[1:] or pictures:
        pictures[name]()
