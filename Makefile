# SPDX-License-Identifier: Apache-2.0
# make demo | test | bench | lint | wheel    each does all the set-up it needs (Debian packages, .venv, build).
.PHONY: help setup demo test bench nightly lint wheel sanitize fuzz clean
.DEFAULT_GOAL := help
BIN := .venv/bin
TESTS := build/tests
JOBS ?= $(shell nproc)
export CLANG ?= 19
export CXX  # one name for the package's build and that of the C++ tests: ccache compiles what both need once

help:       ## this list
	@grep -E '^[a-z]+: .*##' $(MAKEFILE_LIST) | sed -E 's/: .*## /\t/' | expand -t 12

setup:      ## Debian packages, .venv, the package in editable mode
	@scripts/setup

demo:       ## the main job: four tasks with two to five world models each, tables and reports
	@scripts/setup torch
	$(BIN)/wiw demo

test:       ## all tests: ctest, then pytest (but for those of nightly)
	@scripts/setup test
	$(BIN)/cmake -S . -B $(TESTS) -G Ninja -DCMAKE_MAKE_PROGRAM=$(CURDIR)/$(BIN)/ninja -DWIW_BUILD_TESTS=ON -DWIW_BUILD_PYTHON=OFF >/dev/null
	$(BIN)/cmake --build $(TESTS)
	$(BIN)/ctest --test-dir $(TESTS) --output-on-failure
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

bench:      ## every speed claim, side by side with what a user would pick instead
	@scripts/setup test
	$(BIN)/python tests/benchmark/run_all.py

nightly:    ## what takes too long for every change: dearest tests, sanitizers, fuzzing, the small data-scaling study
	@scripts/setup test nightly
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder -m "nightly or extra"
	scripts/sanitize
	@if command -v clang++-$(CLANG) >/dev/null; then scripts/fuzz_compiled; else \
	  echo "nightly: the compiled readers are not fuzzed, for there is no clang++-$(CLANG)"; fi
	rm -rf build/nightly
	$(BIN)/wiw study data-scaling --small --workers $(JOBS) --out build/nightly/data-scaling

lint:       ## ruff, mypy, clang-format, clang-tidy
	@scripts/setup test lint
	$(BIN)/pre-commit run --all-files

wheel:      ## a self-contained wheel in dist/
	@scripts/setup
	scripts/build_wheel

sanitize:   ## C++ tests under ASAN+UBSAN and under TSAN
	@scripts/setup
	scripts/sanitize

fuzz:       ## the compiled readers fuzzed by libFuzzer under ASAN+UBSAN, a minute each (needs Clang 19)
	@scripts/setup test
	scripts/fuzz_compiled

clean:
	rm -rf build dist
