# Reproduce the paper: `make figures`. Check everything: `make test`. `make` alone lists the rest.

PYTHON  = python3
PROFILE = paper
ONLY    =
DASK    =
LAB     =
TRIES   =
RESOLUTION = highest

UV      = .uv/bin/uv
BIN     = .venv/bin

# Three environments, each with all that the one before has: run, dev (and the cluster), bench.
# The largest that there is is kept.
STAMPS      := $(foreach kind,bench dev run,$(wildcard .venv/$(kind).stamp))
ENVIRONMENT := $(firstword $(STAMPS) .venv/run.stamp)
DEVELOPMENT := $(firstword $(filter-out .venv/run.stamp,$(STAMPS)) .venv/dev.stamp)

# Only this environment's Python and kernel are used, whatever the user's shell has active.
export JUPYTER_PREFER_ENV_PATH = 1
export UV_PYTHON_DOWNLOADS = never
unexport PYTHONPATH PYTHONHOME VIRTUAL_ENV
# Without bytecode each kernel would take seconds longer to import what it needs.
unexport PYTHONDONTWRITEBYTECODE

.NOTPARALLEL:
.PHONY: help setup figures lab explore test test-library test-browser attack report bench format lock upgrade audit clean distclean

help:  ## list the targets and variables
	@echo 'Targets:'
	@sed -n 's/^\([a-z-]*\):.*## /  \1	/p' Makefile | expand -t 16
	@echo 'Variables:'
	@echo '  PROFILE     paper (default) or quick: the scale of the Monte Carlo and of the sweeps'
	@echo '  ONLY        notebooks to run, for example ONLY=03 or ONLY=02,sweep (default: all);'
	@echo '              of make attack: a part of the names of scripts, for example ONLY=kill'
	@echo '  DASK        a Dask scheduler to compute on, for example DASK=tls://10.0.0.1:8786'
	@echo '  TRIES       how often make attack makes each attack (default: as each script says)'
	@echo '  PYTHON      the Python, 3.11 or newer, to make .venv with (default: python3)'
	@echo '  RESOLUTION  what test-library installs: highest (default) or lowest-direct'
	@echo '  LAB         more options of lab and explore, for example LAB=--no-browser'

setup: $(ENVIRONMENT)  ## make .venv from the lock, hash-checked (the other targets do it as needed)

figures: $(if $(DASK),$(DEVELOPMENT),$(ENVIRONMENT))  ## run the notebooks that are not fresh; write figures/ and data/
	@$(BIN)/robsmooth figures --profile '$(PROFILE)' $(if $(ONLY),--only '$(ONLY)') $(if $(DASK),--dask '$(DASK)')

# Its layout is kept here: in the user's home another project's tabs would be opened. Jupyter refuses
# root, the only user of many a container, unless told. All else of its security is as it comes:
# loopback only, and a new token each time.
lab: $(ENVIRONMENT)  ## open the notebooks in JupyterLab (beside others that run: it takes a free port)
	@JUPYTERLAB_WORKSPACES_DIR='$(CURDIR)/build/lab' $(BIN)/jupyter lab \
	  $(if $(filter 0,$(shell id -u)),--allow-root) $(LAB) notebooks

# A kernel (265 MB) has run the page before anybody comes, so it opens at once. It ends five minutes
# after its page was left; while a page is open, however long, its kernel stays.
explore: $(ENVIRONMENT)  ## open the sliders and the page for your own system in a browser tab
	@$(BIN)/voila --token --preheat_kernel=True --pool_size=1 \
	  --MappingKernelManager.cull_idle_timeout=300 --MappingKernelManager.cull_interval=30 \
	  $(LAB) notebooks/pages/explore.ipynb

# A file's tests run in one process, in the order of tests/conftest.py: the longest files first.
PARALLEL = -n 2 --dist loadfile --no-loadscope-reorder

test: $(DEVELOPMENT)  ## lint, format check, and all tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest $(PARALLEL)

# The rooms that need no extra but these three, in an environment of their own, without the lock.
LIBRARY        = $(addprefix tests/,support numerics systems estimators analysis simulation io homodyne)
LIBRARY_PYTHON = build/library/bin/python

test-library: .uv/stamp  ## the library's tests, without the lock: see RESOLUTION and PYTHON
	@$(UV) venv --quiet --clear --python '$(PYTHON)' build/library
	@$(UV) pip install --quiet --python $(LIBRARY_PYTHON) --resolution '$(RESOLUTION)' \
	  --editable '.[control,cluster,records]' --group test
	@$(UV) pip list --python $(LIBRARY_PYTHON)
	$(LIBRARY_PYTHON) -m pytest $(PARALLEL) $(LIBRARY)

test-browser: $(DEVELOPMENT)  ## the notebooks and the report in chromium, which apt installs if need be
	@$(BIN)/python -m tests.interface.browser.chromium
	$(BIN)/python -m pytest tests/interface/browser

