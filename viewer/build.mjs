// Bundles the viewer into the Python package: replay.js, replay.css, LICENCES.txt, and a manifest with their digests.
import { createHash } from "node:crypto";
import { mkdirSync, readdirSync, readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const OUT = new URL("../src/keepout/data/replay/", import.meta.url).pathname;
const read = (path) => readFileSync(new URL(path, import.meta.url), "utf8");
const digest = (text) => createHash("sha256").update(text).digest("hex");

const libraries = ["three", "uplot"].map((name) => {
  const { version, license, homepage } = JSON.parse(read(`node_modules/${name}/package.json`));
  return { name, version, licence: license, homepage, text: read(`node_modules/${name}/LICENSE`).trim() };
});
const licences = libraries.map((of) => `${of.name} ${of.version} (${of.homepage})\n\n${of.text}\n`).join("\n\n");

const made = await build({
  entryPoints: { replay: new URL("src/main.js", import.meta.url).pathname },
  bundle: true,
  minify: true,
  format: "iife",
  target: ["chrome103", "firefox115", "safari16.4"],
  charset: "utf8",
  legalComments: "none", // the banner holds the licences in full
  outdir: OUT,
  write: false,
});
const text = (ending) => made.outputFiles.find((file) => file.path.endsWith(ending)).text;
const files = {
  "replay.js": `/*\n${licences.replaceAll("*/", "* /")}*/\n${text(".js")}`.replaceAll(/<\/(script)/gi, "<\\/$1"),
  "replay.css": text(".css"),
  "LICENCES.txt": licences,
};
if (/<\/style/i.test(files["replay.css"])) throw new Error("replay.css would end the page's style element");

mkdirSync(OUT, { recursive: true });
for (const [name, content] of Object.entries(files)) writeFileSync(OUT + name, content);
const manifest = {
  command: "make replay-bundle",
  source: Object.fromEntries(
    ["build.mjs", "package-lock.json", ...readdirSync(new URL("src", import.meta.url)).sort().map((name) => `src/${name}`)]
      .map((name) => [name, digest(read(name))])
  ),
  libraries: libraries.map(({ text: _, ...of }) => of),
  bundler: `esbuild ${JSON.parse(read("node_modules/esbuild/package.json")).version}`,
  sha256: Object.fromEntries(Object.entries(files).map(([name, content]) => [name, digest(content)])),
};
writeFileSync(`${OUT}manifest.json`, `${JSON.stringify(manifest, null, 2)}\n`);
for (const [name, content] of Object.entries(files)) console.log(`${name}: ${(content.length / 1024).toFixed(0)} kB`);
