"use strict";
// The viewer's page. It asks the server for its state and for models; everything else, such as the choice of levels, happens here.
(async () => {
  const SLIDER_STEPS = 200, KEPT_TIMES = 60;
  // Frames that are measured after a change: at most so many, and once there is the least number, only for so many milliseconds.
  const MEASURED_FRAMES = 8, LEAST_FRAMES = 4, MEASURED_TIME = 250;
  // Milliseconds between two questions to the server, while its answer is about to change and otherwise.
  const SOON = 250, LATER = 1000;
  const $ = (id) => document.getElementById(id);
  const stage = $("stage"), panes = [$("left"), $("right")], form = document.forms[0], controls = form.elements;
  const THREE = await bbfit.library($("library"));
  const renderer = bbfit.createRenderer(THREE, document.querySelector("canvas")), canvas = renderer.domElement;
  const scene = new THREE.Scene(), groups = { original: new THREE.Group(), billboards: new THREE.Group(), field: new THREE.Group() };
  const light = bbfit.createLight(THREE, scene), ground = new THREE.LineSegments(undefined, new THREE.LineBasicMaterial());
  const outlines = new THREE.LineSegments(undefined, new THREE.LineBasicMaterial({ vertexColors: true }));
  scene.add(...Object.values(groups), ground);
  const models = new Map(); // by address: null while it loads, false if that failed
  const intervals = [], durations = [];
  let state = { serial: -1, tree: null }, tree = null, status = "", error = "";
  let field = null, plantedFor = "", loading = 0, dirty = true, toMeasure = 0, measuredFrom = 0, before = null, fitted = false, shadowsDue = true, sunAt = [0, 90], mode = "billboards";
  Object.assign(renderer.shadowMap, { enabled: true, autoUpdate: false });
  const orbit = bbfit.createOrbit(THREE, canvas, () => { dirty = true; });
  // The picture has the colors of the page, light or dark.
  const dark = matchMedia("(prefers-color-scheme: dark)"), colorOf = (name) => new THREE.Color(getComputedStyle(document.body).getPropertyValue(name).trim());
  const paint = () => {
    scene.background = colorOf("--paper");
    ground.material.color = colorOf("--ground").convertSRGBToLinear();
    dirty = true;
  };
  dark.addEventListener("change", paint);
  paint();
  for (const name of ["pointerdown", "wheel"]) canvas.addEventListener(name, () => {
    fitted = false;
    document.activeElement.blur();
  });

  const median = (list) => [...list].sort((a, b) => a - b)[list.length >> 1];
  const remember = (list, value) => { list.push(value); if (list.length > KEPT_TIMES) list.shift(); };
  const count = (value) => value.toLocaleString("en");
  const bytes = (value) => (value >= 1 << 20 ? `${(value / 2 ** 20).toFixed(1)} MiB` : `${count(Math.round(value / 1024))} KiB`);
  const meters = (value) => `${value < 1000 ? Number(value.toPrecision(3)) : count(Math.round(value))} m`;
  const height = () => tree.bounds[1][1] - tree.bounds[0][1];
  const middle = () => new THREE.Vector3(...tree.bounds[0].map((low, axis) => (low + tree.bounds[1][axis]) / 2));
  // The slider's steps are equal factors of the distance.
  const nearest = () => 0.5 * height(), REACH = 400;
  const distanceOf = (step) => nearest() * REACH ** (step / SLIDER_STEPS);
  const stepOf = (distance) => Math.round((SLIDER_STEPS * Math.log(Math.max(distance / nearest(), 1))) / Math.log(REACH));

  // The coarsest level that may be shown at a scale in pixels per meter. Levels of unknown scale are never chosen; the first always may be.
  function chooseLevel(levels, scale) {
    return levels.reduce((chosen, level, index) => (level.scale !== null && scale < level.scale ? index : chosen), 0);
  }

  // Pixels of the screen per meter at one meter's distance.
  function focalLength() {
    const area = panes[mode === "original" ? 0 : 1].lastElementChild;
    return (area.clientHeight * renderer.getPixelRatio()) / 2 / Math.tan((orbit.camera.fov * Math.PI) / 360);
  }

  // The model at an address, null until it is loaded.
  function modelAt(address, layered) {
    if (!models.has(address)) {
      models.set(address, null);
      loading += 1;
      const load = async () => {
        const response = await fetch(address);
        if (!response.ok) throw new Error(`the server has no ${address}`);
        const buffer = await response.arrayBuffer(), root = await bbfit.loadModel(THREE, buffer, layered);
        const meshes = [];
        root.traverse((item) => { if (item.isMesh) meshes.push(item); });
        const vertices = new Map(meshes.map(({ geometry }) => [geometry, geometry.attributes.position.count]));
        models.set(address, { root, meshes, bytes: buffer.byteLength, vertices: [...vertices.values()].reduce((a, b) => a + b, 0) });
      };
      load().catch((failure) => {
        models.set(address, false);
        if (address.startsWith(`/${tree.generation}/`) || address === originalAddress()) error = failure.message;
      }).finally(() => {
        loading -= 1;
        measure();
      });
    }
    return models.get(address) || null;
  }

  const isSplit = () => controls.split.checked && controls.alpha.value === "blend";
  function levelModel(level, split) {
    const alpha = controls.alpha.value;
    const address = `/${tree.generation}/model/${level.cloud}/${level.halvings}/${alpha}${split ? "-split" : ""}.glb`;
    return modelAt(address, alpha !== "mask" && !split);
  }

  const originalAddress = () => `/${tree.origin}/original.glb`;

  // Forget the models of trees that are not shown any more.
  function forget() {
    for (const [address, model] of models) {
      if (model === null || address.startsWith(`/${tree.generation}/`) || address === originalAddress() || groups.billboards.children.includes(model.root)) continue;
      for (const { geometry, material } of model.meshes ?? []) {
        geometry.dispose();
        for (const map of ["map", "normalMap", "aoMap"]) material[map]?.dispose();
        material.dispose();
      }
      models.delete(address);
    }
  }

  function measure() {
    intervals.length = durations.length = 0;
    before = null;
    toMeasure = MEASURED_FRAMES;
    dirty = true;
  }

  function fitTree() {
    const area = panes[mode === "original" ? 0 : 1].lastElementChild;
    orbit.fit(...tree.bounds, area.clientWidth / area.clientHeight);
    fitted = true;
  }

  // A new state of the server.
  function accept(next) {
    const first = next.tree !== null && (tree === null || (tree.live && !next.tree.live)), start = tree === null;
    const relit = JSON.stringify(next.tree?.light) !== JSON.stringify(tree?.light);
    if (next.tree?.generation !== tree?.generation) error = ""; // of a model that is no longer shown
    state = next;
    status = next.status;
    tree = next.tree;
    if (tree === null) {
      dirty = true;
      return;
    }
    document.title = `${tree.name} · bbfit`;
    $("name").textContent = tree.name;
    const chosen = controls.level.value;
    controls.level.replaceChildren(...tree.levels.map(({ name }, index) => new Option(name, index)), new Option("by distance", "distance"));
    const finest = String(tree.levels.findIndex(({ cloud }) => cloud !== null));
    controls.level.value = !first && (chosen === "distance" || chosen < tree.levels.length) ? chosen : finest;
    for (const option of controls.show.options) option.disabled = !tree.original && ["both", "original"].includes(option.value);
    if (first) {
      controls.show.value = tree.original ? "both" : "billboards";
      controls.alpha.value = tree.alpha;
      controls.split.checked = tree.split;
    }
    const notes = tree.original && tree.seen.length ? ["The original has the mean color that it has in the views."] : [];
    $("notes").replaceChildren(...[...tree.notes, ...notes].map((note) => Object.assign(document.createElement("p"), { textContent: note })));
    controls.sun.disabled = !tree.maps || tree.light.sun === 0;
    if (relit) aimSun(tree.light);
    applyMode();
    if (start) fitTree();
    measure();
  }

  // Turn the sun to where it is due, and the shadows of the original with it.
  function turnSun() {
    const { center, radius } = models.get(originalAddress()) || {};
    light.aim(...sunAt, center, radius);
    shadowsDue = true;
  }

  // Move the sun to an azimuth and a height in degrees.
  function aimSun({ azimuth, height }) {
    sunAt = [azimuth, height];
    turnSun();
    [controls.azimuth.value, controls.height.value] = [azimuth, height];
    $("sun-note").textContent = !tree.maps ? "The light is in the colors. Fit with --light maps to move the sun."
      : tree.light.sun === 0 ? "The views have no sun."
      : `The sun is at ${Math.round(azimuth)}°, ${Math.round(height)}° high; that of the views at ${Math.round(tree.light.azimuth)}°, ${Math.round(tree.light.height)}°. 0° is where the camera begins, 90° to the right of it.`;
    dirty = true;
  }

  function applyMode() {
    const changed = mode !== controls.show.value, wasField = mode === "field";
    mode = stage.className = controls.show.value;
    resize();
    if (mode === "field") plant(changed);
    else if (wasField || (changed && fitted)) fitTree();
    const cell = 10 ** Math.floor(Math.log10(height() / 2)) * (mode === "field" && field ? Math.ceil(field.side / height() / 8) : 1);
    const cells = Array.from({ length: 40 }, (_, index) => (index - 20) * cell), lines = [...cells, 20 * cell];
    const segments = lines.flatMap((at) => cells.flatMap((from) => [[at, 0, from], [at, 0, from + cell], [from, 0, at], [from + cell, 0, at]]));
    ground.geometry.dispose();
    ground.geometry = new THREE.BufferGeometry().setFromPoints(segments.map((point) => new THREE.Vector3(...point)));
    ground.position.copy(middle()).setY(tree.bounds[0][1]);
  }

  async function plant(moveCamera) {
    const [trees, seed] = [controls.trees, controls.seed].map((input) => Math.round(Math.min(Math.max(input.value, input.min), input.max)));
    [controls.trees.value, controls.seed.value] = [trees, seed];
    const address = `/${tree.generation}/field/${trees}/${seed}`;
    if (field?.address !== address) {
      loading += 1;
      try {
        const values = new Float32Array(await (await fetch(address)).arrayBuffer());
        const places = Array.from({ length: values.length / 5 }, (_, index) => values.subarray(5 * index, 5 * index + 5));
        const matrices = places.map(([x, y, z, yaw, scale]) =>
          new THREE.Matrix4().makeRotationY(yaw).scale(new THREE.Vector3(scale, scale, scale)).setPosition(x, y, z));
        const xs = places.map(([x]) => x), side = Math.max(...xs) - Math.min(...xs) + height();
        field = { address, places, matrices, side, counts: [], vertices: 0 };
      } catch (failure) {
        error = failure.message;
      } finally {
        loading -= 1;
      }
      if (field === null || mode !== "field") return;
      applyMode();
    }
    if (moveCamera || plantedFor !== `${trees}`) {
      plantedFor = `${trees}`;
      orbit.target.copy(middle());
      const up = 0.05 * field.side + 1.5 * height(), away = 0.5 * field.side + 2 * height();
      Object.assign(orbit, { azimuth: 0, elevation: Math.atan2(up, away), distance: Math.hypot(up, away), extent: 2 * field.side });
      orbit.update();
    }
    measure();
  }

  // Give every tree of the field the level for its distance, as instances of that level's model.
  function shareOut() {
    const byDistance = controls.level.value === "distance", level = tree.levels[controls.level.value];
    const wanted = byDistance ? tree.field : [level?.cloud != null ? { ...level, halvings: 0 } : tree.field[0]];
    const loaded = wanted.map((each) => ({ ...each, model: levelModel(each, false) })); // pieces of a split model are not instanced in order
    if (field === null || loaded[0].model === null) return;
    const levels = loaded.filter(({ model }) => model !== null), focal = focalLength(), eye = orbit.camera.position, place = new THREE.Vector3();
    const chosen = field.places.map((values) => chooseLevel(levels, (focal * values[4]) / Math.max(place.fromArray(values).distanceTo(eye), 1e-6)));
    const key = `${field.address} ${levels.map(({ model }) => model.root.uuid)} ${chosen.join("")}`;
    if (key === field.key) return;
    field.key = key;
    field.counts = levels.map((_, index) => chosen.filter((each) => each === index).length);
    field.vertices = levels.reduce((sum, { model }, index) => sum + field.counts[index] * model.vertices, 0);
    for (const old of groups.field.children) old.dispose();
    groups.field.clear();
    const product = new THREE.Matrix4();
    levels.forEach(({ model }, index) => {
      const own = field.matrices.filter((_, number) => chosen[number] === index);
      for (const mesh of own.length ? model.meshes : []) {
        const instances = new THREE.InstancedMesh(mesh.geometry, mesh.material, own.length);
        own.forEach((matrix, number) => instances.setMatrixAt(number, product.multiplyMatrices(matrix, mesh.matrixWorld)));
        instances.frustumCulled = false;
        groups.field.add(instances);
      }
    });
  }

  // Put a level's billboards into the scene, once they are loaded; true if they are there.
  function showBillboards(level) {
    const model = levelModel(level, isSplit());
    if (model === null) return;
    groups.billboards.clear();
    groups.billboards.add(model.root);
    if (controls.outlines.checked) groups.billboards.add(outlinesOf(level));
    forget();
  }

  // The outlines of a level's billboards, which are kept until others are shown.
  function outlinesOf(level) {
    const shown = `${tree.generation} ${level.cloud}`;
    if (outlines.name !== shown) {
      const points = [], colors = [];
      tree.outlines[level.cloud].forEach((corners, index) => {
        const color = new THREE.Color(tree.colors[index]).toArray();
        corners.forEach((corner, number) => {
          points.push(...corner, ...corners[(number + 1) % corners.length]);
          colors.push(...color, ...color);
        });
      });
      outlines.geometry.dispose();
      outlines.geometry = new THREE.BufferGeometry();
      outlines.geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
      outlines.geometry.setAttribute("color", new THREE.Float32BufferAttribute(colors, 3));
      outlines.name = shown;
    }
    return outlines;
  }

  function label(pane, name, details) {
    pane.firstElementChild.replaceChildren(Object.assign(document.createElement("b"), { textContent: name }), details);
  }

  // What is in each pane, and what the panel says about it.
  function update() {
    const distance = orbit.camera.position.distanceTo(middle()), focal = focalLength(), scale = focal / distance;
    const chosen = controls.level.value === "distance" ? chooseLevel(tree.levels, scale) : Number(controls.level.value);
    const level = tree.levels[chosen], original = tree.original ? modelAt(originalAddress(), false) : null;
    if (original !== null && groups.original.children[0] !== original.root) {
      bbfit.original.prepare(THREE, renderer, original);
      const matched = tree.seen.length ? bbfit.original.matchLight(THREE, renderer, original, tree.light, tree.seen) : null;
      original.shares = matched ?? tree.shares;
      groups.original.clear().add(original.root);
      turnSun();
    }
    if (mode === "field") shareOut();
    else if (level.cloud !== null) showBillboards(level);
    const shown = level.cloud === null ? original : levelModel(level, isSplit());
    const details = (model) => (model === null ? "loading …" : `${count(model.vertices)} vertices · ${bytes(model.bytes)}`);
    label(panes[0], "original", details(original));
    if (mode === "field") {
      const shares = field?.counts.length > 1 ? ` · by distance: ${field.counts.map(count).join(" / ")}` : "";
      label(panes[1], field ? `${count(field.places.length)} trees` : "planting …", field ? `${count(field.vertices)} vertices${shares}` : "");
    } else {
      label(panes[1], level.name, details(shown) + (level.cloud === null ? "" : ` · ${controls.alpha.value}${isSplit() ? ", cut up" : ""}`));
    }
    controls.split.disabled = controls.alpha.value !== "blend";
    const notes = controls.alpha.value === tree.alpha ? [] : [`The textures were fitted for ${tree.alpha}.`];
    if (controls.alpha.value === "hash") notes.push("glTF has no hash: the file says BLEND and names HASH in its extras, and viewers blend.");
    if (controls.alpha.value === "coverage") notes.push("glTF has no coverage: the file says MASK and names COVERAGE in its extras, and most viewers draw hard edges.");
    if (["blend", "hash"].includes(controls.alpha.value) && !isSplit()) notes.push("Here texels that are at least half opaque hide what is behind them; the rest is blended in any order.");
    $("alpha-note").textContent = notes.join(" ");
    controls.slider.value = stepOf(orbit.distance);
    if (document.activeElement !== controls.meters) controls.meters.value = Number(orbit.distance.toPrecision(4));
    $("size").textContent = `At ${meters(distance)} the tree is ${count(Math.round(scale * height()))} pixels tall.`;
    $("levels").replaceChildren(...tree.levels.map(({ name, scale: least }, index) => {
      const unknown = tree.live ? "the fit is running" : tree.measuring ? "being measured" : "no views";
      const from = index === 0 ? "from 0 m on" : least === null ? `not known (${unknown})` : `from ${meters(focal / least)} on`;
      const item = Object.assign(document.createElement("li"), { textContent: `${name}: ${from}` });
      item.classList.toggle("now", index === chosen && mode !== "field");
      return item;
    }));
    const right = mode === "field" ? groups.field : level.cloud === null ? groups.original : groups.billboards;
    return [groups.original, right];
  }

  function draw(shown) {
    const whole = canvas.getBoundingClientRect();
    renderer.info.autoReset = false;
    renderer.info.reset();
    renderer.setScissorTest(true);
    panes.forEach((pane, index) => {
      const { left, bottom, width, height: high } = pane.lastElementChild.getBoundingClientRect();
      if (width === 0 || high === 0) return;
      for (const group of Object.values(groups)) group.visible = group === shown[index];
      const original = shown[index] === groups.original ? models.get(originalAddress()) : null;
      if (original) bbfit.original.shine(original, light, tree.light, original.shares);
      else light.shine(tree.light);
      if (original && shadowsDue) { // a shadow map is drawn with what is visible
        renderer.shadowMap.needsUpdate = true;
        shadowsDue = false;
      }
      renderer.setViewport(left - whole.left, whole.bottom - bottom, width, high);
      renderer.setScissor(left - whole.left, whole.bottom - bottom, width, high);
      orbit.camera.aspect = width / high;
      orbit.camera.updateProjectionMatrix();
      renderer.render(scene, orbit.camera);
    });
  }

  function resize() {
    const { clientWidth, clientHeight } = canvas, size = renderer.getSize(new THREE.Vector2());
    if (size.x === clientWidth && size.y === clientHeight && renderer.getPixelRatio() === devicePixelRatio) return;
    renderer.setPixelRatio(devicePixelRatio);
    renderer.setSize(clientWidth, clientHeight, false);
    if (tree !== null && fitted && mode !== "field") fitTree();
    dirty = true;
  }

  // Frames are drawn when something has changed, and once all is loaded some of them one after the other to measure them. The interval
  // between two frames is at least the period of the screen; the duration ends when a pixel could be read back.
  function tick(now) {
    requestAnimationFrame(tick);
    resize();
    $("status").textContent = error || (loading ? "loading models … " : "") + status;
    if (tree === null || !(dirty || (toMeasure && loading === 0))) {
      before = null;
      return;
    }
    dirty = false;
    const shown = update(), begun = performance.now();
    draw(shown);
    if (toMeasure && loading === 0) {
      if (durations.length === 0) measuredFrom = now;
      const gl = renderer.getContext();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      remember(durations, performance.now() - begun);
      if (before !== null) remember(intervals, now - before);
      toMeasure = durations.length >= LEAST_FRAMES && now - measuredFrom > MEASURED_TIME ? 0 : toMeasure - 1;
    }
    before = now;
    const { calls, triangles } = renderer.info.render, parts = [];
    if (intervals.length) parts.push(`${median(intervals).toFixed(1)} ms per frame (${(1000 / median(intervals)).toFixed(0)} per second)`);
    if (durations.length) parts.push(`${median(durations).toFixed(1)} ms to draw`);
    parts.push(`${count(calls)} draws`, `${count(triangles)} triangles`, `${canvas.width} × ${canvas.height} pixels`);
    $("frame").textContent = parts.join(" · ");
  }

  async function poll() {
    try {
      const next = await (await fetch("/state")).json();
      error = error === "the viewer has ended" ? "" : error;
      if (next.serial !== state.serial) accept(next);
    } catch {
      error = "the viewer has ended";
    }
    setTimeout(poll, tree === null || tree.live || tree.measuring ? SOON : LATER);
  }

  function go(distance) {
    if (!(distance > 0) || tree === null) return;
    fitted = false;
    orbit.distance = distance;
    orbit.update();
  }
  controls.slider.addEventListener("input", () => go(distanceOf(controls.slider.value)));
  controls.meters.addEventListener("change", () => go(Number(controls.meters.value)));
  for (const input of [controls.azimuth, controls.height]) input.addEventListener("input", () => {
    aimSun({ azimuth: Number(controls.azimuth.value), height: Number(controls.height.value) });
  });
  controls["views-sun"].addEventListener("click", () => aimSun(tree.light));
  form.addEventListener("change", (event) => {
    const { slider, meters, trees, seed, azimuth, height } = controls;
    if (tree === null || [slider, meters, trees, seed, azimuth, height].includes(event.target)) return;
    error = "";
    if (event.target === controls.show) applyMode();
    measure();
  });
  controls.plant.addEventListener("click", () => {
    if (tree === null) return;
    controls.show.value = "field";
    if (mode === "field") plant(false); else applyMode();
  });
  form.addEventListener("submit", (event) => event.preventDefault());

  // For tests and scripts that drive the page.
  bbfit.viewer = {
    orbit, chooseLevel, distanceOf, stepOf, focalLength, fitTree,
    get state() { return state; },
    get idle() { return tree !== null && loading === 0 && !dirty && toMeasure === 0; },
    get frame() { return { intervals: [...intervals], durations: [...durations], ...renderer.info.render }; },
    get field() { return field; },
    get memory() { return { ...renderer.info.memory }; },
    get shares() { return models.get(originalAddress())?.shares; },
  };
  poll();
  requestAnimationFrame(tick);
})().catch((failure) => {
  document.getElementById("status").textContent = `The page needs WebGL: ${failure.message}`;
});
