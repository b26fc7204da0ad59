"""Whether this installation is whole, and can run a service with its settings: what `spiked doctor` looks at."""

import fcntl
import importlib
import os
import platform
import socket
import sqlite3
import ssl
from collections.abc import Iterator
from contextlib import closing
from importlib import metadata
from pathlib import Path
from urllib.parse import quote

from packaging.requirements import Requirement

from spiked import native
from spiked.blocks import instruction_sets
from spiked.errors import SpikedError
from spiked_service.base.version import installed_version
from spiked_service.operations.doctor import Diagnosis, DiagnosisStatus, memory_findings
from spiked_service.settings.settings import Settings, load_settings
from spiked_service.store.folder import default_folder, nearest_folder, space_at
from spiked_service.store.migrations import MIGRATIONS, schema_of, written_by

PAGE = Path(__file__).parents[1] / "page" / "index.html"
_LEAST_FREE_BYTES = 1 << 30
"""Space below which a recording of a camera lasts less than five seconds."""
_REINSTALL = "install it again: pip install --force-reinstall spiked, or apt-get install --reinstall spiked"


def requirements() -> list[Requirement]:
    """What the installed distribution needs, without its extras. Empty in an uninstalled tree."""
    try:
        found = [Requirement(text) for text in metadata.requires("spiked") or []]
    except metadata.PackageNotFoundError:
        return []
    return [one for one in found if one.marker is None or one.marker.evaluate({"extra": ""})]


def installed_packages() -> dict[str, str | None]:
    """Versions of the packages that spiked needs, None for one that is missing."""
    return {one.name: _version_of(one.name) for one in sorted(requirements(), key=lambda one: one.name.lower())}


def examine_installation(config: Path | None = None, data: Path | None = None) -> list[Diagnosis]:
    """Program, settings and data folder. Takes less than a second and changes nothing."""
    findings = [_program(), _packages(), _native(), _page()]
    try:
        configuration = load_settings({"data": data}, config)
    except SpikedError as error:
        return [*findings, Diagnosis("settings", DiagnosisStatus.PROBLEM, str(error), "see `spiked config show`")]
    settings = configuration.settings
    read = str(configuration.file) if configuration.file else "defaults, no file"
    findings.append(Diagnosis("settings", DiagnosisStatus.OK, read))
    folder = (settings.data or default_folder()).absolute()
    findings += [_data(folder), *_catalogue(folder), *_address(settings, folder), *_tls(settings)]
    return [*findings, *memory_findings()]


