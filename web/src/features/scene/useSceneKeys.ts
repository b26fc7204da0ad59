/** Keys of the scene, while its canvas has the focus and no key flies. */

import { useEffect, useRef } from "react";

import { adjust } from "../../shared/state/route";
import type { Viewer } from "./Viewer";
import { VIEW_MODES, type ViewMode } from "./viewModes";

export function useSceneKeys(
  viewer: Viewer | null,
  mode: ViewMode,
  onMode: (mode: ViewMode) => void,
  orbiting: boolean,
): void {
  const choose = useRef(onMode);
  useEffect(() => {
    choose.current = onMode;
  }, [onMode]);
  useEffect(() => {
    const canvas = viewer?.canvas;
    if (viewer === null || canvas === undefined) return;
    const onKey = (event: KeyboardEvent): void => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const key = event.key.toLowerCase();
      if (key === "m") choose.current(VIEW_MODES[(VIEW_MODES.indexOf(mode) + 1) % VIEW_MODES.length] ?? "colour");
      if (!orbiting) return;
      if (key === "f") viewer.focus(...viewer.middle);
      if (key === "t") viewer.look("top");
      if (key === "h") {
        viewer.home();
        adjust({ camera: null });
      }
    };
    canvas.addEventListener("keydown", onKey);
    return () => canvas.removeEventListener("keydown", onKey);
  }, [viewer, mode, orbiting]);
}
