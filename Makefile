# Everything runs in .venv, made here from the pinned set of constraints.txt.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2
# One thread a process: the tests run in several.
TEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS)

.PHONY: help demo test check lint types docs coverage bench build format clean
.DEFAULT_GOAL := help

help:  ## this list
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{ printf "make %-10s %s\n", $$1, $$2 }'

demo: $(VENV)/ready  ## a rendered drive end to end, into out/demo
	$(BIN)/lanebev demo --out out/demo

test: lint types docs  ## the gate: ruff, mypy --strict, docs and all tests
	$(TEST)

check: lint types  ## for every save: ruff, mypy --strict and the tests that are not slow
	$(TEST) -m "not slow"

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/ready
	$(BIN)/mypy --strict lanebev train tools

docs: $(VENV)/ready  ## the documentation as a site, built strictly, into site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

coverage: $(VENV)/ready  ## all tests with the lines that they run, into out/coverage
	$(TEST) --cov=lanebev --cov-report=term:skip-covered --cov-report=html:out/coverage

bench: $(VENV)/ready  ## speed and accuracy of the calibrators, a quick run, into out/bench
	$(BIN)/python -m tools.bench_filter --out out/bench/filter.json
	$(BIN)/python -m tools.bench_calibration --quick --calibrators joint two-stage --out out/bench

build: $(VENV)/ready  ## wheel and source distribution, into dist
	$(BIN)/python -m build --no-isolation

format: $(VENV)/ready  ## mend what ruff can mend
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[train,export,formats,fleet,completion,rerun,docs,dev]'
	touch $@

clean:  ## remove the environment and everything that was made
	rm -rf $(VENV) out dist site
