"""The options of an export, and the defaults for each program."""

from __future__ import annotations

import importlib.util
import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from bbfit.checks import Count, Range, amount, check_count, check_fields, fail
from bbfit.geometry.alpha import AlphaKind, AlphaMode, Cutoff

Up = Literal["auto", "y", "z"]
Profile = Literal[
    "three", "babylon", "playcanvas", "model-viewer", "cesium", "filament", "godot", "unity", "unreal", "vtk", "panda3d", "blender"
]
Encoding = Literal["png", "webp", "ktx2"]
Textures = Literal["auto"] | Encoding
Material = Literal["unlit", "pbr", "emissive"]
Outline = Literal["pieces", "hull", "rectangle"]

MOST_AVERAGED = 0.25
"""The largest cutoff of a mask with which plain averages of alpha, the mip levels that programs compute, keep most of a tree's leaves."""


@dataclass(frozen=True)
class Program:
    """What a program needs of a model."""

    split: bool = True
    """Whether it sorts blended geometry node by node, so that cards must be split; otherwise it finds the order of each pixel by itself."""
    material: Material = "unlit"
    """The material that it shows as it is."""
    masks: bool = True
    """Whether it cuts masks off at their alpha cutoff; otherwise they are blended (:func:`~bbfit.exporting.smoothing.smoothed`)."""
    transmits: bool = False
    """Whether it reads light that passes through leaves (KHR_materials_diffuse_transmission)."""
    mipmaps: bool = True
    """Whether mip levels do it good."""
    traced: bool = False
    """Whether it follows rays and culls nothing (:class:`~bbfit.geometry.cards.Cards`)."""
    culls: bool = True
    """Whether it culls the back faces of blended meshes that are one-sided; otherwise a node cannot order its fronts and backs."""
    nearest: bool = False
    """Whether it sorts nodes by the nearest points of their bounding spheres, not by the centers of their bounds."""
    quantized: bool = False
    """Whether it reads vertices of integers (KHR_mesh_quantization)."""


# Most corners of a polygon unless an option limits them.
_CORNERS = 8
_PROGRAMS: dict[Profile | None, Program] = {
    None: Program(split=False),
    "three": Program(quantized=True),
    "babylon": Program(transmits=True, quantized=True),
    "playcanvas": Program(quantized=True),
    "model-viewer": Program(quantized=True),
    # It computes mip levels from textures that it scales to powers of two, without the colors under transparent texels.
    "cesium": Program(mipmaps=False, culls=False, nearest=True, quantized=True),
    "filament": Program(quantized=True),
    "godot": Program(),
    "unity": Program(),
    "unreal": Program(),
    # It drops alpha with KHR_materials_unlit, and sorts each pixel's layers by depth peeling.
    "vtk": Program(split=False, material="emissive", masks=False),
    "panda3d": Program(),
    "blender": Program(split=False, mipmaps=False, traced=True),
}


