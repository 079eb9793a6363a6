# Everything works from a fresh clone: the first command makes the environment.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
UV     := $(shell command -v uv 2>/dev/null)
OUT    ?= out
# small matrices: more threads than processes only get in each other's way
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1
# what Python compiles once serves all processes of the tests
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo check test test-all lowest e2e browser study bench docs lint clean

$(VENV)/.ready: pyproject.toml
ifdef UV
	$(UV) venv --quiet --allow-existing --python $(PYTHON) $(VENV)
	$(UV) pip install --quiet --python $(BIN)/python -e . --group dev
else
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet -e . --group dev
endif
	@touch $@

# the packages of the runs in other programs come after the default check, into the same place
$(VENV)/.ready-e2e: $(VENV)/.ready
ifdef UV
	$(UV) pip install --quiet --python $(BIN)/python -e ".[e2e,aot,dask,pdf,pyrtc]"
else
	$(BIN)/python -m pip install --quiet -e ".[e2e,aot,dask,pdf,pyrtc]"
endif
	@touch $@

$(VENV)/.ready-browser: $(VENV)/.ready
ifdef UV
	$(UV) pip install --quiet --python $(BIN)/python --group browser
else
	$(BIN)/python -m pip install --quiet --group browser
endif
	@touch $@

demo: $(VENV)/.ready     ## design both filters for the LBT, close the loop, write out/
	@mkdir -p $(OUT)
	$(BIN)/lbt-synth design examples/lbt.yaml --method kalman -o $(OUT)/kalman.fits
	$(BIN)/lbt-synth design examples/lbt.yaml --method hinf --gamma-ratio 1.2 -o $(OUT)/hinf.fits
	$(BIN)/lbt-synth plot sigma $(OUT)/kalman.fits $(OUT)/hinf.fits -o $(OUT)/sigma.png
	$(BIN)/lbt-synth simulate examples/lbt.yaml $(OUT)/kalman.fits -o $(OUT)/kalman_loop.png
	$(BIN)/lbt-synth simulate examples/lbt.yaml $(OUT)/hinf.fits -o $(OUT)/hinf_loop.png
	$(BIN)/lbt-synth robustness examples/lbt.yaml $(OUT)/kalman.fits $(OUT)/hinf.fits -o $(OUT)/robustness.png
	$(BIN)/lbt-synth report examples/lbt.yaml $(OUT)/kalman.fits $(OUT)/hinf.fits -o $(OUT)/report.html
	$(BIN)/lbt-synth paper -o $(OUT)/paper

lint: $(VENV)/.ready     ## style, types, import layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check: lint              ## lint, and the tests of the modules that a change touches
	$(BIN)/pytest -n 2 -q -x -m "not study and not e2e and not browser" $$($(BIN)/python .ci/touched-tests)

test: lint               ## the whole default check
	$(BIN)/pytest -n 2 --dist loadfile -m "not study and not e2e and not browser" --doctest-modules lbt_synth tests

test-all:                ## the check on each supported Python that is found
	PYTHON=$(PYTHON) .ci/each-python $(MAKE) test

lowest:                  ## the default tests with the lowest versions of all dependencies; needs uv
	$(UV) venv --quiet --allow-existing --python $(PYTHON) $(VENV)-lowest
	$(UV) pip install --quiet --python $(VENV)-lowest/bin/python --resolution lowest-direct -e .
	$(UV) pip freeze --quiet --python $(VENV)-lowest/bin/python --exclude-editable > $(VENV)-lowest/lowest.txt
	$(UV) pip install --quiet --python $(VENV)-lowest/bin/python -e . --group test --constraint $(VENV)-lowest/lowest.txt
	$(VENV)-lowest/bin/python -m pytest -n 2 -m "not study and not e2e and not browser" tests

e2e: $(VENV)/.ready-e2e  ## with the optional extras: SPECULA, AOT, Dask, PDF, pyRTC; a test that is skipped, or none at all, fails
	$(BIN)/pytest -n 2 -m e2e --no-skips tests

browser: $(VENV)/.ready-browser ## pages in headless Chromium (Debian: chromium, chromium-driver); no test may be skipped
	$(BIN)/pytest -m browser --no-skips tests

study: $(VENV)/.ready    ## the long numerical studies
	$(BIN)/pytest -m study tests

bench: $(VENV)/.ready    ## whole commands and their parts, beside peers and bars
	$(BIN)/python benchmarks/speed.py

docs: $(VENV)/.ready     ## the documentation, warnings are errors
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build/html

clean:
	rm -rf $(OUT) $(VENV) docs/_build docs/api/generated docs/gallery .pytest_cache .mypy_cache .ruff_cache
