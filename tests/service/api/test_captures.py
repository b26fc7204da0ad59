"""Captures over HTTP: start, name, remove, and what was recorded."""

import hashlib
import time
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import cv2
import httpx
import numpy as np
import pytest

from spiked.client import ApiError, CaptureOut, NoiseModel
from spiked.recording import Durability, RecordingWriter, open_recording
from spiked.sensor import Sensor

FRAMES = 512


def picture(answer: httpx.Response) -> np.ndarray:
    assert answer.status_code == 200, answer.text
    decoded = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    return np.asarray(decoded)


def test_a_capture_tells_what_it_was(done: CaptureOut) -> None:
    assert (done.name, done.notes, done.keep, done.origin) == ("by hand", "a first one", False, "live")
    assert done.recording is not None and done.recording.frames == FRAMES
    assert done.verdict is not None and done.verdict.grade in ("good", "degraded")
    assert done.ended_at is not None and done.ended_at > done.started_at
    assert done.sensor is not None and (done.sensor.width, done.sensor.height) == (160, 100)
    assert done.counters is not None and done.counters.received == FRAMES


def test_the_answer_to_a_start_says_the_planned_length(service: Any) -> None:
    plan = {"source": "sim:?width=64&height=48", "frames": 64, "reconstruct": False}
    started = service.http.post("captures", json=plan).json()
    assert started["frames_planned"] == 64, started
    service.client.wait_for_capture(started["id"], 60)


def test_the_recording_comes_whole_in_ranges_and_only_if_changed(service: Any, done: CaptureOut) -> None:
    url = f"captures/{done.id}/recording"
    whole = service.http.get(url)
    assert whole.headers["accept-ranges"] == "bytes"
    assert len(whole.content) == done.recording.bytes == int(whole.headers["content-length"])
    ranges = {
        "bytes=0-99": (0, 100),
        "bytes=100-": (100, len(whole.content)),
        "bytes=-50": (len(whole.content) - 50, len(whole.content)),
        f"bytes=10-{10**15}": (10, len(whole.content)),
        f"bytes=10-{10**30}": (10, len(whole.content)),
        f"bytes=-{10**30}": (0, len(whole.content)),
        "bytes=00000000000000000000010-0000000000000000000000020": (10, 21),
    }
    for asked, (first, stop) in ranges.items():
        part = service.http.get(url, headers={"Range": asked})
        assert part.status_code == 206
        assert part.content == whole.content[first:stop]
        assert part.headers["content-range"] == f"bytes {first}-{stop - 1}/{len(whole.content)}"
    for odd in ("bytes=5-2", "lines=1-2", "bytes=a-b", "bytes=0-1,4-5", "bytes=-"):
        assert service.http.get(url, headers={"Range": odd}).status_code == 200
    for first in (len(whole.content), 10**30):
        beyond = service.http.get(url, headers={"Range": f"bytes={first}-"})
        assert beyond.status_code == 416
    assert beyond.headers["content-range"] == f"bytes */{len(whole.content)}"
    assert beyond.headers["content-type"] == "application/problem+json"
    tag = whole.headers["etag"]
    part = {"Range": "bytes=0-9"}
    assert service.http.get(url, headers={**part, "If-Range": tag}).status_code == 206
    assert service.http.get(url, headers={**part, "If-Range": '"other"'}).status_code == 200
    assert service.http.get(url, headers={"If-None-Match": tag}).status_code == 304
    head = service.http.head(url)
    assert (head.status_code, head.content, head.headers["etag"]) == (200, b"", tag)


def test_the_recording_opens_with_its_sidecar(service: Any, done: CaptureOut, tmp_path: Path) -> None:
    service.client.save_recording(done.id, tmp_path / "rec.dat")
    recording = open_recording(tmp_path / "rec.dat")
    assert recording.frames == FRAMES
    assert recording.sensor.frame_rate_hz == done.sensor.frame_rate_hz
    assert recording.sensor.intrinsics is not None


def test_a_download_that_broke_off_goes_on(service: Any, done: CaptureOut, tmp_path: Path) -> None:
    whole = service.http.get(f"captures/{done.id}/recording").content
    part = tmp_path / f"rec.dat.{done.id}.part"
    for length in (100, len(whole), len(whole) + 1):
        part.write_bytes((whole + b"?")[:length])
        assert service.client.save_recording(done.id, tmp_path / "rec.dat").read_bytes() == whole


