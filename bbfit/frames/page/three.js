// Fields of trees in three.js: see frames.js.
import { sized } from "/frames.js";
import { TreeField } from "/lod_field_three.js";
import { loadImpostor } from "/impostor_three.js";
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { KTX2Loader } from "three/addons/loaders/KTX2Loader.js";

export const version = `three.js ${THREE.REVISION}`;

// Masks are drawn with alpha to coverage, with a ramp around the cutoff, as docs/engines.md describes.
THREE.ShaderChunk.alphatest_fragment = THREE.ShaderChunk.alphatest_fragment.replace(
  "smoothstep( alphaTest, alphaTest + fwidth( diffuseColor.a ), diffuseColor.a )",
  "clamp( ( diffuseColor.a - alphaTest ) / max( fwidth( diffuseColor.a ), 0.0001 ) + 0.5, 0.0, 1.0 )",
);
// Without alpha of its own: what alpha to coverage writes there would let the page through.
const canvas = sized(1, 1);
const context = canvas.getContext("webgl2", { alpha: false, antialias: true, preserveDrawingBuffer: true });
const renderer = new THREE.WebGLRenderer({ canvas, context });
renderer.setPixelRatio(1);
renderer.toneMapping = THREE.NoToneMapping;
const gl = renderer.getContext();
const textures = new KTX2Loader().setTranscoderPath("/node_modules/three/examples/jsm/libs/basis/").detectSupport(renderer);
const loader = new GLTFLoader().setKTX2Loader(textures);
const ALONE = new Float32Array(new THREE.Matrix4().elements);
const scene = new THREE.Scene();
const sun = new THREE.DirectionalLight(0xffffff, 2.5); // for materials that take light
sun.position.set(0.5, 1, 0.7);
scene.add(sun, new THREE.AmbientLight(0xffffff, 1.2));

let field = null;
let camera = null;
let update = 0;
let levels = [];

export async function load({ kind, files, extent }) {
  if (field) discard();
  levels = await Promise.all(
    files.map(async ({ url, distance }) => {
      const object = kind === "impostor" ? await loadImpostor(url, { loader }) : (await loader.loadAsync(url)).scene;
      object.traverse(({ material }) => material && prepare(material));
      return { object, distance };
    }),
  );
  field = new TreeField(levels, extent, ALONE);
  scene.add(field);
}

function discard() {
  scene.remove(field);
  for (const { object } of levels) {
    object.traverse(({ geometry, material }) => {
      geometry?.dispose();
      material?.map?.dispose();
      material?.dispose();
    });
  }
  for (const { meshes = [] } of field.levels) meshes.forEach((mesh) => (mesh.geometry.dispose(), mesh.dispose()));
}

function prepare(material) {
  if (material.userData.alphaMode === "COVERAGE") {
    Object.assign(material, { alphaToCoverage: true, alphaTest: 0, blending: THREE.CustomBlending });
    Object.assign(material, { blendSrc: THREE.OneFactor, blendDst: THREE.ZeroFactor });
    Object.assign(material, { blendSrcAlpha: THREE.ZeroFactor, blendDstAlpha: THREE.OneFactor });
  } else if (material.alphaTest > 0 && !material.isShaderMaterial) material.alphaToCoverage = true;
}

// Distances are those of levels on their own screen, for pictures of `height` pixels with a vertical field of view `fov` in degrees.
const atDistances = (height, fov) => {
  levels.forEach(({ distance }, index) => {
    field.levels[index].distance = (distance * height) / 2 / Math.tan(THREE.MathUtils.degToRad(fov) / 2);
  });
};

export function plant({ matrices, width, height, metersHigh, elevation, reach }) {
  renderer.setSize(width, height, false);
  renderer.setClearColor(0x8cb2e6, 1);
  field.setMatrices(matrices);
  const half = metersHigh / 2;
  camera = new THREE.OrthographicCamera((-half * width) / height, (half * width) / height, half, -half, 0.01 * reach, 2 * reach);
  camera.position.set(0, Math.sin(elevation), Math.cos(elevation)).multiplyScalar(reach);
  camera.lookAt(0, 0, 0);
  atDistances(height, 50); // the field of view that TreeField takes for parallel cameras
}

export function frame() {
  const begun = performance.now();
  field.update(camera);
  const chosen = performance.now() - begun;
  renderer.render(scene, camera);
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  return chosen;
}

