// Loads what `bbfit lod` wrote as a THREE.LOD for three.js, whose levels fade into each other by dithering:
//   scene.add(await loadLod("levels/lod.json", { height: renderer.domElement.height, fov: camera.fov }));
// Give a loader of your own for KTX2 textures, and fade: 0 to switch at once.
import { LOD, MathUtils, Vector2, Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

// Progress of each level's object.
const progressOf = new WeakMap();

const focal = (height, fov) => height / 2 / Math.tan(MathUtils.degToRad(fov) / 2);

export async function loadLod(url, { height, fov, loader = new GLTFLoader(), fade = 0.1 } = {}) {
  const { config, extent, levels } = await (await fetch(url)).json();
  const factor = height && fov ? focal(height, fov) / focal(config.screen_height, config.screen_fov_degrees) : 1;
  const lod = new FadingLod(new Vector3(...extent.low).lerp(new Vector3(...extent.high), 0.5), fade);
  for (const { file, distance_meters } of levels) {
    const { scene } = await loader.loadAsync(new URL(encodeURIComponent(file), new URL(url, location)).href);
    prepare(scene);
    lod.addLevel(scene, factor * distance_meters);
  }
  return lod;
}

class FadingLod extends LOD {
  constructor(center = new Vector3(), fade = 0) {
    super();
    Object.assign(this, { center, fade });
  }

  copy(source) {
    super.copy(source);
    Object.assign(this, { center: source.center, fade: source.fade });
    this.levels.forEach(({ object }) => prepare(object));
    return this;
  }

  // Each level shows the pixels whose noise, in [0, 1), lies between its own progress and that of the next one.
  update(camera) {
    const away = this.localToWorld(this.center.clone()).distanceTo(new Vector3().setFromMatrixPosition(camera.matrixWorld));
    const distance = away / camera.zoom / this.matrixWorld.getMaxScaleOnAxis();
    const progress = this.levels.map((level) => MathUtils.clamp((distance - level.distance) / (this.fade * level.distance || 1e-9), 0, 1));
    progress[0] = 1;
    this.levels.forEach(({ object }, index) => {
      const { value } = progressOf.get(object);
      value.set(progress[index + 1] ?? 0, progress[index]);
      object.visible = value.x < value.y;
    });
  }
}

// Gives a level materials of its own, which show the part of its pixels that update sets.
function prepare(object) {
  const [shown, own] = [{ value: new Vector2(0, 1) }, new Map()];
  progressOf.set(object, shown);
  object.traverse((mesh) => {
    if (!mesh.material) return;
    if (!own.has(mesh.material)) own.set(mesh.material, dithered(mesh.material.clone(), shown));
    mesh.material = own.get(mesh.material);
  });
}

// Interleaved gradient noise (Jimenez 2014, "Next generation post processing in Call of Duty: Advanced Warfare").
function dithered(material, shown) {
  material.onBeforeCompile = (shader) => {
    shader.uniforms.shown = shown;
    shader.fragmentShader = shader.fragmentShader.replace("void main() {", `uniform vec2 shown;
void main() {
  float noise = fract( 52.9829189 * fract( dot( gl_FragCoord.xy, vec2( 0.06711056, 0.00583715 ) ) ) );
  if ( noise < shown.x || noise >= shown.y ) discard;`);
  };
  return material;
}
