# make demo         set up and run the demonstration: the paper's simulated arm, and a real Franka Panda
# make test         set up and run the tests (budget: 3 minutes on two cores)
# make test-slow    the tests that take long, or need optimised programs; the other half of what CI runs
# make test-rounding    the examples of all docstrings and a selection of the tests, rounded as by another processor
# make test-exhaustive  before a release: coverage by many trials, every robot, every notebook, all variants; the slow
#                   ones again with their types checked, and ten times as many examples of what hypothesis draws
# make docs         the documentation, into docs/_build/html (runs the notebooks that changed; make docs NOTEBOOKS=stored
#                   shows their stored outputs instead)
# make check        lint, types and import contracts
# make test-newest  a selection of the tests with the newest versions that pyproject.toml allows, installed from scratch
# make test-lowest  the same with the lowest
# make package      the source distribution and the wheel, installed and used in another folder: the core, and everything
# make package-matrix  the same with each extra, on the oldest Python allowed and the newest one found
# make release VERSION=0.2.0    everything that a release consists of, into dist/0.2.0; publishes nothing (.ci/release)
# make audit        known vulnerabilities of the environment; skipped where their service cannot be reached
# make bench        identifications a second, against every contender that is installed
# make reproduce    Cheng et al. 2018, recomputed and checked against benchmarks/cheng2018/REPRODUCTION.md (1.5 minutes
#                   of CPU, 3.5 with an empty compilation cache); make reproduce WRITE=1 rewrites it
# make peers        install the contender that needs a Python environment of its own
# Everything is installed into .venv in this folder (test-newest and test-lowest: .venv-newest, .venv-lowest).

