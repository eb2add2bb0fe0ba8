# Every target sets up the virtual environment it needs on first use, and again when pyproject.toml or
# constraints.txt changes.
#   make demo   the robot's mission on real processes, with the faults
#   make lab    experiments to learn from, on a web page: kill a child and see what its supervisor does
#   make test   the tests, side by side on two cores and more: ten minutes on two
#   make test-all  those that take longer, too: faults at every operation, fixed worlds of the simulation, breakages
#   make test-ros  those among real nodes of ROS 2, in an environment of its own, .venv-ros, with rclpy from wheels
#   make lint   ruff, pyright, import-linter
#   make docs   the docs as a site, in build/docs/index.html, with the reference of all public names; without the network
#   make names  docs/names.md, and the texts of docs/reference, from the code
#   make figures  how large and how tangled the package is, each count with its aim (ARGS=--list: where)
#   make chaos  a system of its own, its processes killed and harmed at random, its promises checked (ARGS="--kills 1000")
#   make breakages  the product broken on purpose in twenty places and more, each noticed by chaos within a minute
#   make simulate  simulated worlds with crashes at every step, each checked (ARGS="--help" for how many)
#   make explore  small worlds in every interleaving, not a sample, as far as ARGS="--seconds 3600" allows (two minutes
#               for registrars, one for the slots of streams)
#   make streams  a million frames with checksums, while publisher and readers are killed (two minutes); thirty pictures
#               a second, and whether memory grows: ARGS="--steady 3600"
#   make fuzz   bad bytes, guided by the code they reach, into whatever reads bytes (atheris, which it installs in an
#               environment of its own; ARGS="--runs 1000000 --only frames")
#   make fuzz-quick  each of these tools, and the fuzz targets without atheris, for some seconds; on another Python, too
#               (PYTHON=... VENV=.venv-3.13 EXTRAS=test,cli)
#   make bench  the table of benchmarks (bench-quick: the same in seconds, with few repetitions; bench-peers: beside
#               xoscar, Thespian and Ray, pictures beside iceoryx2 and Zenoh; it installs them in an environment of their own)
#   make constraints  the newest version of each package that `make` installs, into constraints.txt (PYTHON=python3.11)
# PYTHON=... chooses the interpreter (3.11 or later); VENV=... where the environment goes; EXTRAS=... what goes into it.

PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && echo "$$p" && break; done)
VENV ?= .venv
EXTRAS ?= dev
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
ARGS ?=
# Tests start a thousand interpreters: where none may keep what it has compiled, each would compile the package again.
unexport PYTHONDONTWRITEBYTECODE
# Tests wait for half of their time or more: three processes for each core, at most six. Those that take long compute more.
CORES := $(shell getconf _NPROCESSORS_ONLN)
SIDE_BY_SIDE := -n $(shell echo $$(($(CORES) < 2 ? 3 : 6)))
SLOW_SIDE_BY_SIDE := -n $(shell echo $$(($(CORES) < 4 ? $(CORES) + 1 : 4)))

# A test that fails is run once more, and is named where the run ends. More than three of them are a failure
# (docs/decisions/0073-a-second-run-that-is-counted.md). One test alone, `pytest tests/...`, has no second run.
SECOND_RUN := --reruns 1 -raR

.PHONY: demo lab docs names test test-slow test-all test-ros lint format chaos breakages simulate explore streams fuzz fuzz-quick bench bench-quick bench-peers figures constraints clean
.DELETE_ON_ERROR:

# Where nothing is set up yet, these two do not wait for what the tests need.
demo: $(if $(wildcard $(STAMP)),$(STAMP),$(VENV)/.installed-demo)
	$(BIN)/python examples/mission.py $(ARGS)

lab: $(if $(wildcard $(STAMP)),$(STAMP),$(VENV)/.installed-web)
	$(BIN)/rr-actors web --lab examples/lab $(ARGS)

docs: $(if $(wildcard $(STAMP)),$(STAMP),$(VENV)/.installed-docs)
	$(BIN)/python -m sphinx -qWE --keep-going -c docs/_site -d build/doctrees docs build/docs $(ARGS)
	@echo "built build/docs/index.html"

names: $(STAMP)
	$(BIN)/python docs/_site/names.py
	$(BIN)/python docs/_site/reference.py

