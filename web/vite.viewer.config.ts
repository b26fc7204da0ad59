import { defineConfig } from "vite";

/** The script of exported pages, in one file that needs no server: `spiked.export.viewer_page` puts it into them. */
export default defineConfig({
  define: { "process.env.NODE_ENV": JSON.stringify("production") },
  build: {
    outDir: "../spiked/export",
    emptyOutDir: false,
    target: "es2022",
    chunkSizeWarningLimit: 4000,
    modulePreload: { polyfill: false },
    copyPublicDir: false,
    rollupOptions: {
      input: "src/viewer/main.ts",
      output: { format: "iife", inlineDynamicImports: true, entryFileNames: "viewer.js" },
    },
  },
});
