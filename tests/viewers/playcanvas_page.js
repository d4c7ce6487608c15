// PlayCanvas, without tone mapping. Canvases are in the colors of the screen by default.
import { canvas, query, refuse } from "/page.js";
import * as pc from "playcanvas";

// With ?smooth=coverage, alpha is the share of a pixel's samples that a model covers.
const covers = query.get("smooth") === "coverage";
const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: covers, alpha: false } });
app.autoRender = false;
app.start();
const camera = new pc.Entity("camera");
camera.addComponent("camera", { clearColor: pc.Color.WHITE, toneMapping: pc.TONEMAP_NONE });
app.root.addChild(camera);
let asset = null;
let shown = null;

export async function load(node) {
  refuse(node);
  shown?.destroy();
  asset?.unload();
  asset = new pc.Asset("model", "container", { url: "/model.glb" });
  await new Promise((resolve, reject) => {
    asset.ready(resolve);
    asset.once("error", (text) => reject(new Error(text)));
    app.assets.add(asset);
    app.assets.load(asset);
  });
  shown = asset.resource.instantiateRenderEntity();
  app.root.addChild(shown);
  if (!covers) return;
  for (const { meshInstances } of shown.findComponents("render")) {
    for (const { material } of meshInstances) {
      Object.assign(material, { alphaToCoverage: true, alphaTest: 0 });
      material.update();
    }
  }
}

export function draw({ projection, cameraToWorld, width, height }) {
  app.graphicsDevice.setResolution(width, height);
  const pose = new pc.Mat4().set(cameraToWorld);
  camera.setPosition(pose.getTranslation());
  camera.setRotation(new pc.Quat().setFromMat4(pose));
  camera.camera.calculateProjection = (matrix) => matrix.set(projection);
  app.render();
}
