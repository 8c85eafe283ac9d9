# Every target makes the virtual environment it needs and says what it does. `make help` lists them.
PYTHON ?=
VENV ?= .venv
PIP_ARGS ?=
WORKERS ?= auto

PY := $(VENV)/bin/python
# Files are dealt out to a process a core; what a file's tests share is made once.
PYTEST := $(PY) -m pytest -q -n $(WORKERS) --maxprocesses 8 --dist loadfile --durations 8
READY := $(VENV)/.ready
SHELL := /bin/sh
# Python keeps what it compiles: the tests start many processes, which would each compile everything again.
unexport PYTHONDONTWRITEBYTECODE
.DEFAULT_GOAL := help
.PHONY: help setup demo train-duet test test-slow test-browser test-blender test-all check lint type format docs wheel clean distclean

help:  ## list what make can do
	@echo "magnet: diffusion forcing for the motion of several people"
	@echo
	@sed -nE 's/^([a-z-]+):[^#]*## (.*)/  make \1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{ printf "%-18s %s\n", $$1, $$2 }'
	@echo
	@echo "  PYTHON=python3.12 picks the interpreter, VENV=DIR the environment, PIP_ARGS='...' is handed to pip,"
	@echo "  WORKERS=1 runs the tests in one process."

# The first Python of a version that works; a message that says what to do when there is none.
$(PY):
	@chosen=; for candidate in $(or $(PYTHON),python3 python3.13 python3.12 python3.11); do \
	  if $$candidate -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; \
	  then chosen=$$candidate; break; fi; done; \
	if [ -z "$$chosen" ]; then \
	  echo "magnet needs Python 3.11, 3.12 or 3.13; $(or $(PYTHON),python3) is $$($(or $(PYTHON),python3) --version 2>&1)." >&2; \
	  echo "Install one and name it: make setup PYTHON=python3.12" >&2; exit 1; fi; \
	echo "setup: a virtual environment in $(VENV) with $$($$chosen --version)"; \
	$$chosen -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "setup: no virtual environment; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }

$(READY): pyproject.toml constraints.txt | $(PY)
	@echo "setup: installing magnet and the pinned packages, a few minutes the first time (PIP_ARGS=-vvv shows how)"
	@$(PY) -m pip install -qq --disable-pip-version-check $(PIP_ARGS) -c constraints.txt -e '.[dev]'
	@$(PY) -c 'import torch; print("setup: done, torch", torch.__version__)'
	@$(PY) -m magnet.cli.all_answers  # so that the first --help is quick
	@touch $(READY)

setup: $(READY)  ## make the virtual environment with the pinned packages
	@echo "setup: ready; $(VENV)/bin/magnet --help"

demo: $(READY)  ## run the main job on the embedded default: several people move together
	@echo "demo: magnet demo"
	@$(PY) -m magnet demo

train-duet: $(READY)  ## a model like the shipped one, from recordings (MAGNET_CMU) to weights; again: goes on
	@echo "train-duet: scripts/train_duet.py, into runs/train_duet; DUET='--steps denoiser=100' hands it options"
	@$(PY) scripts/train_duet.py $(DUET)

test: $(READY)  ## run the tests, without the slow ones
	@echo "test: pytest, without the slow tests"
	@$(PYTEST) -m 'not slow'

test-slow: $(READY)  ## run the slow tests only
	@echo "test-slow: pytest, the slow tests"
	@$(PYTEST) -m slow

test-browser: $(READY)  ## the viewer in a real headless Chromium, installed from Debian if absent
	@echo "test-browser: pytest, the viewer in Chromium"
	@command -v chromium >/dev/null || \
	  { apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium fonts-dejavu-core; }
	@$(PY) -m pytest -q -m browser tests/viewer

test-blender: $(READY)  ## our files in Blender, whose bpy gets an environment of its own (Python 3.11)
	@echo "test-blender: pytest, exported files in Blender"
	@test -x .venv-bpy/bin/python || { python3.11 -m venv .venv-bpy && .venv-bpy/bin/pip install -qq 'bpy==4.5.*'; }
	@MAGNET_BLENDER=.venv-bpy/bin/python $(PY) -m pytest -q -s tests/export/test_blender.py tests/export/test_blender_addon.py

test-all: $(READY)  ## run every test
	@echo "test-all: pytest, everything"
	@$(PYTEST)

check: lint type  ## style and types

lint: $(READY)  ## style: ruff
	@echo "lint: ruff"
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .

type: $(READY)  ## types: mypy
	@echo "type: mypy"
	@$(PY) -m mypy

format: $(READY)  ## rewrite the code in the project's style
	@echo "format: ruff"
	@$(PY) -m ruff check --fix .
	@$(PY) -m ruff format .

docs: $(READY)  ## the documentation as a site in site/, served at SITE_URL if that is given; a broken link is an error
	@echo "docs: mkdocs, strict; the tour is run for it, a minute"
	@$(PY) -m pip install -qq --disable-pip-version-check $(PIP_ARGS) -c constraints.txt -e '.[docs]'
	@NO_MKDOCS_2_WARNING=1 SITE_URL='$(SITE_URL)' $(PY) -m mkdocs build -q
	@echo "docs: open site/index.html, or $(PY) -m http.server -d site; for an address like https://host/magnet/," \
	  "make docs SITE_URL=that, or links of 404.html lead to https://host/"

wheel: $(READY)  ## the wheel and the source archive in dist/, with this Python's recorded answers
	@echo "wheel: answers of --help are made for it, half a minute"
	@rm -f magnet/cli/answers-*.json
	@$(PY) -m magnet.cli.all_answers --ship
	@$(PY) -m build --no-isolation; done=$$?; rm -f magnet/cli/answers-*.json; exit $$done

clean:  ## remove caches and builds
	@echo "clean: caches and builds"
	@rm -rf build dist site .mypy_cache .pytest_cache .ruff_cache .hypothesis
	@find magnet tests -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean  ## clean, and the virtual environments
	@echo "distclean: $(VENV) .venv-bpy"
	@rm -rf $(VENV) .venv-bpy
