"""Planes through clusters of points, and the rectangles and textures that are made of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from bbfit.fitting.clusters import Planes, best_planes, cluster_planes, moments, rectangles, splatted, split_planes, view_projection
from bbfit.fitting.initialize import sized
from bbfit.geometry.camera import Camera, look_at, pinhole_intrinsics
from bbfit.geometry.cloud import BillboardCloud
from bbfit.geometry.homography import texel_to_world
from bbfit.geometry.orbit import Orbit

DENSITY, MARGIN = 10.0, 0.05


def cameras(count: int, *elevations: float) -> Camera:
    """Rings of cameras around the origin."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return Orbit(count, elevations or (0.0,)).frame(corners, target=torch.zeros(3, dtype=torch.float64), width=16, height=16)


@pytest.fixture(scope="module")
def ring() -> Camera:
    return cameras(12)


def random_points(count: int, seed: int = 0) -> Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_planes(count: int, seed: int, *, upright: bool) -> tuple[Tensor, Tensor]:
    """Normals [K, 3] and offsets [K] of planes through the neighborhood of the origin."""
    normals = random_points(count, seed)
    if upright:
        normals[:, 1] = 0
    offsets = 2 * torch.rand(count, generator=generator(seed), dtype=torch.float64) - 1
    return normals / normals.norm(dim=-1, keepdim=True), offsets


def planted(count: int, seed: int, *, upright: bool, each: int = 200) -> tuple[Tensor, Tensor, Tensor]:
    """Points exactly on some planes, [K * each, 3], and those planes' normals and offsets."""
    normals, offsets = random_planes(count, seed, upright=upright)
    points = random_points(count * each, seed + 1).view(count, each, 3)
    distance = (points * normals[:, None]).sum(-1, keepdim=True) - offsets[:, None, None]
    return (points - distance * normals[:, None]).flatten(0, 1), normals, offsets


def displacements(points: Tensor, normals: Tensor, offsets: Tensor, camera: Camera) -> Tensor:
    """Mean squared length, over views, of what a view sees of each point's way onto each plane, [P, K]: the definition, step by step."""
    way = (offsets - points @ normals.mT)[..., None] * normals  # [P, K, 3]
    seen = [way - (way @ forward)[..., None] * forward for forward in camera.forward]
    return torch.stack([across.square().sum(-1) for across in seen]).mean(0)


def cost_of(planes: Planes, points: Tensor, camera: Camera) -> float:
    """Mean squared displacement of points onto the planes that they are labeled with, as views see it."""
    return float(displacements(points, planes.normals, planes.offsets, camera).gather(1, planes.labels[:, None]).mean())


# What is seen of a displacement


def test_a_ring_sees_all_of_what_goes_up_and_half_of_what_goes_sideways(ring: Camera) -> None:
    torch.testing.assert_close(view_projection(ring), torch.diag(torch.tensor([0.5, 1.0, 0.5], dtype=torch.float64)), atol=1e-12, rtol=0)


