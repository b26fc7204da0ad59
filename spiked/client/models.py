"""What goes over HTTP: made from the OpenAPI description, see tests/client."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, StringConstraints


class ArmRequest(BaseModel):
    """
    Keep a device's newest frames at hand.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    pretrigger_s: Annotated[
        float,
        Field(description="How far back a capture shall be able to begin, seconds."),
    ] = 1.0


class BaselineScaleRequest(BaseModel):
    """
    The distance of two cameras of a rig, whose paths are in one map.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    revision: Annotated[int, Field(description="The one that this replaces; 409 if it is not.")]
    baseline_m: Annotated[float, Field(description="Distance of the cameras.")]
    path: Annotated[
        int,
        Field(description="Path of the second camera, see GET paths; the first has path 0."),
    ] = 1
    offset_s: Annotated[
        float | None,
        Field(
            description="Seconds by which the second recording began later. Default: by the clocks of both recordings, as `groups/ID` says it."
        ),
    ] = None


class BitOrder(StrEnum):
    """
    Which bit of a byte is the leftmost of its eight pixels.
    """

    lsb = "lsb"
    msb = "msb"


class BoardScaleRequest(BaseModel):
    """
    A ChArUco board of known size.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    revision: Annotated[int, Field(description="The one that this replaces; 409 if it is not.")]
    board: Annotated[str, Field(description="Squares of the board, COLUMNSxROWS.")]
    square_m: Annotated[float, Field(description="Side of a square.")]
    dictionary: Annotated[str, Field(description="Markers of the board: one of OpenCV's sets.")] = "4x4_100"


class BoxModel(BaseModel):
    """
    A box along the axes of the scene, in its unit.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    low: list[float]
    high: list[float]


class CalibrationOut(BaseModel):
    """
    Figures of a calibration.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    gain_spread: Annotated[
        float,
        Field(description="Standard deviation of the logarithm of good pixels' gains."),
    ]
    dark_rate: Annotated[
        float,
        Field(description="Spikes a frame without light, median over the pixels."),
    ]
    useless: Annotated[int, Field(description="Pixels that are left out: dead, stuck or hot.")]
    pixels: Annotated[int, Field(description="Of the sensor.")]


class CalibrationPicture(StrEnum):
    """
    What a picture of a calibration shows.
    """

    gain = "gain"
    dark = "dark"
    useless = "useless"


class CalibrationRequest(BaseModel):
    """
    The captures to calibrate a camera by: one of them or both.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    dark: Annotated[
        str | None,
        Field(description="Capture with the lens covered: dark rates and hot pixels."),
    ] = None
    flat: Annotated[
        str | None,
        Field(description="Capture of an even light: gains and dead pixels."),
    ] = None


class CameraModel(BaseModel):
    """
    Where a camera is, camera to world, OpenCV axes: c2w, or position and quaternion_wxyz, or frame.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    c2w: Annotated[list[list[float]] | None, Field(description="4x4, rows.")] = None
    position: list[float] | None = None
    quaternion_wxyz: Annotated[list[float] | None, Field(description="Of any length but zero.")] = None
    frame: Annotated[int | None, Field(description="As the reconstructed camera was at this frame.")] = None


class CapabilityOut(BaseModel):
    """
    Something that cameras differ in.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    supported: bool
    value: Any


class CaptureChange(BaseModel):
    """
    What can be changed of a capture; fields that are not given stay.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: str | None = None
    notes: str | None = None
    keep: Annotated[bool | None, Field(description="Retention leaves it alone.")] = None
    tags: list[str] | None = None
    metadata: dict[Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_.:/-]{1,64}$")], str] | None = None


class CaptureSort(StrEnum):
    """
    By what captures are listed.
    """

    started = "started"
    name = "name"
    length = "length"
    size = "size"
    verdict = "verdict"
    reconstruction = "reconstruction"


class CaptureState(StrEnum):
    """
    State of a capture.
    """

    starting = "starting"
    waiting = "waiting"
    streaming = "streaming"
    finishing = "finishing"
    complete = "complete"
    failed = "failed"


class ClockPair(BaseModel):
    """
    Host time at which a frame had arrived whole, Unix time in ns.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    frame: int
    unix_ns: int


class ClosureOut(BaseModel):
    """
    A closed loop: the camera sees at the later time what it saw at the earlier one; seconds since the start.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    earlier_s: float
    later_s: float


class DeviceState(StrEnum):
    """
    State of a capture's camera: absent -> idle -> armed -> streaming -> lost -> absent.
    """

    absent = "absent"
    idle = "idle"
    armed = "armed"
    streaming = "streaming"
    lost = "lost"


class DiskOut(BaseModel):
    """
    The disk below the data folder.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    free_bytes: int
    total_bytes: int
    recording_s: Annotated[
        float,
        Field(
            description="How long a recording there is room for, of the cameras that run at the rates that they state, or of a USB camera if none runs; `GET doctor` says the same."
        ),
    ]
    recording_of: Annotated[str, Field(description="These cameras.")]


class EditedOut(BaseModel):
    """
    The version that was published, and what was done.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    version: int
    splats: int
    outside: Annotated[int, Field(description="Splats that lay outside the box.")]
    outlined: Annotated[int, Field(description="Splats that lay inside the outline.")]
    floaters: Annotated[int, Field(description="Splats that were removed as floaters.")]
    split: Annotated[
        int,
        Field(description="Splats larger than a quarter of the scene that were replaced by several."),
    ]
    shrunk: Annotated[
        int,
        Field(description="Splats so large that were made smaller: no view sees them."),
    ]
    large: Annotated[
        int,
        Field(description="Splats that stay so large: as several they would be too many."),
    ]


class ExportFormatOut(BaseModel):
    """
    A format that results are exported in.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: str
    title: Annotated[str, Field(description="What is written.")]
    readers: Annotated[str, Field(description="Programs that read it.")]
    loses: Annotated[str, Field(description="What of the reconstruction is not in it.")]
    suffix: Annotated[str, Field(description="Of the file that is sent.")]
    missing: Annotated[
        str,
        Field(description="How to install what the format needs; empty if nothing is missing."),
    ]


class ExportFormatsOut(BaseModel):
    """
    All formats, in the order in which they are listed.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    formats: list[ExportFormatOut]


class FisheyeLens(BaseModel):
    """
    Distortion by OpenCV's fisheye model.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    model: Literal["fisheye"] = "fisheye"
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0


class Form(StrEnum):
    """
    How frames are stored in a file.
    """

    compact = "compact"
    row_tagged = "row_tagged"
    usb = "usb"
    pcie = "pcie"
    array = "array"
    bits = "bits"


class FoundTagOut(BaseModel):
    """
    A tag in the scene.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    tag: int
    views: int
    side: Annotated[float, Field(description="In the unit of the scene.")]
    sigma: Annotated[float, Field(description="Relative standard deviation.")]
    corners: Annotated[list[list[float]], Field(description="In the scene, [4, 3].")]


class FrameRangeOut(BaseModel):
    """
    Frames `first` to `first + count - 1`, by absolute index.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    first: int
    count: int


class Gap(BaseModel):
    """
    Frames of the capture that are missing from the file.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    first: int
    count: int
    cause: str


