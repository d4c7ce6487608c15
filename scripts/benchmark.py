"""Measure speed, memory and quality: python scripts/benchmark.py [--quick] [--json FILE] [--views FOLDER ...] [--only NAME ...]

One run measures all rows. Alternatives are measured in turns, so that their ratios are valid on a shared machine. With a GPU, the rows
about steps occur once for each device. The rows by name:

grow      growing a tree and writing it as GLB in a separate process; seconds include the import of bbfit
copy      bytes per second of a plain copy in memory (read plus written)
steps     four rows: step is one training step (render, loss, gradient, update) at the default fit's last level, for evenly placed
          billboards with a texel per pixel, by the reference renderer and by the fused kernels; one view, and at 1024 x 1024 also the two
          views of the preset; bound_s is the time in which a plain copy moves the bytes that the step must move; mask is the same for an
          antialiased mask with a ramp, as in the middle of a default fit, and thesis for the thesis preset, whose billboards fill the
          viewport; parts is milliseconds that the operators of a fused step take, at 1024 x 1024 with four billboards
quality   for each folder of views: the 10,000 steps of the thesis preset by the fused kernels, an estimate of their time by the reference
          renderer (the mean of 50 steps, times 10,000), and the default preset with as many billboards and without a mesh; reached_s is
          the time, including the search for a placement, until that fit reaches the thesis preset's PSNR on the held-out views (checked
          every 25 steps)
placement for each folder of views: the thesis preset with four two-sided billboards, with L2 and with L1, and the default preset, which
          has as many vertices; only with ``--only placement``
search    for each folder of views: seconds of the default search for a placement, in the visual hull (the median of three, after one that
          is not counted); only with ``--only search``
levels    for each folder of views: milliseconds of a step at each resolution of a default fit, from coarse to fine, with hundreds of
          billboards (medians); only with ``--only levels``
start     starting up: ``bbfit --help`` and ``import bbfit`` (medians of five), and a fit of two steps and the first step of a fit, with an
          empty and with a filled cache of compiled kernels; only with ``--only start``
cards     drawing the model of a short default fit as programs show it, by torch and by the kernel: four cameras, medians of five; with
          alpha to coverage also by the kernel with one sample a pixel; filling the gaps of its texture; and splitting it for programs that
          sort nodes; only with ``--only cards``
render    the default views of a grown aspen, with all samples for training views, with the default number, and under a sun for each; only
          with ``--only render``
run       the stages of ``bbfit run`` without a tree and without options; only with ``--only run``
memory    the peak resident memory of a default fit of 360 views at 1024 x 1024, in a separate process

PSNR, SSIM and FLIP are means over four backgrounds.

``--quick`` takes less than a minute. It omits the willow, the thesis, steps of two views, most numbers of billboards, quality and memory.
``--views`` are the folders for quality, placement, search and levels, by default data/views. bound_s does not include the bytes that SSIM
and sharpness move.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch.nn.functional import interpolate

import bbfit
from bbfit.exporting.cards import cloud_cards
from bbfit.exporting.gaps import with_filled_gaps
from bbfit.exporting.mips import plain_chain
from bbfit.exporting.model import shipped_model
from bbfit.exporting.splitting import split
from bbfit.fitting import fused_pass
from bbfit.fitting.config import ResolvedFit
from bbfit.fitting.initialize import random_textures, start_cloud
from bbfit.fitting.levels import Targets, resize_textures, shrunk_sizes
from bbfit.fitting.loop import Step, resolution_levels
from bbfit.fitting.points import placement_points
from bbfit.fitting.search import find_placement
from bbfit.fitting.steps import BLEND, Stepper
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import write_png
from bbfit.operators.adam.fused import AdamFused, rest_after
from bbfit.operators.image_loss import fused as image_loss
from bbfit.rendering.cards import CardRenderer
from bbfit.views.view_set import ViewSet

DATA = Path(__file__).resolve().parents[1] / "data"
TREES = {"quaking_aspen": 0, "weeping_willow": 0}
"""Species to grow with all their leaves, and their seeds."""
WARM_STEPS = {"default": 160, "thesis": 1200}
"""Number of steps at an eighth of the size. Each finer level has half as many."""
RAMP = AlphaMode("mask", 0.2, 4.0, antialiased=True)
"""A mask in the middle of a fit."""
ROWS = ("grow", "steps", "quality", "placement", "search", "levels", "start", "cards", "render", "run", "memory")
"""What ``--only`` can choose."""
Row = dict[str, Any]


def own_process(script: str, *arguments: str, environment: Mapping[str, str] = os.environ) -> Row:
    """Run a Python script. Return the JSON object in its last line of output, with the seconds that it took."""
    started = time.perf_counter()
    reading, writing = os.pipe()
    process = os.posix_spawn(
        sys.executable, [sys.executable, "-c", script, *arguments], environment, file_actions=[(os.POSIX_SPAWN_DUP2, writing, 1)]
    )
    os.close(writing)
    with os.fdopen(reading) as pipe:
        output = pipe.read()
    _, status = os.waitpid(process, 0)
    seconds = time.perf_counter() - started
    if status:
        raise SystemExit(f"a measurement failed with status {status}")
    return json.loads(output.splitlines()[-1]) | {"seconds": round(seconds, 2)}


PEAK = """
def peak():  # peak memory of this program alone, because getrusage can report that of the parent
    return int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) * 1024
