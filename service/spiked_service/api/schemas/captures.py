"""Devices, captures and what was recorded."""

from datetime import datetime
from typing import Any, Self

from pydantic import ConfigDict, Field, StrictBool, StrictFloat, StrictInt, model_validator

from spiked.camera import CameraFiles, CameraOptions
from spiked.profile import CameraProfile
from spiked.ring import DeviceState, Policy
from spiked.sensor import Mosaic, Sensor
from spiked.simulate import NoiseOptions
from spiked_service.api.schemas.base import (
    ID_EXAMPLE,
    LARGEST_INTEGER,
    Id,
    In,
    IntrinsicsModel,
    Metadata,
    Name,
    Notes,
    Out,
    PageOut,
    Tags,
    at_least_one_of,
    at_most_one_of,
    camera_example,
    exactly_one_of,
    example,
    examples,
)
from spiked_service.results.rate_statistics import RateStatistics
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.store.rows import CaptureState, Counters, Grade, Origin, Quality, Recorded
from spiked_service.store.snapshot import Snapshot


class ConsumerOut(Out):
    """One reader of the ring."""

    name: str
    policy: Policy = Field(description="latest skips frames by intention; the others want them all.")
    frames_read: int = Field(description="Frames that it read intact.")
    received: int = Field(description="Deprecated: use frames_read.", deprecated=True)
    lost: int = Field(description="Frames that it did not read, of any cause; frames_read + lost is its next frame.")
    lag_frames: int
    fill: float = Field(description="Its lag as a part of what it may lag; at 1 it loses frames.")
    lagging: bool


class CountersOut(Out):
    """Frames of a capture, without those that an armed device had before it."""

    device: DeviceState
    device_reason: str
    received: int = Field(description="Frames written into the ring.")
    lost: dict[str, int] = Field(description="By cause: device, usb, ring, disk.")
    next_frame: int = Field(
        description="Index of the next frame, as previews and poses count: that of the first frame, + received + lost. "
        "The first is 0 unless the device was armed."
    )
    consumers: list[ConsumerOut]

    @classmethod
    def of(cls, counters: Counters | None) -> "CountersOut | None":
        """As it is shown."""
        if counters is None:
            return None
        return cls(
            device=counters.device,
            device_reason=counters.device_reason,
            received=counters.received,
            lost=dict(counters.lost),
            next_frame=counters.next_frame,
            consumers=[ConsumerOut(**vars(consumer), received=consumer.frames_read) for consumer in counters.consumers],
        )


class CapabilityOut(Out):
    """Something that cameras differ in."""

    supported: bool
    value: Any | None = None


class DeviceOut(Out):
    """Something to capture from."""

    id: str = Field(description="Its name here; the same after a restart.", examples=["usb0", "sim:"])
    kind: str = Field(description="A name from `GET options/sources`.", examples=["usb", "sim"])
    source: str = Field(description="To be given as `source` of a capture.", examples=["sim:"])
    description: str
    state: DeviceState
    reason: str = Field(description="Why it is absent or lost.")
    warnings: list[str] = Field(default_factory=list, description="What its capture, or it while armed, does without.")
    serial: str | None = None
    port: str | None = None
    speed: str | None = None
    firmware: str | None = None
    capabilities: dict[str, CapabilityOut] = Field(default_factory=dict)
    counters: CountersOut | None = None
    capture_id: str | None = Field(None, description="The capture that uses it now.")


class DevicesOut(Out):
    """All devices."""

    items: list[DeviceOut]


class SourceKindOut(Out):
    """A kind of source, and what can follow its question mark."""

    name: str = Field(examples=["sim"])
    usage: str = Field(description="How a source of this kind is written.", examples=["sim:"])
    summary: str
    is_camera: bool = Field(description="Hardware: frames that are not read in time are lost.")
    can_block: bool = Field(description="With `pace=0` it waits for its consumers, so that no frame is lost.")
    takes_path: bool = Field(description="A path on the service's machine follows the colon.")
    options: dict[str, Any] = Field(description="JSON Schema of its options: types, limits, defaults and meaning.")


class SourceKindsOut(Out):
    """All kinds of sources."""

    items: list[SourceKindOut]


