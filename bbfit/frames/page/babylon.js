// Fields of trees in Babylon.js: see frames.js. Each mesh of a model is drawn by thin instances.
import { sized } from "/frames.js";
import { Camera } from "@babylonjs/core/Cameras/camera.js";
import { TargetCamera } from "@babylonjs/core/Cameras/targetCamera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { SceneInstrumentation } from "@babylonjs/core/Instrumentation/sceneInstrumentation.js";
import { DirectionalLight } from "@babylonjs/core/Lights/directionalLight.js";
import { HemisphericLight } from "@babylonjs/core/Lights/hemisphericLight.js";
import { LoadAssetContainerAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import "@babylonjs/core/Materials/standardMaterial.js";
import { Color4 } from "@babylonjs/core/Maths/math.color.js";
import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import "@babylonjs/core/Meshes/thinInstanceMesh.js";
import { Scene } from "@babylonjs/core/scene.js";
import "@babylonjs/loaders/glTF/2.0/Extensions/EXT_texture_webp.js";
import "@babylonjs/loaders/glTF/2.0/Extensions/KHR_materials_specular.js";
import "@babylonjs/loaders/glTF/2.0/Extensions/KHR_materials_unlit.js";
import "@babylonjs/loaders/glTF/2.0/Extensions/KHR_mesh_quantization.js";
import "@babylonjs/loaders/glTF/2.0/glTFLoader.js";
import "@babylonjs/loaders/glTF/glTFFileLoader.js";

export const version = `Babylon.js ${Engine.Version}`;

const canvas = sized(1, 1);
const engine = new Engine(canvas, true, { alpha: false, preserveDrawingBuffer: true, useExactSrgbConversions: true });
const scene = new Scene(engine);
scene.useRightHandedSystem = true; // so that the loader does not mirror models
scene.clearColor = new Color4(0.55, 0.7, 0.9, 1);
scene.skipPointerMovePicking = true;
new DirectionalLight("sun", new Vector3(-0.5, -1, -0.7), scene).intensity = 2.5;
new HemisphericLight("sky", new Vector3(0, 1, 0), scene).intensity = 0.8;
const counters = new SceneInstrumentation(scene);
const camera = new TargetCamera("camera", Vector3.Zero(), scene);
camera.mode = Camera.ORTHOGRAPHIC_CAMERA;
const gl = engine._gl;
let shown = null;

export async function load({ files }) {
  shown?.dispose();
  shown = await LoadAssetContainerAsync(files[0].url, scene);
  shown.addAllToScene();
  await scene.whenReadyAsync();
}

export async function plant({ matrices, width, height, metersHigh, elevation, reach }) {
  engine.setSize(width, height);
  const half = metersHigh / 2;
  Object.assign(camera, { orthoTop: half, orthoBottom: -half, orthoRight: (half * width) / height, orthoLeft: (-half * width) / height });
  Object.assign(camera, { minZ: 0.01 * reach, maxZ: 2 * reach });
  camera.position.set(0, reach * Math.sin(elevation), reach * Math.cos(elevation));
  camera.setTarget(Vector3.Zero());
  for (const mesh of shown.meshes) {
    if (!mesh.getTotalVertices()) continue;
    mesh.thinInstanceSetBuffer("matrix", matrices, 16, true);
    mesh.alwaysSelectAsActiveMesh = true;
  }
  await scene.whenReadyAsync();
}

export function frame() {
  scene.render();
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  return 0;
}

export function facts() {
  const triangles = shown.meshes.reduce((sum, mesh) => sum + (mesh.getTotalIndices() / 3) * mesh.thinInstanceCount, 0);
  return { calls: counters.drawCallsCounter.current, triangles, bytes: null };
}

export const fragments = () => null;

export const level = () => 0;

export function picture() {
  throw new Error("pictures are drawn by three.js");
}
