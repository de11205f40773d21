# Each target does its own set-up on a machine that has python3 (>= 3.11) and make; the second time it is quick.
#
#   make demo     the whole path on examples/plow-dry, ending in runs/demo/report.html
#   make test     the tests; sets up with every extra, 0.4 GB besides PyTorch
#   make test-slow  the tests that take minutes: whole reconstructions and simulations of the example sets
#   make mutants  small faults in the source, one at a time, and which of them no test sees; an hour
#   make lint     formatting, lint, unused code and types
#   make audit    known vulnerabilities of the installed packages, and the tests with the oldest ones that are allowed
#   make readme   docs/readme.webp, the README's picture, from the run of make demo
#   make docs     the documentation as a site, build/site/index.html
#   make clean    remove what these made, the virtual environment included; runs/ stays
#
# PYTHON        interpreter to make the virtual environment with
# VENV          where it goes
# TORCH_INDEX   package index to take torch from first; without a GPU https://download.pytorch.org/whl/cpu saves 4 GB
# PYTEST_ARGS   arguments for pytest
# MUTANTS_ARGS  arguments for tests/mutants/run.py

PYTHON ?= python3
VENV ?= .venv
TORCH_INDEX ?=
PYTEST_ARGS ?= -n 2 --dist loadfile -m "not slow"
MUTANTS_ARGS ?= --count 25 --seed 0

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
PACKAGES := splatsoil envs inverse benchmarks
SOURCES := $(shell find $(PACKAGES) -type f -not -path '*/__pycache__/*')

.PHONY: demo test test-slow mutants lint audit readme docs clean
.DELETE_ON_ERROR:

demo: $(VENV)/.use
	$(BIN)/splatsoil run examples/plow-dry --run runs/demo --no-effects

# One thread per worker: the workers together already fill the machine.
test: $(VENV)/.develop
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PYTEST_ARGS)

test-slow: $(VENV)/.develop
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow

mutants: $(VENV)/.develop
	$(BIN)/python tests/mutants/run.py $(MUTANTS_ARGS)

# Static checkers cannot see that envs/, inverse/ and benchmarks/ install as splatsoil.*, so mypy gets the built package.
lint: $(VENV)/.develop build/installed/.stamp
	$(BIN)/ruff format --check $(PACKAGES) tests examples mkdocs_hooks.py
	$(BIN)/ruff check $(PACKAGES) tests examples mkdocs_hooks.py
	$(BIN)/vulture
	cd build/installed && "$(abspath $(BIN))/mypy" --config-file "$(CURDIR)/pyproject.toml" -p splatsoil

audit: $(VENV)/.develop
	$(PIP) install --quiet pip-audit uv
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python build/oldest
	$(BIN)/uv pip install --quiet --python build/oldest/bin/python --resolution lowest-direct --editable '.[dev]'
	OMP_NUM_THREADS=1 build/oldest/bin/python -m pytest $(PYTEST_ARGS)
	$(BIN)/pip-audit --skip-editable

readme: demo
	$(BIN)/splatsoil benchmark readme runs/demo docs/readme.webp

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

clean:
	rm -rf build .pytest_cache .mypy_cache .ruff_cache *.egg-info $(VENV)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "splatsoil needs Python 3.11 or newer: make PYTHON=/path/to/python3.11 …" >&2; exit 2; }
	@$(PYTHON) -m venv $(VENV) || \
		{ rm -rf $(VENV); echo "python3 cannot make virtual environments; on Debian: apt install python3-venv" >&2; exit 2; }

$(VENV)/.use: pyproject.toml | $(BIN)/python
	$(if $(TORCH_INDEX),$(PIP) install torch --index-url $(TORCH_INDEX))
	$(PIP) install --editable .
	@touch $@

$(VENV)/.develop: pyproject.toml | $(VENV)/.use
	$(PIP) install --editable '.[dev]'
	@touch $(VENV)/.use $@

$(VENV)/.docs: pyproject.toml | $(VENV)/.use
	$(PIP) install --editable '.[docs]'
	@touch $(VENV)/.use $@

build/installed/.stamp: $(SOURCES) pyproject.toml README.md LICENSE $(VENV)/.develop
	rm -rf build/lib build/bdist.* build/wheel build/installed
	$(PIP) wheel --quiet --no-deps --no-build-isolation --wheel-dir build/wheel .
	$(PIP) install --quiet --no-deps --target build/installed build/wheel/*.whl
	@touch $@
