"use strict";
// The ground with its relief, a tint where trees cover it, the haze and the sky. Colors are display-referred.
bbfitForest.createGround = (THREE, scene, { low, high, cells, heights, cover }) => {
  const HAZE = 0xdde6e6, ZENITH = 0x8fb3d3, MEADOW = [176, 186, 140], FLOOR = [112, 128, 84];
  const size = [high[0] - low[0], high[1] - low[1]];
  const step = size.map((length) => length / cells);
  const clamp = (value, least, most) => Math.min(Math.max(value, least), most);

  // The height of the ground in meters, bilinear between the middles of cells.
  function heightAt(x, z) {
    if (!heights) return 0;
    const column = clamp((x - low[0]) / step[0] - 0.5, 0, cells - 1);
    const row = clamp((z - low[1]) / step[1] - 0.5, 0, cells - 1);
    const [left, back] = [Math.min(Math.floor(column), cells - 2), Math.min(Math.floor(row), cells - 2)];
    const across = column - left, along = row - back, at = (rows, columns) => heights[(back + rows) * cells + left + columns];
    const mix = (one, other, share) => one + (other - one) * share;
    return mix(mix(at(0, 0), at(0, 1), across), mix(at(1, 0), at(1, 1), across), along);
  }

  const fog = (scene.fog = new THREE.Fog(HAZE, 1, 2));
  const colors = new Uint8Array(4 * cells * cells);
  for (let cell = 0; cell < cells * cells; cell += 1) {
    const share = cover[cell] / 255;
    for (let channel = 0; channel < 3; channel += 1) {
      colors[4 * cell + channel] = MEADOW[channel] + (FLOOR[channel] - MEADOW[channel]) * share;
    }
    colors[4 * cell + 3] = 255;
  }
  const map = Object.assign(new THREE.DataTexture(colors, cells, cells), { encoding: THREE.sRGBEncoding, needsUpdate: true });
  Object.assign(map, { magFilter: THREE.LinearFilter, minFilter: THREE.LinearMipmapLinearFilter, generateMipmaps: true });

  // Small specks, so that the ground is seen to move; they fade before they are smaller than pixels.
  function grain(shader) {
    shader.vertexShader = shader.vertexShader
      .replace("void main() {", "varying vec3 place;\nvoid main() {")
      .replace("#include <project_vertex>", "#include <project_vertex>\n  place = ( modelMatrix * vec4( transformed, 1.0 ) ).xyz;");
    shader.fragmentShader = shader.fragmentShader
      .replace("void main() {", `varying vec3 place;
float speck( vec2 cell ) { return fract( sin( dot( mod( cell, 512.0 ), vec2( 12.9898, 78.233 ) ) ) * 43758.5453 ); }
float smoothed( vec2 at ) {
  vec2 cell = floor( at ), share = smoothstep( 0.0, 1.0, at - cell );
  float above = mix( speck( cell ), speck( cell + vec2( 1, 0 ) ), share.x );
  float below = mix( speck( cell + vec2( 0, 1 ) ), speck( cell + 1.0 ), share.x );
  return mix( above, below, share.y ) - 0.5;
}
void main() {`)
      .replace("#include <map_fragment>", `#include <map_fragment>
  float fine = 1.0 / ( 1.0 + 40.0 * length( fwidth( place.xz ) ) ), wide = 1.0 / ( 1.0 + 2.0 * length( fwidth( place.xz ) ) );
  diffuseColor.rgb *= 1.0 + 0.22 * fine * smoothed( 5.0 * place.xz ) + 0.14 * wide * smoothed( 0.35 * place.xz );`);
  }

  const material = new THREE.MeshBasicMaterial({ map });
  material.onBeforeCompile = grain;
  const parts = heights ? cells - 1 : 1, flat = (...sizes) => new THREE.PlaneGeometry(...sizes).rotateX(-Math.PI / 2);
  const geometry = flat(size[0] - step[0], size[1] - step[1], parts, parts);
  geometry.translate((low[0] + high[0]) / 2, 0, (low[1] + high[1]) / 2);
  const { position, uv } = geometry.attributes;
  for (let corner = 0; corner < position.count; corner += 1) {
    position.setY(corner, heightAt(position.getX(corner), position.getZ(corner)));
    uv.setXY(corner, (position.getX(corner) - low[0]) / size[0], (position.getZ(corner) - low[1]) / size[1]);
  }
  const surface = new THREE.Mesh(geometry, material);
  Object.assign(surface, { frustumCulled: false, renderOrder: -1 });

  // What lies around the forest. It is drawn behind everything else.
  const around = new THREE.Mesh(flat(1, 1), new THREE.MeshBasicMaterial({ depthWrite: false, depthTest: false }));
  around.material.color.setRGB(...MEADOW.map((value) => value / 255)).convertSRGBToLinear();
  around.material.onBeforeCompile = grain;
  around.position.set((low[0] + high[0]) / 2, heights ? heights.reduce((one, other) => Math.min(one, other)) : 0, (low[1] + high[1]) / 2);
  Object.assign(around, { frustumCulled: false, renderOrder: -2 });

  const sky = new THREE.Mesh(new THREE.SphereGeometry(1, 32, 16), new THREE.ShaderMaterial({
    uniforms: { haze: { value: new THREE.Color(HAZE) }, zenith: { value: new THREE.Color(ZENITH) } },
    vertexShader: `varying vec3 ahead;
void main() { ahead = position; gl_Position = projectionMatrix * modelViewMatrix * vec4( position, 1.0 ); }`,
    fragmentShader: `uniform vec3 haze, zenith; varying vec3 ahead;
void main() { gl_FragColor = vec4( mix( haze, zenith, pow( clamp( normalize( ahead ).y, 0.0, 1.0 ), 0.65 ) ), 1.0 ); }`,
    side: THREE.BackSide, depthWrite: false, depthTest: false,
  }));
  Object.assign(sky, { frustumCulled: false, renderOrder: -3 });
  scene.add(sky, around, surface);

  return {
    heightAt,
    HAZE,
    // Follows the camera, which sees as far as `distance`.
    update(camera, distance) {
      sky.position.copy(camera.position);
      sky.scale.setScalar((camera.near + camera.far) / 2);
      around.scale.set(Math.max(size[0], size[1]) + 4 * camera.far, 1, Math.max(size[0], size[1]) + 4 * camera.far);
      Object.assign(fog, { near: 0.3 * distance, far: 0.97 * distance });
    },
  };
};
