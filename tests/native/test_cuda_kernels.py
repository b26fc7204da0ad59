"""The CUDA kernels compile for every GPU that they are built for, without spilling registers."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "spiked/native/gpu/cuda.cu"
NVCC = shutil.which("nvcc", path="/usr/local/cuda/bin") or shutil.which("nvcc")
KERNEL = re.compile(
    r"run_kernel<spiked::\(anonymous namespace\)::(?P<name>\w+).*?\n"
    r".*?Function properties.*?\n\s*(?P<stack>\d+) bytes stack frame, (?P<spilled>\d+) bytes spill stores.*?\n"
    r".*?Used (?P<registers>\d+) registers"
)
PER_PIXEL = (
    *("Forward", "Backward", "Combine"),
    *("CompareRates", "CompareStructure", "DifferentiateStructure", "MixSlopes", "AddEvidence"),
    *("SmoothDepths", "CompareCharge", "MeanSlope", "BlurRows", "AddDetail"),
)
KERNELS = {*PER_PIXEL, "Prepare", "SetSubFrames", "Project", "CountTiles", "ListPairs", "FindTiles", "Unproject",
           "SumBlocks", "Descend", "TakeRows", "KeyDepths", "MedianDepth", "WarpNodes", "Clear", "Scale"}  # fmt: skip


@pytest.mark.skipif(NVCC is None, reason="there is no nvcc here")
@pytest.mark.parametrize("architecture", [80, 86, 89, 90])
def test_kernels_fit_their_registers(architecture: int, tmp_path: Path) -> None:
    assert NVCC is not None
    toolkit = Path(NVCC).resolve().parents[1]
    made = subprocess.run(
        [NVCC, "-std=c++17", f"-I{toolkit}/include/cccl", "-diag-suppress", "177", "-O3", "-use_fast_math",
         "-Xptxas=-v", "-cubin", f"-arch=sm_{architecture}", "-o", tmp_path / "kernels.cubin", SOURCE],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    told = subprocess.run(["c++filt"], input=made.stderr, capture_output=True, text=True, check=True).stdout
    found = [match.groupdict() for match in KERNEL.finditer(told)]
    assert {one["name"] for one in found} == KERNELS
    for one in found:
        assert one["spilled"] == "0", one
        if one["name"] in PER_PIXEL:  # four blocks of 256 threads on a multiprocessor of 65,536 registers
            assert one["stack"] == "0" and int(one["registers"]) <= 64, one
