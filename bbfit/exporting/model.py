"""The model that ships: what the exported files of a billboard cloud contain, and what they show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from torch import Tensor

from bbfit.checks import fail
from bbfit.exporting.cards import cloud_cards
from bbfit.exporting.config import ExportConfig, ResolvedExport
from bbfit.exporting.description import Description, described_glb
from bbfit.exporting.gaps import with_filled_gaps
from bbfit.exporting.gltf import glb_bytes
from bbfit.exporting.hulls import overdraw, with_hulls
from bbfit.exporting.mip_matching import reduced, with_mips
from bbfit.exporting.mips import plain_chain, surface_chain
from bbfit.exporting.obj import mtl_bytes, obj_bytes
from bbfit.exporting.outlines import count_pieces, with_pieces
from bbfit.exporting.smoothing import smoothed
from bbfit.exporting.splitting import split
from bbfit.files import write_bytes
from bbfit.geometry.alpha import AlphaMode
from bbfit.geometry.camera import Camera
from bbfit.geometry.cards import Cards
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.light import Light
from bbfit.images import encode_png
from bbfit.model_files import check_model_path, normals_path
from bbfit.rendering.cards import CardRenderer

OnExport = Callable[[str, int, int], None]
"""Called with a kind of work (``"mip levels"``, ``"textures"``), the number of the finished parts and their total."""


def silent_export(work: str, done: int, total: int) -> None:
    """An :data:`OnExport` that reports nothing."""


@dataclass(frozen=True)
class ShippedModel:
    """A billboard cloud with the export options of its files; make one with :func:`shipped_model`.

    The polygons and the GLB are computed when they are first used, and kept. That raises InputError if the cloud is empty or has values
    that are not finite.
    """

    cloud: BillboardCloud
    """The billboards, with the alpha mode of the files."""
    config: ResolvedExport
    """The export options."""
    halvings: int = 0
    """How many times the sides of the textures are halved, for a model that is only seen from afar."""
    description: Description | None = None
    """The names and facts in the GLB."""
    on_progress: OnExport = field(default=silent_export, compare=False, repr=False)
    """Called during long work."""

    @cached_property
    def cards(self) -> Cards:
        """The polygons, split and trimmed as the options request, and the mip levels if there are any: the files' own, or the program's.

        They are those of the files, so they do not depend on whether a program smooths the edges of masks.
        """
        if not self.config.has_mips:
            return self._averaged_cards
        cards = with_mips(self._trimmed_cards, partial(self.on_progress, "mip levels"))
        averaged = self._averaged_cards.atlas.image
        return replace(cards, averaged=averaged) if self.config.fallback and averaged is not cards.atlas.image else cards

    @cached_property
    def _trimmed_cards(self) -> Cards:
        """The polygons without mip levels."""
        cards = self._whole_cards
        if self.config.outline == "hull":
            cards = with_hulls(cards, self.config.corners, cards.outlined_alpha)
        elif self.config.outline == "pieces":
            cards = with_pieces(cards, self.config.pieces, self.config.corners, cards.outlined_alpha)
        return cards

    @cached_property
    def _averaged_cards(self) -> Cards:
        """The polygons as programs show them that compute the mip levels of a PNG themselves, if the files ask for levels."""
        cards = self._trimmed_cards
        if not (self.config.has_mips or self.config.mipmapped(cards.alpha)):
            return cards
        surface = None if cards.atlas.surface is None else tuple(surface_chain(cards.atlas.surface, None))
        cards = replace(cards, chain=tuple(plain_chain(cards.atlas.image)), surface_chain=surface)
        return with_filled_gaps(cards, partial(self.on_progress, "mip levels"))

    @cached_property
    def _whole_cards(self) -> Cards:
        """The polygons before they are trimmed."""
        cloud = replace(self.cloud, alpha=replace(self.cloud.alpha, antialiased=False))
        program = self.config.program
        splits = self.config.split and cloud.alpha.kind == "blend"
        # Where the nodes of a split model cull back faces, a lit one needs the normals of both sides.
        paired = splits and program.culls and self.config.material != "unlit"
        cards = cloud_cards(cloud, self.config.padding, self.halvings, traced=program.traced, paired=paired)
        if splits:
            cards = split(cards, apart=not program.culls)
        return reduced(cards, self.halvings)

    def count_pieces(self) -> int:
        """How many polygons the model would have with the outline ``pieces``."""
        cards = self._whole_cards
        return count_pieces(cards, self.config.pieces, cards.outlined_alpha)

    @cached_property
    def _renderer(self) -> CardRenderer:
        return CardRenderer(replace(self.cards, alpha=self.cloud.alpha))

    @cached_property
    def glb(self) -> bytes:
        """The GLB file."""
        glb = self._plain_glb
        return glb if self.description is None else described_glb(glb, self.description, self.cards)

    @cached_property
    def _plain_glb(self) -> bytes:
        if self.config.textures != "ktx2":  # which alone takes long
            return glb_bytes(self.cards, self.config)
        return glb_bytes(self.cards, self.config, partial(self.on_progress, "textures"))

    def described(self, description: Description) -> ShippedModel:
        """The same model with names and facts in its GLB."""
        model = replace(self, description=description)
        # What is known of this model is not computed again.
        known = ("_trimmed_cards", "_averaged_cards", "cards", "_plain_glb")
        vars(model).update((name, vars(self)[name]) for name in known if name in vars(self))
        return model

    @property
    def overdraw(self) -> float:
        """Share of the polygons' area that is shaded although nothing is visible there, in [0, 1]."""
        return overdraw(self.cards, self.cards.visible_alpha)

    def draw(self, camera: Camera, light: Light | None = None) -> Tensor:
        """Draw what the files show: premultiplied RGBA over nothing in [0, 1], [H, W, 4], or [V, H, W, 4] for a batch of cameras.

        ``light`` is for a cloud with maps: that of each view, or one for all; by default the cloud's own. See
        :func:`~bbfit.rendering.cards.draw_cards`.
        """
        return self._renderer.draw(camera, light)

    def surfaces(self, camera: Camera) -> Tensor:
        """What the files show of the surfaces of a cloud with maps: see :meth:`~bbfit.rendering.cards.CardRenderer.surfaces`."""
        return self._renderer.surfaces(camera)

    def antialiased(self) -> ShippedModel:
        """The same model as a program draws it that smooths the edges of masks by alpha to coverage."""
        model = replace(self, cloud=replace(self.cloud, alpha=replace(self.cloud.alpha, antialiased=True)))
        vars(model)["cards"] = self.cards  # of the same files, so that they are not computed twice
        return model

    def save(self, path: str | Path) -> list[Path]:
        """Write the files as :func:`export` does, with the same results and errors."""
        path = check_model_path("model file", path)
        if path.suffix.lower() == ".glb":
            contents = {path: self.glb}
        else:
            material, texture = path.with_suffix(".mtl"), path.with_suffix(".png")
            atlas, normals = self._averaged_cards.atlas, normals_path(path)
            has_maps = atlas.surface is not None
            contents = {
                path: obj_bytes(self.cards, self.config, material_file=material.name),
                material: mtl_bytes(texture_file=texture.name, normals_file=normals.name if has_maps else None),
                texture: encode_png(atlas.image),
            }
            if atlas.surface is not None:
                contents[normals] = encode_png(np.ascontiguousarray(atlas.surface[..., :3]))
        if self.config.mip_files:
            own = self.cards if self.config.has_mips else with_mips(self._trimmed_cards, partial(self.on_progress, "mip levels"))
            assert own.chain is not None
            contents |= {path.with_name(f"{path.stem}_mip{level}.png"): encode_png(image) for level, image in enumerate(own.chain)}
        for file, data in reversed(contents.items()):  # a file is written after the files that it refers to
            write_bytes(file, data)
        return list(contents)


