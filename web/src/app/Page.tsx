/** The pages, each loaded when it is first shown. */

import { type ComponentType, type JSX, useEffect, useState } from "react";

import { LivePage } from "../features/live/LivePage";
import type { PageName } from "../shared/state/route";
import { Loading } from "../shared/ui/parts";

const LOADERS: Record<Exclude<PageName, "live">, () => Promise<ComponentType>> = {
  scene: () => import("../features/scene/ScenePage").then((one) => one.ScenePage),
  captures: () => import("../features/captures/CapturesPage").then((one) => one.CapturesPage),
  setup: () => import("../features/setup/SetupPage").then((one) => one.SetupPage),
};
const loaded: Partial<Record<PageName, ComponentType>> = { live: LivePage };

async function load(page: Exclude<PageName, "live">): Promise<void> {
  loaded[page] = await LOADERS[page]();
}

/** Not by `lazy`: React shows the fallback of a Suspense for 300 ms at least. */
export function Page({ name }: { name: PageName }): JSX.Element {
  const [, setDone] = useState(false);
  const [problem, setProblem] = useState<Error | null>(null);
  const Shown = loaded[name];
  useEffect(() => {
    if (name === "live" || Shown !== undefined) return;
    load(name).then(
      () => setDone(true),
      (error: unknown) => setProblem(error as Error),
    );
  }, [name, Shown]);
  useEffect(() => {
    // Most go to the captures next. What fails is loaded again, and told of, when it is shown.
    const soon = setTimeout(() => void load("captures").catch(() => undefined), 1000);
    return () => clearTimeout(soon);
  }, []);
  if (problem !== null) throw problem; // to the boundary
  return Shown === undefined ? <Loading what="the page" /> : <Shown />;
}
