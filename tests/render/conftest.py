"""Lets the tests of this folder import their common scenes; pytest's importlib mode adds no folder by itself."""

import sys
from pathlib import Path

import torch

sys.path.append(str(Path(__file__).parent))

torch.set_num_threads(1)  # the scenes are tiny; more threads only wait for each other
