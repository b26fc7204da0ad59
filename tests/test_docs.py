"""What README and docs name, is there: commands and options, settings, metrics, routes, links, files, names, limits."""

import functools
import importlib
import inspect
import json
import re
import shlex
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from spiked_driver import framing, gap_attribution, usb_budget, usb_connection
from spiked_service.api import idempotency, listener, streams, zmq
from spiked_service.api.routes import events as event_routes
from spiked_service.base import malloc
from spiked_service.captures import live_capture
from spiked_service.cli.main import app
from spiked_service.events import bus
from spiked_service.settings.reconstruction_options import ReconstructionOptions
from spiked_service.settings.settings import NOT_SETTINGS, Settings
from spiked_service.workers import backoff, frame_skipping

from spiked.recon import view_tracking
from spiked.recon.frontend import feature_tracks, windowing
from spiked.recon.mapping import mapper, pyramid, render_requests
from spiked.recon.mapping.densification import DensifyStrategy
from spiked.recon.mapping.rates import RATES
from spiked.recon.mapping.schedule import Schedule
from spiked.recon.mapping.seeding import Seeding
from spiked.recon.odometry import assessment, initialisation, self_calibration, spline_fitting, stationarity
from spiked.recon.options import MapOptions, Options
from spiked.recording import durability, index
from spiked.ring import writer

from .test_deploy import exposed

ROOT = Path(__file__).parents[1]
DOCS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs/decisions").glob("*.md"))]
GLOSSARY = "glossary.md"
"""The only document with former names."""
PLACES = (
    "", "spiked", "driver", "service", "driver/spiked_driver", "service/spiked_service",
    "service/spiked_service/workers", "docs", "evaluation", "tests", "web/src", "deploy",
    "spiked/recon", "spiked/recon/frontend", "spiked/recon/odometry", "spiked/recon/mapping",
    "spiked/render", "tests/recon", "tests/service", "tests/service/api", "tests/usb",
    "web/src/features", "web/src/shared",
)  # fmt: skip
"""Folders that paths in the docs are said from."""


