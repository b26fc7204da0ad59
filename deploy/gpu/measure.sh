#!/bin/sh
# Everything there is to measure on a machine with an NVIDIA GPU and the CUDA toolkit (gsplat compiles its kernels once):
#   deploy/gpu/measure.sh STREAMS [SCORE.py] > gpu.txt
# STREAMS holds living/ and camp_color/ as `spiked simulate` writes such folders.
set -eu
streams=$(realpath "${1:?usage: deploy/gpu/measure.sh STREAMS [SCORE.py]}")
score=${2:+--score $(realpath "$2")}
cd "$(dirname "$0")/../.."
command -v nvcc >/dev/null || { echo "the CUDA toolkit's nvcc is not in PATH: gsplat needs it to compile" >&2; exit 1; }
[ -x .venv/bin/python ] || python3 -m venv .venv
.venv/bin/pip install --quiet '.[cuda,test]'
nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv
.venv/bin/python -m pytest -q tests/render/test_cuda.py
.venv/bin/python deploy/gpu/measure.py
for renderer in cuda cpu; do
    echo "whole runs, $renderer"
    # shellcheck disable=SC2086  # two words or none
    SPIKED_RENDER=$renderer .venv/bin/python docs/measure.py "$streams" living camp_color $score
done
