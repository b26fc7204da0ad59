/** Uploads a file in pieces; what broke off goes on where it ended. */

import * as calls from "../../shared/api/calls";
import { ApiError, UnreachableError } from "../../shared/api/http";
import type { Capture, Upload, UploadRequest } from "../../shared/api/types";

const CHUNK_BYTES = 4 << 20;
/** Pause before a request is sent again; doubled each time, up to the longest. */
const PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 30_000;

export interface Sending {
  file: File;
  /** Of a new upload. */
  request: UploadRequest;
  calibration: File | null;
  /** One that was begun earlier, to go on with; null: a new one. */
  begun: Upload | null;
  /** Told of the upload, before its first piece. */
  onBegin: (upload: Upload) => void;
  /** Told after each piece. */
  onProgress: (sent: number) => void;
  /** Told when all bytes are there and the service checks them. */
  onCheck: () => void;
  /** Told why a request is sent again. */
  onWait: (error: unknown) => void;
  signal: AbortSignal;
}

/** The capture that the file has become. An upload that is refused or cancelled is removed again. */
export async function uploadFile(sending: Sending): Promise<Capture> {
  const { file, request, calibration, begun, onBegin, onProgress, onCheck, onWait, signal } = sending;
  const patiently = <T>(ask: (again: boolean) => Promise<T>): Promise<T> => untilAnswered(ask, onWait, signal);
  let upload = begun ?? (await calls.createUpload(request));
  try {
    onBegin(upload);
    if (calibration !== null) await patiently(() => calls.sendCalibration(upload.id, calibration));
    while (upload.offset_bytes < upload.bytes) {
      upload = await patiently((again) => sentPiece(upload, file, again, signal));
      onProgress(upload.offset_bytes);
    }
    onCheck();
    return await patiently(() => calls.completeUpload(upload.id));
  } catch (error) {
    await calls.removeUpload(upload.id).catch(() => undefined); // retention removes what is left
    throw error;
  }
}

async function sentPiece(upload: Upload, file: File, again: boolean, signal: AbortSignal): Promise<Upload> {
  const from = upload.offset_bytes;
  const piece = file.slice(from, from + CHUNK_BYTES);
  if (again) {
    await piece.slice(0, 1).arrayBuffer(); // throws for a file that was changed, which looks like a broken connection
    const now = await calls.upload(upload.id);
    if (now.offset_bytes > from) return now; // some or all had come, and the answer was lost
  }
  return calls.sendChunk(upload.id, from, piece, signal);
}

/** Send a request until it is answered or refused. Throws what refuses it, and the reason of the signal. */
async function untilAnswered<T>(
  ask: (again: boolean) => Promise<T>,
  onWait: (error: unknown) => void,
  signal: AbortSignal,
): Promise<T> {
  for (let pause = PAUSE_MS, again = false; ; pause = Math.min(2 * pause, LONGEST_PAUSE_MS), again = true) {
    signal.throwIfAborted();
    try {
      return await ask(again);
    } catch (error) {
      if (!isPassing(error)) throw error;
      onWait(error);
      await paused(pause, signal);
    }
  }
}

/** Whether the same request may succeed later. */
const isPassing = (error: unknown): boolean =>
  error instanceof UnreachableError ||
  (error instanceof ApiError &&
    // The service may still wait for the rest of a piece whose connection broke.
    (error.status >= 500 || [408, 429].includes(error.status) || ["busy", "upload-offset"].includes(error.kind)));

const paused = (ms: number, signal: AbortSignal): Promise<void> =>
  new Promise((resolve, reject) => {
    const cancel = (): void => {
      clearTimeout(timer);
      reject(signal.reason as Error);
    };
    const timer = setTimeout(() => {
      signal.removeEventListener("abort", cancel);
      resolve();
    }, ms);
    signal.addEventListener("abort", cancel, { once: true });
  });
