// The size of what a browser must fetch, gzipped, against the budget stated here. Ends with 1 when a part has grown beyond it.
import { readFileSync, readdirSync } from "node:fs";
import { join } from "node:path";
import { gzipSync } from "node:zlib";

const BUILT = new URL("../../service/spiked_service/page/", import.meta.url).pathname;

/** kB (1000 bytes) after gzip. `first` is all that the Live page needs; the others come when their page is opened. */
const BUDGET_KB = { first: 130, plots: 30, three: 220, spark: 1000, swagger: 560, other: 60 };

const LAZY = ["plots", "three", "spark", "swagger"];
const index = readFileSync(join(BUILT, "index.html"), "utf8");
const spent = Object.fromEntries(Object.keys(BUDGET_KB).map((part) => [part, 0]));
for (const name of readdirSync(join(BUILT, "assets"))) {
  if (!/\.(js|css)$/.test(name)) continue;
  const size = gzipSync(readFileSync(join(BUILT, "assets", name))).length / 1000;
  const lazy = LAZY.find((part) => name.startsWith(`${part}-`));
  spent[index.includes(name) ? "first" : (lazy ?? "other")] += size;
}
let over = false;
for (const [part, allowed] of Object.entries(BUDGET_KB)) {
  const verdict = spent[part] > allowed ? "OVER" : "ok";
  over ||= verdict === "OVER";
  console.log(`${part.padEnd(6)} ${spent[part].toFixed(0).padStart(5)} kB of ${allowed} kB gzipped  ${verdict}`);
}
process.exit(over ? 1 : 0);