def test_a_view_from_above_sees_nothing_of_what_goes_up() -> None:
    pose = look_at(torch.tensor([[0.0, 5.0, 0.0]]).double(), torch.zeros(3).double())
    above = Camera(pose, pinhole_intrinsics(40, 8, 8)[None], 8, 8)
    expected = torch.diag(torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(view_projection(above), expected, atol=1e-12, rtol=0)
    torch.testing.assert_close(view_projection(above[0]), expected, atol=1e-12, rtol=0)


def test_what_is_seen_is_the_mean_over_views() -> None:
    camera = cameras(9, 20.0, -50.0)
    ways = random_points(20)
    seen = torch.einsum("pi,ij,pj->p", ways, view_projection(camera), ways)
    expected = torch.stack([torch.linalg.cross(ways, forward.expand_as(ways)).square().sum(-1) for forward in camera.forward]).mean(0)
    torch.testing.assert_close(seen, expected)


# Planes


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_planted_planes_are_found_exactly(ring: Camera, count: int, upright: bool) -> None:
    """From nearly all random starts; one may also end in another arrangement, which costs something."""
    points, normals, offsets = planted(count, 6, upright=upright)
    found = 0
    for seed in range(8):
        planes = cluster_planes(points, count, view_projection(ring), upright=upright, generator=generator(seed))
        alike = (planes.normals @ normals.mT).abs()
        match = alike.argmax(0)  # a plane found for each that was planted
        signs = (planes.normals[match] * normals).sum(-1).sign()
        exact = sorted(match.tolist()) == list(range(count)) and bool(
            (planes.normals[match] * signs[:, None] - normals).abs().max() < 1e-9
            and (planes.offsets[match] * signs - offsets).abs().max() < 1e-9
        )
        assert exact == (cost_of(planes, points, ring) < 1e-18)
        if exact:
            found += 1
            assert (planes.labels == match.repeat_interleave(200)).double().mean() > 0.99  # where planes cross, either is right
    assert found >= 6


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("count", [1, 4, 9])
def test_planes_cost_no_more_than_random_ones(ring: Camera, count: int, upright: bool) -> None:
    """Than the best of thirty arrangements, and less than half of what these cost on average."""
    points = random_points(800) * torch.tensor([1.0, 2.0, 0.7], dtype=torch.float64)
    planes = cluster_planes(points, count, view_projection(ring), upright=upright, generator=generator())
    random = [displacements(points, *random_planes(count, seed, upright=upright), ring).amin(-1).mean() for seed in range(30)]
    assert cost_of(planes, points, ring) < min(*random, 0.5 * sum(random) / 30)


@pytest.mark.parametrize("upright", [True, False])
def test_labels_are_of_the_cheapest_plane(upright: bool) -> None:
    """As cameras on two rings see it, from whose height the choice of a plane is another than by plain distance."""
    camera = cameras(9, 70.0, 85.0)
    points = random_points(500)
    planes = cluster_planes(points, 7, view_projection(camera), upright=upright, generator=generator(3))
    labels = displacements(points, planes.normals, planes.offsets, camera).argmin(-1)
    assert planes.labels.dtype == torch.int64 and torch.equal(planes.labels, labels)
    nearest = (points @ planes.normals.mT - planes.offsets).abs().argmin(-1)
    assert upright or not torch.equal(nearest, labels)


@pytest.mark.parametrize("upright", [True, False])
def test_normals_have_unit_length_and_of_upright_planes_no_height(ring: Camera, upright: bool) -> None:
    planes = cluster_planes(random_points(300), 6, view_projection(ring), upright=upright, generator=generator())
    assert planes.normals.dtype == planes.offsets.dtype == torch.float64
    torch.testing.assert_close(planes.normals.norm(dim=-1), torch.ones(6, dtype=torch.float64))
    assert (planes.normals[:, 1] == 0).all() if upright else (planes.normals[:, 1] != 0).all()


def test_planes_are_seeded(ring: Camera) -> None:
    points, seen = random_points(300), view_projection(ring)
    first, again, other = (cluster_planes(points, 5, seen, upright=False, generator=generator(seed)) for seed in (0, 0, 1))
    assert torch.equal(first.normals, again.normals) and torch.equal(first.labels, again.labels)
    assert not torch.equal(first.normals, other.normals)


@pytest.mark.parametrize("upright", [True, False])
def test_no_plane_is_left_with_next_to_nothing(ring: Camera, upright: bool) -> None:
    """Twenty planes for 200 points: without a new beginning where points are far, one start in two leaves a plane with fewer than three."""
    for seed in range(20):
        planes = cluster_planes(random_points(200, seed), 20, view_projection(ring), upright=upright, generator=generator(seed))
        assert torch.bincount(planes.labels, minlength=20).min() >= 3


@pytest.mark.parametrize("upright", [True, False])
def test_more_planes_than_there_are_to_be_found(ring: Camera, upright: bool) -> None:
    points, _, _ = planted(2, 3, upright=upright)
    costs = []
    for seed in range(6):
        planes = cluster_planes(points, 6, view_projection(ring), upright=upright, generator=generator(seed))
        assert planes.normals.shape == (6, 3) and planes.normals.isfinite().all() and planes.offsets.isfinite().all()
        costs.append(cost_of(planes, points, ring))
    assert sorted(costs)[3] < 1e-18  # half of the starts at least


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 7])
def test_very_few_points(ring: Camera, count: int, upright: bool) -> None:
    points = random_points(count)
    planes = cluster_planes(points, 5, view_projection(ring), upright=upright, generator=generator())
    assert planes.labels.shape == (count,) and (planes.labels >= 0).all() and (planes.labels < 5).all()
    torch.testing.assert_close(planes.normals.norm(dim=-1), torch.ones(5, dtype=torch.float64))
    assert planes.offsets.isfinite().all() and (not upright or (planes.normals[:, 1] == 0).all())
    cost = cost_of(planes, points, ring)
    assert cost <= 0.1 and (count > 3 or cost < 1e-18)  # of points a meter from the middle; up to three need no displacement
    cloud = rectangles(points, planes, DENSITY, MARGIN, two_sided=False)
    assert len(cloud) == 5 and all(tensor.isfinite().all() for tensor in (cloud.centers, cloud.rights, cloud.ups, cloud.half_extents))