export function facts() {
  const { calls, triangles } = renderer.info.render;
  return { calls, triangles, bytes: bytes() };
}

// Attributes and indices, matrices of copies, and textures with their mip levels.
function bytes() {
  const arrays = new Set();
  const pictures = new Set();
  field.traverse((mesh) => {
    if (!mesh.isInstancedMesh) return;
    for (const values of [...Object.values(mesh.geometry.attributes), mesh.geometry.index, mesh.instanceMatrix]) {
      if (values) arrays.add(values.isInterleavedBufferAttribute ? values.data.array : values.array);
    }
    const uniforms = Object.values(mesh.material.uniforms ?? {}).map(({ value }) => value);
    for (const value of [...Object.values(mesh.material), ...uniforms]) if (value?.isTexture) pictures.add(value);
  });
  let total = [...arrays].reduce((sum, array) => sum + array.byteLength, 0);
  for (const { isCompressedTexture, mipmaps, image, generateMipmaps } of pictures) {
    if (isCompressedTexture) total += mipmaps.reduce((sum, { data }) => sum + data.byteLength, 0);
    else total += Math.round(4 * image.width * image.height * (generateMipmaps ? 4 / 3 : 1));
  }
  return total;
}

// Draws every fragment as 1 into numbers that add up, with neither depth nor alpha.
export function fragments() {
  if (!gl.getExtension("EXT_color_buffer_float") || !gl.getExtension("EXT_float_blend")) return null;
  const size = renderer.getSize(new THREE.Vector2());
  const target = new THREE.WebGLRenderTarget(size.x, size.y, { type: THREE.FloatType, depthBuffer: false });
  const counters = new Map();
  field.traverse((mesh) => {
    if (!mesh.isInstancedMesh) return;
    if (!counters.has(mesh.material)) counters.set(mesh.material, counting(mesh.material));
    Object.assign(mesh, { material: counters.get(mesh.material) });
  });
  renderer.setRenderTarget(target);
  renderer.setClearColor(0, 0);
  renderer.clear();
  renderer.render(scene, camera);
  const values = new Float32Array(4 * size.x * size.y);
  renderer.readRenderTargetPixels(target, 0, 0, size.x, size.y, values);
  renderer.setRenderTarget(null);
  renderer.setClearColor(0x8cb2e6, 1);
  const originals = new Map([...counters].map(([material, counter]) => [counter, material]));
  field.traverse((mesh) => mesh.isInstancedMesh && (mesh.material = originals.get(mesh.material)));
  for (const counter of counters.values()) counter.dispose();
  target.dispose();
  let total = 0;
  for (let at = 0; at < values.length; at += 4) total += values[at];
  return total;
}

function counting(material) {
  const counter = material.clone();
  Object.assign(counter, { transparent: true, depthTest: false, depthWrite: false, alphaTest: 0, alphaToCoverage: false });
  Object.assign(counter, { blending: THREE.CustomBlending, blendSrc: THREE.OneFactor, blendDst: THREE.OneFactor });
  Object.assign(counter, { blendSrcAlpha: THREE.OneFactor, blendDstAlpha: THREE.OneFactor, premultipliedAlpha: false });
  counter.customProgramCacheKey = () => "counting";
  counter.onBeforeCompile = (shader, context) => {
    material.onBeforeCompile(shader, context);
    shader.fragmentShader = shader.fragmentShader.replace("void main() {", "void main() { gl_FragColor = vec4( 1.0 ); return;");
  };
  return counter;
}

export const level = () => field.chosen[0];

// One copy from a held-out view: projection and cameraToWorld are lists of 16 numbers, column after column.
export function picture({ width, height, projection, cameraToWorld, fov, color }) {
  renderer.setSize(width, height, false);
  renderer.setClearColor(new THREE.Color().setRGB(...color, THREE.SRGBColorSpace), 1);
  if (field.count !== 1) field.setMatrices(ALONE);
  atDistances(height, fov);
  const view = new THREE.PerspectiveCamera();
  view.matrixAutoUpdate = false;
  view.matrix.fromArray(cameraToWorld);
  view.updateMatrixWorld(true);
  view.projectionMatrix.fromArray(projection);
  view.projectionMatrixInverse.copy(view.projectionMatrix).invert();
  field.update(view);
  renderer.render(scene, view);
  const pixels = new Uint8Array(4 * width * height);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels); // the bottom row first
  return pixels;
}
