"""The camera of a capture: found, lost, and found again or replaced."""

import time

from spiked_driver.usb_cameras import CameraChoice, UsbCamera, find_cameras

_REFRESH_S = 1.0
"""Time between two looks at the other cameras, seconds."""


class CameraSearch:
    """Finds the camera of a capture. It remembers the other cameras, so that none of them is taken for it later."""

    def __init__(self, choice: CameraChoice) -> None:
        self.choice = choice
        self.camera: UsbCamera | None = None
        """The camera in use, or the last one that was."""
        self._others: set[str] = set()
        self._refreshed_s = 0.0

    def find(self) -> UsbCamera | None:
        """The chosen camera, or the one that was lost; None if it is not plugged in. Raises NotUsableError."""
        cameras = find_cameras()
        if self.camera is None:
            return self.choice.pick(cameras)
        return self.choice.find_again(cameras, self.camera, self._others)

    def select(self, camera: UsbCamera) -> str | None:
        """Use this camera from now on. Returns a warning if it has another serial number than the former one."""
        former, self.camera = self.camera, camera
        self.refresh()
        if former is None or former.serial == camera.serial:
            return None
        was, now = former.serial or "none", camera.serial or "none"
        return f"the camera at {camera.port} was swapped: its serial number was {was} and is {now} now"

    def absence_reason(self) -> str:
        """Why there is no camera, as a message."""
        if self.camera is None:
            return f"the camera {self.choice} is not there: waiting for it"
        gone = f"the camera {self.choice} was unplugged: waiting for it"
        instead = [one.serial for one in find_cameras() if one.port == self.camera.port]
        return f"{gone}; at {self.camera.port} there is another one, serial number {instead[0]}" if instead else gone

    def refresh(self) -> bool:
        """Update the list of other cameras. Returns whether the camera in use is plugged in."""
        cameras = find_cameras()
        self._others |= {camera.port for camera in cameras if self.camera and camera.port != self.camera.port}
        self._refreshed_s = time.monotonic()
        return self.camera in cameras

    def refresh_if_due(self) -> None:
        """Update the list of other cameras once a second."""
        if time.monotonic() - self._refreshed_s > _REFRESH_S:
            self.refresh()
