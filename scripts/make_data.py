"""Make the small tree in data/ and its views: python scripts/make_data.py

The tree is a little broadleaf that leans into the light on one side: a trunk, three orders of branches as tapered tubes, and leaves as
double-sided quads in three greens. Everything follows from SEED; the views need Blender.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.visual.material import PBRMaterial

from bbfit.blender.config import ViewsConfig
from bbfit.blender.views_folder import render_views
from bbfit.files import write_bytes

Array = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[1] / "data"
SEED = 11
VIEWS = ViewsConfig(count=24, size=128, samples=64)

UP = np.array([0.0, 1.0, 0.0])
LIGHT = np.array([0.75, 0.0, 0.66])  # the side that the crown reaches out to
GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))  # what successive shoots turn by (Prusinkiewicz and Lindenmayer 1990, section 4.1)

BARK = ("bark", (0.16, 0.10, 0.065), 0.95)
LEAVES = (("leaf_0", (0.055, 0.155, 0.022), 0.6), ("leaf_1", (0.105, 0.225, 0.028), 0.6), ("leaf_2", (0.23, 0.33, 0.035), 0.6))


@dataclass
class Mesh:
    """Vertices, normals and triangles as they pile up."""

    vertices: list[Array] = field(default_factory=list)
    normals: list[Array] = field(default_factory=list)
    faces: list[NDArray[np.int64]] = field(default_factory=list)
    count: int = 0

    def add(self, vertices: Array, normals: Array, faces: NDArray[np.int64]) -> None:
        """Append a piece whose faces count from its own first vertex."""
        self.vertices.append(vertices)
        self.normals.append(normals)
        self.faces.append(faces + self.count)
        self.count += len(vertices)

    def build(self, name: str, colour: tuple[float, float, float], roughness: float, *, double_sided: bool) -> trimesh.Trimesh:
        """One mesh with one material."""
        material = PBRMaterial(
            name=name,
            baseColorFactor=np.array([*colour, 1.0]),
            metallicFactor=0.0,
            roughnessFactor=roughness,
            doubleSided=double_sided,
        )
        return trimesh.Trimesh(
            np.concatenate(self.vertices),
            np.concatenate(self.faces),
            vertex_normals=np.concatenate(self.normals),
            visual=trimesh.visual.TextureVisuals(material=material),
            process=False,
        )


@dataclass(frozen=True)
class Order:
    """How branches of one order look and what grows on them."""

    rings: int
    sides: int
    children: int
    first: float
    """Where along the branch its first child sits, as a share of the length."""
    angle: float
    """Between branch and child, degrees."""
    length: float
    """Of a child, as a share of the branch's."""
    bend: float
    """How far a branch turns up to the light on its way."""
    leaves: int


ORDERS = (
    Order(rings=17, sides=10, children=12, first=0.3, angle=64, length=0.66, bend=0.05, leaves=0),
    Order(rings=7, sides=6, children=7, first=0.28, angle=50, length=0.46, bend=0.55, leaves=0),
    Order(rings=5, sides=4, children=5, first=0.22, angle=48, length=0.55, bend=0.35, leaves=7),
    Order(rings=3, sides=3, children=0, first=0.0, angle=0, length=0.0, bend=0.2, leaves=8),
)


def unit(vector: Array) -> Array:
    """Vectors scaled to length one, [..., 3]."""
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def perpendicular(direction: Array) -> Array:
    """Some unit vector at a right angle to another."""
    return unit(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))]))


def rotate(vector: Array, axis: Array, angle: float) -> Array:
    """Rodrigues' rotation of a vector about a unit axis, radians."""
    turned = vector * np.cos(angle) + np.cross(axis, vector) * np.sin(angle)
    return turned + axis * (axis @ vector) * (1 - np.cos(angle))


def add_tube(mesh: Mesh, path: Array, radii: Array, sides: int) -> None:
    """A tapered tube around a polyline [R, 3], open at its ends, the last of which is thin."""
    tangents = unit(np.gradient(path, axis=0))
    first = perpendicular(tangents[0])
    angles = np.arange(sides) * 2 * np.pi / sides
    rings = []
    for tangent in tangents:
        first = unit(first - tangent * (first @ tangent))  # carried along, so that the tube does not twist
        second = np.cross(tangent, first)
        rings.append(np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * second)
    normals = np.stack(rings)  # [R, sides, 3]
    vertices = path[:, None] + radii[:, None, None] * normals
    vertices[..., 1] = np.maximum(vertices[..., 1], 0)  # the foot stands on the ground, however the trunk leans
    here = np.arange(len(path) - 1)[:, None] * sides + np.arange(sides)
    beside = np.arange(len(path) - 1)[:, None] * sides + (np.arange(sides) + 1) % sides
    faces = np.stack([here, beside, beside + sides, here, beside + sides, here + sides], -1).reshape(-1, 3)
    mesh.add(vertices.reshape(-1, 3), normals.reshape(-1, 3), faces)


