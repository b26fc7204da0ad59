/** Poses of a TUM file that fit into a request. */

/** The service takes a request of one MiB, unless it is set otherwise. */
const MOST_BYTES = 900_000;

/** The file without comments; of a long one every n-th pose and the last. Throws an Error for one without poses. */
export function thinned(text: string, mostBytes: number = MOST_BYTES): { text: string; every: number } {
  const lines = text.split("\n").filter((line) => line.trim() !== "" && !line.trimStart().startsWith("#"));
  if (lines.length === 0) throw new Error("The file holds no poses.");
  const every = Math.max(1, Math.ceil(text.length / mostBytes));
  const kept = lines.filter((_, at) => at % every === 0 || at === lines.length - 1);
  return { text: `${kept.join("\n")}\n`, every };
}
