# make demo   set up .venv, train PPO, MAPPO and IPPO on field_03, print the comparison
# make quick  set up .venv, lint, run the tests that take no seconds
# make test   set up .venv, lint, type-check, run all tests
# make docs   set up .venv, build the documentation site into build/docs, warnings as errors
# make pages  set up .venv, build the wheel, run what README and docs show with it elsewhere
# make lowest set up an empty environment with the oldest versions allowed, step every form there
# make clean  remove what the others made, but not runs/

PYTHON ?= python3
BIN := .venv/bin
export NUMBA_CACHE_DIR ?= $(CURDIR)/.numba_cache

.PHONY: demo quick test ruff mypy pytest docs pages lowest clean
.DELETE_ON_ERROR:

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade pip -c constraints.txt
	$(BIN)/pip install --quiet -c constraints.txt torch
	$(BIN)/pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

demo: .venv/installed
	$(BIN)/mbn compare --algos ppo mappo ippo --fields field_03 --seeds 0 1 2 --steps 655360 \
		--out runs/demo --force

ruff: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

mypy: ruff
	$(BIN)/mypy

pytest: ruff
	$(BIN)/pytest -n 2 --dist worksteal

quick: ruff
	$(BIN)/pytest -n 2 --dist worksteal -m "not slow"

test:
	$(MAKE) -j2 mypy pytest

docs: .venv/installed
	$(BIN)/sphinx-build -q -W --keep-going -d build/doctrees docs build/docs

pages: .venv/installed
	$(BIN)/python -m tests.newcomer

lowest: .venv/installed
	$(BIN)/python -m tests.lowest

clean:
	rm -rf .venv .numba_cache .mypy_cache .ruff_cache .pytest_cache *.egg-info build
