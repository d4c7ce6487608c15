"""Views of a tree: pictures, cameras and their split, read from a folder in the NeRF-synthetic layout or made from arrays."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from cachetools import LRUCache, cached
from numpy.typing import NDArray
from torch import Tensor

from bbfit.blender.request import ViewsRequest
from bbfit.checks import MissingFileError, check_folder, fail
from bbfit.geometry.camera import Camera
from bbfit.geometry.light import Light
from bbfit.images import picture_header, read_rgba
from bbfit.inputs import InputLimits
from bbfit.layout import REQUEST_FILE, Frame, cameras_of, read_frames, read_lit, read_turned, split_views
from bbfit.views.lit import LitViews
from bbfit.views.view_set import ViewSet

_LIMITS = InputLimits()
CACHE_BYTES = 3 << 29
"""Most bytes of decoded pictures that a dataset keeps in memory; it drops the least recently used ones first."""
LEAST_PIXELS = 11
"""Least width and height of a picture: that of the window of the structural similarity."""


@dataclass(frozen=True)
class TurnedViews:
    """Pairs of pictures from neighboring cameras: V held-out views, and as many from cameras that are turned by one degree."""

    views: ViewSet
    """Views from the test split."""
    turned: ViewSet
    """The second picture of each, in the same order."""


@dataclass(frozen=True)
class ViewDataset:
    """Training and test views of one tree.

    Pictures stay uint8. Those of files are decoded when they are first used, and :data:`CACHE_BYTES` bounds how many stay in memory.
    """

    folder: Path | None
    """Folder of the views; None for views from arrays."""
    train: ViewSet
    """Views to fit to."""
    test: ViewSet
    """Held-out views, for the final score only."""
    request: ViewsRequest | None = None
    """The request that ``bbfit views`` recorded in ``views.json``; ``None`` for views from elsewhere."""
    turned: TurnedViews | None = None
    """Some of the held-out views with a second picture of each (``ViewsConfig.turned``), for the score of shimmer; ``None`` for views
    without."""
    lit_train: LitViews | None = None
    """The training cameras under one light at a time (``ViewsConfig.suns``); ``None`` for views without."""
    lit_test: LitViews | None = None
    """The held-out cameras under lights that no training camera saw."""

    @staticmethod
    def load(folder: str | Path, *, seed: int = 0, cache_bytes: int = CACHE_BYTES, limits: InputLimits = _LIMITS) -> ViewDataset:
        """Read a folder of views: bbfit's own, any NeRF-synthetic scene, or one with nerfstudio's intrinsics.

        Of bbfit's own pictures some may be fully transparent: a flat tree is invisible to a camera that sees it edge-on.

        Parameters
        ----------
        folder
            Folder with one or two transforms files.
        seed
            Seed of the random quarter that becomes the test split if the folder has none.
        cache_bytes
            Most bytes of decoded pictures that stay in memory.
        limits
            How many views and pixels there may be, and in which folders besides ``folder`` pictures may lie.

        Raises
        ------
        MissingFileError, InputError
            If there are no transforms, no usable camera, too few views, or pictures missing, unreadable, without alpha or of unequal size.
            If a picture lies outside of the allowed folders, or something exceeds the limits.
        """
        folder = check_folder("views", folder)
        train, test = read_frames(folder, limits)
        if test is None and len(train) >= 2:
            train_indices, test_indices = split_views(len(train), seed)
            train, test = [train[i] for i in train_indices], [train[i] for i in test_indices]
        if not train or not test:
            fail("views", f"{folder} has {len(train)} training and {len(test or [])} test views", "at least one of each is needed")
        pairs, lit = read_turned(folder, test, limits), read_lit(folder, limits)
        lit_frames = [frame for frames in lit or () for frame in frames]
        pictures = [frame.image for frame in [*train, *test, *(frame for _, frame in pairs), *lit_frames]]
        width, height = _common_size([*pictures, *(path for frame in lit_frames for path in frame.passes.values())], limits)
        _check_size("views", f"pictures in {folder}", width, height)

        request = ViewsRequest.load(folder / REQUEST_FILE) if (folder / REQUEST_FILE).is_file() else None
        own = _is_own(request)

        @cached(LRUCache(cache_bytes, getsizeof=Tensor.numel), lock=threading.Lock())
        def read(path: Path) -> Tensor:
            picture = torch.from_numpy(read_rgba(path, limits))
            if not own and not picture[..., 3].any():
                fail("views", f"{path} is fully transparent", "render it anew or take it out of the transforms file")
            return picture

        def view_set(frames: list[Frame]) -> ViewSet:
            lights = [frame.light for frame in frames if frame.light is not None]
            light = Light.joined(lights) if len(lights) == len(frames) else None
            return ViewSet(tuple(frame.image for frame in frames), cameras_of(frames, width, height), read, light)

        def lit_views(frames: list[Frame]) -> LitViews:
            return _lit_views(frames, folder, view_set)

        turned = TurnedViews(view_set([test[index] for index, _ in pairs]), view_set([frame for _, frame in pairs])) if pairs else None
        return ViewDataset(folder, view_set(train), view_set(test), request, turned, *(map(lit_views, lit) if lit else ()))

    @staticmethod
    def from_arrays(images: NDArray[Any] | Tensor, cameras: Camera, *, test: Sequence[int] | None = None, seed: int = 0) -> ViewDataset:
        """A dataset from pictures in memory.

        Parameters
        ----------
        images, cameras
            As for :meth:`ViewSet.from_arrays`; no picture may be fully transparent.
        test
            Indices of the held-out views. Default: a random quarter.
        seed
            Seed of that quarter.

        Raises
        ------
        InputError
            If a picture cannot be used, there are fewer than two, or no view is left for training or for the test.
        """
        views = ViewSet.from_arrays(images, cameras)
        if len(views) < 2:
            fail("images", f"expected at least two views, got {len(views)}")
        held = split_views(len(views), seed)[1] if test is None else sorted({int(index) for index in test})
        rest = [index for index in range(len(views)) if index not in held]
        if not held or not rest or not 0 <= held[0] <= held[-1] < len(views):
            fail("test", f"expected some of the indices 0 to {len(views) - 1}, not all, got {held}")
        _check_size("images", "they", views.cameras.width, views.cameras.height)
        if empty := [index for index in range(len(views)) if not views.image(index)[..., 3].any()]:
            fail("images", f"view {empty[0]} is fully transparent", "leave it out")
        return ViewDataset(None, views.take(rest), views.take(held))

    @property
    def own(self) -> bool:
        """Whether bbfit rendered the views."""
        return _is_own(self.request)

    def check(self) -> None:
        """Decode every picture once. Raises the errors of :meth:`ViewSet.check`. Of the held-out pictures, all may be empty."""
        self.train.check()
        self.test.check(may_be_empty=True)
        if self.turned is not None:
            self.turned.turned.check(may_be_empty=True)
        if self.lit_test is not None:
            for pictures in (self.lit_test.skies, self.lit_test.suns, self.lit_test.albedo, self.lit_test.normal):
                if pictures is not None:
                    pictures.check(may_be_empty=True)

    @property
    def fingerprint(self) -> str:
        """SHA-256 over both splits' fingerprints; the second pictures of ``turned`` do not count."""
        return sha256((self.train.fingerprint + self.test.fingerprint).encode()).hexdigest()

    @property
    def full_fingerprint(self) -> str:
        """SHA-256 over the fingerprints of all that scores depend on: also of ``turned``, ``lit_test``, and the light of the views."""
        turned = "" if self.turned is None else self.turned.views.fingerprint + self.turned.turned.fingerprint
        lit = "" if self.lit_test is None else self.lit_test.fingerprint
        light = "" if self.test.light is None else self.test.light.fingerprint
        return sha256(" ".join((self.fingerprint, turned, lit, light)).encode()).hexdigest()


