// Prints the glTF validator's report on each file named, as a JSON list: node validate.mjs FILE...
import { readFile } from "node:fs/promises";
import process from "node:process";
import validator from "gltf-validator";

const reports = [];
for (const file of process.argv.slice(2)) {
  reports.push(await validator.validateBytes(new Uint8Array(await readFile(file)), { uri: file, maxIssues: 0 }));
}
console.log(JSON.stringify(reports));
