// Draws many copies of a tree that `bbfit lod` wrote in three.js, each at the level of detail for its distance:
//   const field = await loadField("levels/lod.json", matrices, { height: renderer.domElement.height, fov: camera.fov });
//   scene.add(field);
//   renderer.setAnimationLoop(() => { field.update(camera); renderer.render(scene, camera); });
// matrices are 16 numbers for each copy, column after column: where it stands, its turn, and its size. Levels fade into each other by
// dithering: each pixel shows one of the two, so masks stay masks. Copies outside the picture are left out.
// Copies may come and go in patches, such as the tiles of a map: field.addPatch(matrices) returns a patch for field.removePatch(patch).
import {
  Box3, BufferAttribute, DynamicDrawUsage, Frustum, Group, InstancedBufferAttribute, InstancedMesh, MathUtils, Matrix4, Sphere, Vector3,
} from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const BUCKETS = 256; // of distances, by which copies are sorted
const DITHERED = new WeakSet(); // materials whose shaders fade
const focal = (height, fov) => height / 2 / Math.tan(MathUtils.degToRad(fov) / 2);

export async function loadField(url, matrices, { height, fov, loader = new GLTFLoader(), fade = 0.1, farthest = Infinity } = {}) {
  const { config, extent, levels } = await (await fetch(url)).json();
  const factor = height && fov ? focal(height, fov) / focal(config.screen_height, config.screen_fov_degrees) : 1;
  const loaded = levels.map(async ({ file, distance_meters }) => {
    const { scene } = await loader.loadAsync(new URL(encodeURIComponent(file), new URL(url, location)).href);
    return { object: scene, distance: factor * distance_meters };
  });
  return new TreeField(await Promise.all(loaded), extent, matrices, { fade, farthest });
}

// levels: { object, distance } for each, finest first, and from which distance in meters a copy of the tree's own size shows it.
// extent: the corners low and high of the tree's bounds. A copy of twice the size keeps its level to twice the distance.
// farthest: the distance in meters beyond which copies are left out.
export class TreeField extends Group {
  constructor(levels, extent, matrices = [], { fade = 0.1, farthest = Infinity } = {}) {
    super();
    const low = new Vector3(...extent.low);
    const high = new Vector3(...extent.high);
    this.center = low.clone().lerp(high, 0.5);
    this.radius = low.distanceTo(high) / 2;
    this.fade = fade;
    this.farthest = farthest;
    this.levels = [];
    this.setLevels(levels);
    this.setMatrices(matrices);
  }

  // Other levels, finest first, such as one more that has been loaded. An object that was a level before stays as it is on the card.
  setLevels(levels) {
    const before = new Map(this.levels.map((level) => [level.object, level]));
    this.levels = levels.map(({ object, distance }) => {
      const level = before.get(object) ?? { object, parts: partsOf(object), capacity: 0, count: 0 };
      before.delete(object);
      return Object.assign(level, { distance });
    });
    for (const level of before.values()) this.#release(level);
  }

  setMatrices(matrices) {
    this.count = 0;
    this.patches = [];
    this.#makeRoom(matrices.length / 16);
    if (matrices.length > 0) this.addPatch(matrices);
  }

  // Adds copies that stand near each other. A patch outside the picture costs no time.
  addPatch(matrices) {
    const patch = { start: this.count, count: matrices.length / 16, bounds: new Sphere(), largest: 0 }; // the largest scale
    if (this.count + patch.count > this.chosen.length) this.#makeRoom(Math.ceil(1.5 * (this.count + patch.count)));
    this.matrices.set(matrices, 16 * patch.start);
    this.count += patch.count;
    const matrix = new Matrix4();
    const center = new Vector3();
    const box = new Box3();
    for (let copy = patch.start; copy < this.count; copy += 1) {
      matrix.fromArray(this.matrices, 16 * copy);
      center.copy(this.center).applyMatrix4(matrix).toArray(this.spheres, 4 * copy);
      this.spheres[4 * copy + 3] = matrix.getMaxScaleOnAxis();
      box.expandByPoint(center);
    }
    box.getBoundingSphere(patch.bounds);
    for (let copy = patch.start; copy < this.count; copy += 1) patch.largest = Math.max(patch.largest, this.spheres[4 * copy + 3]);
    patch.bounds.radius += this.radius * patch.largest;
    this.patches.push(patch);
    return patch;
  }

  removePatch(patch) {
    const end = patch.start + patch.count;
    this.matrices.copyWithin(16 * patch.start, 16 * end, 16 * this.count);
    this.spheres.copyWithin(4 * patch.start, 4 * end, 4 * this.count);
    this.patches.splice(this.patches.indexOf(patch), 1);
    for (const other of this.patches) if (other.start >= end) other.start -= patch.count;
    this.count -= patch.count;
  }

  // The copies that the last update found in the picture.
  get shown() {
    return this.seen ?? 0;
  }

