// Loads an octahedral impostor that bbfit wrote (Brucks 2018, "Octahedral Impostors") as a mesh for three.js:
//   scene.add(await loadImpostor("model.glb"));
// The mesh can be moved, turned and scaled. For a forest, give its geometry and material to an InstancedMesh.
// Options: a GLTFLoader of your own, and parallax, the number of steps to the depth of a frame, if it is to differ from the file's.
import { Mesh, NoColorSpace, ShaderMaterial, Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

export async function loadImpostor(url, { loader = new GLTFLoader(), parallax } = {}) {
  const { scene, parser } = await loader.loadAsync(url);
  const { frames, hemisphere, center, radius, levels, heights, ...file } = parser.json.meshes[0].extras;
  let quad;
  scene.traverse((object) => object.isMesh && (quad = object));
  const { map, transparent, alphaTest } = quad.material;
  const textures = { colors: map, heights: heights === null ? map : await parser.getDependency("texture", heights) };
  for (const texture of Object.values(textures)) texture.colorSpace = NoColorSpace; // bbfit filters and mixes colors as displayed
  const uniforms = { ...textures, center: new Vector3(...center), radius, frames, levels, texels: map.image.width / frames, alphaTest };
  const steps = heights === null ? 0 : (parallax ?? file.parallax);
  const material = new ShaderMaterial({
    uniforms: Object.fromEntries(Object.entries(uniforms).map(([name, value]) => [name, { value }])),
    defines: { PARALLAX: steps, HEMISPHERE: hemisphere, MASK: !transparent, PER_PIXEL: file.per_pixel },
    vertexShader,
    fragmentShader,
    transparent,
    depthWrite: !transparent,
    premultipliedAlpha: true,
    toneMapped: false,
  });
  return new Mesh(quad.geometry, material);
}

// All positions are those of the model, in meters. A frame has axes to the right, down and away from its viewer.
const shared = `
uniform vec3 center;
uniform float radius;
varying vec3 start, ray; // a point on the ray of a pixel, relative to the center, and its direction
flat varying vec3 viewer; // the direction from the center to the viewer

// Right, down and away of a picture seen from a direction, upright; straight from above or below, -Z is up.
mat3 axes(vec3 direction) {
  vec3 right = normalize(cross(length(direction.xz) < 1e-6 ? vec3(0.0, 0.0, -1.0) : vec3(0.0, 1.0, 0.0), direction));
  return mat3(right, cross(right, direction), -direction);
}
`;

const vertexShader = `${shared}
void main() {
  mat4 toCamera = modelViewMatrix;
#ifdef USE_INSTANCING
  toCamera *= instanceMatrix;
#endif
  mat4 toModel = inverse(toCamera);
  bool parallel = projectionMatrix[2][3] == 0.0;
  vec3 eye = toModel[3].xyz - center;
  viewer = normalize(parallel ? toModel[2].xyz : eye);

  // The quad faces the viewer and hides the bounding sphere: the cone around the sphere, where it crosses the plane of the quad.
  float sine = parallel ? 0.0 : radius / length(eye);
  vec2 side = radius / sqrt(max(1.0 - sine * sine, 1e-3)) * sign(position.xy - center.xy);
  start = axes(viewer) * vec3(side.x, -side.y, 0.0);
  ray = parallel ? -viewer : start - eye;
  gl_Position = projectionMatrix * toCamera * vec4(center + start, 1.0);
}
`;

const fragmentShader = `${shared}
uniform sampler2D colors, heights;
uniform float frames, levels, texels, alphaTest;

// The grid's directions, by column and row, and its inverse, in [-1, 1].
vec3 towards(vec2 cell) {
  vec2 place = 2.0 * cell / (frames - 1.0) - 1.0;
#ifdef HEMISPHERE
  vec2 xz = vec2(place.x + place.y, place.y - place.x) / 2.0;
  return normalize(vec3(xz.x, 1.0 - abs(xz.x) - abs(xz.y), xz.y));
#else
  float y = 1.0 - abs(place.x) - abs(place.y);
  vec2 xz = place - max(-y, 0.0) * mix(vec2(-1.0), vec2(1.0), greaterThanEqual(place, vec2(0.0)));
  return normalize(vec3(xz.x, y, xz.y));
#endif
}

vec2 place(vec3 direction) {
#ifdef HEMISPHERE
  direction.y = max(direction.y, 0.0);
#endif
  direction /= max(abs(direction.x) + abs(direction.y) + abs(direction.z), 1e-12);
#ifdef HEMISPHERE
  return vec2(direction.x - direction.z, direction.x + direction.z);
#else
  return direction.xz + max(-direction.y, 0.0) * mix(vec2(-1.0), vec2(1.0), greaterThanEqual(direction.xz, vec2(0.0)));
#endif
}

// The place in the atlas of a point on a frame's plane, at least half a texel of the coarser mip level within the frame.
vec2 inAtlas(vec2 cell, vec2 point, float level) {
  float margin = exp2(ceil(level)) / (2.0 * texels);
  return (cell + clamp((point / radius + 1.0) / 2.0, margin, 1.0 - margin)) / frames;
}

// What the ray sees of a frame, premultiplied: it meets the frame's plane, then moves to the depth that the frame shows there.
vec4 seen(vec2 cell, float level) {
  mat3 frame = axes(towards(cell));
  vec3 from = start * frame, along = ray * frame;
  along /= max(along.z, 1e-3 * length(along)); // edge-on and from behind, a frame shows nothing
  vec2 point = from.xy - from.z * along.xy;
  for (int i = 0; i < PARALLAX; i++) {
    float height = radius * (2.0 * textureLod(heights, inAtlas(cell, point, level), level).r - 1.0);
    point = from.xy - (from.z + height) * along.xy;
  }
  if (max(abs(point.x), abs(point.y)) > radius) return vec4(0.0);
  vec4 color = textureLod(colors, inAtlas(cell, point, level), level);
  return vec4(color.rgb * color.a, color.a);
}

void main() {
  float pixel = max(length(dFdx(start)), length(dFdy(start)));
  float level = clamp(log2(texels / (2.0 * radius) * pixel), 0.0, levels);

  // The corners of the grid's triangle around the direction against the ray, and its weights there.
#ifdef PER_PIXEL
  vec2 at = (place(-normalize(ray)) + 1.0) / 2.0 * (frames - 1.0);
#else
  vec2 at = (place(viewer) + 1.0) / 2.0 * (frames - 1.0);
#endif
  vec2 cell = clamp(floor(at), 0.0, frames - 2.0);
  vec2 part = clamp(at - cell, 0.0, 1.0);
  vec2 other = part.x > part.y ? vec2(1.0, 0.0) : vec2(0.0, 1.0);
  float most = max(part.x, part.y), least = min(part.x, part.y);
  vec4 mixed = (1.0 - most) * seen(cell, level) + (most - least) * seen(cell + other, level) + least * seen(cell + 1.0, level);
#ifdef MASK
  if (mixed.a < alphaTest) discard;
  mixed /= mixed.a;
#endif
  if (mixed.a == 0.0) discard;
  gl_FragColor = sRGBTransferEOTF(vec4(mixed.rgb / mixed.a, mixed.a));
  #include <colorspace_fragment>
  #include <premultiplied_alpha_fragment>
}
`;
