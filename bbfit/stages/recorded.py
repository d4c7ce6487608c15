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


def record_of(cloud: Path) -> dict[str, Any]:
    """The contents of ``run.json`` of the run that wrote the file ``cloud``; empty without it, or if the cloud has changed since."""
    try:
        record = read_json("run", cloud.with_name(RECORD_FILE))
        fit = recorded_stages(record).get("fit", {"outputs": {}})
        return record if fit["outputs"].get(cloud.name) == digest_file(cloud) else {}
    except InputError:  # there is none, or it is damaged
        return {}


def as_in_run(config: ExportConfig, cloud: Path) -> ExportConfig:
    """``config`` with the outline, the mip levels and the up axis of the run that wrote the file ``cloud``, as far as it leaves them open.

    A budget and the preset ``thesis`` decide the first two for their run, the tree's file the third. Without ``run.json`` beside the cloud,
    or if the cloud has changed since, ``config`` stays as it is.
    """
    run = recorded_export(record_of(cloud))
    if config.outline is None:
        config = replace(config, outline=run.outline, pieces=config.pieces or run.pieces, corners=config.corners or run.corners)
    if config.mipmaps is None:
        config = replace(config, mipmaps=run.mipmaps)
    return replace(config, up=run.up) if config.up == "auto" else config


def grown_species(cloud: Path) -> str | None:
    """The species of the tree that the run that wrote the file ``cloud`` grew; ``None`` if it grew none."""
    config = record_of(cloud).get("config")
    species = config.get("species") if isinstance(config, dict) else None
    name = species.get("name") if isinstance(species, dict) else None
    return name if isinstance(name, str) else None
