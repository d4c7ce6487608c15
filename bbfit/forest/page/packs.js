"use strict";
// Data files are scripts, because a page that was opened by a double click may load nothing else. Each calls packs.arrive(name, base64).
window.packs = (() => {
  const arrived = new Map();

  const bytes = (text) => {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
    const letters = atob(text), values = new Uint8Array(letters.length);
    for (let place = 0; place < letters.length; place += 1) values[place] = letters.charCodeAt(place);
    return values;
  };

  // The bytes of the file data/NAME.js.
  const load = (name) => new Promise((resolve, reject) => {
    const script = document.createElement("script");
    const end = (done) => {
      script.remove();
      arrived.delete(name);
      done();
    };
    script.addEventListener("load", () => {
      const text = arrived.get(name);
      end(() => (text === undefined ? reject(new Error(`data/${name}.js is damaged`)) : resolve(bytes(text))));
    });
    script.addEventListener("error", () => end(() => reject(new Error(`data/${name}.js is missing`))));
    script.src = `data/${name}.js`;
    document.head.append(script);
  });

  return { load, arrive: (name, text) => arrived.set(name, text) };
})();