def add_leaf(mesh: Mesh, base: Array, along: Array, normal: Array, size: float) -> None:
    """A leaf folded a little along its midrib: base, right, tip, left."""
    across = np.cross(along, normal)
    rise = 0.12 * size * normal
    middle = base + 0.45 * size * along + rise
    vertices = np.stack([base, middle + 0.36 * size * across, base + size * along, middle - 0.36 * size * across])
    sides = np.stack([normal, unit(normal - 0.3 * across), normal, unit(normal + 0.3 * across)])
    mesh.add(vertices, sides, np.array([[0, 1, 2], [0, 2, 3]]))


class Tree:
    """Grows one tree into a bark mesh and one mesh a leaf tone."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.bark = Mesh()
        self.leaves = [Mesh() for _ in LEAVES]

    def grow(self, base: Array, direction: Array, length: float, radius: float, depth: int = 0) -> None:
        """A branch with all that grows on it."""
        order, random = ORDERS[depth], self.random
        path = [base]
        heading = direction
        for _ in range(order.rings - 1):
            pull = order.bend * (0.75 * UP + 0.35 * LIGHT)
            heading = unit(heading + (pull + random.normal(0, 0.16, 3)) / (order.rings - 1) * 1.6)
            path.append(path[-1] + heading * length / (order.rings - 1))
        points = np.stack(path)
        share = np.linspace(0, 1, order.rings)
        radii = radius * (1 - 0.86 * share**0.9)
        if depth == 0:
            radii = radii * (1 + 0.55 * np.exp(-share / 0.05))  # the foot
        add_tube(self.bark, points, radii, order.sides)
        turn = random.uniform(0, 2 * np.pi)
        for index in range(order.children):
            at = order.first + (0.98 - order.first) * (index + random.uniform(-0.3, 0.3) + 0.3) / (order.children - 0.4)
            at = float(np.clip(at, 0.05, 1.0))
            place, tangent = self.along(points, at)
            turn += GOLDEN_ANGLE + random.normal(0, 0.25)
            angle = np.radians(order.angle * (1.15 - 0.55 * at) + random.normal(0, 7))
            child = rotate(tangent, rotate(perpendicular(tangent), tangent, turn), angle)
            reach = 1.0 + 0.42 * float(child @ unit(LIGHT)) if depth == 0 else 1.0
            shape = 1.12 - 0.75 * (at - 0.35) ** 2 - 0.35 * at if depth == 0 else 1.1 - 0.5 * at
            self.grow(
                place,
                child,
                length * order.length * shape * reach * random.uniform(0.82, 1.15),
                float(np.interp(at, share, radii)) * 0.62,
                depth + 1,
            )
        for index in range(order.leaves):
            self.sprout(*self.along(points, 0.25 + 0.75 * (index + random.uniform()) / order.leaves))

    def along(self, points: Array, at: float) -> tuple[Array, Array]:
        """Point and direction at a share of a polyline's length."""
        position = at * (len(points) - 1)
        index = min(int(position), len(points) - 2)
        step = points[index + 1] - points[index]
        return points[index] + (position - index) * step, unit(step)

    def sprout(self, place: Array, tangent: Array) -> None:
        """A leaf that points away from its twig, faces the sky more or less, and is lighter where the crown ends."""
        random = self.random
        along = unit(tangent + random.normal(0, 0.75, 3) + np.array([0, -0.25, 0]))
        facing = unit(UP + 0.35 * unit(place - np.array([0, 2.6, 0])) + random.normal(0, 0.45, 3))
        normal = unit(facing - along * (facing @ along))
        outside = np.linalg.norm((place - np.array([0.5, 3.4, 0.45])) / np.array([2.2, 1.8, 2.2]))
        tone = int(np.clip(np.rint(0.2 + 1.25 * outside + random.normal(0, 0.5)), 0, len(LEAVES) - 1))
        add_leaf(self.leaves[tone], place, along, normal, random.uniform(0.15, 0.24))


def make_tree(seed: int) -> trimesh.Scene:
    """The tree, Y up, in metres, its foot on the origin."""
    tree = Tree(seed)
    tree.grow(np.array([0.0, 0.0, 0.0]), unit(UP + 0.05 * LIGHT), length=4.0, radius=0.14)
    parts: dict[str, trimesh.parent.Geometry] = {BARK[0]: tree.bark.build(*BARK, double_sided=False)}
    parts |= {tone[0]: mesh.build(*tone, double_sided=True) for tone, mesh in zip(LEAVES, tree.leaves, strict=True)}
    return trimesh.Scene(parts)


def main() -> None:
    """Write data/tree.glb and data/views."""
    scene = make_tree(SEED)
    write_bytes(DATA / "tree.glb", trimesh.exchange.gltf.export_glb(scene, include_normals=True))
    shutil.rmtree(DATA / "views", ignore_errors=True)
    render_views(DATA / "tree.glb", DATA / "views", VIEWS)


if __name__ == "__main__":
    main()
