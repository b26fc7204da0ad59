import { afterEach, beforeEach, expect, it, vi } from "vitest";

import * as calls from "../../shared/api/calls";
import { ApiError, UnreachableError } from "../../shared/api/http";
import type { Capture, Upload } from "../../shared/api/types";
import { type Sending, uploadFile } from "./uploadFile";

vi.mock("../../shared/api/calls");

const EMPTY: Upload = { id: "u", name: "desk.dat", bytes: 3, offset_bytes: 0, created_at: "", capture_id: null };
const WHOLE = { ...EMPTY, offset_bytes: 3 };
const CAPTURE = { id: "c" } as Capture;
const BUSY = new ApiError(409, "another request is writing to upload u", null, "busy");

const sending = (signal: AbortSignal): Sending => ({
  file: new File(["abc"], "desk.dat"),
  request: { name: "desk.dat", bytes: 3 },
  calibration: null,
  begun: null,
  onBegin: () => undefined,
  onProgress: () => undefined,
  onCheck: () => undefined,
  onWait: () => undefined,
  signal,
});
/** What an upload has come to when all pauses are over. */
const outcome = async (signal = new AbortController().signal): Promise<unknown> => {
  const made = uploadFile(sending(signal)).catch((error: unknown) => error);
  await vi.advanceTimersByTimeAsync(300_000);
  return made;
};

beforeEach(() => {
  vi.useFakeTimers();
  vi.resetAllMocks();
  Blob.prototype.arrayBuffer = () => Promise.resolve(new ArrayBuffer(1)); // jsdom has none
  vi.mocked(calls.createUpload).mockResolvedValue(EMPTY);
  vi.mocked(calls.upload).mockResolvedValue(EMPTY);
  vi.mocked(calls.sendChunk).mockResolvedValue(WHOLE);
  vi.mocked(calls.completeUpload).mockResolvedValue(CAPTURE);
  vi.mocked(calls.removeUpload).mockResolvedValue(undefined);
});
afterEach(() => vi.useRealTimers());

it("goes on after a long outage, and while a broken connection still holds the upload", async () => {
  for (const error of [...Array<Error>(6).fill(new UnreachableError()), BUSY, new ApiError(503, "overloaded")])
    vi.mocked(calls.sendChunk).mockRejectedValueOnce(error);
  expect(await outcome()).toBe(CAPTURE);
  expect(calls.removeUpload).not.toHaveBeenCalled();
});

it("goes on where the service is when the answer to a piece was lost", async () => {
  vi.mocked(calls.sendChunk).mockRejectedValueOnce(new UnreachableError());
  vi.mocked(calls.upload).mockResolvedValue(WHOLE);
  expect(await outcome()).toBe(CAPTURE);
  expect(calls.sendChunk).toHaveBeenCalledTimes(1);
});

it("asks again for the capture when the connection breaks during the check", async () => {
  vi.mocked(calls.completeUpload).mockRejectedValueOnce(new UnreachableError()).mockRejectedValueOnce(BUSY);
  expect(await outcome()).toBe(CAPTURE);
  expect(calls.removeUpload).not.toHaveBeenCalled();
});

it("removes an upload that is refused", async () => {
  const refused = new ApiError(422, "no recording");
  vi.mocked(calls.completeUpload).mockRejectedValue(refused);
  expect(await outcome()).toBe(refused);
  expect(calls.removeUpload).toHaveBeenCalledWith("u");
});

it("is cancelled during a pause, at once", async () => {
  const aborting = new AbortController();
  vi.mocked(calls.sendChunk).mockRejectedValue(new UnreachableError());
  const made = uploadFile(sending(aborting.signal)).catch((error: unknown) => error);
  await vi.advanceTimersByTimeAsync(20_000);
  aborting.abort();
  expect(await made).toBe(aborting.signal.reason);
  expect(calls.removeUpload).toHaveBeenCalledWith("u");
});

it("goes on with an upload that was begun before", async () => {
  vi.mocked(calls.sendChunk).mockResolvedValue(WHOLE);
  const begun = { ...EMPTY, offset_bytes: 1 };
  expect(await uploadFile({ ...sending(new AbortController().signal), begun })).toBe(CAPTURE);
  expect(calls.createUpload).not.toHaveBeenCalled();
  expect(vi.mocked(calls.sendChunk).mock.calls[0]?.slice(0, 2)).toEqual(["u", 1]);
});
