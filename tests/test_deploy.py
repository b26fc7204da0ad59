"""What is in deploy/ fits the program: settings that exist, metrics that exist, a unit that systemd reads."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families
from spiked_service.base.health import CheckStatus, Health
from spiked_service.base.limits import ConcurrencyLimit
from spiked_service.events.bus import Bus
from spiked_service.operations.metrics import Metrics, MetricsSource, RingSample
from spiked_service.settings.settings import Settings, load_settings
from spiked_service.store.rows import CaptureState, ConsumerCounters, Counters, Grade, JobState

from spiked.ring import DeviceState, Policy

DEPLOY = Path(__file__).parents[1] / "deploy"
GPU = DEPLOY.parent / "evaluation/gpu"


def series() -> list[tuple[str, dict[str, str]]]:
    """Names and labels of all series of a service with a capture."""
    consumer = ConsumerCounters("recorder", Policy.PRIORITY, 8, 0, 0, 0.0, False)
    counters = Counters(DeviceState.STREAMING, "", 8, {"usb": 0}, 8, (consumer,))
    health = Health()
    health.add("disk", lambda: (CheckStatus.OK, ""))
    source = MetricsSource(
        lambda: [RingSample("a", "usb0", counters, over=False)],
        lambda: dict.fromkeys(map(str, CaptureState), 0),
        lambda: dict.fromkeys(map(str, Grade), 0),
        lambda: dict.fromkeys(map(str, JobState), 0),
        lambda: {"recorder": 1},
        lambda: Path("/"),
    )
    metrics = Metrics(source, Bus(), health, {"renders": ConcurrencyLimit("renders", 1)})
    metrics.request_s.labels("GET", "/", "200").observe(0.01)
    families = text_string_to_metric_families(metrics.exposition().decode())
    return [(sample.name, sample.labels) for family in families for sample in family.samples]


def exposed() -> set[str]:
    """Names of all series of a service with a capture."""
    return {name for name, _ in series()}


def queried(expressions: list[str]) -> set[str]:
    return {name for text in expressions for name in re.findall(r"\b(?:spiked|process)_[a-z_]+", text)}


def test_alerts_ask_for_metrics_that_exist_and_say_what_to_do() -> None:
    rules = yaml.safe_load((DEPLOY / "prometheus/alerts.yml").read_text())["groups"][0]["rules"]
    assert queried([rule["expr"] for rule in rules]) <= exposed()
    assert all(rule["annotations"]["what_to_do"] for rule in rules)
    there = series()
    for rule in rules:
        for name, label, operator, wanted in re.findall(r'(\w+)\{(\w+)(=~?)"([^"]*)"', rule["expr"]):
            values = {labels[label] for other, labels in there if other == name}
            asked = set(wanted.split("|")) if operator == "=~" else {wanted}
            assert asked <= values or name in ("up", "spiked_http_request_seconds_count"), rule["alert"]
    degraded = next(rule for rule in rules if rule["alert"] == "SpikedCapturesDegraded")
    assert degraded["expr"] == 'sum(delta(spiked_recordings{grade=~"degraded|bad"}[1h])) > 0'
    scrape = yaml.safe_load((DEPLOY / "prometheus/prometheus.yml").read_text())
    assert all((DEPLOY / "prometheus" / name).is_file() for name in scrape["rule_files"])


def test_the_dashboard_asks_for_metrics_that_exist() -> None:
    panels = json.loads((DEPLOY / "grafana/spiked.json").read_text())["panels"]
    asked = queried([target["expr"] for panel in panels for target in panel["targets"]])
    assert asked <= exposed()
    assert {"spiked_frames_received_total", "spiked_frames_lost_total", "spiked_ring_fill_ratio"} <= asked
    places = [(panel["gridPos"]["x"], panel["gridPos"]["y"]) for panel in panels]
    assert len(set(places)) == len(places)


def test_the_settings_file_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("SPIKED_")]:
        monkeypatch.delenv(name)
    text = (DEPLOY / "spiked.toml").read_text()
    assert load_settings(file=DEPLOY / "spiked.toml").settings.devices == ["usb0"]
    commented = re.findall(r"^# ([a-z_]+) = ", text, re.MULTILINE)
    assert set(commented) <= set(Settings.model_fields)


@pytest.mark.parametrize(
    "file",
    ["systemd/spiked.service", "container/Containerfile", "compose/compose.yaml", "kubernetes/spiked.yaml"],
)
def test_the_environment_they_set_is_settings(file: str) -> None:
    lines = (line for line in (DEPLOY / file).read_text().splitlines() if not line.lstrip().startswith("#"))
    names = re.findall(r"\bSPIKED_[A-Z_]+(?=[=:,])", "\n".join(lines))
    assert names
    assert {name.removeprefix("SPIKED_").lower() for name in names} <= set(Settings.model_fields)


def test_systemd_reads_the_unit(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("needs systemd-analyze")
    unit = tmp_path / "spiked.service"
    unit.write_text((DEPLOY / "systemd/spiked.service").read_text().replace("/opt/spiked/bin/spiked", sys.executable))
    command = ["systemd-analyze", "verify", "--man=no", "--generators=no", str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    unit.write_text(unit.read_text().replace("[Service]", "[Service]\nExecStop=/nowhere/at/all"))
    assert "/nowhere/at/all" in subprocess.run(command, capture_output=True, text=True, check=False).stderr


def test_kubernetes_takes_the_manifests() -> None:
    kubernetes_validate = pytest.importorskip("kubernetes_validate", reason="needs kubernetes-validate")
    documents = list(yaml.safe_load_all((DEPLOY / "kubernetes/spiked.yaml").read_text()))
    for one in documents:
        kubernetes_validate.validate(one, kubernetes_validate.latest_version(), strict=True)
    (pod,) = (one["spec"]["template"]["spec"] for one in documents if one["kind"] == "StatefulSet")
    volumes = {volume["name"] for volume in pod["volumes"]} | {"data"}
    assert {mount["name"] for mount in pod["containers"][0]["volumeMounts"]} == volumes
    pod["securityContext"]["runAsNonRoots"] = True
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(documents[-1], kubernetes_validate.latest_version(), strict=True)


def test_kubernetes_takes_the_pods_of_the_ray_cluster() -> None:
    """KubeRay's own schema is not at hand: its pods are checked, and the fields that this project chose."""
    kubernetes_validate = pytest.importorskip("kubernetes_validate", reason="needs kubernetes-validate")
    cluster = yaml.safe_load((DEPLOY / "kubernetes/ray.yaml").read_text())
    groups = [cluster["spec"]["headGroupSpec"], *cluster["spec"]["workerGroupSpecs"]]
    for group in groups:
        pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "one"}, **group["template"]}
        kubernetes_validate.validate(pod, kubernetes_validate.latest_version(), strict=True)
        assert pod["spec"]["securityContext"]["runAsNonRoot"]
    text = (DEPLOY / "kubernetes/ray.yaml").read_text()
    named = {name.lower() for name in re.findall(r"SPIKED_(EXECUTOR[A-Z_]*)=", text)}
    assert named == {"executor", "executor_address", "executor_url", "executor_store"} <= set(Settings.model_fields)


