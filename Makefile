# `make demo`, `make live` and `make test` set up everything they need in .venv, once; nothing is installed outside this folder.

VENV      := .venv
BIN       := $(VENV)/bin
SLIM      := $(VENV)/slim
INSTALLED := $(VENV)/installed
PEERS     := $(VENV)/peers
WRITERS   := $(VENV)/writers
PYTHONS   := python3.11 python3.12 python3.13 python3.14
CANDIDATES := $(PYTHON) python3 python3.13 python3.12 python3.11
DEMO      := configs/experiment1_repaired.yaml
LIVE      := configs/experiment1_reduced.yaml
ANNEALING := maximiser.name=simulated_annealing maximiser.budget=1500 maximiser.cooling_range=1e-3 maximiser.polish=0.2 method.sc2=null method.indices=20 continuation.stop=1e-6
LITERAL_LIVE := configs/experiment1_literal.yaml
ALL_BUT_SLOW := "(long or not slow) and not benchmark"
PIP       := $(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check

define SET_UP
python=; for candidate in $(CANDIDATES); do \
  if $$candidate -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then python=$$candidate; break; fi; \
done; \
if [ -z "$$python" ]; then echo "SparseRob needs Python 3.11 or later with venv; set PYTHON=/path/to/python" >&2; exit 1; fi; \
if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
  echo "setting up $(VENV) with $$($$python --version), which takes a minute, once"; $$python -m venv --clear $(VENV); \
fi
endef

# Several test processes share the machine: one thread of linear algebra each.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: help install demo live paper test tests test-changed test-slow test-pythons archive mutants lint style types bench dist docs docs-pictures docs-tables clean

help:
	@echo "make demo        solve the repaired experiment 1, print the bounds, draw the figures"
	@echo "make live        watch the annealing climb to a certified optimum for a minute: in a viewer, or on a page where there is no display"
	@echo "make live LITERAL=1  the same with tuples as the paper writes them, disturbances and all"
	@echo "make paper       every experiment and figure of the paper, and docs/paper.md (a few minutes)"
	@echo "make test        lint, types, import rules, tests: the first stage, about three minutes on two processors"
	@echo "make test-changed  the tests that the changes since main can affect, what takes long too (SINCE=REVISION)"
	@echo "make test-slow   the second stage: what takes long, and larger instances of what the first one tests"
	@echo "make archive     seconds that the checks of archived runs take, and took the version that made them (MEMORY=1: their memory too)"
	@echo "make mutants     300 small errors in what proves and checks (COUNT=20 SEED=1 for fewer): which do the tests notice? (hours)"
	@echo "make test-pythons  the tests of the first stage on every Python from 3.11 to 3.14 that is found"
	@echo "make bench       time the certified solve, and solvers and maximisers beside other people's"
	@echo "make dist        sdist and wheel in dist/, tried in an environment of their own"
	@echo "make docs        write the reference and the schema anew, and build the site (minutes, the first time)"
	@echo "make docs-tables  the tables of docs/maximisers.md anew: every search beside other people's (an hour)"
	@echo "make docs-pictures  the pictures of docs/gallery.md and docs/live.md anew (minutes; needs a Vulkan driver, no display)"
	@echo "make install     set up $(VENV) with everything, whatever is there of it"
	@echo "make clean       remove $(VENV) and every cache"

install: $(INSTALLED)

# Nothing else is installed than what the target needs: `make demo` takes the package and what draws figures, the other targets everything.
$(SLIM): pyproject.toml
	@$(SET_UP)
	@if [ ! $(INSTALLED) -nt pyproject.toml ]; then $(PIP) --editable '.[figures]'; fi
	@touch $@

$(INSTALLED): pyproject.toml
	@$(SET_UP)
	@$(PIP) --editable '.[all]'
	@touch $@

$(PEERS): $(INSTALLED)
	@if $(PIP) --editable '.[all,bench,solvers]'; then touch $@; \
	else echo "not every peer can be installed here; the benchmark names those that it goes without" >&2; fi

$(WRITERS): $(INSTALLED)
	@$(PIP) --editable '.[all,docs]'
	@touch $@

demo: $(SLIM)
	@$(BIN)/sparserob run $(DEMO)
	@echo "figures in $$(ls -dt runs/$(basename $(notdir $(DEMO)))/*/figures | head -n 1)"

# LITERAL=1: tuples of (t, Beta), as the paper writes them, in the place of (t). Ctrl-C (130) is a good end, and no failure of make.
live: $(INSTALLED)
	@if [ -n "$$DISPLAY$$WAYLAND_DISPLAY" ] || [ "$$(uname -s)" = Darwin ]; then serve=; else serve=--serve; fi; \
	$(BIN)/sparserob watch $(if $(LITERAL),$(LITERAL_LIVE),$(LIVE) $(ANNEALING)) $$serve || case $$? in 130) ;; *) exit 1;; esac