"""

GROW = (
    PEAK
    + """
import json, sys, bbfit
name, seed, path = sys.argv[1], int(sys.argv[2]), sys.argv[3]
scene = bbfit.grow(name, seed=seed)
bbfit.write_tree(scene, path)
vertices = sum(len(mesh.vertices) for mesh in scene.geometry.values())
print(json.dumps({"vertices": vertices, "peak_bytes": peak()}))
"""
)

FIT = (
    PEAK
    + """
import json, sys, bbfit
views = bbfit.ViewDataset.load(sys.argv[1])
result = bbfit.fit(views)
print(json.dumps({"views": len(views.train) + len(views.test), "fit_s": round(result.seconds, 2), "peak_bytes": peak()}))
"""
)


COMPILE = """
import json, sys, time, bbfit
from bbfit.fitting.initialize import start_cloud
from bbfit.fitting.levels import Targets
from bbfit.fitting.movement import Movement
from bbfit.fitting.steps import Stepper
views, config = bbfit.ViewDataset.load(sys.argv[1]).train, bbfit.FitConfig(billboards=4, placement="even").resolve()
start = start_cloud(views, config)
began = time.perf_counter()
Stepper(start, Targets.at(views, 0), config, Movement(start, 1.0)).step([0], 0.01, 0.01)
print(json.dumps({"compiled_s": round(time.perf_counter() - began, 2)}))
"""


def grow(quick: bool) -> list[Row]:
    """Measure the rows ``grow``."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for name in list(TREES)[: 1 if quick else None]:
            path = Path(folder) / f"{name}.glb"
            rows.append({"name": "grow", "species": name} | own_process(GROW, name, str(TREES[name]), str(path)))
            rows[-1]["file_bytes"] = path.stat().st_size
    return rows


def enlarged(views: ViewSet, size: int) -> ViewSet:
    """Resize views to square pictures of another size."""
    pictures = {}
    for index, path in enumerate(views.paths):
        picture = views.image(index).permute(2, 0, 1)[None].float()
        picture = interpolate(picture, (size, size), mode="bilinear")[0].permute(1, 2, 0)
        pictures[path] = picture.round().to(torch.uint8).contiguous()
    return replace(views, cameras=views.cameras.resized(size, size), read=pictures.__getitem__)


