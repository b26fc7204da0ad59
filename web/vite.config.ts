import { defineConfig } from "vitest/config";

/** Where `spiked serve` looks for the page; it is part of the wheel. */
const BUILT = "../service/spiked_service/page";
const DAEMON = process.env["SPIKED_ADDRESS"] ?? "http://127.0.0.1:8650";

export default defineConfig({
  base: "./",
  build: {
    outDir: BUILT,
    emptyOutDir: true,
    target: "es2022",
    // The splat renderer carries its WebAssembly in itself; scripts/budget.mjs says how large each part may be.
    chunkSizeWarningLimit: 3000,
    // No inline data: URLs for assets: the content security policy has one rule less to allow.
    assetsInlineLimit: 0,
    modulePreload: { polyfill: false },
    rollupOptions: {
      input: ["index.html", "docs/index.html"],
      output: {
        manualChunks: (id) => {
          if (id.includes("@sparkjsdev")) return "spark";
          if (id.includes("/three/")) return "three";
          if (id.includes("uplot")) return "plots";
          if (id.includes("swagger-ui-dist")) return "swagger";
          // Shared by every page: not inside the chunk of one of them.
          if (id.includes("commonjsHelpers") || id.includes("vite/preload-helper")) return "helpers";
          return undefined;
        },
      },
    },
  },
  server: {
    proxy: { "/api": { target: DAEMON, ws: true }, "/healthz": DAEMON, "/metrics": DAEMON, "/openapi.json": DAEMON },
  },
  test: { environment: "jsdom", include: ["src/**/*.test.ts", "src/**/*.test.tsx"] },
});
