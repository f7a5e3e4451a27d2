# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
FOLDERS := agent channel common evaluation server training
# Python compiles what it imports as it does so: a third of all that is there, and in a fraction of the time.
PIP_INSTALL := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check \
  --constraint constraints.txt

# Tests start hundreds of processes; each would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE

# Tests and benchmarks are no verbs, which see to this by themselves: where other work keeps the cores busy,
# threads of numpy that share a product wait for each other all the time.
OPENBLAS_NUM_THREADS ?= 1
OMP_WAIT_POLICY ?= PASSIVE
export OPENBLAS_NUM_THREADS OMP_WAIT_POLICY

.PHONY: demo test test-slow check format docs results-page bench-pairs bench-scenes bench-loss \
  bench-lost-detail clean help

help:            ## what can be made
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 14

demo: $(VENV)/.ready-run  ## stream the demo sequence over a noisy link and reconstruct it live
	$(BIN)/semcast demo --out runs/demo $(ARGS)

PYTEST := $(BIN)/python -m pytest --numprocesses logical --maxprocesses 4 --dist loadgroup

test: $(VENV)/.ready-dev  ## run the tests, or those named: ARGS=tests/channel
	$(PYTEST) $(ARGS)

test-slow: $(VENV)/.ready-dev  ## run the tests that `make test` leaves out
	$(PYTEST) -m slow $(ARGS)

check: $(VENV)/.ready-dev  ## formatting, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	@rm -rf build/typecheck && mkdir -p build/typecheck/semcast  # where folders have their import names
	@cd build/typecheck/semcast && ln -s $(addprefix ../../../,src/semcast/* $(FOLDERS)) .
	MYPYPATH=build/typecheck $(BIN)/mypy -p semcast

format: $(VENV)/.ready-dev  ## rewrite the code in the project's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.ready-dev  ## write docs/commands.md from the command line
	COLUMNS=100 $(BIN)/python -m semcast.reference

bench-pairs: $(VENV)/.ready-run  ## measure relative poses (DATA=folder with sequences/ and blender/); overwrites results
	$(BIN)/python -m semcast.evaluation.pair_suite $(DATA) $(ARGS)
	$(BIN)/python -m semcast.evaluation.results_page

bench-scenes: $(VENV)/.ready-run  ## draw rooms, streets, blocks, orbits, measure paths on them (three hours of a core); overwrites results
	$(BIN)/python -m semcast.evaluation.scene_suite $(ARGS)
	$(BIN)/python -m semcast.evaluation.results_page

bench-loss: $(VENV)/.ready-run  ## train short with terms of the loss off (DATA=folder with train/ and valid/); overwrites results
	$(BIN)/python -m semcast.evaluation.loss_ablation $(DATA) $(ARGS)
	$(BIN)/python -m semcast.evaluation.results_page

bench-lost-detail: $(VENV)/.ready-run  ## fit and grade confidence at small rates (DATA=folder with train/ and valid/); overwrites results
	$(BIN)/python -m semcast.evaluation.lost_detail $(DATA) $(ARGS)
	$(BIN)/python -m semcast.evaluation.results_page

results-page: $(VENV)/.ready-run  ## write docs/results.md from evaluation/results
	$(BIN)/python -m semcast.evaluation.results_page

clean:           ## remove the environment and build products
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "semcast needs Python 3.11 or newer, $(PYTHON) is $$($(PYTHON) --version); try: make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.ready-run: $(BIN)/python pyproject.toml constraints.txt
	@echo "installing semcast into $(VENV) (once, about a minute)"
	$(PIP_INSTALL) --editable '.[agent,ros,server]'
	@touch $@

$(VENV)/.ready-dev: $(BIN)/python pyproject.toml constraints.txt
	@echo "installing semcast with its test tools into $(VENV) (once, about a minute)"
	$(PIP_INSTALL) --editable '.[dev]'
	@touch $@ $(VENV)/.ready-run
