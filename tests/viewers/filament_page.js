// Filament in WebAssembly, with linear tone mapping and without FXAA. It blends in linear light, which no setting changes.
import { canvas, refuse, script } from "/page.js";

await script("/filament/filament.js");
await new Promise((resolve) => Filament.init([], resolve));
const engine = Filament.Engine.create(canvas);
const [scene, view, renderer, swapChain] = [engine.createScene(), engine.createView(), engine.createRenderer(), engine.createSwapChain()];
const camera = engine.createCamera(Filament.EntityManager.get().create());
view.setCamera(camera);
view.setScene(scene);
view.setAntiAliasing(Filament.View$AntiAliasing.NONE);
view.setMultiSampleAntiAliasingOptions({ enabled: true, sampleCount: 4 });
const { LINEAR } = Filament.ColorGrading$ToneMapping;
const { ULTRA } = Filament.ColorGrading$QualityLevel;
view.setColorGrading(Filament.ColorGrading.Builder().toneMapping(LINEAR).quality(ULTRA).format(Filament.ColorGrading$LutFormat.FLOAT).build(engine));
// White: of 1, its table of colors makes 252 of 255.
renderer.setClearOptions({ clearColor: [1.03, 1.03, 1.03, 1], clear: true });
const loader = engine.createAssetLoader();
let asset = null;

export async function load(node) {
  refuse(node);
  if (asset !== null) {
    scene.removeEntities(asset.getEntities());
    loader.destroyAsset(asset);
  }
  asset = loader.createAsset(new Uint8Array(await (await fetch("/model.glb")).arrayBuffer()));
  await new Promise((resolve) => asset.loadResources(resolve, null, null, 1));
  scene.addEntities(asset.getEntities());
}

export function draw({ projection, cameraToWorld, width, height, near, far }) {
  view.setViewport([0, 0, width, height]);
  camera.setModelMatrix(cameraToWorld);
  camera.setCustomProjection(projection, near, far);
  renderer.render(swapChain, view);
  engine.execute();
}
