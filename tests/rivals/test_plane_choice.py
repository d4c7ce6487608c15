"""Which planes a billboard cloud gets: known ones are found, and what is promised of epsilon, share and count holds."""

from __future__ import annotations

import numpy as np
import pytest

from bbfit.checks import InputError
from bbfit.rivals.billboard_clouds import PlaneChoice, choose_planes, slabs_of


def quad(center: list[float], normal: list[float], width: float, height: float, cells: int = 3) -> np.ndarray:
    """A rectangle with an upright frame as triangles of equal size, [2 * cells², 3, 3]."""
    n = np.array(normal) / np.linalg.norm(normal)
    up = np.array([0.0, 1.0, 0.0]) - n[1] * n
    up /= np.linalg.norm(up)
    right = np.cross(up, n)
    x, y = (np.linspace(-side / 2, side / 2, cells + 1) for side in (width, height))
    grid = np.array(center) + x[:, None, None] * right + y[None, :, None] * up
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack(corners, 2).reshape(-1, 3, 3) for corners in ((a, b, c), (a, c, d))])


QUADS = [
    ([0.0, 2.0, 0.0], [0.3, 0.1, 1.0], 2.0, 1.0),
    ([1.5, 1.0, -1.0], [1.0, 0.4, -0.2], 1.2, 1.8),
    ([-1.5, 3.0, 1.0], [-0.5, 0.8, 0.3], 1.0, 1.4),
]


def soup(count: int, seed: int = 0) -> np.ndarray:
    """Small triangles of random size and direction in a box of 4 x 6 x 3 meters."""
    generator = np.random.default_rng(seed)
    return generator.uniform([-2, 0, -1], [2, 6, 2], (count, 1, 3)) + generator.normal(0, 0.1, (count, 3, 3))


def areas(triangles: np.ndarray) -> np.ndarray:
    a, b, c = triangles.transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def farthest(choice: PlaneChoice, triangles: np.ndarray) -> float:
    """How far any triangle's corner is from its plane."""
    return max(
        float(np.abs(triangles[members] @ normal - distance).max())
        for normal, distance, members in zip(choice.normals, choice.distances, choice.members, strict=True)
    )


def test_quads_on_known_planes_are_found_exactly() -> None:
    """Each plane to rounding, though none is in the discretized plane space, and each rectangle from edge to edge."""
    parts = [quad(*values) for values in QUADS]
    triangles = np.concatenate(parts)
    choice = choose_planes(triangles, 3, share=1.0)
    assert choice.share == pytest.approx(1.0) and choice.epsilon < 0.25
    slabs = slabs_of(choice, triangles)
    found = set()
    for n, members in enumerate(choice.members):
        which = int(members[0]) // len(parts[0])
        center, normal, width, height = QUADS[which]
        unit = np.array(normal) / np.linalg.norm(normal)
        np.testing.assert_array_equal(members, np.arange(which * 18, which * 18 + 18))
        side = np.sign(choice.normals[n] @ unit)
        np.testing.assert_allclose(choice.normals[n] * side, unit, atol=1e-9)
        assert choice.distances[n] * side == pytest.approx(unit @ center, abs=1e-9)
        np.testing.assert_allclose(slabs.centers[n], center, atol=1e-9)
        np.testing.assert_allclose(slabs.half_extents[n], [width / 2, height / 2], atol=1e-9)
        frame = np.stack([slabs.rights[n], slabs.ups[n], choice.normals[n]])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(np.cross(frame[0], frame[1]), frame[2], atol=1e-12)
        assert frame[1, 1] > 0
        found.add(which)
    assert found == {0, 1, 2}


