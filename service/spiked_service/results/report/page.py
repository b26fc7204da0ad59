"""A report as one HTML file: pictures and style are inside, there are no scripts, and nothing is fetched."""

import base64
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from spiked.lpips import LPIPS_NETWORK
from spiked.trajectory import Trajectory
from spiked_service.results.image_encoding import ImageFormat
from spiked_service.results.report import svg
from spiked_service.results.report.figures import Figures
from spiked_service.results.report.source import Pair, ReportSource

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
"""Content security policy: even text of a hostile recording cannot make the file fetch anything."""
_STYLE = Path(__file__).with_name("report.css")
_EVALUATED = {
    "coverage": ("coverage", "of the frames have a pose"),
    "ate_percent": ("ATE", "% of the RMS radius of the true path"),
    "ate_unit": ("ATE, path of unit norm", "as in tables of pose-free methods"),
    "rpe_t_percent": ("RPE, position", "%, over 32 frames"),
    "rpe_r_deg": ("RPE, rotation", "degrees, over 32 frames"),
    "psnr_db": ("PSNR", "dB, mean of held-out views"),
    "worst_psnr_db": ("PSNR, worst view", "dB"),
    "ssim": ("SSIM", "mean of held-out views"),
    "lpips": ("LPIPS", f"mean of held-out views, by {LPIPS_NETWORK}; smaller is better"),
}
"""Figures of `spiked evaluate`: name and meaning; others are shown by their own names."""
_STATES = {
    "boot": "before the first map",
    "track": "tracked",
    "degraded": "tracked with doubt",
    "lost": "lost",
    "reloc": "found again",
}
_MOST_ROWS = 400
"""Rows of a table; a long run changes its state more often."""

Row = tuple[str, object]


def report_html(source: ReportSource) -> str:
    """The file."""
    title = escape(source.name)
    body = "\n".join(part for part in _sections(source) if part)
    return (
        "<!doctype html>\n"
        f'<html lang="en"><head><meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="referrer" content="no-referrer">'
        f"<title>{title} - spiked report</title><style>\n{_STYLE.read_text(encoding='utf-8')}</style></head>\n"
        f"<body><main>\n{body}\n</main></body></html>\n"
    )


def _sections(source: ReportSource) -> Iterable[str]:
    figures = source.figures
    yield _header(source)
    yield _notices(source)
    yield _section("Result", _tiles(_key_figures(source)))
    yield _section("Against the truth", _tiles(_evaluation(figures)))
    yield _section("Seen and reconstructed", _pictures(source.pairs))
    yield _section("Path", _path(source.path))
    yield _section("Over time", _over_time(figures))
    yield _section("Work", _work(figures))
    yield _section("Map", _map(figures))
    yield _two(
        _section("Recording and camera", _table(_recording(source))),
        _section("Program and machine", _table(_program(figures))),
    )
    yield _section("Options", _options(figures.options))
    yield _footer(source)


def _header(source: ReportSource) -> str:
    figures, sensor = source.figures, source.figures.sensor
    outcome, kind = _outcome(source)
    about = [source.recording_name] if source.recording_name else []
    if figures.frames is not None:
        about.append(f"{figures.frames:,} frames")
    if figures.frames is not None and sensor is not None and sensor.frame_rate_hz:
        about.append(f"{_duration(figures.frames / sensor.frame_rate_hz)} at {sensor.frame_rate_hz:,.0f} Hz")
    if sensor is not None:
        about.append(f"{sensor.width} × {sensor.height} pixels")
    about.append(f"{source.at:%Y-%m-%d %H:%M} UTC")
    return (
        f'<header><h1>{escape(source.name)}<span class="badge {kind}">{escape(outcome)}</span></h1>'
        f"<p>{escape(' · '.join(about))}</p></header>"
    )


def _outcome(source: ReportSource) -> tuple[str, str]:
    """The outcome, and the class of its colour."""
    figures = source.figures
    localised = figures.localisation.get("recognised")
    if localised is False or figures.extended.get("joined") is False:
        return "not recognised" if localised is False else "map not extended", "problem"
    if figures.outcome == "failed":
        return "failed", "problem"
    if source.incomplete is not None:
        return "incomplete", "warning"
    return ("complete", "good") if figures.outcome == "complete" else (figures.outcome, "warning")


