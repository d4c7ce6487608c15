"""Writing a billboard cloud as a model that other programs open."""

from __future__ import annotations

from pathlib import Path

from bbfit.exporting.cards import cloud_cards
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.gltf import glb_bytes
from bbfit.exporting.obj import mtl_bytes, obj_bytes
from bbfit.files import write_bytes
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import encode_png
from bbfit.model_files import check_model_path


def export(cloud: BillboardCloud, path: str | Path, config: ExportConfig | None = None) -> list[Path]:
    """Write a billboard cloud as GLB (one file) or as OBJ with an MTL and a PNG of the same stem, by the ending of ``path``.

    Textures are rounded to 8 bits and otherwise kept texel for texel. Coordinates keep the cloud's metres and origin.

    Returns
    -------
    The files written, the model first.

    Raises
    ------
    InputError
        for another ending, an empty cloud or one with values that are not finite.
    MissingFileError, OSError
        if the folder does not exist or cannot be written to; files that were there stay as they were.
    """
    path, config = check_model_path("model file", path), config or ExportConfig()
    cards = cloud_cards(cloud, config.padding)
    if path.suffix.lower() == ".glb":
        contents = {path: glb_bytes(cards, config)}
    else:
        material, texture = path.with_suffix(".mtl"), path.with_suffix(".png")
        contents = {
            path: obj_bytes(cards, config, material_file=material.name),
            material: mtl_bytes(texture_file=texture.name),
            texture: encode_png(cards.atlas.image),
        }
    for file, data in reversed(contents.items()):  # what is referred to before what refers to it
        write_bytes(file, data)
    return list(contents)
