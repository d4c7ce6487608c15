"""Runs in a process of its own, started by native_viewer.py: opens one model in one program and renders it without a screen.

Standard input holds the job as JSON. Pictures are NumPy files of uint8 [H, W, 3], 0000.npy, 0001.npy, ... in the job's folder.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Passes of depth peeling, each of which takes the nearest and the farthest of the remaining layers.
PEELS = 8


def main() -> None:
    """Do one job."""
    job = json.load(sys.stdin)
    pictures = {"vtk": vtk_pictures, "f3d": f3d_pictures, "panda3d": panda3d_pictures}[job["program"]](job)
    for index, picture in enumerate(pictures):
        np.save(f"{job['folder']}/{index:04d}.npy", picture)


def degrees(job: dict[str, Any], view: dict[str, Any]) -> float:
    """The vertical field of view."""
    return math.degrees(2 * math.atan(job["height"] / (2 * view["focal"])))


def vtk_pictures(job: dict[str, Any]) -> Iterator[NDArray[np.uint8]]:
    """VTK's glTF importer and renderer."""
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    width, height = job["width"], job["height"]
    window, renderer, importer = vtk.vtkEGLRenderWindow(), vtk.vtkRenderer(), vtk.vtkGLTFImporter()
    window.SetSize(width, height)
    window.SetMultiSamples(0)
    window.AddRenderer(renderer)
    renderer.SetBackground(1, 1, 1)
    importer.SetFileName(job["model"])
    importer.SetRenderWindow(window)
    importer.Update()
    if not job["as_it_comes"]:
        window.SetAlphaBitPlanes(1)
        renderer.SetUseDepthPeeling(1)
        renderer.SetMaximumNumberOfPeels(PEELS)
        for actor in renderer.GetActors():
            for name in ("albedoTex", "emissiveTex"):
                if texture := actor.GetProperty().GetTexture(name):
                    texture.SetMaximumAnisotropicFiltering(1)
    camera = renderer.GetActiveCamera()
    for view in job["views"]:
        camera.SetPosition(view["position"])
        camera.SetFocalPoint(*np.add(view["position"], view["forward"]))
        camera.SetViewUp(view["up"])
        camera.SetViewAngle(degrees(job, view))
        camera.SetWindowCenter(-2 * view["aside"][0] / width, 2 * view["aside"][1] / height)
        camera.SetClippingRange(view["clip"])
        window.Render()
        grabber = vtk.vtkWindowToImageFilter()
        grabber.SetInput(window)
        grabber.ReadFrontBufferOff()
        grabber.Update()
        yield vtk_to_numpy(grabber.GetOutput().GetPointData().GetScalars()).reshape(height, width, 3)[::-1]


def f3d_pictures(job: dict[str, Any]) -> Iterator[NDArray[np.uint8]]:
    """F3D, by its own library."""
    import f3d

    f3d.Log.set_verbose_level(f3d.Log.VerboseLevel.WARN)
    engine = f3d.Engine.create(True)
    engine.options.update({"render.background.color": [1.0, 1.0, 1.0], "ui.axis": False, "render.grid.enable": False})
    if not job["as_it_comes"]:
        engine.options["render.effect.blending.mode"] = "ddp"
    engine.scene.add(job["model"])
    engine.window.size = job["width"], job["height"]
    camera = engine.window.camera
    for view in job["views"]:
        assert np.allclose(view["aside"], 0, atol=1e-3)
        camera.position = tuple(view["position"])
        camera.focal_point = tuple(np.add(view["position"], np.multiply(view["distance"], view["forward"])).tolist())
        camera.view_up = tuple(view["up"])
        camera.view_angle = degrees(job, view)
        image = engine.window.render_to_image()
        pixels = np.frombuffer(image.content, np.uint8).reshape(image.height, image.width, image.channel_count)
        yield pixels[::-1, :, :3]


def panda3d_pictures(job: dict[str, Any]) -> Iterator[NDArray[np.uint8]]:
    """Panda3D with panda3d-gltf, with its axis Z up."""
    from panda3d.core import Filename, PerspectiveLens, Point3, Texture, Vec3, loadPrcFileData

    width, height = job["width"], job["height"]
    for line in ("load-display p3headlessgl", "audio-library-name null", f"win-size {width} {height}", "model-cache-dir"):
        loadPrcFileData("", line)
    from direct.showbase.ShowBase import ShowBase

    base, lens = ShowBase(windowType="offscreen"), PerspectiveLens()
    base.disableMouse()
    base.setBackgroundColor(1, 1, 1, 1)
    model = base.loader.loadModel(Filename.fromOsSpecific(job["model"]))
    for texture in model.findAllTextures():
        texture.setFormat(Texture.FRgba)  # filtered and blended as displayed
    model.reparentTo(base.render)
    base.cam.node().setLens(lens)
    lens.setFilmSize(width, height)
    for view in job["views"]:
        position, forward, up = ((x, -z, y) for x, y, z in (view["position"], view["forward"], view["up"]))
        lens.setFocalLength(view["focal"])
        lens.setFilmOffset(-view["aside"][0], view["aside"][1])
        lens.setNearFar(*view["clip"])
        base.cam.setPos(*position)
        base.cam.lookAt(Point3(*np.add(position, forward)), Vec3(*up))
        for _ in range(2):  # the first is not complete
            base.graphicsEngine.renderFrame()
        picture = base.win.getScreenshot()
        yield np.frombuffer(picture.getRamImageAs("RGB"), np.uint8).reshape(height, width, 3)[::-1]


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    os._exit(0)  # graphics drivers may crash in their own clean-up
