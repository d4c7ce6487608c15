"""Height fields: wavelets that lose nothing on any shape, patches that are height fields, and a code that decodes to the surface."""

from __future__ import annotations

import io
from pathlib import Path

import DracoPy
import numpy as np
import pytest
import trimesh

from bbfit.checks import InputError
from bbfit.rivals.draco import draco_geometry_bytes, draco_size
from bbfit.rivals.height_fields import decoded, height_fields
from bbfit.rivals.mesh_parts import tree_parts
from bbfit.rivals.shape_wavelets import band_of, restored, transformed
from bbfit.rivals.surface_patches import CONE, linked, scaled_normals, surface_patches
from bbfit.tree_files.tree_file import TreeFile

TREE = Path(__file__).resolve().parents[2] / "data" / "tree.glb"


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (8, 9), (33, 20)])
@pytest.mark.parametrize("share", [0.2, 0.6, 1.0])
@pytest.mark.parametrize("levels", [1, 3])
def test_wavelets_restore_every_pixel_of_any_shape(shape: tuple[int, int], share: float, levels: int) -> None:
    random = np.random.default_rng(0)
    mask = random.random(shape) <= share
    picture = random.integers(-900, 900, shape).astype(np.int32)
    coefficients = transformed(picture, mask, levels)
    assert not coefficients[~mask].any()
    assert (restored(coefficients, mask, levels) == np.where(mask, picture, 0)).all()


def test_slopes_leave_details_at_the_border_only() -> None:
    """5/3 predicts a plane without error where both neighbors are there. Rounding halves gives details of one step at most."""
    rows, columns = np.mgrid[:32, :48]
    mask = np.hypot(rows - 16, columns - 24) < 15
    coefficients = transformed((12 * rows + 8 * columns).astype(np.int32), mask, 2)
    inner = np.hypot(rows - 16, columns - 24) < 8
    bands = band_of(32, 48, 2)
    assert abs(coefficients[inner & (bands < 2)]).max() <= 1
    assert abs(coefficients[inner & (bands == 2)]).max() > 100


def test_patches_of_a_tube_face_one_way_each_and_are_connected() -> None:
    tube = trimesh.creation.cylinder(radius=1.0, height=8.0, sections=24)
    links = linked(np.asarray(tube.faces, np.int64))
    assert {tuple(sorted(pair)) for pair in links.tolist()} == {tuple(sorted(pair)) for pair in tube.face_adjacency.tolist()}
    patches = surface_patches(np.asarray(tube.triangles, np.float64), links)
    normals = scaled_normals(np.asarray(tube.triangles, np.float64))
    assert 5 <= patches.max() + 1 <= 8  # two ends, and at least three parts of the wall
    for patch in range(patches.max() + 1):
        chosen = patches == patch
        mean = normals[chosen].sum(0)
        directions = normals[chosen] / np.linalg.norm(normals[chosen], axis=-1, keepdims=True)
        assert (directions @ (mean / np.linalg.norm(mean))).min() >= CONE
        (pieces,) = {len(trimesh.graph.connected_components(links[chosen[links].all(-1)], nodes=np.nonzero(chosen)[0]))}
        assert pieces == 1


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    mesh = trimesh.creation.icosphere(4)
    mesh.apply_translation([3.0, 1.0, 0.0])
    mesh.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(baseColorFactor=[200, 10, 10, 255]))
    path = tmp_path_factory.mktemp("ball") / "ball.glb"
    mesh.export(path)
    return path


def test_a_ball_decodes_to_a_ball(ball: Path) -> None:
    """Within a quarter of a cell, half a step of rounding and what a cell's slope adds; finer cells are nearer and take more bytes."""
    fine, coarse = height_fields(ball, 0.02), height_fields(ball, 0.08)
    assert fine.error < 0.012 and 3 * fine.error < coarse.error < 0.05
    assert len(coarse.data) < len(fine.data) / 4
    (mesh,) = trimesh.load_scene(io.BytesIO(fine.glb), file_type="glb", process=False).geometry.values()
    assert len(mesh.faces) == 2 * fine.samples
    radii = np.linalg.norm(np.asarray(mesh.vertices) - [3.0, 1.0, 0.0], axis=1)
    assert abs(radii - 1).max() < 0.04 and abs(radii - 1).mean() < 0.005
    assert mesh.area == pytest.approx(4 * np.pi, rel=0.1)
    outward = (mesh.face_normals * (mesh.triangles_center - [3.0, 1.0, 0.0])).sum(-1)
    assert (outward > 0).all()
    assert list(mesh.visual.material.baseColorFactor) == [200, 10, 10, 255]


def test_the_code_contains_all_that_a_decoder_needs() -> None:
    coded = height_fields(TREE, 0.05)
    parts = decoded(coded.data, [part.material for part in tree_parts(TreeFile.open(TREE))])
    scene = trimesh.load_scene(io.BytesIO(coded.glb), file_type="glb", process=False)
    assert sum(len(part.faces) for part in parts) == sum(len(mesh.faces) for mesh in scene.geometry.values()) == 2 * coded.samples
    low, high = trimesh.load_scene(TREE).bounds
    assert (scene.bounds[0] > low - 0.1).all() and (scene.bounds[1] < high + 0.1).all()
    assert (scene.bounds[0] < low + 0.2).all() and (scene.bounds[1] > high - 0.2).all()


def test_draco_takes_as_many_bits_as_an_error_allows(ball: Path) -> None:
    """A ball of diameter 2 with an error of 1 / 2 ** 8 takes 8 bits a coordinate. Another bit halves the error."""
    sizes = [draco_geometry_bytes(ball, 2.0**-bits) for bits in (8, 9)]
    mesh = tree_parts(TreeFile.open(ball))[0]
    assert sizes == [
        len(DracoPy.encode(mesh.points.astype(np.float32), mesh.faces, quantization_bits=bits, compression_level=10)) for bits in (8, 9)
    ]
    assert sizes[0] < sizes[1] < draco_size(ball).bytes


@pytest.mark.parametrize("spacing", [0.0, -1.0, float("inf"), float("nan")])
def test_a_spacing_that_is_none_is_refused(spacing: float, ball: Path) -> None:
    with pytest.raises(InputError, match="spacing"):
        height_fields(ball, spacing)