def test_points_that_all_lie_in_one_place(ring: Camera) -> None:
    points = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64).repeat(50, 1)
    planes = cluster_planes(points, 4, view_projection(ring), upright=False, generator=generator())
    assert cost_of(planes, points, ring) < 1e-18 and planes.normals.isfinite().all()
    cloud = rectangles(points, planes, DENSITY, MARGIN, two_sided=False)
    torch.testing.assert_close((cloud.centers - points[:1]).norm(dim=-1)[planes.labels], torch.zeros(50, dtype=torch.float64))


# Rectangles


def one_plane(normal: Tensor, offset: float, count: int) -> Planes:
    return Planes(normal[None], torch.tensor([offset], dtype=torch.float64), torch.zeros(count, dtype=torch.int64))


def on_rectangle(cloud: BillboardCloud, n: int, points: Tensor) -> Tensor:
    """Coordinates of points along a billboard's axes, in meters from its center, [P, 2]."""
    return (points - cloud.centers[n]) @ torch.stack([cloud.rights[n], cloud.ups[n]], -1)


NORMALS = {
    "upright": (0.6, 0.0, 0.8),
    "leaning": (0.6, 0.48, -0.64),
    "lying": (0.0, 1.0, 0.0),
    "facing down": (0.0, -1.0, 0.0),
    "nearly lying": (0.02, math.sqrt(1 - 0.02**2), 0.0),
    "along x": (-1.0, 0.0, 0.0),
}


