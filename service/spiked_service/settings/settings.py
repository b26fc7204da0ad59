"""The service's settings: what they are, where each value comes from, and which can change while it runs."""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, get_args
from urllib.parse import SplitResult, urlsplit

from pydantic import AfterValidator, BeforeValidator, Field, SecretStr, ValidationError
from pydantic.config import JsonDict
from pydantic.fields import FieldInfo
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
    TomlConfigSettingsSource,
)

from spiked.errors import ConfigurationError

_PREFIX = "SPIKED_"
NOT_SETTINGS = frozenset(
    {
        "SPIKED_CONFIG",
        "SPIKED_CLIENT_TOKEN",
        "SPIKED_ADDRESS",
        "SPIKED_SPLAT_TRANSFORM",
        "SPIKED_FUZZ_SECONDS",
        "SPIKED_SCRATCH",
    }
)
"""Environment variables with our prefix that say something else: to examples, agents, the page's build, and tests."""
_PASSED_ON: set[str] = set()
"""Switches that `pass_on` has put into the environment of this process: they were not set in it."""
_SWITCHES = ("render", "simd")
"""Settings that compiled modules and workers read from the environment, where an empty one is as good as none."""
MIB = 1 << 20
"""Bytes."""
MOST_BYTES = 1 << 60
"""Upper bound of settings in bytes."""
MOST_DAYS = 36_500.0
"""Upper bound of settings in days: a century."""


