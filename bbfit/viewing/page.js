// What runs in the page besides viser's own client: it draws the scene once for each pane, with colors as they are in the models,
// writes the labels over it, and measures how long a frame takes. The server sends the state with `window.bbfit.set`.
window.bbfit ??= (() => {
  document.title = "bbfit";
  const state = { mode: "split", near: false, left: [], right: [], status: "" };
  const LEFT = "/original", RIGHT = "/billboards", FIELD = "/field";
  const WHITE = "rgba(255, 255, 255, 0.8)";
  const KEPT = 60; // intervals and durations that medians are taken of
  let renderer = null, scene = null, overlay = null;
  let drawn = 0, drewBefore = false, before = 0, measureUntil = 0, written = 0;
  let calls = 0, triangles = 0, sent = "", folded = false;
  const intervals = [], durations = [];

  const viser = () => window.__viserMutable;
  const remember = (list, value) => { list.push(value); if (list.length > KEPT) list.shift(); };
  const median = (list) => [...list].sort((a, b) => a - b)[list.length >> 1];
  const size = () => renderer.getSize({ set(width, height) { this.width = width; this.height = height; return this; } });

  // One after the other where the picture is higher than wide, else beside each other; as bbfit.viewing.panes has it. Pixels from below.
  function panes() {
    const { width, height } = size();
    if (state.mode !== "split") return [{ x: 0, y: 0, width, height }];
    if (width >= height) return [0, 1].map((i) => ({ x: (i * width) / 2, y: 0, width: width / 2, height }));
    return [1, 0].map((i) => ({ x: 0, y: (i * height) / 2, width, height: height / 2 }));
  }

  // Which of the three a pane shows.
  function shown(pane) {
    if (state.mode === "field") return FIELD;
    if (state.mode === "split") return pane === 0 || state.near ? LEFT : RIGHT;
    return state.mode === "original" ? LEFT : RIGHT;
  }

  function drawPanes(plain, camera) {
    const nodes = [LEFT, RIGHT, FIELD].map((name) => [name, viser().nodeRefFromName[name]]).filter(([, node]) => node);
    const kept = nodes.map(([, node]) => node.visible), aspect = camera.aspect, whole = size();
    calls = triangles = 0;
    renderer.toneMapping = 0; // none: a billboard's color is final, and so is that of the light on the original
    renderer.setScissorTest(true);
    panes().forEach((pane, index) => {
      for (const [name, node] of nodes) node.visible = name === shown(index);
      renderer.setViewport(pane.x, pane.y, pane.width, pane.height);
      renderer.setScissor(pane.x, pane.y, pane.width, pane.height);
      camera.aspect = pane.width / pane.height;
      camera.updateProjectionMatrix();
      plain.call(renderer, scene, camera);
      calls += renderer.info.render.calls;
      triangles += renderer.info.render.triangles;
    });
    nodes.forEach(([, node], index) => { node.visible = kept[index]; });
    renderer.setScissorTest(false);
    renderer.setViewport(0, 0, whole.width, whole.height);
    camera.aspect = aspect;
    camera.updateProjectionMatrix();
  }

  // Take over the drawing of a scene; three.js hands its renderer to this callback of the scene.
  function take(found) {
    if (found.bbfit) { renderer = found; return; }
    const plain = found.render;
    renderer = found;
    found.bbfit = true;
    found.render = (what, camera) => {
      const mutable = viser();
      if (what !== mutable.scene || camera !== mutable.camera || found.getRenderTarget()) return plain.call(found, what, camera);
      const begun = performance.now();
      drawPanes(plain, camera);
      if (begun < measureUntil) { // a pixel that is read back is there only when all before it is drawn
        const gl = found.getContext();
        gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
        remember(durations, performance.now() - begun);
      }
      drawn += 1;
    };
    viser().requestRender();
  }

  function block() {
    const made = document.createElement("div");
    made.style.cssText = `position:absolute;margin:10px;padding:6px 10px;border-radius:6px;background:${WHITE};color:#1d2733;`
      + "font:13px/1.45 system-ui,sans-serif;box-sizing:border-box";
    overlay.appendChild(made);
    return made;
  }

  function attach(canvas) {
    overlay = document.createElement("div");
    overlay.id = "bbfit-overlay";
    overlay.style.cssText = "position:absolute;inset:0;pointer-events:none;overflow:hidden";
    canvas.parentElement.appendChild(overlay);
    overlay.labels = [block(), block()];
    overlay.labels.forEach((label, index) => { label.id = `bbfit-label-${index}`; });
    overlay.line = document.createElement("div");
    overlay.line.style.cssText = "position:absolute;background:#9aa5b1";
    overlay.appendChild(overlay.line);
    overlay.frame = document.createElement("div");
    overlay.frame.id = "bbfit-frame";
    overlay.frame.style.cssText = "font-variant-numeric:tabular-nums;color:#52606d;font-size:12px";
  }

  // On a phone viser's controls lie over the lower pane: they begin folded, and a tap on their head unfolds them.
  function fold() {
    for (const panel of document.querySelectorAll(".mantine-Paper-root")) {
      const { position, bottom } = getComputedStyle(panel), head = panel.querySelector('div[style*="cursor: pointer"]');
      if (position === "fixed" && bottom === "0px" && head) { head.click(); return true; }
    }
    return false;
  }

  function write() {
    const { width, height } = size(), both = state.mode === "split", wide = width >= height;
    const texts = [state.mode === "original" || both ? state.left : state.right, both ? state.right : []];
    overlay.labels.forEach((label, index) => {
      label.style.display = texts[index].length ? "block" : "none";
      label.style.left = index && wide ? "50%" : "0";
      label.style.maxWidth = both && wide ? "calc(50% - 20px)" : "calc(100% - 20px)";
      label.style.top = index && !wide ? "50%" : "0";
      const text = JSON.stringify(texts[index]);
      if (label.text === text) return;
      label.text = text;
      label.replaceChildren(...texts[index].map((line, number) => {
        const row = document.createElement("div");
        row.textContent = line;
        if (number === 0) row.style.fontWeight = "600";
        return row;
      }), ...(index === 0 ? [overlay.frame] : []));
    });
    overlay.line.style.display = both ? "block" : "none";
    Object.assign(overlay.line.style, wide
      ? { left: "calc(50% - 0.5px)", top: "0", width: "1px", height: "100%" }
      : { left: "0", top: "calc(50% - 0.5px)", width: "100%", height: "1px" });
    const { width: across, height: down } = renderer.domElement;
    const parts = [];
    if (intervals.length) {
      const apart = median(intervals);
      parts.push(`${apart.toFixed(1)} ms a frame (${(1000 / apart).toFixed(0)} a second)`);
    }
    if (durations.length) parts.push(`drawing takes ${median(durations).toFixed(1)} ms`);
    parts.push(`${calls.toLocaleString("en")} draws`, `${triangles.toLocaleString("en")} triangles`, `${across} × ${down} pixels`);
    overlay.frame.textContent = (state.status ? `${state.status} · ` : "") + parts.join(" · ");
  }

  // A frame's time is that from one to the next where both were drawn; the browser waits for the screen, so it is at least its period.
  function tick(now) {
    requestAnimationFrame(tick);
    const found = viser();
    if (!found?.scene || !found.canvas) return;
    if (scene !== found.scene) {
      scene = found.scene;
      scene.onBeforeRender = (by) => { if (renderer !== by) take(by); };
      found.requestRender();
    }
    const drew = drawn > 0;
    drawn = 0;
    if (drew && drewBefore) remember(intervals, now - before);
    drewBefore = drew;
    before = now;
    if (now < measureUntil) found.requestRender();
    if (!renderer) return;
    if (!overlay?.isConnected) attach(found.canvas);
    if (!folded && state.left.length) folded = window.innerWidth > 576 || fold();
    const { width, height } = renderer.domElement;
    if (sent !== `${width} ${height}`) { // viser tells the server of a new size before the canvas has it
      sent = `${width} ${height}`;
      found.sendCamera?.();
    }
    if (now - written > 200) { written = now; write(); }
  }
  requestAnimationFrame(tick);

  return {
    // `seconds` are drawn without a pause to measure how long it takes.
    set(next, seconds = 0) {
      Object.assign(state, next);
      if (seconds) {
        intervals.length = durations.length = 0;
        drewBefore = false;
        measureUntil = Math.max(measureUntil, performance.now() + 1000 * seconds);
      }
      viser()?.requestRender();
    },
    get frame() {
      return { intervals: [...intervals], durations: [...durations], calls, triangles, measuring: performance.now() < measureUntil };
    },
  };
})();