class GapOut(BaseModel):
    """
    Frames that are missing.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    first: int
    count: int
    cause: str


class Grade(StrEnum):
    """
    Quality of a recording, as `spiked verify` prints it.
    """

    good = "good"
    degraded = "degraded"
    bad = "bad"


class ImageFormat(StrEnum):
    """
    What a picture is encoded as: 8 bits a channel, a value divided by the white given and clipped, or floats.
    """

    png = "png"
    webp = "webp"
    jpeg = "jpeg"
    exr = "exr"


class Initialisation(StrEnum):
    """
    How the path begins.
    """

    tracks = "tracks"
    progressive = "progressive"


class JobState(StrEnum):
    """
    State of a reconstruction.
    """

    queued = "queued"
    running = "running"
    complete = "complete"
    cancelled = "cancelled"
    failed = "failed"


class Layout(StrEnum):
    """
    How one frame's bits are stored.
    """

    compact = "compact"
    row_tagged = "row_tagged"


class LocalisedViewOut(BaseModel):
    """
    Where the camera was in one window of frames, in the frame of reference and the unit of the map.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    frame: Annotated[int, Field(description="In the middle of the window.")]
    time_s: float
    rotation: Annotated[list[list[float]], Field(description="Camera to world, [3, 3].")]
    position: list[float]
    inliers: Annotated[int, Field(description="Points of the map that agree within 1.5 px.")]
    inlier_share: Annotated[float, Field(description="Of those in view.")]
    correlation: Annotated[
        float,
        Field(description="Of the details of the image with those of the map rendered there."),
    ]
    sigma: Annotated[float, Field(description="Predicted standard deviation of the position.")]
    sigma_px: Annotated[float, Field(description="The same in the image.")]


class LossName(StrEnum):
    """
    The losses that a map can be fitted with (docs/paper.md).
    """

    charge = "charge"
    accumulation = "accumulation"
    interval = "interval"
    binomial = "binomial"
    accumulation_binomial = "accumulation+binomial"


class MapRefOut(BaseModel):
    """
    A version of a reconstruction that is used as a map.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    reconstruction_id: str
    version: int


class MergeRequest(BaseModel):
    """
    Another reconstruction of the same place, to be merged with the one of the path.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    other: Annotated[str, Field(description="A finished reconstruction.")]
    seed: Annotated[int, Field(description="Of all random choices.")] = 0
    threads: Annotated[int | None, Field(description="All cores if not given.")] = None
    priority: Annotated[int, Field(description="Higher ones run earlier; live captures go before all.")] = 0


class MethodName(StrEnum):
    """
    The names of `METHODS`.
    """

    spiked = "spiked"
    nope_sgs = "nope-sgs"


class Mosaic(StrEnum):
    """
    Colour of the sites (0,0) (0,1) (1,0) (1,1) of the upright image, row-major.
    """

    RGGB = "RGGB"
    BGGR = "BGGR"
    GRBG = "GRBG"
    GBRG = "GBRG"


class MosaicChoice(StrEnum):
    """
    A mosaic, or detection from the pixels.
    """

    auto = "auto"
    RGGB = "RGGB"
    BGGR = "BGGR"
    GRBG = "GRBG"
    GBRG = "GBRG"


class NoiseModel(BaseModel):
    """
    Noise, defects and light of the simulated camera `sim:`; it wins over the options of the source's text.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    electrons_a_spike: Annotated[
        float,
        Field(
            description="Photo-electrons of one spike; shot noise is normal with the variance of a Poisson law (Eq 13, 14)."
        ),
    ] = 4000.0
    temperature_k: Annotated[
        float,
        Field(
            description="Absolute temperature in kelvin, of the thermal noise of a reset, sqrt(k T / C) (Eq 16); dark current is apart."
        ),
    ] = 300.0
    swing_v: Annotated[
        float,
        Field(
            description="Voltage of the threshold in volts, Vp - Vref (Eq 15); with the electrons it gives the capacitance C of Eq 16."
        ),
    ] = 1.0
    reset_noise: Annotated[
        float | None,
        Field(
            description="Standard deviation of the reset voltage as a share of the threshold, instead of what Eq 16 gives."
        ),
    ] = None
    threshold_jitter: Annotated[
        float,
        Field(
            description="Noise of the comparator: standard deviation of the threshold at each spike, as a share of it."
        ),
    ] = 0.00967
    dark: Annotated[float, Field(description="Mean dark current in spikes a frame (Eq 17).")] = 0.002
    dark_spread: Annotated[
        float,
        Field(description="Standard deviation of the dark current over the pixels, in spikes a frame (Eq 17)."),
    ] = 0.0002
    capacitance_mismatch: Annotated[
        float,
        Field(
            description="Standard deviation of the pixels' capacitance, as a share: fixed pattern of the threshold (Eq 18)."
        ),
    ] = 0.016
    reset_bias: Annotated[
        float,
        Field(
            description="Half width of the uniform distribution of the pixels' reset voltage, as a share of the swing (after Eq 18)."
        ),
    ] = 0.0208
    hot_share: Annotated[float, Field(description="Share of the pixels that are hot.")] = 0.0
    hot_rate: Annotated[
        float,
        Field(description="Extra dark current of a hot pixel, in spikes a frame."),
    ] = 0.2
    dead_share: Annotated[float, Field(description="Share of the pixels that never fire.")] = 0.0
    flicker: Annotated[
        float,
        Field(description="Depth of the light's flicker: amplitude as a share of the mean."),
    ] = 0.0
    flicker_hz: Annotated[
        float,
        Field(description="Frequency of the flicker in Hz; lamps have twice that of the mains."),
    ] = 100.0


class OffsetOut(BaseModel):
    """
    When the frames of a capture came, by the clock of the machine.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    capture_id: Annotated[str, Field(description="UUID version 7: ids sort by time.")]
    offset_s: Annotated[
        float | None,
        Field(
            description="From the first recorded frame of the group's first capture to its own; negative if it began earlier. Null if it is not known."
        ),
    ]
    sigma_s: Annotated[
        float | None,
        Field(
            description="Standard deviation, from the jitter of the clock pairs; null with fewer than 4 of a recording. Delays that all pairs of a recording share are not in it: on a busy machine the error was up to 8 times larger."
        ),
    ]
    reason: Annotated[str, Field(description="Why the offset is not known.")]


class OpencvLens(BaseModel):
    """
    Distortion by OpenCV's polynomial: radial k1, k2, k3 and tangential p1, p2.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    model: Literal["opencv"] = "opencv"
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


class Origin(StrEnum):
    """
    Where a recording comes from.
    """

    live = "live"
    upload = "upload"
    recovered = "recovered"


class OutlineModel(BaseModel):
    """
    An outline drawn over a view, and where that was seen from: c2w, or position and quaternion_wxyz.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    corners: Annotated[
        list[list[float]],
        Field(description="x/z and y/z in the camera's OpenCV axes, in order."),
    ]
    camera: Annotated[CameraModel, Field(description="A frame cannot be given here.")]


class Output(StrEnum):
    """
    What a view shows.
    """

    color = "color"
    depth = "depth"
    alpha = "alpha"


class PathModel(BaseModel):
    """
    Cameras along the reconstructed path, evenly in time.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    count: int
    from_s: Annotated[float | None, Field(description="From its beginning if not given.")] = None
    to_s: Annotated[float | None, Field(description="To its end if not given.")] = None


class PathOut(BaseModel):
    """
    The path of one recording through the scene of a version.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    path: Annotated[
        int,
        Field(description="To be given as `path` of the trajectory; 0 is that of the reconstruction's capture."),
    ]
    capture_id: Annotated[str, Field(description="Its capture, which may have been removed since.")]
    poses: int


