# Every target first sets up what is missing: Debian packages, .venv, and what pip installs there.

SYSTEM_PYTHON := /usr/bin/python3
PACKAGES := python3-dolfinx python3-h5py-mpi libopenblas0-serial openmpi-bin \
    python3-venv python3-dev gcc g++
GRAPHICS := libegl1 libgl1-mesa-dri libxrender1
PYTHON := .venv/bin/python
READY := .venv/ready
RUNS := .venv/runs
# The second lane: DOLFINx from a wheel, for another Python. The first of these that runs; pyenv hides its own.
WHEEL_PYTHON = $(shell for python in python3.12 python3.13 python3.14 $$(ls -d $$HOME/.pyenv/versions/3.1[2-4].*/bin/python 2>/dev/null); \
    do $$python -c 'import venv, ensurepip' 2>/dev/null && echo $$python && break; done)
WHEEL_VENV := .venv-wheel
WHEEL_READY := $(WHEEL_VENV)/ready
WHEEL_TESTS := tests
DEMO := beam
# Files of tests go to one worker for each core; a file stays together, since its tests share what is built.
WORKERS := --numprocesses $(shell env -u OMP_NUM_THREADS nproc) --dist loadfile
ARGS :=
# To compile all modules anew takes as long as the unit tests, in every worker: kept here, whatever the environment says.
KEPT := PYTHONDONTWRITEBYTECODE= PYTHONPYCACHEPREFIX=$(CURDIR)/.venv/compiled
INSTALL = PIP_CONSTRAINT=constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 $(PYTHON) -m pip install --quiet --no-compile --editable

# Open MPI refuses root without these two; one BLAS thread per rank.
export OMPI_ALLOW_RUN_AS_ROOT := 1
export OMPI_ALLOW_RUN_AS_ROOT_CONFIRM := 1
export OMP_NUM_THREADS := 1

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
.PHONY: help setup setup-wheel demo test test-unit test-faults test-flags test-all test-wheel lint house notebooks bench docs release clean system graphics browser

help: ## list the targets
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 18

setup: $(READY) ## install what is missing

setup-wheel: $(WHEEL_READY) ## install DOLFINx 0.11 from PyPI into .venv-wheel (Python 3.12 or newer)

demo: $(or $(wildcard $(READY)),$(RUNS)) ## run configs/beam.toml on 2 ranks; its last line says where the report is
	@mpirun -n 2 --oversubscribe --bind-to none .venv/bin/tissuq run configs/$(DEMO).toml --out results/$(DEMO)

test: $(READY) browser ## run the test suite (ARGS="-k word" goes to pytest)
	@$(KEPT) $(PYTHON) -m pytest $(WORKERS) $(ARGS)

test-unit: $(READY) ## run the tests that take milliseconds, in less than 10 s
	@$(KEPT) $(PYTHON) -m pytest -m "unit and not slow" -p no:hypothesispytest $(ARGS)

test-faults: $(READY) ## plant faults in formulas in turn, and say which of them the unit tests see (ARGS="bias" plants one)
	@$(PYTHON) -m tests.faults $(ARGS)

test-all: $(READY) browser ## run the test suite with the slow tests
	@$(KEPT) $(PYTHON) -m pytest $(WORKERS) -m "not benchmark" $(ARGS)

test-flags: $(READY) ## run what depends on compiler flags and on OpenBLAS's kernels with several of them
	@$(PYTHON) -m tests.flags $(ARGS)

test-wheel: $(WHEEL_READY) ## run the test suite with DOLFINx 0.11, without ranks (WHEEL_TESTS=tests/forward: those of bodies)
	@$(WHEEL_VENV)/bin/python -m pytest $(WORKERS) -m "not slow and not benchmark and not mpi" $(WHEEL_TESTS) $(ARGS)

