#!/bin/sh
# Everything there is to measure on a machine with an NVIDIA GPU and nvcc (beside gsplat, if EXTRAS or the machine has it):
#   evaluation/gpu/measure.sh STREAMS [SCORE.py] > gpu.txt
# STREAMS holds living/ and camp_color/ as `spiked simulate` writes such folders. VENV is where the wheel of this tree
# is installed: build/gpu if not set.
set -eu
streams=$(realpath "${1:?usage: evaluation/gpu/measure.sh STREAMS [SCORE.py]}")
score=${2:+--score $(realpath "$2")}
tree=$(realpath "$(dirname "$0")/../..")
command -v nvcc >/dev/null || { echo "nvcc is not in PATH: the kernels are compiled with it" >&2; exit 1; }
venv=$(realpath -m "${VENV:-$tree/build/gpu}")
"$tree/evaluation/gpu/install.sh" "$venv"
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
cd "$away"  # in the tree, and without -P, Python would find the folder `spiked`, which has no compiled modules
python="$venv/bin/python -P"
nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
"$venv/bin/spiked" version
$python -m pytest -q -p no:cacheprovider "$tree/tests/render/test_gpu.py" "$tree/tests/render/test_gpu_loss.py" "$tree/tests/render/test_gpu_charge.py" "$tree/tests/render/test_gsplat.py" "$tree/tests/render/test_torch.py"
$python "$tree/evaluation/gpu/measure.py"
for renderer in cuda cpu; do
    echo "whole runs, $renderer"
    # shellcheck disable=SC2086  # two words or none
    SPIKED_RENDER=$renderer $python "$tree/evaluation/measure.py" "$streams" living camp_color $score
done