class ArmRequest(In):
    """Keep a device's newest frames at hand."""

    model_config = example(pretrigger_s=0.5)

    pretrigger_s: StrictFloat = Field(
        1.0, ge=0, le=60, description="How far back a capture shall be able to begin, seconds."
    )


class ProfileModel(In, CameraProfile):
    """What is known of one camera; options of a source or request win over it."""

    model_config = camera_example(model="M1K40", width=1000, height=1000, mosaic="BGGR", fov=50.0)

    intrinsics: IntrinsicsModel | None = None


class ProfileOut(Out):
    """The profile of a device."""

    file: str = Field(description="Its file in the folder `profiles` of the data folder.")
    profile: ProfileModel


class CalibrationRequest(In):
    """The captures to calibrate a camera by: one of them or both."""

    model_config = examples(
        {"dark": ID_EXAMPLE},
        rules=at_least_one_of("dark", "flat"),
    )

    dark: str | None = Field(
        None, min_length=1, max_length=64, description="Capture with the lens covered: dark rates and hot pixels."
    )
    flat: str | None = Field(
        None, min_length=1, max_length=64, description="Capture of an even light: gains and dead pixels."
    )

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.dark is None and self.flat is None:
            raise ValueError("name a capture in the dark, one of an even light, or both")
        return self


class CalibrationOut(Out):
    """Figures of a calibration."""

    gain_spread: float = Field(description="Standard deviation of the logarithm of good pixels' gains.")
    dark_rate: float = Field(description="Spikes a frame without light, median over the pixels.")
    useless: int = Field(description="Pixels that are left out: dead, stuck or hot.")
    pixels: int = Field(description="Of the sensor.")


class CalibratedOut(ProfileOut):
    """The completed profile of a device, and what was measured."""

    measured: CalibrationOut


class StatedCameraModel(In, CameraOptions, CameraFiles):
    """What is stated of a camera; it wins over the options of the source, its profile and its sidecar."""

    model_config = camera_example(mosaic="BGGR", fov=50.0)

    intrinsics: IntrinsicsModel | None = None


class NoiseModel(In, NoiseOptions):
    """Noise, defects and light of the simulated camera `sim:`; it wins over the options of the source's text."""

    model_config = example(dark=0.01, hot_share=0.001, flicker=0.2, flicker_hz=100.0) | ConfigDict(strict=True)


class CaptureRequest(In):
    """A capture to start."""

    model_config = examples(
        {"source": "sim:?seed=1", "frames": 1280, "name": "desk, by hand"},
        {"source": "sim:", "seconds": 0.1, "reconstruct": False},
        {"source": "sim:?seed=1", "frames": 640, "camera": {"mosaic": "BGGR", "fov": 60.0}},
        {"source": "sim:", "frames": 640, "noise": {"dark": 0.01, "flicker": 0.2}},
        rules=[
            *exactly_one_of(source="string", device="string"),
            *at_most_one_of(frames="integer", seconds="number"),
            {
                "not": {
                    "required": ["record", "reconstruct"],
                    "properties": {"record": {"const": False}, "reconstruct": {"const": False}},
                }
            },
        ],
    )

    source: str | None = Field(
        None,
        min_length=1,
        max_length=4096,
        description="usb0, pcie:PATH, sim: or replay:FILE, with options after a question mark. "
        "A file or simulation without `pace` waits for its readers.",
    )
    device: str | None = Field(
        None, min_length=1, max_length=4096, description="Id of a device, instead of a source; `GET devices`."
    )
    frames: StrictInt | None = Field(
        None, gt=0, le=LARGEST_INTEGER, description="Length; until the source ends or is stopped if not given."
    )
    seconds: StrictFloat | None = Field(
        None, gt=0, le=1e7, description="Length in seconds of the camera, instead of frames."
    )
    pretrigger_s: StrictFloat = Field(
        0.0, ge=0, le=60, description="Begin so much earlier, from an armed device's ring."
    )
    name: Name = ""
    notes: Notes = ""
    record: StrictBool = Field(True, description="Keep the frames in the data folder.")
    reconstruct: StrictBool = Field(True, description="Reconstruct while it runs.")
    options: ReconstructionOptions = Field(default_factory=ReconstructionOptions)
    camera: StatedCameraModel | None = Field(None, description="The same as options of the source's text.")
    noise: NoiseModel | None = Field(None, description="Of `sim:`: the same as options of the source's text.")
    intrinsics: IntrinsicsModel | None = Field(None, description="If the source does not know its own.")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.source is None) == (self.device is None):
            raise ValueError("give either source or device")
        if self.frames is not None and self.seconds is not None:
            raise ValueError("frames and seconds both say how long to capture; give one of them")
        if not (self.record or self.reconstruct):
            raise ValueError("neither record nor reconstruct: nothing would be left of the capture")
        return self


