import { createHash } from "node:crypto";
import { readFileSync, readdirSync, statSync } from "node:fs";

import { type Plugin, type Rollup, defineConfig } from "vite";

const SOURCES = ["index.html", "package-lock.json", "package.json", "plans.html", "public", "src", "tsconfig.json", "vite.config.ts"];

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

/** Preloads the map of each page, which is a separate chunk because the page works without it if the browser has no WebGL. */
function preloadMap(): Plugin {
  return {
    name: "preload-map",
    transformIndexHtml: {
      order: "post",
      handler: (html, context) => {
        const names = new Set(context.chunk?.dynamicImports);
        // The loop also visits the names that it adds.
        for (const name of names) for (const imported of chunk(context.bundle, name)?.imports ?? []) names.add(imported);
        const missing = [...names].filter((name) => !html.includes(name));
        const chunks = missing.map((name) => ({ rel: "modulepreload", href: `/${name}` }));
        // Preload style sheets too, because a module waits for its style sheet.
        const css = new Set(missing.flatMap((name) => [...(chunk(context.bundle, name)?.viteMetadata?.importedCss ?? [])]));
        const styles = [...css].map((name) => ({ rel: "stylesheet", href: `/${name}` }));
        return [...styles, ...chunks].map((attrs) => ({ tag: "link", attrs, injectTo: "head" }));
      },
    },
  };
}

function chunk(bundle: Rollup.OutputBundle | undefined, name: string): Rollup.OutputChunk | undefined {
  const file = bundle?.[name];
  return file?.type === "chunk" ? file : undefined;
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
    rollupOptions: {
      // plans.html is the page of the management API.
      input: ["index.html", "plans.html"],
      output: { manualChunks: (id: string) => (id.includes("maplibre-gl") ? "maplibre" : null) },
    },
    chunkSizeWarningLimit: 2000,
  },
});
