# make demo              the loop on a simulated capture that hides an effect: error before and after
# make demo DATA=path    the same on dark frames of your own
# make test              the tests that take a few minutes
# make test-slow         all tests that need no accelerator, browser or stop-watch
# make test-browser      reports in Chromium, which must be there: apt-get install chromium
# make lint              ruff and mypy
#
# Needs Python 3.11 or later, git and make. Everything is installed into .venv, once.

VENV ?= .venv
PYTHON ?= $(shell for p in python3 python3.11 python3.12 python3.13 python3.14 python; do \
    $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && echo $$p && break; done)
BIN = $(VENV)/bin
ARGS ?=

.PHONY: demo test test-slow test-browser lint clean

demo: $(VENV)/.installed
	$(BIN)/hsnoise demo $(if $(DATA),--data "$(DATA)") $(ARGS)

# Most of the time is compilation: less of it with these flags, and if one process runs all tests of a file.
# `make test-slow` compiles as users do.
test: $(VENV)/.installed-dev
	flags=$$($(BIN)/python tests/quick_xla.py) && XLA_FLAGS="$${XLA_FLAGS-$$flags}" \
	    $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

test-slow: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not gpu and not browser and not benchmark" $(ARGS)

test-browser: $(VENV)/.installed-browser
	$(BIN)/python -m pytest -m browser -rs tests/test_report_browser.py $(ARGS)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .mypy_cache .hypothesis

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "make: no Python 3.11 or later found; give its name: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-browser: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable ".[browser]"
	@touch $@
