// Shows levels of detail in the program of ?program=, by the files that bbfit writes for it. look() draws them from a distance of their
// center along +Z, with a vertical field of view of 2 degrees, and returns the 96 x 96 pixels as RGBA, over black.
const SIZE = 96;
const FOV = 2;
const center = [0, 1, 0];
const canvas = document.getElementById("canvas");
const query = new URLSearchParams(location.search);
const program = query.get("program");
// Of the tree, about its center. With another than 1, three.js shows a clone.
const scale = Number(query.get("scale") ?? 1);

const programs = {
  async three() {
    const THREE = await import("three");
    const { loadLod } = await import("/levels/lod_three.js");
    const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    const scene = new THREE.Scene();
    const camera = new THREE.PerspectiveCamera(FOV, 1, 1, 10000);
    const lod = await loadLod("/levels/lod.json", { height: SIZE, fov: FOV });
    const shown = scale === 1 ? lod : lod.clone();
    shown.scale.setScalar(scale);
    shown.position.y = center[1] * (1 - scale);
    scene.add(shown);
    return (distance) => {
      camera.position.set(center[0], center[1], center[2] + distance);
      renderer.render(scene, camera);
    };
  },

  // Copies of the tree: ?matrices= lists their matrices, column after column. By default it is one, where the tree is. ?patches= adds them
  // one after another.
  async field() {
    const THREE = await import("three");
    const { loadField } = await import("/levels/lod_field_three.js");
    const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
    const scene = new THREE.Scene();
    const camera = new THREE.PerspectiveCamera(FOV, 1, 1, 10000);
    const matrices = JSON.parse(query.get("matrices")) ?? new THREE.Matrix4().toArray();
    const all = new Float32Array(matrices);
    const field = await loadField("/levels/lod.json", query.has("patches") ? [] : all, { height: SIZE, fov: FOV });
    if (query.has("patches")) inPatches(field, all);
    scene.add(field);
    return (distance) => {
      camera.position.set(center[0], center[1], center[2] + distance);
      field.update(camera);
      renderer.render(scene, camera);
    };
  },

  async babylon() {
    const at = (path) => import(`@babylonjs/core/${path}.js`);
    const [{ Engine }, { Scene }, { FreeCamera }, { Vector3 }, { Color4 }] = await Promise.all(
      ["Engines/engine", "scene", "Cameras/freeCamera", "Maths/math.vector", "Maths/math.color"].map(at),
    );
    await import("@babylonjs/core/Materials/standardMaterial.js");
    const extensions = ["KHR_materials_unlit", "KHR_mesh_quantization", "MSFT_lod"].map((name) => `2.0/Extensions/${name}`);
    for (const name of ["glTFFileLoader", "2.0/glTFLoader", ...extensions]) {
      await import(`@babylonjs/loaders/glTF/${name}.js`);
    }
    const engine = new Engine(canvas, false, { preserveDrawingBuffer: true });
    const scene = new Scene(engine);
    scene.clearColor = new Color4(0, 0, 0, 1);
    const camera = new FreeCamera("camera", Vector3.Zero(), scene);
    Object.assign(camera, { fov: (FOV * Math.PI) / 180, minZ: 1, maxZ: 10000 });
    if (query.has("joined")) {
      const { LoadAssetContainerAsync } = await at("Loading/sceneLoader");
      (await LoadAssetContainerAsync(`/levels/${query.get("joined")}`, scene)).addAllToScene();
    } else {
      await (await import("/levels/lod_babylon.js")).loadLod("/levels/lod.json", scene, { height: SIZE, fov: camera.fov });
    }
    await scene.whenReadyAsync();
    return (distance) => {
      camera.position.set(center[0], center[1], center[2] + distance);
      camera.setTarget(Vector3.FromArray(center));
      scene.render();
    };
  },

  async playcanvas() {
    const { Application, Color, Entity, FILLMODE_NONE, TONEMAP_NONE } = await import("playcanvas");
    const { loadLod } = await import("/levels/lod_playcanvas.js");
    const app = new Application(canvas, { graphicsDeviceOptions: { antialias: false, preserveDrawingBuffer: true } });
    app.autoRender = false;
    app.setCanvasFillMode(FILLMODE_NONE, SIZE, SIZE);
    app.start();
    const camera = new Entity();
    camera.addComponent("camera", { fov: FOV, nearClip: 1, farClip: 10000, clearColor: new Color(0, 0, 0), toneMapping: TONEMAP_NONE });
    app.root.addChild(camera);
    const tree = await loadLod("/levels/lod.json", app, camera, { height: SIZE });
    tree.setLocalScale(scale, scale, scale);
    tree.setLocalPosition(0, center[1] * (1 - scale), 0);
    app.root.addChild(tree);
    return (distance) => {
      camera.setPosition(center[0], center[1], center[2] + distance);
      return new Promise((resolve) => {
        app.once("frameend", resolve);
        app.renderNextFrame = true;
      });
    };
  },

  async cesium() {
    const { Cartesian3, Cesium3DTileset, Color, Matrix4, PerspectiveFrustum, Scene } = await import("/node_modules/cesium/Build/Cesium/index.js");
    const scene = new Scene({ canvas, contextOptions: { webgl: { preserveDrawingBuffer: true } } });
    Object.assign(scene, { backgroundColor: Color.BLACK, highDynamicRange: false });
    scene.postProcessStages.fxaa.enabled = false;
    const place = Matrix4.fromTranslation(new Cartesian3(0, 0, 7e6)); // Cesium shows nothing below the ground of the Earth
    const tileset = await Cesium3DTileset.fromUrl("/levels/tileset.json", { modelMatrix: place });
    scene.primitives.add(tileset);
    scene.camera.frustum = new PerspectiveFrustum({ fov: (FOV * Math.PI) / 180, aspectRatio: 1, near: 1, far: 10000 });
    return async (distance) => {
      // glTF's (x, y, z) is (x, -z, y) in a tile.
      const position = new Cartesian3(center[0], -(center[2] + distance), 7e6 + center[1]);
      scene.camera.setView({ destination: position, orientation: { direction: Cartesian3.UNIT_Y, up: Cartesian3.UNIT_Z } });
      do {
        await new Promise((resolve) => setTimeout(resolve, 20));
        scene.initializeFrame();
        scene.render();
      } while (!tileset.tilesLoaded);
      scene.render();
    };
  },
};

// Adds each copy as a patch of its own, and two more between them that go again.
function inPatches(field, matrices) {
  const others = [];
  for (let start = 0; start < matrices.length; start += 16) {
    others.push(field.addPatch(matrices));
    field.addPatch(matrices.subarray(start, start + 16));
    others.push(field.addPatch(matrices.subarray(0, 32)));
  }
  for (const patch of others) field.removePatch(patch);
  if (field.count !== matrices.length / 16 || field.patches.length !== field.count) throw new Error("patches are left");
}

const draw = programs[program]();

window.look = async (distance) => {
  await (await draw)(distance);
  const copy = new OffscreenCanvas(SIZE, SIZE).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  return [...copy.getImageData(0, 0, SIZE, SIZE).data];
};
