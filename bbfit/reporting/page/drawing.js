"use strict";
// What the report and the viewer share: models drawn by three.js in the colors of their textures, a sun and a sky, and a camera that orbits an
// upright tree.
window.bbfit = (() => {
  const STEEPEST = Math.PI / 2 - 0.05;
  // What an arrow key turns by.
  const STEP = Math.PI / 36;
  const TURNED_NORMAL = "transformedNormal = m * transformedNormal;";

  // The namespace of three.js, which the page in a hidden frame defines.
  const library = (frame) => new Promise((resolve) => {
    const check = () => { if (frame.contentWindow.THREE) resolve(frame.contentWindow.THREE); };
    frame.addEventListener("load", check);
    check();
  }).then(withTurnedTangents);

  // Turns the tangents of instances, without which normal maps do not turn. This version of three.js turns their normals alone.
  function withTurnedTangents(THREE) {
    const chunk = THREE.ShaderChunk.defaultnormal_vertex;
    if (!chunk.includes(TURNED_NORMAL)) throw new Error("three.js turns the normals of instances in another way");
    THREE.ShaderChunk.defaultnormal_vertex = chunk.replace(TURNED_NORMAL, `${TURNED_NORMAL}
#ifdef USE_TANGENT
  objectTangent = m * objectTangent;
#endif`);
    return THREE;
  }

  // A renderer that writes sRGB and lights surfaces in physical units. Its canvas, which three.js has to make itself, replaces an element.
  function createRenderer(THREE, element, { antialias = true } = {}) {
    const renderer = new THREE.WebGLRenderer({ antialias });
    Object.assign(renderer, { outputEncoding: THREE.sRGBEncoding, physicallyCorrectLights: true });
    for (const { name, value } of element.attributes) renderer.domElement.setAttribute(name, value);
    element.replaceWith(renderer.domElement);
    return renderer;
  }

  // The light of a scene: a sun and an even sky. `aim` takes the sun's azimuth and height in degrees; with the center and the radius of what
  // it shines on, that casts shadows. `shine` takes the intensities of both and the sun's color.
  function createLight(THREE, scene) {
    const sun = new THREE.DirectionalLight(), sky = new THREE.AmbientLight();
    sun.shadow.mapSize.set(2048, 2048);
    sun.shadow.bias = -0.002;
    scene.add(sun, sun.target, sky);
    return {
      sun,
      aim(azimuth, height, center, radius) {
        sun.position.setFromSphericalCoords(1, ((90 - height) * Math.PI) / 180, (azimuth * Math.PI) / 180);
        if (center === undefined) return;
        sun.castShadow = true;
        sun.position.multiplyScalar(2 * radius).add(center);
        sun.target.position.copy(center);
        const { camera } = sun.shadow;
        Object.assign(camera, { left: -radius, right: radius, top: radius, bottom: -radius, near: radius, far: 3 * radius });
        camera.updateProjectionMatrix();
      },
      shine(light) {
        sun.intensity = light.sun;
        sun.color.setRGB(...light.color);
        sky.intensity = light.sky;
      },
    };
  }

  // The scene in the bytes of a GLB file. In a layered one, texels that are at least half opaque are drawn first and hide what is behind
  // them. The rest is blended over them in any order. A material for coverage covers samples. Blending only keeps the
  // alpha of the canvas, and the alpha test drops what covers none of four samples, also where a context has one sample alone.
  async function loadModel(THREE, buffer, layered, loader = new THREE.GLTFLoader()) {
    const { scene } = await loader.parseAsync(buffer, "");
    const covering = { alphaToCoverage: true, alphaTest: 0.125, blending: THREE.CustomBlending };
    Object.assign(covering, { blendSrc: THREE.OneFactor, blendDst: THREE.ZeroFactor });
    Object.assign(covering, { blendSrcAlpha: THREE.ZeroFactor, blendDstAlpha: THREE.OneFactor });
    scene.traverse(({ material }) => { if (material?.userData.alphaMode === "COVERAGE") Object.assign(material, covering); });
    const blended = [];
    scene.traverse((item) => { if (layered && item.isMesh && item.material.transparent) blended.push(item); });
    for (const mesh of blended) {
      const core = mesh.clone();
      core.material = Object.assign(mesh.material.clone(), { transparent: false, alphaTest: 0.5, depthWrite: true });
      mesh.material.depthWrite = false;
      mesh.parent.add(core);
    }
    scene.updateMatrixWorld(true);
    return scene;
  }

  // A camera that orbits a target: `azimuth` 0 is at +Z, `elevation` is the angle above the horizon in radians, `distance` is in meters.
  // `extent` is how far the scene reaches from the target.
  function createOrbit(THREE, canvas, onChange) {
    const camera = new THREE.PerspectiveCamera(35, 1), target = new THREE.Vector3();
    const orbit = { camera, target, azimuth: 0, elevation: 0.12, distance: 1, extent: 1, update, fit, pan };

    function update() {
      orbit.elevation = Math.min(Math.max(orbit.elevation, -STEEPEST), STEEPEST);
      const { azimuth, elevation, distance, extent } = orbit;
      camera.position.setFromSphericalCoords(distance, Math.PI / 2 - elevation, azimuth).add(target);
      camera.lookAt(target);
      Object.assign(camera, { near: distance / 100, far: 10 * distance + 2 * extent });
      camera.updateProjectionMatrix();
      onChange();
    }

    // Fill a picture of some aspect ratio with a box, seen from a little above.
    function fit(low, high, aspect) {
      const size = high.map((value, axis) => value - low[axis]), radius = Math.max(size[0], size[2]) / 2;
      target.fromArray(low.map((value, axis) => (value + high[axis]) / 2));
      const distance = (1.1 * Math.max(size[1] / 2, radius / aspect)) / Math.tan((camera.fov * Math.PI) / 360) + radius / 2;
      Object.assign(orbit, { azimuth: 0, elevation: 0.12, distance, extent: Math.hypot(...size) });
      camera.aspect = aspect;
      update();
    }

    // Move the target by some pixels of the canvas.
    function pan(right, down) {
      const meters = (2 * orbit.distance * Math.tan((camera.fov * Math.PI) / 360)) / canvas.clientHeight;
      target.add(new THREE.Vector3(-right * meters, down * meters, 0).applyQuaternion(camera.quaternion));
    }

    const pointers = new Map();
    const release = (event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
    });
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const right = event.clientX - before.clientX, down = event.clientY - before.clientY;
      const other = [...pointers.values()].find((pointer) => pointer.pointerId !== event.pointerId);
      pointers.set(event.pointerId, event);
      if (other) { // two fingers zoom and pan
        const span = ({ clientX, clientY }) => Math.max(Math.hypot(clientX - other.clientX, clientY - other.clientY), 1);
        orbit.distance *= span(before) / span(event);
        pan(right / 2, down / 2);
      } else if (event.buttons === 2 || event.shiftKey) {
        pan(right, down);
      } else {
        orbit.azimuth -= (Math.PI * right) / canvas.clientHeight;
        orbit.elevation += (Math.PI * down) / canvas.clientHeight;
      }
      update();
    });
    canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] }, turn = turns[event.key];
      const zoom = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 }[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey || !(turn || zoom)) return;
      event.preventDefault();
      orbit.azimuth += turn?.[0] ?? 0;
      orbit.elevation += turn?.[1] ?? 0;
      orbit.distance *= zoom ?? 1;
      update();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      orbit.distance *= Math.exp(event.deltaY * (event.deltaMode ? 0.03 : 0.001));
      update();
    }, { passive: false });
    return orbit;
  }

  return { library, createRenderer, createLight, loadModel, createOrbit };
})();
