// Loads what `bbfit lod` wrote into a scene of Babylon.js, with addLODLevel:
//   await loadLod("levels/lod.json", scene, { height: engine.getRenderHeight(), fov: camera.fov });  // Babylon.js has radians
import { BoundingInfo } from "@babylonjs/core/Culling/boundingInfo.js";
import { LoadAssetContainerAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import { Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { Mesh } from "@babylonjs/core/Meshes/mesh.js";
import { TransformNode } from "@babylonjs/core/Meshes/transformNode.js";

const focal = (height, fov) => height / 2 / Math.tan(fov / 2);

export async function loadLod(url, scene, { height, fov } = {}) {
  const { config, extent, levels, name } = await (await fetch(url)).json();
  const factor = height && fov ? focal(height, fov) / focal(config.screen_height, (config.screen_fov_degrees * Math.PI) / 180) : 1;
  const tree = new TransformNode(name, scene);
  for (const [index, level] of levels.entries()) {
    const container = await LoadAssetContainerAsync(new URL(encodeURIComponent(level.file), new URL(url, location)).href, scene);
    container.addAllToScene();
    const [root] = container.rootNodes;
    root.parent = tree;
    const toWorld = root.computeWorldMatrix(true);
    for (const mesh of container.meshes.filter((mesh) => mesh.getTotalVertices() > 0)) {
      const own = placeholder(mesh, extent, toWorld);
      own.addLODLevel(factor * level.distance_meters, mesh);
      if (index + 1 < levels.length) own.addLODLevel(factor * levels[index + 1].distance_meters, null);
    }
  }
  return tree;
}

// A mesh without triangles in place of another, which shows nothing from nearer than its levels. Babylon.js takes distances from the
// center of its bounds, which are those of the whole tree, so that all meshes of a level switch together.
function placeholder(mesh, { low, high }, toWorld) {
  const empty = new Mesh(`${mesh.name} LOD`, mesh.getScene(), mesh.parent);
  const { position, rotation, rotationQuaternion, scaling } = mesh;
  Object.assign(empty, { position, rotation, rotationQuaternion, scaling });
  const toLocal = toWorld.multiply(empty.computeWorldMatrix(true).clone().invert());
  const corners = Array.from({ length: 8 }, (_, corner) => new Vector3(...low.map((value, axis) => (corner & (1 << axis) ? high[axis] : value))));
  const local = corners.map((point) => Vector3.TransformCoordinates(point, toLocal));
  const [least, most] = [Vector3.Minimize, Vector3.Maximize].map((choose) => local.reduce((best, point) => choose(best, point)));
  empty.setBoundingInfo(new BoundingInfo(least, most, empty.getWorldMatrix()));
  return empty;
}
