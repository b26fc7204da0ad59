"""Videos of scenes along a camera path, and of recordings in slow motion, as MP4."""

from spiked.video.camera_path import CameraPath, calm_path, recorded_path, smoothed_path, waypoint_path
from spiked.video.mp4 import Mp4Writer
from spiked.video.rate_pictures import SlowMotion, slow_motion
from spiked.video.scene_pictures import scene_pictures, video_camera

__all__ = [
    "CameraPath",
    "Mp4Writer",
    "SlowMotion",
    "calm_path",
    "recorded_path",
    "scene_pictures",
    "slow_motion",
    "smoothed_path",
    "video_camera",
    "waypoint_path",
]