test: $(STAMP)
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) $(SECOND_RUN) -m "not slow and not ros" $(ARGS)

test-slow: $(STAMP)
	$(BIN)/python -m pytest $(SLOW_SIDE_BY_SIDE) $(SECOND_RUN) -m slow $(ARGS)

test-all: test-slow test

test-ros: .venv-ros/.installed
	.venv-ros/bin/python -m pytest -n 2 $(SECOND_RUN) -m ros tests/managers/test_ros2_*.py $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

figures: $(STAMP)
	$(BIN)/python tests/project/package_figures.py $(ARGS)

chaos: $(STAMP)
	PYTHONPATH=tests $(BIN)/python -m chaos $(ARGS)

breakages: $(STAMP)
	RR_ACTORS_BREAKAGES=all $(BIN)/python -m pytest tests/chaos/test_breakages.py $(ARGS)

simulate: $(STAMP)
	cd tests && ../$(BIN)/python -m simulation $(ARGS)

explore: $(STAMP)
	cd tests && ../$(BIN)/python -m simulation.small_worlds $(ARGS)
	cd tests && ../$(BIN)/python -m simulation.slot_worlds $(ARGS)

streams: $(STAMP)
	cd tests && ../$(BIN)/python -m support_stream_soak $(ARGS)

fuzz: $(STAMP)
	$(BIN)/python -m fuzz $(ARGS)

fuzz-quick: $(STAMP)
	$(BIN)/python -m pytest -q -p no:cacheprovider tests/storage/test_fuzz_targets.py
	$(BIN)/python -m fuzz.damage --times 60
	$(BIN)/python tests/support_interrupts.py --most 40 --together 20 --only "load here" "ask far" queries
	$(BIN)/python tests/support_interrupts.py --most 40 --together 20 --raising Exception --only "load here" "tell near"
	PYTHONPATH=tests $(BIN)/python -m chaos --kills 3 --seconds 4
	cd tests && ../$(BIN)/python -m simulation 300 --seed 4503599627375496

bench: $(STAMP)
	$(BIN)/python -m benchmarks.run $(ARGS)

bench-quick: $(STAMP)
	$(BIN)/python -m benchmarks.run --quick $(ARGS)

bench-peers: $(STAMP)
	$(BIN)/python -m benchmarks.peers $(ARGS)
	$(BIN)/python -m benchmarks.peers.frames

define INSTALL
	@test -n "$(PYTHON)" || { echo "rr_actors needs Python 3.11 or later: none found. Try: make PYTHON=/path/to/python3" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "rr_actors needs Python 3.11 or later; PYTHON=$(PYTHON) is not. Try another: make PYTHON=..." >&2; exit 1; }
	@echo "Setting up $(VENV) with what rr_actors[$(1)] needs: this takes a minute or so, and is done once."
	@test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV) \
		|| { echo "cannot make a virtual environment: install your system's python3-venv package" >&2; rm -rf $(VENV); exit 1; }
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[$(1)]"
	@touch $@
endef

$(STAMP): pyproject.toml constraints.txt
	$(call INSTALL,$(EXTRAS))

$(VENV)/.installed-%: pyproject.toml constraints.txt
	$(call INSTALL,$*)

# rclpy comes with a distribution of ROS, or as wheels: it is no dependency of rr_actors, and of no extra.
.venv-ros/.installed: pyproject.toml constraints.txt
	@echo "Setting up .venv-ros with rclpy and what its tests need: this takes a minute or so, and is done once."
	@test -x .venv-ros/bin/python || "$(PYTHON)" -m venv .venv-ros
	@.venv-ros/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable . \
		pytest pytest-timeout pytest-rerunfailures pytest-xdist hypothesis \
		"ros-jazzy-rclpy[fastrtps]" ros-jazzy-std-msgs ros-jazzy-std-srvs
	@touch $@

# On the oldest Python: what is for that one is for the later ones too.
constraints:
	rm -rf build/newest && "$(PYTHON)" -m venv build/newest
	build/newest/bin/python -m pip install --quiet --disable-pip-version-check ".[dev]"
	build/newest/bin/python -m pip freeze --exclude rr-actors >constraints.txt

clean:
	rm -rf .venv .venv-* .pytest_cache .ruff_cache .hypothesis .import_linter_cache build dist out bench.json bench-peers.json
