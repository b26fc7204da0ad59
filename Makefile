# Every target does its own set-up, on a bare Debian machine too: what Debian lacks, the environment in .venv, the native modules.

PYTHON ?= python3.11
# The reference renderer of the tests is all that uses torch. Installed first and by number, so that a CPU wheel offered by
# the machine's pip configuration is taken and the default build, several times its size, is not.
TORCH ?= torch==2.13.0
BUILD_REQUIRES := "scikit-build-core>=0.10" "nanobind>=2.4" "cmake>=3.25" ninja

VENV := .venv
BIN := $(VENV)/bin
NATIVE_SOURCES := CMakeLists.txt $(shell find spiked/native -name '*.cpp' -o -name '*.hpp' -o -name '*.inl' -o -name CMakeLists.txt)
CPP := $(filter-out %CMakeLists.txt,$(NATIVE_SOURCES))
PAGE := $(shell find service/spiked_service/page -name '*.js')

.PHONY: demo test test-slow lint bench clean
.DELETE_ON_ERROR:

demo: $(VENV)/.native
	$(BIN)/spiked serve --device sim: --frames 1280 --follow

test: lint
	$(BIN)/pytest -m "not slow"

test-slow: $(VENV)/.native
	$(BIN)/pytest -m slow

lint: $(VENV)/.native
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(if $(CPP),$(BIN)/clang-format --dry-run -Werror $(CPP))
	$(BIN)/lint-imports
	for script in $(PAGE); do node --check $$script || exit 1; done

bench: $(VENV)/.native
	$(BIN)/spiked bench

clean:
	rm -rf $(VENV) build dist out .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find spiked -name '*.so' -delete

# Debian's part. Only root can install it; anybody else is told what is missing.
$(VENV)/.python:
	@missing=""; \
	command -v $(PYTHON) >/dev/null || missing="$$missing python3.11"; \
	$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || missing="$$missing python3.11-venv"; \
	command -v g++ >/dev/null || missing="$$missing g++"; \
	command -v node >/dev/null || missing="$$missing nodejs"; \
	if [ -n "$$missing" ] && [ "$$(id -u)" = 0 ]; then \
	  apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends $$missing; \
	elif [ -n "$$missing" ]; then \
	  echo "missing Debian packages:$$missing; install them (apt-get install$$missing) and run make again" >&2; exit 1; \
	fi
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/.packages: $(VENV)/.python pyproject.toml
	$(BIN)/pip install --quiet $(BUILD_REQUIRES)
	$(BIN)/pip install --quiet $(TORCH)
	$(BIN)/pip install --quiet --no-build-isolation --editable '.[test,lint]'
	touch $@

# Without build isolation CMake finds the same nanobind each time and compiles only what changed.
$(VENV)/.native: $(VENV)/.packages $(NATIVE_SOURCES)
	$(BIN)/pip install --quiet --no-build-isolation --no-deps --editable .
	touch $@
