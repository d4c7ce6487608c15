// Shows a forest in the program of ?program=, by the files that bbfit writes: /forest/forest.glb, and in cesium /forest/tiles/tileset.json.
// The program "plain" is three.js without instances: a copy of a tree of the library for each entry of ?copies=.
// look() draws it from an eye to a target, both in the forest's axes (Y up), and returns the pixels as RGBA, over white.
const WIDTH = 320;
const HEIGHT = 240;
const canvas = document.getElementById("canvas");
const query = new URLSearchParams(location.search);
const program = query.get("program");

async function three(fill) {
  const THREE = await import("three");
  const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  renderer.setClearColor(0xffffff, 1);
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(45, WIDTH / HEIGHT, 1, 10000);
  await fill(scene, new GLTFLoader(), THREE);
  return ({ eye, target, fov }) => {
    camera.fov = fov;
    camera.position.set(...eye);
    camera.lookAt(...target);
    camera.updateProjectionMatrix();
    renderer.render(scene, camera);
  };
}

const programs = {
  three: () => three(async (scene, loader) => scene.add((await loader.loadAsync("/forest/forest.glb")).scene)),

  plain: () =>
    three(async (scene, loader, THREE) => {
      for (const { file, matrix } of await (await fetch("/forest/copies.json")).json()) {
        const tree = (await loader.loadAsync(`/library/${file}`)).scene;
        tree.matrixAutoUpdate = false;
        tree.matrix = new THREE.Matrix4().fromArray(matrix);
        scene.add(tree);
      }
    }),

  async babylon() {
    const at = (path) => import(`@babylonjs/core/${path}.js`);
    const [{ Engine }, { Scene }, { FreeCamera }, { Vector3 }, { Color4 }, { LoadAssetContainerAsync }] = await Promise.all(
      ["Engines/engine", "scene", "Cameras/freeCamera", "Maths/math.vector", "Maths/math.color", "Loading/sceneLoader"].map(at),
    );
    await import("@babylonjs/core/Materials/standardMaterial.js");
    await import("@babylonjs/core/Meshes/thinInstanceMesh.js");
    const extensions = ["KHR_materials_unlit", "KHR_mesh_quantization", "EXT_mesh_gpu_instancing"].map((name) => `2.0/Extensions/${name}`);
    for (const name of ["glTFFileLoader", "2.0/glTFLoader", ...extensions]) {
      await import(`@babylonjs/loaders/glTF/${name}.js`);
    }
    const engine = new Engine(canvas, false, { preserveDrawingBuffer: true, useExactSrgbConversions: true });
    const scene = new Scene(engine);
    scene.useRightHandedSystem = true;
    scene.clearColor = new Color4(1, 1, 1, 1);
    const camera = new FreeCamera("camera", Vector3.Zero(), scene);
    Object.assign(camera, { minZ: 1, maxZ: 10000 });
    const container = await LoadAssetContainerAsync("/forest/forest.glb", scene);
    container.addAllToScene();
    for (const texture of container.textures) texture.anisotropicFilteringLevel = 1; // as glTF's samplers say
    await scene.whenReadyAsync();
    return ({ eye, target, fov }) => {
      camera.fov = (fov * Math.PI) / 180;
      camera.position.set(...eye);
      camera.setTarget(Vector3.FromArray(target));
      scene.render();
    };
  },

  async playcanvas() {
    const { Application, Asset, Color, Entity, FILLMODE_NONE, TONEMAP_NONE } = await import("playcanvas");
    const app = new Application(canvas, { graphicsDeviceOptions: { antialias: false, preserveDrawingBuffer: true } });
    app.autoRender = false;
    app.setCanvasFillMode(FILLMODE_NONE, WIDTH, HEIGHT);
    app.start();
    const camera = new Entity();
    camera.addComponent("camera", { nearClip: 1, farClip: 10000, clearColor: new Color(1, 1, 1), toneMapping: TONEMAP_NONE });
    app.root.addChild(camera);
    const asset = new Asset("forest", "container", { url: "/forest/forest.glb" });
    await new Promise((resolve, reject) => {
      asset.ready(resolve);
      asset.once("error", (text) => reject(new Error(text)));
      app.assets.add(asset);
      app.assets.load(asset);
    });
    app.root.addChild(asset.resource.instantiateRenderEntity());
    return ({ eye, target, fov }) => {
      camera.camera.fov = fov;
      camera.setPosition(...eye);
      camera.lookAt(...target);
      return new Promise((resolve) => {
        app.once("frameend", resolve);
        app.renderNextFrame = true;
      });
    };
  },

  // ?longitude= and ?latitude= are those of the forest's origin; without, the tileset is at the north pole. A view may have `places`, which are
  // longitudes, latitudes and heights; it returns their pixels by Cesium's own ellipsoid.
  async cesium() {
    const C = await import("/node_modules/cesium/Build/Cesium/index.js");
    const scene = new C.Scene({ canvas, contextOptions: { webgl: { preserveDrawingBuffer: true, antialias: false } }, msaaSamples: 1 });
    Object.assign(scene, { backgroundColor: C.Color.WHITE, highDynamicRange: false });
    scene.postProcessStages.fxaa.enabled = false;
    const earth = query.has("longitude");
    const pole = C.Matrix4.fromTranslation(new C.Cartesian3(0, 0, 7e6)); // Cesium shows nothing below the ground of the Earth
    const origin = earth ? C.Cartesian3.fromDegrees(Number(query.get("longitude")), Number(query.get("latitude"))) : null;
    const frame = earth ? C.Transforms.eastNorthUpToFixedFrame(origin) : pole;
    const tileset = await C.Cesium3DTileset.fromUrl("/forest/tiles/tileset.json", {
      cullRequestsWhileMoving: false, // the camera jumps
      foveatedScreenSpaceError: false,
      ...(earth ? {} : { modelMatrix: pole }),
    });
    const failures = [];
    tileset.tileFailed.addEventListener(({ message }) => failures.push(message));
    scene.primitives.add(tileset);
    const point = ([x, y, z]) => C.Matrix4.multiplyByPoint(frame, new C.Cartesian3(x, -z, y), new C.Cartesian3());
    return async ({ eye, target, fov, places = [], pick = null }) => {
      // The field of view is that of the longer side in Cesium.
      const across = 2 * Math.atan((Math.tan((fov * Math.PI) / 360) * WIDTH) / HEIGHT);
      scene.camera.frustum = new C.PerspectiveFrustum({ fov: across, aspectRatio: WIDTH / HEIGHT, near: 1, far: 100000 });
      const direction = C.Cartesian3.subtract(point(target), point(eye), new C.Cartesian3());
      C.Cartesian3.normalize(direction, direction);
      const vertical = C.Matrix4.multiplyByPointAsVector(frame, C.Cartesian3.UNIT_Z, new C.Cartesian3());
      const right = C.Cartesian3.normalize(C.Cartesian3.cross(direction, vertical, new C.Cartesian3()), new C.Cartesian3());
      const up = C.Cartesian3.cross(right, direction, new C.Cartesian3());
      scene.camera.setView({ destination: point(eye), orientation: { direction, up } });
      do {
        await new Promise((resolve) => setTimeout(resolve, 20));
        scene.initializeFrame();
        scene.render();
      } while (!tileset.tilesLoaded);
      scene.render();
      if (failures.length > 0) throw new Error(failures.join());
      const pixels = places.map((place) => {
        const { x, y } = C.SceneTransforms.worldToWindowCoordinates(scene, C.Cartesian3.fromDegrees(...place));
        return [x, y];
      });
      const feature = pick === null ? undefined : scene.pick(new C.Cartesian2(...pick));
      const picked = feature && Object.fromEntries(["height", "row", "species"].map((name) => [name, feature.getProperty(name)]));
      return { pixels, picked, tiles: tileset.statistics.selected, trees: tileset.statistics.numberOfFeaturesSelected };
    };
  },
};

const draw = programs[program]();

window.look = async (view) => {
  const found = (await (await draw)(view)) ?? {};
  const copy = new OffscreenCanvas(WIDTH, HEIGHT).getContext("2d");
  copy.drawImage(canvas, 0, 0);
  return { ...found, picture: [...copy.getImageData(0, 0, WIDTH, HEIGHT).data] };
};