def test_a_download_replaces_an_earlier_recording_with_its_index(
    service: Any, done: CaptureOut, tmp_path: Path
) -> None:
    with RecordingWriter(tmp_path / "rec.dat", Sensor(64, 48, 1000.0), durability=Durability(index=True)) as writer:
        writer.append(np.zeros((5, 384), np.uint8))
        writer.gap(5, 7, "device")
    assert (tmp_path / "rec.index").exists()
    service.client.save_recording(done.id, tmp_path / "rec.dat")
    recording = open_recording(tmp_path / "rec.dat")
    assert (recording.frames, recording.gaps) == (FRAMES, ())
    assert sorted(file.name for file in tmp_path.iterdir()) == ["rec.dat", "rec.json"]


@pytest.mark.parametrize("kind", ["interval", "rate", "accumulation", "render"])
def test_pictures_of_recorded_frames(service: Any, done: CaptureOut, kind: str) -> None:
    answer = service.http.get(f"captures/{done.id}/preview", params={"kind": kind, "frame": 300, "format": "png"})
    image = picture(answer)
    assert image.shape[:2] == (100, 160)
    assert image.std() > 5
    brighter = {"kind": kind, "frame": 300, "format": "png", "white": float(answer.headers["x-white"]), "gain": 2}
    assert picture(service.http.get(f"captures/{done.id}/preview", params=brighter)).mean() > image.mean()


def test_a_white_and_a_gain_far_from_sense_are_refused(service: Any, done: CaptureOut) -> None:
    """Their quotient was once more than the renderer's own limit, which ended in a failure of the service."""
    for query in ({"gain": 1e-300}, {"white": 1e-68}, {"white": 1e9}, {"gain": 1e9}):
        answer = service.http.get(f"captures/{done.id}/preview", params={"kind": "render", **query})
        assert answer.status_code == 422
    extreme = {"kind": "render", "gain": 0.001, "white": 1e6, "frame": 300}
    assert service.http.get(f"captures/{done.id}/preview", params=extreme).status_code == 200


@pytest.mark.parametrize("number", ["0.0", "1e1", "0x1", "", "\u0663"])
def test_an_integer_in_a_query_is_written_in_digits(service: Any, done: CaptureOut, number: str) -> None:
    for what in ("stats", "preview"):
        answer = service.http.get(f"captures/{done.id}/{what}", params={"frame": number})
        assert answer.status_code == 422, answer.text
    assert service.http.get("captures", params={"limit": number}).status_code == 422


def test_a_frame_that_was_not_recorded_has_no_picture(service: Any, done: CaptureOut) -> None:
    answer = service.http.get(f"captures/{done.id}/preview", params={"frame": FRAMES})
    assert answer.status_code == 404
    assert f"0 to {FRAMES - 1}" in answer.json()["detail"]


def test_a_thumbnail_and_statistics(service: Any, done: CaptureOut) -> None:
    assert service.http.get(f"captures/{done.id}/thumbnail").content[8:12] == b"WEBP"
    stats = service.http.get(f"captures/{done.id}/stats", params={"frame": 200}).json()
    histogram = stats["rate_histogram"]
    assert sum(histogram["counts"]) == 160 * 100
    assert len(histogram["edges"]) == len(histogram["counts"]) + 1
    assert 0 < stats["mean_rate"] < 1
    assert abs(stats["frame"] - 200) <= 1