@functools.cache
def code(doc: Path) -> tuple[str, ...]:
    """Lines of fenced blocks, continued ones joined, and what stands between backticks."""
    text = doc.read_text()
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    rest = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    indented = re.findall(r"^ {4}(\S.*)$", rest, re.MULTILINE)
    lines = [line for block in blocks for line in re.sub(r"\\\n\s*", " ", block).splitlines()]
    return (*lines, *indented, *(span.replace("\n", " ") for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", rest)))


def commands(doc: Path, program: str) -> Iterator[list[str]]:
    """Words after a program's name, to the end of its command."""
    for line in code(doc):
        for rest in re.findall(rf"(?:^|[\s/;(]){re.escape(program)} (.*)", line):
            words = re.split(r"\s#\s|[|;&]|…|\.\.\.|\)$", re.sub(r"\[|\]", " ", rest))[0]
            try:
                yield shlex.split(words)
            except ValueError:
                yield words.split()


def told(words: list[str]) -> set[str]:
    return {word.partition("=")[0] for word in words if word.startswith("--")}


def unknown_commands(doc: Path) -> list[str]:
    """Commands of `spiked`, and options of them."""
    top = typer.main.get_command(app)
    wrong = []
    for words in commands(doc, "spiked"):
        command: Any = top
        while hasattr(command, "commands") and words and words[0] in command.commands:
            command = command.commands[words.pop(0)]
        known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        unknown = told(words) - known - {"--help"}
        if command is top and words and re.fullmatch(r"[a-z][a-z-]+", words[0]):
            wrong.append(f"spiked {words[0]}")
        wrong += [f"spiked {command.name} {option}" for option in unknown]
    return wrong


@functools.cache
def help_of(script: str) -> str:
    done = subprocess.run([sys.executable, ROOT / script, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def unknown_programs(doc: Path) -> list[str]:
    """Scripts below evaluation/ and their options, tests, targets of make."""
    wrong = []
    for words in commands(doc, "python"):
        if words and words[0].startswith("evaluation/"):
            wrong += [f"{words[0]} {option}" for option in told(words) if option not in help_of(words[0])]
    for words in commands(doc, "pytest"):
        wrong += [word for word in words if word.startswith("tests/") and not (ROOT / word.split("::")[0]).exists()]
        if "-k" in words:
            name = words[words.index("-k") + 1]
            files = [ROOT / word for word in words if word.endswith(".py")]
            wrong += [name for file in files if not re.search(rf"def test_\w*{name}", file.read_text())]
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for words in commands(doc, "make"):
        wrong += [f"make {words[0]}" for _ in [0] if words and words[0] not in targets]
    return wrong


def unknown_settings(doc: Path) -> list[str]:
    """Settings, and variables of the environment."""
    named = set(re.findall(r"\bSPIKED_[A-Z_]+\b", doc.read_text())) - {"SPIKED_NAME"}
    known = {f"SPIKED_{name.upper()}" for name in Settings.model_fields} | NOT_SETTINGS
    refused = {"SPIKED_LIMIT_RENDER"}  # an example of a wrong one
    spans = " ".join(code(doc))
    keys = set(re.findall(r"--set (\w+)=", spans)) | set(re.findall(r"\b(\w+) = (?:true|false)\b", spans))
    return sorted(named - known - refused | keys - set(Settings.model_fields))


def unknown_metrics(doc: Path) -> list[str]:
    """Metrics."""
    series = {re.sub(r"_(total|bucket|sum|count|created|info)$", "", name) for name in exposed()}
    modules = {path.name.removesuffix(".py") for path in ROOT.glob("*/spiked_*")}
    named = {
        re.sub(r"_(total|info)$", "", name)
        for span in code(doc)
        for name in re.findall(r"^(spiked_[a-z_]+)(?:\{[a-z,]+\})?$", span)
    }
    return sorted(named - series - modules)


@functools.cache
def document() -> dict[str, Any]:
    """The API as it describes itself."""
    done = subprocess.run(
        [sys.executable, "-m", "spiked_service", "openapi"], capture_output=True, text=True, check=True
    )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@functools.cache
def operations() -> dict[tuple[str, str], set[str]]:
    """Method and path pattern of every operation of the API, with the names of its query parameters."""
    shared = document()["components"].get("parameters", {})
    return {
        (method.upper(), re.sub(r"\{\w+\}", "[^/:]+", path)): {
            parameter["name"]
            for parameter in (shared[p["$ref"].split("/")[-1]] if "$ref" in p else p
                              for p in operation.get("parameters", []))
            if parameter["in"] == "query"
        }
        for path, item in document()["paths"].items()
        for method, operation in item.items()
        if method in ("get", "post", "put", "patch", "delete")
    }  # fmt: skip


def requests(doc: Path) -> Iterator[tuple[str, str]]:
    """Method and address of what is asked of the API."""
    for line in code(doc):
        method = re.search(r"(?:-X |\.|^)(GET|POST|PATCH|PUT|DELETE)\b", line)
        for address in re.findall(r"(?:\$API|/api/v1)(/[^\s\"'`)]*)", line):
            if not address.startswith("/events"):  # a WebSocket as well, which OpenAPI cannot say
                yield method[1] if method else "GET", address
        for verb, address in re.findall(r"^(GET|POST|PATCH|DELETE) ([a-z/][^\s`]*)$", line):
            if not address.startswith("/api/v1/events"):
                yield verb, "/" + address.removeprefix("/api/v1").lstrip("/")


def unknown_routes(doc: Path) -> list[str]:
    """Requests of the API, and their parameters."""
    wrong = []
    for method, address in requests(doc):
        path, _, query = address.partition("?")
        path = "/api/v1" + re.sub(r"\$?\{?[A-Za-z_.]*(?:ID|JOB|UPLOAD|TOKEN)\}?|\{\w+\}", "one", path).rstrip("/,.;")
        found = [
            names for (verb, pattern), names in operations().items() if verb == method and re.fullmatch(pattern, path)
        ]
        asked = set(re.findall(r"(?:^|&)(\w+)=", query))
        if not any(asked <= names for names in found):
            wrong.append(f"{method} {address}")
    return wrong


def dead_links(doc: Path) -> list[str]:
    """Links within the project."""
    wrong = []
    for target in re.findall(r"\]\(([^)\s]+)\)", doc.read_text()):
        if re.match(r"https?://", target):
            continue
        path, _, anchor = target.partition("#")
        file = (doc.parent / path).resolve() if path else doc
        if not file.exists():
            wrong.append(target)
        elif anchor:
            heads = re.findall(r"^#+ (.+)$", file.read_text(), re.MULTILINE)
            if anchor not in {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}:
                wrong.append(target)
    return wrong


def missing_files(doc: Path) -> list[str]:
    """Files."""
    ending = r"(?:py|cpp|hpp|inl|sh|toml|service|rules|json|mjs|css|ts|tsx|md)"
    named = {
        word
        for span in code(doc)
        for word in re.findall(rf"(?<![\w/.$-])((?:[a-z_0-9.]+/)+[\w.-]+\.{ending}|[a-z_]+\.py)(?![\w/])", span)
        if not span.startswith("replay:")
    }
    there = {path.name for path in ROOT.rglob("*.py") if ".venv" not in path.parts}
    wrong = [
        word for word in named
        if not any((ROOT / place / word).exists() for place in PLACES) and not ("/" not in word and word in there)
    ]  # fmt: skip
    return [word for word in wrong if not word.startswith(("spiked/spiked.toml", "path/"))]


def found(name: str, former: bool) -> bool:
    """A module, or something in one; with `former` also under a deprecated name."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            thing: Any = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore" if former else "error", DeprecationWarning)
            try:
                for part in parts[cut:]:
                    thing = getattr(thing, part)
            except (AttributeError, DeprecationWarning):
                return False
        return True
    return False


def unknown_names(doc: Path) -> list[str]:
    """Modules, and what is in them; former names belong into the glossary only."""
    named = {word for span in code(doc) for word in re.findall(r"^(spiked(?:_driver|_service)?(?:\.\w+)+)$", span)}
    named -= {name for name in named if re.search(r"\.(dat|json|toml|service|txt)$", name)}
    return [name for name in sorted(named) if not found(name, former=doc.name == GLOSSARY)]


def paged() -> list[str]:
    """Lists of the API that come in pages."""
    names = {
        path.rsplit("/", 1)[1]
        for path, item in document()["paths"].items()
        if "get" in item and re.search(r"schemas/\w+Page\b", json.dumps(item["get"]["responses"].get("200")))
    }
    return sorted(names)


WRONG = """# Wrong

`spiked reconstrukt`, `spiked serve --portt 1`, `python evaluation/measure.py --fast`, `pytest tests/test_nothing.py`,
`make everything`, `SPIKED_PORTT=1`, `limit_requests = true`, `spiked_frames_eaten_total{device}`,
`GET captures/{id}/soup`, `GET captures?flavour=sweet`, [a page](nowhere.md), [a part](#no-such-part),
`recon/magic.py`, `spiked.recon.Magic`, `spiked.ring.Geometry`
"""
CHECKS: dict[Callable[[Path], list[str]], tuple[str, ...]] = {
    unknown_commands: ("spiked reconstrukt", "spiked serve --portt"),
    unknown_programs: ("evaluation/measure.py --fast", "tests/test_nothing.py", "make everything"),
    unknown_settings: ("SPIKED_PORTT", "limit_requests"),
    unknown_metrics: ("spiked_frames_eaten",),
    unknown_routes: ("GET /captures/{id}/soup", "GET /captures?flavour=sweet"),
    dead_links: ("nowhere.md", "#no-such-part"),
    missing_files: ("recon/magic.py", "tests/test_nothing.py"),
    unknown_names: ("spiked.recon.Magic", "spiked.ring.Geometry"),
}
"""What is looked for in each document, and what of WRONG each has to find."""


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("doc", DOCS, ids=lambda doc: doc.stem)
def test_what_is_named_is_there(doc: Path, check: Callable[[Path], list[str]]) -> None:
    assert check(doc) == []


@pytest.mark.parametrize(("check", "culprits"), CHECKS.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_what_is_not_there_is_found(
    check: Callable[[Path], list[str]], culprits: tuple[str, ...], tmp_path: Path
) -> None:
    doc = tmp_path / "wrong.md"
    doc.write_text(WRONG)
    assert sorted(check(doc)) == sorted(culprits)


def default(name: str) -> Any:
    """Of a setting."""
    return Settings.model_fields[name].default


def parameter(function: Callable[..., object], name: str) -> Any:
    """Default of a parameter."""
    return inspect.signature(function).parameters[name].default


def web(path: str, pattern: str) -> str:
    """A value in the page's sources."""
    (value,) = re.findall(pattern, (ROOT / "web/src" / path).read_text())
    return str(value)


def gains() -> tuple[float, float]:
    """Smallest, as what it divides by, and largest."""
    low, high = re.findall(r"(?:min|max)=\{(-?\d+)\}", (ROOT / "web/src/features/live/PictureView.tsx").read_text())[:2]
    return 2.0 ** -int(low), 2.0 ** int(high)


def defaults() -> tuple[int, float]:
    """Steps and splats a pixel of a reconstruction."""
    return Options().steps, MapOptions().splats_a_pixel


MIB = 1 << 20
Claim = tuple[str, str, Callable[[], object]]
CLAIMS: tuple[Claim, ...] = (
    ("README.md", "on port {}", lambda: default("port")),
    ("README.md", "From {:.0f} % of predicted error on", lambda: 100 * assessment.WORST_PATH_ERROR),
    ("method.md", "windows of {} frames", lambda: f"{min(windowing.WINDOWS)} to {max(windowing.WINDOWS)}"),
    ("method.md", "(image motion under about {} px,", lambda: windowing.WINDOW_MOTION_PX[1]),
    ("method.md", "Up to {} corners", lambda: inspect.signature(feature_tracks.Tracks).parameters["target"].default),
    ("method.md", "{} views of equal flow", lambda: {10: "Ten"}[initialisation.BOOT_VIEWS]),
    ("method.md", "({} frames a knot", lambda: f"{min(spline_fitting.SPACINGS)} to {max(spline_fitting.SPACINGS)}"),
    ("method.md", "would take over {} knots", lambda: spline_fitting.MOST_KNOTS),
    ("method.md", "between knots of {} frames", lambda: " or ".join(map(str, sorted(spline_fitting.KINKED_SPACINGS)))),
    ("method.md", "follows the free poses within {} px", lambda: spline_fitting.WORST_PX),
    ("method.md", "tried at {} fields of view", lambda: {5: "five"}[len(self_calibration.FIELDS_OF_VIEW_DEG)]),
    ("method.md", "Plane sweep of {} views", lambda: {11: "eleven"}[Seeding.views]),
    ("method.md", "with one to {} sub-frames", lambda: {6: "six"}[render_requests.MAX_SUB_FRAMES]),
    ("method.md", "Every {} steps dead splats", lambda: DensifyStrategy.every),
    ("method.md", "along its motion to {} frames", lambda: 2 * windowing.WARP_FRAMES),
    ("method.md", "{} times in the first", lambda: {5: "Five"}[len(Schedule.align_at)]),
    ("method.md", "in the first {:.0f} % of a refinement", lambda: 100 * Schedule.align_at[-1]),
    ("method.md", "over the last {:.0f} %", lambda: 100 * Schedule.settling_share),
    ("method.md", "if the path moved by more than {} px", lambda: Schedule.stale_px),
    ("method.md", "points stays below {} px", lambda: stationarity.STOOD_PX),
    ("decisions/0002-view-length-follows-motion.md", "moved less than {} px in", lambda: windowing.WINDOW_MOTION_PX[0]),
    ("decisions/0002-view-length-follows-motion.md", "above {:.1f} px, but", lambda: 2 * windowing.WINDOW_MOTION_PX[1]),
    ("decisions/0002-view-length-follows-motion.md", "Above {} px a frame views", lambda: windowing.FAST_PX[1]),
    ("decisions/0002-view-length-follows-motion.md", "above {} px a frame 4", lambda: windowing.FASTEST_PX[1]),
    ("decisions/0065-steps-along-the-axes.md", "{} of these for means", lambda: RATES.means),
    ("decisions/0003-learning-rates.md", "The defaults today are {:,} steps and {} splats", defaults),
    ("decisions/0005-motion-aware-rendering.md", "cap every {} steps", lambda: DensifyStrategy.every),
    ("decisions/0005-motion-aware-rendering.md", "a pixel and {:,} in all", lambda: MapOptions().most_splats),
    ("decisions/0005-motion-aware-rendering.md", "with at least {:,} pixels", lambda: pyramid.SMALLEST_PIXELS),
    ("decisions/0005-motion-aware-rendering.md", "the first {:.0f} % of", lambda: 100 * Schedule.coarse_share),
    ("decisions/0005-motion-aware-rendering.md", "estimated from step {} on", lambda: mapper.GAINS_FROM),
    ("decisions/0005-motion-aware-rendering.md", "brightness from step {} on", lambda: mapper.NUISANCES_FROM),
    ("events.md", "remembers {:,} messages", lambda: bus.HISTORY),
    ("events.md", "room for {:,} messages, two of them pictures", lambda: event_routes.CAPACITY),
    ("events.md", "takes nothing for {:.0f} seconds is disconnected", lambda: streams.STUCK_S),
    ("events.md", "has no room ({:,} messages; 2 pictures", lambda: zmq.QUEUE_MESSAGES),
    ("events.md", "close code {}", lambda: event_routes.CLOSE_SEND_ONLY),
    ("events.md", "| PUB | {} | all but pictures", lambda: default("port") + 1),
    ("api.md", "the first answer is kept for {}", lambda: {1: "a day"}[idempotency.KEPT.days]),
    ("api.md", "lists of {} are pages", lambda: " and ".join(f"`{name}`" for name in paged())),
    ("operations.md", "up to {} s or", lambda: live_capture.BACKLOG_S),
    ("architecture.md", "with delays of {:g}, {:g}, {:g}, {:g} and {:g} s;", lambda: backoff.DELAYS_S),
    ("architecture.md", "that ran for {:.0f} s", lambda: backoff.RESET_S),
    ("operations.md", "s or {} MiB", lambda: writer.MOST_BACKLOG_BYTES // MIB),
    ("operations.md", "is {:,} frames behind it", lambda: frame_skipping.LATE_FRAMES),
    ("operations.md", "({:.0f} to {:.0f} pixels)", lambda: frame_skipping.REACH_PX[::2]),
    ("operations.md", "no more than {:.0f} ms apart", lambda: 1000 * view_tracking.BRIDGED_S),
    ("service-figures.md", "the {:,} events that are remembered", lambda: bus.HISTORY),
    ("service-figures.md", "All threads share {} heaps", lambda: {2: "two"}[malloc.ARENAS]),
    ("recordings.md", "{} bytes of header, then {} bytes an entry", lambda: (index.HEADER_BYTES, index.ENTRY_BYTES)),
    ("recordings.md", "a block of {} at a time", lambda: parameter(writer.RingWriter.create, "block_frames")),
    ("recordings.md", "in steps of {} MiB", lambda: durability.LIVE.preallocate_bytes // MIB),
    ("recordings.md", "the last {} MiB of a disk", lambda: durability.LIVE.reserve_bytes // MIB),
    ("threat-model.md", "WebSocket messages {} KiB", lambda: listener.MESSAGE_BYTES >> 10),
    ("threat-model.md", "ZeroMQ requests {} KiB", lambda: zmq.REQUEST_BYTES >> 10),
    ("threat-model.md", "holds a connection; there are {:,}", lambda: listener.CONNECTIONS),
    ("usb.md", "Reads of {} MiB", lambda: usb_budget.TRANSFER_BYTES // MIB),
    ("usb.md", "to hide {:.0f} ms of a busy host", lambda: 1000 * usb_budget.BUFFER_S),
    ("usb.md", "no byte for `silence_s` ({:.0f} s)", lambda: usb_connection.SILENCE_S),
    ("usb.md", "at most {:,} frames behind a moment", lambda: gap_attribution.HELD_FRAMES),
    ("usb.md", "exactly a frame's bytes ({:,})", lambda: framing.USB_FRAME_BYTES),
    ("usb-figures.md", "after `silence_s`, here {:.0f} s", lambda: usb_connection.SILENCE_S),
    ("usb-figures.md", "The camera sends {:.0f} MB/s", lambda: framing.USB_FRAME_BYTES * usb_connection.RATE_HZ / 1e6),
    (
        "page.md",
        "of more than {:,} splats a quarter",
        lambda: int(web("features/scene/useScene.ts", r"MOST_SPLATS = (\w+)").replace("_", "")),
    ),
    ("page.md", "{} kB for the Live page", lambda: web("../scripts/budget.mjs", r"first: (\d+)")),
    ("page.md", "{} kB for three.js", lambda: web("../scripts/budget.mjs", r"three: (\d+)")),
    ("page.md", "{:,} kB for the splat renderer", lambda: int(web("../scripts/budget.mjs", r"spark: (\d+)"))),
    ("page.md", "{} kB for plots", lambda: web("../scripts/budget.mjs", r"plots: (\d+)")),
    ("page.md", "Gain goes from 1/{:.0f} to {:.0f}", gains),
    ("page.md", "play ({} seconds for", lambda: {"10": "ten"}[web("features/scene/Scrubber.tsx", r"PLAYED_S = (\d+)")]),
    (
        "page.md",
        "is {} times the absolute",
        lambda: {"4": "four"}[web("features/scene/composing.ts", r"_GAIN = (\d+)")],
    ),
    ("page.md", "a contrast below {}", lambda: web("shared/styles/palette.test.ts", r"TEXT = ([\d.]+)")),
)
"""What a document says of a limit, and where the code has it: a sentence that has another value is not found."""


@pytest.mark.parametrize(("doc", "sentence", "value"), CLAIMS, ids=[f"{claim[0]}: {claim[1]}" for claim in CLAIMS])
def test_limits_are_those_of_the_code(doc: str, sentence: str, value: Callable[[], object]) -> None:
    text = " ".join((ROOT / ("" if doc == "README.md" else "docs") / doc).read_text().split())
    known = value()
    assert sentence.format(*known if isinstance(known, tuple) else (known,)) in text


def test_options_say_what_the_motion_makes_of_them() -> None:
    """Descriptions that repeat limits of the method."""
    windows = f"({min(windowing.WINDOWS)} to {max(windowing.WINDOWS)})"
    assert windows in (ReconstructionOptions.model_fields["window_frames"].description or "")
    source = inspect.getsource(Options)
    assert windows in source and Schedule.fast_steps == 3 and "up to three times as many" in source
    assert f"more than {Schedule.small_pixels:,} pixels" in source


def places(line: str) -> list[Path]:
    """Files and folders of the repository that a line names."""
    return [ROOT / span for span in re.findall(r"`([^`]+)`", line) if "/" in span and (ROOT / span).exists()]


def test_a_new_sensor_finds_each_name_where_it_is_said_to_be() -> None:
    lines = [line for line in (ROOT / "docs/new-sensor.md").read_text().splitlines() if places(line)]
    assert len(lines) > 20
    for line in lines:
        files = [file for place in places(line) for file in ([place] if place.is_file() else place.iterdir())]
        text = "".join(f"{file.name}\n{file.read_text()}" for file in files if file.is_file())
        names = re.findall(r"`([A-Za-z_]\w+(?:\.\w+)?)`", line)
        assert [name for name in names if name.split(".")[-1] not in text and name not in text] == [], line
