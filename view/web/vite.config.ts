import { createHash } from "node:crypto";
import { readFileSync, readdirSync, statSync } from "node:fs";

import { type Plugin, defineConfig } from "vite";

const SOURCES = ["index.html", "package-lock.json", "package.json", "public", "src", "tsconfig.json", "vite.config.ts"];

function files(path: string): string[] {
  return statSync(path).isDirectory() ? readdirSync(path).sort().flatMap((name) => files(`${path}/${name}`)) : [path];
}

/** Writes down what the page was built of, so that a test can tell one that is out of date. */
function remember(): Plugin {
  const source = () => SOURCES.flatMap(files).map((path) => `${createHash("sha256").update(readFileSync(path)).digest("hex")}  ${path}\n`);
  return {
    name: "remember",
    generateBundle() {
      this.emitFile({ type: "asset", fileName: "sources.sha256", source: source().join("") });
    },
  };
}

export default defineConfig({
  plugins: [remember()],
  build: {
    outDir: "../fractus_view/page",
    emptyOutDir: true,
    // The policy of the page lets no inlined file in.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    // MapLibre changes seldom: its file keeps its name when ours change.
    rollupOptions: { output: { manualChunks: (id: string) => (id.includes("maplibre-gl") ? "maplibre" : null) } },
    chunkSizeWarningLimit: 2000,
  },
});
