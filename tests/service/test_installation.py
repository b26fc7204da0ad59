"""`spiked doctor`, `spiked health`, `spiked version --json`: what an installation says of itself."""

import json
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import typer
from certificates import certificate
from spiked_service.cli.commands.health import address_of, health
from spiked_service.cli.main import app
from spiked_service.operations import installation
from spiked_service.operations.doctor import Diagnosis, DiagnosisStatus
from spiked_service.operations.installation import examine_installation
from spiked_service.settings.settings import Settings
from spiked_service.store.catalogue import Catalogue
from spiked_service.store.folder import DataFolder
from spiked_service.store.migrations import MIGRATIONS
from typer.testing import CliRunner

from spiked.errors import ConfigurationError

from .store.test_migrations import SCHEMAS, made_of


def found(data: Path, config: Path | None = None) -> dict[str, Diagnosis]:
    return {finding.name: finding for finding in examine_installation(config, data)}


def file_with(folder: Path, text: str) -> Path:
    path = folder / "spiked.toml"
    path.write_text(text)
    return path


def test_a_whole_installation_has_no_problem(tmp_path: Path) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
    config = file_with(tmp_path, f"port = {port}\n")
    done = CliRunner().invoke(app, ["doctor", "--config", str(config), "--data", str(tmp_path / "data"), "--json"])
    findings = {finding["name"]: finding for finding in json.loads(done.output)}
    assert done.exit_code == 0, done.output
    assert {"spiked", "packages", "compiled modules", "web page", "settings", "data folder", "address"} <= set(findings)
    assert all(finding["status"] == "ok" or finding["what_to_do"] for finding in findings.values())
    assert "made at the first start" in findings["data folder"]["finding"]
    assert not (tmp_path / "data").exists()


def test_packages_that_are_missing_or_too_old_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    wanted = ["numpy>=1.26", "scipy>=999", "no-such-package>=1", 'h5py>=999; extra == "hdf5"']
    monkeypatch.setattr(installation.metadata, "requires", lambda name: wanted)
    packages = found(tmp_path)["packages"]
    assert packages.status is DiagnosisStatus.PROBLEM and "pip install" in (packages.what_to_do or "")
    assert "scipy" in packages.finding and "no-such-package is missing" in packages.finding
    assert "numpy" not in packages.finding and "h5py" not in packages.finding


def test_settings_that_cannot_be_are_the_finding(tmp_path: Path) -> None:
    settings = found(tmp_path, file_with(tmp_path, "prot = 1\n"))["settings"]
    assert settings.status is DiagnosisStatus.PROBLEM and "did you mean port?" in settings.finding


def test_a_port_in_use_and_bad_certificates_are_problems(tmp_path: Path) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        port = taken.getsockname()[1]
        pem = tmp_path / "x.pem"
        pem.write_text("nothing")
        text = f"port = {port}\ntls_certificate = '{pem}'\ntls_key = '{pem}'\n"
        findings = found(tmp_path, file_with(tmp_path, text))
        assert findings["address"].status is findings["TLS"].status is DiagnosisStatus.PROBLEM
        assert f":{port}" in (findings["address"].what_to_do or "")
        folder = DataFolder(tmp_path / "data")
        assert "a service uses the data folder" in found(folder.path)["address"].finding
        folder.close()


def test_the_schema_of_the_catalogue_is_told_and_not_changed(tmp_path: Path) -> None:
    path = made_of(SCHEMAS[0], tmp_path / "catalogue.sqlite")
    before = path.read_bytes()
    catalogue = found(tmp_path)["catalogue"]
    assert (catalogue.status, path.read_bytes()) == (DiagnosisStatus.WARNING, before)
    assert f"schema {SCHEMAS[0].stem} of {len(MIGRATIONS)}, 2 captures" in catalogue.finding
    Catalogue(path).close()
    assert found(tmp_path)["catalogue"].status is DiagnosisStatus.OK
    path.write_bytes(b"no database" * 100)
    assert found(tmp_path)["catalogue"].status is DiagnosisStatus.PROBLEM


def test_version_as_json_has_what_a_report_needs() -> None:
    done = CliRunner().invoke(app, ["version", "--json"])
    told = json.loads(done.output)
    assert told["catalogue_schema"] == len(MIGRATIONS) and told["packages"]["numpy"]
    assert told["spiked"] in CliRunner().invoke(app, ["version"]).output


def test_health_finds_the_service_by_its_settings(daemon: Callable[..., Any], tmp_path: Path) -> None:
    chain, key = certificate(tmp_path, "elsewhere")
    one = daemon("--token", "secret", "--set", "require_token=true", "--set", f"tls_certificate={chain}", "--set",
                 f"tls_key={key}")  # fmt: skip
    command = [sys.executable, "-m", "spiked_service", "health", "--address", one.address]
    done = subprocess.run([*command, "--ready"], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "disk" in done.stdout, done
    one.close()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "does not answer" in done.stderr


def test_the_address_asked_is_on_this_machine() -> None:
    assert address_of(Settings(host="0.0.0.0", port=9)) == "http://127.0.0.1:9"
    pem = Path("x.pem")
    assert address_of(Settings(host="::", port=9, tls_certificate=pem, tls_key=pem)) == "https://[::1]:9"
    with pytest.raises(ConfigurationError, match="--address"):
        address_of(Settings(port=0))


def test_what_is_no_service_is_not_healthy() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as silent:
        port = silent.getsockname()[1]
    with pytest.raises(typer.Exit):
        health(address=f"http://127.0.0.1:{port}")