def _notices(source: ReportSource) -> str:
    figures = source.figures
    reasons = [source.incomplete] if source.incomplete else []
    if figures.outcome == "failed" and figures.reason:
        reasons.append(f"No path was found: {figures.reason}")
    reasons += [str(part["reason"]) for part in (figures.extended, figures.localisation) if part.get("reason")]
    notices = "".join(f"<p>{escape(reason)}</p>" for reason in reasons)
    urgent = " problem-notice" if figures.outcome == "failed" else ""
    shown = f'<section class="notice{urgent}">{notices}</section>' if notices else ""
    if figures.warnings:
        listed = "".join(f"<li>{escape(warning)}</li>" for warning in figures.warnings)
        shown += f'<section class="notice"><h2>Warnings and questions</h2><ul>{listed}</ul></section>'
    return shown


def _key_figures(source: ReportSource) -> list[Row]:
    figures = source.figures
    rows: list[Row] = [("poses", source.poses)]
    if figures.frames:
        rows.append(("share of the frames", f"{source.poses / figures.frames:.2%}"))
    rows += [("splats", figures.splats), ("PSNR of the views", _unit(figures.final_psnr_db, "dB"))]
    if figures.views:
        rows.append(("views", len(figures.views)))
    if figures.path_error_predicted is not None:
        rows.append(("predicted error of the path", f"{figures.path_error_predicted:.2%}"))
    if figures.closures:
        rows.append(("closed loops", len(figures.closures)))
    if figures.gaps:
        rows.append(("frames lost", sum(gap.frames for gap in figures.gaps)))
    if "total" in figures.seconds:
        rows.append(("work", _unit(figures.seconds["total"], "s")))
    localisation = figures.localisation
    if localisation:
        rows += [(name.replace("_", " "), localisation.get(name)) for name in ("searches", "agreeing", "references")]
    return [row for row in rows if row[1] is not None]


def _evaluation(figures: Figures) -> list[Row]:
    rows: list[Row] = []
    for name, value in figures.evaluation.items():
        known, meaning = _EVALUATED.get(name, (name, ""))
        rows.append((known, _unit(value, meaning, digits=4)))
    return rows


class _Value(str):
    """Markup of a value, which is not escaped again."""


def _unit(value: float | None, unit: str, digits: int = 2) -> "_Value | None":
    if value is None:
        return None
    return _Value(f'<data value="{value!r}">{value:,.{digits}f}</data> <small>{escape(unit)}</small>')


def _value(value: object) -> str:
    """Markup of a figure: exact in the attribute, rounded for eyes."""
    if isinstance(value, _Value):
        return value
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "not set"}[value]
    if isinstance(value, int):
        return f'<data value="{value}">{value:,}</data>'
    if isinstance(value, float):
        return f'<data value="{value!r}">{value:.6g}</data>'
    if isinstance(value, list | tuple):
        return ", ".join(_value(one) for one in value)
    return escape(str(value))


def _tiles(rows: list[Row]) -> str:
    tiles = "".join(f"<div><dt>{escape(name)}</dt><dd>{_value(value)}</dd></div>" for name, value in rows)
    return f'<dl class="tiles">{tiles}</dl>' if tiles else ""


def _pictures(pairs: list[Pair]) -> str:
    if not pairs:
        return ""
    shown = []
    for pair in pairs:
        moment = f"at {_duration(pair.time_s)}"
        named = (("seen by the camera", pair.observed), ("rendered from the scene", pair.rendered))
        images = "".join(_image(encoded, f"{name} {moment}") for name, encoded in named if encoded is not None)
        shown.append(f"<figure>{images}<figcaption>{escape(moment)}</figcaption></figure>")
    both = all(pair.observed and pair.rendered for pair in pairs)
    only = "rendered from the scene" if pairs[0].rendered else "seen by the camera"
    order = "Above: a moment as the camera saw it, 32 frames. Below: the scene from there." if both else f"Only {only}."
    return f'<div class="pictures">{"".join(shown)}</div><figcaption>{order}</figcaption>'


def _image(encoded: Mapping[ImageFormat, bytes], name: str) -> str:
    content = base64.b64encode(encoded[ImageFormat.WEBP]).decode()
    return f'<img alt="{escape(name)}" src="data:{ImageFormat.WEBP.media_type};base64,{content}">'


