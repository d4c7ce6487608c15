"""The command ``bbfit forest``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bbfit.checks import fail
from bbfit.cli.console import out_console, progress
from bbfit.forest.config import ForestConfig, RegisterConfig, ScatterConfig
from bbfit.inputs import InputLimits


def forest_command(
    placements: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[PLACEMENTS]")] = None,
    /,
    library: Path = Path("runs/library"),
    out: Path = Path("runs/forest"),
    forest: ForestConfig = ForestConfig(),  # noqa: B008
    register: RegisterConfig = RegisterConfig(),  # noqa: B008
    scatter: ScatterConfig = ScatterConfig(),  # noqa: B008
    limits: InputLimits = InputLimits(),  # noqa: B008
) -> None:
    """Place the trees of a library as a tree register says, or scatter them, and write a GLB, 3D Tiles, a USD stage or a web page.

    Interrupted and started again, it resumes where it stopped.

    For example: bbfit forest trees.csv --library runs/library --out runs/forest

    Args:
        placements: Register of trees: a table (.csv .tsv .txt) with a header, or GeoJSON with points (.geojson .json). Without it, give
            --scatter or --scatter-area.
        library: Folder of a library of trees.
        out: Folder for the forest.
        forest: What is written, and how trees are chosen.
        register: How the register is read.
        scatter: Where trees are scattered, and which.
        limits: What the inputs may refer to, and how large they may be.
    """
    from bbfit.forest.building import build_forest

    if placements is not None and scatter.given:
        fail("scatter", "the trees are in a register", "leave out --scatter and --scatter-area, or the register")
    source = scatter if placements is None else placements
    if placements is not None and scatter.mix:
        fail("mix", "the register has the species", "leave out --mix")
    with progress() as on_progress:
        result = build_forest(source, library, out, forest, register=register, limits=limits, on_progress=on_progress)
    counts = dict[str, int]()
    for species in result.species:
        counts[species.likeness] = counts.get(species.likeness, 0) + species.count
    how = ", ".join(f"{count:,} by {likeness}" for likeness, count in counts.items() if count)
    found = "" if placements is None else f" ({how}); forest.json says which trees stand for each species"
    out_console.print(f"{len(result):,} trees{found}", soft_wrap=True)
    if result.skipped:
        out_console.print(f"{result.skipped:,} rows without usable coordinates were left out", style="yellow")
    shown = {"glb": "forest.glb", "tiles": "tiles/tileset.json", "usd": "usd/forest.usda", "page": "page/index.html"}
    out_console.print(f"in {result.folder}: {', '.join(shown[name] for name in forest.formats)}", soft_wrap=True)
