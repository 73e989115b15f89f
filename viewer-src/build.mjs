// Writes the bundles that the Python package ships into ../src/naibu/viewer/assets: report.js and report.css of the pages that load
// nothing, and live.js of the live page, the only one that talks to a server.
import { build } from "esbuild";
import { readFileSync, mkdirSync, statSync } from "node:fs";
import { fileURLToPath } from "node:url";

const here = (path) => fileURLToPath(new URL(path, import.meta.url));
const outdir = here("../src/naibu/viewer/assets");
const LIMIT_BYTES = 700_000;

const licence = readFileSync(here("node_modules/three/LICENSE"), "utf8").trim();
mkdirSync(outdir, { recursive: true });
await build({
  entryPoints: { report: here("src/main.js"), live: here("src/live-page.js") },
  bundle: true,
  minify: true,
  format: "iife",
  target: ["es2020"],
  legalComments: "none",
  banner: { js: `/* Contains three.js.\n${licence}\n*/` },
  outdir,
});
await build({ entryPoints: { report: here("src/report.css") }, bundle: true, minify: true, outdir });

for (const name of ["report.js", "live.js", "report.css"]) {
  const { size } = statSync(`${outdir}/${name}`);
  console.log(`${name}: ${(size / 1000).toFixed(0)} kB`);
  if (size > LIMIT_BYTES) throw new Error(`${name} has ${size} bytes; at most ${LIMIT_BYTES} are allowed`);
}