PYTHON ?= $(shell for python in python3 python3.11 python3.12 python3.13 python3.14; do \
	"$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo "$$python" && break; done)
BIN := .venv/bin
# Make reads a comma in the arguments of a call as the end of one, so what contains commas has a name.
USERS := '.[plot,report]'
# install,FOLDER,ARGUMENTS: by pip; with make UV=uv by uv, in a tenth of the CPU, and by pip where that fails.
install = $(if $(UV),$(UV) pip install --quiet --python $(1)/bin/python $(2) || )$(1)/bin/python -m pip install --quiet \
	--disable-pip-version-check $(2)
# A worker that dies ends the run: a replacement might wait for ever for tests that went with the first.
PYTEST := -m pytest -n auto --max-worker-restart 0 --dist loadscope --no-loadscope-reorder
# Tests compile without XLA's optimisations (see tests/__init__.py), except where the variable is set, be it empty.
OPTIMISED := XLA_FLAGS=
# The others would be collected for nothing, in 7 s of CPU for each worker.
OPTIMISED_FILES = $(shell grep -rlw --include "test_*.py" mark.optimised tests)
# Numerics, differentiation, storage and the command line on real captures: what a change of a dependency breaks first.
SELECTION := tests/test_package.py tests/kinematics tests/solver \
	tests/pipeline/test_single.py tests/files/test_hdf5.py tests/test_real_captures.py
PANDA := aacmm-demo/panda
SUMMARY := sed '/^Warning/,$$d'
# As a processor of 2008 rounds: SSE4.2 and the linear algebra of that time (without effect on other architectures).
OTHER_ROUNDING := OPENBLAS_CORETYPE=Nehalem XLA_FLAGS=--xla_cpu_max_isa=SSE4_2

.PHONY: demo test test-slow test-rounding test-exhaustive test-newest install-newest run-newest test-lowest check package \
	package-matrix release audit bench peers evidence docs reproduce clean

demo: .venv/.run
	$(BIN)/aacmm demo aacmm-demo
	@echo
	@echo "A real Franka Panda, calibrated in six placements of a tool with two sockets, evaluated in two others:"
	@echo
	$(BIN)/aacmm import examples/mukca/capture.toml -o $(PANDA)-capture.h5 > $(PANDA)-capture.txt
	$(BIN)/aacmm calibrate $(PANDA)-capture.h5 -o $(PANDA)-calibration.h5 \
		--without 'mid_left/*' --without 'mid_right/*' > $(PANDA)-calibration.txt
	@$(SUMMARY) $(PANDA)-calibration.txt
	$(BIN)/aacmm evaluate $(PANDA)-calibration.h5 $(PANDA)-capture.h5 -o $(PANDA)-evaluation.h5 > $(PANDA)-evaluation.txt
	@$(SUMMARY) $(PANDA)-evaluation.txt
	$(BIN)/aacmm report $(PANDA)-calibration.h5 -o $(PANDA)-report.html > $(PANDA)-report.txt
	@echo
	@echo "All that was printed, with warnings and tables, is in $(PANDA)-calibration.txt and $(PANDA)-evaluation.txt."
	@echo "Open in a browser: aacmm-demo/report.html (the simulated arm), $(PANDA)-report.html (the Panda)"

test: .venv/.test
	$(BIN)/python $(PYTEST)

test-slow: .venv/.test
	AACMM_TYPES=0 $(BIN)/python $(PYTEST) -m "slow and not optimised and not exhaustive"
	AACMM_TYPES=0 $(OPTIMISED) $(BIN)/python $(PYTEST) -m "optimised and not exhaustive" $(OPTIMISED_FILES)

test-rounding: .venv/.test
	AACMM_TYPES=0 $(OTHER_ROUNDING) $(BIN)/python $(PYTEST) -m "not exhaustive and not optimised" tests/docs/test_reference.py
	$(OTHER_ROUNDING) $(BIN)/python $(PYTEST) $(SELECTION) tests/uncertainty tests/cli

test-exhaustive: .venv/.test
	$(BIN)/python $(PYTEST) -m "(exhaustive or slow) and not optimised"
	$(OPTIMISED) $(BIN)/python $(PYTEST) -m "(exhaustive or slow) and optimised" $(OPTIMISED_FILES)
	AACMM_EXAMPLES=10 $(OPTIMISED) $(BIN)/python $(PYTEST) -m "hypothesis and not exhaustive"

test-newest: install-newest
	$(MAKE) --no-print-directory run-newest

install-newest:
	rm -rf .venv-newest
	$(PYTHON) -m venv .venv-newest
	$(call install,.venv-newest,--editable '.[selection]')

# As `make test`, without XLA's optimisations: where the newest jaxlib is the tested one, `make test-slow` has them.
run-newest:
	.venv-newest/bin/python -m pip list --disable-pip-version-check
	.venv-newest/bin/python $(PYTEST) $(SELECTION)

# Old releases warn of what newer releases of others deprecate.
test-lowest:
	rm -rf .venv-lowest
	$(PYTHON) -m venv .venv-lowest
	$(call install,.venv-lowest,--constraint requirements/lowest.txt --editable '.[selection]')
	$(OPTIMISED) .venv-lowest/bin/python $(PYTEST) -W ignore::DeprecationWarning $(SELECTION)

check: .venv/.dev
	$(BIN)/ruff check --no-cache . .ci/try_package .ci/readme_commands .ci/release
	$(BIN)/ruff format --check . .ci/try_package .ci/readme_commands .ci/release
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports --no-cache

package:
	$(PYTHON) .ci/try_package

package-matrix:
	$(PYTHON) .ci/try_package --matrix

release: .venv/.docs
	@$(BIN)/python .ci/release "$(VERSION)" $(DATE)

# Known vulnerabilities of what the tests run on. Their service is asked over the network; without one, this is skipped.
audit: .venv/.dev
	@timeout 300 $(BIN)/python -m pip_audit --progress-spinner off --skip-editable --timeout 15 > .venv/audit.txt 2>&1; \
	code=$$?; if [ $$code = 124 ] || grep -q "ConnectionError\|ServiceError\|Max retries" .venv/audit.txt; \
	then echo "audit skipped: the service of known vulnerabilities cannot be reached"; \
	else cat .venv/audit.txt; exit $$code; fi

# NOTEBOOKS=stored reaches docs/conf.py as an environment variable.
docs: .venv/.docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

bench: .venv/.test
	$(BIN)/python benchmarks/throughput.py

reproduce: .venv/.test
	$(BIN)/python benchmarks/cheng2018/reproduce.py $(if $(WRITE),--write)

evidence: .venv/.test
	$(BIN)/python benchmarks/evidence.py

peers: $(foreach peer,pybotics figaroh opencv,benchmarks/peers/$(peer)/.venv/.done)

benchmarks/peers/%/.venv/.done: benchmarks/peers/%/requirements.txt
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check --requirement $<
	touch $@

.venv/bin/python:
	@test -n "$(PYTHON)" || { echo "aacmm_jax needs Python 3.11 or later; install it, or name one with make PYTHON=..."; exit 1; }
	$(PYTHON) -m venv .venv

.venv/.run: pyproject.toml requirements/tested.txt | .venv/bin/python
	$(call install,.venv,--constraint requirements/tested.txt --editable $(USERS))
	touch $@

.venv/.test: pyproject.toml requirements/tested.txt | .venv/bin/python
	$(call install,.venv,--constraint requirements/tested.txt --editable '.[test]')
	touch $@ .venv/.run

.venv/.dev: pyproject.toml requirements/tested.txt | .venv/bin/python
	$(call install,.venv,--constraint requirements/tested.txt --editable '.[dev]')
	touch $@ .venv/.test .venv/.docs .venv/.run

.venv/.docs: pyproject.toml requirements/tested.txt | .venv/bin/python
	$(call install,.venv,--constraint requirements/tested.txt --editable '.[docs]')
	touch $@ .venv/.run

clean:
	rm -rf .venv .venv-newest .venv-lowest aacmm-demo docs/_build docs/notebooks docs/reference/api
	rm -rf docs/reference/command_line.md docs/reference/gallery*
	git clean -qfX docs/reference/files