@pytest.mark.parametrize("normal", NORMALS.values(), ids=NORMALS.keys())
def test_rectangles_lie_in_their_plane_with_axes_at_right_angles(normal: tuple[float, float, float]) -> None:
    axis, offset = torch.tensor(normal, dtype=torch.float64), 0.7
    points = random_points(100)
    cloud = rectangles(points, one_plane(axis, offset, 100), DENSITY, MARGIN, two_sided=False)
    assert cloud.centers.dtype == torch.float64
    assert float(cloud.centers[0] @ axis) == pytest.approx(offset, abs=1e-6)
    frame = torch.stack([cloud.rights[0], cloud.ups[0], axis])
    torch.testing.assert_close(frame @ frame.mT, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(torch.linalg.cross(cloud.rights[0], cloud.ups[0]), axis, atol=1e-12, rtol=0)


@pytest.mark.parametrize("upright", [True, False])
def test_rectangles_hold_their_points_and_the_margin_and_little_more(ring: Camera, upright: bool) -> None:
    points = random_points(600) * torch.tensor([1.0, 2.0, 0.3], dtype=torch.float64)
    planes = cluster_planes(points, 7, view_projection(ring), upright=upright, generator=generator())
    cloud = rectangles(points, planes, DENSITY, MARGIN, two_sided=False)
    for n in range(7):
        reach = on_rectangle(cloud, n, points[planes.labels == n])
        spare = torch.stack([reach.amin(0) + cloud.half_extents[n], cloud.half_extents[n] - reach.amax(0)])  # meters, at all four sides
        assert (spare > MARGIN - 1e-5).all()  # a turned rectangle is worked out in float32
        assert (spare < MARGIN + 0.5 / DENSITY + 1e-5).all()  # half a texel, since sides are rounded up to whole ones
        foreign = on_rectangle(cloud, n, points[planes.labels != n])
        assert (foreign.abs() > cloud.half_extents[n]).any()  # and not all points alike


def flat_points(width: float, height: float, degrees: float) -> Tensor:
    """Points of a rectangle in the plane z = 0.5 that is turned counter-clockwise, its corners included."""
    sides = torch.tensor([width, height], dtype=torch.float64) / 2
    corners = torch.tensor([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=torch.float64)
    inner = 2 * torch.rand(50, 2, generator=generator(), dtype=torch.float64) - 1
    x, y = (torch.cat([corners, inner]) * sides).unbind(-1)
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.stack([c * x - s * y + 0.3, s * x + c * y - 0.2, torch.full_like(x, 0.5)], -1)


# Beside a turned square the upright one is 1 + sin(2 angle) times as large: 5/4 at 7.24 degrees.
@pytest.mark.parametrize(
    ("width", "height", "degrees", "turned"),
    [
        (2.0, 2.0, 0.0, False),
        (2.0, 2.0, 6.9, False),
        (2.0, 2.0, 7.6, True),
        (2.0, 2.0, -6.9, False),
        (2.0, 2.0, -7.6, True),
        (3.0, 0.4, 30.0, True),
        (3.0, 0.4, -30.0, True),
        (3.0, 0.4, 1.0, False),
        (0.4, 3.0, 20.0, True),
    ],
)
def test_rectangles_stand_upright_unless_a_turned_one_is_a_fifth_smaller(width: float, height: float, degrees: float, turned: bool) -> None:
    points = flat_points(width, height, degrees)
    fine = 250.0  # texels a meter, so that rounding up adds little
    cloud = rectangles(points, one_plane(torch.tensor([0.0, 0.0, 1.0]).double(), 0.5, len(points)), fine, 0.0, two_sided=False)
    angle = math.radians(degrees if turned else 0.0)
    right = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
    torch.testing.assert_close(cloud.rights[0], right, atol=1e-5, rtol=0)
    assert cloud.ups[0, 1] > 0.7
    torch.testing.assert_close(cloud.centers[0], torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64), atol=1e-5, rtol=0)
    if turned:
        expected = torch.tensor([width, height], dtype=torch.float64) / 2
    else:
        c, s = abs(math.cos(math.radians(degrees))), abs(math.sin(math.radians(degrees)))
        expected = torch.tensor([width * c + height * s, width * s + height * c], dtype=torch.float64) / 2
    torch.testing.assert_close(cloud.half_extents[0], expected, atol=0.5 / fine + 1e-5, rtol=0)


@pytest.mark.parametrize("two_sided", [False, pytest.param(True)])
def test_a_plane_without_points_gets_a_small_rectangle(two_sided: bool) -> None:
    points = random_points(30)
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]], dtype=torch.float64)
    planes = Planes(normals, torch.tensor([0.1, 0.4], dtype=torch.float64), torch.zeros(30, dtype=torch.int64))
    cloud = rectangles(points, planes, DENSITY, MARGIN, two_sided=two_sided)
    assert cloud.texture_sizes[1].tolist() == [1, 1] and cloud.half_extents[1].tolist() == [0.05, 0.05]
    assert float(cloud.centers[1] @ normals[1]) == pytest.approx(0.4)
    assert cloud.two_sided.tolist() == [two_sided] * 2 and not cloud.texels.any()


