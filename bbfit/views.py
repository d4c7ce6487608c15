"""Views of a tree: pictures, cameras and their split, read from a folder in the NeRF-synthetic layout or made from arrays."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from cachetools import LRUCache, cached
from numpy.typing import NDArray
from torch import Tensor

from bbfit.blender.request import ViewsRequest
from bbfit.checks import InputTypeError, MissingFileError, check_folder, check_shape, fail
from bbfit.geometry.camera import Camera
from bbfit.images import picture_header, premultiply, read_rgba, to_bytes
from bbfit.inputs import InputLimits
from bbfit.layout import REQUEST_FILE, Frame, cameras_of, read_frames, read_turned, split_views

_LIMITS = InputLimits()
CACHE_BYTES = 3 << 29
"""Most bytes of decoded pictures that a dataset keeps in memory; it drops the least recently used ones first."""


LEAST_PIXELS = 11
"""Least width and height of a picture: that of the window of the structural similarity."""


@dataclass(frozen=True)
class ViewSet:
    """V pictures of one size with their cameras."""

    paths: tuple[Path, ...]
    """The pictures' files, V of them; for pictures from arrays, names without a file."""
    cameras: Camera
    """V cameras, float64."""
    read: Callable[[Path], Tensor] = field(repr=False, compare=False)
    """Returns the picture of a path, uint8 [H, W, 4], straight alpha; it may be called from several threads."""

    @staticmethod
    def from_arrays(images: NDArray[Any] | Tensor, cameras: Camera) -> ViewSet:
        """Views from straight-alpha RGBA pictures, [V, H, W, 4], with V cameras, which are named 0000, 0001 and so on.

        Pictures are uint8, or floats in [0, 1], which are rounded to 8 bits. Other shapes, types and values raise ``InputError``.
        """
        pictures = torch.as_tensor(images).detach().cpu()
        cameras = cameras.batch().to(torch.float64).to("cpu")
        check_shape("images", tuple(pictures.shape), (len(cameras), cameras.height, cameras.width, 4))
        if pictures.is_floating_point():
            if not bool(((pictures >= 0) & (pictures <= 1)).all()):
                fail("images", "floats are not all in [0, 1]", "divide 8-bit values by 255, or give uint8")
            pictures = torch.from_numpy(to_bytes(pictures))
        if pictures.dtype != torch.uint8:
            raise InputTypeError(f"images: expected uint8 or floats, got {pictures.dtype}")
        paths = [Path(f"{index:04}.png") for index in range(len(pictures))]
        return ViewSet(tuple(paths), cameras, dict(zip(paths, pictures, strict=True)).__getitem__)

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def names(self) -> list[str]:
        """File names without folder and ending."""
        return [path.stem for path in self.paths]

    def take(self, indices: Sequence[int]) -> ViewSet:
        """Some of the views, which share the pictures in memory."""
        return ViewSet(tuple(self.paths[index] for index in indices), self.cameras[list(indices)], self.read)

    def image(self, index: int) -> Tensor:
        """One picture, uint8 [H, W, 4], straight alpha. Do not write to it: it may be cached.

        Raises ``MissingFileError`` or ``InputError`` if the file is missing, damaged, without alpha or not of the others' size, or fully
        transparent in views from elsewhere.
        """
        path = self.paths[index]
        picture = self.read(path)
        expected = (self.cameras.height, self.cameras.width)
        if tuple(picture.shape[:2]) != expected:
            fail("views", f"{path} is {picture.shape[1]}x{picture.shape[0]}, others {expected[1]}x{expected[0]}", "make them equal")
        return picture

    def images(self, indices: Sequence[int]) -> Tensor:
        """Several pictures, uint8 [B, H, W, 4], straight alpha."""
        return torch.stack([self.image(i) for i in indices])

    def targets(self, indices: Sequence[int], dtype: torch.dtype = torch.float32) -> Tensor:
        """Several pictures as the renderer would draw them: premultiplied RGBA in [0, 1], [B, H, W, 4]."""
        return premultiply(self.images(indices).to(dtype) / 255)

    @property
    def fingerprint(self) -> str:
        """SHA-256 over the cameras and the pictures' pixels: equal for equal views, wherever they lie and however they were packed."""
        digest = sha256(repr((self.cameras.width, self.cameras.height, self.cameras.orthographic)).encode())
        digest.update(self.cameras.world_to_camera.numpy().tobytes() + self.cameras.intrinsics.numpy().tobytes())
        pictures = dict[Path, bytes]()  # several views may show one picture
        for index, path in enumerate(self.paths):
            if path not in pictures:
                pictures[path] = sha256(self.image(index).numpy().tobytes()).digest()
            digest.update(pictures[path])
        return digest.hexdigest()

    def shows(self, index: int) -> bool:
        """Whether a picture has a pixel that is not fully transparent. Raises the errors of :meth:`image`."""
        return bool(self.image(index)[..., 3].any())

    def check(self, *, may_be_empty: bool = False) -> None:
        """Decode every picture once, so that a bad one is reported before long work begins.

        Raises the errors of :meth:`image`, and ``InputError`` if all pictures are fully transparent, unless they may be.
        """
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # each thread keeps memory of its own
            shown = list(pool.map(self.shows, {path: index for index, path in enumerate(self.paths)}.values()))
        if not any(shown) and not may_be_empty:
            fail(
                "views",
                f"none of {len(self)} training pictures shows anything of the tree",
                "it is thinner than their pixels or its materials are transparent; give a larger --size or more --samples, or mend them",
            )


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
        pairs = read_turned(folder, test, limits)
        width, height = _common_size([*train, *test, *(frame for _, frame in pairs)], limits)
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
            return ViewSet(tuple(frame.image for frame in frames), cameras_of(frames, width, height), read)

        turned = TurnedViews(view_set([test[index] for index, _ in pairs]), view_set([frame for _, frame in pairs])) if pairs else None
        return ViewDataset(folder, view_set(train), view_set(test), request, turned)

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

    @property
    def fingerprint(self) -> str:
        """SHA-256 over both splits' fingerprints; the second pictures of ``turned`` do not count."""
        return sha256((self.train.fingerprint + self.test.fingerprint).encode()).hexdigest()


def _is_own(request: ViewsRequest | None) -> bool:
    return request is not None and request.complete and request.camera is not None


def _check_size(name: str, pictures: str, width: int, height: int) -> None:
    if min(width, height) < LEAST_PIXELS:
        fail(name, f"{pictures} have {width}x{height} pixels", f"give at least {LEAST_PIXELS}x{LEAST_PIXELS}")


def _common_size(frames: list[Frame], limits: InputLimits) -> tuple[int, int]:
    """Width and height that all pictures share; only headers are read."""
    first: tuple[Path, tuple[int, int]] | None = None
    for path in dict.fromkeys(frame.image for frame in frames):
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
