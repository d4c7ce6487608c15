// model-viewer. It has an orbit, a target and a vertical field of view: its cameras are upright and look at the middle of the picture, and
// it has no parallel projection. It maps no tones of unlit materials. With ?anisotropy=1 textures are filtered as glTF's samplers say, and
// bbfit does. Its own level is 4, for which it has no setting: it sets the default of three.js.
import { canvas, centered, query, refuse } from "/page.js";
import "model-viewer";

const viewer = document.createElement("model-viewer");
const limits = { "min-camera-orbit": "-Infinity 0deg 0m", "min-field-of-view": "1deg", "max-field-of-view": "170deg" };
for (const [name, value] of Object.entries({ ...limits, "tone-mapping": "none" })) viewer.setAttribute(name, value);
viewer.constructor.minimumRenderScale = 1;
canvas.replaceWith(viewer);

export async function load(node) {
  refuse(node);
  const loaded = new Promise((resolve, reject) => {
    viewer.addEventListener("load", resolve, { once: true });
    viewer.addEventListener("error", ({ detail }) => reject(new Error(detail.type)), { once: true });
  });
  viewer.src = `/model.glb?${performance.now()}`; // it keeps models by their addresses
  await loaded;
  if (query.has("anisotropy")) scene().traverse(({ material }) => filter(material?.map, Number(query.get("anisotropy"))));
}

export async function draw({ projection, cameraToWorld, width, height, near, far }) {
  const distance = (near + far) / 2;
  const [right, back, position] = [0, 8, 12].map((start) => cameraToWorld.slice(start, start + 3));
  centered(projection);
  if (Math.abs(right[1]) > 1e-9) throw new Error("model-viewer has upright cameras only");
  Object.assign(viewer.style, { width: `${width}px`, height: `${height}px` });
  viewer.cameraTarget = position.map((place, axis) => `${place - distance * back[axis]}m`).join(" ");
  viewer.cameraOrbit = `${Math.atan2(-right[2], right[0])}rad ${Math.acos(back[1])}rad ${distance}m`;
  viewer.maxCameraOrbit = `Infinity 180deg ${2 * distance}m`;
  viewer.fieldOfView = `${2 * Math.atan(1 / projection[5])}rad`;
  await viewer.updateComplete;
  viewer.jumpCameraToGoal();
  await new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve)));
  return { picture: await createImageBitmap(await viewer.toBlob()) };
}

// The scene of three.js, which it does not show.
function scene() {
  return viewer[Object.getOwnPropertySymbols(viewer).find(({ description }) => description === "scene")];
}

function filter(texture, anisotropy) {
  if (texture) Object.assign(texture, { anisotropy, needsUpdate: true });
}
