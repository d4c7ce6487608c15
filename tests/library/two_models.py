"""Two small models whose textures share an atlas, and their files."""

from __future__ import annotations

from pathlib import Path

import torch
from billboard_scene import crossing_billboards

from bbfit.exporting.config import ExportConfig
from bbfit.exporting.gltf import glb_bytes, texture_files
from bbfit.exporting.model import shipped_model
from bbfit.geometry.cards import Cards
from bbfit.geometry.cloud import BillboardCloud
from bbfit.library.shared_atlas import SharedPage, shared_pages


def clouds() -> list[BillboardCloud]:
    """Two and three billboards of noise."""
    return [crossing_billboards(2), crossing_billboards(3)]


def plain(color: tuple[float, float, float]) -> BillboardCloud:
    """Two opaque billboards of one color."""
    cloud = crossing_billboards(2)
    return cloud.with_texels(torch.tensor([*color, 1.0]).expand_as(cloud.texels))


def cards_of(models: list[BillboardCloud], config: ExportConfig, halvings: int = 0) -> list[Cards]:
    """The cards of each model by itself."""
    return [shipped_model(cloud, config, halvings).cards for cloud in models]


def page_of(cards: list[Cards], config: ExportConfig) -> SharedPage:
    """The one page of several models."""
    (page,) = shared_pages(cards, config.padding, 4096, own_levels=config.resolve().has_mips)
    return page


def write_models(folder: Path, page: SharedPage, config: ExportConfig) -> list[Path]:
    """The files of models that share a page: ``0.glb``, ``1.glb`` and so on, and the atlas beside them."""
    names = []
    for name, data in texture_files(page.cards[0], config.resolve()).items():
        (folder / name).write_bytes(data)
        names.append(name)
    paths = [folder / f"{number}.glb" for number in range(len(page.cards))]
    for path, cards in zip(paths, page.cards, strict=True):
        path.write_bytes(glb_bytes(cards, config, files={name: name for name in names}))
    return paths
