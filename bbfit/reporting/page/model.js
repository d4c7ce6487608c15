// Runs behind trimesh's viewer, whose variables are global, before the model is loaded.
renderer.outputEncoding = THREE.sRGBEncoding;
const dark = matchMedia("(prefers-color-scheme: dark)");
const paint = () => { scene.background = new THREE.Color(dark.matches ? 0x1d2126 : 0xffffff); };
paint();
dark.addEventListener("change", () => { paint(); render(); });
let framed = false;
// All that is to be seen in the picture, whatever the picture's shape: from azimuth 0, a little from above.
const frame = () => {
  const [low, high] = bounds.map((corner) => new THREE.Vector3(...corner));
  const size = high.clone().sub(low), wide = Math.hypot(size.x, size.z) / 2, half = Math.tan((camera.fov * Math.PI) / 360);
  const away = (1.1 * Math.max(size.y / 2, wide / camera.aspect)) / half + wide;
  controls.target.copy(low.add(high).multiplyScalar(0.5));
  camera.position.setFromSphericalCoords(away, 1.45, 0).add(controls.target);
  Object.assign(camera, { near: away / 100, far: 30 * away });
  camera.updateProjectionMatrix();
};
const layer = () => {
  const meshes = [];
  scene.traverse((item) => { if (item.isMesh && item.material.transparent) meshes.push(item); });
  for (const mesh of meshes) {
    const core = mesh.clone();
    core.material = mesh.material.clone();
    Object.assign(core.material, { transparent: false, alphaTest: 0.5, depthWrite: true });
    mesh.material.depthWrite = false;
    mesh.parent.add(core);
  }
};
// In place of the viewer's own: the trunk stays upright.
render = () => {
  if (!framed && camera.aspect) { framed = true; frame(); if (layered) layer(); }
  const eye = camera.position.clone().sub(controls.target);
  const seen = new THREE.Spherical().setFromVector3(eye);
  seen.phi = Math.min(Math.max(seen.phi, 0.05), Math.PI - 0.05);
  camera.position.setFromSpherical(seen).add(controls.target);
  camera.up.set(0, 1, 0);
  camera.lookAt(controls.target);
  tracklight.position.copy(camera.position);
  renderer.render(scene, camera);
};
