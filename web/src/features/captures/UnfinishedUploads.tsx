/** Uploads that were begun and left: by a page that was closed or loaded again, or by another program. */

import { type JSX, useState } from "react";

import * as calls from "../../shared/api/calls";
import type { Upload } from "../../shared/api/types";
import { attempt } from "../../shared/state/attempt";
import { bytes, when } from "../../shared/state/format";
import { go } from "../../shared/state/route";
import { errorText } from "../../shared/state/store";
import { toast } from "../../shared/state/toasts";
import { useFetch } from "../../shared/state/useFetch";
import { ActionButton } from "../../shared/ui/access";
import { ErrorMessage, Meter, Panel } from "../../shared/ui/parts";
import { forgetFile, whyNot } from "./rememberedFiles";
import { upload, useUploads } from "./uploads";

export function UnfinishedUploads(): JSX.Element | null {
  const running = useUploads((state) => state.uploads);
  const found = useFetch(`unfinished ${running.map((one) => one.id).join(",")}`, calls.uploads);
  // One that is begun here is listed for a moment before the page knows its id.
  const isOwn = (one: Upload): boolean =>
    running.some((own) => own.uploadId === one.id || (own.uploadId === null && own.name === one.name));
  const left = (found.value ?? []).filter((one) => !isOwn(one));
  if (left.length === 0) return null;
  return (
    <Panel title="Unfinished uploads">
      <ul className="unfinished">
        {left.map((one) => (
          <Unfinished key={one.id} begun={one} onEnd={found.again} />
        ))}
      </ul>
    </Panel>
  );
}

function Unfinished({ begun, onEnd }: { begun: Upload; onEnd: () => void }): JSX.Element {
  const [problem, setProblem] = useState<string | null>(null);
  const whole = begun.offset_bytes === begun.bytes;

  const goOn = async (file: File): Promise<void> => {
    const wrong = whyNot(begun, file);
    setProblem(wrong);
    if (wrong !== null) return;
    try {
      // Another program may have sent more meanwhile.
      const now = await calls.upload(begun.id);
      const capture = await upload(file, { name: begun.name, notes: "", bytes: begun.bytes }, null, now);
      if (capture !== null) told(begun.name, capture.id);
    } catch (error) {
      toast(`${begun.name} was not uploaded. ${errorText(error)}`, { tone: "problem" });
    }
    onEnd();
  };
  const complete = async (): Promise<void> => {
    await attempt(async () => told(begun.name, (await calls.completeUpload(begun.id)).id));
    onEnd();
  };
  const cancel = async (): Promise<void> => {
    await attempt(() => calls.removeUpload(begun.id));
    forgetFile(begun.id);
    onEnd();
  };
  return (
    <li>
      <strong>{begun.name}</strong>
      <Meter share={begun.offset_bytes / begun.bytes} label={`Sent of ${begun.name}`} />
      <span>
        {bytes(begun.offset_bytes)} of {bytes(begun.bytes)} sent, begun {when(begun.created_at)}
      </span>
      {whole ? (
        <ActionButton onClick={() => void complete()}>Check it, and make a capture</ActionButton>
      ) : (
        <label className="button">
          Choose the file again to go on
          <input
            type="file"
            className="hidden"
            aria-label={`File of ${begun.name}, to go on`}
            onChange={(event) => {
              const file = event.target.files?.[0];
              if (file !== undefined) void goOn(file);
              event.target.value = "";
            }}
          />
        </label>
      )}
      <ActionButton aria-label={`Cancel the upload of ${begun.name}`} onClick={() => void cancel()}>
        Cancel
      </ActionButton>
      {problem !== null && <ErrorMessage text={problem} />}
    </li>
  );
}

function told(name: string, captureId: string): void {
  toast(`Uploaded ${name}`, {
    action: { label: "Open", run: () => go({ page: "captures", capture: captureId, reconstruction: null }) },
  });
}
