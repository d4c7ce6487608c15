"""The systems that are not fits of bbfit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from bbfit.blender.pictures import render_pictures
from bbfit.comparison.config import CompareConfig
from bbfit.comparison.own_systems import fits
from bbfit.comparison.subject import Subject, System, SystemResult, baking, billboards
from bbfit.evaluation.shading import triangle_fragments
from bbfit.exporting.config import ExportConfig
from bbfit.exporting.lod import glb_counts
from bbfit.exporting.model import shipped_model
from bbfit.exporting.trees import thinned
from bbfit.files import write_bytes
from bbfit.fitting.config import FitConfig
from bbfit.geometry.camera import Camera
from bbfit.geometry.cloud import BillboardCloud
from bbfit.outputs import output_folder
from bbfit.rendering.cards import CardRenderer
from bbfit.rivals.baking import tree_triangles
from bbfit.rivals.billboard_clouds import billboard_cloud
from bbfit.rivals.crossed import crossed_planes
from bbfit.rivals.decimation import TooSmallError, decimate
from bbfit.rivals.draco import draco_geometry_bytes, draco_size
from bbfit.rivals.height_fields import height_fields
from bbfit.rivals.learned_mesh import learn_mesh, mesh_glb
from bbfit.rivals.octahedral import octahedral_impostor
from bbfit.rivals.octahedral_files import THREE_PROGRAM, impostor_glb, three_program
from bbfit.rivals.radiance_field import learn_radiance_field
from bbfit.rivals.slicing import slicing
from bbfit.views.view_set import ViewSet

_RECTANGLE = ExportConfig(outline="rectangle")
# The triangles of a quad.
_QUAD = torch.tensor([[0, 1, 2], [0, 2, 3]])
_THINNED = "Blender; fewer, larger leaves; vertices of integers"


def rival_systems(config: CompareConfig, shared: FitConfig) -> dict[str, System]:
    """The systems that are not fits of bbfit, by their names. Some depend on the size of bbfit's fit."""
    size, count, crossed = fits(config, shared)["bbfit"], config.billboards, config.crossed
    few, more, steps = config.mesh_vertices, config.mesh_vertices_many, config.mesh_steps
    return {
        "crossed": System(f"{crossed} crossed planes, baked", partial(_baked, crossed_planes, crossed), (crossed,)),
        "slicing": System(
            f"slicing and blending, {config.directions} x {config.slices} slices", _sliced, (config.directions, config.slices)
        ),
        "cloud": _cloud(count),
        "cloud-many": _cloud(config.many),
        "octahedral": _impostor(config, "blend"),
        "octahedral-flat": _impostor(config, "blend, without depth", parallax=0),
        "octahedral-mask": _impostor(config, "mask", alpha="mask"),
        "decimated-vertices": System(f"decimated to {4 * count} vertices", partial(_decimated, vertices=4 * count), (count,)),
        "decimated-bytes": System("decimated to bbfit's bytes", _decimated_to_size, size),
        "thinned": System("thinned out to bbfit's bytes", _thinned_to_size, size),
        "thinned-large": System(
            f"thinned out to {config.large_bytes:,} bytes", partial(_thinned, size=config.large_bytes), (config.large_bytes,)
        ),
        "thinned-triangles": System(
            f"thinned out to {config.thinned_triangles:,} triangles",
            partial(_thinned, triangles=config.thinned_triangles),
            (config.thinned_triangles,),
        ),
        "height-fields": System("the tree as coded height fields", _height_fields),
        "draco": System("the tree, with Draco", _draco),
        "learned": System(f"learned mesh, {few} vertices", partial(_learned, few), (few, steps)),
        "learned-many": System(f"learned mesh, {more} vertices", partial(_learned, more), (more, steps)),
        "radiance-field": System("radiance field", _radiance_field, (config.field_steps,)),
    }


def _cloud(count: int) -> System:
    return System(f"billboard cloud, {count} planes, baked", partial(_baked, billboard_cloud, count), (count,))