def _path(path: Trajectory) -> str:
    above = svg.path(path.centres[:, [0, 2]], path.times_s, ("x, right", "z, forward"), "path from above")
    side = svg.path(path.centres[:, [2, 1]], path.times_s, ("z, forward", "y, down"), "path from the side", down=True)
    if not above:
        return ""
    note = (
        "<figcaption>From blue to yellow with time; ● begin, ■ end. Axes of the first camera, in the unit of length of "
        "the scene.</figcaption>"
    )
    return _two(_plot("From above", above), _plot("From the side", side)) + note


def _plot(name: str, drawn: str, note: str = "") -> str:
    if not drawn:
        return ""
    caption = f"<figcaption>{escape(note)}</figcaption>" if note else ""
    return f"<figure><h3>{escape(name)}</h3>{drawn}{caption}</figure>"


def _two(*parts: str) -> str:
    found = [part for part in parts if part]
    return f'<div class="two">{"".join(found)}</div>' if found else ""


def _over_time(figures: Figures) -> str:
    if not figures.views:
        return ""
    times = figures.column("time_s")
    plots = (
        ("sigma_px", "Predicted error of the pose", "px in the image"),
        ("inliers", "Share of known points that agree", "share"),
        ("rate", "Mean spikes a pixel and frame", "spikes"),
        ("motion_px", "Image motion within a view", "px"),
        ("chi2", "Squared residual over the expected one", "ratio"),
    )
    drawn = [
        _plot(name, svg.curve(times, figures.column(field), ("time (s)", unit), name, floor=0.0))
        for field, name, unit in plots
    ]
    return _states(figures) + _two(*drawn)


def _states(figures: Figures) -> str:
    runs = _runs(figures)
    total = sum(end - begin for begin, end, _ in runs) or 1.0
    shares: dict[str, float] = {}
    for begin, end, state in runs:
        shares[state] = shares.get(state, 0.0) + (end - begin) / total
    legend = "".join(
        f'<li><i class="state-{escape(state)}"></i>{escape(state)} ({escape(_STATES.get(state, state))}) '
        f"{share:.1%}</li>"
        for state, share in sorted(shares.items(), key=lambda entry: -entry[1])
    )
    strip = svg.strip(runs[0][0], runs[-1][1], runs, "tracking state over time")
    return f'<h3>Tracking state</h3>{strip}<ul class="legend">{legend}</ul>{_changes(figures)}'


def _changes(figures: Figures) -> str:
    rows = [
        f"<tr><td>{change.time_s:.4f} s</td><td>{escape(change.state)}</td><td>{escape(change.reason)}</td></tr>"
        for change in figures.states[:_MOST_ROWS]
    ]
    if not rows:
        return ""
    more = len(figures.states) - len(rows)
    rest = f"<p>{more:,} more are in report.json.</p>" if more > 0 else ""
    head = '<th scope="col">time</th><th scope="col">state</th><th scope="col">reason</th>'
    return (
        f"<details><summary>Changes of the state: {len(figures.states):,}</summary>"
        f'<div class="scroll" tabindex="0"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>{rest}</div></details>"
    )


def _runs(figures: Figures) -> list[tuple[float, float, str]]:
    """(from, to, state) of neighbouring views of one state."""
    runs: list[tuple[float, float, str]] = []
    views = figures.views
    for view, following in zip(views, [*views[1:], views[-1]], strict=True):
        if runs and runs[-1][2] == view.state:
            runs[-1] = (runs[-1][0], following.time_s, view.state)
        else:
            runs.append((view.time_s, following.time_s, view.state))
    return runs


def _work(figures: Figures) -> str:
    parts = []
    if figures.psnr_of_views_over_seconds:
        seconds, psnr = np.array(figures.psnr_of_views_over_seconds, np.float64).T
        name = "PSNR of the mapped views"
        drawn = svg.curve(seconds, psnr, ("seconds of work", "dB"), name)
        parts.append(_plot(name, drawn, "Their noise is part of it: held-out views without noise score higher."))
    if figures.views:
        drawn = svg.histogram(figures.column("sigma_px"), ("px in the image", "views"), "histogram of predicted errors")
        parts.append(_plot("Predicted errors of the poses", drawn, "The last bar has all that are larger."))
    stages = [(stage, _unit(seconds, "s")) for stage, seconds in figures.seconds.items()]
    if stages:
        parts.append(f"<div><h3>Seconds</h3>{_table(list(stages))}</div>")
    return _two(*parts)