@dataclass(frozen=True)
class ExportConfig:
    """How a billboard cloud is written to a model file."""

    profile: Profile | None = None
    """Program that will open the file; it decides the options below that are not given. Default: any program."""
    alpha: AlphaKind | None = None
    """Alpha mode: mask draws where alpha reaches the cutoff, and needs no sorting; blend is smooth, and drawn back to front;
    hash draws at random with alpha as the probability; coverage covers a share of a pixel's samples, once you set the material.
    Default: the mode that the textures were fitted for, which suits them best."""
    alpha_cutoff: Cutoff | None = None
    """Least alpha that is drawn with mask, in (0, 1). Default: the cutoff that the textures were fitted for."""
    split: bool | None = None
    """With blend: cut billboards that cross, and spread the pieces over nodes that programs draw in the right order.
    This costs vertices; mask, coverage and hash ignore it.
    Default: only for a profile whose program sorts nodes."""
    outline: Outline | None = None
    """What is drawn of each billboard. pieces: convex pieces around its visible parts, so that few empty pixels are shaded;
    hull: one convex polygon; rectangle: all of it.
    Default: pieces; a run with a budget of bytes draws pieces or hulls of 5 to 8 corners, the finest outline that fits;
    a run with a budget of vertices draws hulls of 4; the preset thesis and a comparison of vertices draw rectangles."""
    pieces: Count | None = None
    """With pieces: the most pieces of a billboard on average, at least 1. Cuts that save too little are left out. Default: 8."""
    corners: Annotated[int, Range(4, 8)] | None = None
    """With pieces or hull: the most corners of each polygon, 4 to 8. Default: 8."""
    textures: Textures | None = None
    """Format of a GLB's texture beside PNG, which every program reads: webp is smaller, once --no-fallback omits the PNG;
    ktx2 stays compressed on the graphics card and includes mip levels that keep their coverage (needs the extra ktx2);
    auto is ktx2 where that extra is installed, else PNG alone.
    Default: PNG, the textures exactly as they were scored."""
    fallback: bool = True
    """Keep the PNG beside a texture in another format, for programs that cannot read that format."""
    mipmaps: bool | None = None
    """Read the texture with mip levels from afar, so that the tree does not flicker. Programs compute those of a PNG as plain averages.
    Default: yes, except for masks with a cutoff above 0.25, whose leaves would vanish; for the preset thesis; for Blender and CesiumJS."""
    mip_files: bool = False
    """Also write the mip levels as PNG files beside the model, for programs that import them."""
    quantized: bool | None = None
    """Store positions and texture coordinates of a GLB with 16 bits, normals and tangents with 8 (KHR_mesh_quantization).
    Default: for the profiles of web viewers and Filament, which read this. Other programs may refuse such a file."""
    material: Material | None = None
    """unlit: colors as they are, with the light that the tree was rendered in. pbr: a rough dielectric that the program lights again.
    emissive: a black metal that emits the colors, for programs that do not show unlit right.
    Default: unlit; emissive for VTK. A cloud with maps has a matte material of its own, which takes the program's light."""
    padding: Annotated[int, Range(1, 64)] = 8
    """Free texels around each texture in the atlas, 1 to 64; with 8 the mip levels 1 to 3 never mix two textures."""
    up: Up = "auto"
    """Up axis of an OBJ file. auto: that of the tree's file, if the views name it (.ply, .stl and .blend are Z up), else y.
    A GLB is Y up, as glTF requires."""

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def program(self) -> Program:
        """What the profile's program needs."""
        return _PROGRAMS[self.profile]

    def comparable(self) -> ExportConfig:
        """The same options with rectangles unless they ask for outlines: all models have as many vertices for each billboard."""
        return replace(self, outline="rectangle") if self.outline is None else self

    def compact(self, corners: int) -> ExportConfig:
        """The same options with hulls of at most so many corners, 4 to 8, unless they ask for other outlines."""
        return replace(self, outline="hull", corners=min(self.corners or _CORNERS, corners)) if self.outline is None else self

    def outlines(self) -> tuple[ExportConfig, ...]:
        """The same options with each outline that a budget of bytes may draw: from the one that shades fewest pixels, the default's, to the
        one of fewest bytes, hulls of at most 5 corners. Only the same options if they ask for an outline.
        """
        if self.outline is not None:
            return (self,)
        steps: tuple[tuple[Outline, int], ...] = (("pieces", 8), ("pieces", 6), ("pieces", 5), ("hull", 6), ("hull", 5))
        return tuple(
            dict.fromkeys(replace(self, outline=outline, corners=min(self.corners or _CORNERS, corners)) for outline, corners in steps)
        )

    def mipmapped(self, alpha: AlphaMode) -> bool:
        """Whether a model with an alpha mode is read with mip levels."""
        if self.mipmaps is not None:
            return self.mipmaps
        return self.program.mipmaps and (alpha.kind != "mask" or alpha.cutoff <= MOST_AVERAGED)

    def resolve(self) -> ResolvedExport:
        """Fill in the choices that depend on the profile and on the installed encoders; a :class:`ResolvedExport` returns itself.

        ``alpha`` and ``alpha_cutoff``, whose default is that of the cloud, stay as they are, and ``mipmaps``, which depends on them.
        """
        if isinstance(self, ResolvedExport):
            return self
        chosen: dict[str, Any] = {"split": self.program.split, "material": self.program.material, "textures": "png", "outline": "pieces"}
        chosen |= {"pieces": 8, "corners": _CORNERS, "quantized": self.program.quantized}
        chosen |= {name: value for name, value in vars(self).items() if value is not None or name not in chosen}
        if chosen["textures"] == "auto":
            chosen["textures"] = "png" if ktx2_missing() else "ktx2"
        return ResolvedExport(**chosen)

    @property
    def key(self) -> tuple[ResolvedExport, Outline | None]:
        """What a cache key contains: the resolved options and the requested outline.

        :meth:`comparable`, :meth:`compact` and :meth:`outlines` choose an outline only if none is requested.
        """
        return self.resolve(), self.outline

    def check(self) -> None:
        """Require that the encoder of the requested textures is installed."""
        if self.textures == "ktx2" and (missing := ktx2_missing()):
            fail("textures", "the encoder of ktx2, the package alktx2, is not installed", missing)

    @property
    def missing_encoder(self) -> str | None:
        """What to install for textures that were requested with ``auto``; None if nothing is missing."""
        return ktx2_missing() if self.textures == "auto" else None


def check_effect(config: ExportConfig, path: Path) -> None:
    """Require that the options which are given have an effect on a model file at ``path``. Raises InputError for one that has none."""
    if path.suffix.lower() == ".obj":
        if config.textures not in (None, "png"):
            fail("textures", f"an OBJ file has a PNG, not {config.textures}", "leave out --textures, or write a .glb")
        if config.quantized:
            fail("quantized", "an OBJ file has decimal numbers", "leave out --quantized, or write a .glb")
    elif config.up == "z":
        fail("up", "a GLB is Y up, as glTF requires", "leave out --up, or write an .obj")
    if not config.fallback and config.textures in (None, "png"):
        fail("fallback", "PNG is the only texture", "leave out --no-fallback, or give --textures webp or ktx2")
    if config.outline in ("hull", "rectangle") and config.pieces is not None:
        fail("pieces", f"a {config.outline} is one polygon", "leave out --pieces, or give --outline pieces")
    if config.outline == "rectangle" and config.corners is not None:
        fail("corners", "a rectangle has four", "leave out --corners, or give --outline hull or pieces")


