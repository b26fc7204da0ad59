/** The uploads under way: they go on while other pages are shown. */

import { create } from "zustand";

import type { Capture, UploadRequest } from "../../shared/api/types";
import { errorText } from "../../shared/state/store";
import { uploadFile } from "./uploadFile";

export interface Uploading {
  id: number;
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

/** The capture that the file has become, or null if it was cancelled. Throws what refuses it. */
export async function upload(file: File, request: UploadRequest, calibration: File | null): Promise<Capture | null> {
  const aborting = new AbortController();
  const id = next++;
  const change = (values: Partial<Uploading>): void =>
    useUploads.setState(({ uploads }) => ({
      uploads: uploads.map((one) => (one.id === id ? { ...one, ...values } : one)),
    }));
  const began = {
    id,
    name: request.name,
    bytes: file.size,
    sent: 0,
    checking: false,
    waits: null,
    cancel: () => aborting.abort(),
  };
  useUploads.setState(({ uploads }) => ({ uploads: [...uploads, began] }));
  try {
    return await uploadFile({
      file,
      request,
      calibration,
      onProgress: (sent) => change({ sent, waits: null }),
      onCheck: () => change({ sent: file.size, checking: true, waits: null }),
      onWait: (error) => change({ waits: errorText(error) }),
      signal: aborting.signal,
    });
  } catch (error) {
    if (aborting.signal.aborted) return null;
    throw error;
  } finally {
    useUploads.setState(({ uploads }) => ({ uploads: uploads.filter((one) => one.id !== id) }));
  }
}
