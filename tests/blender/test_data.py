"""The tree and the views that come with the package."""

from __future__ import annotations

import hashlib
import runpy
from pathlib import Path

import numpy as np
import trimesh

from bbfit.views.dataset import ViewDataset

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "data"


def test_views_are_of_the_tree() -> None:
    views = ViewDataset.load(DATA / "views")
    views.train.check()
    views.test.check()
    assert (len(views.train), len(views.test)) == (18, 6)
    assert views.request is not None and views.request.complete
    assert views.request.tree.sha256 == hashlib.sha256((DATA / "tree.glb").read_bytes()).hexdigest()
    assert sum(path.stat().st_size for path in DATA.rglob("*") if path.is_file()) < 3_000_000


def test_script_makes_the_tree() -> None:
    """Vertex for vertex, to float32's precision."""
    script = runpy.run_path(str(ROOT / "scripts/make_data.py"))
    made, stored = script["make_tree"](script["SEED"]), trimesh.load(DATA / "tree.glb", process=False)
    assert set(made.geometry) == set(stored.geometry) == {"bark", "leaf_0", "leaf_1", "leaf_2"}
    for name, mesh in stored.geometry.items():
        np.testing.assert_allclose(mesh.vertices, made.geometry[name].vertices, atol=1e-5)
        np.testing.assert_array_equal(mesh.faces, made.geometry[name].faces)
        np.testing.assert_allclose(np.linalg.norm(mesh.vertex_normals, axis=1), 1, atol=1e-5)
    low, high = stored.bounds
    assert low[1] == 0 and 3.5 <= high[1] <= 4.5 and (low[[0, 2]] < 0).all() and (high[[0, 2]] > 0).all()
    assert 10_000 <= sum(len(mesh.faces) for mesh in stored.geometry.values()) <= 20_000
