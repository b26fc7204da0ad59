"""A scene in a data folder as a reconstruction that is over, without a reconstruction."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

from spiked_service.base.ids import new_id
from spiked_service.captures.archive import DataStore
from spiked_service.results.versions import Publisher, RecordedPath
from spiked_service.store.rows import JobState, ReconstructionRow, Stage

from spiked.scene import Scene
from spiked.sensor import Intrinsics
from spiked.trajectory import Trajectory


def published_map(
    data_store: DataStore,
    capture_id: str,
    scene: Scene,
    path: Trajectory,
    optics: Intrinsics,
    white: float = 1.0,
    others: Sequence[RecordedPath] = (),
) -> str:
    """The id of a complete reconstruction of a capture; `others` are paths of other captures through the scene."""
    now = datetime.now(UTC)
    row = ReconstructionRow(new_id(), capture_id, False, JobState.COMPLETE, now, stage=Stage.DONE, ended_at=now)
    folder = data_store.folder.reconstruction(row.id)
    folder.mkdir()
    published = Publisher(folder).publish(scene, path, white, None, optics, others=others)
    rows = data_store.reconstructions.rows
    rows.save(replace(row, version=1, white=white, poses=len(path), splats=len(scene)))
    rows.add_version(row, published, {1})
    return row.id