def test_statistics_of_a_region_and_spikes_of_a_pixel(service: Any, done: CaptureOut, tmp_path: Path) -> None:
    path = service.client.save_recording(done.id, tmp_path / "rec.dat")
    images = open_recording(path).images(0, 512)
    answer = service.http.get(f"captures/{done.id}/spikes", params={"x": 40, "y": 30, "frame": 256, "frames": 200})
    assert answer.json() == {
        "first_frame": 156,
        "frames": 200,
        "spikes": [156 + int(k) for k in np.flatnonzero(images[156:356, 30, 40])],
    }
    every = service.http.get(f"captures/{done.id}/spikes", params={"x": 159, "y": 99}).json()
    assert (every["first_frame"], every["frames"]) == (0, 512) and len(every["spikes"]) == images[:, 99, 159].sum()

    region = {"x": 30, "y": 20, "width": 16, "height": 9}
    stats = service.http.get(f"captures/{done.id}/stats", params={"frame": 256, **region}).json()
    assert (stats["frame"], stats["frames"]) == (256, 64)
    rate = images[224:288, 20:29, 30:46].mean(0)
    assert abs(stats["mean_rate"] - rate.mean()) < 1e-6 and abs(stats["deviation"] - rate.std()) < 1e-6
    assert sum(stats["rate_histogram"]["counts"]) == 16 * 9
    assert sum(service.http.get(f"captures/{done.id}/stats?x=159&y=98").json()["rate_histogram"]["counts"]) == 2
    for where in ("stats?x=160", "stats?x=1&width=160", "stats?height=101", "spikes?x=160&y=0", "spikes?x=0&y=100"):
        refused = service.http.get(f"captures/{done.id}/{where}")
        assert refused.status_code == 404 and "160x100" in refused.json()["detail"]


def test_statistics_of_a_region_while_frames_come(service: Any) -> None:
    capture = service.client.start_capture("sim:?width=64&height=48", reconstruct=False)
    deadline = time.monotonic() + 60
    while (answer := service.http.get(f"captures/{capture.id}/stats?x=8&y=4&width=20&height=10")).status_code == 404:
        assert time.monotonic() < deadline
        time.sleep(0.1)
    stats = answer.json()
    assert sum(stats["rate_histogram"]["counts"]) == 200 and stats["frames"] > 0 and 0 < stats["mean_rate"] < 1
    assert service.http.get(f"captures/{capture.id}/spikes?x=8&y=4").status_code in (200, 404)
    service.client.stop_capture(capture.id)
    service.client.wait_for_capture(capture.id, 60)


def test_names_notes_and_keeping(service: Any, done: CaptureOut) -> None:
    changed = service.client.change_capture(done.id, name="renamed", keep=True)
    assert (changed.name, changed.notes, changed.keep) == ("renamed", done.notes, True)
    service.client.change_capture(done.id, name=done.name, keep=False)
    for body in ({"name": "a\nb"}, {"name": "x" * 201}, {"nmae": "x"}, {"keep": "perhaps"}):
        assert service.http.patch(f"captures/{done.id}", json=body).status_code == 422


def test_removal_can_be_undone(service: Any) -> None:
    capture = service.capture(reconstruct=False, name="to be removed")
    service.client.remove_capture(capture.id)
    assert capture.id not in [one.id for one in service.client.captures()]
    assert capture.id in [one.id for one in service.client.captures(deleted=True)]
    assert service.client.restore_capture(capture.id).deleted_at is None
    assert capture.id in [one.id for one in service.client.captures(query="TO BE rem")]


def test_what_is_removed_can_be_purged(service: Any) -> None:
    capture = service.capture(reconstruct=False, name="to be purged")
    folder = service.daemon.data / "captures" / capture.id
    assert folder.is_dir()
    refused = service.http.post(f"captures/{capture.id}:purge")
    assert refused.status_code == 409 and "remove it first" in refused.json()["detail"]
    service.client.remove_capture(capture.id)
    service.client.purge_capture(capture.id)
    assert not folder.exists()
    for answer in (
        service.http.get(f"captures/{capture.id}"),
        service.http.post(f"captures/{capture.id}:restore"),
        service.http.post(f"captures/{capture.id}:purge"),
    ):
        assert answer.status_code == 404


def test_lists_come_in_pages(service: Any, done: CaptureOut) -> None:
    for _ in range(3):
        service.capture(reconstruct=False)
    ids = [one.id for one in service.client.captures()]
    assert ids == sorted(ids, reverse=True)
    paged, cursor = [], None
    while True:
        page = service.http.get("captures", params={"limit": 2, **({"cursor": cursor} if cursor else {})}).json()
        assert len(page["items"]) <= 2
        paged += [one["id"] for one in page["items"]]
        cursor = page["next_cursor"]
        if cursor is None:
            break
    assert paged == ids
    assert service.http.get("captures", params={"limit": 0}).status_code == 422


