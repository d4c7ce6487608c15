"use strict";
// The page of a forest. The address may name a pose of the camera, #x,y,z,yaw,pitch: meters and degrees; see walker.js.
// window.forest is for tests: `ready` and `settled()` are promises for all that the camera needs to be loaded, `renderOnce()` draws a frame
// and returns its figures, and `pause()` stops the page from drawing by itself. ?antialias=0 draws one sample a pixel.
window.forest = {};
window.forest.ready = new Promise((resolve, reject) => Object.assign(window.forest, { resolveReady: resolve, rejectReady: reject }));
(async () => {
  const KEPT_TIMES = 60, LINGER = 500; // frames; milliseconds for which the page draws on after a change
  const data = window.forestData, $ = (id) => document.getElementById(id), controls = document.forms[0].elements;
  const frame = $("library"), query = new URLSearchParams(location.search);
  const THREE = await bbfit.library(frame);
  if (!frame.contentWindow.TreeField) await new Promise((resolve) => frame.addEventListener("load", resolve));
  const renderer = bbfit.createRenderer(THREE, $("canvas"), { antialias: query.get("antialias") !== "0" }), canvas = renderer.domElement;
  const scene = new THREE.Scene(), light = bbfit.createLight(THREE, scene);
  // For levels whose materials are lit, such as the tree itself: the default light of views, less what a crown keeps off.
  light.aim(30, 45);
  light.shine({ sun: 0.9 * 2.5, sky: 0.3 * Math.PI, color: [1, 1, 1] });

  let changed = performance.now(), paused = false, drawn = null, waiting = [], distance = data.drawDistance;
  const wake = () => { changed = performance.now(); };
  const groundBytes = await packs.load("ground"), cells = data.ground.cells;
  const floats = new Float32Array(groundBytes.slice(cells * cells).buffer);
  const ground = bbfitForest.createGround(THREE, scene, { ...data.ground, cover: groundBytes, heights: floats.length ? floats : null });
  const walker = bbfitForest.createWalker(THREE, canvas, ground.heightAt, wake), { camera } = walker;
  const trees = bbfitForest.createTrees(THREE, frame, data.trees, wake);
  const tiles = bbfitForest.createTiles(data.tiles, trees, (field) => scene.add(field), wake);

  const count = (value) => Math.round(value).toLocaleString("en");
  const median = (list) => [...list].sort((one, other) => one - other)[list.length >> 1];
  const height = () => camera.position.y - ground.heightAt(camera.position.x, camera.position.z);

  // The distance of the forest's farthest corner, behind which there is nothing but haze.
  const [low, high] = [Math.min, Math.max].map((pick, corner) => [0, 2].map((axis) =>
    data.tiles.reduce((end, tile) => pick(end, (corner ? tile.high : tile.low)[axis]), corner ? -Infinity : Infinity)));
  function farthestTree() {
    const { x, z } = camera.position, across = (at, axis) => Math.max(Math.abs(at - low[axis]), Math.abs(at - high[axis]));
    return Math.hypot(across(x, 0), across(z, 1), height());
  }

  function resize() {
    renderer.setPixelRatio(devicePixelRatio);
    renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
    camera.aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight);
    const focal = (pixels, fov) => pixels / 2 / Math.tan((fov * Math.PI) / 360);
    trees.setScreen(focal(renderer.domElement.height, camera.fov) / focal(data.screen.height, data.screen.fov));
    wake();
  }

  // Chooses what is shown where the camera is. Returns whether all of it is loaded.
  function update() {
    const reach = Math.hypot(distance, height()); // tiles are chosen along the ground
    Object.assign(camera, { near: Math.max(0.1, 0.02 * height()), far: 1.05 * reach + 50 });
    camera.updateProjectionMatrix();
    ground.update(camera, Math.min(reach, 1.5 * farthestTree() + 100));
    trees.setFarthest(reach);
    const missing = tiles.update(camera.position, distance);
    trees.loadFor(camera.position);
    for (const field of trees.fields) field.update(camera);
    return !missing && trees.pending === 0;
  }

  function renderOnce() {
    const begun = performance.now(), complete = update();
    renderer.render(scene, camera);
    const { calls, triangles } = renderer.info.render;
    drawn = { calls, triangles, complete, milliseconds: performance.now() - begun };
    drawn.shown = trees.fields.reduce((sum, field) => sum + field.shown, 0);
    Object.assign(drawn, { loaded: tiles.loaded, tiles: tiles.tiles.filter(({ state }) => state === "here").map(({ name }) => name) });
    if (complete || tiles.failed) {
      for (const { resolve, reject } of waiting) (tiles.failed ? reject(tiles.failed) : resolve(drawn));
      waiting = [];
    }
    return drawn;
  }

  const times = [];
  let before = null, written = 0;
  function loop(now) {
    requestAnimationFrame(loop);
    if (paused) return;
    if (before !== null) walker.step(Math.min((now - before) / 1000, 0.2));
    const active = now - changed < LINGER || !drawn?.complete;
    if (active) {
      if (before !== null) times.push(now - before);
      if (times.length > KEPT_TIMES) times.shift();
      renderOnce();
    }
    before = active ? now : null;
    if (active ? now - written > 250 : written !== null) {
      describe();
      written = active ? now : null; // all is written when the page comes to rest
    }
  }

  function describe() {
    if (times.length > 0) $("time").textContent = median(times).toFixed(1);
    for (const name of ["calls", "triangles", "shown", "loaded"]) $(name).textContent = count(drawn[name]);
    $("status").textContent = tiles.failed ? tiles.failed.message : drawn.complete ? "" : "loading …";
    controls.mode.textContent = walker.flying ? "Walk" : "Fly";
    const { x, y, z } = camera.position;
    const pose = [x, y, z, walker.yaw, walker.pitch].map((value) => String(Number(value.toFixed(2)))).join(",");
    if (location.hash !== `#${pose}`) history.replaceState(null, "", `#${pose}`);
  }

  function readPose() {
    const pose = location.hash.slice(1).split(",").map(Number);
    const whole = pose.length === 5 && pose.every(Number.isFinite);
    if (whole) walker.setPose(...pose);
    return whole;
  }

  function setDistance(meters) {
    distance = meters;
    controls.distance.value = meters;
    controls.meters.value = `${count(meters)} m`;
    wake();
  }

  function colorLevels(on) {
    controls.levels.checked = on;
    $("levels").hidden = !on;
    trees.colorLevels(on);
    wake();
  }

  const most = Math.max(...data.trees.map(({ levels }) => levels.length));
  $("levels").replaceChildren(...Array.from({ length: most }, (_, level) => {
    const item = document.createElement("li"), swatch = document.createElement("i");
    swatch.style.background = `#${trees.colors[level % trees.colors.length].toString(16).padStart(6, "0")}`;
    item.append(swatch, `level ${level}`);
    return item;
  }));
  controls.mode.addEventListener("click", () => walker.setFlying(!walker.flying));
  controls.distance.addEventListener("input", () => setDistance(Number(controls.distance.value)));
  controls.levels.addEventListener("change", () => colorLevels(controls.levels.checked));
  addEventListener("keydown", ({ code, repeat, ctrlKey, metaKey, altKey }) => {
    if (repeat || ctrlKey || metaKey || altKey) return;
    if (code === "KeyL") colorLevels(!controls.levels.checked);
    if (code === "KeyH") $("help").open = !$("help").open;
  });
  addEventListener("resize", resize);
  addEventListener("hashchange", readPose);

  resize();
  setDistance(distance);
  if (!readPose()) walker.setPose(...data.pose);
  const settled = () => new Promise((resolve, reject) => {
    waiting.push({ resolve, reject });
    if (paused) advance();
  });
  // Draws until everything is loaded while the page itself does not draw.
  async function advance() {
    while (waiting.length > 0) {
      renderOnce();
      await new Promise((resolve) => setTimeout(resolve, 20));
    }
  }
  const pixels = () => {
    renderOnce();
    const gl = renderer.getContext(), { drawingBufferWidth: width, drawingBufferHeight: high } = gl;
    const values = new Uint8Array(4 * width * high);
    gl.readPixels(0, 0, width, high, gl.RGBA, gl.UNSIGNED_BYTE, values); // the bottom row first
    return { width, height: high, values };
  };
  Object.assign(window.forest, {
    THREE, renderer, scene, camera, walker, trees, tiles, ground, data, renderOnce, settled, pixels, setDistance, describe,
    pause() { paused = true; },
    resume() {
      paused = false;
      before = null;
      wake();
    },
  });
  settled().then(window.forest.resolveReady, window.forest.rejectReady);
  requestAnimationFrame(loop);
})().catch((error) => {
  document.getElementById("status").textContent = error.message;
  window.forest.rejectReady(error);
});
