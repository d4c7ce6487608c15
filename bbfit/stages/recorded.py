"""How a run exported its cloud, by the record in its folder."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from bbfit.checks import InputError
from bbfit.exporting.config import ExportConfig
from bbfit.files import read_json
from bbfit.provenance import digest_file
from bbfit.stages.stage import RECORD_FILE, recorded_stages


def recorded_export(record: Any) -> ExportConfig:
    """The options of the export in the contents of a ``run.json``, which may be anything; the defaults if it has no valid ones."""
    config = record.get("config") if isinstance(record, dict) else None
    stored = config.get("export") if isinstance(config, dict) else None
    known = {f.name: stored[f.name] for f in fields(ExportConfig) if f.name in stored} if isinstance(stored, dict) else {}
    try:
        return ExportConfig(**known)
    except (InputError, TypeError):  # of another version
        return ExportConfig()


def as_in_run(config: ExportConfig, cloud: Path) -> ExportConfig:
    """``config`` with the outline and the mip levels of the run that wrote the file ``cloud``, as far as it leaves them open.

    A budget and the preset ``thesis`` decide them for their run. Without ``run.json`` beside the cloud, or if the cloud has changed since,
    ``config`` stays as it is.
    """
    try:
        record = read_json("run", cloud.with_name(RECORD_FILE))
        fit = recorded_stages(record).get("fit", {"outputs": {}})
        if fit["outputs"].get(cloud.name) != digest_file(cloud):
            return config
    except InputError:  # there is none, or it is damaged
        return config
    run = recorded_export(record)
    if config.outline is None:
        config = replace(config, outline=run.outline, pieces=min(config.pieces, run.pieces), corners=min(config.corners, run.corners))
    return config if config.mipmaps is not None else replace(config, mipmaps=run.mipmaps)
