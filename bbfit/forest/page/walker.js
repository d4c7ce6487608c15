"use strict";
// A camera that walks at the height of eyes or flies. Yaw 0 looks north, along -Z, and grows counterclockwise seen from above; pitch grows
// upwards. Both are in degrees.
bbfitForest.createWalker = (THREE, canvas, heightAt, onChange) => {
  const EYE = 1.7, WALKING = 4, FLYING = 15, FASTER = 4; // meters, and meters a second
  const DEGREE = Math.PI / 180, STEEPEST = 89;
  const KEYS = {
    KeyW: [0, 1, 0], ArrowUp: [0, 1, 0], KeyS: [0, -1, 0], ArrowDown: [0, -1, 0], KeyA: [-1, 0, 0], ArrowLeft: [-1, 0, 0],
    KeyD: [1, 0, 0], ArrowRight: [1, 0, 0], KeyE: [0, 0, 1], KeyQ: [0, 0, -1],
  };
  const camera = new THREE.PerspectiveCamera(55, 1, 0.1, 1000), pressed = new Set();
  const walker = { camera, flying: false, yaw: 0, pitch: 0, step, setFlying, setPose, apply };
  camera.rotation.order = "YXZ";

  function apply() {
    walker.yaw = ((walker.yaw % 360) + 360) % 360;
    walker.pitch = Math.min(Math.max(walker.pitch, -STEEPEST), STEEPEST);
    const least = heightAt(camera.position.x, camera.position.z) + (walker.flying ? 0.3 : EYE);
    camera.position.y = walker.flying ? Math.max(camera.position.y, least) : least;
    camera.rotation.set(walker.pitch * DEGREE, walker.yaw * DEGREE, 0);
    camera.updateMatrixWorld();
    onChange();
  }

  // A camera that is not at the height of eyes flies.
  function setPose(x, y, z, yaw, pitch) {
    camera.position.set(x, y, z);
    Object.assign(walker, { yaw, pitch, flying: Math.abs(y - heightAt(x, z) - EYE) > 0.05 });
    apply();
  }

  function setFlying(flying) {
    walker.flying = flying;
    apply();
  }

  // Moves right, ahead and up by meters. Whoever flies moves where the camera looks; whoever walks, along the ground.
  function move(right, ahead, up) {
    const turn = walker.yaw * DEGREE, tilt = walker.flying ? walker.pitch * DEGREE : 0;
    camera.position.x += right * Math.cos(turn) - ahead * Math.sin(turn) * Math.cos(tilt);
    camera.position.z -= right * Math.sin(turn) + ahead * Math.cos(turn) * Math.cos(tilt);
    if (walker.flying) camera.position.y += up + ahead * Math.sin(tilt);
    apply();
  }

  // From high above one moves faster.
  const above = () => camera.position.y - heightAt(camera.position.x, camera.position.z);
  const speed = () => (walker.flying ? Math.max(FLYING, 0.5 * above()) : WALKING);

  // Moves by the keys that are pressed, for some seconds. Returns whether it moved.
  function step(seconds) {
    const ways = [...pressed].filter((key) => KEYS[key]).map((key) => KEYS[key]);
    const sum = [0, 1, 2].map((axis) => Math.sign(ways.reduce((total, way) => total + way[axis], 0)));
    if (!walker.flying) sum[2] = 0;
    const length = Math.hypot(...sum);
    if (length === 0) return false;
    const meters = (seconds * speed() * (pressed.has("ShiftLeft") || pressed.has("ShiftRight") ? FASTER : 1)) / length;
    move(...sum.map((way) => way * meters));
    return true;
  }

  // Arrows belong to a slider that has the focus.
  const taken = ({ target, code, ctrlKey, metaKey, altKey }) =>
    ctrlKey || metaKey || altKey || (code.startsWith("Arrow") && target.matches?.("input"));
  addEventListener("keydown", (event) => {
    if (taken(event)) return;
    if (KEYS[event.code]) event.preventDefault();
    pressed.add(event.code);
    if (event.code === "KeyF" && !event.repeat) setFlying(!walker.flying);
    onChange();
  });
  addEventListener("keyup", ({ code }) => pressed.delete(code));
  addEventListener("blur", () => pressed.clear());

  const pointers = new Map(), release = ({ pointerId }) => pointers.delete(pointerId);
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    canvas.focus({ preventScroll: true });
    pointers.set(event.pointerId, event);
  });
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const right = event.clientX - before.clientX, down = event.clientY - before.clientY;
    const other = [...pointers.values()].find(({ pointerId }) => pointerId !== event.pointerId);
    pointers.set(event.pointerId, event);
    if (other) { // two fingers move
      const span = ({ clientX, clientY }) => Math.hypot(clientX - other.clientX, clientY - other.clientY);
      move((-right * speed()) / 150, ((span(event) - span(before)) * speed()) / 75, 0);
      return;
    }
    // What one drags stays under the pointer.
    const degrees = camera.fov / canvas.clientHeight;
    walker.yaw += right * degrees;
    walker.pitch += down * degrees;
    apply();
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    move(0, (-event.deltaY * (event.deltaMode ? 30 : 1) * speed()) / 400, 0);
  }, { passive: false });
  return walker;
};
