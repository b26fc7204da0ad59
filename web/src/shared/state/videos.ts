/** What videos can be made of, and how long they become. */

export const KINDS = [
  {
    value: "smooth",
    label: "the scene, smoothed path",
    hint: "What the camera would have seen of the scene, without the tremor of its path",
  },
  {
    value: "recorded",
    label: "the scene, recorded path",
    hint: "What the camera would have seen of the scene, on its path as it was",
  },
  {
    value: "bookmarks",
    label: "the scene, through bookmarks",
    hint: "Smoothly from each bookmark of this reconstruction to the next, with the optics of the camera",
  },
  {
    value: "recording",
    label: "the recording, slow motion",
    hint: "The rates that the camera has recorded; pictures whose frames were lost are black",
  },
] as const;
export type Kind = (typeof KINDS)[number]["value"];

/** Longest video that the service makes. */
export const LONGEST_S = 1200;
/** Most pictures of a video that the service makes. */
export const MOST_PICTURES = 36_000;
/** Length of a video that nobody has chosen. */
const USUAL_S = 10;

/** How many times slower a time is shown so that it takes about ten seconds: two digits, at least as long as it was. */
export const slownessFor = (taken_s: number): number =>
  taken_s > 0 ? Math.max(1, Number((USUAL_S / taken_s).toPrecision(2))) : 1;

/** Why there can be no video of a length; null if there can. */
export function problemOf(seconds: number, fps: number): string | null {
  if (!(seconds > 0) || !(fps >= 1 && fps <= 240)) return "Fill in numbers: 1 to 240 pictures a second.";
  if (seconds < 0.1) return "Less than 0.1 s: show it more slowly.";
  if (seconds > LONGEST_S || seconds * fps > MOST_PICTURES)
    return "Longer than 20 minutes, or of more than 36,000 pictures: show it less slowly, or with fewer pictures a second.";
  return null;
}