def test_a_level_plane_has_a_frame_too() -> None:
    triangles = quad([0.0, 1.0, 0.0], [0.0, 1.0, 1e-9], 2.0, 1.0)
    slabs = slabs_of(choose_planes(triangles, 1, share=1.0), triangles)
    np.testing.assert_allclose(np.abs(slabs.rights[0]), [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(slabs.half_extents[0], [1.0, 0.5], atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_what_is_promised_of_a_choice_holds(count: int) -> None:
    """Never more planes than asked for, each triangle on one of them within epsilon, and their area is the share, which is kept."""
    triangles = soup(1500)
    choice = choose_planes(triangles, count, share=0.9)
    assert 1 <= len(choice.normals) <= count
    members = np.concatenate(choice.members)
    assert len(np.unique(members)) == len(members)
    assert farthest(choice, triangles) <= choice.epsilon * (1 + 1e-5)
    weights = areas(triangles)
    assert choice.share == pytest.approx(weights[members].sum() / weights.sum()) and choice.share >= 0.9
    np.testing.assert_allclose(np.linalg.norm(choice.normals, axis=-1), 1.0, atol=1e-12)


def test_more_planes_lie_closer_and_more_share_takes_more_room() -> None:
    triangles = soup(1500)
    epsilons = [choose_planes(triangles, count, share=0.9).epsilon for count in (1, 3, 9)]
    assert epsilons[0] > 1.5 * epsilons[1] > 1.5**2 * epsilons[2]
    assert choose_planes(triangles, 3, share=0.6).epsilon < epsilons[1]


def test_densest_plane_comes_first_and_counts_projected_area() -> None:
    """Of two walls the larger is chosen first; a comb of teeth across a wall, larger in area, counts for nothing on it."""
    wall, small = quad([0, 1, 0], [0, 0, 1], 2.0, 2.0), quad([0, 1, 3], [0, 0, 1], 1.0, 1.0)
    choice = choose_planes(np.concatenate([small, wall]), 2, share=1.0)
    assert [len(m) for m in choice.members] == [18, 18] and choice.members[0].min() == 18
    teeth = np.concatenate([quad([x, 1, 3], [1, 0, 0], 0.02, 2.0, 1) for x in np.linspace(-2, 2, 400)])
    assert areas(teeth).sum() > areas(wall).sum()
    first = choose_planes(np.concatenate([teeth, wall]), 1, share=0.1)
    assert abs(first.normals[0, 2]) == pytest.approx(1.0, abs=1e-6) and first.distances[0] * first.normals[0, 2] == pytest.approx(
        0, abs=1e-6
    )


def test_choice_moves_with_the_tree_and_is_the_same_twice() -> None:
    triangles = soup(600)
    choice, again = choose_planes(triangles, 4), choose_planes(triangles, 4)
    np.testing.assert_array_equal(choice.normals, again.normals)
    shift = np.array([100.0, -20.0, 7.0])
    moved = choose_planes(triangles + shift, 4)
    np.testing.assert_allclose(moved.normals, choice.normals, atol=1e-9)
    np.testing.assert_allclose(moved.distances, choice.distances + choice.normals @ shift, atol=1e-6)


def test_weights_decide_where_they_are_given() -> None:
    """Areas given as weights take the place of the triangles' own."""
    wall, small = quad([0, 1, 0], [0, 0, 1], 2.0, 2.0), quad([0, 1, 3], [0, 0, 1], 1.0, 1.0)
    triangles = np.concatenate([wall, small])
    choice = choose_planes(triangles, 1, areas=np.repeat([0.1, 1.0], 18), share=0.9)
    assert set(choice.members[0]) == set(range(18, 36))


@pytest.mark.parametrize(
    ("triangles", "count", "share", "says"),
    [
        (np.zeros((0, 3, 3)), 2, 0.9, "at least one that has an area"),
        (np.zeros((4, 3, 3)), 2, 0.9, "at least one that has an area"),
        (np.zeros((4, 3)), 2, 0.9, "expected shape"),
        (soup(4), 0, 0.9, "expected at least 1"),
        (soup(4), 2, 0.0, "share"),
        (soup(4), 2, 1.1, "share"),
    ],
)
def test_bad_input_is_refused(triangles: np.ndarray, count: int, share: float, says: str) -> None:
    with pytest.raises(InputError, match=says):
        choose_planes(triangles, count, share=share)
