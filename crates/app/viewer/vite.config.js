import { defineConfig } from "vite";

// Three files with fixed names, so that the Rust program can embed them.
export default defineConfig({
  base: "./",
  build: {
    outDir: "../../../assets/viewer",
    emptyOutDir: true,
    chunkSizeWarningLimit: 8000,
    license: { fileName: "LICENSES.md" },
    rollupOptions: {
      output: {
        entryFileNames: "viewer.js",
        assetFileNames: "viewer[extname]",
        codeSplitting: false,
      },
    },
  },
});