class PathsOut(BaseModel):
    """
    The paths of a version, more than one if its map is of several recordings.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    version: int
    items: list[PathOut]


class PictureKind(StrEnum):
    """
    What a picture shows.
    """

    interval = "interval"
    rate = "rate"
    accumulation = "accumulation"
    render = "render"


class Pinhole(BaseModel):
    """
    A pinhole camera behind a lens; pixels, the centre of the first pixel is (0.5, 0.5).
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Annotated[
        OpencvLens | FisheyeLens | None,
        Field(description="Of the lens, as OpenCV has it; null: none."),
    ] = None


class PointOut(BaseModel):
    """
    What a scene has at a pixel of a frame.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    version: Annotated[int, Field(description="Of the scene.")]
    frame: Annotated[int, Field(description="Whose pose it is seen from.")]
    opacity: Annotated[float, Field(description="How opaque the scene is there, 0 to 1.")]
    rate: Annotated[
        list[float],
        Field(description="Radiance in expected spikes a frame; red, green and blue of a colour scene."),
    ]
    depth: Annotated[
        float | None,
        Field(description="Along the camera's axis, in the scene's unit of length; null below an opacity of 0.5."),
    ]
    depth_m: Annotated[
        float | None,
        Field(description="The same in metres; null while the scale is not known."),
    ]
    depth_m_sigma: Annotated[
        float | None,
        Field(description="Standard deviation of depth_m by that of the scale alone; null: not known."),
    ]
    position: Annotated[
        list[float] | None,
        Field(description="Of the surface, in the axes of the scene; null as depth."),
    ]


class Policy(StrEnum):
    """
    How a reader is treated when it falls behind. The writer waits for none.
    """

    lossless = "lossless"
    priority = "priority"
    latest = "latest"


class PoseStepName(StrEnum):
    """
    What corrects the poses while the map is fitted.
    """

    alignment = "alignment"
    gradient = "gradient"
    difference = "difference"


class Problem(BaseModel):
    """
    RFC 9457 problem details.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    type: Annotated[str, Field(description="urn:spiked:problem: followed by the kind of problem.")]
    title: str
    status: int
    detail: Annotated[str, Field(description="What is wrong, in one or more sentences.")]
    instance: Annotated[str | None, Field(description="Path of the request.")]
    what_to_do: Annotated[str | None, Field(description="How to correct it, if known.")]


class Session(StrEnum):
    """
    How the bridge of a USB camera is made to send.
    """

    auto = "auto"
    request = "request"
    stream = "stream"


class RateHistogram(BaseModel):
    """
    How many pixels fire how often.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    edges: Annotated[list[float], Field(description="Spikes a frame; one more than counts.")]
    counts: list[int]


class ReconstructionChange(BaseModel):
    """
    What can be changed of a reconstruction; fields that are not given stay.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: str | None = None
    notes: str | None = None
    held: Annotated[
        bool | None,
        Field(description="Whether it stays in the queue; one that runs returns there, unless it follows its capture."),
    ] = None
    queue_place: Annotated[
        int | None,
        Field(
            description="Its new place in the queue, 1 is the next; beyond the end: the last. Only while it waits there. It takes the priority of the one that has this place."
        ),
    ] = None


class RecordingOut(BaseModel):
    """
    What lies on disk of a capture.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    bytes: int
    frames: int
    first_frame: Annotated[int, Field(description="Index in the capture of the first frame recorded.")]
    lost: Annotated[
        int,
        Field(description="Frames missing between its first and the end of the capture."),
    ]
    lost_by_cause: Annotated[
        dict[str, int],
        Field(description="By cause: device, usb, ring; disk, which took what had come too slowly or not at all."),
    ]
    sha256: str | None


class ReloadedOut(BaseModel):
    """
    Result of a reload.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    changed: Annotated[list[str], Field(description="Settings whose new value is in effect.")]
    needs_restart: Annotated[
        list[str],
        Field(description="Settings whose new value takes effect after a restart."),
    ]


class Response(StrEnum):
    """
    How light becomes spikes.
    """

    integrate_and_fire = "integrate-and-fire"
    bernoulli = "bernoulli"


class RevertRequest(BaseModel):
    """
    An earlier version to go back to.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    version: Annotated[
        int,
        Field(description="The newest version, which is edited; 409 if there is another."),
    ]
    to: Annotated[int, Field(description="A version that is kept; `GET versions` lists them.")]


class ScaleRequest(BaseModel):
    """
    What is measured; what is left out stays as it is.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    revision: Annotated[int, Field(description="The one that this replaces; 409 if it is not.")]
    version: Annotated[
        int | None,
        Field(description="Version that it was measured in; 409 for one of an earlier run. Default: the newest."),
    ] = None
    metres_per_unit: float | None = None
    sigma: Annotated[float | None, Field(description="Relative standard deviation, if known.")] = None
    up: Annotated[list[float] | None, Field(description="Of any length but zero.")] = None


class ScaleSource(StrEnum):
    """
    What a scale rests on.
    """

    length = "length"
    tag = "tag"
    board = "board"
    baseline = "baseline"


class SceneFormat(StrEnum):
    """
    How a scene is written.
    """

    ply = "ply"
    spz = "spz"


class Scope(StrEnum):
    """
    What a token may do; each includes those before it.
    """

    read = "read"
    operate = "operate"
    admin = "admin"


class SettingOrigin(StrEnum):
    """
    Where a value comes from; later ones prevail.
    """

    default = "default"
    file = "file"
    environment = "environment"
    flag = "flag"


class SettingOut(BaseModel):
    """
    One setting; secrets are masked.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    key: str
    value: Any
    origin: SettingOrigin
    reloadable: Annotated[
        bool,
        Field(description="Whether `configuration:reload` brings a new value into effect."),
    ]
    editable: Annotated[
        bool,
        Field(description="Whether `PATCH configuration` changes it; others are changed in the file."),
    ]
    option: Annotated[
        dict[str, Any],
        Field(description="JSON Schema: type, limits, default, meaning."),
    ]
    doc: str


class SettingsChange(BaseModel):
    """
    New values of settings.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    values: Annotated[
        dict[str, bool | int | float | str | None],
        Field(
            description="By the names of `GET configuration`; null removes a setting from the file: its default.",
            max_length=64,
            min_length=1,
        ),
    ]


class SettingsOut(BaseModel):
    """
    All settings in effect.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    items: list[SettingOut]
    file: Annotated[str, Field(description="The file that `PATCH configuration` changes.")]
    needs_restart: Annotated[
        list[str],
        Field(description="Settings whose value in the file takes effect after a restart."),
    ]
    problem: Annotated[
        str | None,
        Field(description="Why the file as it is now cannot be loaded; null if it can be."),
    ]


class SimilarityOut(BaseModel):
    """
    x in the first map is scale * rotation * x in the other, plus translation.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    scale: float
    rotation: list[list[float]]
    translation: list[float]


class SourceKindOut(BaseModel):
    """
    A kind of source, and what can follow its question mark.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: str
    usage: Annotated[str, Field(description="How a source of this kind is written.")]
    summary: str
    is_camera: Annotated[bool, Field(description="Hardware: frames that are not read in time are lost.")]
    can_block: Annotated[
        bool,
        Field(description="With `pace=0` it waits for its consumers, so that no frame is lost."),
    ]
    takes_path: Annotated[bool, Field(description="A path on the service's machine follows the colon.")]
    options: Annotated[
        dict[str, Any],
        Field(description="JSON Schema of its options: types, limits, defaults and meaning."),
    ]


class SourceKindsOut(BaseModel):
    """
    All kinds of sources.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    items: list[SourceKindOut]


