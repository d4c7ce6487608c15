// Draws many copies of a tree that `bbfit lod` wrote in three.js, each at the level of detail for its distance:
//   const field = await loadField("levels/lod.json", matrices, { height: renderer.domElement.height, fov: camera.fov });
//   scene.add(field);
//   renderer.setAnimationLoop(() => { field.update(camera); renderer.render(scene, camera); });
// matrices are 16 numbers for each copy, column after column: where it stands, its turn, and its size. Levels fade into each other by
// dithering: each pixel shows one of the two, so masks stay masks. Copies outside the picture are left out.
import { DynamicDrawUsage, Frustum, Group, InstancedBufferAttribute, InstancedMesh, MathUtils, Matrix4, Sphere, Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const BUCKETS = 256; // of distances, by which copies are sorted
const focal = (height, fov) => height / 2 / Math.tan(MathUtils.degToRad(fov) / 2);

export async function loadField(url, matrices, { height, fov, loader = new GLTFLoader(), fade = 0.1 } = {}) {
  const { config, extent, levels } = await (await fetch(url)).json();
  const factor = height && fov ? focal(height, fov) / focal(config.screen_height, config.screen_fov_degrees) : 1;
  const loaded = levels.map(async ({ file, distance_meters }) => {
    const { scene } = await loader.loadAsync(new URL(file, new URL(url, location)).href);
    return { object: scene, distance: factor * distance_meters };
  });
  return new TreeField(await Promise.all(loaded), extent, matrices, { fade });
}

// levels: { object, distance } for each, finest first, and from which distance in meters a copy of the tree's own size shows it.
// extent: the corners low and high of the tree's bounds. A copy of twice the size keeps its level to twice the distance.
export class TreeField extends Group {
  constructor(levels, extent, matrices, { fade = 0.1 } = {}) {
    super();
    const low = new Vector3(...extent.low);
    const high = new Vector3(...extent.high);
    this.center = low.clone().lerp(high, 0.5);
    this.radius = low.distanceTo(high) / 2;
    this.fade = fade;
    this.levels = levels.map(({ object, distance }) => ({ distance, parts: partsOf(object), capacity: 0, count: 0 }));
    this.setMatrices(matrices);
  }

  setMatrices(matrices) {
    this.matrices = matrices;
    this.count = matrices.length / 16;
    this.spheres = new Float32Array(4 * this.count); // center and scale of each copy
    const matrix = new Matrix4();
    const center = new Vector3();
    for (let copy = 0; copy < this.count; copy += 1) {
      matrix.fromArray(matrices, 16 * copy);
      center.copy(this.center).applyMatrix4(matrix).toArray(this.spheres, 4 * copy);
      this.spheres[4 * copy + 3] = matrix.getMaxScaleOnAxis();
    }
    this.chosen = new Uint8Array(this.count); // the coarsest level that a copy shows, whole or in part
    this.progress = new Float32Array(this.count); // how far that level has faded in
    this.buckets = new Uint8Array(this.count);
    this.sorted = new Uint32Array(this.count);
  }

  // Chooses the levels for a camera; call it before each frame.
  update(camera) {
    this.updateWorldMatrix(true, false);
    camera.updateWorldMatrix(true, false);
    const seen = this.#choose(camera);
    this.levels.forEach((level, index) => this.#fill(level, index, seen));
  }

  // Chooses level, progress and place in the order for each copy in the picture; returns their number, with their indices in this.sorted.
  #choose(camera) {
    const inverse = this.matrixWorld.clone().invert();
    const toClip = new Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse.copy(camera.matrixWorld).invert());
    const frustum = new Frustum().setFromProjectionMatrix(toClip.multiply(this.matrixWorld), camera.coordinateSystem);
    const eye = new Vector3().setFromMatrixPosition(camera.matrixWorld).applyMatrix4(inverse);
    const ahead = new Vector3().setFromMatrixColumn(camera.matrixWorld, 2).transformDirection(inverse).negate();
    // An orthographic camera shows all copies at one size, as from the distance where a field of view of 50 degrees has that size.
    const parallel = camera.isOrthographicCamera ? (camera.top - camera.bottom) / camera.zoom / 2 / Math.tan(MathUtils.degToRad(25)) : 0;
    const sphere = new Sphere();
    const distances = this.levels.map((level) => level.distance);
    const [nearest, farthest] = this.#reach(eye, ahead);
    const perBucket = (BUCKETS - 1e-3) / Math.max(farthest - nearest, 1e-6);
    const counts = new Uint32Array(BUCKETS + 1);
    const shown = new Uint32Array(this.count);
    let seen = 0;
    for (let copy = 0; copy < this.count; copy += 1) {
      const at = 4 * copy;
      sphere.center.fromArray(this.spheres, at);
      const scale = this.spheres[at + 3];
      sphere.radius = this.radius * scale;
      if (!frustum.intersectsSphere(sphere)) continue;
      const depth = sphere.center.sub(eye).dot(ahead);
      const distance = (parallel || sphere.center.length() / camera.zoom) / scale;
      let level = distances.length - 1;
      while (level > 0 && distance < distances[level]) level -= 1;
      this.chosen[copy] = level;
      this.progress[copy] = level === 0 || this.fade === 0 ? 1 : Math.min(1, (distance - distances[level]) / (this.fade * distances[level]));
      this.buckets[copy] = Math.min(Math.max((depth - nearest) * perBucket, 0), BUCKETS - 1);
      counts[this.buckets[copy] + 1] += 1;
      shown[seen] = copy;
      seen += 1;
    }
    for (let bucket = 0; bucket < BUCKETS; bucket += 1) counts[bucket + 1] += counts[bucket];
    for (let index = 0; index < seen; index += 1) this.sorted[counts[this.buckets[shown[index]]]++] = shown[index];
    return seen;
  }

  // The least and the greatest depth of copies.
  #reach(eye, ahead) {
    let [nearest, farthest] = [Infinity, -Infinity];
    for (let at = 0; at < this.spheres.length; at += 4) {
      const depth = (this.spheres[at] - eye.x) * ahead.x + (this.spheres[at + 1] - eye.y) * ahead.y + (this.spheres[at + 2] - eye.z) * ahead.z;
      if (depth > 0) [nearest, farthest] = [Math.min(nearest, depth), Math.max(farthest, depth)];
    }
    return [nearest, farthest];
  }

  // Writes the copies that show a level: masks from front to back, so that hidden pixels are not shaded, and blended ones from back to front.
  #fill(level, index, seen) {
    if (level.capacity === 0) this.#reserve(level, Math.max(16, Math.ceil(this.count / 8)));
    const shows = (copy) => this.chosen[copy] === index || (this.chosen[copy] === index + 1 && this.progress[copy] < 1);
    let needed = 0;
    for (let place = 0; place < seen; place += 1) needed += shows(this.sorted[place]);
    if (needed > level.capacity) this.#reserve(level, Math.min(this.count, Math.max(needed, 2 * level.capacity)));
    const { matrix, fading, parts } = level;
    const backwards = parts.some(({ material }) => material.transparent);
    let count = 0;
    for (let step = 0; step < seen && count < needed; step += 1) {
      const copy = this.sorted[backwards ? seen - 1 - step : step];
      if (!shows(copy)) continue;
      for (let entry = 0; entry < 16; entry += 1) matrix.array[16 * count + entry] = this.matrices[16 * copy + entry];
      const own = this.chosen[copy] === index;
      // A copy shows the pixels whose noise, in [0, 1), lies between the two: the coarser level those below its progress.
      fading.array[2 * count] = own ? 0 : this.progress[copy];
      fading.array[2 * count + 1] = own ? this.progress[copy] : 1;
      count += 1;
    }
    level.count = count;
    for (const attribute of [matrix, fading]) {
      attribute.clearUpdateRanges();
      attribute.addUpdateRange(0, count * attribute.itemSize);
      attribute.needsUpdate = count > 0;
    }
    for (const mesh of level.meshes) Object.assign(mesh, { count, visible: count > 0 });
  }

  #reserve(level, capacity) {
    this.remove(...(level.meshes ?? []));
    level.meshes?.forEach((mesh) => mesh.dispose());
    Object.assign(level, { capacity, matrix: attribute(16, capacity), fading: attribute(2, capacity) });
    level.meshes = level.parts.map(({ geometry, material }) => {
      const shared = geometry.clone();
      for (const [name, values] of Object.entries(geometry.attributes)) shared.setAttribute(name, values);
      shared.setIndex(geometry.index).setAttribute("fading", level.fading);
      const mesh = new InstancedMesh(shared, material, 0);
      Object.assign(mesh, { instanceMatrix: level.matrix, frustumCulled: false });
      return mesh;
    });
    this.add(...level.meshes);
  }
}