class CaptureChange(In):
    """What can be changed of a capture; fields that are not given stay."""

    model_config = example(name="desk, second try", keep=True, tags=["desk"], metadata={"robot.run": "17"})

    name: Name | None = None
    notes: Notes | None = None
    keep: StrictBool | None = Field(None, description="Retention leaves it alone.")
    tags: Tags | None = None
    metadata: Metadata | None = None


class SensorOut(Out):
    """The camera of a capture."""

    width: int
    height: int
    frame_rate_hz: float
    intrinsics: IntrinsicsModel | None
    mosaic: Mosaic | None = Field(description="Colour pattern of the upright image; null for a grey camera.")

    @classmethod
    def of(cls, sensor: Sensor | None) -> "SensorOut | None":
        """As it is shown."""
        if sensor is None:
            return None
        return cls(
            width=sensor.width,
            height=sensor.height,
            frame_rate_hz=sensor.frame_rate_hz,
            intrinsics=IntrinsicsModel.of(sensor.intrinsics),
            mosaic=sensor.mosaic,
        )


class VerdictOut(Out):
    """What a recording is good for."""

    grade: Grade
    reasons: list[str] = Field(description="Why it is not good, the worst first.")

    @classmethod
    def of(cls, verdict: Quality | None) -> "VerdictOut | None":
        """As it is shown."""
        return None if verdict is None else cls(grade=verdict.grade, reasons=list(verdict.reasons))


class RecordingOut(Out):
    """What lies on disk of a capture."""

    bytes: int
    frames: int
    first_frame: int = Field(description="Index in the capture of the first frame recorded.")
    lost: int = Field(description="Frames missing between its first and the end of the capture.")
    lost_by_cause: dict[str, int] = Field(
        description="By cause: device, usb, ring; disk, which took what had come too slowly or not at all."
    )
    sha256: str | None

    @classmethod
    def of(cls, recorded: Recorded | None) -> "RecordingOut | None":
        """As it is shown."""
        return None if recorded is None else cls(**vars(recorded))