def test_a_key_makes_a_post_happen_once(service: Any) -> None:
    body = {"source": "sim:?width=96&height=64", "frames": 64, "reconstruct": False}
    key = {"Idempotency-Key": f"start-{time.monotonic_ns()}"}
    first = service.http.post("captures", json=body, headers=key)
    again = service.http.post("captures", json=body, headers=key)
    assert (first.status_code, again.status_code) == (201, 201)
    assert again.json() == first.json()
    assert again.headers["location"] == first.headers["location"]
    assert "idempotency-replayed" not in first.headers and again.headers["idempotency-replayed"] == "true"
    other = service.http.post("captures", json={**body, "frames": 65}, headers=key)
    assert other.status_code == 422
    assert other.json()["type"] == "urn:spiked:problem:idempotency-key-reused"
    assert service.http.post("captures", json=body, headers={"Idempotency-Key": "x" * 256}).status_code == 422
    service.client.wait_for_capture(first.json()["id"])


def test_a_post_that_failed_may_be_tried_again_with_its_key(service: Any) -> None:
    key = {"Idempotency-Key": f"failed-{time.monotonic_ns()}"}
    refused = service.http.post("captures", json={"source": "sim:?bogus=1"}, headers=key)
    assert refused.status_code == 422
    assert service.http.post("captures", json={"source": "sim:?bogus=1"}, headers=key).status_code == 422


def test_noise_of_a_simulation_is_part_of_a_request(service: Any) -> None:
    source = "sim:?width=96&height=64&dark=0.3&flicker=0.1"
    started = service.client.start_capture(
        source, frames=64, reconstruct=False, noise=NoiseModel(dark=0.9, hot_share=0.25)
    )
    assert parse_qs(started.source.partition("?")[2]) == {
        "width": ["96"], "height": ["64"], "flicker": ["0.1"], "dark": ["0.9"], "hot_share": ["0.25"], "pace": ["0"],
    }  # fmt: skip
    frames = service.client.wait_for_capture(started.id).recording
    assert frames is not None and frames.frames == 64
    for body, told in (
        ({"source": "sim:", "noise": {"dark": -1}}, "dark"),
        ({"source": "sim:", "noise": {"dark": "0.1"}}, "dark"),
        ({"source": "sim:", "noise": {"temperature": 300}}, "temperature"),
        ({"source": "usb0", "noise": {"dark": 0.1}}, "no option dark"),
        ({"source": "sim:?response=bernoulli", "noise": {"reset_bias": 0.1}}, "leave out reset_bias"),
    ):
        refused = service.http.post("captures", json=body)
        assert refused.status_code == 422 and told in refused.text, refused.text


def test_one_capture_a_device(service: Any) -> None:
    running = service.client.start_capture("sim:?width=96&height=64&seed=7", record=False)
    try:
        with pytest.raises(ApiError) as refused:
            service.client.start_capture("sim:?width=96&height=64&seed=7")
        assert refused.value.status == 409
        answer = service.http.get(f"captures/{running.id}/recording")
        assert answer.status_code == 409
        assert service.http.delete(f"captures/{running.id}").status_code == 409
        live = picture(poll(service, f"captures/{running.id}/preview"))
        assert live.shape[:2] == (64, 96)
    finally:
        service.client.stop_capture(running.id)
        service.client.stop_capture(running.id)
        service.client.wait_for_capture(running.id)


def poll(service: Any, path: str) -> httpx.Response:
    """What will be there in a moment."""
    deadline = time.monotonic() + 30
    while True:
        answer: httpx.Response = service.http.get(path)
        if answer.status_code != 404 or time.monotonic() > deadline:
            return answer
        time.sleep(0.05)


@pytest.mark.parametrize("name", ["/etc/passwd", "../../../etc/passwd", "/etc/../etc/passwd?width=8&height=8", "a\0b"])
def test_no_file_outside_the_open_folders_is_touched(service: Any, name: str) -> None:
    answer = service.http.post("captures", json={"source": f"replay:{name}"})
    assert answer.status_code == 422
    assert "source_folders" in answer.json()["detail"]


def test_links_out_of_the_open_folders_lead_nowhere(service: Any, tmp_path: Path) -> None:
    (tmp_path / "link.dat").symlink_to("/etc/passwd")
    answer = service.http.post("captures", json={"source": f"replay:{tmp_path / 'link.dat'}"})
    assert answer.status_code == 422
    assert "source_folders" in answer.json()["detail"]