class SpikesOut(BaseModel):
    """
    When a pixel fired.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    first_frame: Annotated[int, Field(description="Absolute index of the first frame that was looked at.")]
    frames: Annotated[int, Field(description="Number of recorded frames that were looked at.")]
    spikes: Annotated[
        list[int],
        Field(description="Absolute indices of the frames in which it fired."),
    ]


class Stage(StrEnum):
    """
    The phase of a reconstruction.
    """

    waiting = "waiting"
    tracking = "tracking"
    mapping = "mapping"
    refining = "refining"
    joining = "joining"
    done = "done"


class State(StrEnum):
    """
    State of the tracker.
    """

    boot = "boot"
    track = "track"
    degraded = "degraded"
    lost = "lost"
    reloc = "reloc"


class StatsOut(BaseModel):
    """
    Statistics of a few frames, over all pixels or those of a region.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    frame: Annotated[int, Field(description="Absolute index of the middle one.")]
    frames: Annotated[int, Field(description="Number of frames in which spikes were counted.")]
    rate_histogram: RateHistogram
    hot_pixels: Annotated[list[list[int]], Field(description="x, y in the upright image.")]
    mean_rate: Annotated[float, Field(description="Spikes a pixel and frame.")]
    deviation: Annotated[float, Field(description="Standard deviation of the rates of the pixels.")]


class Status(StrEnum):
    """
    How bad it is.
    """

    ok = "ok"
    warning = "warning"
    problem = "problem"


class TagScaleRequest(BaseModel):
    """
    AprilTags of known size.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    revision: Annotated[int, Field(description="The one that this replaces; 409 if it is not.")]
    side_m: Annotated[float, Field(description="Side of the black square.")]
    family: Annotated[str, Field(description="16h5, 25h9, 36h10 or 36h11.")] = "36h11"


class Task(StrEnum):
    """
    What a job in the queue of reconstructions does.
    """

    reconstruct = "reconstruct"
    extend = "extend"
    merge = "merge"
    localise = "localise"


class TokenOut(BaseModel):
    """
    A token, without its secret.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: str
    created_at: AwareDatetime
    expires_at: AwareDatetime | None
    scope: Annotated[
        Scope,
        Field(description="read: look and download; operate: change captures, too; admin: set-up, too."),
    ]
    created_by: Annotated[
        str | None,
        Field(description="The token that it was created with; null: by `spiked token`."),
    ]


class TokenRequest(BaseModel):
    """
    A token to be made.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: Annotated[str, Field(description="Of its user or device.")]
    scope: Scope
    days: Annotated[
        float | None,
        Field(description="Until it expires; null: when the token of this request does, if that expires."),
    ] = None


class TokensOut(BaseModel):
    """
    All tokens, oldest first.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    items: list[TokenOut]


class TrajectoryFormat(StrEnum):
    """
    How a trajectory is written.
    """

    json = "json"
    tum = "tum"
    kitti = "kitti"
    colmap = "colmap"
    nerfstudio = "nerfstudio"


class TrajectoryOut(BaseModel):
    """
    Camera-to-world poses, OpenCV axes; one for each frame that has one, arrays of the same length.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    version: int
    frames: Annotated[list[int], Field(description="Absolute frame indices.")]
    times_s: Annotated[
        list[float],
        Field(description="Middle of each frame, seconds since the start of the capture."),
    ]
    positions: Annotated[list[list[float]], Field(description="[n, 3], length unit of the scene.")]
    quaternions_wxyz: Annotated[list[list[float]], Field(description="[n, 4]")]
    states: Annotated[
        list[State | None],
        Field(description="State of the tracking then; null where it is not known."),
    ]


class UpRequest(BaseModel):
    """
    What up is found by: gravity at a frame, points of the floor, or neither: the floor is found.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    revision: Annotated[int, Field(description="The one that this replaces; 409 if it is not.")]
    gravity: Annotated[
        list[float] | None,
        Field(description="In the axes of the camera: x right, y down, z forward."),
    ] = None
    frame: Annotated[
        int | None,
        Field(description="Of gravity: the pose nearest to it is used. Default: the first."),
    ] = None
    points: Annotated[list[list[float]] | None, Field(description="Of the floor, in the scene.")] = None


class UploadOut(BaseModel):
    """
    How far an upload is.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    id: Annotated[str, Field(description="UUID version 7: ids sort by time.")]
    name: str
    bytes: Annotated[int, Field(description="What it will be.")]
    offset_bytes: Annotated[int, Field(description="What has come; the next chunk begins here.")]
    created_at: AwareDatetime
    capture_id: Annotated[str | None, Field(description="What it became.")]


class AssumedEnum(StrEnum):
    frame_rate = "frame_rate"
    flipped = "flipped"
    bit_order = "bit_order"


class UploadSidecar(BaseModel):
    """
    A recording's sidecar, as it stands beside the `.dat`.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    format: Layout
    width: int
    height: int
    frame_rate: float
    frames: int | None
    bit_order: BitOrder
    flipped: bool
    cfa: Mosaic | None = None
    intrinsics: Pinhole | None = None
    response: Response = Response.integrate_and_fire
    pixel_centre: float = 0.5
    note: str = ""
    first_frame: int = 0
    gaps: Annotated[list[Gap], Field(validate_default=True)] = []
    clock: Annotated[list[ClockPair], Field(validate_default=True)] = []
    calibration: str | None = None
    device: dict[str, Any] | None = None
    profile: dict[str, Any] | None = None
    assumed: list[AssumedEnum] = []


class UploadsOut(BaseModel):
    """
    Uploads that have not become captures, newest first.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    items: list[UploadOut]


class Verdict(StrEnum):
    """
    How a check ended.
    """

    ok = "ok"
    warning = "warning"
    failed = "failed"


class VerdictOut(BaseModel):
    """
    What a recording is good for.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    grade: Grade
    reasons: Annotated[list[str], Field(description="Why it is not good, the worst first.")]


class WorkOut(BaseModel):
    """
    The map over the seconds of work, after the last frame, too; arrays of the same length.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    work_s: list[float]
    loss: list[float]
    psnr_db: list[float | None]
    splats: list[int]


class ZmqOut(BaseModel):
    """
    Addresses of the ZeroMQ sockets, on this machine.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    events: Annotated[str, Field(description="PUB: all but pictures.")]
    state: Annotated[
        str,
        Field(description="REP: the newest message of each kind, or those after a number."),
    ]
    previews: Annotated[str, Field(description="PUB: pictures.")]


class CleanRequest(BaseModel):
    """
    What is removed.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    version: Annotated[
        int,
        Field(description="The newest version, which is edited; 409 if there is another."),
    ]
    box: Annotated[BoxModel | None, Field(description="Splats outside are removed.")] = None
    outline: Annotated[
        OutlineModel | None,
        Field(description="Splats inside are removed, however far behind it."),
    ] = None
    floaters: Annotated[bool, Field(description="Remove splats that few views see or that hang alone.")] = True
    split: Annotated[
        bool,
        Field(
            description="With floaters: also replace splats larger than a quarter of the scene by smaller ones that show the same."
        ),
    ] = True


class ConsumerOut(BaseModel):
    """
    One reader of the ring.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: str
    policy: Annotated[
        Policy,
        Field(description="latest skips frames by intention; the others want them all."),
    ]
    frames_read: Annotated[int, Field(description="Frames that it read intact.")]
    received: Annotated[int, Field(deprecated=True, description="Deprecated: use frames_read.")]
    lost: Annotated[
        int,
        Field(description="Frames that it did not read, of any cause; frames_read + lost is its next frame."),
    ]
    lag_frames: int
    fill: Annotated[
        float,
        Field(description="Its lag as a part of what it may lag; at 1 it loses frames."),
    ]
    lagging: bool


