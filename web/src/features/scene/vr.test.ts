import { EventDispatcher, Group, Scene, Vector3 } from "three";
import { afterEach, expect, it, vi } from "vitest";

import { showInHeadset, type Stage } from "./vr";

afterEach(() => vi.unstubAllGlobals());

/** A headset, and a renderer that does at the end of a session what three.js does: it starts its loop. */
function rig(setSession: () => Promise<void>): { stage: Stage; end: () => Promise<void>; looping: () => boolean } {
  let looping = false;
  const xr = Object.assign(new EventDispatcher<{ sessionend: object }>(), {
    enabled: false,
    setReferenceSpaceType: () => undefined,
    setSession,
  });
  const setAnimationLoop = (loop: unknown): void => {
    looping = loop !== null;
  };
  const end = vi.fn(() => {
    looping = true;
    xr.dispatchEvent({ type: "sessionend" });
    return Promise.resolve();
  });
  vi.stubGlobal("navigator", {
    xr: { requestSession: () => Promise.resolve({ end, addEventListener: () => undefined }) },
  });
  const renderer = { xr, setAnimationLoop, render: () => undefined } as unknown as Stage["renderer"];
  const content = new Group();
  const world = new Scene().add(content);
  const stage = {
    renderer,
    world,
    content,
    drawer: content,
    eye: new Vector3(),
    ahead: new Vector3(0, 0, -1),
    depth: 4,
  };
  return { stage, end, looping: () => looping };
}

it("leaves no loop running after three.js has ended the session", async () => {
  const { stage, end, looping } = rig(() => Promise.resolve());
  const shown = showInHeadset(stage);
  await vi.waitFor(() => expect(looping()).toBe(true));
  expect(stage.content.scale.x).toBe(0.5);
  await end();
  await shown;
  expect(looping()).toBe(false);
  expect(stage.content.scale.x).toBe(1);
});

it("ends a session that cannot be shown", async () => {
  const { stage, end } = rig(() => Promise.reject(new Error("no framebuffer")));
  await expect(showInHeadset(stage)).rejects.toThrow("no framebuffer");
  expect(end).toHaveBeenCalledOnce();
  expect(stage.content.scale.x).toBe(1);
});
