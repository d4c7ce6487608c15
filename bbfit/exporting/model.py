"""Writing a billboard cloud as a model that other programs open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bbfit.exporting.cards import Cards, cloud_cards
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.gltf import glb_bytes
from bbfit.exporting.hulls import with_hulls
from bbfit.exporting.mip_matching import reduced, with_mips
from bbfit.exporting.obj import mtl_bytes, obj_bytes
from bbfit.exporting.splitting import split
from bbfit.files import write_bytes
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.cloud import BillboardCloud
from bbfit.images import encode_png
from bbfit.model_files import check_model_path


def export(cloud: BillboardCloud, path: str | Path, config: ExportConfig | None = None) -> list[Path]:
    """Write a billboard cloud as GLB (one file) or as OBJ with an MTL and a PNG of the same stem, by the ending of ``path``.

    Textures are rounded to 8 bits and otherwise kept texel for texel. Coordinates keep the cloud's meters and origin.

    Returns
    -------
    The files written, the model first.

    Raises
    ------
    InputError
        for another ending, an empty cloud or one with values that are not finite, or if an encoder is missing that was asked for.
    MissingFileError, OSError
        if the folder does not exist or cannot be written to; files that were there stay as they were.
    """
    path, config = check_model_path("model file", path), config or ExportConfig()
    return write_model(shipped_cards(cloud, config), path, config)


def write_model(cards: Cards, path: Path, config: ExportConfig) -> list[Path]:
    """Write the cards that :func:`shipped_cards` gives, as :func:`export` does."""
    if path.suffix.lower() == ".glb":
        contents = {path: glb_bytes(cards, config)}
    else:
        material, texture = path.with_suffix(".mtl"), path.with_suffix(".png")
        contents = {
            path: obj_bytes(cards, config, material_file=material.name),
            material: mtl_bytes(texture_file=texture.name),
            texture: encode_png(cards.atlas.image),
        }
    if config.mip_files:
        levels = enumerate(cards.chain or [cards.atlas.image])
        contents |= {path.with_name(f"{path.stem}_mip{level}.png"): encode_png(image) for level, image in levels}
    for file, data in reversed(contents.items()):  # what is referred to before what refers to it
        write_bytes(file, data)
    return list(contents)


def as_shipped(cloud: BillboardCloud, config: ExportConfig) -> BillboardCloud:
    """The cloud with the alpha mode that its model file has: what a render or a score of the file is to be taken of."""
    kind, cutoff = config.alpha or cloud.alpha.kind, config.alpha_cutoff or cloud.alpha.cutoff
    return replace(cloud, alpha=AlphaMode(kind, cutoff))


def shipped_cards(cloud: BillboardCloud, config: ExportConfig, halvings: int = 0) -> Cards:
    """The polygons that a model file of the cloud has, cut up and trimmed as asked for, and their mip levels if the file brings any.

    With ``halvings`` the sides of the textures are halved so often, for a model that is never seen from near.

    Raises
    ------
    InputError
        if the cloud is empty or has values that are not finite.
    """
    resolved = config.resolve()
    cards = cloud_cards(as_shipped(cloud, resolved), resolved.padding << halvings)
    if resolved.split and cards.alpha.kind == "blend":
        cards = split(cards)
    if resolved.hull is not None:
        cards = with_hulls(cards, resolved.hull, shows_from(cards))
    cards = reduced(cards, halvings)
    return with_mips(cards) if resolved.has_mips else cards


def shows_from(cards: Cards) -> float:
    """The alpha from which on something shows; 0 where it is anything above."""
    return cards.alpha.cutoff if cards.alpha.kind == "mask" else 0.0
