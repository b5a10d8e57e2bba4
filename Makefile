# Everything happens in a virtual environment of the project's own: nothing else needs to be installed than Python and make.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
TASK ?= walker_stand
ARGS ?=
PYTEST_ARGS ?= --numprocesses auto --dist loadfile
PICTURES ?=
NOTEBOOKS ?= $(wildcard notebooks/*.ipynb)
CPP := $(wildcard torchrl_loco/sim/compiled/*/*.h torchrl_loco/sim/compiled/*/*/*.h)
PYTEST := $(BIN)/python -m pytest $(PYTEST_ARGS)

.PHONY: help train test test-fast test-all tests tests-ci lint format docs runners viewer tables notebooks report dist clean

help:  ## this list
	@grep -E '^[a-z-]+:.*##' Makefile | sed -E 's/:.*##/\t/' | expand -t 12

train: $(VENV)/installed  ## train a policy; TASK=walker_walk ARGS="--seed 1" to change what
	$(BIN)/torchrl-loco train $(TASK) $(ARGS)
	@echo "next: see learning_curve.png and video.mp4 in that folder, or watch the policy: $(BIN)/torchrl-loco play FOLDER"

test: lint tests  ## style, types and the tests, on real physics

test-fast: $(VENV)/installed  ## the everyday part of the tests
	$(PYTEST) -m "not slow and not ci"

test-all: lint tests tests-ci  ## the same as test, then site, notebooks, wheel and a training run

# The parts of these, for workflows.
tests: $(VENV)/installed
	$(PYTEST) -m "not ci"

tests-ci: $(VENV)/installed-ci
	$(PYTEST) -m ci

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $(CPP)
	$(BIN)/mypy

format: $(VENV)/installed  ## format the code and apply safe fixes
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CPP)

dist: $(VENV)/installed  ## wheel and sdist, checked and tried out, into dist/
	rm -rf dist
	$(BIN)/python -m hatchling build
	$(BIN)/python -m pytest tests/test_packaging.py

docs: $(VENV)/installed  ## the site, into docs/_build/html; warnings are errors
	$(BIN)/sphinx-build -W --keep-going -b html docs docs/_build/html

runners: $(VENV)/installed  ## draw the moving pictures anew, with the shipped policies; PICTURES=robots.webp for some
	PYTHONPATH=docs $(BIN)/python -m generate.runners $(PICTURES)

viewer: $(VENV)/installed  ## draw the moving picture of the viewer anew, in Chromium
	PYTHONPATH=docs $(BIN)/python -m generate.viewer go1_velocity

tables: $(VENV)/installed  ## write tables and pictures of README and docs from benchmarks/results
	PYTHONPATH=docs $(BIN)/python -m generate.benchmarks

report:  ## docs/report as a PDF in docs/_build; needs pdflatex
	mkdir -p docs/_build
	cd docs/report && for run in 1 2; do pdflatex -interaction=nonstopmode -output-directory=../_build report.tex; done

notebooks: $(VENV)/installed  ## run the notebooks and store their output; NOTEBOOKS=notebooks/rewards.ipynb for one
	$(BIN)/python notebooks/execute.py $(NOTEBOOKS)

# PIP_ARGS can constrain versions, for example to a CPU build of torch: make test PIP_ARGS="torch==2.13.0"
$(VENV)/installed: pyproject.toml
	@echo "setting up $(VENV): pip downloads torch and others, with CUDA some gigabytes, and takes minutes"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install $(PIP_ARGS) --editable ".[dev]"
	touch $@

$(VENV)/installed-ci: $(VENV)/installed
	$(BIN)/python -m pip install --quiet $(PIP_ARGS) --editable ".[ray,wrappers]"
	touch $@

clean:
	rm -rf $(VENV) dist .mypy_cache .pytest_cache .ruff_cache docs/_build docs/generated