def seconds_of(work: Callable[[], object], device: torch.device) -> float:
    """Seconds that ``work`` takes. On a GPU, this is the time of the device."""
    if device.type == "cuda":
        events = [torch.cuda.Event(enable_timing=True) for _ in range(2)]
        events[0].record()
        work()
        events[1].record()
        torch.cuda.synchronize()
        return events[0].elapsed_time(events[1]) / 1000
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def copy_speed(device: torch.device) -> float:
    """Bytes per second, read plus written, of copying 64 MiB."""
    source = torch.rand(1 << 24, device=device)
    target = torch.empty_like(source)
    return 2 * 4 * source.numel() / statistics.median(seconds_of(lambda: target.copy_(source), device) for _ in range(15))


def warm(views: ViewSet, config: ResolvedFit, device: torch.device) -> Stepper:
    """Advance a fused fit into its last level, where empty texels are empty, as in most steps of a fit."""
    start = start_cloud(views, config)
    cloud = random_textures(start, shrunk_sizes(start, 3), 0)
    for halvings in (3, 2, 1, 0):
        cloud = resize_textures(cloud, shrunk_sizes(start, halvings))
        stepper = Stepper(cloud.to(device), Targets.at(views, halvings), config)
        # The thesis has a low learning rate and large billboards. Emptying them takes many steps, which are fast at an eighth of the size.
        for index in range(WARM_STEPS[config.preset] >> (3 - halvings)):
            stepper.step([(5 * index) % len(views)], config.learning_rate or 0.0)
        cloud = cloud.with_texels(stepper.texels.cpu())
    return stepper


def step_row(
    views: ViewSet, config: bbfit.FitConfig, name: str, *, device: torch.device, turns: int, copy: float, alpha: AlphaMode = BLEND
) -> Row:
    """Measure a row ``step``, ``mask`` or ``thesis``."""
    config, targets = config.resolve(), Targets.at(views, 0)
    fused = warm(views, config, device)
    start = start_cloud(views, config).to(device)
    reference = Stepper(start.with_texels(fused.texels.clone()), targets, replace(config, backend="reference"))
    reference.step([0], 0.01)
    times: dict[str, list[float]] = {"reference": [], "fused": []}
    batch = config.views_per_step or 1
    for turn in range(turns):
        sample = [(turn * batch + index) % len(views) for index in range(batch)]
        times["reference"].append(seconds_of(lambda sample=sample: reference.step(sample, 0.01, alpha=alpha), device))  # type: ignore[misc]
        time.sleep(0.1)  # torch's threads wait on all cores after the reference's step
        for index in range(4):
            sample = [((4 * turn + index) * batch + view) % len(views) for view in range(batch)]
            times["fused"].append(seconds_of(lambda sample=sample: fused.step(sample, 0.01, alpha=alpha), device))  # type: ignore[misc]
    slow, fast = (statistics.median(times[name]) for name in ("reference", "fused"))
    moved = bytes_of_a_step(fused, views, batch, rest_after(config.beta1 or 0.0))
    return {
        "name": name,
        "device": device.type,
        "size": views.cameras.width,
        "billboards": config.billboards,
        "views": batch,
        "texels": len(start.texels),
        "reference_s": round(slow, 5),
        "fused_s": round(fast, 5),
        "ratio": round(slow / fast, 1),
        "bytes": moved,
        "bound_s": round(moved / copy, 5),
        "of_bound": round(moved / copy / fast, 2),
    }


