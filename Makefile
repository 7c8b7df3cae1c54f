# Everything runs in .venv, which these targets make and keep up to date.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# A file of tests stays with one worker, which builds and compiles once what its tests share; the longest come first.
BY_FILE := -n 2 --dist loadfile --no-loadscope-reorder

.PHONY: help demo check test test-all lint style types quick-tests tests format install docs shipped replay-bundle basilisk clean

help:
	@echo "make demo      set up, then fly the built-in demonstration; results in out/demo"
	@echo "make check     set up, lint, type-check and run the quick tests (about three and a half minutes on two cores)"
	@echo "make test      the same with the longer tests, as CI runs it (about 15 minutes on two cores)"
	@echo "make test-all  the same with the tests that take hours"
	@echo "make format    format the code"
	@echo "make docs      build the documentation site into out/site"
	@echo "make shipped   remake the learned fields that ship with the package"
	@echo "make replay-bundle  bundle the replay's viewer into the package again (needs Node.js and npm)"
	@echo "make basilisk  fly law and guard as flight software in Basilisk, in an environment of its own"
	@echo "make clean     remove the environment and all outputs"

install: $(STAMP)

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(0 if (3, 11) <= v < (3, 14) else "Keepout needs Python 3.11 to 3.13, but $(PYTHON) is %d.%d; run make PYTHON=python3.11" % v)'
	@echo "installing Keepout and its libraries into $(VENV): 1.8 GB, a minute or more without a word"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --editable '.[test,dev,docs]'
	@touch $(STAMP)

demo: install
	$(BIN)/keepout reproduce case1 --quick --out out/demo

lint: style types

style: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: install
	$(BIN)/pyright

# Types are checked beside the tests: pyright has work for one core and most of a minute.
check: style
	@$(MAKE) --no-print-directory --jobs=2 types quick-tests

test: style
	@$(MAKE) --no-print-directory --jobs=2 types tests

quick-tests: install
	$(BIN)/pytest -m "not slow and not long" $(BY_FILE)

tests: install
	$(BIN)/pytest -m "not slow" $(BY_FILE)

test-all: lint
	$(BIN)/pytest -n 2 --dist loadgroup --hypothesis-profile=random

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: install
	$(BIN)/python docs/site.py

shipped: install
	$(BIN)/python -m keepout.learning.shipped

basilisk: .venv-basilisk/.installed
	.venv-basilisk/bin/python examples/basilisk/fly.py --out out/basilisk

.venv-basilisk/.installed: pyproject.toml
	$(PYTHON) -m venv .venv-basilisk
	.venv-basilisk/bin/pip install --quiet --editable '.[basilisk]'
	@touch $@

replay-bundle:
	cd viewer && npm ci && npm run build

clean:
	rm -rf $(VENV) .venv-basilisk out zensical.toml .cache .pytest_cache .ruff_cache
