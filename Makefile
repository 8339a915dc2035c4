# `make help` lists the targets. Needs GNU make and Python 3.11 or newer, and nothing else.

PYTHON ?= python3
VENV ?= .venv
# Extra arguments for the command behind a target: make test ARGS="-k orbits", make demo ARGS=--help.
ARGS ?=
# Where to take PyTorch from. Linux without a graphics card: a far smaller download with
#   make setup TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH_INDEX ?=

ifeq ($(OS),Windows_NT)
RUN := $(VENV)/Scripts/python
PEERS_RUN := .venv-peers/Scripts/python
else
RUN := $(VENV)/bin/python
PEERS_RUN := .venv-peers/bin/python
endif
QUICK := tests/kernel/test_kernel.py tests/physics/test_orbits.py tests/physics/test_theory.py tests/environments/test_single.py
DEMO_STAMP := $(VENV)/.demo
STAMP := $(VENV)/.installed
# pip's output; make setup QUIET= shows it.
QUIET ?= --quiet
# Goes in first and alone: TORCH_INDEX holds PyTorch, not our versions of what it needs.
TORCH := $(shell sed -n '/^torch==/p' constraints.txt)
TORCH_FROM := $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX))
PIP := -m pip --disable-pip-version-check

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo quick test test-all lint format slow reference benchmark benchmark-peers figures report docs constraints clean hunt

help: ## list the targets
	@echo "Usage: make TARGET [ARGS=...] [PYTHON=python3.12] [TORCH_INDEX=https://download.pytorch.org/whl/cpu]"
	@echo
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1\t\2/p' Makefile | expand -t 20

setup: $(STAMP) ## make .venv and install the project with all that its checks and extras need

$(VENV)/.made:
	@command -v "$(PYTHON)" >/dev/null 2>&1 || { \
	  echo "make: '$(PYTHON)' was not found. Install Python 3.11 or newer, or name yours: make setup PYTHON=python3.12" >&2; \
	  exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "make: '$(PYTHON)' is $$("$(PYTHON)" --version 2>&1), and Python 3.11 or newer is needed." >&2; \
	  echo "      Name a newer one: make setup PYTHON=python3.12" >&2; \
	  exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "make: '$(PYTHON)' cannot make virtual environments: its venv module is missing." >&2; \
	  echo "      On Debian and Ubuntu: sudo apt install python3-venv" >&2; \
	  exit 1; }
	@"$(RUN)" $(PIP) --version >/dev/null 2>&1 || { \
	  echo "Making $(VENV) ..."; "$(PYTHON)" -m venv "$(VENV)"; }
	@"$(RUN)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "make: $(VENV) holds a Python older than 3.11. Remove it (make clean VENV=$(VENV)) and try again." >&2; \
	  exit 1; }
	@touch "$@"

$(DEMO_STAMP): $(VENV)/.made pyproject.toml constraints.txt
	@echo "Installing what the demo needs into $(VENV): a few minutes the first time, most of the download is PyTorch ..."
	@"$(RUN)" $(PIP) install $(QUIET) -c constraints.txt --no-deps $(TORCH_FROM) $(TORCH)
	@"$(RUN)" $(PIP) install $(QUIET) -c constraints.txt -e ".[plot,train]"
	@touch "$@"

$(STAMP): $(DEMO_STAMP)
	@echo "Installing the rest: all extras, and what the checks need ..."
	@"$(RUN)" $(PIP) install $(QUIET) -c constraints.txt -e ".[all,dev]"
	@touch "$@"
	@echo "Ready. 'make demo' shows what it does, 'make test' checks it."

demo: $(DEMO_STAMP) ## draw the amplitude curve, train both agents, compare them with passive and classical (minutes)
	"$(RUN)" scripts/demo.py $(ARGS)

quick: setup ## while working: ruff, and tests of one environment, the kernel and the orbits (under a minute)
	"$(RUN)" -m ruff check .
	"$(RUN)" -m pytest -x -n 2 $(QUICK) $(ARGS)

test-all: setup ## run every check and every test, the slow ones too
	"$(RUN)" scripts/check.py -m "" $(ARGS)

test: setup ## run every check, and the tests but for those that take minutes
	"$(RUN)" scripts/check.py $(ARGS)

lint: setup ## run every check but the tests
	"$(RUN)" scripts/check.py --lint-only

format: setup ## let ruff mend and format the code
	"$(RUN)" -m ruff check --fix .
	"$(RUN)" -m ruff format .

slow: setup ## run the tests that take minutes
	"$(RUN)" -m pytest -m slow -n 2 $(ARGS)

reference: setup ## print each accuracy target next to the measured value
	"$(RUN)" scripts/verify.py $(ARGS)

hunt: setup ## hold random legal plants, tasks, files and command lines against independent answers (five minutes)
	"$(RUN)" scripts/hunt.py $(ARGS)

benchmark: setup ## measure the speed, ours and others', in one run (minutes)
	"$(RUN)" scripts/benchmark $(ARGS)

# Apart from .venv, for what they need and what we need may not go together.
benchmark-peers: ## make .venv-peers with EnvPool and gymnax: `make benchmark` then measures them too
	"$(PYTHON)" -m venv .venv-peers
	"$(PEERS_RUN)" $(PIP) install -r benchmark_peers.txt

figures: setup ## compute and draw the paper's figures again
	"$(RUN)" scripts/figures $(ARGS)

report: setup ## evaluate every controller on every task; write report_output/report.html (a minute)
	"$(RUN)" -m sd_friction_env report $(ARGS)

docs: export NO_MKDOCS_2_WARNING := 1
docs: setup ## build the documentation into site/ (open site/index.html)
	"$(RUN)" -m mkdocs build --strict $(ARGS)

# The newest versions that the ranges in pyproject.toml allow, installed on their own and frozen.
constraints: ## renew constraints.txt from the newest versions (then run make test)
	"$(PYTHON)" -m venv --clear .venv-newest
	.venv-newest/bin/python $(PIP) install $(TORCH_FROM) torch
	.venv-newest/bin/python $(PIP) install -e ".[all,dev]"
	sed -n '/^#/p' constraints.txt > constraints.new
	.venv-newest/bin/python $(PIP) freeze --all --exclude-editable | sed -e '/^pip==/d' -e 's/+.*//' >> constraints.new
	mv constraints.new constraints.txt
	rm -rf .venv-newest

clean: ## remove .venv and its like, caches, builds and the demo's output (trained runs stay)
	rm -rf "$(VENV)" .venv-newest .venv-peers build dist demo_output report_output site *.egg-info .mypy_cache .pytest_cache .ruff_cache
	rm -rf .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
