import { appendFileSync, readFileSync } from "node:fs";
import { defineConfig } from "vite";

const outDir = "../../../assets/viewer";

// Spark contains fflate, which is therefore missing in Vite's list.
const bundledInSpark = {
  name: "bundled-in-spark",
  closeBundle() {
    const { version, license } = JSON.parse(readFileSync("node_modules/fflate/package.json", "utf8"));
    const text = readFileSync("node_modules/fflate/LICENSE", "utf8").trim();
    appendFileSync(`${outDir}/LICENSES.md`, `\n## fflate - ${version} (${license})\n\n${text}\n`);
  },
};

// Three files with fixed names, so that the Rust program can embed them beside index.html.
export default defineConfig({
  base: "./",
  plugins: [bundledInSpark],
  build: {
    outDir,
    emptyOutDir: true,
    chunkSizeWarningLimit: 8000,
    license: { fileName: "LICENSES.md" },
    rollupOptions: {
      input: "src/main.js",
      output: {
        entryFileNames: "viewer.js",
        assetFileNames: "viewer[extname]",
        codeSplitting: false,
      },
    },
  },
});