def _version_of(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _program() -> Diagnosis:
    found = f"{installed_version()}, in {Path(__file__).parents[2]}, Python {platform.python_version()}"
    return Diagnosis("spiked", DiagnosisStatus.OK, found)


def _packages() -> Diagnosis:
    name, wrong = "packages", []
    needed = requirements()
    for one in needed:
        version = _version_of(one.name)
        if version is None:
            wrong.append(f"{one.name} is missing")
        elif not one.specifier.contains(version, prereleases=True):
            wrong.append(f"{one.name} {version} is not {one.specifier}")
    if wrong:
        return Diagnosis(name, DiagnosisStatus.PROBLEM, "; ".join(wrong), _REINSTALL)
    return Diagnosis(name, DiagnosisStatus.OK, f"all {len(needed)} are there")


def _native() -> Diagnosis:
    """Whether the compiled modules load here, and which instructions they use."""
    name = "compiled modules"
    files = sorted(Path(native.__path__[0]).glob("_*.so"))
    for file in files:
        try:
            importlib.import_module(f"spiked.native.{file.name.partition('.')[0]}")
        except ImportError as error:
            return Diagnosis(name, DiagnosisStatus.PROBLEM, f"{file.name}: {error}", _REINSTALL)
    return Diagnosis(name, DiagnosisStatus.OK, f"{len(files)} load; instruction sets: {', '.join(instruction_sets())}")


def _page() -> Diagnosis:
    if not PAGE.is_file():
        todo = "install a wheel, or run `make page` in the checkout; the API works without"
        return Diagnosis("web page", DiagnosisStatus.WARNING, "it is not built", todo)
    return Diagnosis("web page", DiagnosisStatus.OK, "built")


def _data(folder: Path) -> Diagnosis:
    """Whether this user can write there, and how much fits."""
    name = "data folder"
    existing = nearest_folder(folder)
    if not os.access(existing, os.W_OK | os.X_OK):
        todo = "run this as the user of the service (sudo -u spiked spiked doctor), or name another folder with --data"
        return Diagnosis(name, DiagnosisStatus.PROBLEM, f"{existing} cannot be written by this user", todo)
    free = space_at(existing).free_bytes
    found = f"{folder}, {free / 1e9:.1f} GB free" + ("" if existing == folder else "; it is made at the first start")
    if free < _LEAST_FREE_BYTES:
        return Diagnosis(name, DiagnosisStatus.PROBLEM, found, "make room, or choose another folder with --data")
    return Diagnosis(name, DiagnosisStatus.OK, found)


def _catalogue(folder: Path) -> Iterator[Diagnosis]:
    """The schema of the catalogue, read without migrating it."""
    name, path = "catalogue", folder / "catalogue.sqlite"
    if not os.access(path, os.R_OK):
        return
    try:
        with closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True)) as connection:
            schema, writer = schema_of(connection), written_by(connection)
            ((captures,),) = connection.execute("SELECT count(*) FROM captures").fetchall()
    except sqlite3.Error as error:
        todo = "start the service, which rebuilds it from the files, or `spiked restore`; see docs/backup.md"
        yield Diagnosis(name, DiagnosisStatus.PROBLEM, f"{path} cannot be read: {error}", todo)
        return
    found = f"schema {schema} of {len(MIGRATIONS)}, {captures:,} captures"
    if schema > len(MIGRATIONS):
        by = f" by spiked {writer}" if writer else ""
        todo = "install that release again, or restore the copy in `backups` that was made before the migration"
        yield Diagnosis(name, DiagnosisStatus.PROBLEM, f"{found}: it was migrated{by}", todo)
    elif schema < len(MIGRATIONS):
        todo = "the next start migrates it, and keeps a copy in `backups`"
        yield Diagnosis(name, DiagnosisStatus.WARNING, f"{found}: of a former release", todo)
    else:
        yield Diagnosis(name, DiagnosisStatus.OK, found)


def _address(settings: Settings, folder: Path) -> Iterator[Diagnosis]:
    """Whether the port is free, unless the service of this data folder has it."""
    name, address = "address", f"{settings.host}:{settings.port}"
    if _in_use(folder):
        yield Diagnosis(name, DiagnosisStatus.OK, f"a service uses the data folder; `spiked health` asks {address}")
        return
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    try:
        with closing(socket.socket(family)) as one:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            one.bind((settings.host, settings.port))
    except OSError as error:
        todo = f"`ss -ltnp 'sport = :{settings.port}'` names the program; or choose another with --port or --host"
        yield Diagnosis(name, DiagnosisStatus.PROBLEM, f"{address}: {error.strerror}", todo)
        return
    yield Diagnosis(name, DiagnosisStatus.OK, f"{address} is free")


def _in_use(folder: Path) -> bool:
    """Whether a service holds the lock of the data folder."""
    try:
        with (folder / "lock").open() as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _tls(settings: Settings) -> Iterator[Diagnosis]:
    if settings.tls_certificate is None:
        return
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(settings.tls_certificate, settings.tls_key)
    except (OSError, ssl.SSLError) as error:
        todo = "let the user of the service read both files, and renew them together"
        yield Diagnosis("TLS", DiagnosisStatus.PROBLEM, f"{settings.tls_certificate}: {error}", todo)
        return
    yield Diagnosis("TLS", DiagnosisStatus.OK, f"{settings.tls_certificate}")
