// Loads what `bbfit lod` wrote into an application of PlayCanvas, and shows the level for the distance from a camera's entity:
//   app.root.addChild(await loadLod("levels/lod.json", app, camera, { height: app.graphicsDevice.height }));
import { Asset, Entity, Vec3 } from "playcanvas";

const focal = (height, fov) => height / 2 / Math.tan((fov * Math.PI) / 360);

export async function loadLod(url, app, camera, { height } = {}) {
  const { config, extent, levels, name } = await (await fetch(url)).json();
  const factor = height ? focal(height, camera.camera.fov) / focal(config.screen_height, config.screen_fov_degrees) : 1;
  const tree = new Entity(name);
  for (const { file } of levels) tree.addChild(await load(app, new URL(encodeURIComponent(file), new URL(url, location)).href));
  const center = new Vec3().lerp(new Vec3(extent.low), new Vec3(extent.high), 0.5);
  const choose = () => {
    const world = tree.getWorldTransform();
    const { x, y, z } = world.getScale();
    const distance = world.transformPoint(center).distance(camera.getPosition()) / Math.max(x, y, z);
    const chosen = levels.findLastIndex((level, index) => index === 0 || distance >= factor * level.distance_meters);
    tree.children.forEach((entity, index) => (entity.enabled = index === chosen));
  };
  app.on("prerender", choose);
  tree.once("destroy", () => app.off("prerender", choose));
  choose();
  return tree;
}

function load(app, url) {
  const asset = new Asset(url, "container", { url });
  app.assets.add(asset);
  app.assets.load(asset);
  return new Promise((resolve, reject) => {
    asset.ready(() => resolve(asset.resource.instantiateRenderEntity()));
    asset.once("error", reject);
  });
}
