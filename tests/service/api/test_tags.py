"""Tags and metadata of captures: stored, searched, listed by tag."""

from typing import Any

import pytest

from spiked.client import CaptureOut


def test_tags_and_metadata_are_kept_and_found(service: Any, done: CaptureOut) -> None:
    http, url = service.http, f"captures/{done.id}"
    body = {"tags": ["desk", "by night", "desk"], "metadata": {"robot.run": "17", "lens": "8 mm"}}
    changed = http.patch(url, json=body)
    assert changed.status_code == 200, changed.text
    assert changed.json()["tags"] == ["desk", "by night"] and changed.json()["metadata"] == body["metadata"]
    assert http.get(url).json()["notes"] == changed.json()["notes"]

    def found(**asked: str) -> list[str]:
        return [one["id"] for one in http.get("captures", params=asked).json()["items"]]

    assert found(tag="by night") == [done.id] == found(q="8 MM") == found(q="by nig")
    assert found(tag="by") == found(tag="night") == []
    assert http.patch(url, json={"metadata": {}}).json()["tags"] == ["desk", "by night"]
    assert http.patch(url, json={"tags": []}).json()["metadata"] == {} and found(tag="desk") == []


@pytest.mark.parametrize(
    "body",
    [{"tags": ["a,b"]}, {"tags": [""]}, {"tags": ["x" * 65]}, {"metadata": {"two words": "x"}}, {"metadata": {"a": 1}}],
)
def test_what_is_no_tag_and_no_key_is_refused(service: Any, done: CaptureOut, body: dict[str, Any]) -> None:
    assert service.http.patch(f"captures/{done.id}", json=body).status_code == 422
