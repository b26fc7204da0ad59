"""Settings: which source prevails, where a value comes from, and what is said of wrong ones."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from spiked_service.settings.settings import (
    LogLevel,
    SettingOrigin,
    Settings,
    load_settings,
    pass_on,
    reloadable,
    setting,
)

from spiked.errors import ConfigurationError


@pytest.fixture(autouse=True)
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No settings of the machine that runs the tests."""
    for name in [name for name in os.environ if name.startswith("SPIKED_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "spiked.toml"
    path.write_text(text)
    return path


def test_flags_over_environment_over_file_over_defaults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, 'host = "::1"\nport = 1000\nlog_level = "debug"\ndevices = ["sim:", "replay:a.dat"]\n')
    monkeypatch.setenv("SPIKED_PORT", "2000")
    monkeypatch.setenv("SPIKED_LOG_LEVEL", "error")
    found = load_settings({"log_level": "warning", "host": None}, path)
    assert (found.settings.host, found.settings.port, found.settings.log_level) == ("::1", 2000, LogLevel.WARNING)
    assert found.settings.devices == ["sim:", "replay:a.dat"]
    assert [found.origins[name] for name in ("host", "port", "log_level", "zmq")] == [
        SettingOrigin.FILE,
        SettingOrigin.ENVIRONMENT,
        SettingOrigin.FLAG,
        SettingOrigin.DEFAULT,
    ]
    assert found.file == path


def test_lists_in_the_environment_are_separated_by_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_ALLOWED_HOSTS", "camera.lab, spiked.example")
    assert load_settings().settings.allowed_hosts == ["camera.lab", "spiked.example"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("prot = 1", ["prot in ", "did you mean port?"]),
        ('log_level = "debgu"', ["log_level in ", "did you mean debug?"]),
        ('port = "many"', ["port in ", "'many'", "integer"]),
        ("port = 70000", ["65535"]),
        ("port = ", ["cannot read"]),
        ("[http]\nport = 1", ["http in "]),
        ('tls_key = "key.pem"', ["belong together"]),
    ],
)
def test_a_wrong_file_is_refused_with_the_nearest_right(tmp_path: Path, text: str, says: list[str]) -> None:
    with pytest.raises(ConfigurationError) as refused:
        load_settings(file=written(tmp_path, text))
    assert all(part in str(refused.value) for part in says), refused.value


NUMBERS = [
    name for name, one in Settings.model_fields.items() if {int, float} & {one.annotation, *get_args(one.annotation)}
]


@pytest.mark.parametrize("name", NUMBERS)
def test_every_number_is_finite_and_bounded(name: str) -> None:
    for value in ("inf", "-inf", "nan", "1e99", "9" * 40, "-1"):
        with pytest.raises(ConfigurationError, match=f"{name}: ") as refused:
            load_settings({name: value})
        assert value in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("text", ['["/a", "/b c"]', "/a, /b c", ' ["/a","/b c"] '])
def test_a_list_may_be_json(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    assert load_settings({"source_folders": text}).settings.source_folders == ["/a", "/b c"]
    monkeypatch.setenv("SPIKED_SOURCE_FOLDERS", text)
    assert load_settings().settings.source_folders == ["/a", "/b c"]


@pytest.mark.parametrize("text", ['["/a", "/b"', '["/a", 3]', '[{"a": 1}]'])
def test_a_list_that_is_wrong_json_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="--set source_folders: "):
        load_settings({"source_folders": text})


def test_an_address_in_brackets_is_no_json() -> None:
    assert load_settings({"allowed_hosts": "[::1], camera.lab"}).settings.allowed_hosts == ["[::1]", "camera.lab"]


