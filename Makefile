# Each target sets everything up first.
#   make demo       reconstruct a rendered scene
#   make check      style, imports and types
#   make test-fast  the tests that are not slow, on all cores: before each commit
#   make test       all tests: the fast ones, then the slow ones
#   make test-lowest  the fast tests and the demo with the lowest versions that pyproject.toml admits (downloads GBs)
#   make docs       docs/api.md, the reference of the Python API, from the docstrings

PYTHON ?= python3
VENV := .venv
# PyTorch's default Linux build brings several GB of CUDA libraries: without an NVIDIA GPU take the CPU build.
TORCH := $(shell command -v nvidia-smi >/dev/null 2>&1 && echo "torch" \
	|| echo "torch==2.13.0 --extra-index-url https://download.pytorch.org/whl/cpu")

.PHONY: check demo docs setup test test-fast test-lowest

demo: setup
	$(VENV)/bin/hm-sfm demo out/demo

check: setup
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/lint-imports
	$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

# One thread a process: the threads of two would wait for each other.
test-fast: setup
	OMP_NUM_THREADS=1 $(VENV)/bin/python -m pytest -m "not slow" --numprocesses auto

test: test-fast
	$(VENV)/bin/python -m pytest -m slow

test-lowest:
	PYTHON=$(PYTHON) .ci/lowest_versions

docs: setup
	$(VENV)/bin/python docs/make_api_reference.py

setup: $(VENV)/installed

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --retries 1 $(TORCH)
	$(VENV)/bin/pip install --quiet --editable ".[test,viz,dev]"
	touch $@
