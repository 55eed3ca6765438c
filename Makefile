# make demo   train two centralised and two decentralised forms on field_03, print the comparison
# make quick  lint, run the tests that take no seconds
# make test   lint, type-check, run the tests of every pull request
# make docs   build the documentation site into build/docs, warnings as errors
# make readme do what the README shows, with the wheel, in an empty folder
# make unpinned install the planner's extra without constraints, and prove an optimum
# make cuda   compile the CUDA kernels to machine code, without a GPU; print registers and spills
# make all    all of this, and what takes long: tests marked all, the judges of the engine without
#             its compiler and on the newest Numba, the oldest versions allowed, every page's commands
# make clean  remove what the others made, but not runs/
# All but clean set up .venv first.

PYTHON ?= python3
BIN := .venv/bin
PYTEST := python -m pytest -n 2 --dist worksteal
JUDGES := tests/engine/test_golden.py tests/engine/test_oracle.py tests/adapters/test_forms.py
PLAN := from mbn_marl.planning import plan; print(plan('field_03').makespan)
export NUMBA_CACHE_DIR ?= $(CURDIR)/.numba_cache

.PHONY: demo quick test ruff mypy pytest docs readme unpinned cuda all clean
.DELETE_ON_ERROR:

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade pip -c constraints.txt
	$(BIN)/pip install --quiet -c constraints.txt torch
	$(BIN)/pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

demo: .venv/installed
	$(BIN)/mbn compare --fields field_03 --seeds 0 1 2 --steps 655360 \
		--out runs/demo --force

ruff: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

mypy: ruff
	$(BIN)/mypy

pytest: ruff
	$(BIN)/$(PYTEST)

quick: ruff
	$(BIN)/$(PYTEST) -m "not slow and not all"

test:
	$(MAKE) -j2 mypy pytest

docs: .venv/installed
	$(BIN)/sphinx-build -q -W --keep-going -d build/doctrees docs build/docs

readme: .venv/installed
	$(BIN)/python -m tests.newcomer README.md

unpinned:
	$(PYTHON) -m venv --clear build/unpinned
	build/unpinned/bin/pip install --quiet '.[plan]'
	test "$$(build/unpinned/bin/python -c "$(PLAN)")" = 17

cuda: .venv/installed
	$(PYTHON) -m venv --clear build/cuda
	build/cuda/bin/pip install --quiet -c constraints.txt '.[cuda]' nvidia-cuda-nvcc
	ls -d $(CURDIR)/.venv/lib/*/site-packages > $$(ls -d build/cuda/lib/*/site-packages)/borrowed.pth
	build/cuda/bin/python -m pytest -n 0 -s -m all -k machine_code tests/engine/test_cuda.py

all: test docs readme unpinned cuda
	$(BIN)/$(PYTEST) -m all
	MBN_PLAIN_JIT=1 NUMBA_CACHE_DIR=build/plain_cache $(BIN)/$(PYTEST) $(JUDGES)
	$(PYTHON) -m venv --clear build/newest
	build/newest/bin/pip install --quiet numba
	ls -d $(CURDIR)/.venv/lib/*/site-packages > $$(ls -d build/newest/lib/*/site-packages)/borrowed.pth
	NUMBA_CACHE_DIR=build/newest/cache build/newest/bin/$(PYTEST) $(JUDGES)
	$(BIN)/python -m tests.lowest
	$(BIN)/python -m tests.newcomer

clean:
	rm -rf .venv .numba_cache .mypy_cache .ruff_cache .pytest_cache *.egg-info build
