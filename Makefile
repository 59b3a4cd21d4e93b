# Everything runs in .venv, which is made here with the pinned versions of constraints.txt.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2
# One thread per process, because the tests run in several processes.
TEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS)

.PHONY: help demo test check lint types docs coverage bench build format clean
.DEFAULT_GOAL := help

help:  ## print this list
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{ printf "make %-10s %s\n", $$1, $$2 }'

demo: $(VENV)/ready  ## render a drive and calibrate it, into out/demo
	$(BIN)/lanebev demo --out out/demo

test: lint types docs  ## all checks: ruff, mypy --strict, docs and all tests
	$(TEST)

check: lint types  ## fast checks: ruff, mypy --strict and the tests that are not slow
	$(TEST) -m "not slow"

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/ready
	$(BIN)/mypy --strict lanebev train tools

docs: $(VENV)/ready  ## build the documentation strictly, into site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

coverage: $(VENV)/ready  ## run all tests and report the lines they run, into out/coverage
	$(TEST) --cov=lanebev --cov-report=term:skip-covered --cov-report=html:out/coverage

bench: $(VENV)/ready  ## measure the accuracy of the calibrators quickly, into out/bench
	$(BIN)/python -m tools.bench_calibration --quick --calibrators joint two-stage --out out/bench

build: $(VENV)/ready  ## build wheel and source distribution, into dist
	$(BIN)/python -m build --no-isolation

format: $(VENV)/ready  ## fix what ruff can fix
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[train,export,formats,fleet,completion,rerun,docs,dev]'
	touch $@

clean:  ## remove the environment and all outputs
	rm -rf $(VENV) out dist site
