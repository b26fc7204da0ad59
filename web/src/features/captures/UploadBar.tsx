/** The uploads under way, on every page. */

import type { JSX } from "react";

import { bytes } from "../../shared/state/format";
import { Meter } from "../../shared/ui/parts";
import { useUploads } from "./uploads";

export function UploadBar(): JSX.Element[] {
  return useUploads((state) => state.uploads).map((one) => (
    <section key={one.id} className="uploading" aria-label={`Upload of ${one.name}`}>
      <strong>{one.name}</strong>
      <Meter share={one.sent / one.bytes} label="Sent" />
      <span>
        {one.checking
          ? "All bytes are there; the service checks them."
          : `${bytes(one.sent)} of ${bytes(one.bytes)} sent`}
      </span>
      {one.waits !== null && (
        <span className="warning" role="status">
          It waits and goes on by itself. {one.waits}
        </span>
      )}
      {(!one.checking || one.waits !== null) && (
        <button type="button" onClick={one.cancel}>
          Cancel
        </button>
      )}
    </section>
  ));
}
