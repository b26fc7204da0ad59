"""Reports and bundles of published versions over HTTP."""

import zlib

import numpy as np
from fastapi import Request, Response
from numpy.typing import NDArray

from spiked_service.api import files
from spiked_service.api.problems import ConflictError, NotReadyError
from spiked_service.api.results import Result, Results
from spiked_service.api.streams import GuardedStream
from spiked_service.captures.captures import Captures
from spiked_service.results.map_reports import REPORT
from spiked_service.results.report.bundle import bundle_pieces
from spiked_service.results.report.job import JobReport
from spiked_service.results.report.page import POLICY, report_html
from spiked_service.results.report.source import Render
from spiked_service.results.view_renderer import Pose, ViewRenderer
from spiked_service.store.folder import DataFolder
from spiked_service.store.rows import ReconstructionRow


class Reports:
    """Makes reports of published versions, and sends them."""

    def __init__(self, results: Results, captures: Captures, folder: DataFolder, views: ViewRenderer) -> None:
        self._results = results
        self._captures = captures
        self._folder = folder
        self._views = views

    def page(self, request: Request, row: ReconstructionRow, version: int | None) -> Response:
        """The HTML file. Raises NotReadyError, NothingError, GoneError, SceneError, OverloadedError."""
        result = self._results.of(row, version)
        tag = self._tag(row, result, "report")
        if files.unchanged(request, tag):
            return files.not_modified(tag)
        body = report_html(self._job(row, result, with_recording=False).read()).encode("utf-8", "replace")
        headers = {
            "Content-Security-Policy": POLICY,
            "Content-Disposition": f'inline; filename="{_name(row, result)}.html"',
            "X-Scene-Version": str(result.published.version),
        }
        return files.content(request, body, "text/html; charset=utf-8", tag, **headers)

    def bundle(self, request: Request, row: ReconstructionRow, version: int | None, with_recording: bool) -> Response:
        """The ZIP file, streamed.

        Raises as `page`, and ConflictError or NotReadyError for a recording that is not closed or not there.
        """
        result = self._results.of(row, version)
        if with_recording:
            self._check_recording(row)
        tag = self._tag(row, result, "bundle", with_recording)
        if files.unchanged(request, tag):
            return files.not_modified(tag)
        downloads = self._results.downloads
        downloads.acquire()
        try:
            source = self._job(row, result, with_recording).read()
            if with_recording and source.recording is None:
                raise NotReadyError(f"the recording of capture {row.capture_id} cannot be read; leave it out")
            pieces = bundle_pieces(source)
        except BaseException:
            downloads.release()
            raise
        headers = {
            **files.attached(tag, f"{_name(row, result)}.zip"),
            "X-Scene-Version": str(result.published.version),
        }
        return GuardedStream(pieces, "application/zip", headers, over=downloads.release)

    def _check_recording(self, row: ReconstructionRow) -> None:
        capture = self._captures.get(row.capture_id).row
        if capture.state.acquiring:
            raise ConflictError(f"capture {capture.id} is being recorded; stop it, or leave out its recording")
        if capture.recording is None:
            raise NotReadyError(f"capture {capture.id} has no recording; leave it out")

    def _job(self, row: ReconstructionRow, result: Result, with_recording: bool) -> JobReport:
        return JobReport(
            row=row,
            capture=self._captures.get(row.capture_id).row,
            folder=result.folder,
            published=result.published,
            poses=result.poses(),
            sensor=result.sensor,
            timeline=result.timeline,
            recording=self._folder.recording(row.capture_id),
            render=self._render(result),
            with_recording=with_recording,
        )

    def _render(self, result: Result) -> Render | None:
        camera = result.camera
        if camera is None or not result.published.splats:
            return None

        def render(pose: Pose) -> NDArray[np.float32]:
            return self._views.render(result.scene, camera, pose).values

        return render

    def _tag(self, row: ReconstructionRow, result: Result, *parts: object) -> str:
        """Changes with the version, with what the job has done since, and with the name of its capture."""
        own = result.folder / REPORT
        stamp = files.stamp(own) if own.exists() else row.frames
        name = self._captures.get(row.capture_id).row.name
        return files.etag(
            *parts, result.published.version, row.state, row.stage, stamp, f"{zlib.crc32(name.encode()):x}"
        )


def _name(row: ReconstructionRow, result: Result) -> str:
    return f"{row.id}-{result.published.version:06d}"
