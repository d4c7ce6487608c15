"""The comparison of all systems on one tree."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from bbfit.blender.request import ViewsRequest
from bbfit.blender.requirements import check_blender
from bbfit.checks import fail
from bbfit.comparison.config import LIT, SYSTEMS, CompareConfig
from bbfit.comparison.own_systems import fits
from bbfit.comparison.systems import Systems
from bbfit.exporting.config import check_no_mip_files
from bbfit.files import write_bytes, write_json
from bbfit.layout import REQUEST_FILE
from bbfit.outputs import claimed_folder
from bbfit.pipeline import RunConfig, needs_blender
from bbfit.reporting.comparison_summary import compare_plot, summaries
from bbfit.reporting.comparison_tables import CompareRow, compare_csv, compare_markdown, compare_picture
from bbfit.stages.results import original_tree
from bbfit.stages.stage import OnProgress, Record, Stage, silent
from bbfit.stages.trees import convert_stage, views_stage
from bbfit.tree_files.tree_file import GLTF_SUFFIXES, TreeFile
from bbfit.views.dataset import ViewDataset

_TABLES = ("compare.csv", "compare.md", "compare.json", "quality.png", "systems.png")


@dataclass(frozen=True)
class CompareResult:
    """The results of a comparison."""

    folder: Path
    """The folder of the comparison, with ``views``, a folder for each system, and the tables and pictures."""
    rows: tuple[CompareRow, ...]
    """One row for each system."""


def compare(
    tree: str | Path | TreeFile,
    out: str | Path,
    config: CompareConfig | None = None,
    stages: RunConfig | None = None,
    *,
    on_progress: OnProgress | None = None,
) -> CompareResult:
    """Simplify a tree with bbfit and with alternative systems, and score all results on the same held-out views.

    Each result is drawn as its authors intended. Billboards, slices and learned meshes are unlit and blended; bbfit's masks are drawn with
    alpha to coverage. Billboards with maps take the light of the views, and Blender renders decimated meshes in it. If a system takes the
    program's light, views have at least one other sun, and all billboards are also scored under the suns of held-out views. Writes
    ``views/``, a folder for each system with its model and its pictures of the held-out views, ``compare.csv``, ``compare.md``,
    ``compare.json``, ``systems.png`` and ``quality.png``. A killed comparison continues where it stopped.

    Parameters
    ----------
    tree
        A tree in any format. Blender converts formats other than .glb and .gltf for the systems that read triangles.
    out
        The folder for the results.
    config
        The systems and their sizes.
    stages
        The options for rendering views, and the options that all of bbfit's fits and exports share.
    on_progress
        Called with the progress of each system.

    Raises
    ------
    InputError, OSError
        If the tree cannot be used or a file cannot be written. If a package is missing, the row of the system has no scores but a note.
    """
    config, stages, on_progress = config or CompareConfig(), stages or RunConfig(), on_progress or silent
    tree = TreeFile.open(tree, stages.limits)
    earlier, requested = _suns(Path(out)), stages.views.suns
    systems, stages = checked_systems(config, stages, earlier or 0)
    if needs_blender(Path(out)):
        check_blender(stages.views)
    with claimed_folder("out", out) as folder:
        record = Record(folder, inputs=[*tree.files, stages.views.hdri])
        record.check({"tables": _TABLES} | ({} if tree.suffix in GLTF_SUFFIXES else {"convert": ("tree.glb",)}))
        if earlier == 0 and requested == 0 and stages.views.suns:
            needing = " and ".join(system for system in systems if system in LIT)
            fail("systems", f"{needing}: {out}/views has no views under other suns", "choose another output folder, or remove that folder")
        return CompareResult(folder, _compared(tree, record, systems, config, stages, on_progress))


def checked_systems(config: CompareConfig, stages: RunConfig, suns: int = 0) -> tuple[list[str], RunConfig]:
    """The names of the systems in their order, and the options with at least ``suns`` suns, and with one if a system needs it.

    Raises InputError if an option is unusable.
    """
    if stages.fit.billboards is not None or stages.budget.given:
        fail("billboards", "the comparison sets their numbers", "omit billboards and budgets")
    if stages.fit.alpha is not None or stages.export.alpha is not None:
        fail("alpha", "each system has its own alpha mode", "leave out --alpha, and choose --systems")
    check_no_mip_files(stages.export)
    chosen = config.systems or (SYSTEMS if stages.views.hdri is None else tuple(system for system in SYSTEMS if system not in LIT))
    systems = [system for system in SYSTEMS if system in chosen]
    suns = max(suns, stages.views.suns, 1 if set(systems) & set(LIT) else 0)
    stages = replace(stages, views=replace(stages.views, suns=suns))
    for system, (fit, budget) in fits(config, stages.fit).items():
        if system == "bbfit" or system in systems:  # others take its size
            replace(stages, fit=fit, budget=budget).check(mesh=False, rendered=True, blender=False)
    return systems, stages


def _suns(folder: Path) -> int | None:
    """The number of suns of views that an earlier comparison rendered, with other systems perhaps; ``None`` without such views."""
    path = folder / "views" / REQUEST_FILE
    request = ViewsRequest.load(path) if path.is_file() else None
    suns = None if request is None else request.config.get("suns", 0)
    return suns if isinstance(suns, int) else None


def _compared(
    tree: TreeFile, record: Record, systems: list[str], config: CompareConfig, stages: RunConfig, on_progress: OnProgress
) -> tuple[CompareRow, ...]:
    """Compare the systems in a claimed folder. The options were checked."""
    folder = record.folder
    record.run(views_stage(folder, tree, stages.views), on_progress)
    views = ViewDataset.load(folder / "views", limits=stages.limits)
    views.check()
    if tree.suffix not in GLTF_SUFFIXES:
        record.run(convert_stage(folder, tree, "tree.glb"), on_progress)
        tree = TreeFile.open(folder / "tree.glb", stages.limits)
    comparison = Systems(tree, views, record, config, stages, on_progress)
    rows = []
    on_progress("systems", 0, len(systems))
    for number, system in enumerate(systems, 1):
        rows.append(comparison.row(system))
        on_progress("systems", number, len(systems), system)

    def write_tables(on_progress: OnProgress) -> None:
        write_bytes(folder / "compare.csv", compare_csv(rows))
        write_bytes(folder / "compare.md", compare_markdown(rows, original_tree(views)).encode(errors="backslashreplace"))
        write_json(folder / "compare.json", [row.to_json() for row in rows])
        compare_plot(summaries({"tree": rows}), folder / "quality.png")
        compare_picture(rows, views.test, folder)

    record.run(Stage("tables", ([row.to_json() for row in rows], views.fingerprint), _TABLES, write_tables, algorithm="compare"))
    return tuple(rows)