class CountersOut(BaseModel):
    """
    Frames of a capture, without those that an armed device had before it.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    device: DeviceState
    device_reason: str
    received: Annotated[int, Field(description="Frames written into the ring.")]
    lost: Annotated[dict[str, int], Field(description="By cause: device, usb, ring, disk.")]
    next_frame: Annotated[
        int,
        Field(
            description="Index of the next frame, as previews and poses count: that of the first frame, + received + lost. The first is 0 unless the device was armed."
        ),
    ]
    consumers: list[ConsumerOut]


class DeviceOut(BaseModel):
    """
    Something to capture from.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    id: Annotated[str, Field(description="Its name here; the same after a restart.")]
    kind: Annotated[str, Field(description="A name from `GET options/sources`.")]
    source: Annotated[str, Field(description="To be given as `source` of a capture.")]
    description: str
    state: DeviceState
    reason: Annotated[str, Field(description="Why it is absent or lost.")]
    warnings: Annotated[
        list[str],
        Field(description="What its capture, or it while armed, does without."),
    ]
    serial: str | None
    port: str | None
    speed: str | None
    firmware: str | None
    capabilities: dict[str, CapabilityOut]
    counters: CountersOut | None
    capture_id: Annotated[str | None, Field(description="The capture that uses it now.")]


class DevicesOut(BaseModel):
    """
    All devices.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    items: list[DeviceOut]


class DoctorItemOut(BaseModel):
    """
    Result of one check.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: str
    status: Status
    finding: str
    what_to_do: Annotated[str | None, Field(description="null where all is well.")]


class DoctorOut(BaseModel):
    """
    Results of all checks.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    items: list[DoctorItemOut]


class FindingOut(BaseModel):
    """
    Result of one check.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: str
    verdict: Verdict
    finding: str


class HealthOut(BaseModel):
    """
    Health of the service.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    status: Annotated[Verdict, Field(description="The worst of the checks.")]
    checks: list[FindingOut]


class IntrinsicsModel(BaseModel):
    """
    A pinhole camera behind a lens; pixels, the centre of the first pixel is (0.5, 0.5).
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Annotated[
        OpencvLens | FisheyeLens | None,
        Field(description="Of the lens, as OpenCV has it; null: none."),
    ] = None


class IntrinsicsOption(BaseModel):
    """
    A pinhole camera behind a lens; pixels, the centre of the first pixel is (0.5, 0.5).
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Annotated[
        OpencvLens | FisheyeLens | None,
        Field(description="Of the lens, as OpenCV has it; null: none."),
    ] = None


class LocalisationOut(BaseModel):
    """
    Where a camera was in a map, and how sure that is.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    recognised: bool
    reason: Annotated[str, Field(description="Why it was or was not recognised.")]
    searches: Annotated[int, Field(description="Views that were searched for in the whole map.")]
    agreeing: Annotated[int, Field(description="Searches that found the pose that the path has there.")]
    references: Annotated[int, Field(description="Reference views of the map.")]
    best_inliers: Annotated[int, Field(description="Most points that agreed with one pose in a search.")]
    views: Annotated[
        list[LocalisedViewOut],
        Field(description="In order of time; empty if the place was not recognised."),
    ]


class LocaliseRequest(BaseModel):
    """
    A recording to look for in the map of the reconstruction of the path.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    capture_id: str
    first_frame: Annotated[int, Field(description="First frame to use, absolute index.")] = 0
    frames: Annotated[
        int | None,
        Field(description="Number of frames to use; 1,000 suffice. Default: all."),
    ] = None
    intrinsics: Annotated[
        IntrinsicsModel | None,
        Field(description="Lens of the recording, if it does not state it. Default: that of the map."),
    ] = None
    threads: Annotated[int | None, Field(description="All cores if not given.")] = None
    priority: Annotated[int, Field(description="Higher ones run earlier; live captures go before all.")] = 0


class NewTokenOut(BaseModel):
    """
    A new token.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: str
    created_at: AwareDatetime
    expires_at: AwareDatetime | None
    scope: Annotated[
        Scope,
        Field(description="read: look and download; operate: change captures, too; admin: set-up, too."),
    ]
    created_by: Annotated[
        str | None,
        Field(description="The token that it was created with; null: by `spiked token`."),
    ]
    secret: Annotated[
        str,
        Field(description="The token itself, which is not shown again: only its hash is kept."),
    ]


class ProfileModel(BaseModel):
    """
    What is known of one camera; options of a source or request win over it.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    rate: Annotated[float | None, Field(description="Frames per second.")] = None
    mosaic: Annotated[
        Mosaic | None,
        Field(description="Colour mosaic of the upright image; none: a grey sensor."),
    ] = None
    flipped: Annotated[bool | None, Field(description="Rows come bottom-up; false: top-down.")] = None
    response: Annotated[
        Response | None,
        Field(
            description="How light becomes spikes: integrate-and-fire of spike cameras, or bernoulli of single-photon cameras."
        ),
    ] = None
    fov: Annotated[
        float | None,
        Field(
            description="Horizontal field of view in degrees of a pinhole camera with square pixels; without optics they are estimated."
        ),
    ] = None
    intrinsics: IntrinsicsModel | None = None
    model: Annotated[str, Field(description="Name of the product.")] = ""
    serial: Annotated[
        str | None,
        Field(description="Serial number of the camera that the profile is of; null: of any."),
    ] = None
    width: Annotated[int | None, Field(description="Pixels in a row.")] = None
    height: Annotated[int | None, Field(description="Rows.")] = None
    calibration: Annotated[
        str | None,
        Field(description="File of gains, dark rates and dead pixels, relative to the profile."),
    ] = None
    session: Annotated[
        Session | None,
        Field(description="How the bridge of a USB camera is made to send."),
    ] = None
    note: str = ""


class ProfileOut(BaseModel):
    """
    The profile of a device.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    file: Annotated[str, Field(description="Its file in the folder `profiles` of the data folder.")]
    profile: ProfileModel


