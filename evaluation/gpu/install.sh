#!/bin/sh
# A wheel of this tree, installed into an environment of its own, the compiled modules in it checked:
#   evaluation/gpu/install.sh VENV
# The environment sees the machine's packages, so that a torch made for its GPU is taken and none is downloaded.
# EXTRAS are those of the wheel: "[test]" if not set.
set -eu
venv=$(realpath -m "${1:?usage: evaluation/gpu/install.sh VENV}")
cd "$(dirname "$0")/../.."
[ -x "$venv/bin/python" ] || "${PYTHON:-python3}" -m venv --system-site-packages "$venv"
wheels=$(mktemp -d)
trap 'rm -rf "$wheels"' EXIT
"$venv/bin/pip" wheel --quiet --no-deps --wheel-dir "$wheels" .
wheel=$(ls "$wheels"/spiked-*.whl)
"$venv/bin/pip" install --quiet --force-reinstall --no-deps "$wheel"
"$venv/bin/pip" install --quiet "$wheel${EXTRAS-[test]}"
# Away from the tree, whose folder `spiked` has no compiled modules and would be found first.
cd "$wheels"
"$venv/bin/python" -P - "$venv" <<'CHECK'
import importlib, pkgutil, sys
from pathlib import Path

import spiked.native

names = [module.name for module in pkgutil.iter_modules(spiked.native.__path__) if module.name.startswith("_")]
for name in names:
    file = Path(importlib.import_module(f"spiked.native.{name}").__file__)
    if not file.is_relative_to(sys.argv[1]):
        sys.exit(f"{name} comes from {file}, not from the wheel installed in {sys.argv[1]}")
if not names:
    sys.exit(f"{spiked.native.__path__[0]} has no compiled modules")
print(f"{len(names)} compiled modules from {file.parent}")
CHECK
