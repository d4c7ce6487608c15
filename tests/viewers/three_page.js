// three.js: page.js calls load() once a GLB and draw() once a view.
import { canvas, query } from "/page.js";
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { KTX2Loader } from "three/addons/loaders/KTX2Loader.js";

const SIDES = { [THREE.FrontSide]: "front", [THREE.BackSide]: "back", [THREE.DoubleSide]: "double" };
// three.js has its own numbers for filters; these are glTF's, which are OpenGL's.
const FILTERS = {
  [THREE.NearestFilter]: 9728,
  [THREE.LinearFilter]: 9729,
  [THREE.NearestMipmapNearestFilter]: 9984,
  [THREE.LinearMipmapNearestFilter]: 9985,
  [THREE.NearestMipmapLinearFilter]: 9986,
  [THREE.LinearMipmapLinearFilter]: 9987,
};
// Objects in no other layer are drawn. Layers, unlike visible, are not inherited.
const SHOWN = 0;
const HIDDEN = 1;

// With ?smooth=centered, masks are drawn with alpha to coverage as docs/engines.md describes: three.js gets the usual ramp around the cutoff.
// With ?smooth=own it keeps its own, which begins at the cutoff. With ?smooth=coverage, models for it are drawn so.
const smooth = query.get("smooth");
if (smooth === "centered") {
  THREE.ShaderChunk.alphatest_fragment = THREE.ShaderChunk.alphatest_fragment.replace(
    "smoothstep( alphaTest, alphaTest + fwidth( diffuseColor.a ), diffuseColor.a )",
    "clamp( ( diffuseColor.a - alphaTest ) / max( fwidth( diffuseColor.a ), 0.0001 ) + 0.5, 0.0, 1.0 )",
  );
}
// With ?impostor=plain, models are octahedral impostors, drawn by the program that bbfit writes for them. With ?impostor=turned, they are
// instances that are turned by 90 degrees.
const { loadImpostor } = query.has("impostor") ? await import("/impostor_three.js") : {};
// Without alpha of its own: three.js always asks for one, and what alpha to coverage writes there lets the page through.
// Materials for coverage keep the alpha of the canvas, so that they work with a context as three.js makes it.
const context = smooth === "coverage" ? undefined : canvas.getContext("webgl2", { alpha: false, antialias: smooth !== null });
const renderer = new THREE.WebGLRenderer({ canvas, context, antialias: true });
renderer.setPixelRatio(1);
renderer.setClearColor(0xffffff, 1);
renderer.outputColorSpace = THREE.SRGBColorSpace;
renderer.toneMapping = THREE.NoToneMapping;
const scene = new THREE.Scene();
const loader = new GLTFLoader().setKTX2Loader(
  new KTX2Loader().setTranscoderPath("/three/examples/jsm/libs/basis/").detectSupport(renderer),
);

export async function load(node) {
  scene.traverse(({ geometry, material }) => {
    geometry?.dispose();
    material?.map?.dispose();
    material?.dispose();
  });
  scene.clear();
  if (loadImpostor) {
    const impostor = await loadImpostor("/model.glb", { loader });
    scene.add(query.get("impostor") === "turned" ? turned(impostor) : impostor);
    return [];
  }
  const gltf = await loader.loadAsync("/model.glb");
  scene.add(gltf.scene);
  if (node !== null) await showOnly(gltf, node);
  scene.updateMatrixWorld(true);

  const materials = new Set();
  scene.traverse((object) => {
    if (!object.isMesh || !object.layers.isEnabled(SHOWN)) return;
    materials.add(object.material);
    object.material.alphaToCoverage = smooth !== null && object.material.alphaTest > 0;
    if (object.material.userData.alphaMode === "COVERAGE" && smooth !== null) cover(object.material);
  });
  return [...materials].map(describe);
}

// As docs/engines.md describes.
function cover(material) {
  Object.assign(material, { alphaToCoverage: true, alphaTest: 0, blending: THREE.CustomBlending });
  Object.assign(material, { blendSrc: THREE.OneFactor, blendDst: THREE.ZeroFactor });
  Object.assign(material, { blendSrcAlpha: THREE.ZeroFactor, blendDstAlpha: THREE.OneFactor });
}

function turned({ geometry, material }) {
  const forest = new THREE.InstancedMesh(geometry, material, 1);
  forest.setMatrixAt(0, new THREE.Matrix4().makeRotationY(Math.PI / 2).scale(new THREE.Vector3(0.5, 0.5, 0.5)));
  forest.scale.setScalar(2);
  return forest;
}

// Levels of detail are nodes beside the scene (MSFT_lod), which three.js does not load by itself.
async function showOnly(gltf, name) {
  const index = gltf.parser.json.nodes.findIndex((node) => node.name === name);
  if (index < 0) throw new Error(`the model has no node ${name}`);
  const chosen = await gltf.parser.getDependency("node", index);
  if (chosen.parent === null) gltf.scene.add(chosen);
  gltf.scene.traverse((object) => object.layers.set(HIDDEN));
  chosen.traverse((object) => object.layers.set(SHOWN));
}

function describe(material) {
  const { name, type, alphaTest, transparent, side, map } = material;
  const picture = map && {
    width: map.image.width,
    height: map.image.height,
    min: FILTERS[map.minFilter],
    mag: FILTERS[map.magFilter],
    compressed: Boolean(map.isCompressedTexture),
  };
  return { name, type, alphaTest, transparent, side: SIDES[side], map: picture };
}

// A sun and an even sky as bbfit has them (docs/engines.md).
const sun = new THREE.DirectionalLight();
const sky = new THREE.AmbientLight();

function illuminate({ direction, strength, color, ambient }) {
  sun.position.set(...direction);
  sun.color.setRGB(...color);
  sun.intensity = strength;
  sky.intensity = Math.PI * ambient;
  scene.add(sun, sun.target, sky);
  scene.updateMatrixWorld(true);
}

// Lights the scene by an equirectangular picture: 32-bit RGBA in base 64, the bottom row first.
export function surround({ values, width, height }) {
  const bytes = Uint8Array.from(atob(values), (letter) => letter.charCodeAt(0));
  const picture = new THREE.DataTexture(new Float32Array(bytes.buffer), width, height, THREE.RGBAFormat, THREE.FloatType);
  picture.mapping = THREE.EquirectangularReflectionMapping;
  picture.minFilter = picture.magFilter = THREE.LinearFilter;
  picture.needsUpdate = true;
  scene.environment = picture;
}

export function draw({ projection, cameraToWorld, width, height, light }) {
  renderer.setSize(width, height, false);
  if (light !== null) illuminate(light);
  const camera = new THREE.Camera();
  camera.matrixAutoUpdate = camera.matrixWorldAutoUpdate = false;
  camera.matrixWorld.fromArray(cameraToWorld);
  camera.matrixWorldInverse.copy(camera.matrixWorld).invert();
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  renderer.render(scene, camera);
  return renderer.info.render;
}