def check_no_mip_files(config: ExportConfig) -> None:
    """Require that an export writes no mip levels as files. Raises InputError."""
    if config.mip_files:
        fail("mip_files", "only bbfit run, fit, sweep and export write them", "leave out --mip-files, or give --textures ktx2")


class ResolvedExport(ExportConfig):
    """An :class:`ExportConfig` with every choice made. Where ``alpha`` or ``alpha_cutoff`` is None, that of the cloud holds."""

    split: bool
    outline: Outline
    pieces: int
    corners: int
    textures: Encoding
    quantized: bool
    material: Material

    @property
    def has_mips(self) -> bool:
        """Whether the model's textures include mip levels of their own."""
        return self.textures == "ktx2" and self.mipmaps is not False


@dataclass(frozen=True)
class ThinConfig:
    """How far a tree is thinned out, and for which program. At least one limit must be given; both hold at once."""

    bytes: int | str | None = None
    """Most bytes of the file with its textures, such as 500k or 2M."""
    triangles: Count | None = None
    """Most triangles. A shared mesh counts once for each of its objects."""
    texture_size: Annotated[int, Range(1, 16_384)] | None = None
    """Longest side of the tree's pictures, in texels; larger pictures are scaled down.
    Default: pictures stay; with a limit of bytes, they take at most half of it."""
    profile: Profile | None = None
    """Program that will open the file; it decides whether vertices are integers. Default: any program."""
    quantized: bool | None = None
    """Store vertices as integers (KHR_mesh_quantization), in about half of the bytes. Default: for a profile that reads them."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.bytes is not None:
            check_count("bytes", amount("bytes", self.bytes))

    @property
    def most_bytes(self) -> int | None:
        """``bytes`` as a number."""
        return None if self.bytes is None else amount("bytes", self.bytes)

    @property
    def integers(self) -> bool:
        """Whether vertices are integers."""
        return ExportConfig(profile=self.profile, quantized=self.quantized).resolve().quantized


@dataclass(frozen=True)
class LodConfig:
    """How a tree and billboard clouds of it become levels of detail."""

    planes: tuple[Count, ...] = (16, 8, 4, 2)
    """Number of billboards of each level, the finest first."""
    thinned: tuple[Count, ...] = ()
    """Triangles of trees that Blender thins out, with enlarged leaves, as levels before the billboards, the finest first."""
    error_pixels: Annotated[float, Range(0, 100, open_low=True)] = 1.0
    """Largest error of a level's silhouette, gaps included, where the level takes over, in pixels of the screen.
    It holds for 95 % of the silhouette's pixels, in every training view."""
    color_error: Annotated[float, Range(0, 1, open_low=True)] = 0.2
    """Largest perceived difference (FLIP) of a level's pixels where the level takes over, the mean over training views, in (0, 1].
    Even colors side by side have 0.1 where the difference is just noticeable, 0.2 where it is no longer acceptable."""
    original: bool = True
    """Keep the tree itself as the finest level."""
    triangles: Count | None = None
    """Triangles to which Blender thins the tree itself out. Default: all of them stay."""
    fragments_per_triangle: Annotated[float, Range(0, 1e6)] | None = None
    """How many pixels of triangles (fragments) are shaded in the time that a triangle takes; bbfit frames measures it.
    A level then takes over only where it also draws faster, with the outline that draws fastest there.
    A level that nowhere draws faster is left out. Default: the errors alone count."""
    frames: Path | None = None
    """Folder of bbfit frames that measured this number. The times of the profile's program count, or else those of the first program."""
    screen_width: Count = 1920
    """Width in pixels of the screen for which distances and screen coverages are computed."""
    screen_height: Count = 1080
    """Height of that screen in pixels."""
    screen_fov_degrees: Annotated[float, Range(0, 170, open_low=True)] = 50.0
    """Vertical field of view of that screen in degrees."""

    def __post_init__(self) -> None:
        if not isinstance(self.planes, tuple | list) or not self.planes:
            fail("planes", "expected one or more numbers of billboards", "for example 16 8 4 2")
        check_fields(self)
        if self.frames is not None and self.fragments_per_triangle is not None:
            fail("frames", "fragments_per_triangle is given too", "leave out one of them")
        meshes = (*(() if self.triangles is None else (self.triangles,)), *self.thinned)
        for name, numbers in (("planes", self.planes), ("thinned", meshes)):
            if any(coarse >= fine for fine, coarse in itertools.pairwise(numbers)):
                fail(name, f"expected falling numbers, got {' '.join(map(str, numbers))}", "list the finest level first")


def ktx2_missing() -> str | None:
    """What to install before :func:`~bbfit.exporting.encoders.encode_ktx2` works; None if nothing is missing."""
    if importlib.util.find_spec("alktx2") is None:
        return 'install bbfit with its extra, pip install "bbfit[ktx2]" (".[ktx2]" in its source folder), on Python 3.11 or newer'
    return None