class LogLevel(StrEnum):
    """The least important line that is written."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class LogFormat(StrEnum):
    """How a line of the log is written."""

    AUTO = "auto"
    """For people on a terminal, otherwise JSON."""
    CONSOLE = "console"
    JSON = "json"


class Renderer(StrEnum):
    """Which rasteriser does the work."""

    CPU = "cpu"
    CUDA = "cuda"


class JobEngine(StrEnum):
    """What starts jobs."""

    LOCAL = "local"
    """This machine."""
    RAY = "ray"
    SUBMITIT = "submitit"
    """Slurm, or processes of this machine."""


class InstructionSet(StrEnum):
    """Which compiled kernels do the work."""

    AVX512 = "avx512"
    AVX2 = "avx2"
    NEON = "neon"
    BASELINE = "baseline"


def _parts(value: object) -> object:
    """Texts separated by commas, or a JSON list of texts. An address such as [::1] is neither."""
    if not isinstance(value, str):
        return value
    if value.lstrip().startswith("[") and '"' in value:
        try:
            return json.loads(value)
        except ValueError as error:
            raise ValueError("should be texts separated by commas, or a JSON list of texts") from error
    return [part.strip() for part in value.split(",") if part.strip()]


Words = Annotated[list[str], NoDecode, BeforeValidator(_parts)]
"""In the environment and after --set: separated by commas, or a JSON list."""


def _has_port(parts: SplitResult) -> bool:
    """Whether its port is left out or a number of one."""
    try:
        return parts.port != 0
    except ValueError:
        return False


def _addresses(values: list[str]) -> list[str]:
    """Addresses of web servers. Raises ValueError for anything else."""
    for value in values:
        parts = urlsplit(value)
        if parts.scheme not in ("http", "https") or not parts.hostname or not _has_port(parts):
            raise ValueError(f"{value!r} is no address: write http://HOST/PATH or https://HOST/PATH")
    return values


def _pairs(values: list[str]) -> list[str]:
    """Texts NAME=VALUE. Raises ValueError for anything else."""
    for value in values:
        name, sign, _ = value.partition("=")
        if not sign or not name.isidentifier():
            raise ValueError(f"{value!r} is no pair: write NAME=VALUE")
    return values


_OWN_FLAGS = {
    "devices": "device",
    "log_level": "log-level",
    "log_format": "log-format",
    "token_file": "token-file",
} | {name: name for name in ("data", "runtime", "host", "port", "token", "zmq")}
"""Settings that `spiked serve` has an option for; the others are given with --set."""
_LIVE: JsonDict = {"reloadable": True}


class Settings(BaseSettings):
    """Every setting, by the one name that it has in TOML, as `SPIKED_NAME` and as `--name`."""

    model_config = SettingsConfigDict(env_prefix=_PREFIX, extra="forbid", frozen=True, allow_inf_nan=False)

    data: Path | None = Field(None, description="Folder of catalogue and recordings; $XDG_DATA_HOME/spiked if not set.")
    runtime: Path | None = Field(None, description="Folder for what lives only while the service does.")
    devices: Words = Field([], description="Cameras: usb0, replay:FILE, sim:, with options after a question mark.")
    host: str = Field("127.0.0.1", description="Address to listen at; beyond loopback every request needs a token.")
    port: int = Field(8650, ge=0, le=65535, description="Port of HTTP and WebSocket; 0 takes a free one.")
    allowed_hosts: Words = Field(
        [], description="Names by which browsers may call the service, besides its address and localhost."
    )
    source_folders: Words = Field(
        [],
        description="Folders whose files requests may name as replay: or pcie: sources; where the service was started, "
        "if none.",
        json_schema_extra=_LIVE,
    )
    webhooks: Annotated[Words, AfterValidator(_addresses)] = Field(
        [],
        description="Addresses that get a POST with the job when a reconstruction has ended.",
        json_schema_extra=_LIVE,
    )
    zmq: bool = Field(True, description="Whether events also go out over ZeroMQ, on loopback only.")
    zmq_port: int | None = Field(
        None, ge=0, le=65533, description="First of three ports; the three after `port` if not set, 0 takes free ones."
    )
    token: SecretStr | None = Field(
        None, description="One more token that opens the service, for containers; `spiked token` keeps better ones."
    )
    token_file: Path | None = Field(
        None, description="File with that token, as containers mount their secrets; instead of `token`."
    )
    require_token: bool = Field(False, description="Whether requests on loopback need a token too.")
    tls_certificate: Path | None = Field(
        None, description="PEM file with the certificate chain.", json_schema_extra=_LIVE
    )
    tls_key: Path | None = Field(None, description="PEM file with its private key.", json_schema_extra=_LIVE)
    log_level: LogLevel = Field(LogLevel.INFO, description="Least important line written.", json_schema_extra=_LIVE)
    log_format: LogFormat = Field(LogFormat.AUTO, description="console, json, or by where the log goes.")
    limit_body_bytes: int = Field(MIB, ge=1024, le=MOST_BYTES, description="Longest request.", json_schema_extra=_LIVE)
    limit_chunk_bytes: int = Field(
        64 * MIB, ge=MIB, le=MOST_BYTES, description="Longest piece of an upload.", json_schema_extra=_LIVE
    )
    limit_upload_bytes: int = Field(
        64 << 30, ge=MIB, le=MOST_BYTES, description="Longest recording that may be uploaded.", json_schema_extra=_LIVE
    )
    limit_requests_per_s: float = Field(
        1000.0, gt=0, le=1e6, description="Requests a second from one address, on average.", json_schema_extra=_LIVE
    )
    limit_requests_burst: int = Field(
        2000, ge=1, le=1_000_000, description="Requests from one address at once.", json_schema_extra=_LIVE
    )
    limit_renders: int = Field(8, ge=1, le=1000, description="Views rendered at a time.", json_schema_extra=_LIVE)
    limit_trajectories: int = Field(
        8, ge=1, le=1000, description="Trajectories sent at a time.", json_schema_extra=_LIVE
    )
    limit_event_clients: int = Field(
        100, ge=1, le=100_000, description="WebSocket clients at a time.", json_schema_extra=_LIVE
    )
    limit_captures: int = Field(
        4,
        ge=1,
        le=64,
        description="Devices that captures run on or that are armed at a time.",
        json_schema_extra=_LIVE,
    )
    reconstruction_workers: int = Field(
        1,
        ge=1,
        le=1000,
        description="Reconstructions at a time; live ones count, but never wait.",
        json_schema_extra=_LIVE,
    )
    executor: JobEngine = Field(
        JobEngine.LOCAL, description="What runs queued reconstructions: local, ray, or submitit for Slurm."
    )
    executor_address: str | None = Field(
        None, description="Ray's head, HOST:PORT or ray://HOST:PORT; for submitit slurm or local; found if not set."
    )
    executor_store: str | None = Field(
        None,
        description="Where other machines find and leave files: a shared folder file:///PATH, or s3://BUCKET/PREFIX; "
        "the folder cluster of `data` if not set.",
    )
    executor_url: str | None = Field(
        None, description="Address at which other machines reach this service; its own if not set."
    )
    executor_cpus: int = Field(1, ge=1, le=1024, description="Cores of a job on other machines.")
    executor_gpus: float = Field(0, ge=0, le=64, description="GPUs of a job on other machines.")
    executor_lease_s: float = Field(
        60.0, ge=2, le=86_400, description="Silence of another machine after which its job begins again."
    )
    executor_cache_bytes: int = Field(
        20_000_000_000,
        ge=0,
        le=MOST_BYTES,
        description="Bytes of recordings that each of the other machines keeps for further jobs; 0 for none.",
    )
    executor_options: Annotated[Words, AfterValidator(_pairs)] = Field(
        [], description="NAME=VALUE for submitit, such as slurm_partition=gpu."
    )
    retention_days: float | None = Field(
        None,
        gt=0,
        le=MOST_DAYS,
        description="Remove captures that are older, unless marked to be kept.",
        json_schema_extra=_LIVE,
    )
    retention_bytes: int | None = Field(
        None,
        gt=0,
        le=MOST_BYTES,
        description="Remove the oldest beyond this size of all, unless marked.",
        json_schema_extra=_LIVE,
    )
    deleted_days: float = Field(
        7.0, ge=0, le=MOST_DAYS, description="How long a removed capture can be restored.", json_schema_extra=_LIVE
    )

    render: Renderer | None = Field(None, description="cpu or cuda; the GPU if one can render here, if not set.")
    simd: InstructionSet | None = Field(
        None, description="Instruction set: avx512, avx2, neon or baseline; the widest of this machine if not set."
    )

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Only what `load_settings` has put together, so that it knows each value's origin."""
        return (init_settings,)


