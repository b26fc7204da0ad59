"""PSNR of the pictures of a slow-motion video against exact pictures on the path, with and without motion compensation.

    python evaluation/slow_motion_figures.py STREAM_FOLDER...

A folder holds NAME.dat, and views.json with exact pictures, their times, and the gain from pixel values to spikes a
frame.
"""

import json
import sys
from pathlib import Path

import cv2
import numpy as np

from spiked.rates import rate_at
from spiked.recording import open_recording
from spiked.video.rate_pictures import compensated


def main() -> None:
    """Print a line for each folder and window."""
    for folder in map(Path, sys.argv[1:]):
        about = json.loads((folder / "views.json").read_text())
        recording = open_recording(folder / f"{folder.name}.dat")
        views = [view for view in about["views"] if view["on_trajectory"]]
        for window in (8, 16, 32, 64):
            plain, added = [], []
            for view in views:
                rate = rate_at(recording, view["timestamp"], window)
                if rate is None:
                    continue
                flags = cv2.IMREAD_COLOR if rate.shape[2] == 3 else cv2.IMREAD_GRAYSCALE
                exact = cv2.imread(str(folder / view["file"]), flags).reshape(*rate.shape[:2], -1)[..., ::-1] / 255.0
                brightest = float(np.percentile(rate, 99.5))
                both = rate, compensated(recording, view["timestamp"], window, rate, brightest)
                for pictures, picture in zip((plain, added), both, strict=True):
                    value = np.clip((picture - about["dark"]) / about["gain"], 0, 1)
                    pictures.append(-10 * np.log10(np.mean((value - exact) ** 2)))
            print(f"{folder.name} {window:3} frames: {np.mean(plain):.2f} dB, compensated {np.mean(added):.2f} dB")


if __name__ == "__main__":
    main()
