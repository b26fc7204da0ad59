"""The wire parsers under a coverage-guided fuzzer: the corpus again, and a little further each time."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
WIRE = HERE.parents[1] / "spiked/native/wire"
PARSERS = ("usb", "pcie")
SECONDS = int(os.environ.get("SPIKED_FUZZ_SECONDS", "5"))


@pytest.fixture(scope="module", params=PARSERS)
def fuzzer(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """A parser's name, and its fuzzer, built with address and undefined-behaviour sanitizers."""
    compiler = shutil.which("clang++")
    if compiler is None:
        pytest.skip("the Debian package clang is not installed (apt-get install clang libclang-rt-14-dev)")
    name: str = request.param
    binary = tmp_path_factory.mktemp("fuzz") / name
    command = [compiler, "-std=c++17", "-O2", "-g", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all"]
    command += [f"-I{WIRE}", f"-I{HERE}", str(HERE / f"{name}_framing.cpp"), str(WIRE / f"{name}.cpp")]
    built = subprocess.run([*command, "-o", str(binary)], capture_output=True, text=True, check=False)
    if "libclang_rt.fuzzer" in built.stderr:
        pytest.skip("the Debian package libclang-rt-14-dev is not installed: there is no libFuzzer")
    assert built.returncode == 0, built.stderr
    return name, binary


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    """Run from a small process: the largest memory of the one that starts it counts as the fuzzer's own (getrusage)."""
    return subprocess.run(["sh", "-c", '"$@"; exit', "sh", *command], capture_output=True, text=True, check=False)


def test_nothing_found_before_or_now_breaks_a_parser(fuzzer: tuple[str, Path], tmp_path: Path) -> None:
    name, binary = fuzzer
    corpus = sorted((HERE / "corpus" / name).iterdir())
    assert len(corpus) > 20
    options = [f"-artifact_prefix={tmp_path}/", "-timeout=20", "-print_final_stats=1"]
    again = run(binary, *options, *corpus)
    assert again.returncode == 0, again.stderr[-3000:]
    grown = tmp_path / "grown"
    grown.mkdir()
    search = [f"-max_total_time={SECONDS}", "-max_len=160", "-len_control=0", grown, HERE / "corpus" / name]
    further = run(binary, *options, *search)
    kept = [path.read_bytes().hex() for path in tmp_path.iterdir() if path.is_file()]
    assert further.returncode == 0, f"input {kept}\n{further.stderr[-3000:]}"