class CaptureOut(Out):
    """A capture: frames of a camera from here or elsewhere, recorded, reconstructed, or both."""

    model_config = ConfigDict(
        json_schema_serialization_defaults_required=True,
        json_schema_extra={
            "examples": [
                {
                    "id": ID_EXAMPLE,
                    "name": "desk, by hand",
                    "notes": "",
                    "keep": False,
                    "tags": ["desk"],
                    "metadata": {"robot.run": "17"},
                    "origin": "live",
                    "source": "sim:?seed=1&pace=0",
                    "state": "complete",
                    "reason": "",
                    "warnings": [],
                    "verdict": {"grade": "good", "reasons": []},
                    "started_at": "2026-11-21T07:10:00.123456Z",
                    "ended_at": "2026-11-21T07:10:31.654321Z",
                    "deleted_at": None,
                    "frames_planned": 1280,
                    "recording": {
                        "bytes": 16000000,
                        "frames": 1280,
                        "first_frame": 0,
                        "lost": 0,
                        "lost_by_cause": {},
                        "sha256": None,
                    },
                    "reconstruction_ids": ["01928f5c-7e2a-7c3d-8a41-0f6d2b9c5e11"],
                    "reconstruction_count": 1,
                    "counters": None,
                    "sensor": {
                        "width": 400,
                        "height": 250,
                        "frame_rate_hz": 20000.0,
                        "intrinsics": {"fx": 346.4, "fy": 346.4, "cx": 200.0, "cy": 125.0},
                        "mosaic": None,
                    },
                }
            ]
        },
    )

    id: Id
    name: str
    notes: str
    keep: bool = Field(description="Retention leaves it alone.")
    tags: list[str] = Field(description="Words to find it by.")
    metadata: dict[str, str] = Field(description="Values of other programs by key.")
    origin: Origin = Field(
        description="live: captured here; upload: a recording from elsewhere; recovered: found in the data folder, its "
        "row rebuilt from its files."
    )
    source: str
    state: CaptureState
    reason: str = Field(
        description="Why, if the capture has failed or is about to; or what it waits for, while no frame comes."
    )
    warnings: list[str]
    verdict: VerdictOut | None = Field(description="Null until the recording is closed.")
    started_at: datetime
    ended_at: datetime | None
    deleted_at: datetime | None = Field(description="Not null: removed; `:restore` brings it back.")
    frames_planned: int | None = Field(description="Length of the capture if it is known.")
    recording: RecordingOut | None
    reconstruction_ids: list[str] = Field(
        description="The newest 100, the oldest of these first; `GET reconstructions?capture_id=` lists all."
    )
    reconstruction_count: int = Field(description="Number of all its reconstructions.")
    counters: CountersOut | None
    sensor: SensorOut | None = Field(description="Null until the source is open.")
    group: str | None = Field(None, description="Id of the group of captures that were started together.")
    ring: str | None = Field(
        None,
        description="Name of the shared memory with the newest frames, for programs on the service's machine; null "
        "when the capture does not run.",
    )

    @classmethod
    def of(cls, snapshot: Snapshot) -> "CaptureOut":
        """All that is known."""
        row = snapshot.row
        return cls(
            id=row.id,
            name=row.name,
            notes=row.notes,
            keep=row.keep,
            tags=list(row.tags),
            metadata=row.metadata,
            origin=row.origin,
            source=row.source,
            state=row.state,
            reason=snapshot.reason,
            warnings=list(row.warnings),
            verdict=VerdictOut.of(row.verdict),
            started_at=row.started_at,
            ended_at=row.ended_at,
            deleted_at=row.deleted_at,
            frames_planned=row.frames_planned,
            recording=RecordingOut.of(row.recording),
            reconstruction_ids=list(snapshot.jobs.ids),
            reconstruction_count=snapshot.jobs.total,
            counters=CountersOut.of(snapshot.counters),
            sensor=SensorOut.of(row.sensor),
            group=row.group,
            ring=snapshot.ring,
        )


class CapturePage(PageOut[CaptureOut]):
    """Captures, newest first or in the order that was asked for."""

    total: int = Field(description="Captures on all pages.")


class RateHistogram(Out):
    """How many pixels fire how often."""

    edges: list[float] = Field(description="Spikes a frame; one more than counts.")
    counts: list[int]

    @classmethod
    def of(cls, counts: list[int]) -> "RateHistogram":
        """Equal bins from 0 to 1."""
        return cls(edges=[k / len(counts) for k in range(len(counts) + 1)], counts=counts)


class StatsOut(Out):
    """Statistics of a few frames, over all pixels or those of a region."""

    frame: int = Field(description="Absolute index of the middle one.")
    frames: int = Field(description="Number of frames in which spikes were counted.")
    rate_histogram: RateHistogram
    hot_pixels: list[tuple[int, int]] = Field(description="x, y in the upright image.")
    mean_rate: float = Field(description="Spikes a pixel and frame.")
    deviation: float = Field(description="Standard deviation of the rates of the pixels.")

    @classmethod
    def of(cls, found: RateStatistics) -> "StatsOut":
        """As it is shown."""
        return cls(
            frame=found.frame,
            frames=found.frames,
            rate_histogram=RateHistogram.of(found.rate_histogram),
            hot_pixels=found.hot_pixels,
            mean_rate=found.mean_rate,
            deviation=found.deviation,
        )


class SpikesOut(Out):
    """When a pixel fired."""

    first_frame: int = Field(description="Absolute index of the first frame that was looked at.")
    frames: int = Field(description="Number of recorded frames that were looked at.")
    spikes: list[int] = Field(description="Absolute indices of the frames in which it fired.")
