# make demo: set everything up and reconstruct a rendered scene.  make test: set everything up and run the tests.

PYTHON ?= python3
VENV := .venv
# PyTorch's default Linux build brings several GB of CUDA libraries: without an NVIDIA GPU take the CPU build.
TORCH := $(shell command -v nvidia-smi >/dev/null 2>&1 && echo "torch" \
	|| echo "torch==2.13.0 --extra-index-url https://download.pytorch.org/whl/cpu")

.PHONY: demo test docs setup

demo: setup
	$(VENV)/bin/hm-sfm demo out/demo

test: setup
	$(VENV)/bin/python -m pytest

# The reference of the Python API, docs/api.md, from the docstrings.
docs: setup
	$(VENV)/bin/python docs/make_api_reference.py

setup: $(VENV)/installed

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --retries 1 $(TORCH)
	$(VENV)/bin/pip install --quiet --editable ".[test,viz]"
	touch $@
