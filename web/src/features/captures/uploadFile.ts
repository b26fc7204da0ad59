/** Uploads a file in pieces; what broke off goes on where it ended. */

import * as calls from "../../shared/api/calls";
import { UnreachableError } from "../../shared/api/http";
import type { Capture, Upload, UploadRequest } from "../../shared/api/types";

const CHUNK_BYTES = 4 << 20;
/** Pauses before a piece is sent again after a broken connection. */
const PAUSES_MS = [500, 2000, 8000];

export interface Sending {
  file: File;
  request: UploadRequest;
  calibration: File | null;
  /** Told after each piece. */
  onProgress: (sent: number) => void;
  /** Told when all bytes are there and the service checks them. */
  onCheck: () => void;
  signal: AbortSignal;
}

/** The capture that the file has become. An upload that is refused or cancelled is removed again. */
export async function uploadFile(sending: Sending): Promise<Capture> {
  const { file, request, calibration, onProgress, onCheck, signal } = sending;
  let upload = await calls.createUpload(request);
  try {
    if (calibration !== null) await calls.sendCalibration(upload.id, calibration);
    while (upload.offset_bytes < upload.bytes) {
      upload = await sentPiece(upload, file, signal);
      onProgress(upload.offset_bytes);
    }
    onCheck();
    signal.throwIfAborted();
    return await calls.completeUpload(upload.id);
  } catch (error) {
    await calls.removeUpload(upload.id).catch(() => undefined); // retention removes what is left
    throw error;
  }
}

async function sentPiece(upload: Upload, file: File, signal: AbortSignal): Promise<Upload> {
  const from = upload.offset_bytes;
  for (const pause of [...PAUSES_MS, null]) {
    try {
      return await calls.sendChunk(upload.id, from, file.slice(from, from + CHUNK_BYTES), signal);
    } catch (error) {
      if (!(error instanceof UnreachableError) || pause === null) throw error;
      await new Promise((resolve) => setTimeout(resolve, pause));
      const now = await calls.upload(upload.id).catch(() => upload);
      if (now.offset_bytes > from) return now; // it had come, and its answer was lost
    }
  }
  return upload;
}
