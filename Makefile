# `make` shows this help. Everything runs from a fresh clone: the first target that needs it makes .venv.
.DEFAULT_GOAL := help
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out
# Rules have OUT in quotes, as it may have spaces; a shell expands no ~ there.
override OUT := $(patsubst ~/%,$(HOME)/%,$(OUT))
ifneq ($(words $(VENV)),1)
$(error VENV is a path without spaces, not '$(VENV)')
endif
JOBS ?= $(shell expr 2 + $$(getconf _NPROCESSORS_ONLN))  # tests wait a good part of their time; each worker collects for 4 CPU s
export PIP_DISABLE_PIP_VERSION_CHECK := 1
unexport PYTHONDONTWRITEBYTECODE  # modules are compiled once, not for each of a hundred programs

.PHONY: help demo test test-long test-uml test-pi mutants quick check bench firmware flash pi-install host-is-named library reproduce wheels docs clean

help:  ## this list
	@awk -F':.*## ' '/^[a-z-]+:.*## /{printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

PROJECTS := shared pi_controller simulators host papers worlds
KERNELS := $(wildcard host/polysight/sync/*.c host/polysight/sync/*.h) host/polysight/sync/build.py host/setup.py

$(VENV)/installed: pyproject.toml $(PROJECTS:%=%/pyproject.toml) $(KERNELS)
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11"; exit 2; }
	@./tests/install-python.sh "$(PYTHON)" $(VENV)
	@touch $@

demo: $(VENV)/installed  ## the whole rig, simulated: scan nine plates on a table, end with a report (OUT=out)
	$(BIN)/polysight demo --out "$(OUT)/demo"

test: $(VENV)/installed  ## install what is missing, then run every test
	@./tests/install-tools.sh
	$(BIN)/python -m pytest -n $(JOBS) $(COSTS)

# Each file that takes more draws with --long.
LONG := tests/stage tests/store tests/capture/test_adversary.py tests/acquisition/test_adversarial_scans.py \
	tests/acquisition/test_mangled_takes.py tests/acquisition/test_pulse_times.py tests/pi/test_hostile.py \
	tests/pi/test_edges.py tests/pi/test_stops.py tests/calibration/test_metal.py tests/materials \
	tests/process/test_metal_scans.py tests/surfaces/test_rejected_surfaces.py tests/e2e/test_killed_processes.py \
	tests/e2e/test_random_commands.py tests/radar/test_random_faults.py tests/serve/test_generations.py \
	tests/serve/test_states.py tests/simulators/test_scene_pairs.py $(shell grep -rl --include='*.py' '^@given' tests)
test-long: $(VENV)/installed  ## tests at full length: random rows, records, messages, faults and kills by the ten thousand (hours)
	@./tests/install-tools.sh
	$(BIN)/python -m pytest $(LONG) -n $(JOBS) --long

test-uml: $(VENV)/installed  ## the chain on a kernel's GPIO chip, in user-mode Linux built from Debian's source (10 minutes, once)
	@./tests/install-tools.sh kernel
	$(BIN)/python -m pytest tests/uml --uml -rP

test-pi: $(VENV)/installed  ## a Raspberry Pi 3B in a box: Debian's kernel on QEMU, the real installation (a quarter of an hour, or more)
	@./tests/install-tools.sh pi
	$(BIN)/python -m pytest tests/pi_box --pi-box -rP

# The settings of the tools name .venv only.
NOT_VENV := --config 'extend-exclude = ["build", "$(VENV)"]'
CHANGED = $(shell git diff --name-only --diff-filter=d HEAD -- host papers pi_controller shared simulators worlds 2>/dev/null | grep '\.py$$')
UNCHANGED = $(shell git rev-parse HEAD >/dev/null 2>&1 && echo nothing differs from the last commit || echo without git none are checked, make check does)
LAWS := tests/house/test_rooms.py tests/shared tests/polarimetry tests/sync/test_tone.py tests/imaging/test_direct.py

mutants: $(VENV)/installed  ## change the code at 100 random places: do the tests notice? (hours; COUNT=100 SEED=1)
	@PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	@PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --group mutants
	$(BIN)/python -m tests.mutants --count $(or $(COUNT),100) --seed $(or $(SEED),1)

quick: $(VENV)/installed  ## under a minute: lint, types of what differs from the last commit, the fastest laws
	$(BIN)/ruff check $(NOT_VENV) .
	$(BIN)/ruff format --check $(NOT_VENV) .
	$(if $(CHANGED),$(BIN)/pyright --pythonpath $(BIN)/python $(CHANGED),@echo "types: $(UNCHANGED)")
	$(BIN)/lint-imports >/dev/null || $(BIN)/lint-imports
	$(BIN)/python -m pytest -q -n $(JOBS) $(LAWS)

check: $(VENV)/installed  ## lint, format, types, import contracts
	$(BIN)/ruff check $(NOT_VENV) .
	$(BIN)/ruff format --check $(NOT_VENV) .
	NODE_OPTIONS=--max-semi-space-size=128 $(BIN)/pyright --pythonpath $(BIN)/python  # a tenth less CPU time for collecting garbage
	$(BIN)/lint-imports

bench: $(VENV)/installed  ## speed as ratios, measured side by side in one run
	@PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	@PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --group bench
	$(BIN)/python -m benchmarks --out "$(OUT)/bench"

reproduce: $(VENV)/installed  ## the paper's tables and figures from simulation, beside the published values
	$(BIN)/polysight reproduce --out "$(OUT)/reproduce"

library: $(VENV)/installed  ## make the simulated reference library of the classifier again
	$(BIN)/polysight train --simulate examples/library --times 2 --out host/polysight/materials/simulated-library.npz

wheels: $(VENV)/installed  ## wheels for users, x86-64 and ARM64, any Python, for machines without a compiler (OUT=out)
	rm -rf $(PROJECTS:%=%/build)  # modules that were renamed since would come along
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir "$(OUT)/wheels" $(patsubst %,./%,$(filter-out host,$(PROJECTS)))
	for platform in manylinux_2_17_x86_64 manylinux_2_17_aarch64; do \
	  POLYSIGHT_WHEEL=$$platform $(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir "$(OUT)/wheels" ./host || exit 1; done
	@ls "$(OUT)/wheels"

docs: $(VENV)/installed  ## make the API reference (OUT=out), check all links, run every command that README and docs show
	$(BIN)/python -m docs.reference --out "$(OUT)/docs"
	$(BIN)/python -m docs.check --run

firmware: $(VENV)/installed  ## build the sketch for an UNO with avr-gcc
	$(MAKE) -C arduino_stage firmware

flash: firmware  ## flash it: make flash PORT=/dev/ttyACM0
	$(MAKE) -C arduino_stage flash PORT=$(PORT)

host-is-named:
	@test -n "$(HOST)" || { echo "make pi-install HOST=user@address"; exit 2; }

ON_PI := .cache/polysight-install
pi-install: host-is-named $(VENV)/installed  ## install or update the Pi half on a Pi: make pi-install HOST=pi@polysight
	rm -rf "$(OUT)/pi" && mkdir -p "$(OUT)/pi/sources"
	tar -c --exclude=__pycache__ --exclude='*.egg-info' --exclude=build shared pi_controller | tar -x -C "$(OUT)/pi/sources"
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir "$(OUT)/pi/copied" "$(OUT)/pi/sources/shared" "$(OUT)/pi/sources/pi_controller"
	cp pi_controller/install.sh pi_controller/requirements.txt pi_controller/polysight-pi.service pi_controller/60-polysight.rules instrument.toml "$(OUT)/pi/copied/"
	tar -c -C "$(OUT)/pi/copied" . | ssh $(HOST) 'rm -rf $(ON_PI) && mkdir -p $(ON_PI) && tar -x -C $(ON_PI)'
	ssh -t $(HOST) sudo $(ON_PI)/install.sh

clean:  ## remove what was built; products (OUT=out) stay
	rm -rf arduino_stage/build
	@test ! -e $(VENV)/pyvenv.cfg || rm -rf $(VENV)  # an environment, and no folder of yours
	@test ! -e "$(OUT)" || echo "$(OUT)/ stays: products are in it, perhaps the only ones of a scan; remove it yourself"