def _baked(bake: Callable[..., BillboardCloud], count: int, subject: Subject, folder: Path) -> SystemResult:
    baked, on_progress = folder / f"baked_{count}", subject.on(folder, "bake")
    cloud, seconds = baking(baked, lambda: bake(subject.tree, count=count, config=subject.bake, folder=baked, on_progress=on_progress))
    return billboards(subject, shipped_model(cloud, _RECTANGLE), seconds)


def _sliced(subject: Subject, folder: Path) -> SystemResult:
    config = subject.config
    baked = folder / f"baked_{config.directions}x{config.slices}"
    directions = {"directions": config.directions, "slices": config.slices}
    slices, seconds = baking(
        baked, lambda: slicing(subject.tree, subject.bake, **directions, folder=baked, on_progress=subject.on(folder, "bake"))
    )
    started = time.perf_counter()
    model = shipped_model(BillboardCloud.joined(slices.clouds), _RECTANGLE)
    # As a file shows them, with mip levels.
    renderers = [CardRenderer(shipped_model(cloud, _RECTANGLE).cards) for cloud in slices.clouds]

    def fragments(camera: Camera) -> float:
        return sum(renderers[index].fragments(camera) for index, weight in slices.weights(camera) if weight > 0)

    seconds += time.perf_counter() - started
    triangles = round(glb_counts(model.glb)[1] * min(2, len(slices.clouds)) / len(slices.clouds))
    note = "two of the slicings are drawn at a time, and their pictures are mixed, which requires a shader"
    return SystemResult(
        model.glb,
        model.cards.vertex_count,
        seconds,
        partial(slices.draw, drawn=[renderer.draw for renderer in renderers]),
        sum(map(len, slices.clouds)),
        note,
        fragments=fragments,
        triangles=triangles,
        shader=True,
    )


def _impostor(config: CompareConfig, kind: str, **options: Any) -> System:
    title = f"octahedral impostor, {config.frames} x {config.frames} frames{'' if config.hemisphere else ' all around'}, {kind}"
    return System(title, partial(_octahedral, options), (config.frames, config.hemisphere, options))


def _octahedral(options: dict[str, Any], subject: Subject, folder: Path) -> SystemResult:
    """An octahedral impostor. Variants with ``options`` share the frames of the system ``octahedral``, and the time of rendering them."""
    if options:
        subject.row("octahedral")  # which renders the frames
    hemisphere, on_progress = subject.config.hemisphere, subject.on(folder, "bake")
    baked = folder.parent / "octahedral" / f"baked_{subject.config.frames}{'' if hemisphere else '_all_around'}"
    render = partial(octahedral_impostor, subject.tree, subject.config.frames, subject.bake, hemisphere=hemisphere)
    impostor, seconds = baking(baked, lambda: render(folder=baked, on_progress=on_progress))
    started = time.perf_counter()
    impostor = replace(impostor, **options)
    model = impostor_glb(impostor)
    write_bytes(folder / THREE_PROGRAM, three_program())
    return SystemResult(
        model,
        glb_counts(model)[0],
        seconds + time.perf_counter() - started,
        impostor.draw,
        planes=1,
        note="a shader blends three frames; one quad",
        fragments=lambda camera: triangle_fragments(impostor.quad(camera)[_QUAD], camera),
        shader=True,
    )


def _decimated(subject: Subject, folder: Path, *, vertices: int | None = None, size: int | None = None) -> SystemResult:
    started = time.perf_counter()
    try:
        mesh = decimate(subject.tree, vertices=vertices, size=size)
    except TooSmallError as error:
        return SystemResult(None, None, time.perf_counter() - started, None, note=str(error))
    note = "edge collapses, then vertex clustering" if mesh.clustered else "edge collapses"
    return _rendered(mesh.glb, subject, folder, time.perf_counter() - started, note)


def _decimated_to_size(subject: Subject, folder: Path) -> SystemResult:
    return _decimated(subject, folder, size=subject.most_bytes)


