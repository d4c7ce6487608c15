"""The terminal: results on standard output, progress and errors on standard error."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from rich.console import Console

from bbfit.exporting.config import ExportConfig

if TYPE_CHECKING:
    from bbfit.pipeline import RunResult
    from bbfit.stages.stage import OnProgress

out_console = Console()
"""Standard output."""
err_console = Console(stderr=True)
"""Standard error."""


def show(result: RunResult, *, thesis: bool) -> None:
    """Print the scores of a run, with those on the thesis's scale if ``thesis``, and the folder of its results."""
    from bbfit.reporting.tables import report_table

    out_console.print(report_table(result.report, thesis=thesis))
    if result.skipped:
        out_console.print(f"unchanged and skipped: {', '.join(result.skipped)}", style="dim")
    if result.missed is not None:
        out_console.print(
            f"no short fit within the budget reached {result.missed:g} dB on validation views; this is the best one, fitted for longer",
            style="yellow",
        )
    out_console.print(
        f"results in {result.folder}: report.html shows all; model.glb, model.obj, metrics.json, cloud.safetensors", soft_wrap=True
    )


def show_missing_encoder(config: ExportConfig) -> None:
    """Print what to install, if a texture format was omitted because its encoder is missing."""
    if config.missing_encoder is not None:
        out_console.print(f"textures are PNG alone, without mip levels; for KTX2 {config.missing_encoder}", style="yellow", soft_wrap=True)


def progress() -> contextlib.AbstractContextManager[OnProgress]:
    """A progress bar for each stage, on standard error."""
    from bbfit.reporting.progress import progress_bars

    return progress_bars(err_console)