class ReconstructionOptions(BaseModel):
    """
    A reconstruction's options; the defaults suit a hand-held camera.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    seconds: Annotated[
        float | None,
        Field(
            description="Time budget in seconds of work: reduces the steps, and at last the frames that are read; of a live reconstruction it is that of the refinement. Without it all steps are done."
        ),
    ] = None
    steps: Annotated[
        int,
        Field(description="Gradient steps of the refinement after the last frame; its time grows with them."),
    ] = 1600
    seed: Annotated[int, Field(description="Same input, options and seed: same result.")] = 0
    window_frames: Annotated[
        int | None,
        Field(description="Frames of a view; follows the motion (4 to 64) if not given."),
    ] = None
    threads: Annotated[
        int | None,
        Field(description="Threads of the rasteriser; all cores if not given."),
    ] = None
    max_views: Annotated[int, Field(description="Views kept for mapping; beyond it older ones thin out.")] = 400
    most_splats: Annotated[
        int,
        Field(
            description="Most splats of the map, which has no more than follow from the size of the picture. Ten times as many make a step about five times as long."
        ),
    ] = 250000
    memory_mb: Annotated[
        int,
        Field(description="MiB of images held in memory; the others are built anew from the recording."),
    ] = 512
    refine_poses: Annotated[bool, Field(description="Whether the map corrects the trajectory.")] = True
    method: Annotated[
        MethodName,
        Field(
            description="spiked, or nope-sgs: the method of 3D Gaussian Splatting from Unposed Spike Streams, to compare."
        ),
    ] = MethodName.spiked
    initialisation: Annotated[
        Initialisation | None,
        Field(description="How the path begins; as in the method if not given."),
    ] = None
    pose_step: Annotated[
        PoseStepName | None,
        Field(description="What corrects the poses while the map is fitted; as in the method if not given."),
    ] = None
    loss: Annotated[
        LossName | None,
        Field(description="What the map is fitted to; as in the method if not given."),
    ] = None
    intrinsics: Annotated[
        IntrinsicsOption | None,
        Field(description="Optics, where neither the capture nor its recording says them, or to overrule them."),
    ] = None
    fov: Annotated[
        float | None,
        Field(
            description="The same as a horizontal field of view in degrees of square pixels; a distortion that is known stays. Without any optics they are estimated."
        ),
    ] = None
    mosaic: Annotated[
        MosaicChoice | None,
        Field(
            description="Colour mosaic of the upright image, where the recording states another or none; auto: detect it from the pixels of the recording."
        ),
    ] = None
    flipped: Annotated[
        bool | None,
        Field(description="Rows come bottom-up; false: top-down; as the recording states if not given."),
    ] = None


class ReconstructionOut(BaseModel):
    """
    A job: a reconstruction, live from a capture or from its recording, an extended or merged map, a localisation.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    id: Annotated[str, Field(description="UUID version 7: ids sort by time.")]
    name: str
    notes: str
    capture_id: Annotated[
        str,
        Field(description="The capture that its trajectory belongs to; of a merge that of the first map."),
    ]
    task: Annotated[
        Task,
        Field(description="A localisation has the scene of the map, and the path of the recording in it."),
    ]
    maps: Annotated[
        list[MapRefOut],
        Field(description="What it uses; the result is in the frame of reference of the first."),
    ]
    recognised: Annotated[
        bool | None,
        Field(
            description="Whether all show one place; null before that is known, and without maps. If false and the task is `extend`, the versions show the recording alone, in a frame of reference of their own."
        ),
    ]
    part: Annotated[FrameRangeOut | None, Field(description="Frames that are localised; null: all.")]
    live: bool
    state: JobState
    node: Annotated[
        str,
        Field(description="The machine that runs it or ran it last; empty: that of the service."),
    ]
    stage: Stage
    progress: Annotated[float, Field(description="0 to 1.")]
    tracking_state: State
    reason: Annotated[
        str,
        Field(description="Why it failed, waits or tracks badly; empty while all is well."),
    ]
    warnings: Annotated[
        list[str],
        Field(description="What it found out about the camera, or had to assume."),
    ]
    priority: int
    user: Annotated[
        str,
        Field(description="Name of the token with which it was queued; empty if none was needed."),
    ]
    options: ReconstructionOptions
    poses_from: Annotated[
        str,
        Field(description="Given poses: the id of their reconstruction, or `file`; empty: estimated."),
    ]
    calibration_from: Annotated[
        str,
        Field(description="Device of its calibration; empty: that of the recording, if any."),
    ]
    created_at: AwareDatetime
    started_at: AwareDatetime | None
    ended_at: AwareDatetime | None
    frames: Annotated[int, Field(description="Frames taken so far.")]
    poses: Annotated[int, Field(description="Frames that have a pose in the published trajectory.")]
    splats: int
    loss: Annotated[
        float | None,
        Field(description="Mean squared error of the views, in units of white squared."),
    ]
    psnr_db: float | None
    version: Annotated[
        int,
        Field(description="Number of the newest published scene and trajectory; 0: none yet."),
    ]
    white: Annotated[
        float | None,
        Field(description="Radiance shown as white in that version, spikes a frame."),
    ]
    queue_place: Annotated[
        int | None,
        Field(description="1 is the next to begin; null unless it waits in the queue."),
    ]
    held: Annotated[bool, Field(description="Whether it stays in the queue until it is let go.")]
    eta_s: Annotated[
        float | None,
        Field(description="Seconds to its end, those before its turn included; null where that is not known."),
    ]


class ReconstructionPage(BaseModel):
    """
    Reconstructions, newest first, or the queue in its order.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    items: list[ReconstructionOut]
    next_cursor: Annotated[
        str | None,
        Field(description="To be given as `cursor` for those that follow; null: there are no more."),
    ]
    total: Annotated[
        int | None,
        Field(description="Reconstructions in the queue; null unless it is listed in its order."),
    ]


class ReconstructionRequest(BaseModel):
    """
    A recording to reconstruct.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    capture_id: str
    options: ReconstructionOptions | None = None
    priority: Annotated[int, Field(description="Higher ones run earlier; live captures go before all.")] = 0
    map: Annotated[
        str | None,
        Field(
            description="A finished reconstruction of the same place: its map is extended by the recording, and the result is in its frame of reference."
        ),
    ] = None
    poses: Annotated[
        str | None,
        Field(
            description="Known camera-to-world poses as the text of a TUM file, in seconds since the start of the capture: the map is fitted to them, and they are not changed. Poses between them are interpolated."
        ),
    ] = None
    poses_of: Annotated[
        str | None,
        Field(description="Another reconstruction of the capture, whose newest path is taken as known poses."),
    ] = None
    calibration_of: Annotated[
        str | None,
        Field(description="A device whose calibration corrects the rates, instead of that of the recording."),
    ] = None


class RegistrationOut(BaseModel):
    """
    How two maps, or a map and a recording, were brought together.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    joined: bool
    reason: Annotated[
        str,
        Field(description="Why they were not; empty if they were. Then there are figures."),
    ]
    similarity: SimilarityOut | None
    scale_range: Annotated[
        list[float] | None,
        Field(description="Smallest and largest scale along the second way."),
    ]
    scale_sigma: Annotated[
        float | None,
        Field(description="Predicted relative standard deviation of the scale."),
    ]
    turn_sigma_deg: float | None
    shift_sigma: float | None
    residual_px: Annotated[float | None, Field(description="Median distance of common points.")]
    searched: Annotated[
        int | None,
        Field(description="Views of the second that were searched for in the first."),
    ]
    recognised: Annotated[int | None, Field(description="Of these, views that were found.")]
    agreeing: Annotated[
        int | None,
        Field(description="Views that agree on how the two lie to each other."),
    ]
    views_alike: int | None
    views_different: int | None
    brightness: Annotated[
        float | None,
        Field(description="Radiance of the first over that of the second."),
    ]
    splats_kept: Annotated[list[int] | None, Field(description="Of the first and of the second.")]
    psnr_db: Annotated[
        list[float] | None,
        Field(description="How well the result shows what each of them showed."),
    ]


class RestartRequest(BaseModel):
    """
    Begin a reconstruction anew, with other options if they are given.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    options: ReconstructionOptions | None = None