def parts_row(views: ViewSet, config: bbfit.FitConfig, device: torch.device, turns: int) -> Row:
    """Measure the row ``parts``."""
    operators = {"draw": fused_pass, "unpacked": fused_pass, "differentiate": fused_pass, "ssim_and_gradient": image_loss}
    stepper, times = warm(views, config.resolve(), device), dict[str, list[float]]()
    places = [*((module, name) for name, module in operators.items()), (image_loss, "add_sharpness_gradient"), (AdamFused, "update")]
    with ExitStack() as stack:
        for place, name in places:
            original, own = getattr(place, name), times.setdefault(name, [])

            def timed(*args: Any, _original: Any = original, _own: list[float] = own, **kwargs: Any) -> Any:
                result: list[Any] = []
                _own.append(seconds_of(lambda: result.append(_original(*args, **kwargs)), device))
                return result[0]

            stack.enter_context(mock.patch.object(place, name, timed))
        for index in range(4 * turns):
            stepper.step([index % len(views)], 0.01)
    return {"name": "parts", "device": device.type} | {name: round(1000 * statistics.median(own), 2) for name, own in times.items()}


def bytes_of_a_step(stepper: Stepper, views: ViewSet, batch: int, rest: int) -> int:
    """Bytes that a step must move: for each view, the targets and the touched texels with their gradients; then the awake blocks."""
    state, steps = stepper.state, stepper.steps
    assert isinstance(state, AdamFused)
    touched = int((state.last == steps).sum()) * 4
    awake = int((steps - state.last <= rest).sum()) * 4
    pixels = views.cameras.width * views.cameras.height
    # RGBA in float32 is 16 bytes. A touched texel is read, and its gradient is read, written and cleared. For an awake texel, three arrays
    # are read and written. Every gradient is read.
    return batch * (4 * pixels + 64 * touched) + 96 * awake + 16 * len(state.texels)


def steps(quick: bool) -> list[Row]:
    """Measure the rows ``copy``, ``step``, ``mask``, ``parts`` and ``thesis``."""
    rows: list[Row] = []
    views = bbfit.ViewDataset.load(DATA / "views").train
    for device in [torch.device("cpu"), *([torch.device("cuda")] if torch.cuda.is_available() else [])]:
        copy = copy_speed(device)
        rows.append({"name": "copy", "device": device.type, "bytes_a_second": round(copy)})
        for size in (256, 512, 1024):
            large = enlarged(views, size)
            turns = 2 if quick else 7
            default = bbfit.FitConfig(views_per_step=1, levels=1, placement="even", texel_density=1)
            for count in (4,) if quick else (2, 4, 8, 16, 32):
                rows.append(step_row(large, replace(default, billboards=count), "step", device=device, turns=turns, copy=copy))
                show(rows[-1])
            mask = replace(default, billboards=4)
            rows.append(step_row(large, mask, "mask", device=device, turns=turns, copy=copy, alpha=RAMP))
            show(rows[-1])
            if size == 1024:
                rows.append(parts_row(large, replace(default, billboards=4), device, turns))
                show(rows[-1])
            if size == 1024 and not quick:
                rows.append(
                    step_row(large, replace(default, billboards=4, views_per_step=None), "step", device=device, turns=turns, copy=copy)
                )
                show(rows[-1])
            if not quick:
                thesis = bbfit.FitConfig(preset="thesis")
                rows.append(step_row(large, thesis, "thesis", device=device, turns=turns, copy=copy))
                show(rows[-1])
    return rows


def quality(folders: list[Path]) -> list[Row]:
    """Measure the rows ``quality``."""
    rows = []
    for folder in folders:
        views = bbfit.ViewDataset.load(folder)
        views.train.check()
        views.test.check()
        thesis, default = bbfit.FitConfig(preset="thesis"), bbfit.FitConfig(billboards=4, alpha="blend")
        bbfit.fit(views, replace(default, steps=4))  # compiles the kernels
        slow = reference_step(views.train, thesis)
        row: Row = {
            "name": "quality",
            "views": folder.name,
            "size": views.train.cameras.width,
            "thesis_reference_s": round(slow * 10_000, 1),
        }
        for name, config in {"thesis": thesis, "default": default}.items():
            clouds: list[tuple[float, BillboardCloud]] = []
            started = time.perf_counter()
            cloud = bbfit.fit(views, config, on_step=partial(keep, clouds, started) if name == "default" else None).cloud
            seconds = time.perf_counter() - started
            scores = bbfit.evaluate(cloud, views.test).to_json()["over"]["mean"]
            row |= {f"{name}_s": round(seconds, 2), **{f"{name}_{key}": round(value, 4) for key, value in scores.items()}}
            # Scored after the fit, which must not depend on the held-out views.
            for at, early in clouds:
                if bbfit.evaluate(early, views.test).mean.over.mean.psnr >= row["thesis_psnr"]:
                    row |= {"reached_s": round(at, 2), "ratio": round(slow * 10_000 / at, 1)}
                    break
        rows.append(row)
        show(row)
    return rows


