# Everything happens in .venv, which is made and filled on first use and again when the dependencies change; the documentation in
# a small one of its own.
PYTHON := $(shell python3.11 -c "print('python3.11')" 2>/dev/null || echo python3)
BIN := .venv/bin
DEPENDENCIES := setup.cfg pyproject.toml constraints.txt

.PHONY: demo test docs fast slow gpu fuzz oldest soak lint type format bench release-check clean

demo: .venv/.installed
	$(BIN)/python examples/demo.py

test: lint type fast

# a warning, a dead link or a cell that fails is an error. TUTORIALS=off runs no cell: the site then needs no torch
TUTORIALS ?= cache
docs: .venv-docs/.installed $(if $(filter off,$(TUTORIALS)),,.venv-docs/.kernel)
	OMP_NUM_THREADS=1 .venv-docs/bin/sphinx-build -D nb_execution_mode=$(TUTORIALS) --quiet --fresh-env --fail-on-warning --keep-going -c docs -d build/doctrees . build/docs

# one torch thread per worker: the workers already fill the cores
fast: .venv/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

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
	OMP_NUM_THREADS=1 .venv-oldest/bin/python -m pytest -n 2

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

# what the release workflow does: wheel and sdist in dist/, checked, and the quickstart where nothing else is installed
release-check:
	.ci/release-check $(PYTHON)

clean:
	rm -rf .venv .venv-docs .venv-oldest build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache

.venv/.installed: $(DEPENDENCIES) | .venv
	$(BIN)/pip install --quiet -c constraints.txt -e ".[zoo,plots]"
	touch $@

.venv/.installed-dev: $(DEPENDENCIES) | .venv
	$(BIN)/pip install --quiet -c constraints.txt -e ".[all,dev]"
	touch $@ .venv/.installed

# the extra alone, without what the package itself needs, which pip would install too
.venv-docs/.installed: $(DEPENDENCIES)
	$(PYTHON) -m venv --clear .venv-docs
	.venv-docs/bin/pip install --quiet -c constraints.txt $$(sed -n '/^docs =/,/^[a-z]/s/^    \([a-z]\)/\1/p' setup.cfg)
	touch $@

# the pages' notebooks are run by the Python that has the package
.venv-docs/.kernel: .venv-docs/.installed .venv/.installed-dev
	JUPYTER_PATH=$(CURDIR)/.venv-docs/share/jupyter $(BIN)/python -m ipykernel install --prefix .venv-docs --name python3 > /dev/null
	touch $@

.venv:
	$(PYTHON) -m venv .venv