# Texels


def without_textures(*half_extents: tuple[float, float], two_sided: bool = False) -> BillboardCloud:
    """Leaning rectangles in a row, float64, of a texel each."""
    n = len(half_extents)
    frame = torch.linalg.qr(random_points(3, 2)).Q
    frame = frame * torch.linalg.det(frame)
    rows = torch.arange(n, dtype=torch.float64)[:, None] * torch.tensor([[5.0, 1.0, 0.0]], dtype=torch.float64)
    return BillboardCloud(
        rows,
        frame[:1].expand(n, 3).clone(),
        frame[1:2].expand(n, 3).clone(),
        torch.tensor(half_extents, dtype=torch.float64),
        torch.ones(n, 2, dtype=torch.int64),
        torch.full((n,), two_sided),
        torch.zeros(n * (1 + two_sided), 4),
    )


@pytest.mark.parametrize("two_sided", [False, True])
def test_sized_rectangles_are_whole_texels_of_the_density(two_sided: bool) -> None:
    cloud = without_textures((0.5, 0.8), (0.01, 0.02), (1.234, 0.617), two_sided=two_sided)
    made = sized(cloud, DENSITY)
    assert made.texture_sizes.dtype == torch.int64
    assert made.texture_sizes.tolist() == [[16, 10], [1, 1], [13, 25]]
    torch.testing.assert_close(made.texture_sizes.flip(-1) / (2 * made.half_extents), torch.full((3, 2), DENSITY, dtype=torch.float64))
    assert (made.half_extents >= cloud.half_extents - 1e-12).all() and (made.half_extents < cloud.half_extents + 0.5 / DENSITY).all()
    assert made.texels.shape == ((160 + 1 + 325) * (1 + two_sided), 4) and not made.texels.any()
    for name in ("centers", "rights", "ups", "two_sided"):
        assert torch.equal(getattr(made, name), getattr(cloud, name))


def at_texels(cloud: BillboardCloud, n: int, places: list[tuple[float, float]]) -> Tensor:
    """World points of columns and rows of a billboard's texture, [P, 3]; texel centers lie at whole numbers."""
    homogeneous = torch.tensor([(x, y, 1.0) for x, y in places], dtype=torch.float64)
    return homogeneous @ texel_to_world(cloud)[n, :3].mT


@pytest.mark.parametrize("two_sided", [False, True])
def test_splatted_points_color_the_texels_that_they_are_over(two_sided: bool) -> None:
    """Moved along the normal they are over the same texel; anywhere within a texel they are over it."""
    cloud = sized(without_textures((0.2, 0.15), (0.1, 0.1), two_sided=two_sided), DENSITY)  # 3 x 4 and 2 x 2 texels
    red, green, blue = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    places = [(0, 0), (0.45, -0.45), (3, 0), (2.6, 2.4)]  # top left twice, top right, bottom right
    points = torch.cat([at_texels(cloud, 0, places), at_texels(cloud, 1, [(1, 0)])])
    points[[0, 2, 4]] += 0.3 * torch.linalg.cross(cloud.rights, cloud.ups)[0]
    colors = torch.tensor([red, green, blue, red, green])
    textures = splatted(cloud, points, colors, torch.tensor([0, 0, 0, 0, 1])).textures()
    for side in textures[0]:
        once, twice = 1 - math.exp(-1 / (4 / 3)), 1 - math.exp(-2 / (4 / 3))  # four points on three texels
        torch.testing.assert_close(side[0, 0], torch.tensor([0.5, 0.5, 0.0, twice]))
        torch.testing.assert_close(side[0, 3], torch.tensor([*blue, once]))
        torch.testing.assert_close(side[2, 3], torch.tensor([*red, once]))
        empty = torch.ones(3, 4, dtype=torch.bool)
        empty[[0, 0, 2], [0, 3, 3]] = False
        torch.testing.assert_close(side[empty], torch.tensor([0.5, 0.25, 0.25, 0.0]).expand(9, 4))  # their mean color
    for side in textures[1]:
        torch.testing.assert_close(side[0, 1], torch.tensor([*green, 1 - math.exp(-1)]))
        assert int((side[..., 3] > 0).sum()) == 1
    assert len(textures[0]) == len(textures[1]) == 1 + two_sided


