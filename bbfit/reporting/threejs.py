"""three.js for the project's pages, and the script with which they draw models."""

from __future__ import annotations

import math
from functools import lru_cache
from importlib.resources import files
from typing import Any

from bbfit.geometry.light import Light, angles_degrees


@lru_cache(maxsize=1)
def library_page() -> str:
    """A page that defines three.js (r140), with its GLTF loader, as the global ``THREE``.

    It is the page that trimesh makes of a scene, unchanged. The project's pages load it in a hidden frame and draw with its ``THREE``.
    """
    import trimesh
    from trimesh.viewer import scene_to_html

    page: str = scene_to_html(trimesh.Scene(trimesh.creation.box()))
    return page


def drawing_script() -> str:
    """The JavaScript that the report and the viewer share: it defines the global ``bbfit``."""
    return (files("bbfit.reporting") / "page" / "drawing.js").read_text(encoding="utf-8")


def page_light(light: Light) -> dict[str, Any]:
    """A light, a batch of one, for three.js: the sun's azimuth and height in degrees, its color, and the intensities of sun and sky."""
    azimuth, elevation = angles_degrees(light.sun_directions[0])
    # A white matte surface returns its irradiance over pi, in Blender's sun and sky as in three.js's lights.
    return {
        "azimuth": azimuth,
        "height": elevation,
        "sun": float(light.sun_strengths),
        "sky": math.pi * float(light.ambients),
        "color": light.sun_colors[0].tolist(),
    }