def _is_own(request: ViewsRequest | None) -> bool:
    return request is not None and request.complete and request.camera is not None


def _check_size(name: str, pictures: str, width: int, height: int) -> None:
    if min(width, height) < LEAST_PIXELS:
        fail(name, f"{pictures} have {width}x{height} pixels", f"give at least {LEAST_PIXELS}x{LEAST_PIXELS}")


def _lit_views(frames: list[Frame], folder: Path, view_set: Callable[[list[Frame]], ViewSet]) -> LitViews:
    """Match the pictures under single suns with those of the same cameras under the sky."""
    skies, suns = list[Frame](), list[Frame]()
    for frame in frames:
        (skies if frame.light is not None and float(frame.light.ambients) > 0 else suns).append(frame)
    places = {_camera_key(frame): place for place, frame in enumerate(skies)}
    for frame in suns:
        if _camera_key(frame) not in places:
            fail("views", f"{frame.image} has no picture of the same camera under the sky", "add one, or take it out of the file")
    if not suns:
        fail("views", f"{folder} has a transforms_lights file without a picture under a sun", "render the views anew")
    passes = []
    for name in ("albedo", "normal"):
        paths = [frame.passes.get(name) for frame in skies]
        known = [replace(frame, image=path) for frame, path in zip(skies, paths, strict=True) if path is not None]
        passes.append(view_set(known) if len(known) == len(skies) else None)
    return LitViews(view_set(skies), view_set(suns), tuple(places[_camera_key(frame)] for frame in suns), *passes)


def _camera_key(frame: Frame) -> str:
    return repr((frame.camera_to_world, {name: value for name, value in frame.header.items() if name not in ("file_path", "turned_from")}))


def _common_size(paths: list[Path], limits: InputLimits) -> tuple[int, int]:
    """Width and height that all pictures share; only headers are read."""
    first: tuple[Path, tuple[int, int]] | None = None
    for path in dict.fromkeys(paths):
        if not path.is_file():
            raise MissingFileError(f"views: {path} does not exist; render the views anew or take it out of the transforms file")
        header = picture_header("views", path, limits)
        if header is None:
            fail("views", f"{path} is damaged or no picture", "render or copy it anew")
        if not header.alpha:
            fail("views", f"{path} has no alpha channel", "give straight-alpha RGBA images")
        size = header.width, header.height
        if first is None:
            first = path, size
        elif size != first[1]:
            fail("views", f"{path} is {size[0]}x{size[1]}, {first[0].name} {first[1][0]}x{first[1][1]}", "make all views one size")
    assert first is not None
    return first[1]
