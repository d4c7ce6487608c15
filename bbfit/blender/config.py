"""The options of rendering views of a tree."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from bbfit.checks import Count, Range, Seed, check_fields, fail
from bbfit.provenance import EXECUTION

if TYPE_CHECKING:
    from bbfit.geometry.orbit import Orbit

Device = Literal["cpu", "cuda", "optix", "hip", "oneapi", "metal"]
Axis = Literal["auto", "origin", "center"]
_Elevation = Annotated[float, Range(-90, 90)]
_Strength = Annotated[float, Range(0, 1e6)]

DOME = (0.0, 20.0, 40.0, 60.0, 80.0)
"""Elevations of the rings of a dome in degrees."""
RING = (0.0,)
"""Elevation of the ring of the thesis (section 4.1)."""
# With fewer views, rings of a dome would have one or two.
_LEAST_DOME = 20


@dataclass(frozen=True)
class ViewsConfig:
    """How a tree is rendered."""

    count: Annotated[int, Range(2)] = 90
    """Number of pictures; steep rings of cameras get fewer of them, and one view out of every four neighbors is held out for the score."""
    size: Annotated[int, Range(11, 16384)] = 384
    """Width and height of a picture in pixels."""
    turned: Annotated[int, Range(0)] = 6
    """Number of held-out views, spread evenly, of which there is a second picture from a camera turned by one degree around the tree;
    they show how much the tree itself changes, which the score of shimmer needs. 0 for none."""
    elevations: tuple[_Elevation, ...] | None = None
    """Elevation of each ring of cameras: its angle above the horizon, in degrees.
    Default: a dome, 0 20 40 60 80; for fewer than 20 views and for the preset thesis, one ring at eye level, 0."""
    fov_degrees: Annotated[float, Range(1, 170)] = 40.0
    """Field of view in degrees; the cameras move back until the whole tree is in the picture."""
    orthographic: bool = False
    """Parallel projection instead of a field of view."""
    samples: Count = 16
    """Light paths per pixel: more are slower and less noisy; training views have half of them."""
    training_samples: Count | None = None
    """The same for training views, whose noise averages out in a fit. Default: half of --samples."""
    denoise: bool = True
    """Denoise the pictures with Open Image Denoise, which makes a few samples look like many."""
    sun_strength: _Strength = 2.5
    """Strength of the sun in watts per square meter; 0 leaves only the ambient light."""
    sun_azimuth: Annotated[float, Range(-360, 360)] = 30.0
    """Azimuth of the sun in degrees: 0 is behind the first view's camera; angles grow counter-clockwise seen from above."""
    sun_elevation: _Elevation = 45.0
    """Angle of the sun above the horizon in degrees."""
    ambient_strength: _Strength = 1.0
    """Strength of the ambient light: at 1, without sun, an open white matte surface is exactly white. It scales a panorama too."""
    suns: Annotated[int, Range(0, 64)] = 0
    """Number of other suns under which each training camera sees the tree, one at a time, for billboards that take a program's light.
    Held-out cameras see it under four further suns. With 0 there is only the baked light."""
    hdri: Path | None = None
    """Panorama (.hdr or .exr) that lights the tree in place of even white; set the sun's strength to 0 if it includes a sun."""
    render_device: Device = field(default="cpu", metadata=EXECUTION)
    """Device that Blender renders on."""
    render_workers: Count = field(default=1, metadata=EXECUTION)
    """Number of Blender processes; they divide the processor's threads among them."""
    seed: Seed = 0
    """Seed of the noise, and of the choice of held-out views."""
    axis: Axis = "auto"
    """Vertical line that the cameras circle: through the file's origin, or through the center of the tree's bounding box.
    Auto is the origin if it lies inside the bounding box seen from above, as it does under most trunks, else the center."""

    def __post_init__(self) -> None:
        if self.elevations is not None and not self.elevations:
            fail("elevations", f"expected one or more angles, got {self.elevations!r}")
        check_fields(self)
        if self.count < len(self.rings):
            fail("count", f"expected at least one view for each of {len(self.rings)} rings, got {self.count}")
        if self.suns and self.hdri is not None:
            fail("suns", "they need an even sky, and a panorama replaces it", "leave out --hdri, or set --suns 0")

    @property
    def samples_of_training(self) -> int:
        """Light paths per pixel of training views, with the default filled in."""
        if self.training_samples is not None:
            return self.training_samples
        return (self.samples + 1) // 2

    @property
    def rings(self) -> tuple[float, ...]:
        """Elevation of each ring, with the default filled in."""
        if self.elevations is not None:
            return tuple(self.elevations)
        return DOME if self.count >= _LEAST_DOME else RING

    @property
    def orbit(self) -> Orbit:
        """Directions of the cameras."""
        from bbfit.geometry.orbit import Orbit  # torch takes a while to start

        return Orbit(self.count, self.rings)