class ScaleOut(BaseModel):
    """
    Metres for the unit of length of a scene, and the direction of up; null where it is not known.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    revision: Annotated[
        int,
        Field(description="Counts the changes; 0: nothing is known. A change names the one it replaces."),
    ]
    metres_per_unit: float | None
    sigma: Annotated[
        float | None,
        Field(description="Relative standard deviation of metres_per_unit; null: not known."),
    ]
    source: Annotated[
        ScaleSource | None,
        Field(description="What the scale rests on: a known length, AprilTags, a board, or two cameras."),
    ]
    up: Annotated[
        list[float] | None,
        Field(description="Direction in the scene, of length 1; null: -y is taken for up."),
    ]
    version: Annotated[int | None, Field(description="Version of the scene that it was measured in.")]
    since: Annotated[
        int,
        Field(
            description="Versions up to this one are of an earlier run, whose unit of length is another one: the scale is not theirs, and cannot be measured in them."
        ),
    ]


class SensorOut(BaseModel):
    """
    The camera of a capture.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    width: int
    height: int
    frame_rate_hz: float
    intrinsics: IntrinsicsModel | None
    mosaic: Annotated[
        Mosaic | None,
        Field(description="Colour pattern of the upright image; null for a grey camera."),
    ]


class StatedCameraModel(BaseModel):
    """
    What is stated of a camera; it wins over the options of the source, its profile and its sidecar.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    calibration: Annotated[
        str | None,
        Field(description="File of gains, dark rates and dead pixels, from `spiked calibrate`."),
    ] = None
    profile: Annotated[
        str | None,
        Field(description="Camera profile, a JSON file; options that are stated win over it."),
    ] = None
    rate: Annotated[float | None, Field(description="Frames per second.")] = None
    mosaic: Annotated[
        Mosaic | None,
        Field(description="Colour mosaic of the upright image; none: a grey sensor."),
    ] = None
    flipped: Annotated[bool | None, Field(description="Rows come bottom-up; false: top-down.")] = None
    response: Annotated[
        Response | None,
        Field(
            description="How light becomes spikes: integrate-and-fire of spike cameras, or bernoulli of single-photon cameras."
        ),
    ] = None
    fov: Annotated[
        float | None,
        Field(
            description="Horizontal field of view in degrees of a pinhole camera with square pixels; without optics they are estimated."
        ),
    ] = None
    intrinsics: IntrinsicsModel | None = None


class SystemOut(BaseModel):
    """
    The running service.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    version: str
    started_at: AwareDatetime
    uptime_s: float
    data_folder: str
    disk: DiskOut
    memory_bytes: Annotated[
        int,
        Field(description="Resident memory of the service itself, without its workers."),
    ]
    pid: int
    events_seq: Annotated[int, Field(description="Number of the newest event.")]
    event_clients: Annotated[
        int,
        Field(description="Clients of the events now, WebSocket and server-sent events."),
    ]
    zmq: Annotated[ZmqOut | None, Field(description="null where ZeroMQ is turned off.")]
    scope: Annotated[
        Scope,
        Field(description="Scope of the token of this request; admin where no token is required."),
    ]
    token_required: Annotated[
        bool,
        Field(description="Whether requests need a token. Where none is required, scopes limit nothing."),
    ]
    token_scope: Annotated[
        Scope | None,
        Field(
            description="Scope of the token that this request brings, whether one is required or not; null without one."
        ),
    ]


class TagScaleOut(BaseModel):
    """
    The scale by tags.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    scale: ScaleOut
    tags: list[FoundTagOut]


class TimelineOut(BaseModel):
    """
    How a reconstruction went, arrays of the same length; null where a value is not known.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    time_s: Annotated[list[float], Field(description="Since the start of the capture.")]
    frame: list[int]
    state: list[State]
    chi2: list[float | None]
    sigma_px: list[float | None]
    rate: Annotated[list[float | None], Field(description="Mean spikes a pixel and frame.")]
    loss: list[float | None]
    psnr_db: list[float | None]
    splats: list[int | None]
    work_s: Annotated[
        list[float | None],
        Field(description="Seconds of work when the view was tracked."),
    ]
    work: WorkOut
    gaps: list[GapOut]
    closures: Annotated[list[ClosureOut], Field(description="In the order in which they were closed.")]


class UploadProfile(BaseModel):
    """
    The profile of the camera that a recording is of.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    rate: Annotated[float | None, Field(description="Frames per second.")] = None
    mosaic: Annotated[
        Mosaic | None,
        Field(description="Colour mosaic of the upright image; none: a grey sensor."),
    ] = None
    flipped: Annotated[bool | None, Field(description="Rows come bottom-up; false: top-down.")] = None
    response: Annotated[
        Response | None,
        Field(
            description="How light becomes spikes: integrate-and-fire of spike cameras, or bernoulli of single-photon cameras."
        ),
    ] = None
    fov: Annotated[
        float | None,
        Field(
            description="Horizontal field of view in degrees of a pinhole camera with square pixels; without optics they are estimated."
        ),
    ] = None
    intrinsics: IntrinsicsModel | None = None
    model: Annotated[str, Field(description="Name of the product.")] = ""
    serial: Annotated[
        str | None,
        Field(description="Serial number of the camera that the profile is of; null: of any."),
    ] = None
    width: Annotated[int | None, Field(description="Pixels in a row.")] = None
    height: Annotated[int | None, Field(description="Rows.")] = None
    calibration: Annotated[
        None,
        Field(
            description="Sent on its own, by `PUT uploads/ID/calibration`: a file name says nothing to another machine."
        ),
    ] = None
    session: Annotated[
        Session | None,
        Field(description="How the bridge of a USB camera is made to send."),
    ] = None
    note: str = ""


class VersionOut(BaseModel):
    """
    A published version of a scene and its trajectory.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    version: int
    at: AwareDatetime
    splats: int
    poses: int
    white: float
    scene_bytes: Annotated[int, Field(description="Size of the PLY file.")]
    psnr_db: float | None
    intrinsics: Annotated[
        IntrinsicsModel | None,
        Field(
            description="Of the camera, as it was given or as the reconstruction found it, with its lens; null: not known."
        ),
    ]
    cleaned_from: Annotated[
        int | None,
        Field(description="The version that `:clean` made it from, which undoes it; null: it was not cleaned."),
    ]


class VersionsOut(BaseModel):
    """
    The versions that are kept, oldest first.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    items: list[VersionOut]


class ViewRequest(BaseModel):
    """
    One camera gives a picture; several, or a path, give a ZIP of pictures.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    camera: CameraModel | None = None
    cameras: list[CameraModel] | None = None
    path: PathModel | None = None
    width: Annotated[int | None, Field(description="Pixels; the sensor's own if not given.")] = None
    height: int | None = None
    intrinsics: Annotated[
        IntrinsicsModel | None,
        Field(
            description="Optics of the pictures; if not given the capture's own, scaled to the width, the height taken from or added to the middle."
        ),
    ] = None
    undistorted: Annotated[
        bool,
        Field(description="Without the distortion of the lens that these optics have."),
    ] = False
    background: list[float] | None = None
    output: Annotated[
        Output,
        Field(
            description="color; depth along the camera's axis in the scene's unit of length, 0 where nothing is; alpha, 0 to 1."
        ),
    ] = Output.color
    white: Annotated[
        float | None,
        Field(
            description="Value shown as white in all formats but EXR. If not given: for color the scene's own, for alpha 1, for depth the largest of the picture. The header X-White says what was used."
        ),
    ] = None


