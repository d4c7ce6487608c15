// Runs behind trimesh's viewer, whose variables are global, before the model is loaded.
renderer.outputEncoding = THREE.sRGBEncoding;
const dark = matchMedia("(prefers-color-scheme: dark)");
const paint = () => { scene.background = new THREE.Color(dark.matches ? 0x1d2126 : 0xffffff); };
paint();
dark.addEventListener("change", () => { paint(); render(); });
// In place of the viewer's own: the trunk stays upright.
render = () => {
  const eye = camera.position.clone().sub(controls.target);
  const seen = new THREE.Spherical().setFromVector3(eye);
  seen.phi = Math.min(Math.max(seen.phi, 0.05), Math.PI - 0.05);
  camera.position.setFromSpherical(seen).add(controls.target);
  camera.up.set(0, 1, 0);
  camera.lookAt(controls.target);
  tracklight.position.copy(camera.position);
  renderer.render(scene, camera);
};
