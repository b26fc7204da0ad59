/** How the scene is drawn on this machine: as points where no graphics hardware helps, and whether it is being sorted. */

import { useEffect, useState } from "react";

import type { Viewer } from "./Viewer";

/** Where this browser keeps that splats are wanted without graphics hardware, too. */
const KEPT = "spiked.splats";
/** A sorting is told that takes longer than one or two looks at it, ms. */
const LOOK_MS = 150;

/** Whether splats are wanted although the processor draws them, and how to want them. */
export function useSplatsWanted(): [boolean, () => void] {
  const [wanted, setWanted] = useState(() => {
    try {
      return localStorage.getItem(KEPT) === "always";
    } catch {
      return false; // storage is forbidden
    }
  });
  const want = (): void => {
    setWanted(true);
    try {
      localStorage.setItem(KEPT, "always");
    } catch {
      // asked again at the next visit
    }
  };
  return [wanted, want];
}

/** Whether splats have been sorted for a while, and are not in order yet. */
export function useSorting(viewer: Viewer | null): boolean {
  const [sorting, setSorting] = useState(false);
  useEffect(() => {
    if (viewer === null) return;
    let before = false;
    const timer = setInterval(() => {
      setSorting(before && viewer.sorting);
      before = viewer.sorting;
    }, LOOK_MS);
    return () => {
      clearInterval(timer);
      setSorting(false);
    };
  }, [viewer]);
  return sorting;
}
