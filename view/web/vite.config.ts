import { createHash } from "node:crypto";
import { readFileSync, readdirSync, statSync } from "node:fs";

import { type Plugin, defineConfig } from "vite";

const SOURCES = ["index.html", "package-lock.json", "package.json", "public", "src", "tsconfig.json", "vite.config.ts"];

function files(path: string): string[] {
  return statSync(path).isDirectory() ? readdirSync(path).sort().flatMap((name) => files(`${path}/${name}`)) : [path];
}

/** Stores the digests of all source files, so that a test can detect an outdated page. */
function storeDigests(): Plugin {
  const lines = () => SOURCES.flatMap(files).map((path) => `${createHash("sha256").update(readFileSync(path)).digest("hex")}  ${path}\n`);
  return {
    name: "store-digests",
    generateBundle() {
      this.emitFile({ type: "asset", fileName: "sources.sha256", source: lines().join("") });
    },
  };
}

/** Preloads the map, which is a separate chunk because the page works without it if the browser has no WebGL. */
function preloadMap(): Plugin {
  return {
    name: "preload-map",
    transformIndexHtml: {
      order: "post",
      handler: (html, context) => {
        const files = Object.values(context.bundle ?? {}).filter((file) => !html.includes(file.fileName));
        const chunks = files.filter((file) => file.type === "chunk").map((file) => ({ rel: "modulepreload", href: `/${file.fileName}` }));
        // Preload style sheets too, because a module waits for its style sheet.
        const styles = files
          .filter((file) => file.fileName.endsWith(".css"))
          .map((file) => ({ rel: "stylesheet", href: `/${file.fileName}` }));
        return [...styles, ...chunks].map((attrs) => ({ tag: "link", attrs, injectTo: "head" }));
      },
    },
  };
}

export default defineConfig({
  plugins: [storeDigests(), preloadMap()],
  build: {
    outDir: "../fractus_view/page",
    emptyOutDir: true,
    // The page's Content-Security-Policy forbids inlined files.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    // Keep MapLibre in its own file, so that browsers can cache it when other files change.
    rollupOptions: { output: { manualChunks: (id: string) => (id.includes("maplibre-gl") ? "maplibre" : null) } },
    chunkSizeWarningLimit: 2000,
  },
});