def check_material(config: ExportConfig, *, maps: bool) -> None:
    """Require that a cloud can have the material that is requested. Raises InputError for one without light and a cloud with maps."""
    if maps and config.material in ("unlit", "emissive"):
        fail("material", "the cloud has maps, whose colors contain no light", "leave out --material, or fit with --light baked")


def shipped_model(
    cloud: BillboardCloud, config: ExportConfig | None = None, halvings: int = 0, on_progress: OnExport = silent_export
) -> ShippedModel:
    """The model in the exported files of a billboard cloud; an alpha mode or cutoff that ``config`` leaves open is the cloud's own.

    ``halvings`` halves the sides of the textures that many times, for a model that is only seen from afar. ``on_progress`` is called during
    long work. Raises InputError if the encoder of the textures is not installed.
    """
    resolved = (config or ExportConfig()).resolve()
    resolved.check()  # before the polygons and the mip levels are computed
    check_material(config or ExportConfig(), maps=cloud.surface is not None)
    alpha = AlphaMode(resolved.alpha or cloud.alpha.kind, resolved.alpha_cutoff or cloud.alpha.cutoff)
    cloud = replace(cloud if resolved.program.transmits else cloud.opaque(), alpha=alpha)
    return ShippedModel(cloud if resolved.program.masks else smoothed(cloud), resolved, halvings, on_progress=on_progress)


def export(cloud: BillboardCloud, path: str | Path, config: ExportConfig | None = None) -> list[Path]:
    """Write a billboard cloud as a GLB file, or as an OBJ file with an MTL and a PNG file of the same stem.

    The suffix of ``path`` selects the format. Textures are rounded to 8 bits and otherwise kept texel for texel. Coordinates keep the
    cloud's meters and origin.

    Returns
    -------
    list of Path
        The files written, the model first.

    Raises
    ------
    InputError
        for another suffix, for an empty cloud, for values that are not finite, or if the encoder of a requested format is missing.
    MissingFileError, OSError
        if the folder does not exist or cannot be written to; existing files stay as they were.
    """
    return shipped_model(cloud, config).save(path)
