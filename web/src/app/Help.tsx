/** Keys, and what to do about what the page says: a dialog that the question mark opens. */

import { type JSX, useEffect, useRef } from "react";

import { Icon } from "../shared/ui/icons";

const KEYS: readonly [string, string][] = [
  ["1 2 3 4", "Live, Scene, Captures, Set-up"],
  ["?", "This help"],
  ["Tab", "To the next control; everything is reached"],
  ["Drag, right drag, wheel", "Scene, Orbit: turn, move, come closer"],
  ["Double click", "Scene: turn round the point that was clicked"],
  ["One finger, two fingers", "Scene, Orbit: turn; move and come closer"],
  ["Double tap", "Scene: turn round the point that was tapped"],
  ["Arrow keys", "Scene, Orbit: move sideways; on the time slider: other frames"],
  ["F, H, T", "Scene, Orbit: to the middle of the view; home; from the top"],
  ["M", "Scene: show another property of the splats"],
  ["W A S D R F Q E", "Scene, Fly: move and roll"],
  ["+ − 0", "Timeline: zoom in, out, the whole time"],
];

/** By what the page says; docs/troubleshooting.md has more. */
const SYMPTOMS: readonly [string, string][] = [
  ["It says boot and stays there", "Move the camera sideways by some centimetres, with near and far things in view."],
  ["It says degraded", "Move more slowly, or give more light: the error is larger than the noise explains."],
  ["It says lost", "Go back to what was seen before. The recording goes on; it can be reconstructed again later."],
  ["The scene is foggy", "Clean the scene (Scene, Clean), or re-run it with more steps; see whether the path is good."],
  ["The scene has the wrong size", "A camera alone knows no metres: give it a length (Scene, Measure)."],
  [
    "The view moves in jerks, or only points are drawn",
    "This browser draws without graphics hardware: allow it in the settings of the browser, or keep the points.",
  ],
  [
    "Frames are missing",
    "The table of missing frames names the cause: usb, ring or disk. Set-up, Doctor, checks each.",
  ],
  ["The picture is upside down or has odd colours", "Live, Camera and options: orientation and mosaic."],
];

export function Help({ open, onClose }: { open: boolean; onClose: () => void }): JSX.Element {
  const dialog = useRef<HTMLDialogElement>(null);
  useEffect(() => {
    const { current } = dialog;
    if (current === null) return;
    if (open && !current.open) current.showModal();
    if (!open && current.open) current.close();
  }, [open]);
  return (
    <dialog ref={dialog} className="help" aria-labelledby="help-title" onClose={onClose}>
      <header>
        <h2 id="help-title">Keys and help</h2>
        <button type="button" className="bare" aria-label="Close" onClick={onClose}>
          <Icon name="close" />
        </button>
      </header>
      <dl className="keys">
        {KEYS.map(([key, meaning]) => (
          <div key={key}>
            <dt>
              <kbd>{key}</kbd>
            </dt>
            <dd>{meaning}</dd>
          </div>
        ))}
      </dl>
      <h3>When something is not as it should be</h3>
      <dl className="symptoms">
        {SYMPTOMS.map(([symptom, remedy]) => (
          <div key={symptom}>
            <dt>{symptom}</dt>
            <dd>{remedy}</dd>
          </div>
        ))}
      </dl>
      <p>
        <a href="docs/guide">Documentation</a> · <a href="docs/guide/glossary/">Glossary</a> ·{" "}
        <a href="docs/guide/troubleshooting/">Troubleshooting by symptom</a> · <a href="docs">API documentation</a>
      </p>
    </dialog>
  );
}
