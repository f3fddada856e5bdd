# Everything runs from .venv, which `make setup` builds from nothing out of the package registry.
PYTHON ?= python3
# Five on two cores: tests of graphs wait for each other's nodes while others compute. A worker that
# dies ends the run with its name and test: pytest-xdist gives a new one the same test, and hangs.
WORKERS ?= 5
# The middleware has once left a reader beside a writer without a message for 300 s, in some hundred
# runs of the suite, and an emulated servo is a thread of its test. A test that waited for either in
# vain runs once more; the summary names it.
AGAIN := --reruns 1 -raR --only-rerun 'not within [0-9]+ s' --only-rerun 'did not answer in time'
SPREAD := -n $(WORKERS) --dist loadfile --no-loadscope-reorder --max-worker-restart 0 $(AGAIN)
PYTEST_ARGS ?= -m 'not long' $(SPREAD)

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# Python compiles a module when it is first imported; most of them never are.
INSTALL := $(PIP) install --quiet --no-compile
STAMPS := $(VENV)/stamps

# Where this is set, every process would compile anew all that it imports: a second and more each.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup browser test long fuzz soak lint demo docs pictures bench figures release format system colcon clean

setup: $(STAMPS)/dev

# Each step is repeated only when what it installs from has changed.
$(STAMPS)/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if (3, 10) <= v < (3, 14) else \
	  f"Python 3.10 to 3.13 is needed, this is {v.major}.{v.minor}: make setup PYTHON=python3.12")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) --upgrade pip 'setuptools>=68,<80' wheel
	@mkdir -p $(STAMPS) && touch $@

$(STAMPS)/ros: requirements/ros.txt | $(STAMPS)/python
	$(INSTALL) -r $<
	@touch $@

# PyTorch without CUDA's libraries, which take several GB: of the index, else PyTorch's own; where
# neither answers, what the index has. Another one: make setup TORCH='torch==2.9.1'
CPU_TORCH := torch==2.13.0+cpu
ifdef TORCH
.PHONY: $(STAMPS)/torch
endif
$(STAMPS)/torch: | $(STAMPS)/python
	@if [ -n "$(TORCH)" ]; then $(INSTALL) '$(TORCH)'; else \
	  $(INSTALL) --no-deps '$(CPU_TORCH)' 2>/dev/null || $(INSTALL) --no-deps --retries 0 --timeout 5 \
	  --index-url https://download.pytorch.org/whl/cpu '$(CPU_TORCH)' 2>/dev/null || \
	  { echo 'No torch without CUDA here: the one of the index' >&2; $(INSTALL) 'torch>=2.4'; }; fi
	@touch $@

INTERFACES := $(shell find longarm_interfaces -type f -not -path '*/build/*')
$(STAMPS)/interfaces: $(INTERFACES) $(STAMPS)/ros
	$(INSTALL) --no-build-isolation ./longarm_interfaces
	@touch $@

# What runs, without the peers of benchmarks and tests.
PROGRAMS := longarm error_predictor kinematics servo_driver simulated_arm stereo_bridge trajectory_compensator
$(STAMPS)/package: setup.py setup.cfg pyproject.toml package.xml $(STAMPS)/interfaces | $(STAMPS)/torch
	$(INSTALL) --no-build-isolation --editable .
	@# An editable installation holds no files but Python's: these are what `ros2` looks for.
	@mkdir -p $(VENV)/share/ament_index/resource_index/packages $(VENV)/share/longarm_comp $(VENV)/lib/longarm_comp
	@cp resource/longarm_comp $(VENV)/share/ament_index/resource_index/packages/longarm_comp
	@ln -sfn $(CURDIR)/config $(CURDIR)/launch $(CURDIR)/package.xml $(VENV)/share/longarm_comp/
	@for name in $(PROGRAMS); do ln -sf ../../bin/$$name $(VENV)/lib/longarm_comp/$$name; done
	@touch $@

# Packages of ROS that no registry has, for the tests.
STAND_INS := $(shell find test/stand_ins -type f -not -path '*/build/*')
$(STAMPS)/stand_ins: $(STAND_INS) $(STAMPS)/interfaces
	$(INSTALL) --no-build-isolation ./test/stand_ins
	@touch $@

$(STAMPS)/dev: $(STAMPS)/package $(STAMPS)/stand_ins
	$(INSTALL) --no-build-isolation --editable '.[dev]'
	@# Compiled here once: the workers of the first run would each compile all that tests import.
	@$(BIN)/python -m pytest --collect-only -q >/dev/null 2>&1 || true
	@touch $@

# What tests look at pages with is installed where that asks for no password; else they are skipped.
browser:
	@for name in chromium chromium-browser google-chrome; do command -v $$name >/dev/null && exit 0; done; \
	case $$(id -u) in 0) may=;; *) may='sudo -n';; esac; \
	$$may $(MAKE) -s system PACKAGES=chromium >/dev/null 2>&1 || \
	  echo 'No browser, and none may be installed: tests of pages are skipped. To run them: sudo make system'

test: setup browser
	$(BIN)/python -m pytest $(PYTEST_ARGS)

# Every test: those that take a minute, and those that ask the same in another form, too.
long: setup browser
	$(BIN)/python -m pytest $(SPREAD)

# Damaged files given to every command that reads one; `make test` runs a few.
fuzz: setup
	LONGARM_FUZZ_RUNS=3000 $(BIN)/python -m pytest $(PYTEST_ARGS) test/cli/test_fuzz.py

# Hours of targets on a simulated arm, with random faults: SOAK_ARGS='--hours 8'.
SOAK_ARGS ?=
soak: setup
	PYTHONPATH=test $(BIN)/python -m soak $(SOAK_ARGS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Only what runs is installed for it. What an earlier one left makes room.
demo: $(STAMPS)/package
	rm -rf build/demo
	$(BIN)/longarm demo --out build/demo

# Pages to read offline: build/docs/index.html. Warnings are errors; LONGARM_NOTEBOOKS=off runs none.
docs: setup
	$(BIN)/sphinx-build -q -W --keep-going docs build/docs

# Pictures of README and pages, drawn again (docs/pictures); some are of a demonstration in build/demo.
pictures: setup build/demo/report.html
	$(BIN)/python docs/made_by/pictures.py build/demo

build/demo/report.html: | $(STAMPS)/package
	$(BIN)/longarm demo --out build/demo

# Version and changelog, written where other tools look for them (CONTRIBUTING.md), and what is released: dist/.
release: setup
	$(BIN)/python docs/made_by/release.py
	rm -rf dist && $(BIN)/python -m build --no-isolation -o dist .

# What benchmarks compare with; the tests run without.
$(STAMPS)/bench: $(STAMPS)/dev
	$(INSTALL) --no-build-isolation --editable '.[bench]'
	@touch $@

bench: $(STAMPS)/bench
	$(BIN)/longarm bench -o build/bench

# The tables of figures in docs/, printed anew: hours. A second call goes on where the first ended.
# Some of them: FIGURES_ARGS='real day --data DIR'
FIGURES_ARGS ?=
figures: $(STAMPS)/bench
	$(BIN)/python docs/made_by/figures.py $(FIGURES_ARGS)

# Debian packages: a compiler for the ROS interfaces, a browser for the tests of pages.
PACKAGES := build-essential python3-venv chromium
system:
	apt-get update -qq
	DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(PACKAGES)

# A colcon workspace of both packages beside the sources, against the ROS of .venv.
colcon: setup
	. $(BIN)/activate && colcon build

clean:
	rm -rf $(VENV) build dist install log
