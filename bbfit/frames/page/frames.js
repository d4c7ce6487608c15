// What the pages of all programs share. frames.html?program=NAME imports NAME.js, which exports
//   load(model)  loads a model: its kind (mesh, impostor, levels), its files with the distances of levels, and its extent
//   plant(field) draws copies of it from now on: their matrices, and an orthographic camera
//   frame()      draws a frame and waits until it is drawn; returns the milliseconds that choosing levels took
//   facts()      draw calls and triangles of the last frame, and bytes on the graphics card
//   fragments()  the number of fragments that the triangles of a frame have, or null
//   level()      the level of detail of the last picture
//   picture(view)  the RGBA of one copy from a held-out view over a color
const canvas = document.getElementById("canvas");
export const query = new URLSearchParams(location.search);
const program = import(`/${query.get("program")}.js`);

export function sized(width, height) {
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  return canvas;
}

window.load = async (model) => (await program).load(model);

window.plant = async ({ matrices, ...field }) => {
  const values = new Float32Array(await (await fetch(matrices)).arrayBuffer());
  return (await program).plant({ ...field, matrices: values });
};

// The first frame compiles shaders and uploads textures, so it does not count. A frame that takes far too long is the only one.
window.measure = async ({ frames, seconds, longest_ms }) => {
  const { frame, facts } = await program;
  const first = timed(frame);
  const times = [];
  const updates = [];
  const begun = performance.now();
  do {
    const { time, update } = timed(frame);
    times.push(time);
    updates.push(update);
  } while (times[0] < 2 * longest_ms && (times.length < frames || performance.now() - begun < 1000 * seconds) && times.length < 500);
  return { first: first.time, times, updates, ...facts() };
};

function timed(frame) {
  const begun = performance.now();
  const update = frame();
  return { time: performance.now() - begun, update };
}

window.fragments = async () => (await program).fragments();

window.level = async () => (await program).level();

window.picture = async (view) => {
  const bytes = await (await program).picture(view);
  let text = "";
  for (let start = 0; start < bytes.length; start += 8192) text += String.fromCharCode(...bytes.subarray(start, start + 8192));
  return btoa(text);
};

window.machine = async () => {
  const gl = new OffscreenCanvas(1, 1).getContext("webgl2");
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return { renderer: gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER), version: (await program).version };
};
