"""What rendering requires of this machine and of its options, for checks before long work begins."""

from __future__ import annotations

from pathlib import Path

from bbfit.blender.config import ViewsConfig
from bbfit.blender.processes import BlenderPool, require_bpy
from bbfit.checks import check_file


def check_blender(config: ViewsConfig) -> None:
    """Require that Blender is installed, that it supports the device and finds one, and that it can read the panorama.

    This starts Blender only for a device besides the CPU or for a panorama. Raises ``MissingFileError`` or ``InputError``.
    """
    if config.hdri is not None:
        check_file("hdri", config.hdri)
    require_bpy()
    if config.hdri is None and config.render_device == "cpu":
        return
    hdri = None if config.hdri is None else str(Path(config.hdri).resolve())
    with BlenderPool({"check": True, "device": config.render_device, "hdri": hdri}) as pool:
        pool.check()
