"""What views of a tree look like: how many, how large, from where, in which light."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from bbfit.checks import InputTypeError, check_choice, check_count, check_range, fail
from bbfit.provenance import EXECUTION

Device = Literal["cpu", "cuda", "optix", "hip", "oneapi", "metal"]
Axis = Literal["auto", "origin", "center"]


@dataclass(frozen=True)
class ViewsConfig:
    """How a tree is rendered."""

    count: int = 90
    """Pictures in all, shared out over the rings of cameras; a random quarter is held out for the score."""
    size: int = 384
    """Width and height of a picture in pixels."""
    elevations: tuple[float, ...] = (0.0,)
    """Height of each ring of cameras as an angle above the horizon, in degrees."""
    fov_degrees: float = 40.0
    """Field of view in degrees; the cameras step back until the whole tree is in the picture."""
    orthographic: bool = False
    """Parallel projection instead of a field of view."""
    samples: int = 16
    """Light paths a pixel: more are slower and less noisy."""
    denoise: bool = True
    """Clean the pictures with Open Image Denoise; takes about half of the time, and lets a few samples look like hundreds."""
    sun_strength: float = 2.5
    """Strength of the sun in watts a square meter; 0 leaves only the ambient light."""
    sun_azimuth: float = 30.0
    """Direction of the sun in degrees: 0 is behind the first view's camera, growing counter-clockwise seen from above, as views do."""
    sun_elevation: float = 45.0
    """Height of the sun above the horizon in degrees."""
    ambient_strength: float = 1.0
    """Strength of the light from everywhere: at 1, without sun, an open white matt surface is just white. Scales an HDRI too."""
    hdri: Path | None = None
    """Panorama (.hdr or .exr) that lights the tree in place of even white; set the sun's strength to 0 when it has its own sun."""
    device: Device = field(default="cpu", metadata=EXECUTION)
    """What Blender renders on."""
    workers: int = field(default=1, metadata=EXECUTION)
    """Blender processes at a time; the processor's threads are shared out among them."""
    seed: int = 0
    """Another seed gives other noise, and holds out other views."""
    axis: Axis = "auto"
    """Vertical line that the cameras circle: through the file's origin, or through the center of the tree's bounding box.
    Auto takes the origin where it lies inside the bounding box seen from above, as where the trunk stands on it, else the center."""

    def __post_init__(self) -> None:
        if not isinstance(self.elevations, tuple | list) or not self.elevations:
            raise InputTypeError(f"elevations: expected one or more angles, got {self.elevations!r}")
        for elevation in self.elevations:
            check_range("elevations", elevation, -90, 90)
        check_count("count", self.count, 2)
        if self.count < len(self.elevations):
            fail("count", f"expected at least one view for each of {len(self.elevations)} rings, got {self.count}")
        check_count("size", self.size, 11)
        check_range("size", self.size, 11, 16384)
        check_range("fov_degrees", self.fov_degrees, 1, 170)
        check_count("samples", self.samples)
        check_range("sun_strength", self.sun_strength, 0, 1e6)
        check_range("sun_azimuth", self.sun_azimuth, -360, 360)
        check_range("sun_elevation", self.sun_elevation, -90, 90)
        check_range("ambient_strength", self.ambient_strength, 0, 1e6)
        check_choice("device", self.device, ("cpu", "cuda", "optix", "hip", "oneapi", "metal"))
        check_count("workers", self.workers)
        check_count("seed", self.seed, 0)
        check_choice("axis", self.axis, ("auto", "origin", "center"))