def _thinned(subject: Subject, folder: Path, *, triangles: int | None = None, size: int | None = None) -> SystemResult:
    """Thin the tree out (Cook et al. 2007), as ``bbfit thin`` does it."""
    started = time.perf_counter()
    model = thinned(subject.tree, triangles=triangles, size=size, quantized=True, on_attempt=subject.on(folder, "thin"))
    note = _THINNED if size is None or len(model) <= size else f"{_THINNED}; no smaller size is possible"
    return _rendered(model, subject, folder, time.perf_counter() - started, note)


def _thinned_to_size(subject: Subject, folder: Path) -> SystemResult:
    return _thinned(subject, folder, size=subject.most_bytes)


def _draco(subject: Subject, folder: Path) -> SystemResult:
    started = time.perf_counter()
    compressed = draco_size(subject.tree)
    note = "the tree itself, with 14 bits for each coordinate; not drawn"
    return SystemResult(None, compressed.vertices, time.perf_counter() - started, None, note=note, size=compressed.bytes)


def _height_fields(subject: Subject, folder: Path) -> SystemResult:
    """Code the tree as height fields at the resolution of the views. Blender renders the decoded tree, which is the file of the model."""
    started = time.perf_counter()
    coded = height_fields(subject.tree, 1 / subject.bake.texels_per_meter)
    seconds = time.perf_counter() - started
    draco = draco_geometry_bytes(subject.tree, coded.error)
    note = f"{coded.patches:,} patches; wrong by {1000 * coded.error:.1f} mm (RMS), at which Draco takes {draco:,} bytes for the triangles"
    result = _rendered(coded.glb, subject, folder, seconds, note)
    return replace(result, model=None, vertices=None, size=len(coded.data), fragments=None, shader=True)


def _learned(vertices: int, subject: Subject, folder: Path) -> SystemResult:
    started, on_progress, steps = time.perf_counter(), subject.on(folder, "learn"), subject.config.mesh_steps
    mesh = learn_mesh(
        subject.views.train,
        vertices=vertices,
        steps=steps,
        seed=subject.stages.fit.seed,
        on_step=lambda step, loss: on_progress(step, steps),
    )
    model = mesh_glb(mesh)
    return SystemResult(
        model,
        len(mesh.vertices),
        time.perf_counter() - started,
        mesh.draw,
        note="blended, so its triangles must be sorted",
        fragments=partial(triangle_fragments, mesh.vertices[mesh.faces].double()),
    )


def _radiance_field(subject: Subject, folder: Path) -> SystemResult:
    started, on_progress, steps = time.perf_counter(), subject.on(folder, "learn"), subject.config.field_steps
    field = learn_radiance_field(
        subject.views.train, steps=steps, seed=subject.stages.fit.seed, on_step=lambda step, loss: on_progress(step, steps)
    )
    write_bytes(folder / "field.bin", field.to_bytes())
    seconds = time.perf_counter() - started
    drawn, camera = time.perf_counter(), subject.views.train.cameras[0]
    field.draw(camera)
    drawn = time.perf_counter() - drawn
    note = f"{drawn:.2f} s a frame of {camera.width} x {camera.height} pixels on this CPU; {field.samples(camera):.0f} samples a ray"
    return SystemResult(None, None, seconds, field.draw, note=note, size=field.bytes, shader=True)


def _rendered(model: bytes, subject: Subject, folder: Path, seconds: float, note: str) -> SystemResult:
    """A model as Blender renders it in the light of the views."""
    path = folder / "model.glb"
    write_bytes(path, model)
    pictures = output_folder("out", folder / "blender")
    for earlier in [*pictures.glob("*.png"), *pictures.glob("*.json")]:
        earlier.unlink()  # pictures of another model
    cameras, on_progress = subject.views.test.cameras, subject.on(folder, "render")
    paths = render_pictures(path, cameras, pictures, subject.stages.views, on_progress=on_progress)
    return SystemResult(
        model,
        glb_counts(model)[0],
        seconds,
        ViewSet.of_files(paths, cameras).draw,
        note=note,
        fragments=partial(triangle_fragments, torch.tensor(tree_triangles(path, subject.stages.limits))),
    )
