/** Which file an upload is of, for a page that is loaded again: the service knows its size only. */

import type { Upload } from "../../shared/api/types";

const KEY = "spiked.uploads";

interface Remembered {
  file: string;
  modified: number;
  calibration: boolean;
}

/** A browser that keeps nothing for pages remembers nothing. */
function remembered(): Record<string, Remembered> {
  try {
    return JSON.parse(localStorage.getItem(KEY) ?? "{}") as Record<string, Remembered>;
  } catch {
    return {};
  }
}

function keep(files: Record<string, Remembered>): void {
  try {
    localStorage.setItem(KEY, JSON.stringify(files));
  } catch {
    // Uploads do not go on after the page is loaded again.
  }
}

export const rememberFile = (id: string, file: File, calibration: boolean): void =>
  keep({ ...remembered(), [id]: { file: file.name, modified: file.lastModified, calibration } });

export const forgetFile = (id: string): void =>
  keep(Object.fromEntries(Object.entries(remembered()).filter(([key]) => key !== id)));

/** Why a file is not the one that an upload was begun with; null if it is. */
export function whyNot(upload: Upload, file: File): string | null {
  const known = remembered()[upload.id];
  // Another file of the same name and size would make a recording of two halves.
  if (known === undefined) return "This browser did not begin the upload, and cannot tell its file: cancel it here.";
  const name = known.file;
  if (file.name !== name) return `The upload was begun with ${name}, and this is ${file.name}.`;
  if (file.size !== upload.bytes) return `${name} had ${upload.bytes} bytes, and now it has ${file.size}.`;
  if (file.lastModified !== known.modified)
    return `${name} was changed since the upload was begun: cancel it, and upload the file anew.`;
  if (known.calibration && upload.offset_bytes === 0)
    return "Its calibration may not have been sent: cancel it, and upload the files anew.";
  return null;
}
