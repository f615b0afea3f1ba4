# Everything runs in an environment of its own, made on first use with the python3 at hand.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/
READY := $(VENV)/.ready

.PHONY: demo test lint bench validate clean

demo: $(READY) renderer  ## runs the bundled navigation scenario
	$(RUN)tagtrail run navigation --out out/demo

test: $(READY) renderer  ## runs the tests
	$(RUN)python -m pytest -m "not recording" -n auto --maxprocesses 8 --dist loadfile

lint: $(READY)  ## checks style, formatting and types
	$(RUN)ruff check
	$(RUN)ruff format --check
	$(RUN)mypy

bench: $(READY) renderer  ## prints speeds and accuracies beside those of the peers
	$(RUN)python -m tests.benchmarks

validate: $(READY) renderer  ## runs what needs the real recordings, and the slow checks
	$(RUN)python -m pytest -m recording
	$(RUN)python -m tests.benchmarks.validate
	$(RUN)python -m tests.benchmarks.validate_robot
	$(RUN)python -m tests.benchmarks.validate_formation
	$(RUN)python -m tests.benchmarks.validate_mapping
	$(RUN)python -m tests.benchmarks.validate_replay

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "tagtrail needs Python 3.11 or later: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
	  { echo "cannot make an environment: install the system package python3-venv"; exit 1; }
	$(RUN)python -m pip install --quiet --upgrade pip
	$(RUN)python -m pip install --quiet --editable '.[dev]'
	@touch $@

# Drake renders without a display through EGL; Mesa does it in software where there is no GPU.
.PHONY: renderer
renderer:
	@if [ "$$(uname)" = Linux ]; then \
	  ls /usr/lib*/libEGL.so.1 /usr/lib/*/libEGL.so.1 2>/dev/null | grep -q . || \
	    { echo "rendering needs the system packages libegl1 and libgl1-mesa-dri"; exit 1; }; \
	fi

clean:
	rm -rf $(VENV) out
