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

/** Lets the browser fetch and compile the map while it reads the rest, though the page does without where there is no WebGL. */
function early(): Plugin {
  return {
    name: "early",
    transformIndexHtml: {
      order: "post",
      handler: (html, context) => {
        const files = Object.values(context.bundle ?? {}).filter((one) => !html.includes(one.fileName));
        const chunks = files.filter((one) => one.type === "chunk").map((one) => ({ rel: "modulepreload", href: `/${one.fileName}` }));
        // A module waits for its style sheet.
        const styles = files.filter((one) => one.fileName.endsWith(".css")).map((one) => ({ rel: "stylesheet", href: `/${one.fileName}` }));
        return [...styles, ...chunks].map((attrs) => ({ tag: "link", attrs, injectTo: "head" }));
      },
    },
  };
}

export default defineConfig({
  plugins: [remember(), early()],
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