paper: $(INSTALLED)
	@$(BIN)/python docs/paper/build.py

lint: style types

style: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(INSTALLED)
	$(BIN)/mypy

# Types are checked beside the tests, so that both processors have work from the first second.
test: style
	@$(MAKE) --no-print-directory --jobs 2 types tests

tests: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal

# SINCE=REVISION (main): what the modules that were changed since can affect, by the imports.
test-changed: $(INSTALLED)
	@chosen=$$($(BIN)/python -m tests.changed $(SINCE)) && \
	if [ -n "$$chosen" ]; then $(BIN)/python -m pytest -m $(ALL_BUT_SLOW) --numprocesses 2 --dist worksteal $$chosen; else echo "nothing was changed"; fi

test-slow: $(INSTALLED)
	$(BIN)/python -m pytest -m slow --numprocesses 2 --dist worksteal -p no:cacheprovider

# Ends with 1 where the checks take more than 1.5 times as long in sum, or one of them more than 4 times.
archive: $(INSTALLED)
	@$(BIN)/python -m tests.archive MEMORY=$(MEMORY)

# COUNT, SEED, FOLDERS=checker,sip/proof, STAGE=folder (not the whole first stage for what survives), JOBS.
mutants: $(INSTALLED)
	$(BIN)/python -m tests.mutants COUNT=$(COUNT) SEED=$(SEED) FOLDERS=$(FOLDERS) STAGE=$(STAGE) JOBS=$(JOBS)

# One environment for each interpreter, set up once; one on which a dependency cannot be installed is named and left out.
# Looked for on the path, among those of pyenv (whose names on the path answer for versions that are switched on only), and by uv.
test-pythons:
	@tried=; status=0; for python in $(PYTHONS); do \
	  version=$${python#python}; found=; \
	  for candidate in $$python $$(ls -r $${PYENV_ROOT:-$$HOME/.pyenv}/versions/$$version.*/bin/python 2>/dev/null) \
	      $$(uv python find --no-python-downloads $$version 2>/dev/null); do \
	    if $$candidate -c 'import venv, ensurepip' 2>/dev/null; then found=$$candidate; break; fi; \
	  done; \
	  if [ -z "$$found" ]; then echo "$$python: not found, left out" >&2; continue; fi; \
	  place=$(VENV)/pythons/$$python; \
	  if [ ! $$place/installed -nt pyproject.toml ]; then \
	    $$found -m venv --clear $$place && $$place/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[all]' \
	      || { echo "$$python: not every dependency can be installed there; left out" >&2; continue; }; \
	    touch $$place/installed; \
	  fi; \
	  echo "$$python: $$($$place/bin/python --version)"; tried="$$tried $$python"; \
	  $$place/bin/python -m pytest -q -m $(ALL_BUT_SLOW) --numprocesses 2 --dist worksteal -p no:cacheprovider || status=$$?; \
	done; \
	if [ -z "$$tried" ]; then echo "none of $(PYTHONS) was found" >&2; exit 1; fi; exit $$status

bench: $(PEERS)
	$(BIN)/python -m pytest -m benchmark tests/benchmarks

# The wheel is built from the unpacked sdist, so that what is missing in this is missing in that.
dist: $(INSTALLED)
	@rm -rf dist
	$(BIN)/python -m hatchling build -d dist -t sdist
	@mkdir dist/unpacked && tar -xzf dist/*.tar.gz -C dist/unpacked --strip-components 1
	cd dist/unpacked && $(CURDIR)/$(BIN)/python -m hatchling build -d .. -t wheel
	@rm -rf dist/unpacked
	DIST=dist $(BIN)/python -m pytest -q -m slow -p no:cacheprovider tests/rules/test_distribution.py

# The site, every warning an error; pictures and notebooks are kept in .docs_cache until what they show has changed.
docs: $(WRITERS)
	$(BIN)/python docs/build_reference.py
	$(BIN)/python -m sphinx -b html -W --keep-going -q docs site/html
	@echo "the site is site/html/index.html"

docs-tables: $(PEERS)
	$(BIN)/python docs/build_maximisers.py

docs-pictures: $(INSTALLED)
	$(BIN)/python docs/build_gallery.py
	$(BIN)/python docs/build_pictures.py

clean:
	rm -rf $(VENV) site docs/generated .docs_cache .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .benchmarks
