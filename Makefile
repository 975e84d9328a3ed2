# Everything sets itself up: `make bench` and `make test` are all a new user needs.
PYTHON ?= python3
VENV ?= .venv
export S2A_BENCH_VENV := $(abspath $(VENV))
BIN := $(VENV)/bin

.PHONY: bench test check setup clean

# The main job: a real model first, then the transports alone (no model), with JPEG and with raw pixels.
bench: setup
	$(BIN)/s2a-bench latency
	$(BIN)/s2a-bench latency --engine echo --transport http,ros,loopback --runs 100
	$(BIN)/s2a-bench latency --engine echo --transport http,ros,loopback --runs 100 --payload raw

test: setup
	$(BIN)/python -m pytest

check: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

setup:
	@$(PYTHON) tools/setup.py

clean:
	rm -rf $(VENV) build *.egg-info
