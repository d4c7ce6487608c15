// Prints the glTF validator's report on each file named, as a JSON list: node validate.mjs FILE...
import { readFile } from "node:fs/promises";
import path from "node:path";
import process from "node:process";
import validator from "gltf-validator";

const reports = [];
for (const file of process.argv.slice(2)) {
  // Pictures beside the file are read too.
  const externalResourceFunction = async (uri) => new Uint8Array(await readFile(path.resolve(path.dirname(file), decodeURIComponent(uri))));
  const options = { uri: file, maxIssues: 0, externalResourceFunction };
  reports.push(await validator.validateBytes(new Uint8Array(await readFile(file)), options));
}
console.log(JSON.stringify(reports));
