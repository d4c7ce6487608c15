"""The tree itself as a file that ships: thinned out to a number of triangles or bytes, with vertices of integers on request."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path

from bbfit.blender.conversion import check_converted, tree_as_glb
from bbfit.checks import fail
from bbfit.exporting.config import ThinConfig
from bbfit.exporting.vertex_formats import quantized_tree
from bbfit.files import write_bytes
from bbfit.glb import joined_glb, split_glb
from bbfit.images import smaller_picture
from bbfit.inputs import InputLimits
from bbfit.scratch import ScratchFolder
from bbfit.tree_files.tree_file import TreeFile

ATTEMPTS = 5
"""Most conversions until a size in bytes is filled."""
# A size is filled if at least this share of it is used. Each attempt aims a little below it. Roughly how many bytes a triangle takes.
_CLOSE, _AIM, _TRIANGLE = 0.95, 0.98, 50
# Texels of a side that pictures may have if a size in bytes decides.
_SIDES = tuple(2**power for power in range(14, 5, -1))
_log = logging.getLogger(__name__)


def thin_tree(
    tree: str | Path | TreeFile,
    out: str | Path,
    config: ThinConfig,
    *,
    limits: InputLimits | None = None,
    on_progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write a tree with fewer and larger leaves on simpler branches as one GLB file, Y up in meters.

    How leaves and twigs are chosen is described in :func:`~bbfit.blender.conversion.tree_as_glb`. The materials stay, and need lights.

    Parameters
    ----------
    tree
        A tree in any format that Blender reads (:func:`~bbfit.blender.conversion.tree_as_glb`).
    out
        The .glb file to write, in an existing folder. It is replaced atomically.
    config
        The largest number of bytes, of triangles, or both. A tree that has no more stays whole.
    limits
        How large the tree may be, and what it may refer to.
    on_progress
        Called with the number of attempts to fill a size, and the most of them.

    Returns
    -------
    Path
        ``out``.

    Raises
    ------
    MissingFileError, InputError
        If the tree cannot be used, there is no limit, or the tree cannot have so few bytes. Also the other errors of ``tree_as_glb``.
    BlenderError
        If Blender crashes.
    """
    out, size = Path(out), config.most_bytes
    tree = TreeFile.open(tree, limits or InputLimits())
    check_thin(tree, out, config)
    model = thinned(
        tree, triangles=config.triangles, size=size, side=config.texture_size, quantized=config.integers, on_attempt=on_progress
    )
    if size is not None and len(model) > size:
        fail(
            "bytes",
            f"{size:,} are too few for {tree.path}, which has at least {len(model):,} with its textures",
            "allow more, or a smaller texture_size" if config.texture_size else "allow more",
        )
    write_bytes(out, model)
    return out


def check_thin(tree: TreeFile, out: Path, config: ThinConfig) -> None:
    """Raise the errors of :func:`thin_tree` that are known before any work."""
    if config.bytes is None and config.triangles is None:
        fail("thin", "a limit is missing", "for example --bytes 2M, or --triangles 20000")
    check_converted(tree, out)


def thinned(
    tree: TreeFile,
    *,
    triangles: int | None = None,
    size: int | None = None,
    side: int | None = None,
    quantized: bool,
    on_attempt: Callable[[int, int], None] | None = None,
) -> bytes:
    """The GLB of a tree with at most so many triangles, bytes, and texels a ``side`` of its pictures; see :class:`ThinConfig`.

    It is the smallest possible one if it cannot have so few bytes.
    """
    on_attempt, pictures = on_attempt or (lambda done, total: None), SmallerPictures(side, None if size is None else size // 2)
    with ScratchFolder() as folder:

        def convert(count: int | None) -> bytes:
            return pictures(convert_tree(tree, folder / "tree.glb", triangles=count, quantized=quantized).read_bytes())

        if size is None:
            on_attempt(0, 1)
            model = convert(triangles)
            on_attempt(1, 1)
        else:
            model = filled(convert, size, triangles, on_attempt)
    if side is None and pictures.changed:
        _log.warning("pictures have at most %d texels a side; give --texture-size for others, or allow more bytes", pictures.side)
    return model


class SmallerPictures:
    """Gives the GLBs of one tree smaller pictures."""

    def __init__(self, side: int | None, size: int | None) -> None:
        """With at most ``side`` texels a side; or of the most, out of powers of two, with which they have at most ``size`` bytes."""
        self.side, self.changed = side, False
        self._size, self._smaller = size, cache(smaller_picture)

    def __call__(self, glb: bytes) -> bytes:
        """The GLB with smaller pictures."""
        tree, views = split_glb(glb)
        places = {image["bufferView"] for image in tree.get("images", ()) if "bufferView" in image}
        if self.side is None and self._size is not None:
            sizes = ((side, sum(len(self._smaller(views[place], side)) for place in places)) for side in _SIDES)
            self.side = next((side for side, size in sizes if size <= self._size), _SIDES[-1])
        if self.side is None:
            return glb
        made = [self._smaller(view, self.side) if place in places else view for place, view in enumerate(views)]
        self.changed = made != views
        return joined_glb(tree, made) if self.changed else glb


def filled(convert: Callable[[int], bytes], size: int, most: int | None, on_attempt: Callable[[int, int], None]) -> bytes:
    """The largest conversion to a number of triangles, at most ``most``, that has at most ``size`` bytes; else the smallest one.

    The number is found by the secant method.
    """
    models, counts, triangles = list[bytes](), list[int](), size // _TRIANGLE
    while len(models) < ATTEMPTS and (triangles := max(1, min(triangles, most or triangles))) not in counts:
        on_attempt(len(models), ATTEMPTS)
        models.append(convert(triangles))
        counts.append(triangles)
        bytes_now = len(models[-1])
        if _CLOSE * size <= bytes_now <= size or bytes_now in map(len, models[:-1]):  # close, or the tree has no more or no fewer
            break
        # The bytes of a triangle: those of the first file with its materials, later those by which files differ.
        each = bytes_now / triangles if len(counts) < 2 else (bytes_now - len(models[-2])) / (triangles - counts[-2])
        triangles = int(triangles + (_AIM * size - bytes_now) / each) if each > 0 else triangles // 2
    on_attempt(ATTEMPTS, ATTEMPTS)
    fitting = [model for model in models if len(model) <= size]
    return max(fitting, key=len) if fitting else min(models, key=len)


def convert_tree(tree: TreeFile, out: Path, *, triangles: int | None = None, quantized: bool = False) -> Path:
    """Do what :func:`~bbfit.blender.conversion.tree_as_glb` does; with ``quantized``, vertices are integers."""
    path = tree_as_glb(tree, out, triangles=triangles)
    if quantized:
        write_bytes(path, quantized_tree(path.read_bytes()))
    return path
