"""Pictures of one size with their cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from bbfit.checks import InputTypeError, check_shape, fail
from bbfit.geometry.camera import Camera
from bbfit.geometry.light import Light
from bbfit.images import premultiply, read_rgba, shrunk, to_bytes
from bbfit.inputs import InputLimits

# Views that suffice for a mean over all of them.
SAMPLED_VIEWS = 24


def evenly(indices: Sequence[int], most: int = SAMPLED_VIEWS) -> list[int]:
    """At most ``most`` of the indices of views, evenly spaced, from the first on."""
    count = min(most, len(indices))
    return [indices[number * len(indices) // count] for number in range(count)]


@dataclass(frozen=True)
class ViewSet:
    """V pictures of one size with their cameras."""

    paths: tuple[Path, ...]
    """The pictures' files, V of them; for pictures from arrays, names without a file."""
    cameras: Camera
    """V cameras, float64."""
    read: Callable[[Path], Tensor] = field(repr=False, compare=False)
    """Returns the picture of a path, uint8 [H, W, 4], straight alpha; it may be called from several threads."""
    light: Light | None = None
    """The V lights of the pictures; ``None`` if they are not known."""

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

    @staticmethod
    def of_files(paths: Sequence[Path], cameras: Camera) -> ViewSet:
        """Views from files of straight-alpha RGBA pictures, which are read when they are needed, with V cameras."""
        limits = InputLimits(max_input_pixels=cameras.width * cameras.height)
        return ViewSet(tuple(paths), cameras, lambda path: torch.from_numpy(read_rgba(path, limits)))

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def names(self) -> list[str]:
        """File names without folder and ending."""
        return [path.stem for path in self.paths]

    def take(self, indices: Sequence[int]) -> ViewSet:
        """Some of the views, which share the pictures in memory."""
        light = None if self.light is None else self.light[list(indices)]
        return ViewSet(tuple(self.paths[index] for index in indices), self.cameras[list(indices)], self.read, light)

    @staticmethod
    def joined(sets: Sequence[ViewSet]) -> ViewSet:
        """The views of several sets, whose pictures have one size and different paths, in one; the light is known if that of all is."""
        readers = {path: each.read for each in sets for path in each.paths}
        lights = [each.light for each in sets if each.light is not None]
        return ViewSet(
            tuple(path for each in sets for path in each.paths),
            Camera.joined([each.cameras for each in sets]),
            lambda path: readers[path](path),
            Light.joined(lights) if len(lights) == len(sets) else None,
        )

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

    def draw(self, camera: Camera) -> Tensor:
        """The picture of a single camera with the pose of one of the views, premultiplied RGBA in [0, 1], float64 [H, W, 4].

        A smaller picture than the view's is averaged by area. Raises InputError if no view has this pose or if the picture is larger.
        """
        same = (self.cameras.world_to_camera == camera.batch().world_to_camera.to(self.cameras.world_to_camera)).flatten(1).all(1)
        if not bool(same.any()):
            fail("camera", "no picture was taken from there", "give the camera of a view")
        return shrunk(self.targets([int(same.nonzero()[0])], torch.float64)[0], camera.width, camera.height)

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
