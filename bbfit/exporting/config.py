"""What an export may choose, and what it takes for each program."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

from bbfit.checks import check_choice, check_count, check_range, fail
from bbfit.geometry.alpha import AlphaKind, check_cutoff

Up = Literal["auto", "y", "z"]
Profile = Literal["three", "babylon", "godot", "unity", "unreal", "blender"]
Textures = Literal["auto", "png", "webp", "ktx2"]
Material = Literal["unlit", "pbr"]

# What is taken where it is left open. Programs that rasterize sort what is blended node by node, so they need split cards; Blender's Cycles
# finds the order by itself.
_OPEN: dict[str, Any] = {"split": False, "material": "unlit", "textures": "png"}
_PROFILES: dict[str, dict[str, Any]] = {
    "three": {"split": True},
    "babylon": {"split": True},
    "godot": {"split": True},
    "unity": {"split": True},
    "unreal": {"split": True},
    "blender": {},
}


@dataclass(frozen=True)
class ExportConfig:
    """How a billboard cloud is written to a model file."""

    profile: Profile | None = None
    """The program that the file is for: sets the options below that are not given. Left out: any program."""
    alpha: AlphaKind | None = None
    """What alpha means: mask is drawn where alpha reaches the cutoff, and needs no sorting; blend is smooth, and drawn back to front;
    hash is drawn by chance.
    Left out: what the textures were fitted for, which they are best at."""
    alpha_cutoff: float | None = None
    """Least alpha that is drawn with mask, in (0, 1). Left out: what the textures were fitted for."""
    split: bool | None = None
    """With blend: cut billboards that cross, and give each piece a node, so that programs that sort nodes draw them in the right order.
    Costs vertices; with mask and hash it is ignored.
    Left out: only for a profile whose program sorts nodes."""
    hull: int | None = None
    """Corners at most, 4 to 8, of a convex outline in place of each rectangle, so that fewer empty pixels are drawn.
    Left out: the rectangle."""
    textures: Textures | None = None
    """Format of a GLB's texture beside PNG, which every program reads: webp is smaller, once --no-fallback leaves the PNG out;
    ktx2 stays compressed on the graphics card and brings mip levels that keep their coverage (needs the extra ktx2);
    auto is ktx2 where that extra is installed, else PNG alone.
    Left out: PNG, the textures as they were scored."""
    fallback: bool = True
    """Keep the PNG beside a texture in another format, for programs that cannot read it."""
    mip_files: bool = False
    """Write the mip levels as PNG files beside the model too, for programs that take them."""
    material: Material | None = None
    """unlit: colors as they are, with the light that the tree was rendered in. pbr: a rough dielectric that the program lights once more.
    Left out: unlit."""
    padding: int = 8
    """Texels kept free around each texture in the atlas, at least 1; with 8 the mip levels 1 to 3 never mix two textures."""
    up: Up = "auto"
    """Up axis of an OBJ file. auto: that of the tree's own file where the views tell it (.ply, .stl and .blend are Z up), else y.
    A GLB is Y up, as glTF demands."""

    def __post_init__(self) -> None:
        check_choice("profile", self.profile, (None, *get_args(Profile)))
        check_choice("alpha", self.alpha, (None, *get_args(AlphaKind)))
        if self.alpha_cutoff is not None:
            check_cutoff("alpha_cutoff", self.alpha_cutoff)
        check_choice("split", self.split, (None, False, True))
        if self.hull is not None:
            check_count("hull", self.hull, 4)
            if self.hull > 8:
                fail("hull", f"expected 4 to 8 corners, got {self.hull}")
        check_choice("textures", self.textures, (None, *get_args(Textures)))
        check_choice("material", self.material, (None, *get_args(Material)))
        check_count("padding", self.padding, 1)
        check_choice("up", self.up, get_args(Up))

    def resolve(self) -> ExportConfig:
        """The same with what the profile and the encoders that are there decide over.

        ``alpha`` and ``alpha_cutoff``, which the cloud decides over, stay as they are.
        """
        taken = _OPEN | (_PROFILES[self.profile] if self.profile else {})
        resolved = replace(self, **{name: value for name, value in taken.items() if getattr(self, name) is None})
        if resolved.textures != "auto":
            return resolved
        return replace(resolved, textures="png" if ktx2_missing() else "ktx2")

    @property
    def brings_mips(self) -> bool:
        """Whether files bring mip levels of their own."""
        return self.mip_files or self.resolve().textures == "ktx2"

    @property
    def missed(self) -> str | None:
        """What to install for the textures that were wished for but not insisted on, if they are not had."""
        return ktx2_missing() if self.textures == "auto" else None


@dataclass(frozen=True)
class LodConfig:
    """How a tree and billboard clouds of it become levels of detail in one file."""

    planes: tuple[int, ...] = (16, 8, 4, 2)
    """How many billboards each level has, the finest first."""
    error_pixels: float = 1.0
    """How far a level's silhouette, gaps included, may be off where it takes over, in pixels of the screen.
    That holds for 95 of 100 pixels of the silhouette, in every training view."""
    original: bool = True
    """Keep the tree itself as the finest level."""
    triangles: int | None = None
    """Triangles that the tree itself is thinned out to, by Blender. Left out: all of them stay."""
    screen_width: int = 1920
    """Width in pixels of the screen that distances and screen coverages are given for."""
    screen_height: int = 1080
    """Height of that screen in pixels."""
    screen_fov_degrees: float = 50.0
    """Vertical field of view of that screen in degrees."""

    def __post_init__(self) -> None:
        if not isinstance(self.planes, tuple | list) or not self.planes:
            fail("planes", "expected one or more numbers of billboards", "say for example 16 8 4 2")
        for count in self.planes:
            check_count("planes", count)
        if any(coarse >= fine for fine, coarse in zip(self.planes, self.planes[1:], strict=False)):
            fail("planes", f"expected falling numbers, got {' '.join(map(str, self.planes))}", "name the finest level first")
        check_range("error_pixels", self.error_pixels, 0, 100, open_low=True)
        if self.triangles is not None:
            check_count("triangles", self.triangles)
        check_count("screen_width", self.screen_width)
        check_count("screen_height", self.screen_height)
        check_range("screen_fov_degrees", self.screen_fov_degrees, 0, 170, open_low=True)


def ktx2_missing() -> str | None:
    """What to install before :func:`~bbfit.exporting.encoders.encode_ktx2` works; None if nothing is missing."""
    if importlib.util.find_spec("alktx2") is None:
        return 'install bbfit with its extra, pip install "bbfit[ktx2]" (".[ktx2]" in its source folder), on Python 3.11 or newer'
    return None
