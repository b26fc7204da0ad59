/** The uploads under way: they go on while other pages are shown. */

import { create } from "zustand";

import type { Capture, Upload, UploadRequest } from "../../shared/api/types";
import { errorText } from "../../shared/state/store";
import { forgetFile, rememberFile } from "./rememberedFiles";
import { uploadFile } from "./uploadFile";

export interface Uploading {
  id: number;
  /** The upload of the service; null before there is one. */
  uploadId: string | null;
  name: string;
  bytes: number;
  sent: number;
  checking: boolean;
  /** Why it waits; null while it goes on. */
  waits: string | null;
  cancel: () => void;
}

let next = 1;

export const useUploads = create<{ uploads: readonly Uploading[] }>(() => ({ uploads: [] }));

/**
 * The capture that the file has become, or null if it was cancelled. Throws what refuses it.
 *
 * `begun`: an upload of the service that goes on with this file.
 */
export async function upload(
  file: File,
  request: UploadRequest,
  calibration: File | null,
  begun: Upload | null = null,
): Promise<Capture | null> {
  const aborting = new AbortController();
  const id = next++;
  const change = (values: Partial<Uploading>): void =>
    useUploads.setState(({ uploads }) => ({
      uploads: uploads.map((one) => (one.id === id ? { ...one, ...values } : one)),
    }));
  const began = {
    id,
    uploadId: begun?.id ?? null,
    name: request.name,
    bytes: file.size,
    sent: begun?.offset_bytes ?? 0,
    checking: false,
    waits: null,
    cancel: () => aborting.abort(),
  };
  useUploads.setState(({ uploads }) => ({ uploads: [...uploads, began] }));
  let uploadId = begun?.id ?? null;
  try {
    const made = await uploadFile({
      file,
      request,
      calibration,
      begun,
      onBegin: (one) => {
        uploadId = one.id;
        change({ uploadId });
        if (begun === null) rememberFile(one.id, file, calibration !== null);
      },
      onProgress: (sent) => {
        change({ sent, waits: null });
      },
      onCheck: () => change({ sent: file.size, checking: true, waits: null }),
      onWait: (error) => change({ waits: errorText(error) }),
      signal: aborting.signal,
    });
    if (uploadId !== null) forgetFile(uploadId);
    return made;
  } catch (error) {
    if (aborting.signal.aborted) return null;
    throw error;
  } finally {
    useUploads.setState(({ uploads }) => ({ uploads: uploads.filter((one) => one.id !== id) }));
  }
}
