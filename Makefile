# Everything happens in .venv, which is made and filled on first use and again when the dependencies change.
PYTHON := $(shell python3.11 -c "print('python3.11')" 2>/dev/null || echo python3)
BIN := .venv/bin
DEPENDENCIES := setup.cfg pyproject.toml constraints.txt

.PHONY: demo test fast slow gpu fuzz oldest soak lint type format bench clean

demo: .venv/.installed
	$(BIN)/python examples/demo.py

test: lint type fast

# one torch thread per worker: the workers already fill the cores; one browser for all tests that need one
fast: .venv/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadgroup

slow: .venv/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 -m slow

# the tests use the CPU unless they are told otherwise
gpu: .venv/.installed-dev
	CUDA_VISIBLE_DEVICES=0 CUBLAS_WORKSPACE_CONFIG=:4096:8 $(BIN)/python -m pytest tests/networks/test_accelerator.py

# an input that fails is left in crash-*; SECONDS for each test
SECONDS ?= 3600
fuzz: .venv/.installed-dev
	$(BIN)/pip install --quiet -c constraints.txt -e ".[fuzz]"
	for test in $$($(BIN)/python tests/fuzz.py 2>&1 >/dev/null | tail -n +2); do \
		OMP_NUM_THREADS=1 $(BIN)/python tests/fuzz.py $$test -max_total_time=$(SECONDS) || exit 1; done

# the fast tests with the lowest versions that setup.cfg accepts, but for the extra that wants a newer torch
oldest:
	$(PYTHON) -m venv --clear .venv-oldest
	.venv-oldest/bin/pip install --quiet uv
	.venv-oldest/bin/uv pip install --python .venv-oldest/bin/python --quiet --resolution lowest-direct -e ".[franka,zoo,plots,hub,cluster,dev]"
	OMP_NUM_THREADS=1 .venv-oldest/bin/python -m pytest -n 2 --dist loadgroup

# half an hour
soak: .venv/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/soak.py

lint: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: .venv/.installed-dev
	$(BIN)/mypy

format: .venv/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: .venv/.installed-dev
	for script in benchmarks/bench_*.py; do $(BIN)/python $$script || exit 1; done

clean:
	rm -rf .venv .venv-oldest build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache

.venv/.installed: $(DEPENDENCIES) | .venv
	$(BIN)/pip install --quiet -c constraints.txt -e ".[zoo,plots]"
	touch $@

.venv/.installed-dev: $(DEPENDENCIES) | .venv
	$(BIN)/pip install --quiet -c constraints.txt -e ".[all,dev]"
	touch $@ .venv/.installed

.venv:
	$(PYTHON) -m venv .venv