class BaselineScaleOut(BaseModel):
    """
    The scale by a baseline.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    scale: ScaleOut
    poses: Annotated[int, Field(description="Moments at which both cameras have a pose.")]
    offset_s: Annotated[float, Field(description="Seconds by which the second recording began later.")]


class BoardScaleOut(BaseModel):
    """
    The scale by a board.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    scale: ScaleOut
    square: Annotated[float, Field(description="Side of a square, in the unit of the scene.")]
    views: int
    corners: Annotated[int, Field(description="Of the board, that were used.")]
    error_px: Annotated[
        float,
        Field(description="Root mean square error of its corners, px of the pictures."),
    ]


class CalibratedOut(BaseModel):
    """
    The completed profile of a device, and what was measured.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    file: Annotated[str, Field(description="Its file in the folder `profiles` of the data folder.")]
    profile: ProfileModel
    measured: CalibrationOut


class CaptureOut(BaseModel):
    """
    A capture: frames of a camera from here or elsewhere, recorded, reconstructed, or both.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    id: Annotated[str, Field(description="UUID version 7: ids sort by time.")]
    name: str
    notes: str
    keep: Annotated[bool, Field(description="Retention leaves it alone.")]
    tags: Annotated[list[str], Field(description="Words to find it by.")]
    metadata: Annotated[dict[str, str], Field(description="Values of other programs by key.")]
    origin: Annotated[
        Origin,
        Field(
            description="live: captured here; upload: a recording from elsewhere; recovered: found in the data folder, its row rebuilt from its files."
        ),
    ]
    source: str
    state: CaptureState
    reason: Annotated[
        str,
        Field(description="Why, if the capture has failed or is about to; or what it waits for, while no frame comes."),
    ]
    warnings: list[str]
    verdict: Annotated[VerdictOut | None, Field(description="Null until the recording is closed.")]
    started_at: AwareDatetime
    ended_at: AwareDatetime | None
    deleted_at: Annotated[
        AwareDatetime | None,
        Field(description="Not null: removed; `:restore` brings it back."),
    ]
    frames_planned: Annotated[int | None, Field(description="Length of the capture if it is known.")]
    recording: RecordingOut | None
    reconstruction_ids: Annotated[
        list[str],
        Field(description="The newest 100, the oldest of these first; `GET reconstructions?capture_id=` lists all."),
    ]
    reconstruction_count: Annotated[int, Field(description="Number of all its reconstructions.")]
    counters: CountersOut | None
    sensor: Annotated[SensorOut | None, Field(description="Null until the source is open.")]
    group: Annotated[
        str | None,
        Field(description="Id of the group of captures that were started together."),
    ]
    ring: Annotated[
        str | None,
        Field(
            description="Name of the shared memory with the newest frames, for programs on the service's machine; null when the capture does not run."
        ),
    ]


class CapturePage(BaseModel):
    """
    Captures, newest first or in the order that was asked for.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    items: list[CaptureOut]
    next_cursor: Annotated[
        str | None,
        Field(description="To be given as `cursor` for those that follow; null: there are no more."),
    ]
    total: Annotated[int, Field(description="Captures on all pages.")]


class CaptureRequest(BaseModel):
    """
    A capture to start.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    source: Annotated[
        str | None,
        Field(
            description="usb0, pcie:PATH, sim: or replay:FILE, with options after a question mark. A file or simulation without `pace` waits for its readers."
        ),
    ] = None
    device: Annotated[
        str | None,
        Field(description="Id of a device, instead of a source; `GET devices`."),
    ] = None
    frames: Annotated[
        int | None,
        Field(description="Length; until the source ends or is stopped if not given."),
    ] = None
    seconds: Annotated[
        float | None,
        Field(description="Length in seconds of the camera, instead of frames."),
    ] = None
    pretrigger_s: Annotated[float, Field(description="Begin so much earlier, from an armed device's ring.")] = 0.0
    name: str = ""
    notes: str = ""
    record: Annotated[bool, Field(description="Keep the frames in the data folder.")] = True
    reconstruct: Annotated[bool, Field(description="Reconstruct while it runs.")] = True
    options: ReconstructionOptions | None = None
    camera: Annotated[
        StatedCameraModel | None,
        Field(description="The same as options of the source's text."),
    ] = None
    noise: Annotated[
        NoiseModel | None,
        Field(description="Of `sim:`: the same as options of the source's text."),
    ] = None
    intrinsics: Annotated[
        IntrinsicsModel | None,
        Field(description="If the source does not know its own."),
    ] = None


class GeometryModel(BaseModel):
    """
    What the recording holds, where there is no sidecar.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    rate: Annotated[float | None, Field(description="Frames per second.")] = None
    mosaic: Annotated[
        Mosaic | None,
        Field(description="Colour mosaic of the upright image; none: a grey sensor."),
    ] = None
    flipped: Annotated[bool | None, Field(description="Rows come bottom-up; false: top-down.")] = None
    response: Annotated[
        Response | None,
        Field(
            description="How light becomes spikes: integrate-and-fire of spike cameras, or bernoulli of single-photon cameras."
        ),
    ] = None
    fov: Annotated[
        float | None,
        Field(
            description="Horizontal field of view in degrees of a pinhole camera with square pixels; without optics they are estimated."
        ),
    ] = None
    intrinsics: IntrinsicsModel | None = None
    width: Annotated[int | None, Field(description="Pixels in a row, a multiple of 8.")] = None
    height: Annotated[int | None, Field(description="Rows.")] = None
    layout: Annotated[
        Layout | None,
        Field(description="How a frame is stored: rows only, or each row followed by its number."),
    ] = None
    bit_order: Annotated[
        BitOrder | None,
        Field(description="Which bit of a byte is the leftmost of its eight pixels."),
    ] = None
    frame_rate_hz: Annotated[float | None, Field(deprecated=True, description="Deprecated: use rate.")] = None


class GroupOut(BaseModel):
    """
    A group, with its captures in the order of the request.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    id: Annotated[str, Field(description="UUID version 7: ids sort by time.")]
    captures: list[CaptureOut]
    offsets: Annotated[
        list[OffsetOut] | None,
        Field(description="Of all captures but the first, against the first. Null until all have ended."),
    ]


class GroupRequest(BaseModel):
    """
    Captures to start together, or none of them.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    captures: Annotated[list[CaptureRequest], Field(description="A device each.")]


class UploadRequest(BaseModel):
    """
    A recording, or another file with the frames of one, that is about to come.
    """

    model_config = ConfigDict(
        extra="ignore",
    )
    name: Annotated[str, Field(description="What the capture will be called.")]
    notes: str = ""
    bytes: Annotated[int, Field(description="Size of the whole file.")]
    sidecar: UploadSidecar | None = None
    geometry: Annotated[GeometryModel | None, Field(description="Wins over the sidecar.")] = None
    profile: Annotated[
        UploadProfile | None,
        Field(description="Camera profile, which says what geometry does not."),
    ] = None
    device: Annotated[
        str | None,
        Field(description="Device that the recording is of: its profile and its calibration are used."),
    ] = None
    sha256: Annotated[str | None, Field(description="Of the whole file, in hex; checked at the end.")] = None
    form: Annotated[
        Form | None,
        Field(
            description="Raw bytes of a camera (`usb`, `pcie`), arrays of NumPy or HDF5 (`array`) and frames without ends of rows (`bits`) are converted to a recording. Default: a recording if it has a sidecar or a stated layout, otherwise detected."
        ),
    ] = None
    array: Annotated[
        str | None,
        Field(description="Name of the array of spikes, where the file has several with three axes."),
    ] = None