  // Frees what the field has on the graphics card; geometries and materials belong to the objects of the levels.
  dispose() {
    this.levels.forEach((level) => this.#release(level));
  }

  #makeRoom(copies) {
    const { matrices = [], spheres = [] } = this;
    this.matrices = new Float32Array(16 * copies);
    this.spheres = new Float32Array(4 * copies); // center and scale of each copy
    if (this.count > 0) {
      this.matrices.set(matrices.subarray(0, 16 * this.count));
      this.spheres.set(spheres.subarray(0, 4 * this.count));
    }
    this.chosen = new Uint8Array(copies); // the coarsest level that a copy shows, whole or in part
    this.progress = new Float32Array(copies); // how far that level has faded in
    this.buckets = new Uint8Array(copies);
    this.candidates = new Uint32Array(copies);
    this.sorted = new Uint32Array(copies);
  }

  // Chooses the levels for a camera; call it before each frame.
  update(camera) {
    this.updateWorldMatrix(true, false);
    camera.updateWorldMatrix(true, false);
    this.seen = this.#choose(camera);
    this.levels.forEach((level, index) => this.#fill(level, index, this.seen));
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
    const inside = ({ bounds }) => frustum.intersectsSphere(bounds) && bounds.distanceToPoint(eye) < this.farthest;
    const patches = this.patches.filter(inside);
    const [nearest, farthest] = this.#reach(patches, eye, ahead);
    const perBucket = (BUCKETS - 1e-3) / Math.max(farthest - nearest, 1e-6);
    const counts = new Uint32Array(BUCKETS + 1);
    let seen = 0;
    for (const { start, count } of patches) {
      for (let copy = start; copy < start + count; copy += 1) {
        const at = 4 * copy;
        sphere.center.fromArray(this.spheres, at);
        const scale = this.spheres[at + 3];
        sphere.radius = this.radius * scale;
        if (!frustum.intersectsSphere(sphere)) continue;
        const depth = sphere.center.sub(eye).dot(ahead);
        const away = sphere.center.length();
        if (away > this.farthest) continue;
        const distance = (parallel || away / camera.zoom) / scale;
        let level = distances.length - 1;
        while (level > 0 && distance < distances[level]) level -= 1;
        const into = (distance - distances[level]) / (this.fade * distances[level]);
        this.chosen[copy] = level;
        this.progress[copy] = level === 0 || this.fade === 0 ? 1 : Math.min(1, into);
        this.buckets[copy] = Math.min(Math.max((depth - nearest) * perBucket, 0), BUCKETS - 1);
        counts[this.buckets[copy] + 1] += 1;
        this.candidates[seen] = copy;
        seen += 1;
      }
    }
    for (let bucket = 0; bucket < BUCKETS; bucket += 1) counts[bucket + 1] += counts[bucket];
    for (let index = 0; index < seen; index += 1) {
      const copy = this.candidates[index];
      this.sorted[counts[this.buckets[copy]]++] = copy;
    }
    return seen;
  }

  // The least and the greatest depth that copies of patches may have.
  #reach(patches, eye, ahead) {
    let [nearest, farthest] = [Infinity, 0];
    for (const { bounds } of patches) {
      const depth = bounds.center.clone().sub(eye).dot(ahead);
      nearest = Math.min(nearest, Math.max(0, depth - bounds.radius));
      farthest = Math.max(farthest, Math.min(this.farthest, depth + bounds.radius));
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
      const length = count * attribute.itemSize;
      attribute.clearUpdateRanges?.();
      if (attribute.addUpdateRange) attribute.addUpdateRange(0, length);
      else Object.assign(attribute.updateRange, { offset: 0, count: length }); // before three.js 0.159
      attribute.needsUpdate = count > 0;
    }
    for (const mesh of level.meshes) Object.assign(mesh, { count, visible: count > 0 });
  }

  #reserve(level, capacity) {
    this.#release(level);
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

  // The buffers of copies. Vertices stay on the card, for the geometries of meshes share them.
  #release(level) {
    this.remove(...(level.meshes ?? []));
    level.meshes?.forEach((mesh) => mesh.dispose());
    Object.assign(level, { capacity: 0, count: 0, meshes: undefined });
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
    const geometry = moved ? withFloats(mesh.geometry.clone()).applyMatrix4(mesh.matrixWorld) : mesh.geometry;
    parts.push({ geometry, material: dithered(mesh.material) });
  });
  return parts;
}

// Floats in place of integers that a matrix changes: a moved position is no integer.
function withFloats(geometry) {
  for (const name of ["position", "normal", "tangent"]) {
    const values = geometry.attributes[name];
    if (!values || values.array instanceof Float32Array) continue;
    const { itemSize, count, normalized, array, data = { stride: itemSize }, offset = 0 } = values;
    const signed = array instanceof Int8Array || array instanceof Int16Array;
    const most = normalized ? 2 ** (8 * array.BYTES_PER_ELEMENT - signed) - 1 : 1;
    const floats = Float32Array.from({ length: itemSize * count }, (_, index) =>
      array[Math.floor(index / itemSize) * data.stride + offset + (index % itemSize)] / most);
    geometry.setAttribute(name, new BufferAttribute(floats, itemSize));
  }
  return geometry;
}

// Interleaved gradient noise (Jimenez 2014, "Next generation post processing in Call of Duty: Advanced Warfare").
function dithered(material) {
  if (DITHERED.has(material)) return material; // of several meshes
  DITHERED.add(material);
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
