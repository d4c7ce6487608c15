"use strict";
// The trees of the library: a field for each, whose levels of detail are loaded when a copy is near enough for them.
window.bbfitForest = {
  // A tree's field starts with its coarsest level. `wake` is called when something has been loaded.
  createTrees(THREE, frame, trees, wake) {
    const { TreeField, createImageBitmap } = frame.contentWindow;
    const EARLY = 1.25; // levels are loaded when a copy is so many times their distance away
    const textures = new Map(), entries = new Map(), colors = [0xe4572e, 0xf2b134, 0x76b041, 0x17a398, 0x3b6fb6, 0x7d53a6];
    let pending = 0, factor = 1, farthest = Infinity, colored = false;

    // All models share the textures of the atlas. A texture may be WebP alone; the loader's own extension would look for it on a server.
    const sharing = (pictures) => (parser) => {
      const addresses = (parser.json.textures ?? []).map(({ source, extensions }) =>
        parser.json.images[source ?? extensions?.EXT_texture_webp?.source]?.uri);
      const shared = (index) => pictures[addresses[index]];
      return {
        name: "bbfit_shared_textures",
        beforeRoot() {
          addresses.forEach((_, index) => { if (shared(index)) delete parser.json.textures[index].extensions; });
        },
        loadTexture(index) {
          if (!shared(index)) return null;
          const { samplers, textures: listed } = parser.json, sampler = samplers?.[listed[index].sampler] ?? {};
          const { magFilter = 9729, minFilter = 9987, wrapS = 10497, wrapT = 10497 } = sampler;
          const key = JSON.stringify([shared(index), magFilter, minFilter, wrapS, wrapT]);
          if (!textures.has(key)) textures.set(key, texture(shared(index), { magFilter, minFilter, wrapS, wrapT }));
          return textures.get(key);
        },
      };
    };
    const FILTERS = {
      9728: "Nearest", 9729: "Linear", 9984: "NearestMipmapNearest", 9985: "LinearMipmapNearest", 9986: "NearestMipmapLinear",
      9987: "LinearMipmapLinear",
    };
    const WRAPS = { 33071: "ClampToEdge", 33648: "MirroredRepeat", 10497: "Repeat" };
    async function texture(name, { magFilter, minFilter, wrapS, wrapT }) {
      const picture = new Blob([await packs.load(name)]);
      const image = await createImageBitmap(picture, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
      const made = Object.assign(new THREE.Texture(image), { flipY: false, needsUpdate: true, anisotropy: 4 });
      Object.assign(made, { magFilter: THREE[`${FILTERS[magFilter]}Filter`], minFilter: THREE[`${FILTERS[minFilter]}Filter`] });
      return Object.assign(made, { wrapS: THREE[`${WRAPS[wrapS]}Wrapping`], wrapT: THREE[`${WRAPS[wrapT]}Wrapping`] });
    }

    // Mixes a color into a material: red, green and blue in linear light, and its share.
    function tintable(material) {
      const tint = (material.userData.tint = new THREE.Vector4());
      material.onBeforeCompile = (shader) => {
        shader.uniforms.tint = { value: tint };
        shader.fragmentShader = shader.fragmentShader
          .replace("void main() {", "uniform vec4 tint;\nvoid main() {")
          .replace("#include <map_fragment>", `#include <map_fragment>
  diffuseColor.rgb = mix( diffuseColor.rgb, tint.rgb * ( 0.3 + 2.0 * dot( diffuseColor.rgb, vec3( 0.3333 ) ) ), tint.a );`);
      };
    }

    async function loadLevel({ pack, pictures }) {
      const loader = new THREE.GLTFLoader().register(sharing(pictures));
      const model = await bbfit.loadModel(THREE, (await packs.load(pack)).buffer, true, loader);
      model.traverse(({ material }) => { if (material && !material.userData.tint) tintable(material); });
      return model;
    }

    // The levels that are loaded, finest first. One that is missing leaves its place to the next coarser one.
    const usable = (entry) => entry.objects.flatMap((object, level) => (object ? [{ object, level, distance: 0 }] : []));

    function applyDistances({ tree, field, objects }) {
      const loaded = usable({ objects });
      field.levels.forEach((level, index) => { level.distance = factor * trees[tree].levels[loaded[index].level].distance; });
      field.farthest = farthest;
    }

    function paint(entry) {
      usable(entry).forEach(({ level }, index) => {
        const { r, g, b } = new THREE.Color(colors[level % colors.length]).convertSRGBToLinear();
        for (const { material } of entry.field.levels[index].parts) material.userData.tint.set(r, g, b, colored ? 0.85 : 0);
      });
    }

    async function request(entry, level) {
      entry.asked.add(level);
      pending += 1;
      try {
        entry.objects[level] = await loadLevel(trees[entry.tree].levels[level]);
        if (entry.field) entry.field.setLevels(usable(entry));
        else entry.field = new TreeField(usable(entry), trees[entry.tree]);
        applyDistances(entry);
        paint(entry);
      } finally {
        pending -= 1;
        wake();
      }
    }

    // The field of a tree.
    function field(tree) {
      if (!entries.has(tree)) {
        const entry = { tree, objects: trees[tree].levels.map(() => null), asked: new Set(), field: null };
        entry.first = request(entry, trees[tree].levels.length - 1).then(() => entry.field);
        entries.set(tree, entry);
      }
      return entries.get(tree).first;
    }

    // Asks for the levels that copies need where the camera is.
    function loadFor(eye) {
      for (const entry of entries.values()) {
        if (!entry.field) continue;
        const away = ({ bounds, largest }) => Math.max(0, bounds.distanceToPoint(eye)) / largest;
        const nearest = entry.field.patches.reduce((least, patch) => Math.min(least, away(patch)), Infinity);
        const { levels } = trees[entry.tree];
        for (let level = levels.length - 2; level >= 0; level -= 1) {
          if (entry.asked.has(level) || nearest >= EARLY * factor * levels[level + 1].distance) continue;
          request(entry, level).catch((error) => console.error(error));
        }
      }
    }

    return {
      colors,
      entries,
      field,
      loadFor,
      get pending() { return pending; },
      get fields() { return [...entries.values()].flatMap((entry) => entry.field ?? []); },
      // `scale` is the screen's focal length over that of the library's distances.
      setScreen(scale) {
        factor = scale;
        for (const entry of entries.values()) if (entry.field) applyDistances(entry);
      },
      setFarthest(meters) {
        farthest = meters;
        for (const entry of entries.values()) if (entry.field) entry.field.farthest = meters;
      },
      colorLevels(on) {
        colored = on;
        for (const entry of entries.values()) if (entry.field) paint(entry);
      },
    };
  },
};
