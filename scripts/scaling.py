"""Measure how time grows: python scripts/scaling.py [--only CURVE ...] [--json FILE] [--picture FILE]

The curves, each a list of rows:

pixels      milliseconds of a training step of four billboards by the width of the square view
billboards  the same by the number of billboards, one view of 512 x 512 pixels
views       the same by the number of views, four billboards
vertices    seconds of Blender by the vertices of an aspen and a willow: until the first picture of 384 x 384 pixels, and for each other one
suns        seconds of Blender for each further camera around an aspen, by the number of suns besides the baked light
processes   seconds of a sweep of eight short fits by the number of processes

``--json`` writes the rows to a file. ``--picture`` draws them, with those that are in the file of ``--json`` already.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch
from benchmark import DATA, Row, enlarged, seconds_of, show, warm

import bbfit

LEAVES = {"quaking_aspen": (0.02, 0.1, 0.3, 1.0), "weeping_willow": (0.1, 0.3)}
"""Species that grow for the curve of vertices, and shares of their leaves."""
FEW, MANY = 3, 8
"""Numbers of cameras. The difference of their seconds is that of as many cameras as the difference of the numbers."""


def steps(curve: str) -> Iterator[Row]:
    """Measure ``pixels``, ``billboards`` or ``views``."""
    views, device = bbfit.ViewDataset.load(DATA / "views").train, torch.device("cpu")
    cases = {
        "pixels": [(size, size, 4, 1) for size in (128, 256, 512, 1024, 2048)],
        "billboards": [(count, 512, count, 1) for count in (4, 8, 16, 32, 64)],
        "views": [(batch, 512, 4, batch) for batch in (1, 2, 4, 8, 16)],
    }
    for at, size, count, batch in cases[curve]:
        large = enlarged(views, size)
        stepper = warm(large, bbfit.FitConfig(billboards=count, levels=1, placement="even", texel_density=1).resolve(), device)
        samples = [[(turn + view) % len(large) for view in range(batch)] for turn in range(12)]
        seconds = statistics.median(seconds_of(partial(stepper.step, sample, 0.01), device) for sample in samples)
        yield {"name": curve, "at": at, "ms": round(1000 * seconds, 2)}


def rendered(tree: Path, folder: Path, count: int, suns: int) -> float:
    """Seconds of the pictures of ``count`` cameras with the default numbers of samples."""
    started = time.perf_counter()
    bbfit.render_views(tree, folder, bbfit.ViewsConfig(count=count, size=384, suns=suns, turned=0))
    return time.perf_counter() - started


def renders(curve: str) -> Iterator[Row]:
    """Measure ``vertices`` or ``suns``."""
    cases = [(species, leaves, 0) for species, shares in LEAVES.items() for leaves in shares]
    if curve == "suns":
        cases = [("quaking_aspen", 0.3, suns) for suns in (0, 1, 2, 4)]
    for species, leaves, suns in cases:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            scene = bbfit.grow(species, leaves=leaves)
            vertices = sum(len(mesh.vertices) for mesh in scene.geometry.values())
            tree = bbfit.write_tree(scene, folder / "tree.glb")[0]
            few, many = (rendered(tree, folder / str(count), count, suns) for count in (FEW, MANY))
        further = (many - few) / (MANY - FEW)
        row: Row = {"name": curve, "at": suns if curve == "suns" else vertices, "species": species}
        yield row | {"first_s": round(few - (FEW - 1) * further, 2), "further_s": round(further, 2)}


def sweeps(curve: str) -> Iterator[Row]:
    """Measure ``processes``."""
    stages = bbfit.RunConfig(fit=bbfit.FitConfig(steps=1000))
    for workers in (1, 2, 4):
        config = bbfit.SweepConfig(billboards=(2, 4, 8, 16), variants=("base",), workers=workers)
        with tempfile.TemporaryDirectory() as folder:
            started = time.perf_counter()
            bbfit.run_sweep(folder, config, stages, views=[DATA / "views"])
            yield {"name": curve, "at": workers, "seconds": round(time.perf_counter() - started, 1)}


CURVES = {"pixels": steps, "billboards": steps, "views": steps, "vertices": renders, "suns": renders, "processes": sweeps}
LINEAR = ("suns", "processes")
"""Curves on linear axes."""
TITLES = {
    "pixels": ("width of a view, pixels", "a step, ms"),
    "billboards": ("billboards", "a step, ms"),
    "views": ("views in a step", "a step, ms"),
    "vertices": ("vertices of the tree", "Blender, s"),
    "suns": ("suns", "Blender, s"),
    "processes": ("processes of a sweep", "eight fits, s"),
}


def draw(rows: list[Row], path: Path) -> None:
    """Draw the curves that have rows. Dotted lines are proportional to pixels, billboards, views and vertices."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    names = [name for name in CURVES if any(row["name"] == name for row in rows)]
    figure, axes = plt.subplots(-(-len(names) // 3), 3, figsize=(11, 3.1 * -(-len(names) // 3)), squeeze=False)
    labels = {"ms": None, "seconds": None, "first_s": "first picture", "further_s": "each further one"}
    for axis, name in zip(axes.flat, names, strict=False):
        curve = sorted((row for row in rows if row["name"] == name), key=lambda row: row["at"])
        for key, label in labels.items():
            if key in curve[0] and not (name == "suns" and key == "first_s"):
                at, values = zip(*((row["at"], row[key]) for row in curve), strict=True)
                (line,) = axis.plot(at, values, marker="o", markersize=4, label=label)
                if name not in LINEAR:
                    power = 2 if name == "pixels" else 1
                    axis.plot(at, [values[-1] * (x / at[-1]) ** power for x in at], ":", color=line.get_color(), linewidth=1)
        axis.set_xlabel(TITLES[name][0])
        axis.set_ylabel(TITLES[name][1])
        if name in LINEAR:
            axis.set_xticks(at)
            axis.set_ylim(bottom=0)
        else:
            axis.set_xscale("log")
            axis.set_yscale("log")
            axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.yaxis.set_minor_locator(NullLocator())
            ticks = [200_000, 1_000_000, 5_000_000] if name == "vertices" else at
            axis.set_xticks(ticks, [f"{x:,}" for x in ticks])
            axis.xaxis.set_minor_locator(NullLocator())
            low, high = (end(row[key] for row in curve for key in labels if key in row) for end in (min, max))
            axis.set_ylim(low / 1.3, high * 1.3)
        axis.grid(visible=True, color="#e4e7ea")
        if name == "vertices":
            axis.legend(frameon=False)
    for axis in list(axes.flat)[len(names) :]:
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def main() -> None:
    """Measure the curves, print and write their rows, and draw them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=CURVES, default=list(CURVES), help="measure only these curves")
    parser.add_argument("--json", type=Path, help="add the rows to those of other curves in this file, a JSON list")
    parser.add_argument("--picture", type=Path, help="draw the curves into this PNG or SVG")
    arguments = parser.parse_args()
    rows: list[Row] = json.loads(arguments.json.read_text(encoding="utf-8")) if arguments.json and arguments.json.exists() else []
    for curve in arguments.only:
        rows = [row for row in rows if row["name"] != curve]
        for row in CURVES[curve](curve):
            rows.append(row)
            show(row)
        if arguments.json:
            arguments.json.write_text("[\n " + ",\n ".join(map(json.dumps, rows)) + "\n]\n", encoding="utf-8")
    if arguments.picture:
        draw(rows, arguments.picture)


if __name__ == "__main__":
    main()