def placement(folders: list[Path]) -> list[Row]:
    """Measure the rows ``placement``."""
    rows = []
    thesis = bbfit.FitConfig(preset="thesis", sides="two")
    fits = {"thesis l2": thesis, "thesis l1": replace(thesis, loss="l1")}
    fits |= {f"default, {alpha}": bbfit.FitConfig(alpha=alpha) for alpha in ("blend", "mask")}
    for folder in folders:
        views = bbfit.ViewDataset.load(folder)
        for name, config in fits.items():
            result = bbfit.fit(views, config)
            report = bbfit.evaluate(result.cloud, views.test).to_json()
            color = {f"color_{key}": report["colour"][key] for key in ("delta_e", "chroma", "brightness")}
            scores = {**report["over"]["mean"], "sharpness": report["sharpness"], "brightness": report["brightness"], **color}
            row: Row = {"name": "placement", "views": folder.name, "fit": name, "vertices": result.cloud.vertex_count}
            row |= {"texels": len(result.cloud.texels), "fit_s": round(result.seconds, 1)}
            rows.append(row | {key: None if value is None else round(value, 4) for key, value in scores.items()})
            show(rows[-1])
    return rows


def keep(clouds: list[tuple[float, BillboardCloud]], started: float, step: Step) -> None:
    """Store the cloud of a fit after every 25 steps, with the seconds since the start. They include the time for the copies."""
    if step.index % 25 == 0:
        clouds.append((time.perf_counter() - started, step.snapshot()))


def reference_step(views: ViewSet, config: bbfit.FitConfig, steps: int = 50) -> float:
    """Mean seconds of a step by the reference renderer, over ``steps`` steps after two warm-up steps."""
    config = replace(config.resolve(), backend="reference")
    stepper = Stepper(start_cloud(views, config), Targets.at(views, 0), config)
    for index in range(2):
        stepper.step([index % len(views)], 0.01)
    started = time.perf_counter()
    for index in range(steps):
        stepper.step([index % len(views)], 0.01)
    return (time.perf_counter() - started) / steps


def searching(folders: list[Path]) -> list[Row]:
    """Measure the rows ``search``."""
    rows, config = [], bbfit.FitConfig().resolve()
    for folder in folders:
        views = bbfit.ViewDataset.load(folder)
        points, _ = placement_points(views, config, None)
        times = []
        for _ in range(4):
            started = time.perf_counter()
            found = find_placement(views.train, points, config)
            times.append(time.perf_counter() - started)
        rows.append({"name": "search", "views": folder.name, "billboards": len(found), "seconds": round(statistics.median(times[1:]), 2)})
        show(rows[-1])
    return rows


def levels(folders: list[Path]) -> list[Row]:
    """Measure the rows ``levels``."""
    rows: list[Row] = []
    for folder in folders:
        views = bbfit.ViewDataset.load(folder)
        for count in (384, 768):
            config, ends = bbfit.FitConfig(billboards=count, steps=160).resolve(), list[float]()
            bbfit.fit(views, config, on_step=lambda step, ends=ends: ends.append(time.perf_counter()))  # type: ignore[misc]
            parts = np.array_split(np.diff(ends), len(resolution_levels(config, views.train.cameras)))
            row: Row = {"name": "levels", "views": folder.name, "size": views.train.cameras.width, "billboards": count}
            rows.append(row | {"step_ms": [round(1000 * float(np.median(part)), 1) for part in parts]})
            show(rows[-1])
    return rows


