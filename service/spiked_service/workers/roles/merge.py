"""The merge worker: makes one map of two."""

import os

from spiked.recon import NotOnePlaceError
from spiked.recon import merge as merge_maps
from spiked_service.results.map_reports import REGISTRATION
from spiked_service.results.pinned_map import PinnedMap
from spiked_service.results.versions import moved_paths
from spiked_service.store.rows import Stage
from spiked_service.workers.channel import WorkerChannel
from spiked_service.workers.map_job_reporter import MapJobReporter
from spiked_service.workers.messages import MergeCommand

_NICE = 10
"""Niceness: live captures have priority."""


def run_merge(command: MergeCommand, channel: WorkerChannel) -> None:
    """Merge the maps, and publish the scene with the paths of all recordings, in the first map's frame of reference.

    Raises ConfigurationError or SceneError for errors that the user can correct.
    """
    os.nice(_NICE)
    reporter = MapJobReporter(command.folder, channel, Stage.JOINING)
    pinned = [PinnedMap.read(folder) for folder in command.maps]
    first, second = (one.known(folder) for one, folder in zip(pinned, command.maps, strict=True))
    try:
        made = merge_maps(
            first,
            second,
            seed=command.seed,
            threads=command.threads,
            progress=lambda share: reporter.progress(0.99 * share),
            cancelled=channel.leave.is_set,
        )
    except NotOnePlaceError as error:
        reporter.refuse(str(error), REGISTRATION, {"joined": False, "reason": str(error)})
        return
    if channel.leave.is_set():
        return
    own, *others = pinned[0].recorded(command.maps[0])
    others += moved_paths(pinned[1].recorded(command.maps[1]), made.joint.second.trajectory)
    figures = {"joined": True, "reason": "", **made.report()}
    reporter.publish(made.scene, own.trajectory, first.camera.intrinsics, REGISTRATION, figures, others=others)
