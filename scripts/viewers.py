"""Compare what programs show of fitted models to what bbfit draws: python scripts/viewers.py VIEWS RUN [VIEWS RUN ...]

VIEWS is a views folder and RUN the folder of a fit to it. The held-out cameras see the model in each program, with the export for that
program. Models with maps (``--light maps``) are seen under the held-out suns, on a sunny day, by programs that light them as bbfit does.
The script prints the table of docs/engines.md: PSNR of the program's pictures from bbfit's own drawing of the same export, PSNR of that
drawing from the views, and by how much the program's differs from it, all in dB over white. It needs Blender, Chromium and
``npm ci --prefix tests/node``.

With ``--panorama`` it draws models with maps in a panorama of a sun-lit sky instead, in three.js and in Cycles, and prints the PSNR between
both.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Hashable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import date
from importlib import metadata
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from playwright.sync_api import Browser

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "viewers")]

from blender_viewer import render_blender  # noqa: E402
from browser import open_browser  # noqa: E402
from browser_viewer import open_program, version_of  # noqa: E402
from eevee import draw_as_eevee  # noqa: E402

import bbfit  # noqa: E402
from bbfit.evaluation.metrics import psnr  # noqa: E402
from bbfit.exporting.config import Profile  # noqa: E402
from bbfit.exporting.model import ShippedModel, shipped_model  # noqa: E402
from bbfit.geometry.camera import Camera  # noqa: E402
from bbfit.geometry.light import SUNNY, Light  # noqa: E402
from bbfit.images import over_color, shrunk  # noqa: E402
from bbfit.rendering.cards import draw_cards  # noqa: E402


@dataclass(frozen=True)
class Program:
    """A program and how it is set."""

    page: str | None
    """Its page of tests/viewers; None: Blender."""
    query: str = ""
    """Settings of the page."""
    lights: bool = False
    """Whether it lights models with maps as bbfit does."""
    smooth: bool = False
    """Whether a pixel has four samples, and masks have smooth edges."""
    mipmaps: bool | None = None
    """As :class:`bbfit.ExportConfig` has it."""
    split: bool | None = None
    """As :class:`bbfit.ExportConfig` has it."""
    as_it_comes: bool = False
    """Whether Blender keeps shadows of billboards on each other."""
    eevee: bool = False
    """Whether Blender renders with EEVEE instead of Cycles."""
    imitated: bool = False
    """Whether it is compared with a drawing that reads and lights textures of masks as EEVEE does, and not as Cycles."""

    @property
    def profile(self) -> Profile:
        """The profile of the export; that of three.js where the program has none."""
        name = self.page or "blender"
        return name if name in get_args(Profile) else "three"  # type: ignore[return-value]

    @property
    def version(self) -> str:
        """The version that is installed."""
        return version_of(self.page) if self.page else metadata.version("bpy")


# By the name in the table.
PROGRAMS = {
    "three.js": Program("three", lights=True),
    "three.js, not split": Program("three", lights=True, split=False),
    "three.js, smooth edges": Program("three", "smooth=centered", smooth=True),
    "Babylon.js": Program("babylon", "anisotropy=1", lights=True),
    "Babylon.js, anisotropic": Program("babylon", lights=True),
    "PlayCanvas": Program("playcanvas"),
    "model-viewer": Program("model-viewer", "anisotropy=1"),
    "model-viewer, anisotropic": Program("model-viewer"),
    "CesiumJS": Program("cesium"),
    "CesiumJS, mip levels": Program("cesium", mipmaps=True),
    "CesiumJS, order-independent": Program("cesium", "order=independent"),
    "Filament, smooth edges": Program("filament", smooth=True),
    "Cycles": Program(None, lights=True),
    "Cycles as it comes": Program(None, lights=True, as_it_comes=True),
    "EEVEE": Program(None, lights=True, eevee=True),
    "EEVEE, from its own drawing": Program(None, lights=True, mipmaps=True, eevee=True, imitated=True),
}
NOT_TRIED = ("Godot 4", "Unity", "Unreal")
# Cycles chooses at random whether a path passes a layer that is half transparent.
SAMPLES = {"mask": 16, "coverage": 16, "blend": 64, "hash": 64}

Pictures = NDArray[np.float64]
Chromium = tuple[Browser, ThreadPoolExecutor]


def shown(program: Program, glb: Path, camera: Camera, light: Light | None, alpha: str, browser: Chromium) -> Pictures:
    """A program's pictures of a model over white, [V, H, W, 3]."""
    if program.page:
        with open_program(*browser, program.page, program.query) as viewer:
            return viewer.render(glb, camera, light=light)
    return render_blender(glb, camera, samples=SAMPLES[alpha], light=light, as_it_comes=program.as_it_comes, eevee=program.eevee)


