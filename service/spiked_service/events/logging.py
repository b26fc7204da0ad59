"""The log: structured lines for people or programs on standard error, and as events for whoever listens."""

import logging
import sys
from collections.abc import MutableMapping
from typing import Any

import structlog

from spiked_service.events.bus import Bus, Topic
from spiked_service.events.payloads import LogPayload
from spiked_service.settings.settings import LogFormat, LogLevel

AUDIT = "spiked.audit"
"""Logger of what requests change in settings and tokens."""
_QUIET = ("uvicorn.access", "uvicorn.error", "asyncio", "websockets")
"""What they have to say below a warning is said better by our own lines."""


def configure_logs(level: LogLevel, format: LogFormat, bus: Bus | None = None) -> None:
    """Every line of this process and its libraries goes to standard error, and from `info` up to the bus."""
    shared: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True, key="at"),
        structlog.processors.format_exc_info,
    ]
    people = format is LogFormat.CONSOLE or (format is LogFormat.AUTO and sys.stderr.isatty())
    renderer: structlog.typing.Processor = (
        structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), timestamp_key="at")
        if people
        else structlog.processors.JSONRenderer()
    )
    structlog.configure(
        processors=[
            structlog.stdlib.filter_by_level,
            *shared,
            structlog.stdlib.ProcessorFormatter.wrap_for_formatter,
        ],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=False,
    )
    written = logging.StreamHandler(sys.stderr)
    written.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=shared,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, renderer],
        )
    )
    root = logging.getLogger()
    root.handlers = [written] if bus is None else [written, _ToBus(bus, shared)]
    for name in ("uvicorn", *_QUIET):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [], True
    for name in _QUIET:
        logging.getLogger(name).setLevel(logging.WARNING)
    set_level(level)


def set_level(level: LogLevel) -> None:
    """The least important line written from now on."""
    logging.getLogger().setLevel(level.upper())
    # Who changed settings and tokens is written at any level: a request can change the level.
    logging.getLogger(AUDIT).setLevel(logging.INFO)


def logger(name: str, **known: object) -> structlog.stdlib.BoundLogger:
    """A logger whose every line says what is known: `capture_id`, `reconstruction_id`, `role`."""
    bound: structlog.stdlib.BoundLogger = structlog.stdlib.get_logger(name, **known)
    return bound


class _ToBus(logging.Handler):
    """Publishes lines as events, but none that sending an event can cause."""

    def __init__(self, bus: Bus, shared: list[structlog.typing.Processor]) -> None:
        super().__init__(logging.INFO)
        self._bus = bus
        self._shared = shared

    def emit(self, record: logging.LogRecord) -> None:
        if record.name in _QUIET:
            return  # words about connections, sent over connections, would beget more of them
        line = self._line(record)
        fields = {name: value for name, value in line.items() if not name.startswith("_")}
        capture_id, reconstruction_id = fields.pop("capture_id", None), fields.pop("reconstruction_id", None)
        fields.pop("at", None)
        payload = LogPayload(
            level=str(fields.pop("level", record.levelname.lower())),
            event=str(fields.pop("event", "")),
            logger=str(fields.pop("logger", record.name)),
            **{name: _plain(value) for name, value in fields.items()},
        )
        self._bus.publish(Topic.LOG, payload, _text(capture_id), _text(reconstruction_id))

    def _line(self, record: logging.LogRecord) -> MutableMapping[str, Any]:
        if isinstance(record.msg, dict):
            return dict(record.msg)
        line: Any = {"event": record.getMessage(), "_record": record, "exc_info": record.exc_info}
        for processor in self._shared:
            line = processor(logging.getLogger(record.name), record.levelname.lower(), line)
        return dict(line)


def _plain(value: object) -> object:
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def _text(value: object) -> str | None:
    return None if value is None else str(value)