def starting() -> list[Row]:
    """Measure the rows ``start``."""
    fit = ["-m", "bbfit.cli", "fit", str(DATA / "views"), "--steps", "2", "--placement", "even", "--billboards", "2"]
    commands = {"bbfit --help": ["-m", "bbfit.cli", "--help"], "import bbfit": ["-c", "import bbfit"]}
    rows = [
        {"name": "start", "what": what, "seconds": statistics.median(of_command(own) for _ in range(5))} for what, own in commands.items()
    ]
    with tempfile.TemporaryDirectory() as folder:
        for cached in ("nothing compiled", "compiled before"):
            environment = os.environ | {"WARP_CACHE_PATH": str(Path(folder) / "cache")}
            fit = [*fit, "--out", str(Path(folder) / cached)]
            rows.append({"name": "start", "what": f"a short fit, {cached}", "seconds": of_command(fit, environment)})
        for cached in ("nothing compiled", "compiled before"):
            environment = os.environ | {"WARP_CACHE_PATH": str(Path(folder) / "another cache")}
            seconds = own_process(COMPILE, str(DATA / "views"), environment=environment)["compiled_s"]
            rows.append({"name": "start", "what": f"the first step of a fit, {cached}", "seconds": seconds})
    return rows


def of_command(arguments: list[str], environment: Mapping[str, str] | None = None) -> float:
    """Seconds of a Python process."""
    started = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, capture_output=True, env=environment)
    return round(time.perf_counter() - started, 2)


def cards() -> list[Row]:
    """Measure the rows ``cards``."""
    views, rows = bbfit.ViewDataset.load(DATA / "views"), []
    model = shipped_model(bbfit.fit(views, bbfit.FitConfig(steps=100)).cloud)
    empty = shipped_model(model.cloud, bbfit.ExportConfig(mipmaps=False)).cards
    empty = replace(empty, chain=tuple(plain_chain(empty.atlas.image)))
    whole = cloud_cards(replace(model.cloud, alpha=BLEND), model.config.padding)
    for what, work in (("gaps", partial(with_filled_gaps, empty)), ("split", partial(split, whole))):
        seconds = seconds_of(work, torch.device("cpu"))
        rows.append({"name": "cards", "what": what, "cards": len(empty.cards), "seconds": round(seconds, 2)})
    for antialiased in (False, True):
        shown = replace(model.cards, alpha=replace(model.cards.alpha, antialiased=antialiased))
        renderers = {name: CardRenderer(shown, backend=name) for name in ("reference", "fused")}
        renderers["one sample"] = CardRenderer(shown, multisampled=False)
        for size in (384, 48):
            cameras, times = views.test.cameras.resized(size, size)[:4], dict[str, list[float]]()
            for name in [*renderers] * 6:
                times.setdefault(name, []).append(seconds_of(partial(renderers[name].draw, cameras), torch.device("cpu")))
            slow, fast, single = (statistics.median(own[1:]) for own in times.values())
            row = {"name": "cards", "alpha": "antialiased mask" if antialiased else "mask", "size": size, "cards": len(shown.cards)}
            rows.append(row | {"reference_s": round(slow, 4), "fused_s": round(fast, 4), "one_sample_s": round(single, 4)})
            rows[-1]["ratio"] = round(slow / fast, 1)
    return rows