def test_the_more_points_the_more_alpha() -> None:
    cloud = sized(without_textures((0.4, 0.05)), DENSITY)  # one row of eight texels
    places = [(column, 0) for column in range(8) for _ in range(column)]
    points = at_texels(cloud, 0, places)
    texture = splatted(cloud, points, torch.full((len(points), 3), 0.3), torch.zeros(len(points), dtype=torch.int64)).textures()[0]
    alpha = texture[0, 0, :, 3]
    torch.testing.assert_close(alpha, 1 - torch.exp(-torch.arange(8.0) / 4))  # 28 points on 7 texels
    assert (alpha.diff() > 0).all()
    torch.testing.assert_close(texture[..., :3], torch.full((1, 1, 8, 3), 0.3))


def test_points_on_the_edge_and_beyond_count_for_the_border() -> None:
    cloud = sized(without_textures((0.1, 0.1)), DENSITY)  # 2 x 2 texels
    points = at_texels(cloud, 0, [(-0.5, -0.5), (1.5, -0.5), (7, 9)])
    texture = splatted(cloud, points, torch.eye(3), torch.zeros(3, dtype=torch.int64)).textures()[0][0]
    torch.testing.assert_close(texture[0, 0, :3], torch.tensor([1.0, 0, 0]))
    torch.testing.assert_close(texture[0, 1, :3], torch.tensor([0, 1.0, 0]))
    torch.testing.assert_close(texture[1, 1, :3], torch.tensor([0, 0, 1.0]))
    assert texture[1, 0, 3] == 0


@pytest.mark.parametrize("two_sided", [False, True])
def test_a_billboard_without_points_is_grey_and_transparent(two_sided: bool) -> None:
    cloud = sized(without_textures((0.1, 0.1), (0.2, 0.1), two_sided=two_sided), DENSITY)
    points = at_texels(cloud, 0, [(0, 0)])
    made = splatted(cloud, points, torch.tensor([[0.2, 0.4, 0.6]]), torch.tensor([0]))
    assert (made.textures()[1] == torch.tensor([0.5, 0.5, 0.5, 0.0])).all()
    assert replace(made, texels=cloud.texels).texels is cloud.texels and torch.equal(made.centers, cloud.centers)


