"""Trees with several meshes that are moved, turned and scaled in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from small_library import small_library

from bbfit.checks import InputError
from bbfit.forest.instances import Instances, placed_part
from bbfit.forest.placements import Placements, matrices
from bbfit.forest.prototypes import read_prototype
from bbfit.glb import glb_pieces, gltf_parts
from bbfit.inputs import InputLimits
from bbfit.library.manifest import Library

QUATERNION = Rotation.from_euler("xyz", [20, 30, -40], degrees=True).as_quat().tolist()
NODES = [
    {"children": [1, 2], "translation": [1, 2, 3], "rotation": QUATERNION},
    {"mesh": 0, "matrix": [2, 0, 0, 0, 0, 3, 0, 0, 0, 0, 0.5, 0, 4, 5, 6, 1]},
    {"mesh": 0, "scale": [1, -1, 1]},
]


def changed(folder: Path, nodes: list[dict[str, object]]) -> Library:
    """A library whose first tree has other nodes."""
    library = small_library(folder)
    path = folder / library.trees[0].levels[0].file
    document, binary = gltf_parts(path.read_bytes())
    path.write_bytes(b"".join(glb_pieces(document | {"nodes": nodes}, [binary])))
    return library


def composed(placed: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """The matrices of translations, rotations and scales, [P, 4, 4]."""
    found = np.zeros((len(placed["SCALE"]), 4, 4))
    found[:, :3, :3] = Rotation.from_quat(placed["ROTATION"]).as_matrix() * placed["SCALE"][:, None]
    found[:, :3, 3], found[:, 3, 3] = placed["TRANSLATION"], 1
    return found


def test_instances_have_the_places_of_their_meshes_in_the_tree(tmp_path: Path) -> None:
    parts = read_prototype(changed(tmp_path / "library", NODES), 0, 0, InputLimits()).parts
    outer = np.eye(4)
    outer[:3, :3], outer[:3, 3] = Rotation.from_quat(QUATERNION).as_matrix(), [1, 2, 3]
    inner = [np.array(NODES[1]["matrix"]).reshape(4, 4).T, np.diag([1.0, -1, 1, 1])]
    random = np.random.default_rng(0)
    positions, turns = random.random((20, 3)) * 100, (360 * random.random(20)).astype(np.float32)
    scales = random.uniform(0.5, 2, 20).astype(np.float32)
    placed = matrices(Placements(positions, turns, scales, np.zeros(20, np.int32))).reshape(-1, 4, 4).transpose(0, 2, 1)
    for part, own in zip(parts, inner, strict=True):
        found = composed(placed_part(part, Instances(positions, turns, scales[:, None].repeat(3, 1).astype(float))))
        np.testing.assert_allclose(found, placed.astype(float) @ outer @ own, atol=2e-5)


def test_wider_trees_keep_their_height(tmp_path: Path) -> None:
    part = read_prototype(changed(tmp_path / "library", [{"mesh": 0, "translation": [1, 2, 3]}]), 0, 0, InputLimits()).parts[0]
    placed = placed_part(part, Instances(np.zeros((1, 3)), np.zeros(1, np.float32), np.array([[4.0, 2.0, 4.0]])))
    assert placed["SCALE"].tolist() == [[4, 2, 4]] and placed["TRANSLATION"].tolist() == [[4, 4, 12]]


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([{"children": [1], "scale": [1, 2, 1]}, {"mesh": 0, "rotation": QUATERNION}], "a node is sheared"),
        ([{"children": [0]}], "nested too deeply"),
        ([{"mesh": 0, "scale": [0, 1, 1]}], "no usable matrix"),
        ([{"children": [7]}], "cannot be read"),
    ],
)
def test_unusable_nodes_are_refused(nodes: list[dict[str, object]], message: str, tmp_path: Path) -> None:
    library = changed(tmp_path / "library", nodes)
    with pytest.raises(InputError, match=f"^library: .*oak_LOD0.glb.*{message}"):
        read_prototype(library, 0, 0, InputLimits())