def test_ray_takes_the_cluster_file() -> None:
    ray = pytest.importorskip("ray.autoscaler._private.util", reason="needs ray")
    given = yaml.safe_load((DEPLOY / "ray/cluster.yaml").read_text())
    ray.validate_config(ray.prepare_config(given))
    with pytest.raises(Exception, match="setup_command"):
        ray.validate_config(ray.prepare_config({**given, "setup_command": []}))


def test_the_settings_for_slurm_are_settings() -> None:
    settings = load_settings(file=DEPLOY / "slurm/spiked.toml").settings
    assert settings.executor == "submitit" and settings.executor_url is not None


def test_compose_takes_the_file() -> None:
    pytest.importorskip("check_jsonschema", reason="needs check-jsonschema")
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec"]
    done = subprocess.run([*command, DEPLOY / "compose/compose.yaml"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_images_ask_the_same_health() -> None:
    assert 'CMD ["spiked", "health"]' in (DEPLOY / "container/Containerfile").read_text()
    assert '["CMD", "spiked", "health"]' in (DEPLOY / "build_image.py").read_text()


@pytest.mark.parametrize("script", ["postinst", "prerm", "postrm"])
def test_the_scripts_of_the_package_are_shell(script: str) -> None:
    done = subprocess.run(["sh", "-n", DEPLOY / "debian" / script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_bill_of_materials_names_what_is_installed() -> None:
    site = Path(yaml.__file__).parents[1]
    command = [sys.executable, DEPLOY / "sbom.py", site]
    first, second = (subprocess.run(command, capture_output=True, check=True).stdout for _ in range(2))
    bill = json.loads(first)
    assert first == second and (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    numpy = next(part for part in bill["components"] if part["name"] == "numpy")
    assert numpy["purl"] == f"pkg:pypi/numpy@{np.__version__}" and numpy["hashes"][0]["alg"] == "SHA-256"
    assert bill["metadata"]["component"]["name"] == "spiked"


@pytest.mark.slow
def test_a_wheel_is_the_same_from_two_folders(tmp_path: Path) -> None:
    """Builds the wheel of CPython 3.11 twice, some CPU minutes each."""
    wheels = []
    for name in ("one", "another/folder"):
        tree = tmp_path / name
        shutil.copytree(
            DEPLOY.parent, tree, ignore=shutil.ignore_patterns(".venv", "build", "node_modules", ".git", "*.so", "dist")
        )
        command = ["python3.11", tree / "deploy/build_wheels.py", "--python", "python3.11", "--machine", "x86_64"]
        environment = {**os.environ, "SOURCE_DATE_EPOCH": "1700000000"}
        subprocess.run([*command, "--out", tree / "dist"], env=environment, check=True)
        (wheel,) = (tree / "dist").glob("*.whl")
        wheels.append((wheel.name, wheel.read_bytes()))
    assert wheels[0] == wheels[1]


@pytest.mark.slow
def test_the_gpu_measurement_installs_a_wheel_and_takes_its_modules(tmp_path: Path) -> None:
    """Started in the tree, whose own `spiked` must not be found first. Packages are those of this environment."""
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", str(venv)], check=True)
    site = venv / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
    packages = [path for path in sys.path if path.endswith("site-packages")]
    (site / "packages.pth").write_text("\n".join(packages) + "\n")
    done = subprocess.run(
        ["sh", str(GPU / "install.sh"), str(venv)],
        env={**os.environ, "EXTRAS": "", "PIP_NO_BUILD_ISOLATION": "0", "PIP_NO_INDEX": "1"},
        cwd=DEPLOY.parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(rf"^\d+ compiled modules from {re.escape(str(site))}/spiked/native$", done.stdout, re.MULTILINE)
    told = subprocess.run([venv / "bin" / "spiked", "version"], cwd="/", capture_output=True, text=True, check=True)
    assert "renderer: cpu" in told.stdout


def test_the_gpu_measurement_asks_for_what_it_needs(tmp_path: Path) -> None:
    script = str(GPU / "measure.sh")
    told = subprocess.run(["sh", script], capture_output=True, text=True, check=False)
    assert told.returncode != 0 and "usage: evaluation/gpu/measure.sh STREAMS" in told.stderr
    for tool in ("realpath", "dirname"):
        (tmp_path / tool).symlink_to(shutil.which(tool) or tool)
    told = subprocess.run(
        ["/bin/sh", script, str(tmp_path)], env={"PATH": str(tmp_path)}, capture_output=True, text=True, check=False
    )
    assert told.returncode == 1 and "nvcc is not in PATH" in told.stderr