@pytest.mark.parametrize("upright", [False, True])
def test_best_planes_of_moments_are_those_of_the_points(upright: bool) -> None:
    """Against the singular vectors of the points themselves, where views see all displacements alike; far from the origin as well."""
    points = random_points(500) * torch.tensor([3.0, 1.0, 0.4]) + torch.tensor([40.0, 5.0, -60.0])
    labels = torch.arange(500) % 3
    normals, offsets, squares = best_planes(moments(points, labels, 4), torch.eye(3).double(), upright=upright)
    for k in range(3):
        own = points[labels == k]
        flat = own * torch.tensor([1.0, 0.0, 1.0]) if upright else own
        _, values, axes = torch.linalg.svd(flat - flat.mean(0), full_matrices=False)
        last = 1 if upright else 2
        assert (normals[k] @ axes[last]).abs() == pytest.approx(1, abs=1e-9)
        assert float(squares[k]) == pytest.approx(float(values[last] ** 2), rel=1e-6)
        assert float((own @ normals[k] - offsets[k]).square().sum()) == pytest.approx(float(squares[k]), rel=1e-6)
    assert normals.norm(dim=-1)[3] == pytest.approx(1) and float(squares[3]) == 0  # a cluster without points


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("flatness", [1.0, 0.7, 0.2, 1e-7])
def test_best_planes_move_points_least_in_the_views(upright: bool, flatness: float) -> None:
    """Against a search over many directions; views from the sides see vertical displacements twice as well as horizontal ones."""
    points = random_points(900) * torch.tensor([1.0, flatness, 0.9])
    labels = torch.arange(900) % 3
    seen = torch.diag(torch.tensor([0.5, 1.0, 0.4], dtype=torch.float64))
    normals, offsets, squares = best_planes(moments(points, labels, 3), seen, upright=upright)
    directions = torch.nn.functional.normalize(
        torch.randn(20_000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)), dim=-1
    )
    directions = torch.cat([directions, torch.eye(3).double()])
    if upright:
        directions[:, 1] = 0
        directions = torch.nn.functional.normalize(directions[directions.norm(dim=-1) > 1e-3], dim=-1)
        assert (normals[:, 1] == 0).all()
    for k in range(3):
        own = points[labels == k]
        distances = (own - own.mean(0)) @ directions.mT
        moved = distances.square().sum(0) * ((directions @ seen) * directions).sum(-1)
        assert float(squares[k] * (normals[k] @ seen @ normals[k])) <= 1.001 * float(moved.min()) + 1e-12
        assert float((own @ normals[k] - offsets[k]).square().sum()) == pytest.approx(float(squares[k]), rel=1e-6, abs=1e-12)


def test_planes_face_views_from_one_direction() -> None:
    """Such views see no displacement across them; neither do they decide where points have no extent at all."""
    seen = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64))
    for points in (random_points(100), torch.zeros(100, 3, dtype=torch.float64)):
        normals, _, _ = best_planes(moments(points, torch.zeros(100, dtype=torch.int64), 1), seen, upright=False)
        assert normals.isfinite().all() and normals[0, 2].abs() == pytest.approx(1, abs=1e-4)


def test_moments_of_a_union_are_the_sums() -> None:
    points, labels = random_points(60), torch.arange(60) % 4
    apart = moments(points, labels, 4)
    assert torch.allclose(moments(points, labels % 2, 2), apart[:2] + apart[2:], rtol=1e-12)
    assert apart[:, 3, 3].tolist() == [15] * 4


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("across", [0, 2])
def test_split_planes_find_two_sheets(ring: Camera, upright: bool, across: int) -> None:
    """Parallel ones, a pace apart, seen through noise; and a bent sheet."""
    points = random_points(400)
    points[:, across] = 0.02 * points[:, across] + torch.where(torch.arange(400) % 2 == 0, 0.5, -0.5)
    planes = split_planes(points, torch.eye(3), view_projection(ring), upright=upright)
    assert planes.normals[:, across].abs().min() > 0.99 and planes.offsets.abs().sub(0.5).abs().max() < 0.05
    assert planes.labels.bincount().tolist() == [200, 200] and len(planes.labels[::2].unique()) == len(planes.labels[1::2].unique()) == 1


def test_split_planes_are_upright_where_they_have_to_be(ring: Camera) -> None:
    points, seen = random_points(300), view_projection(ring)
    upright, free = (split_planes(points, torch.eye(3), seen, upright=must) for must in (True, False))
    assert (upright.normals[:, 1] == 0).all()

    def moved(planes: Planes) -> float:
        return float(((points @ planes.normals.mT - planes.offsets).abs().amin(-1)).square().mean())

    one = best_planes(moments(points, torch.zeros(300, dtype=torch.int64), 1), seen, upright=True)[2]
    assert moved(upright) < 0.8 * float(one) / 300 and moved(free) < 1.2 * moved(upright)


def test_few_points_split_as_well(ring: Camera) -> None:
    for count in (1, 2, 3, 5):
        planes = split_planes(random_points(count), torch.eye(3), view_projection(ring), upright=False)
        assert planes.normals.isfinite().all() and planes.offsets.isfinite().all() and len(planes.labels) == count
