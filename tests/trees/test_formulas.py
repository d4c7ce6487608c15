"""Formulas, rotations and outlines of leaves: the values that the paper gives, and those that follow."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from plain_tree import ROUNDING, angles, grown, plain

from bbfit.trees.formulas import in_envelope, shape_ratio, stem_radius
from bbfit.trees.leaf_shapes import leaf_shape
from bbfit.trees.skeleton import rotation, rotation_about
from bbfit.trees.species import load_species


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        (0, [0.2, 0.4, 0.6, 0.76, 1.0]),
        (1, [0.2, 0.2 + 0.8 * math.sin(math.pi / 4), 1.0, 0.2 + 0.8 * math.sin(0.7 * math.pi), 0.2]),
        (2, [0.2, 0.2 + 0.8 * math.sin(math.pi / 8), 0.2 + 0.8 * math.sqrt(0.5), 0.2 + 0.8 * math.sin(0.35 * math.pi), 1.0]),
        (3, [1.0, 1.0, 1.0, 1.0, 1.0]),
        (4, [0.5, 0.625, 0.75, 0.85, 1.0]),
        (5, [0.0, 0.25 / 0.7, 0.5 / 0.7, 1.0, 0.0]),
        (6, [1.0, 0.8, 0.6, 0.44, 0.2]),
        (7, [0.5, 0.5 + 0.125 / 0.7, 0.5 + 0.25 / 0.7, 1.0, 0.5]),
    ],
)
def test_shape_ratio_has_the_paper_s_values(shape: int, expected: list[float]) -> None:
    ratio = np.array([0, 0.25, 0.5, 0.7, 1])
    assert np.abs(shape_ratio(shape, ratio, plain()) - expected).max() < ROUNDING


def test_pruning_envelope_is_widest_at_its_peak_and_nothing_outside() -> None:
    species = plain(prune_width_peak=0.4, prune_power_low=0.5, prune_power_high=2.0)
    # By share of the height from the top; the peak is 0.4 of the height above the envelope's foot.
    ratio = np.array([-0.1, 0, 0.3, 0.6, 0.9, 1, 1.1])
    expected = [0, 0, 0.25, 1, math.sqrt(0.25), 0, 0]
    assert np.abs(shape_ratio(8, ratio, species) - expected).max() < ROUNDING
    wide = replace(species, prune_width=0.3)  # of a tree of 20 m whose lowest fifth is bare
    peak = 20 - 0.6 * 20 * 0.8
    points = np.array([[5.9, 0, peak], [0, 6.1, peak], [0, 0, 3.9], [0, 0, 20.1]])
    assert in_envelope(wide, 20.0, points).tolist() == [True, False, False, False]


def paper_radius(taper: float, radius: float, length: float, z: float) -> float:
    """Section 4.4, line by line."""
    unit = taper if taper < 1 else 2 - taper if taper < 2 else 0
    cone = radius * (1 - unit * z)
    if taper < 1:
        return cone
    z2 = (1 - z) * length
    depth = 1 if taper < 2 or z2 < cone else taper - 2
    z3 = z2 if taper < 2 else abs(z2 - 2 * cone * int(z2 / (2 * cone) + 0.5))
    if taper < 2 and z3 >= cone:
        return cone
    return (1 - depth) * cone + depth * math.sqrt(max(cone**2 - (z3 - cone) ** 2, 0))


@pytest.mark.parametrize("taper", [0, 0.5, 1, 1.5, 2, 2.5, 3])
def test_radius_falls_off_by_taper(taper: float) -> None:
    shares = np.linspace(0, 1, 101)
    got = stem_radius(plain(taper=(taper,) * 4), 0, np.array(0.13), np.array(2.0), shares)
    assert np.abs(got - [paper_radius(taper, 0.13, 2.0, z) for z in shares]).max() < ROUNDING
    ends = {0: (0.13, 0.13), 0.5: (0.13, 0.065), 1: (0.13, 0), 1.5: (0.13, 0), 2: (0.13, 0)}
    if taper in ends:
        assert got[[0, -1]] == pytest.approx(ends[taper], abs=ROUNDING)
    if taper == 2:  # a cylinder with half a sphere at its end
        assert (got[shares < 1 - 0.13 / 2] == 0.13).all()
        assert got[-1 - 4] == pytest.approx(math.sqrt(0.13**2 - (0.13 - 0.08) ** 2))


def test_rotations_turn_as_the_right_hand_says() -> None:
    x, y, z = np.eye(3)
    quarter = np.array([np.pi / 2])
    assert np.allclose(rotation("x", quarter)[0] @ y, z) and np.allclose(rotation("y", quarter)[0] @ z, x)
    assert np.allclose(rotation("z", quarter)[0] @ x, y)
    for name, axis in (("x", x), ("y", y), ("z", z)):
        assert np.allclose(rotation_about(7 * axis[None], np.array([0.3])), rotation(name, np.array([0.3])), atol=ROUNDING)
    assert np.array_equal(rotation_about(np.zeros((1, 3)), quarter)[0], np.eye(3))


def test_a_stem_passes_through_its_nodes_along_its_frames() -> None:
    stems = grown(load_species("acer"), 2, leaves=0).levels[1]
    every = np.arange(len(stems))
    for node in range(stems.resolution + 1):
        points, frames = stems.at(every, np.full(len(stems), node / stems.resolution))
        assert np.abs(points - stems.nodes[:, node]).max() < ROUNDING
        assert angles(frames[..., 2], stems.frames[:, node, :, 2]).max() < 1e-5
    random = np.random.default_rng(0)
    which, shares = random.integers(0, len(stems), 500), random.uniform(0.01, 0.99, 500)
    _, frames = stems.at(which, shares)
    assert np.abs(frames.swapaxes(-1, -2) @ frames - np.eye(3)).max() < ROUNDING and (np.linalg.det(frames) > 0).all()
    step = stems.at(which, shares + 1e-6)[0] - stems.at(which, shares - 1e-6)[0]
    assert angles(frames[..., 2], step).max() < 0.01  # the tangent, against a difference over two millionths


@pytest.mark.parametrize("number", range(11))
def test_leaf_outlines_are_whole_symmetric_and_of_length_one(number: int) -> None:
    shape = leaf_shape(number)
    corners = shape.points[shape.faces]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    assert (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).min() > 1e-3  # star-shaped about the shared corner, twice the areas
    outline = shape.points[1:]
    assert np.ptp(outline[:, 1]) == 1 and outline[0].tolist() == [0, 0] and [0, 1] in outline.tolist()
    mirrored = {(-x, y) for x, y in outline.tolist()}
    assert mirrored == {(x, y) for x, y in outline.tolist()}
    assert shape.uvs.min() == 0 and shape.uvs.max() == 1 and np.array_equal(shape.uvs[1], [0.5, 0])
    assert np.array_equal(np.unique(shape.faces), np.arange(len(shape.points)))
    turns = np.arctan2(outline[:, 1] - shape.points[0, 1], outline[:, 0])
    assert np.diff(np.unwrap(np.append(turns, turns[0]))).sum() == pytest.approx(2 * np.pi)  # once round
