/** Downloads in the formats of other programs. They are made when they are asked for. */

import { type JSX, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Reconstruction } from "../../shared/api/types";
import { useFetch } from "../../shared/state/useFetch";
import { DownloadLink } from "../../shared/ui/DownloadLink";
import { Fetched } from "../../shared/ui/Fetched";
import { Markup } from "../../shared/ui/parts";

export function ExportMenu({ job }: { job: Reconstruction }): JSX.Element {
  const [open, setOpen] = useState(false);
  return (
    <details className="exports" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>For other programs</summary>
      {open && <Formats job={job} />}
    </details>
  );
}

function Formats({ job }: { job: Reconstruction }): JSX.Element {
  const [metric, setMetric] = useState(false);
  const formats = useFetch("formats", calls.exportFormats);
  const scale = useFetch(job.id, () => calls.scale(job.id));
  const known = scale.value !== null && scale.value.metres_per_unit !== null;
  return (
    <>
      <p className="dim">
        Made on the server when you ask: the download begins after some seconds, or minutes for meshes.
      </p>
      {known && (
        <label className="check">
          <input type="checkbox" checked={metric} onChange={(event) => setMetric(event.currentTarget.checked)} />
          In metres
        </label>
      )}
      <Fetched from={formats} what="the formats">
        {(found) => (
          <ul>
            {found.map((format) => (
              <li key={format.name}>
                {format.missing === "" ? (
                  <DownloadLink href={calls.address.exported(job.id, format.name, metric && known)}>
                    {format.name}
                  </DownloadLink>
                ) : (
                  <span className="dim">{format.name}</span>
                )}
                <span>
                  {format.title}.{" "}
                  <span className="dim">
                    For <Markup>{format.readers}</Markup>.
                  </span>
                  {format.missing !== "" && <span className="dim"> Not installed: {format.missing}.</span>}
                </span>
              </li>
            ))}
          </ul>
        )}
      </Fetched>
    </>
  );
}
