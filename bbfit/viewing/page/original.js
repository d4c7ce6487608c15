"use strict";
// The original tree in the light of its views. Browsers have no light from leaf to leaf, so the strengths of sun and sky are fitted.
(() => {
  const SIZE = 96, ROUNDS = 60, STEP = 1e-3;
  // How much an error of color it costs if the sun is stronger or weaker than in the views, where colors alone do not decide.
  const UNLIKELY = 0.01;

  // Let a model cast shadows, and let its materials reflect an even white sky. Adds the model's center and radius.
  function prepare(THREE, renderer, model) {
    const box = new THREE.Box3().setFromObject(model.root);
    Object.assign(model, { center: box.getCenter(new THREE.Vector3()), radius: box.getSize(new THREE.Vector3()).length() / 2 });
    const white = Object.assign(new THREE.Scene(), { background: new THREE.Color(0xffffff) });
    const sky = new THREE.PMREMGenerator(renderer).fromScene(white).texture;
    for (const mesh of model.meshes) {
      mesh.castShadow = mesh.receiveShadow = true;
      if ("envMapIntensity" in mesh.material) Object.assign(mesh.material, { envMap: sky, needsUpdate: true });
    }
  }

  // Shine on a model with shares of the views' light: of the sun, of the sky without its reflections, and of the sky with them.
  function shine(model, lamps, light, [sun, dull, bright]) {
    lamps.shine({ ...light, sun: sun * light.sun, sky: dull * light.sky });
    for (const { material } of model.meshes) material.envMapIntensity = (bright * light.sky) / Math.PI;
  }

  // The shares with which the model's mean colors are those of the views; null if the browser cannot measure them.
  function matchLight(THREE, renderer, model, light, views) {
    if (!renderer.extensions.get("EXT_color_buffer_float")) return null;
    const { center, radius } = model, scene = new THREE.Scene().add(model.root), camera = new THREE.PerspectiveCamera(35, 1, radius / 100, 10 * radius);
    const lamps = bbfit.createLight(THREE, scene), target = new THREE.WebGLRenderTarget(SIZE, SIZE, { type: THREE.FloatType });
    lamps.aim(light.azimuth, light.height, center, radius);
    renderer.shadowMap.needsUpdate = true;
    renderer.setScissorTest(false);
    renderer.setClearColor(0x000000, 0);
    renderer.setRenderTarget(target);
    const pixels = (shares) => {
      const values = new Float32Array(4 * SIZE * SIZE);
      shine(model, lamps, light, shares);
      renderer.render(scene, camera);
      renderer.readRenderTargetPixels(target, 0, 0, SIZE, SIZE, values);
      return values;
    };
    // The linear colors of covered pixels under each light alone, for each view and channel.
    const seen = views.map(({ azimuth, elevation }) => {
      camera.position.setFromSphericalCoords(4 * radius, ((90 - elevation) * Math.PI) / 180, (azimuth * Math.PI) / 180).add(center);
      camera.lookAt(center);
      const alone = [pixels([1, 0, 0]), pixels([0, 1, 0]), pixels([0, 0, 1])];
      const covered = Array.from({ length: SIZE * SIZE }, (_, pixel) => 4 * pixel).filter((start) => alone[0][start + 3] > 0.5);
      return [0, 1, 2].map((channel) => covered.map((start) => alone.map((values) => values[start + channel])));
    });
    renderer.setRenderTarget(null);
    target.dispose();
    lamps.sun.shadow.map?.dispose();
    const encode = (value) => (value < 0.0031308 ? 12.92 * value : 1.055 * Math.min(value, 1) ** (1 / 2.4) - 0.055);
    const mean = (parts, [sun, dull, bright]) =>
      parts.reduce((sum, [a, b, c]) => sum + encode(sun * a + dull * b + bright * c), 0) / Math.max(parts.length, 1);
    const errors = (shares) => [
      ...views.flatMap(({ color }, index) => color.map((value, channel) => mean(seen[index][channel], shares) - value)),
      UNLIKELY * (shares[0] - 1),
    ];
    let shares = [1, 0.3, 0.3];
    for (let round = 0; round < ROUNDS; round += 1) {
      // One step of Gauss and Newton on one of them, with a numeric derivative.
      const chosen = round % shares.length, changed = (value) => shares.map((share, index) => (index === chosen ? value : share));
      const now = errors(shares), slope = errors(changed(shares[chosen] + STEP)).map((value, index) => (value - now[index]) / STEP);
      const dot = (other) => slope.reduce((sum, value, index) => sum + value * other[index], 0);
      shares = changed(Math.min(Math.max(shares[chosen] - dot(now) / (dot(slope) + 1e-6), 0), 4));
    }
    return shares;
  }

  bbfit.original = { prepare, shine, matchLight };
})();