function attribute(size, count) {
  return new InstancedBufferAttribute(new Float32Array(size * count), size).setUsage(DynamicDrawUsage);
}

// The meshes of a model, with their places in it applied.
function partsOf(object) {
  const parts = [];
  object.updateWorldMatrix(true, true);
  object.traverse((mesh) => {
    if (!mesh.isMesh) return;
    const moved = !mesh.matrixWorld.equals(new Matrix4());
    const geometry = moved ? mesh.geometry.clone().applyMatrix4(mesh.matrixWorld) : mesh.geometry;
    parts.push({ geometry, material: dithered(mesh.material) });
  });
  return parts;
}

// Interleaved gradient noise (Jimenez 2014, "Next generation post processing in Call of Duty: Advanced Warfare").
function dithered(material) {
  const before = material.onBeforeCompile;
  material.onBeforeCompile = (shader, renderer) => {
    before.call(material, shader, renderer);
    shader.vertexShader = shader.vertexShader.replace("void main() {", `attribute vec2 fading;
flat varying vec2 shown;
void main() {
  shown = fading;`);
    shader.fragmentShader = shader.fragmentShader.replace("void main() {", `flat varying vec2 shown;
void main() {
  float noise = fract( 52.9829189 * fract( dot( gl_FragCoord.xy, vec2( 0.06711056, 0.00583715 ) ) ) );
  if ( noise < shown.x || noise >= shown.y ) discard;`);
  };
  return material;
}
