# make demo | test | lint | bench: each makes .venv first, once.
# make setup PIP_ARGS="--index-url …" says where pip takes packages from.

PYTHON ?= python3
PIP_ARGS ?=
BIN := .venv/bin
READY := .venv/.ready
BENCHMARKS := engine emps recovery check excite diagnosis diagnosis_time concealed real peers trpo learn learn_effect belief \
	selection

.PHONY: setup demo test lint bench

setup: $(READY)

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "Python 3.11 or newer is needed: make setup PYTHON=python3.12"; exit 1; }
	@echo "Installing into .venv, once; this takes a few minutes"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install -q -q --disable-pip-version-check $(PIP_ARGS) \
		--constraint constraints.txt --editable '.[dev,notebooks,report]'
	@touch $(READY)

demo: setup
	$(BIN)/bo-sysid demo

lint: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

# the tests run in two processes, one thread each, and what a module prepares is prepared once; in
# their own order, of which the last are short: else modules of few tests, the longest, come last
test: export BO_SYSID_THREADS = 1
test: export OMP_NUM_THREADS = 1
test: export OPENBLAS_NUM_THREADS = 1
test: lint
	$(BIN)/python -m pytest --numprocesses 2 --dist loadscope --no-loadscope-reorder --quiet

bench: setup
	for name in $(BENCHMARKS); do $(BIN)/python benchmarks/$$name.py || exit 1; done
	$(BIN)/python benchmarks/publish.py