def held_out(views: Path, cloud: bbfit.BillboardCloud, every: int, reduction: int) -> tuple[Camera, Light | None, Pictures]:
    """Held-out cameras, the light of each for a cloud with maps, and the views over white, ``reduction`` times as small as they are."""
    dataset = bbfit.ViewDataset.load(views)
    if cloud.surface is None:
        chosen = list(range(0, len(dataset.test), every))
        return reduced(dataset.test.cameras[chosen], None, dataset.test.targets(chosen, torch.float64), reduction)
    lit, baked = dataset.lit_test, dataset.test.light
    if lit is None or baked is None:
        sys.exit("a model with maps needs views with suns")
    sunny, chosen = lit.under(*SUNNY), lit.other_suns(baked[[0]])[::every]
    assert sunny.light is not None
    return reduced(sunny.cameras[chosen], sunny.light[chosen], sunny.targets(chosen, torch.float64), reduction)


def reduced(cameras: Camera, light: Light | None, targets: torch.Tensor, reduction: int) -> tuple[Camera, Light | None, Pictures]:
    """The result of :func:`held_out` for premultiplied RGBA views, [V, H, W, 4]."""
    width, height = cameras.width // reduction, cameras.height // reduction
    return cameras.resized(width, height), light, over_color(torch.stack([shrunk(target, width, height) for target in targets])).numpy()


def measure(views: Path, run: Path, every: int, reduction: int, programs: list[str], browser: Chromium) -> None:
    """Print the rows of one fitted model."""
    cloud = bbfit.BillboardCloud.load(run / "cloud.safetensors")
    camera, light, target = held_out(views, cloud, every, reduction)

    def score(pictures: Pictures) -> float:
        return float(np.mean([psnr(*pair) for pair in zip(target, pictures, strict=True)]))

    models: dict[Hashable, ShippedModel] = {}
    drawings: dict[Hashable, Pictures] = {}
    for name in programs:
        program = PROGRAMS[name]
        if light is None if program.as_it_comes else not (program.lights or light is None):
            continue
        if program.split is not None and cloud.alpha.kind != "blend":
            continue  # other modes are never split
        if program.imitated and cloud.alpha.kind != "mask":
            continue  # that drawing is of hard edges
        config = bbfit.ExportConfig(profile=program.profile, mipmaps=program.mipmaps, split=program.split)
        # What the files depend on.
        same = (
            str(replace(config.resolve(), profile=None)),
            replace(config.program, transmits=config.program.transmits and light is not None),
        )
        if same not in models:
            models[same] = shipped_model(cloud, config)
        model = models[same]
        if (drawn := (same, program.smooth)) not in drawings:
            alpha = replace(model.cloud.alpha, antialiased=program.smooth and cloud.alpha.kind == "mask")
            cards = replace(model.cards, alpha=alpha)
            if program.imitated:
                drawing = draw_as_eevee(cards, camera, light)
            else:
                drawing = draw_cards(cards, camera, light, multisampled=program.smooth)
            drawings[drawn] = over_color(drawing.double().clamp(0, 1)).numpy()
        own = drawings[drawn]
        with tempfile.TemporaryDirectory() as folder:
            (glb,) = model.save(Path(folder) / "model.glb")
            pictures = shown(program, glb, camera, light, cloud.alpha.kind, browser)
        figures = f"{psnr(own, pictures):.1f} | {score(own):.2f} | {score(pictures) - score(own):+.2f}"
        print(f"| {run.name} | {name} | {program.version} | {len(camera)} | {model.cards.vertex_count} | {figures} |", flush=True)


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


def surrounded(views: Path, run: Path, browser: Chromium) -> None:
    """Print how far three.js and Cycles are apart in four held-out views of a model in the panorama."""
    cameras, cloud = bbfit.ViewDataset.load(views).test.cameras, bbfit.BillboardCloud.load(run / "cloud.safetensors")
    camera, sky = cameras[list(range(0, len(cameras), max(1, len(cameras) // 4)))[:4]], panorama()
    with tempfile.TemporaryDirectory() as folder:
        cv2.imwrite(str(picture := Path(folder) / "sky.hdr"), sky[..., ::-1])
        files: dict[str, Path] = {}
        for profile in ("three", "blender"):
            model = shipped_model(cloud, bbfit.ExportConfig(profile=profile, mipmaps=False))
            (files[profile],) = model.save(Path(folder) / f"{profile}.glb")
        with open_program(*browser, "three") as three:
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
    parser.add_argument("--reduction", type=int, default=1, help="see the tree from so many times as far, in smaller pictures")
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
    with open_browser() as browser:
        print(f"{date.today()}, Chromium {browser[0].version}\n")
        print("| model | program | version | pictures | vertices | from bbfit's drawing | bbfit's score | program's score |")
        print("| --- | --- | --- | --- | --- | --- | --- | --- |")
        for views, run in pairs:
            measure(views, run, options.every, options.reduction, options.programs, browser)
        for name in NOT_TRIED:
            print(f"| | {name} | not tried | | | | | |")


if __name__ == "__main__":
    main()
