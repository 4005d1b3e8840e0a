# make demo   set up and run the demonstration
# make test   set up and run the tests (make test-slow: those that take long)
# make check  lint and types
# make bench  identifications a second, against every contender that is installed
# make reproduce  Cheng et al. 2018, recomputed: benchmarks/cheng2018/REPRODUCTION.md (two minutes on 2 cores)
# make peers  install the contenders that need a Python environment of their own
# Everything is installed into .venv in this folder.

PYTHON ?= $(shell for python in python3 python3.11 python3.12 python3.13; do \
	"$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo "$$python" && break; done)
BIN := .venv/bin

.PHONY: demo test test-slow check bench peers reproduce clean

demo: .venv/.run
	$(BIN)/aacmm demo aacmm-demo

test: .venv/.test
	$(BIN)/python -m pytest -n auto --dist loadscope --no-loadscope-reorder

test-slow: .venv/.test
	$(BIN)/python -m pytest -n auto --dist loadscope --no-loadscope-reorder -m slow

check: .venv/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

bench: .venv/.test
	$(BIN)/python benchmarks/throughput.py

reproduce: .venv/.test
	$(BIN)/python benchmarks/cheng2018/reproduce.py

peers: benchmarks/peers/pybotics/.venv/.done benchmarks/peers/pinocchio/.venv/.done

benchmarks/peers/%/.venv/.done: benchmarks/peers/%/requirements.txt
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check --requirement $<
	touch $@

.venv/bin/python:
	@test -n "$(PYTHON)" || { echo "aacmm_jax needs Python 3.11 or later; install it, or name one with make PYTHON=..."; exit 1; }
	$(PYTHON) -m venv .venv

.venv/.run: pyproject.toml | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

.venv/.test: pyproject.toml | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	touch $@ .venv/.run

.venv/.dev: pyproject.toml | .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@ .venv/.test .venv/.run

clean:
	rm -rf .venv aacmm-demo