attack: $(DEVELOPMENT)  ## kills, damaged files and the like, at random, for up to hours: see TRIES and ONLY
	@$(BIN)/python -m tests.attacks $(if $(TRIES),--tries '$(TRIES)') $(if $(ONLY),--only '$(ONLY)')

report: $(DEVELOPMENT)  ## all of it to read, as one offline site in build/PROFILE/site
	@$(BIN)/robsmooth figures --profile '$(PROFILE)'
	@$(BIN)/python -m docs --profile '$(PROFILE)'

bench: .venv/bench.stamp  ## measure the speed against NumPy, JAX, C++ and others (five minutes)
	@$(BIN)/robsmooth bench --write

format: $(DEVELOPMENT)  ## format code and notebooks; take out notebook outputs
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .
	$(BIN)/nbstripout --keep-id --extra-keys metadata.papermill $(wildcard notebooks/*.ipynb notebooks/pages/*.ipynb)

clean:  ## remove build/ and caches; figures/ and data/ stay
	rm -rf build .pytest_cache .ruff_cache .hypothesis
	find . -path './.?*' -prune -o -name __pycache__ -prune -exec rm -rf {} +

distclean: clean  ## clean, and remove .venv and .uv
	rm -rf .venv .uv

# --- the environment -----------------------------------------------------------------------------

# $(call install,LOCK): make .venv exactly LOCK, and put this project into it.
# uv does it in seconds; pip, for machines that uv has no wheel for, in minutes.
define install
	@rm -f .venv/*.stamp
	@set -e; if [ -x $(UV) ]; then \
	  [ -x $(BIN)/python ] || $(UV) venv --quiet --clear --python '$(PYTHON)' .venv; \
	  $(UV) pip sync --quiet --python $(BIN)/python --require-hashes $(1); \
	  $(UV) pip install --quiet --python $(BIN)/python $(PROJECT); \
	else \
	  $(PYTHON) -m venv --clear .venv \
	    && $(BIN)/python -m pip install --quiet --require-hashes --requirement $(1) \
	    && $(BIN)/python -m pip install --quiet $(PROJECT) \
	    || { rm -rf .uv; echo '$(NO_ENVIRONMENT)' >&2; exit 1; }; \
	fi
endef

PROJECT        = --no-deps --no-build-isolation --editable .
PIP_UV         = pip install --quiet --require-hashes --only-binary :all: --requirement requirements-uv.lock
NO_PYTHON      = robsmooth needs Python 3.11 or newer; say which with make PYTHON=... (given: $(PYTHON))
NO_ENVIRONMENT = The environment could not be made; as root, apt-get install python3-venv, and run make again.

.venv/run.stamp: requirements.lock pyproject.toml .uv/stamp
	$(call install,requirements.lock)
	@touch $@

.venv/dev.stamp: requirements-dev.lock requirements.lock pyproject.toml .uv/stamp
	$(call install,requirements-dev.lock)
	@touch $@

.venv/bench.stamp: requirements-bench.lock requirements-dev.lock requirements.lock pyproject.toml .uv/stamp
	$(call install,requirements-bench.lock)
	@touch $@

.uv/stamp: requirements-uv.lock
	@rm -rf .uv
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo '$(NO_PYTHON)' >&2; exit 1; }
	@$(PYTHON) -m $(PIP_UV) --target .uv 2>/dev/null \
	  || { $(PYTHON) -m venv --clear .uv >/dev/null && .uv/bin/python -m $(PIP_UV); } \
	  || echo 'uv cannot be installed here; pip takes its place, which is slower.' >&2
	@mkdir -p .uv && touch $@

# --- the locks -----------------------------------------------------------------------------------

COMPILE = $(UV) pip compile --quiet --universal --fork-strategy fewest --python-version 3.11 \
          --generate-hashes --custom-compile-command 'make lock' $(LOCK_OPTIONS)

lock: .uv/stamp  ## write the locks anew after pyproject.toml changed; versions that fit stay
	$(COMPILE) pyproject.toml --extra notebooks --group build --output-file requirements.lock
	$(COMPILE) pyproject.toml --extra all --group build --group dev \
	  --constraint requirements.lock --output-file requirements-dev.lock
	$(COMPILE) pyproject.toml --extra all --group build --group dev --group bench \
	  --constraint requirements-dev.lock --output-file requirements-bench.lock
	echo uv | $(COMPILE) --no-annotate - --output-file requirements-uv.lock
	echo pip-audit | $(COMPILE) --no-annotate - --output-file requirements-audit.lock

# In an environment of its own: what it needs is no part of the project's.
audit:  ## look up the locked versions among the known vulnerabilities
	@$(PYTHON) -m venv --clear build/audit
	@build/audit/bin/python -m pip install --quiet --require-hashes --requirement requirements-audit.lock
	@failed=0; for lock in requirements*.lock; do \
	  echo "$$lock"; build/audit/bin/pip-audit --strict --disable-pip --require-hashes \
	    --progress-spinner off --requirement "$$lock" || failed=1; \
	done; exit $$failed

upgrade: LOCK_OPTIONS = --upgrade
upgrade: lock  ## write the locks anew with the newest versions
