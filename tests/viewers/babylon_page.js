// Babylon.js: page.js calls load() once a GLB and draw() once a view.
// Only the modules that are needed are imported, one by one, so that the page starts fast.
import { canvas, query, refuse } from "/page.js";
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
import "@babylonjs/loaders/glTF/2.0/Extensions/KHR_mesh_quantization.js";
import "@babylonjs/loaders/glTF/2.0/glTFLoader.js";
import "@babylonjs/loaders/glTF/glTFFileLoader.js";

// With ?handed=right the scene is right-handed. By default it is left-handed, and the loader mirrors the model.
// With ?anisotropy=1 textures are filtered as glTF's samplers say, and bbfit does. Babylon.js's own level is 4.
const rightHanded = query.get("handed") === "right";
const anisotropy = query.get("anisotropy");
const engine = new Engine(canvas, false, { alpha: false, preserveDrawingBuffer: true, useExactSrgbConversions: true });
const scene = new Scene(engine);
scene.useRightHandedSystem = rightHanded;
scene.clearColor = new Color4(1, 1, 1, 1);
const camera = new Camera("camera", Vector3.Zero(), scene);
const sun = new DirectionalLight("sun", new Vector3(0, -1, 0), scene);
sun.setEnabled(false);

let shown = null;

export async function load(node) {
  refuse(node);
  shown?.dispose();
  shown = await LoadAssetContainerAsync("/model.glb", scene);
  shown.addAllToScene();
  for (const material of shown.materials) {
    material.ambientColor = Color3.White(); // the share of the scene's ambient light
    if (anisotropy !== null) for (const texture of material.getActiveTextures()) texture.anisotropicFilteringLevel = Number(anisotropy);
  }
  await scene.whenReadyAsync();
  return shown.materials.map(describe);
}

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

// Babylon.js keeps the transposes of OpenGL's matrices, row after row: the same 16 numbers.
export function draw({ projection, cameraToWorld, width, height, light }) {
  engine.setSize(width, height, true);
  if (light !== null) illuminate(light);
  const forwards = rightHanded ? Matrix.Identity() : Matrix.Scaling(1, 1, -1); // a left-handed camera looks along +Z
  const view = root().invert().multiply(Matrix.FromArray(cameraToWorld).invert()).multiply(forwards);
  camera._getViewMatrix = () => view;
  camera.getViewMatrix(true);
  camera.freezeProjectionMatrix(forwards.multiply(Matrix.FromArray(projection)));
  const before = engine._drawCalls.current;
  scene.render();
  return { calls: engine._drawCalls.current - before, triangles: scene.getActiveIndices() / 3 };
}