def test_a_wrong_environment_or_flag_is_refused_by_its_own_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_LIMIT_RENDER", "3")
    with pytest.raises(ConfigurationError, match=r"SPIKED_LIMIT_RENDER: .* SPIKED_LIMIT_RENDERS\?"):
        load_settings()
    monkeypatch.delenv("SPIKED_LIMIT_RENDER")
    monkeypatch.setenv("SPIKED_ZMQ", "maybe")
    with pytest.raises(ConfigurationError, match=r"SPIKED_ZMQ: .*'maybe'"):
        load_settings()
    monkeypatch.delenv("SPIKED_ZMQ")
    with pytest.raises(ConfigurationError, match=r"--set retention_dyas: .* retention_days\?"):
        load_settings(dict([setting("retention-dyas=3")]))
    with pytest.raises(ConfigurationError, match="NAME=VALUE"):
        setting("port")


def test_a_secret_is_neither_shown_nor_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_TOKEN", "sesame")
    assert "sesame" not in json.dumps(load_settings().shown())
    with pytest.raises(ConfigurationError) as refused:
        load_settings({"token": 5})
    assert "5" not in str(refused.value)


def test_a_file_that_was_named_must_be_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPIKED_CONFIG", str(tmp_path / "none.toml"))
    with pytest.raises(ConfigurationError, match=r"none\.toml"):
        load_settings()


def test_the_users_own_file_is_found(tmp_path: Path) -> None:
    own = tmp_path / "config" / "spiked" / "spiked.toml"
    own.parent.mkdir(parents=True)
    own.write_text("port = 4000")
    assert load_settings().settings.port == 4000


def test_every_setting_is_described_and_what_is_bound_at_the_start_is_not_reloadable() -> None:
    assert all(field.description for field in Settings.model_fields.values())
    assert reloadable("limit_renders")
    assert not any(reloadable(name) for name in ("host", "port", "data", "devices", "zmq_port"))


def test_config_show_prints_each_origin(tmp_path: Path) -> None:
    path = written(tmp_path, "port = 9000")
    environment = {**os.environ, "SPIKED_LOG_LEVEL": "debug"}
    command = [sys.executable, "-m", "spiked_service", "config", "show", "--config", str(path), "--set", "zmq=no"]
    shown = subprocess.run([*command, "--json"], env=environment, capture_output=True, text=True, check=True).stdout
    rows = {row["key"]: (row["value"], row["origin"]) for row in json.loads(shown)}
    assert rows["port"] == (9000, "file")
    assert rows["log_level"] == ("debug", "environment")
    assert rows["zmq"] == (False, "flag")
    assert rows["host"] == ("127.0.0.1", "default")
    table = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert any(line.split()[:3] == ["port", "9000", "file"] for line in table.splitlines())


def test_the_switches_of_compiled_code_are_settings(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("SPIKED_RENDER", "SPIKED_SIMD"):
        monkeypatch.setenv(name, "")  # as good as not set; and whatever is put there is taken away again
    assert (load_settings().settings.render, load_settings().settings.simd) == (None, None)
    monkeypatch.setenv("SPIKED_RENDER", "cpu")
    assert load_settings().settings.render == "cpu"
    with pytest.raises(ConfigurationError, match=r"SPIKED_RENDER: .*'gpu'"):
        monkeypatch.setenv("SPIKED_RENDER", "gpu")
        load_settings()
    monkeypatch.setenv("SPIKED_RENDER", "")
    (tmp_path / "own.toml").write_text('render = "cpu"\nsimd = "baseline"\n')
    pass_on(load_settings(file=tmp_path / "own.toml").settings)
    run = subprocess.run(
        [sys.executable, "-m", "spiked_service", "version"], capture_output=True, text=True, check=True
    )
    assert "instruction sets: baseline\n" in run.stdout
    assert "renderer: cpu (SPIKED_RENDER asks for it)" in run.stdout


def test_a_forced_renderer_does_not_keep_the_settings_from_being_shown() -> None:
    run = subprocess.run(
        [sys.executable, "-m", "spiked_service", "config", "show"],
        env={**os.environ, "SPIKED_RENDER": "cpu", "SPIKED_SIMD": "baseline"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert "renderer: cpu" in run.stdout