@pytest.mark.parametrize("capture_id", ["no-such", "..%2F..%2Fetc", "%00", "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10"])
def test_ids_that_are_none(service: Any, capture_id: str) -> None:
    for ending in ("", "/recording", "/thumbnail", "/trajectory", "/preview?frame=1", "/recording/verdict"):
        answer = service.http.get(f"captures/{capture_id}{ending}")
        assert answer.status_code == 404
        assert answer.headers["content-type"] == "application/problem+json"


def test_every_refusal_says_what_to_do(service: Any) -> None:
    answers = {
        404: service.http.get("nowhere"),
        405: service.http.put("captures"),
        422: service.http.post("captures", json={"source": "sim:", "frames": 5, "seconds": 1}),
    }
    for status, answer in answers.items():
        assert answer.status_code == status
        body = answer.json()
        assert body["status"] == status and body["instance"].startswith("/api/v1/")
        assert body["what_to_do"] and body["detail"] and body["type"].startswith("urn:spiked:problem:")
    malformed = service.http.post("captures", content=b"{", headers={"Content-Type": "application/json"})
    assert malformed.status_code == 422
    assert malformed.json()["detail"].startswith("the body is not JSON: ")
    assert "HTTPValidationError" not in httpx.get(f"{service.daemon.address}openapi.json").text


def test_usual_mistakes_are_told_in_words(service: Any) -> None:
    def detail(**body: Any) -> str:
        answer = service.http.post("captures", **body)
        assert answer.status_code == 422
        return str(answer.json()["detail"])

    assert detail(json={"source": "sim:", "frame": 5}) == "frame: there is no such field; did you mean frames?"
    nested = {"source": "sim:", "options": {"stepps": 5, "intrinsics": {"fx": 1, "fy": 1, "cx": 1, "cy": 1, "fxx": 1}}}
    assert "options.stepps: there is no such field; did you mean steps?" in detail(json=nested)
    assert "options.intrinsics.fxx: there is no such field; did you mean fx?" in detail(json=nested)
    assert detail(json={"source": "sim:", "qqqqqq": 5}) == "qqqqqq: there is no such field"
    form = {"Content-Type": "application/x-www-form-urlencoded"}  # what curl says of any body
    assert "x-www-form-urlencoded, not as JSON: add" in detail(content=b'{"source": "sim:"}', headers=form)


def test_devices_say_what_they_do(service: Any) -> None:
    sim = next(one for one in service.client.devices() if one.source == "sim:")
    assert (sim.state, sim.capture_id) == ("idle", None)
    assert service.http.get("devices/sim:").json()["id"] == "sim:"
    assert service.http.get("devices/replay:no%2Fsuch").status_code == 404


def test_a_capture_can_begin_before_it_was_asked_for(service: Any) -> None:
    assert service.http.post("devices/sim::arm", json={"pretrigger_s": 0.02}).status_code == 202
    deadline = time.monotonic() + 60
    while (device := service.http.get("devices/sim:").json())["state"] != "armed":  # until then captures are refused
        assert device["state"] == "idle" and device["reason"].startswith("being armed"), device
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert service.http.post("devices/sim::arm", json={"pretrigger_s": 0.02}).status_code == 409
    refused = service.http.post("captures", json={"device": "sim:", "pretrigger_s": 0.5})
    assert refused.status_code == 422 and "keeps 0.02 s, not 0.5" in refused.json()["detail"]
    assert service.http.post("devices/sim::disarm").status_code == 202
    assert service.http.get("devices/sim:").json()["state"] == "idle"


def test_options_describe_themselves(service: Any) -> None:
    schema = service.client.options()
    for name, option in schema["properties"].items():
        assert option["description"], name
        assert "default" in option, name


def test_the_hash_of_a_recording(service: Any, done: CaptureOut) -> None:
    if done.recording.sha256 is not None:
        whole = service.http.get(f"captures/{done.id}/recording").content
        assert hashlib.sha256(whole).hexdigest() == done.recording.sha256


@pytest.mark.parametrize("sort", ["started", "name"])
def test_a_cursor_of_no_capture_is_answered_as_the_schema_says(service: Any, sort: str) -> None:
    answer = service.http.get("captures", params={"sort": sort, "cursor": "01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e10"})
    declared = service.http.get(f"{service.daemon.address}openapi.json").json()["paths"]["/api/v1/captures"]["get"]
    assert str(answer.status_code) in declared["responses"], answer.text
    assert answer.status_code == (404 if sort == "name" else 200)
