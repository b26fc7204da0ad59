"""The truth of a part of a recording: poses and held-out pictures, in the times of the part."""

import json
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from spiked.errors import RecordingError
from spiked.pose import rotation_of
from spiked.trajectory import Trajectory, tum_lines, tum_tables
from spiked.whole_files import whole_folder

__all__ = ["TRUTH", "cut_truth"]

PATH, VIEWS = TRUTH = ("groundtruth.tum", "views.json")
PICTURES = ("file", "lens_file")
"""Fields of a view that name pictures."""


def cut_truth(source: Path, folder: Path, names: Collection[str], begin_s: float, end_s: float) -> None:
    """Write these files of the folder `source` to `folder`, from `begin_s` to `end_s`; their times begin at 0 then.

    After an error there are none.

    Raises SceneError for a damaged path, RecordingError for damaged views, and OSError.
    """
    with whole_folder(folder) as making:
        if PATH in names:
            with (making / PATH).open("w", encoding="utf-8") as file:
                file.writelines(tum_lines(_poses(source / PATH, begin_s, end_s)))
        if VIEWS in names:
            _cut_views(source, making, begin_s, end_s)


def _poses(path: Path, begin_s: float, end_s: float) -> Iterator[Trajectory]:
    for table in tum_tables(path):
        part = Trajectory(table[:, 0], rotation_of(table[:, [7, 4, 5, 6]]), table[:, 1:4]).between(begin_s, end_s)
        yield Trajectory(part.times_s - begin_s, part.rotations, part.centres)


def _cut_views(source: Path, folder: Path, begin_s: float, end_s: float) -> None:
    try:
        content: dict[str, Any] = json.loads((source / VIEWS).read_bytes())
        views = [view for view in content["views"] if begin_s <= float(view["timestamp"]) < end_s]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(
            f"{source / VIEWS} is no list of views: {error!r}; move it away to cut without it"
        ) from error
    for view in views:
        view["timestamp"] = float(view["timestamp"]) - begin_s
        view.pop("coverage", None)  # of the whole path
        for field in PICTURES:
            if field in view:
                if not _inside(view[field]):
                    raise RecordingError(f"{source / VIEWS} names {view[field]!r}, which is outside of its folder")
                place = folder / view[field]
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source / view[field], place)
    (folder / VIEWS).write_text(json.dumps({**content, "views": views}, indent=1), encoding="utf-8")


def _inside(name: object) -> bool:
    """Whether a name is that of a file in a folder or below."""
    return isinstance(name, str) and not Path(name).is_absolute() and ".." not in Path(name).parts
