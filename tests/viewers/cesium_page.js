// CesiumJS: a scene without globe and sky. It has no tone mapping unless highDynamicRange is on. Layers are drawn from back to front; by
// default it averages them (order-independent translucency), unless the page has ?order=independent.
import { canvas, centered, query, refuse } from "/page.js";
import { Axis, Cartesian3, Color, Matrix4, Model, PerspectiveFrustum, Scene } from "cesium";

window.CESIUM_BASE_URL = "/cesium/Build/Cesium/";
const orderIndependentTranslucency = query.get("order") === "independent";
const contextOptions = { webgl: { alpha: false, antialias: false } };
const scene = new Scene({ canvas, orderIndependentTranslucency, contextOptions, msaaSamples: 1 });
scene.backgroundColor = Color.WHITE;
scene.highDynamicRange = false;
scene.postProcessStages.fxaa.enabled = false;
// The model stands on the equator. Its axes, which are glTF's, are parallel to those of the Earth.
const place = Matrix4.fromTranslation(new Cartesian3(6378137, 0, 0));

export async function load(node) {
  refuse(node);
  scene.primitives.removeAll();
  const axes = { modelMatrix: place, upAxis: Axis.Z, forwardAxis: Axis.X };
  const model = await Model.fromGltfAsync({ url: "/model.glb", ...axes, incrementallyLoadTextures: false });
  scene.primitives.add(model);
  let failed = null;
  model.errorEvent.addEventListener((error) => (failed = error));
  while (!model.ready) {
    if (failed !== null) throw failed;
    scene.render();
    await new Promise((resolve) => setTimeout(resolve, 5));
  }
}

export function draw({ projection, cameraToWorld, width, height, near, far }) {
  centered(projection);
  const { camera } = scene;
  const world = Matrix4.multiply(place, Matrix4.fromColumnMajorArray(cameraToWorld), new Matrix4());
  const axis = (vector) => Matrix4.multiplyByPointAsVector(world, vector, new Cartesian3());
  camera.position = Matrix4.getTranslation(world, new Cartesian3());
  camera.direction = axis(new Cartesian3(0, 0, -1));
  camera.up = axis(Cartesian3.UNIT_Y);
  camera.right = axis(Cartesian3.UNIT_X);
  // It moves the planes of depth by itself, so that the sides of the picture cannot be given at a depth.
  const fov = 2 * Math.atan(1 / Math.min(projection[0], projection[5]));
  camera.frustum = new PerspectiveFrustum({ fov, aspectRatio: width / height, near, far });
  scene.render();
}
