# Everything runs in .venv, which these targets make and keep up to date.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Stamps: what flying needs is there; what tests need is there, too.
BASE := $(VENV)/.flies
STAMP := $(VENV)/.tests
ALL := .[test,dev,docs]

# A file of tests stays with one worker, which builds and compiles once what its tests share; the longest come first.
BY_FILE := -n 2 --dist loadfile --no-loadscope-reorder
# Arguments are compared with their annotations, shapes and types, in flights as users fly them and in `make test-all`: it
# takes a tenth of the time of tests.
TYPED = --jaxtyping-packages=$(1),beartype.beartype
# The rooms from a mesh to a flight: the paper's system, made safe.
CORE := tests/core

# What compares bits, or runs more than it compiles, is run as users run it: with XLA's own settings.
AS_USED = $(shell grep -rlw mark.as_used tests --include='test_*.py')

# Without them each start of Python would compile 1,800 modules of the libraries anew: 5 s a command.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo core check test test-all lint style types quick-tests as-used-tests other-tests format install docs shipped replay-bundle flight-code basilisk release-check clean

help:
	@echo "make demo      set up, then fly the built-in demonstration; results in out/demo"
	@echo "make core      set up, and run the quick tests of the rooms from a mesh to a flight"
	@echo "make check     set up, lint, type-check what was changed and run all quick tests"
	@echo "make test      the same with all types and the longer tests, as CI runs it"
	@echo "make test-all  the same with the longest; run again after a stop, it goes on where it was"
	@echo "make format    format the code"
	@echo "make docs      build the documentation site into out/site"
	@echo "make shipped   remake the learned fields that ship with the package"
	@echo "make replay-bundle  bundle the replay's viewer into the package again (needs Node.js and npm)"
	@echo "make flight-code  compare the exported C with Python, break it, and go through it by tools"
	@echo "make basilisk  fly law and guard as flight software in Basilisk, in an environment of its own"
	@echo "make release-check  build wheel and sdist, check them, and run the first tutorial from the wheel alone"
	@echo "make clean     remove the environment and all outputs"

# uv installs in a fifth of pip's processor time. Where it is absent pip fetches it, and installs all by itself where
# uv cannot (an index that only pip's settings name).
UV := $(shell command -v uv)
ifdef UV
MAKE_VENV := uv venv --quiet --allow-existing --python $(PYTHON) $(VENV)
INSTALLED = uv pip install --quiet --python $(BIN)/python --editable $(1)
else
# An environment without a pip of its own is there sooner. An old pip, or none, cannot install into another's.
MAKE_VENV := { $(PYTHON) -m venv --without-pip $(VENV) && \
	$(PYTHON) -m pip --python $(BIN)/python install --quiet --no-compile uv 2>/dev/null; } || \
	{ $(PYTHON) -m venv $(VENV) && { $(BIN)/python -m pip install --quiet --no-compile uv || true; }; }
INSTALLED = { test -x $(BIN)/uv && $(BIN)/uv pip install --quiet --python $(BIN)/python --editable $(1); } || \
	{ $(BIN)/python -m ensurepip >/dev/null && $(BIN)/python -m pip install --quiet --no-compile --editable $(1); }
endif

# `make demo` waits for nothing but what flying needs. Whoever tests gets all in one go.
$(BASE): pyproject.toml | $(BIN)/python
	@echo "installing Keepout and its libraries into $(VENV): 1 GB, half a minute without a word"
	@$(call INSTALLED,.)
	@touch $@

install: $(STAMP)

$(STAMP): pyproject.toml | $(BIN)/python
	@echo "installing Keepout, its libraries and what tests, lint and documents need: 1.8 GB, a minute without a word"
	@$(call INSTALLED,'$(ALL)')
	@touch $@ $(BASE)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v < (3, 14) else "Keepout needs Python 3.11 to 3.13, but $(PYTHON) is %d.%d; run make PYTHON=python3.11" % v)'
	@$(MAKE_VENV)

demo: $(BASE)
	$(BIN)/keepout reproduce case1 --quick --out out/demo

lint: style types

style: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

# Room for what is new, so that Node looks less often for what is not used any more: a seventh of the time.
PYRIGHT = NODE_OPTIONS="$$NODE_OPTIONS --max-semi-space-size=64" $(BIN)/pyright

types: install
	$(PYRIGHT)

# Of types only the files of the package that differ from the last commit: all of it is two minutes of a core.
CHANGED = $(shell git diff --name-only --diff-filter=d HEAD -- 'src/*.py' 2>/dev/null)

check: style
	$(if $(CHANGED),$(PYRIGHT) $(CHANGED))
	@$(MAKE) --no-print-directory quick-tests

# The fields of guards are kept in one new folder for all: some take a worker 20 s.
test: style
	@kept=$$(mktemp -d) && trap "rm -rf $$kept" EXIT && \
	KEEPOUT_CACHE=$$kept $(MAKE) --no-print-directory --jobs=2 as-used-tests other-tests

core: install
	$(BIN)/pytest -m "not slow and not long" $(BY_FILE) $(CORE)

quick-tests: install
	$(BIN)/pytest -m "not slow and not long" $(BY_FILE)

# One process, beside the types and then beside the other tests: what has to be compiled once in a new checkout, modules
# of the libraries and kernels of Numba, is not compiled by two at a time. Its words come at its end, in one piece.
as-used-tests: install
	@said=$$(mktemp) && code=0 && \
	{ XLA_FLAGS= $(BIN)/pytest -m "as_used and not slow" $(call TYPED,keepout.core) $(AS_USED) > $$said 2>&1 || code=$$?; } && \
	cat $$said && rm $$said && exit $$code

other-tests: types
	$(BIN)/pytest -m "not slow and not as_used" $(BY_FILE)

test-all: lint
	XLA_FLAGS= $(BIN)/python tests/where_time_goes.py --keep out/test-all $(BY_FILE) \
		--hypothesis-profile=random $(call TYPED,keepout)

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: install
	$(BIN)/python docs/site.py

shipped: install
	$(BIN)/python benchmarks/shipped.py

flight-code: install
	$(BIN)/python benchmarks/flight_code.py

basilisk: .venv-basilisk/.installed
	.venv-basilisk/bin/python examples/basilisk/fly.py --out out/basilisk

.venv-basilisk/.installed: pyproject.toml
	$(PYTHON) -m venv .venv-basilisk
	.venv-basilisk/bin/pip install --quiet --editable '.[basilisk]'
	@touch $@

# With RELEASE="--quick --python python3.12" a rough shape, and another Python.
release-check:
	$(PYTHON) tests/release_check.py $(RELEASE)

replay-bundle:
	cd viewer && npm ci && npm run build

clean:
	find src benchmarks -name '*.nb[ci]' -delete
	rm -rf $(VENV) .venv-basilisk out zensical.toml .cache .pytest_cache .ruff_cache
