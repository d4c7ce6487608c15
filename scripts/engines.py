"""Compare what programs show of fitted models with maps to what bbfit draws: python scripts/engines.py VIEWS RUN [VIEWS RUN ...]

VIEWS is a views folder with suns and RUN the folder of a fit to it with ``--light maps``. The held-out cameras see the model under the
held-out suns, on a sunny day, in three.js, Babylon.js and Blender's Cycles. The script prints a table: PSNR of the program's pictures from
bbfit's own drawing of the same export, PSNR of that drawing from the views, and by how much the program's differs from it, all in dB
over white. It needs Blender, Chromium and ``npm ci --prefix tests/node``.

With ``--panorama`` it draws the models in a panorama of a sun-lit sky instead, in three.js and in Cycles, and prints the PSNR between both.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from playwright.sync_api import Browser

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "viewers")]

from blender_viewer import render_blender  # noqa: E402
from browser import open_browser  # noqa: E402
from browser_viewer import open_babylon, open_three  # noqa: E402

import bbfit  # noqa: E402
from bbfit.evaluation.metrics import psnr  # noqa: E402
from bbfit.exporting.config import Profile  # noqa: E402
from bbfit.exporting.model import ShippedModel, shipped_model  # noqa: E402
from bbfit.geometry.camera import Camera  # noqa: E402
from bbfit.geometry.light import SUNNY, Light  # noqa: E402
from bbfit.images import over_color  # noqa: E402

# The page of each program with its own settings, by the name in the table.
PROGRAMS: dict[str, Profile] = {
    "three.js": "three",
    "Babylon.js": "babylon",
    "Babylon.js, anisotropic": "babylon",
    "Cycles": "blender",
    "Cycles as it comes": "blender",
}
# Cycles chooses at random whether a path passes a layer that is half transparent.
SAMPLES = {"mask": 16, "blend": 64, "hash": 64}

Pictures = NDArray[np.float64]


def shown(program: str, glb: Path, camera: Camera, light: Light, alpha: str, browser: tuple[Browser, ThreadPoolExecutor]) -> Pictures:
    """A program's pictures of a model over white, [V, H, W, 3]."""
    if program == "three.js":
        with open_three(*browser) as viewer:
            return viewer.render(glb, camera, light=light)
    if program.startswith("Babylon.js"):
        with open_babylon(*browser, "" if program.endswith("anisotropic") else "?anisotropy=1") as viewer:
            return viewer.render(glb, camera, light=light)
    return render_blender(glb, camera, samples=SAMPLES[alpha], light=light, as_it_comes=program.endswith("comes"))


def measure(views: Path, run: Path, every: int, programs: list[str], browser: tuple[Browser, ThreadPoolExecutor]) -> None:
    """Print the rows of one fitted model."""
    dataset, cloud = bbfit.ViewDataset.load(views), bbfit.BillboardCloud.load(run / "cloud.safetensors")
    lit, baked = dataset.lit_test, dataset.test.light
    if lit is None or baked is None or cloud.surface is None:
        sys.exit("the views need suns, and the fit needs maps")
    sunny, chosen = lit.under(*SUNNY), lit.other_suns(baked[[0]])[::every]
    assert sunny.light is not None
    camera, light = sunny.cameras[chosen], sunny.light[chosen]
    target = over_color(sunny.targets(chosen, torch.float64)).numpy()

    def score(pictures: Pictures) -> float:
        return float(np.mean([psnr(*pair) for pair in zip(target, pictures, strict=True)]))

    drawn: dict[Profile, tuple[ShippedModel, Pictures]] = {}
    for program in programs:
        if (profile := PROGRAMS[program]) not in drawn:
            made = shipped_model(cloud, bbfit.ExportConfig(profile=profile))
            drawn[profile] = made, over_color(made.draw(camera, light).double().clamp(0, 1)).numpy()
        model, own = drawn[profile]
        with tempfile.TemporaryDirectory() as folder:
            (glb,) = model.save(Path(folder) / "model.glb")
            pictures = shown(program, glb, camera, light, cloud.alpha.kind, browser)
        figures = f"{psnr(own, pictures):.1f} | {score(own):.2f} | {score(pictures) - score(own):+.2f}"
        print(f"| {run.name} | {program} | {len(chosen)} | {model.cards.vertex_count} | {figures} |", flush=True)


def panorama() -> NDArray[np.float32]:
    """A blue sky over brown ground with a wide, warm sun, equirectangular and in linear light, [64, 128, 3].

    A white surface that faces the sun has, from the sun, 1.8 times the radiance of white. The middle of the picture is towards +X, and +Z
    lies a quarter of its width to the right.
    """
    up = np.sin(np.pi * (0.5 - (np.arange(64) + 0.5) / 64))[:, None]
    around = 2 * np.pi * ((np.arange(128) + 0.5) / 128 - 0.5)
    across = np.sqrt(1 - up**2)
    towards = np.stack(np.broadcast_arrays(across * np.cos(around), up, across * np.sin(around)), -1)
    sun = np.array([0.5, 0.6, 0.6]) / np.linalg.norm([0.5, 0.6, 0.6])
    background = np.where(up[..., None] > 0, [0.3, 0.4, 0.6], [0.12, 0.1, 0.08])
    return (background + np.exp((towards @ sun - 1)[..., None] / 0.02) * [45.0, 40.0, 34.0]).astype(np.float32)


def surrounded(views: Path, run: Path, browser: tuple[Browser, ThreadPoolExecutor]) -> None:
    """Print how far three.js and Cycles are apart in four held-out views of a model in the panorama."""
    cameras, cloud = bbfit.ViewDataset.load(views).test.cameras, bbfit.BillboardCloud.load(run / "cloud.safetensors")
    camera, sky = cameras[list(range(0, len(cameras), max(1, len(cameras) // 4)))[:4]], panorama()
    with tempfile.TemporaryDirectory() as folder:
        cv2.imwrite(str(picture := Path(folder) / "sky.hdr"), sky[..., ::-1])
        files: dict[str, Path] = {}
        for profile in ("three", "blender"):
            model = shipped_model(cloud, bbfit.ExportConfig(profile=profile, mipmaps=False))
            (files[profile],) = model.save(Path(folder) / f"{profile}.glb")
        with open_three(*browser) as three:
            three.surround(sky)
            left = three.render(files["three"], camera)
        right = render_blender(files["blender"], camera, samples=64, panorama=picture)
        comes = render_blender(files["blender"], camera, samples=64, panorama=picture, as_it_comes=True)
    print(f"| {run.name} | {len(camera)} | {psnr(left, right):.1f} | {psnr(left, comes):.1f} |", flush=True)


def main() -> None:
    """Measure all models given on the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, help="views folder and run folder, in turn")
    parser.add_argument("--every", type=int, default=1, help="take every n-th picture")
    parser.add_argument("--programs", nargs="+", choices=PROGRAMS, default=list(PROGRAMS))
    parser.add_argument("--panorama", action="store_true", help="light by a panorama, and compare three.js with Cycles")
    options = parser.parse_args()
    pairs = list(zip(options.folders[::2], options.folders[1::2], strict=True))
    if options.panorama:
        print("| model | pictures | three.js and Cycles | three.js and Cycles as it comes |\n| --- | --- | --- | --- |")
        with open_browser() as browser:
            for views, run in pairs:
                surrounded(views, run, browser)
        return
    print("| model | program | pictures | vertices | from bbfit's drawing | bbfit's score | program's score |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    with open_browser() as browser:
        for views, run in pairs:
            measure(views, run, options.every, options.programs, browser)


if __name__ == "__main__":
    main()
