"use strict";
{
  const { views, marks, bounds, layered, light: viewsLight, glb } = JSON.parse(document.getElementById("data").textContent);
  const slider = document.getElementById("view");
  const images = [...document.querySelectorAll(".strip img")];
  const eye = document.getElementById("plan-eye");
  const cursors = ["psnr", "ssim", "flip"].map((name) => document.getElementById(`azimuth-cursor-${name}`));
  const points = new Map(views.map((view) => [view.index, cursors.map((cursor) => document.getElementById(cursor.id.replace("cursor-", "") + `-${view.index}`))]));

  function show(place) {
    const view = views[place];
    slider.value = place;
    images.forEach((image, part) => { image.src = view.pictures[part]; });
    const height = Math.abs(view.elevation) >= 0.5 ? `, elevation ${view.elevation.toFixed(0)}°` : "";
    document.getElementById("caption").textContent =
      `${view.name}: azimuth ${view.azimuth.toFixed(0)}°${height}; PSNR ${view.psnr.toFixed(2)} dB (${view.over.white.toFixed(2)} over white), SSIM ${view.ssim.toFixed(3)}, FLIP ${view.flip.toFixed(3)}, silhouette IoU ${view.iou.toFixed(3)}`;
    cursors.forEach((cursor) => cursor.setAttribute("transform", `translate(${view.azimuth * marks.degree} 0)`));
    eye.setAttribute("transform", `rotate(${-view.azimuth} ${marks.x} ${marks.y})`);
    points.forEach((group, index) => group.forEach((point) => point.classList.toggle("now", index === view.index)));
  }

  // The page's colors stay as they are: only what is behind the pictures of held-out views changes.
  const backgrounds = [...document.querySelectorAll("input[name=over]")];
  const section = document.getElementById("views");
  backgrounds.forEach((input) => input.addEventListener("change", () => {
    section.style.setProperty("--over", input.parentElement.querySelector(".swatch").style.background);
  }));

  const step = (by) => show((Number(slider.value) + by + views.length) % views.length);
  slider.addEventListener("input", () => show(Number(slider.value)));
  document.getElementById("before").addEventListener("click", () => step(-1));
  document.getElementById("after").addEventListener("click", () => step(1));
  const placeOf = (index) => views.findIndex((view) => view.index === index);
  points.forEach((group, index) => group.forEach((point) => {
    point.dataset.view = index;
    point.addEventListener("click", () => show(placeOf(index)));
  }));
  document.querySelectorAll(".pictures").forEach((button) => {
    const place = placeOf(Number(button.dataset.view));
    button.querySelectorAll("img").forEach((image) => { image.src = views[place].pictures[image.dataset.part]; });
    button.addEventListener("click", () => {
      show(place);
      document.getElementById("views").scrollIntoView();
    });
  });
  show(Number(slider.value));

  // The sun that readers drag, in a circle that shows the sky from above, with the camera at its lower edge. Returns what places it there.
  function createDial(orbit, light) {
    const DEGREE = Math.PI / 180, RADIUS = 40, STEP = 5; // the radius is that of the horizon, in units of the picture
    const dial = document.getElementById("dial"), mark = dial.querySelector(".sun");
    let { azimuth, height } = viewsLight;

    function place() {
      const away = (RADIUS * Math.min(90 - height, 90)) / 90, turn = azimuth * DEGREE - orbit.azimuth;
      mark.setAttribute("transform", `translate(${away * Math.sin(turn)} ${away * Math.cos(turn)})`);
    }
    function aim(nextAzimuth, nextHeight) {
      [azimuth, height] = [((nextAzimuth % 360) + 360) % 360, Math.min(Math.max(nextHeight, 0), 90)];
      light.aim(azimuth, height);
      const text = `The sun is at ${azimuth.toFixed(0)}°, ${height.toFixed(0)}° high.`;
      document.getElementById("sun-place").textContent = text;
      dial.setAttribute("aria-valuenow", azimuth.toFixed(0));
      dial.setAttribute("aria-valuetext", text);
      orbit.update();
    }
    const reset = () => aim(viewsLight.azimuth, viewsLight.height);
    function drag(event) {
      if (!dial.hasPointerCapture(event.pointerId)) return;
      const box = dial.getBoundingClientRect(), unit = 100 / box.width;
      const right = unit * (event.clientX - box.left - box.width / 2), near = unit * (event.clientY - box.top - box.height / 2);
      aim((Math.atan2(right, near) + orbit.azimuth) / DEGREE, 90 * (1 - Math.hypot(right, near) / RADIUS));
    }
    dial.addEventListener("pointerdown", (event) => {
      dial.setPointerCapture(event.pointerId);
      drag(event);
    });
    dial.addEventListener("pointermove", drag);
    dial.addEventListener("dblclick", reset);
    dial.addEventListener("keydown", (event) => {
      const moves = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] }, move = moves[event.key];
      if (!move && event.key !== "Home") return;
      event.preventDefault();
      if (move) aim(azimuth + move[0], height + move[1]);
      else reset();
    });
    reset();
    return place;
  }

  async function drawModel() {
    const THREE = await bbfit.library(document.getElementById("library"));
    const renderer = bbfit.createRenderer(THREE, document.querySelector(".stage canvas")), canvas = renderer.domElement;
    const scene = new THREE.Scene(), dark = matchMedia("(prefers-color-scheme: dark)");
    const light = bbfit.createLight(THREE, scene);
    light.shine(viewsLight ?? { sun: 1.75 * Math.PI, sky: 0, color: [1, 1, 1] });
    const orbit = bbfit.createOrbit(THREE, canvas, () => requestAnimationFrame(draw));
    scene.add(await bbfit.loadModel(THREE, Uint8Array.from(atob(glb), (byte) => byte.charCodeAt(0)).buffer, layered));
    const draw = () => {
      if (placeSun) placeSun();
      else light.sun.position.copy(orbit.camera.position); // for models whose materials are lit
      scene.background = new THREE.Color(dark.matches ? 0x1d2126 : 0xffffff);
      renderer.render(scene, orbit.camera);
    };
    const placeSun = viewsLight && createDial(orbit, light);
    const resize = () => {
      renderer.setPixelRatio(devicePixelRatio);
      renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
      orbit.camera.aspect = canvas.clientWidth / canvas.clientHeight;
      orbit.update();
    };
    orbit.fit(...bounds, canvas.clientWidth / canvas.clientHeight);
    resize();
    addEventListener("resize", resize);
    dark.addEventListener("change", draw);
    bbfit.model = { canvas, camera: orbit.camera, draw, orbit };
  }
  // The wheel and a finger scroll the page until the reader clicks the model, and again once it is out of sight.
  const turn = document.getElementById("turn");
  drawModel().catch((failure) => {
    turn.disabled = true;
    turn.textContent = `The model needs WebGL: ${failure.message}`;
  });
  turn.addEventListener("click", () => { turn.hidden = true; });
  new IntersectionObserver((seen) => { if (!seen[0].isIntersecting) turn.hidden = false; }).observe(turn.parentElement);
}