class SettingOrigin(StrEnum):
    """Where a value comes from; later ones prevail."""

    DEFAULT = "default"
    FILE = "file"
    ENVIRONMENT = "environment"
    FLAG = "flag"


@dataclass(frozen=True)
class Configuration:
    """Settings with the origin of each, and the file that was read."""

    settings: Settings
    origins: Mapping[str, SettingOrigin]
    file: Path | None

    def shown(self) -> dict[str, object]:
        """Each value as it may be shown: without secrets."""
        return dict(self.settings.model_dump(mode="json"))


def reloadable(name: str) -> bool:
    """Whether a running service takes a new value of this setting."""
    extra = Settings.model_fields[name].json_schema_extra
    return isinstance(extra, dict) and bool(extra.get("reloadable"))


def settings_file(given: Path | None = None) -> Path | None:
    """The file to read: the one given, $SPIKED_CONFIG, the user's own, the system's. Raises ConfigurationError if a
    file that was named is not there."""
    named = given or (Path(text) if (text := os.environ.get("SPIKED_CONFIG")) else None)
    if named is not None:
        if not named.is_file():
            raise ConfigurationError(f"there is no configuration file {named}")
        return named
    return next((path for path in (own_file(), Path("/etc/spiked/spiked.toml")) if path.is_file()), None)


