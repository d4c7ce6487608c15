// What the pages of all programs share. browser_viewer.py opens page.html?program=NAME, which imports NAME_page.js. That module exports
//   load(node)  loads /model.glb in place of the model before; node is the name of the only node to show, or null. It may return materials.
//   draw(view)  draws one view on the canvas of the page, or returns another `picture`. It may also return its `calls` and `triangles`.
// A view has the `width` and `height` of the picture and a `light` or null. `projection` and `cameraToWorld` are lists of 16 numbers, column
// after column as OpenGL has them, for OpenGL's axes of a camera. The model lies between the depths `near` and `far`, in meters.
export const canvas = document.getElementById("canvas");
export const query = new URLSearchParams(location.search);

const program = import(`/${query.get("program")}_page.js`);
const paper = new OffscreenCanvas(1, 1);

window.load = async (node) => (await (await program).load(node)) ?? [];

window.draw = async (view) => {
  resize(view);
  const { picture = canvas, calls = 0, triangles = 0 } = (await (await program).draw(view)) ?? {};
  return { calls, triangles, pixels: read(picture, view) };
};

window.surround = async (sky) => (await program).surround(sky);

// Loads a program that is no module.
export function script(address) {
  const element = Object.assign(document.createElement("script"), { src: address });
  return new Promise((resolve, reject) => {
    Object.assign(element, { onload: resolve, onerror: () => reject(new Error(`${address} does not load`)) });
    document.head.append(element);
  });
}

// For programs that show whole models only.
export function refuse(node) {
  if (node !== null) throw new Error("this page shows whole models");
}

// For programs whose cameras look at the middle of the picture.
export function centered(projection) {
  if (projection[11] !== -1 || Math.hypot(projection[8], projection[9]) > 1e-9) throw new Error("this program has no such camera");
}

function resize({ width, height }) {
  if (canvas.width !== width) canvas.width = width;
  if (canvas.height !== height) canvas.height = height;
  Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
}

// What a white page shows of a picture: RGBA bytes in base 64, the top row first.
function read(picture, { width, height }) {
  if (picture.width !== width || picture.height !== height) throw new Error("the canvas has another size");
  Object.assign(paper, { width, height });
  const context = paper.getContext("2d", { willReadFrequently: true });
  context.fillStyle = "white";
  context.fillRect(0, 0, width, height);
  context.drawImage(picture, 0, 0);
  const bytes = context.getImageData(0, 0, width, height).data;
  let text = "";
  for (let start = 0; start < bytes.length; start += 8192) text += String.fromCharCode(...bytes.subarray(start, start + 8192));
  return btoa(text);
}
