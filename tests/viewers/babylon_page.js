// Loads GLBs with Babylon.js and draws them from given cameras; browser_viewer.py calls load() once a GLB and then draw() once a view.
// Only the modules that are needed are imported, one by one, so that the page starts fast.
import { Camera } from "@babylonjs/core/Cameras/camera.js";
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { DirectionalLight } from "@babylonjs/core/Lights/directionalLight.js";
import { LoadAssetContainerAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import "@babylonjs/core/Materials/standardMaterial.js";
import { Color3, Color4 } from "@babylonjs/core/Maths/math.color.js";
import { Matrix, Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { Scene } from "@babylonjs/core/scene.js";
import "@babylonjs/loaders/glTF/2.0/Extensions/EXT_texture_webp.js";
import "@babylonjs/loaders/glTF/2.0/Extensions/KHR_materials_specular.js";
import "@babylonjs/loaders/glTF/2.0/Extensions/KHR_materials_unlit.js";
import "@babylonjs/loaders/glTF/2.0/glTFLoader.js";
import "@babylonjs/loaders/glTF/glTFFileLoader.js";

// With ?handed=right the scene is right-handed. By default it is left-handed, and the loader mirrors the model.
// With ?anisotropy=1 textures are filtered as glTF's samplers say, and bbfit does. Babylon.js's own level is 4.
const query = new URLSearchParams(location.search);
const rightHanded = query.get("handed") === "right";
const anisotropy = query.get("anisotropy");
const canvas = document.getElementById("canvas");
const engine = new Engine(canvas, false, { alpha: false, preserveDrawingBuffer: true, useExactSrgbConversions: true });
const scene = new Scene(engine);
scene.useRightHandedSystem = rightHanded;
scene.clearColor = new Color4(1, 1, 1, 1);
const camera = new Camera("camera", Vector3.Zero(), scene);
const sun = new DirectionalLight("sun", new Vector3(0, -1, 0), scene);
sun.setEnabled(false);

let shown = null;

// Loads the model in place of the one before. Tells the extent of what is shown and its materials.
window.load = async (node) => {
  if (node !== null) throw new Error("this page shows whole models");
  shown?.dispose();
  shown = await LoadAssetContainerAsync("/model.glb", scene);
  shown.addAllToScene();
  for (const material of shown.materials) {
    material.ambientColor = Color3.White(); // the share of the scene's ambient light
    if (anisotropy !== null) for (const texture of material.getActiveTextures()) texture.anisotropicFilteringLevel = Number(anisotropy);
  }
  await scene.whenReadyAsync();
  const toModel = root().invert();
  const points = shown.meshes.flatMap((mesh) => {
    const found = mesh.getVerticesData("position") ?? [];
    const toWorld = mesh.computeWorldMatrix(true).multiply(toModel);
    const count = found.length / 3;
    return Array.from({ length: count }, (_, i) => Vector3.TransformCoordinates(Vector3.FromArray(found, 3 * i), toWorld).asArray());
  });
  const bound = (choose) => [0, 1, 2].map((axis) => points.reduce((best, point) => choose(best, point[axis]), points[0][axis]));
  return { low: bound(Math.min), high: bound(Math.max), materials: shown.materials.map(describe) };
};

// From the model's axes, which are glTF's, to the scene's.
function root() {
  return shown.rootNodes[0].computeWorldMatrix(true).clone();
}

function describe(material) {
  const { name, alphaCutOff, albedoTexture } = material;
  const { width, height } = albedoTexture?.getSize() ?? {};
  return {
    name,
    type: material.getClassName(),
    alphaTest: material.needAlphaTesting() ? alphaCutOff : 0,
    transparent: material.needAlphaBlending(),
    side: material.backFaceCulling ? "front" : "double",
    map: albedoTexture && { width, height },
  };
}

// A sun and an even sky as bbfit has them (docs/guide/light.md).
function illuminate({ direction, strength, color, ambient }) {
  sun.setEnabled(true);
  sun.direction = Vector3.TransformNormal(Vector3.FromArray(direction), root()).negate();
  sun.intensity = strength;
  sun.diffuse = Color3.FromArray(color);
  scene.ambientColor = new Color3(ambient, ambient, ambient);
}

// Draws one view. Matrices are lists of 16 numbers, row after row, for OpenGL's axes of a camera. Babylon.js keeps the transposes.
// Pixels are RGBA bytes in base 64, the bottom row first.
window.draw = ({ projection, cameraToWorld, width, height, light }) => {
  engine.setSize(width, height, true);
  if (light !== null) illuminate(light);
  const forwards = rightHanded ? Matrix.Identity() : Matrix.Scaling(1, 1, -1); // a left-handed camera looks along +Z
  const view = root().invert().multiply(transposed(cameraToWorld).invert()).multiply(forwards);
  camera._getViewMatrix = () => view;
  camera.getViewMatrix(true);
  camera.freezeProjectionMatrix(forwards.multiply(transposed(projection)));
  const before = engine._drawCalls.current;
  scene.render();

  const gl = engine._gl;
  if (gl.drawingBufferWidth !== width || gl.drawingBufferHeight !== height) throw new Error("the canvas has another size");
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return { calls: engine._drawCalls.current - before, triangles: scene.getActiveIndices() / 3, pixels: encode(pixels) };
};

function transposed(rows) {
  return Matrix.FromArray(rows).transpose();
}

function encode(bytes) {
  let text = "";
  for (let start = 0; start < bytes.length; start += 8192) text += String.fromCharCode(...bytes.subarray(start, start + 8192));
  return btoa(text);
}
