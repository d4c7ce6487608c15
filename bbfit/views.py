"""Views of a tree: pictures, cameras and their split, read from a folder in the NeRF-synthetic layout."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from bbfit.blender.request import ViewsRequest
from bbfit.checks import MissingFileError, check_folder, fail
from bbfit.geometry.camera import Camera
from bbfit.images import premultiply, read_rgba
from bbfit.layout import REQUEST_FILE, Frame, cameras_of, read_frames, split_views

CACHE_BYTES = 3 << 29
"""Decoded pictures that a dataset keeps in memory at most, in bytes; the ones used longest ago go first."""


LEAST_PIXELS = 11
"""Least width and height of a picture: that of the window of the structural similarity."""


class _Cache:
    """Decoded pictures, least recently used out first; safe to use from several threads."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit, self._held, self._pictures = limit_bytes, 0, OrderedDict[Path, Tensor]()
        self._lock = threading.Lock()

    def get(self, path: Path) -> Tensor:
        with self._lock:
            if path in self._pictures:
                self._pictures.move_to_end(path)
                return self._pictures[path]
        picture = torch.from_numpy(read_rgba(path))
        if not picture[..., 3].any():
            fail("views", f"{path} is fully transparent", "render it anew or take it out of the transforms file")
        with self._lock:
            if path not in self._pictures:
                self._pictures[path] = picture
                self._held += picture.numel()
            while self._held > self._limit and len(self._pictures) > 1:
                self._held -= self._pictures.popitem(last=False)[1].numel()
        return picture


@dataclass(frozen=True)
class ViewSet:
    """V pictures of one size with their cameras."""

    paths: tuple[Path, ...]
    """The pictures' files, V of them."""
    cameras: Camera
    """V cameras, float64."""
    _cache: _Cache = field(repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def names(self) -> list[str]:
        """File names without folder and ending."""
        return [path.stem for path in self.paths]

    def take(self, indices: Sequence[int]) -> ViewSet:
        """Some of the views, with the same memory of pictures."""
        return ViewSet(tuple(self.paths[index] for index in indices), self.cameras[list(indices)], self._cache)

    def image(self, index: int) -> Tensor:
        """One picture, uint8 [H, W, 4], straight alpha. Do not write to it: it may be cached.

        Raises
        ------
        MissingFileError, InputError
            if the file is missing, damaged, without alpha, fully transparent or of another size than the rest.
        """
        path = self.paths[index]
        picture = self._cache.get(path)
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
        for index in range(len(self)):
            digest.update(sha256(self.image(index).numpy().tobytes()).digest())
        return digest.hexdigest()

    def check(self) -> None:
        """Decode every picture once, so that a bad one is found now and not in the middle of long work."""
        with ThreadPoolExecutor(torch.get_num_threads()) as pool:  # each thread keeps memory of its own
            for _ in pool.map(self.image, range(len(self))):
                pass


@dataclass(frozen=True)
class ViewDataset:
    """Training and test views of one tree.

    Pictures stay uint8 and are decoded when asked for; at most :data:`CACHE_BYTES` of them are kept.
    """

    folder: Path
    """Where the views lie."""
    train: ViewSet
    """Views to fit to."""
    test: ViewSet
    """Held-out views, for the final score only."""
    request: ViewsRequest | None = None
    """The request that ``bbfit views`` recorded in ``views.json``; ``None`` for views from elsewhere."""

    @staticmethod
    def load(folder: str | Path, *, seed: int = 0, cache_bytes: int = CACHE_BYTES) -> ViewDataset:
        """Read a folder of views: bbfit's own, any NeRF-synthetic scene, or one with nerfstudio's intrinsics.

        Parameters
        ----------
        seed : chooses the random quarter that becomes the test split where the folder has none.
        cache_bytes : bound on the decoded pictures kept in memory.

        Raises
        ------
        MissingFileError, InputError
            if there are no transforms, no usable camera, too few views, or pictures missing, unreadable, without alpha or of
            unequal size.
        """
        folder = check_folder("views", folder)
        train, test = read_frames(folder)
        if test is None and len(train) >= 2:
            train_indices, test_indices = split_views(len(train), seed)
            train, test = [train[i] for i in train_indices], [train[i] for i in test_indices]
        if not train or not test:
            fail("views", f"{folder} has {len(train)} training and {len(test or [])} test views", "at least one of each is needed")
        width, height = _common_size([*train, *test])
        if min(width, height) < LEAST_PIXELS:
            fail("views", f"{folder} has pictures of {width}x{height} pixels", f"give at least {LEAST_PIXELS}x{LEAST_PIXELS}")
        cache = _Cache(cache_bytes)

        def view_set(frames: list[Frame]) -> ViewSet:
            return ViewSet(tuple(frame.image for frame in frames), cameras_of(frames, width, height), cache)

        request = ViewsRequest.load(folder / REQUEST_FILE) if (folder / REQUEST_FILE).is_file() else None
        return ViewDataset(folder, view_set(train), view_set(test), request)

    @property
    def fingerprint(self) -> str:
        """SHA-256 over both splits' fingerprints."""
        return sha256((self.train.fingerprint + self.test.fingerprint).encode()).hexdigest()


def _common_size(frames: list[Frame]) -> tuple[int, int]:
    """Width and height that all pictures share; only headers are read."""
    first: tuple[Path, tuple[int, int]] | None = None
    for path in (frame.image for frame in frames):
        if not path.is_file():
            raise MissingFileError(f"views: {path} does not exist; render the views anew or take it out of the transforms file")
        try:
            with Image.open(path) as picture:
                size, bands = picture.size, picture.getbands()
        except (UnidentifiedImageError, OSError):
            fail("views", f"{path} is damaged or no picture", "render or copy it anew")
        if "A" not in bands and "transparency" not in picture.info:
            fail("views", f"{path} has no alpha channel", "give straight-alpha RGBA images")
        if first is None:
            first = path, size
        elif size != first[1]:
            fail("views", f"{path} is {size[0]}x{size[1]}, {first[0].name} {first[1][0]}x{first[1][1]}", "make all views one size")
    assert first is not None
    return first[1]