def _map(figures: Figures) -> str:
    """How maps were brought together, or where the recording was in one."""
    rows = [*_flat(figures.merged), *_flat(figures.extended)]
    rows += _flat({name: value for name, value in figures.localisation.items() if name != "views"})
    loops = [
        (f"closed loop {number}", f"{loop.later_s:.4f} s sees what {loop.earlier_s:.4f} s saw")
        for number, loop in enumerate(figures.closures[:_MOST_ROWS], 1)
    ]
    return _table([*rows, *loops])


def _recording(source: ReportSource) -> list[Row]:
    figures, sensor = source.figures, source.figures.sensor
    rows: list[Row] = [("recording", source.recording_name)] if source.recording_name else []
    if sensor is not None:
        rows += [
            ("size", f"{sensor.width} × {sensor.height} pixels"),
            ("frame rate", _unit(sensor.frame_rate_hz, "Hz", digits=0)),
        ]
    rows.append(("frames", figures.frames))
    if figures.gaps:
        rows.append(("gaps", f"{len(figures.gaps)}, {sum(gap.frames for gap in figures.gaps):,} frames"))
    if figures.focal_px is not None:
        estimated = {True: " (estimated)", False: " (given)", None: ""}[figures.focal_estimated]
        rows.append((f"focal length{estimated}", _pixels(figures.focal_px)))
        sigma = figures.focal_relative_sigma
        rows.append(("its relative standard deviation", None if sigma is None else f"{sigma:.2%}"))
    if figures.principal_point_px is not None:
        rows.append(("principal point", _pixels(figures.principal_point_px)))
    if figures.distortion is not None:
        estimated = " (estimated)" if figures.distortion_estimated else ""
        rows += [(f"distortion{estimated} {name}", value) for name, value in _flat(figures.distortion.model_dump())]
    return [row for row in rows if row[1] is not None]


def _pixels(values: tuple[float, float]) -> "_Value":
    first, second = (f'<data value="{value!r}">{value:.2f}</data>' for value in values)
    return _Value(f"{first}, {second} px")


def _program(figures: Figures) -> list[Row]:
    rows: list[Row] = list(figures.versions.items())
    machine = figures.machine
    if machine is not None:
        rows += [("processor", machine.processor), ("cores", machine.cores), ("system", machine.system)]
        if machine.memory_bytes is not None:
            rows.append(("memory", f"{machine.memory_bytes / 2**30:.1f} GiB"))
    rows += _flat(figures.job)
    return [row for row in rows if row[1] not in (None, "")]


def _options(options: Mapping[str, Any]) -> str:
    """Those that a user gives, and behind a line to open those that only programs set."""
    plain = {name: value for name, value in options.items() if not isinstance(value, Mapping)}
    nested = {name: value for name, value in options.items() if isinstance(value, Mapping)}
    rest = _table(_flat(nested))
    more = f"<details><summary>Constants of the method</summary>{rest}</details>" if rest else ""
    return _table(_flat(plain)) + more


def _flat(part: Mapping[str, Any], prefix: str = "") -> list[Row]:
    """Nested figures as rows `name of the part, name`."""
    rows: list[Row] = []
    for key, value in part.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            rows += _flat(value, f"{name}: ")
        elif isinstance(value, list) and any(isinstance(one, Mapping) for one in value):
            for number, one in enumerate(value[:_MOST_ROWS], 1):
                rows += _flat(one, f"{name} {number}: ") if isinstance(one, Mapping) else [(f"{name} {number}", one)]
        else:
            rows.append((name, value))
    return rows


def _table(rows: list[Row]) -> str:
    lines = "".join(f'<tr><th scope="row">{escape(name)}</th><td>{_value(value)}</td></tr>' for name, value in rows)
    return f'<table class="facts"><tbody>{lines}</tbody></table>' if lines else ""


def _section(title: str, content: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{content}</section>" if content else ""


def _footer(source: ReportSource) -> str:
    version = source.figures.versions.get("spiked", "unknown")
    return (
        f"<footer>Made by spiked {escape(version)}. Poses are camera to world, with OpenCV's axes: x right, y down, "
        "z forward. Exact figures are in report.json of the bundle.</footer>"
    )


def _duration(seconds: float) -> str:
    return f"{seconds * 1e3:.1f} ms" if seconds < 1 else f"{seconds:,.2f} s"