lint: $(READY) ## check style, types and layers
	@$(PYTHON) -m ruff check
	@$(PYTHON) -m ruff format --check
	@$(PYTHON) -m mypy
	@.venv/bin/lint-imports
	@$(PYTHON) -m tests.circles

house: $(READY) ## count what says how large and how clear the code is
	@$(PYTHON) -m tests.house

notebooks: $(READY) ## run the notebooks, and leave them in results/notebooks with their pictures
	@$(PYTHON) -m tests.notebooks $(ARGS)

bench: $(READY) ## measure times
	@$(PYTHON) -m benchmarks $(ARGS)

docs: $(READY) ## build the documentation into site/, without network
	@NO_MKDOCS_2_WARNING=1 $(PYTHON) -m mkdocs build --strict --quiet
	@echo site/index.html

release: docs ## build the source archive and the wheel into dist/, install the wheel elsewhere and run a study with it
	@$(PYTHON) -m tests.release

clean: ## remove .venv and caches; results stay
	@rm -rf .venv $(WHEEL_VENV) build dist site *.egg-info .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .grimp_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Reports are tested in a browser; without one these tests are skipped, with the reason.
browser:
	@command -v chromium >/dev/null || ! command -v apt-get >/dev/null || $(MAKE) --no-print-directory system PACKAGES=chromium || \
	    echo "Chromium could not be installed: reports are not tested in a browser" >&2

graphics:
	@$(MAKE) --no-print-directory system PACKAGES="$(GRAPHICS)"

system:
	@missing=; for package in $(PACKAGES); do \
	    case "$$(dpkg-query -W -f '$${db:Status-Status}' $$package 2>/dev/null || true)" in \
	        installed) ;; *) missing="$$missing $$package" ;; esac; \
	done; \
	if [ -n "$$missing" ]; then \
	    echo "installing:$$missing"; \
	    command -v apt-get >/dev/null || { echo "apt-get not found: tissuq is set up on Debian 12" >&2; exit 1; }; \
	    sudo=; [ "$$(id -u)" = 0 ] || sudo=sudo; \
	    $$sudo apt-get update -qq; \
	    $$sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $$missing >/dev/null; \
	fi

# What runs studies, and what tests, documentation and notebooks need besides. A constraint file given by environment
# holds for build environments too. Of files of packages those are compiled that a study imports, which most are not:
# where the environment forbids it later (PYTHONDONTWRITEBYTECODE), each start would take two to three times as long.
$(RUNS): pyproject.toml constraints.txt | system
	@echo "installing Python packages into .venv"
	@$(SYSTEM_PYTHON) -m venv --system-site-packages .venv
	@$(INSTALL) .
	@PYTHONDONTWRITEBYTECODE= $(PYTHON) -c 'import dolfinx, chaospy, h5py, h5netcdf, matplotlib.pyplot, numpy, scipy.stats, xarray'
	@$(PYTHON) -m compileall -q forward inverse tissuq uq workflows
	@touch $@

$(READY): pyproject.toml constraints.txt | $(if $(wildcard $(READY)),,$(RUNS)) graphics
	@echo "installing what tests, documentation and notebooks need"
	@$(INSTALL) '.[dev]'
	@touch $@

$(WHEEL_READY): pyproject.toml constraints.txt
	@[ -n "$(WHEEL_PYTHON)" ] || { echo "no Python 3.12 or newer found" >&2; exit 1; }
	@echo "installing Python packages into $(WHEEL_VENV)"
	@$(WHEEL_PYTHON) -m venv $(WHEEL_VENV)
	@PIP_CONSTRAINT=constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 $(WHEEL_VENV)/bin/python -m pip install --quiet --no-compile \
	    --editable '.[fenicsx,check,vtk]' hatchling hypothesis jsonschema pytest pytest-xdist pyyaml SALib sympy umbridge
	@$(WHEEL_VENV)/bin/python -c 'import dolfinx_solver, dolfinx, chaospy, h5py, h5netcdf, numpy, scipy'
	@touch $@
