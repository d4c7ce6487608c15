"use strict";
// The tiles of the forest: they are loaded when the camera comes near, nearest first, and freed when it is far.
bbfitForest.createTiles = (descriptions, trees, addField, wake) => {
  const AT_ONCE = 4;
  const KEPT = 1.25; // a tile is freed beyond so many draw distances
  const tiles = descriptions.map(({ name, low, high, count }) => ({ name, low, high, count, state: "away", patches: [] }));
  let loading = 0, failed = null;

  // How far a tile is from the camera, along the ground.
  const away = ({ low, high }, { x, z }) => Math.hypot(Math.max(low[0] - x, 0, x - high[0]), Math.max(low[2] - z, 0, z - high[2]));

  // Copies of each tree in the bytes of a tile: their number, the index of the tree of each (16 bits, padded to 32), then five rows of
  // floats: x, y and z from the tile's low corner, turns in degrees, and scales.
  function matricesOf(bytes, [left, bottom, back]) {
    const count = new DataView(bytes.buffer, bytes.byteOffset).getUint32(0, true);
    const indices = new Uint16Array(bytes.buffer, bytes.byteOffset + 4, count);
    const rows = new Float32Array(bytes.buffer, bytes.byteOffset + 4 + 4 * Math.ceil(count / 2), 5 * count);
    const counts = new Map(), found = new Map();
    for (const index of indices) counts.set(index, (counts.get(index) ?? 0) + 1);
    for (const [index, copies] of counts) found.set(index, { matrices: new Float32Array(16 * copies), at: 0 });
    for (let copy = 0; copy < count; copy += 1) {
      const entry = found.get(indices[copy]), { matrices, at } = entry;
      const turn = (rows[3 * count + copy] * Math.PI) / 180, scale = rows[4 * count + copy];
      matrices[at] = matrices[at + 10] = scale * Math.cos(turn);
      matrices[at + 8] = scale * Math.sin(turn);
      matrices[at + 2] = -matrices[at + 8];
      matrices[at + 5] = scale;
      matrices[at + 12] = left + rows[copy];
      matrices[at + 13] = bottom + rows[count + copy];
      matrices[at + 14] = back + rows[2 * count + copy];
      matrices[at + 15] = 1;
      entry.at += 16;
    }
    return found;
  }

  async function load(tile) {
    tile.state = "loading";
    loading += 1;
    try {
      const found = matricesOf(await packs.load(`tiles/${tile.name.replaceAll("/", "-")}`), tile.low);
      const fields = await Promise.all([...found].map(([tree]) => trees.field(tree)));
      tile.patches = [...found.values()].map(({ matrices }, index) => {
        addField(fields[index]);
        return [fields[index], fields[index].addPatch(matrices)];
      });
      tile.state = "here";
    } catch (error) {
      tile.state = "failed";
      failed = error;
    } finally {
      loading -= 1;
      wake();
    }
  }

  function free(tile) {
    for (const [field, patch] of tile.patches) field.removePatch(patch);
    Object.assign(tile, { patches: [], state: "away" });
  }

  return {
    tiles,
    // Loads and frees tiles for a place of the camera and a draw distance in meters. Returns whether tiles are missing still.
    update(eye, distance) {
      const wanted = [];
      for (const tile of tiles) {
        const meters = away(tile, eye);
        if (tile.state === "here" && meters > KEPT * distance) free(tile);
        if (tile.state === "away" && meters <= distance) wanted.push([meters, tile]);
      }
      wanted.sort((one, other) => one[0] - other[0]);
      for (const [, tile] of wanted.slice(0, AT_ONCE - loading)) load(tile);
      return wanted.length > 0 || loading > 0;
    },
    get failed() { return failed; },
    get loaded() { return tiles.reduce((sum, { state, count }) => sum + (state === "here" ? count : 0), 0); },
  };
};
