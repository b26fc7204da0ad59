"""The running daemon under systemd's eyes: notify, watchdog, reload, health, TLS."""

import asyncio
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import httpx
import pytest
from certificates import certificate
from spiked_service.base.health import CheckResult, CheckStatus, EventLoopHeartbeat, Health, failed
from spiked_service.operations.systemd import SystemdNotifier
from spiked_service.settings.reload import ReloadableSettings
from waiting import until

from spiked.client import ServiceUnreachableError, Spiked
from spiked.errors import ConfigurationError

DEADLINE_S = 20.0


class Systemd:
    """The other end of $NOTIFY_SOCKET."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address)
        self.socket.settimeout(DEADLINE_S)

    def until(self, wanted: str) -> list[str]:
        """Every message up to the one that says what is wanted."""
        messages = []
        while wanted not in (messages[-1:] or [""])[0]:
            messages.append(self.socket.recv(4096).decode())
        return messages


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Systemd]:
    one = Systemd(str(tmp_path / "notify"))
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    with closing(one.socket):
        yield one


def test_a_daemon_says_ready_alive_reloading_and_stopping(
    systemd: Systemd, daemon: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "200000")
    file = tmp_path / "spiked.toml"
    file.write_text("limit_renders = 3")
    one = daemon("--config", str(file))
    ready = systemd.until("READY=1")[-1]
    assert f"STATUS=serving at {one.address}" in ready
    assert httpx.get(f"{one.address}readyz").status_code == 200
    systemd.until("WATCHDOG=1")
    systemd.until("WATCHDOG=1")

    file.write_text("limit_renders = 5\nport = 9")
    one.process.send_signal(signal.SIGHUP)
    reloading = systemd.until("RELOADING=1")[-1]
    assert 0 < int(reloading.partition("MONOTONIC_USEC=")[2]) <= time.monotonic_ns() // 1000
    systemd.until("READY=1")
    assert value(one, "limit_renders") == 5

    one.process.send_signal(signal.SIGTERM)
    systemd.until("STOPPING=1")
    assert one.process.wait(DEADLINE_S) == 0


def test_a_service_that_does_not_live_is_not_vouched_for(systemd: Systemd, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "40000")
    lives = True
    notifier = SystemdNotifier()
    notifier.watch(lambda: lives)
    systemd.until("WATCHDOG=1")
    lives = False
    systemd.socket.settimeout(0.3)
    with pytest.raises(TimeoutError):
        while True:
            systemd.until("WATCHDOG=1")
    notifier.stopping()


def test_abstract_sockets_and_no_systemd(monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"spiked-test-{os.getpid()}"
    one = Systemd(f"\0{name}")
    monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}")
    with closing(one.socket):
        SystemdNotifier().ready("here")
        assert one.until("READY=1") == ["READY=1\nSTATUS=here"]
    SystemdNotifier().ready("nobody listens any more")
    monkeypatch.setenv("NOTIFY_SOCKET", "vsock:2:1")
    with pytest.raises(ConfigurationError, match="NOTIFY_SOCKET"):
        SystemdNotifier()
    monkeypatch.delenv("NOTIFY_SOCKET")
    SystemdNotifier().ready("nobody listens")


def value(daemon: Any, key: str) -> Any:
    items = daemon.http.get("configuration").json()["items"]
    return next(item["value"] for item in items if item["key"] == key)


def test_settings_are_reloaded_over_http_and_a_wrong_file_changes_nothing(
    daemon: Callable[..., Any], tmp_path: Path
) -> None:
    file = tmp_path / "spiked.toml"
    file.write_text("limit_renders = 3\nlimit_event_clients = 7")
    one = daemon("--config", str(file), "--set", "limit-event-clients=9")
    items = {item["key"]: item for item in one.http.get("configuration").json()["items"]}
    assert (items["limit_renders"]["value"], items["limit_renders"]["origin"]) == (3, "file")
    assert (items["limit_event_clients"]["value"], items["limit_event_clients"]["origin"]) == (9, "flag")

    file.write_text("limit_renders = 4\nhost = '::1'")
    answer = one.http.post("/configuration:reload")
    assert answer.json() == {"changed": ["limit_renders"], "needs_restart": ["host"]}
    assert (value(one, "limit_renders"), value(one, "host")) == (4, "127.0.0.1")

    file.write_text("limit_renders = 0")
    refused = one.http.post("/configuration:reload")
    assert refused.status_code == 422 and "limit_renders" in refused.json()["detail"]
    assert value(one, "limit_renders") == 4


def test_the_system_tells_of_itself(daemon: Callable[..., Any], tmp_path: Path) -> None:
    one = daemon()
    system = one.http.get("system").json()
    assert system["pid"] == one.process.pid
    assert system["data_folder"] == str(tmp_path / "data")
    assert 0 < system["disk"]["free_bytes"] <= system["disk"]["total_bytes"]
    assert system["disk"]["recording_of"] == "400x250 at 20 kHz"
    doctor = {item["name"]: item["finding"] for item in one.http.get("doctor").json()["items"]}["disk space"]
    minutes = int(re.search(r"(\d+) minutes of 400x250 at 20 kHz", doctor)[1])
    assert minutes == pytest.approx(system["disk"]["recording_s"] / 60, rel=0.1, abs=1), "one forecast"
    assert system["memory_bytes"] > 10e6
    assert system["uptime_s"] >= 0


def test_the_forecast_of_the_disk_is_that_of_the_cameras_that_run(daemon: Callable[..., Any]) -> None:
    one = daemon("--no-capture")
    for width in (96, 64):
        source = f"sim:?width={width}&height=64&pace=0.02"
        started = one.http.post("captures", json={"source": source, "reconstruct": False})
        path = f"captures/{started.json()['id']}"
        until(lambda path=path: one.http.get(path).json()["sensor"], "it runs")
    disk = one.http.get("system").json()["disk"]
    assert disk["recording_of"] == "96x64 at 20 kHz and 64x64 at 20 kHz"
    assert disk["recording_s"] == pytest.approx(disk["free_bytes"] / (20_000 * (96 + 64) * 64 / 8), rel=0.01)
    finding = {item["name"]: item["finding"] for item in one.http.get("doctor").json()["items"]}["disk space"]
    minutes = int(re.search(r"(\d+) minutes of 96x64 at 20 kHz and 64x64 at 20 kHz", finding)[1])
    assert minutes == pytest.approx(disk["recording_s"] / 60, rel=0.1, abs=1), "one forecast"
    assert one.http.get("tokens").json() == {"items": []}
    checks = httpx.get(f"{one.address}readyz").json()["checks"]
    assert "zmq" in [check["name"] for check in checks]


def test_a_failing_or_broken_check_makes_the_service_unready() -> None:
    health = Health()
    health.add("sound", lambda: (CheckStatus.OK, ""), life=True)
    health.add("full", lambda: (CheckStatus.WARNING, "it is getting full"))
    assert [finding.name for finding in health.readiness()] == ["sound", "full"]
    assert not failed(health.readiness())

    def broken() -> tuple[CheckStatus, str]:
        raise OSError("gone")

    health.add("broken", broken)
    assert not failed(health.life())
    assert failed(health.readiness())
    assert health.readiness()[-1] == CheckResult(
        "broken", CheckStatus.FAILED, "the check itself failed: OSError('gone')"
    )


def test_an_event_loop_that_hangs_is_seen() -> None:
    heartbeat = EventLoopHeartbeat(period_s=0.01, limit_s=1)
    seen = [heartbeat.check()[0]]

    async def loop() -> None:
        beating = asyncio.create_task(heartbeat.beat())
        await asyncio.sleep(0.05)
        seen.append(heartbeat.check()[0])
        time.sleep(1.2)  # what a loop must never do
        seen.append(heartbeat.check()[0])
        beating.cancel()

    asyncio.run(loop())
    assert seen == [CheckStatus.OK, CheckStatus.OK, CheckStatus.FAILED]


def test_tls_with_a_certificate_that_is_changed_while_serving(daemon: Callable[..., Any], tmp_path: Path) -> None:
    (first, key1), (second, key2) = certificate(tmp_path, "first"), certificate(tmp_path, "second")
    file = tmp_path / "spiked.toml"
    file.write_text(f"tls_certificate = '{first}'\ntls_key = '{key1}'")
    one = daemon("--config", str(file))
    assert one.address.startswith("https://")
    answer = httpx.get(f"{one.address}healthz", verify=ssl.create_default_context(cafile=str(first)))
    assert answer.status_code == 200
    with Spiked(one.address) as client, pytest.raises(ServiceUnreachableError, match="set SSL_CERT_FILE"):
        client.system()

    file.write_text(f"tls_certificate = '{second}'\ntls_key = '{key1}'")  # do not belong together
    trusts_first = httpx.Client(verify=ssl.create_default_context(cafile=str(first)))
    refused = trusts_first.post(f"{one.address}api/v1/configuration:reload")
    assert refused.status_code == 422 and "belong together" in refused.json()["detail"]
    assert httpx.get(f"{one.address}healthz", verify=ssl.create_default_context(cafile=str(first))).status_code == 200

    file.write_text(f"tls_certificate = '{second}'\ntls_key = '{key2}'")
    assert trusts_first.post(f"{one.address}api/v1/configuration:reload").status_code == 200
    trusts_first.close()
    assert httpx.get(f"{one.address}healthz", verify=ssl.create_default_context(cafile=str(second))).status_code == 200


def test_a_certificate_that_cannot_be_used_ends_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "x.pem").write_text("not a certificate")
    flags = ["--set", f"tls_certificate={tmp_path / 'x.pem'}", "--set", f"tls_key={tmp_path / 'x.pem'}"]
    command = [sys.executable, "-m", "spiked_service", "serve", "--port", "0", "--data", str(tmp_path), *flags]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "x.pem" in done.stderr and done.stderr.count("\n") == 1


def test_listeners_keep_the_old_settings_when_one_refuses_the_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv("SPIKED_LIMIT_RENDERS", "2")
    live = ReloadableSettings()
    seen = []
    live.on_change(lambda now: seen.append(now.limit_renders))

    def refuse(now: Any) -> None:
        if now.limit_renders == 3:
            raise ConfigurationError("not three")

    live.on_change(refuse)
    monkeypatch.setenv("SPIKED_LIMIT_RENDERS", "3")
    with pytest.raises(ConfigurationError, match="not three"):
        live.reload()
    assert live.now.limit_renders == 2
    assert seen == [2, 3, 2]
