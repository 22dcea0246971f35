# Every target makes .venv itself, from any Python 3.11 to 3.14; PYTHON=python3.12 chooses one.
#   make demo       register a real pair, and write a picture and a page into out/
#   make test       the tests
#   make test-slow  what takes too long for every change: see .ci/nightly
#   make lint       ruff and mypy
#   make coverage   the tests, and how much of the package they reach
#   make bench      measure speed; BENCH="--quick --minutes 8" for a short one
#   make docs       the site, into out/docs

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.PHONY: demo test test-slow lint format coverage bench docs clean

PYTHON ?=
BENCH ?=
BIN := .venv/bin
RUNNABLE := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))

demo: .venv/.viz
	$(BIN)/cfr demo

# A file of tests stays in one process: its tests share what they compile.
test: .venv/.dev
	$(BIN)/python -m pytest -n auto --dist loadfile

test-slow: .venv/.dev
	.ci/nightly

coverage: .venv/.dev
	$(BIN)/python -m pytest -n auto --dist loadfile --cov --cov-report=term --cov-fail-under=92

lint: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: .venv/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: .venv/.dev
	$(BIN)/python benchmarks/run.py $(BENCH)

docs: .venv/.dev
	$(BIN)/python -m sphinx -b html -W --keep-going -q docs out/docs
	@echo "wrote out/docs/index.html"

clean:
	rm -rf .venv out build dist .coverage .pytest_cache .ruff_cache .mypy_cache

# The stamps are newer than pyproject.toml as long as what it asks for is installed.
.venv/.viz: pyproject.toml | .venv/bin/python
	@echo "installing cfr_jax into .venv (a few minutes the first time)"
	$(BIN)/python -m pip install -qq --disable-pip-version-check --editable '.[viz]'
	@touch $@

.venv/.dev: pyproject.toml | .venv/bin/python
	@echo "installing cfr_jax and its tools into .venv (a few minutes the first time)"
	$(BIN)/python -m pip install -qq --disable-pip-version-check --editable '.[dev]'
	@touch $@ .venv/.viz

# A shim of pyenv may be found and not run, a Debian Python may lack venv: try each one.
.venv/bin/python:
	@for python in $(or $(PYTHON),python3 python3.12 python3.13 python3.14 python3.11 python); do \
	  if "$$python" -c '$(RUNNABLE)' 2>/dev/null; then exec "$$python" -m venv --clear .venv; fi; \
	done; \
	echo "no Python from 3.11 to 3.14 with venv found (tried: $(or $(PYTHON),python3 python3.11 python3.12 python3.13 python3.14 python))." >&2; \
	echo "Debian and Ubuntu: apt-get install python3-venv. Elsewhere: make PYTHON=/path/to/python3.12" >&2; \
	exit 1