def own_file() -> Path:
    """The user's own file, which need not exist."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "spiked" / "spiked.toml"


def load_settings(flags: Mapping[str, object] | None = None, file: Path | None = None) -> Configuration:
    """Defaults, then TOML, then SPIKED_*, then flags (None: not given).

    Raises ConfigurationError for a key or value that cannot be, and names the nearest that can.
    """
    path = settings_file(file)
    layers = {
        SettingOrigin.FILE: _from_file(path) if path else {},
        SettingOrigin.ENVIRONMENT: _from_environment(),
        SettingOrigin.FLAG: {name: value for name, value in (flags or {}).items() if value is not None},
    }
    values: dict[str, Any] = {}
    origins = dict.fromkeys(Settings.model_fields, SettingOrigin.DEFAULT)
    for origin, layer in layers.items():
        for name, value in layer.items():
            if name not in Settings.model_fields:
                raise ConfigurationError(f"{_place(name, origin, path)}: there is no such setting{_nearest(name)}")
            values[name] = value
            origins[name] = origin
    try:
        settings = Settings(**values)
    except ValidationError as error:
        raise ConfigurationError(_wrong(error, origins, path)) from error
    if (settings.tls_certificate is None) != (settings.tls_key is None):
        raise ConfigurationError("tls_certificate and tls_key belong together: give both, or neither")
    return Configuration(settings, origins, path)


def pass_on(settings: Settings) -> None:
    """Put what compiled modules and worker processes read from the environment into it."""
    for name in _SWITCHES:
        value, variable = getattr(settings, name), _PREFIX + name.upper()
        if value is None or os.environ.get(variable) == value:
            continue
        if variable not in os.environ:
            _PASSED_ON.add(name)
        os.environ[variable] = value


def setting(text: str) -> tuple[str, str]:
    """A flag NAME=VALUE. Raises ConfigurationError."""
    name, sign, value = text.partition("=")
    if not sign:
        raise ConfigurationError(f"--set {text}: write NAME=VALUE; `spiked config show` lists the names")
    return name.strip().replace("-", "_"), value


def _from_file(path: Path) -> dict[str, Any]:
    try:
        return dict(TomlConfigSettingsSource(Settings, toml_file=path)())
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"cannot read {path}: {error}") from error


def _from_environment() -> dict[str, Any]:
    for name in os.environ:
        key = name.removeprefix(_PREFIX).lower()
        if name.startswith(_PREFIX) and name not in NOT_SETTINGS and key not in Settings.model_fields:
            raise ConfigurationError(f"{name}: there is no such setting{_nearest(key, _PREFIX)}")
    try:
        values = EnvSettingsSource(Settings)()
    except SettingsError as error:
        raise ConfigurationError(f"the environment: {error}") from error
    values = {name: value for name, value in values.items() if name not in _PASSED_ON}
    return {name: value for name, value in values.items() if value or name not in _SWITCHES}


def _place(name: str, origin: SettingOrigin, path: Path | None) -> str:
    match origin:
        case SettingOrigin.FILE:
            return f"{name} in {path}"
        case SettingOrigin.ENVIRONMENT:
            return f"{_PREFIX}{name.upper()}"
        case SettingOrigin.FLAG:
            return flag_of(name).partition("=")[0]
        case SettingOrigin.DEFAULT:
            return name


def _nearest(name: str, prefix: str = "") -> str:
    found = get_close_matches(name, Settings.model_fields, n=1)
    return f"; did you mean {prefix}{found[0].upper() if prefix else found[0]}?" if found else ""


def _wrong(error: ValidationError, origins: Mapping[str, SettingOrigin], path: Path | None) -> str:
    messages = []
    for one in error.errors(include_url=False):
        name = str(one["loc"][0])
        what = "" if name == "token" else f" {one['input']!r}"
        message = one["msg"][0].lower() + one["msg"][1:]
        messages.append(f"{_place(name, origins[name], path)}: {message}, not{what or ' this'}{_near_value(name, one)}")
    return "; ".join(messages)


def _near_value(name: str, error: Mapping[str, Any]) -> str:
    kind = Settings.model_fields[name].annotation
    members = _members(kind)
    found = get_close_matches(str(error["input"]).lower(), members, n=1)
    return f"; did you mean {found[0]}?" if found else ""


def _members(kind: Any) -> list[str]:
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return [str(member) for member in kind]
    return [member for part in get_args(kind) for member in _members(part)]


def flag_of(name: str) -> str:
    """How `spiked serve` takes a setting: an option of its own, or `--set NAME=VALUE`."""
    return f"--{_OWN_FLAGS[name]}" if name in _OWN_FLAGS else f"--set {name}=VALUE"


def field(name: str) -> FieldInfo:
    """What is declared of a setting."""
    return Settings.model_fields[name]
