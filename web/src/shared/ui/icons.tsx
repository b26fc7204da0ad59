/** Line icons of 16 by 16, drawn in the colour of the text. */

import type { JSX } from "react";

const PATHS = {
  live: "M2 8h2l2-4.5 3 9 2.2-6L12.5 8H14",
  scene: "M8 1.8 14 5v6l-6 3.2L2 11V5zM2 5l6 3.2L14 5M8 8.2v6",
  captures: "M2 3.5h12v9H2zM2 6.5h12M5 3.5v9",
  setup: "M2 4.5h6m4 0h2M2 11.5h2m4 0h6M10 4.5a1.6 1.6 0 1 0 .01 0M6 11.5a1.6 1.6 0 1 0 .01 0",
  start: "M5 3l8 5-8 5z",
  pause: "M5 3v10M11 3v10",
  stop: "M4 4h8v8H4z",
  good: "M3 8.5l3.2 3L13 4.5",
  warning: "M8 2 15 13.5H1zM8 6.5v3.2M8 11.4v.6",
  problem: "M3.5 3.5l9 9M12.5 3.5l-9 9",
  sun: "M8 5a3 3 0 1 0 .01 0M8 1v1.6M8 13.4V15M1 8h1.6M13.4 8H15M3 3l1.2 1.2M11.8 11.8 13 13M3 13l1.2-1.2M11.8 4.2 13 3",
  moon: "M13 9.8A5.6 5.6 0 0 1 6.2 3 5.6 5.6 0 1 0 13 9.8z",
  auto: "M8 2a6 6 0 1 0 .01 0M8 2v12M8 5l4.6-1.2M8 8h6M8 11l4.6 1.2",
  download: "M8 2v8M4.5 7 8 10.5 11.5 7M2.5 13.5h11",
  upload: "M8 10.5v-8M4.5 5.5 8 2l3.5 3.5M2.5 13.5h11",
  trash: "M2.5 4.5h11M6 4.5v-2h4v2M4 4.5l.7 9h6.6l.7-9",
  search: "M7 2.5a4.5 4.5 0 1 0 .01 0M10.3 10.3 14 14",
  back: "M9.5 3 4.5 8l5 5",
  camera: "M2 5h3l1.2-2h3.6L11 5h3v8H2zM8 6.5a2.4 2.4 0 1 0 .01 0",
  bookmark: "M4 2.5h8v11L8 10.6 4 13.5z",
  eye: "M1.5 8C4 3.5 12 3.5 14.5 8 12 12.5 4 12.5 1.5 8zM8 6.2a1.8 1.8 0 1 0 .01 0",
  layers: "M8 2 14.5 5.5 8 9 1.5 5.5zM1.5 9 8 12.5 14.5 9",
  edge: "M3 3l6 5-6 5zM12 3v10",
  again: "M13 8a5 5 0 1 1-1.5-3.6M13 2.5v3h-3",
  link: "M6.5 9.5l3-3M7 4.5l1.5-1.5a3 3 0 0 1 4.3 4.3L11.3 8.8M9 11.5 7.5 13a3 3 0 0 1-4.3-4.3L4.7 7.2",
  up: "M8 13V3.5M4 7.5l4-4 4 4",
  down: "M8 3v9.5M4 8.5l4 4 4-4",
  close: "M4 4l8 8M12 4l-8 8",
  compare: "M8 1.5v13M2 4h4v8H2zM10 4h4v8h-4z",
  key: "M5 6.5a2.8 2.8 0 1 0 .01 0M7.2 9.2H14v2.6M11 9.2v2",
  plus: "M8 3v10M3 8h10",
  minus: "M3 8h10",
  whole: "M2 3.5v9M14 3.5v9M4.5 8h7M6.5 6l-2 2 2 2M9.5 6l2 2-2 2",
  loop: "M4 5.5a5 5 0 1 1-.8 4.6M3 2.5v3.5h3.5",
  help: "M8 1.8a6.2 6.2 0 1 0 .01 0M6 6.2a2 2 0 1 1 2.8 1.9c-.6.3-.8.7-.8 1.4M8 11.4v.6",
  home: "M2 8l6-5.5L14 8M4 6.5V13h8V6.5",
} as const;

export type IconName = keyof typeof PATHS;

export function Icon({ name }: { name: IconName }): JSX.Element {
  return (
    <svg className="icon" viewBox="0 0 16 16" aria-hidden="true" focusable="false">
      <path d={PATHS[name]} />
    </svg>
  );
}