def rendering() -> list[Row]:
    """Measure the rows ``render``."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        tree = bbfit.write_tree(bbfit.grow("quaking_aspen"), Path(folder) / "tree.glb")[0]
        all_samples = bbfit.ViewsConfig().samples
        for config in (bbfit.ViewsConfig(training_samples=all_samples), bbfit.ViewsConfig(), bbfit.ViewsConfig(suns=1)):
            started, row = time.perf_counter(), {"name": "render", "pictures": config.count + config.turned, "suns": config.suns}
            row["training_samples"] = config.samples_of_training
            bbfit.render_views(tree, Path(folder) / str(len(rows)), config)
            rows.append(row | {"seconds": round(time.perf_counter() - started, 2)})
    return rows


def whole() -> list[Row]:
    """Measure the row ``run``."""
    with tempfile.TemporaryDirectory() as folder:
        seconds = of_command(["-m", "bbfit.cli", "run", "--out", folder])
        stages = json.loads((Path(folder) / "run.json").read_text())["stages"]
    return [{"name": "run", "seconds": seconds} | {f"{name}_s": round(stage["seconds"], 1) for name, stage in stages.items()}]


def memory() -> list[Row]:
    """Measure the row ``memory``."""
    views = enlarged(bbfit.ViewDataset.load(DATA / "views").train, 1024)
    with tempfile.TemporaryDirectory() as folder:
        frames = []
        for index in range(360):
            turn = 2 * np.pi * index / 360
            pose = [
                [np.cos(turn), 0, np.sin(turn), 20 * np.sin(turn)],
                [np.sin(turn), 0, -np.cos(turn), -20 * np.cos(turn)],
                [0, 1, 0, 4],
                [0, 0, 0, 1],
            ]
            frames.append({"file_path": f"{index:03d}", "transform_matrix": pose})
            if index < len(views):
                write_png(Path(folder) / f"{index:03d}.png", views.image(index).numpy())
            else:
                os.link(Path(folder) / f"{index % len(views):03d}.png", Path(folder) / f"{index:03d}.png")
        for split, part in {"train": [f for i, f in enumerate(frames) if i % 4], "test": frames[::4]}.items():
            text = json.dumps({"camera_angle_x": 0.7, "frames": part})
            (Path(folder) / f"transforms_{split}.json").write_text(text, encoding="utf-8")
        return [{"name": "memory", "size": 1024} | own_process(FIT, folder)]


def show(row: Row) -> None:
    """Print a row on one line."""
    print("  ".join(str(value) if key == "name" else f"{key} {value}" for key, value in row.items()), flush=True)


def main() -> None:
    """Measure the rows, print them, and write them to the file of ``--json``."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="take less than a minute")
    parser.add_argument("--json", type=Path, help="write the rows to this file as a JSON list")
    parser.add_argument("--views", type=Path, nargs="*", help="folders of views for the rows quality, placement, search and levels")
    parser.add_argument("--only", nargs="*", choices=ROWS, help="measure only these rows")
    arguments = parser.parse_args()
    selected = arguments.only or (["grow", "steps"] if arguments.quick else ["grow", "steps", "quality", "memory"])
    rows: list[Row] = [
        {"name": "machine", "platform": platform.platform(), "processors": os.cpu_count(), "threads": torch.get_num_threads()}
    ]
    if "steps" in selected:
        rows += steps(arguments.quick)
    if "quality" in selected:
        rows += quality(arguments.views or [DATA / "views"])
    if "levels" in selected:
        rows += levels(arguments.views or [DATA / "views"])
    if "search" in selected:
        rows += searching(arguments.views or [DATA / "views"])
    if "placement" in selected:
        rows += placement(arguments.views or [DATA / "views"])
    others = {"grow": lambda: grow(arguments.quick), "start": starting, "cards": cards, "render": rendering, "run": whole}
    others["memory"] = memory
    for name, measured in others.items():
        if name in selected:
            for row in measured():
                rows.append(row)
                show(row)
    if arguments.json:
        arguments.json.write_text("[\n " + ",\n ".join(map(json.dumps, rows)) + "\n]\n", encoding="utf-8")


if __name__ == "__main__":
    main()
