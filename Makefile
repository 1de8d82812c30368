# The front door. `make help` lists the targets; every target installs what it needs first.
#   SCALE=smoke|laptop|paper   LAUNCHER=local|slurm [PROFILE=file.yaml]   FRESH=1 (ignore committed results)   YES=1 (agree to large plans)

SHELL := /bin/bash
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PYTHON ?= python3
SCALE ?= smoke
LAUNCHER ?= local
RUNS_DIR ?= runs
BIN := .venv/bin
PY = $(BIN)/python -m

SWEEP_FLAGS = --scale $(SCALE) --launcher $(LAUNCHER) --runs-dir $(RUNS_DIR) $(if $(FRESH),--fresh) $(if $(YES),--yes)
SWEEP_FLAGS += $(if $(filter slurm,$(LAUNCHER)),--wait) $(if $(PROFILE),--profile $(PROFILE))
DRAW_FLAGS = --scale $(SCALE) --runs-dir $(RUNS_DIR)

FIGURES := $(filter fig%,$(basename $(notdir $(wildcard paper_figures/fig*.py))))
TABLES := $(filter table%,$(basename $(notdir $(wildcard paper_figures/table*.py))))

install: .venv/installed  ## make .venv with the locked versions (nothing to do when nothing changed)

.venv/installed: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python >= 3.11 is needed; set PYTHON=..." >&2; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --requirement requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

$(FIGURES) $(TABLES): install
	@if [ -f experiments/conf/figure/$@.yaml ]; then $(PY) experiments.sweep run $@ $(SWEEP_FLAGS); fi
	@$(PY) paper_figures.$@ $(DRAW_FLAGS)

all: $(FIGURES) $(TABLES)  ## every figure and table at SCALE

report: install claims  ## one page with everything drawn at SCALE
	@$(PY) analysis.report $(DRAW_FLAGS)

skills-gallery: install  ## measure and draw the given skills, and a short video of each where OpenGL works
	@$(PY) experiments.gallery paper_figures/data/skills/*.pt
	@$(PY) paper_figures.gallery
	@$(PY) experiments.gallery paper_figures/data/skills/*.pt --videos paper_figures/out/gallery || [ $$? -eq 1 ]  # no OpenGL

claims: install  ## the paper's comparative sentences and what the results at SCALE say about them
	@$(PY) analysis.claims $(DRAW_FLAGS)

results: install  ## docs/results.md and its pictures, from the committed results
	@for scale in laptop paper; do $(PY) experiments.sweep plan all --scale $$scale --runs-dir build/results --write > /dev/null; done
	@for csv in paper_figures/data/*/fig*.csv; do \
		scale=$$(basename $$(dirname $$csv)); figure=$$(basename $$csv .csv); \
		$(PY) paper_figures.$$figure --scale $$scale --runs-dir build/results --out build/results/out > /dev/null && \
		cp build/results/out/$$scale/$$figure.png docs/pictures/$${scale}_$$figure.png; \
	done
	@$(PY) analysis.results --runs-dir build/results

plan-%: install
	@$(PY) experiments.sweep plan $* $(SWEEP_FLAGS)

lint: install  ## ruff (format and rules) and mypy
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

test: install  ## every test but the slow ones
	$(PY) pytest -m "not slow and not slurm and not browser" --numprocesses logical --maxprocesses 4 --dist loadfile

test-slow: install  ## the tests that take minutes
	$(PY) pytest -m slow -s

test-slurm: install  ## the launcher on a real one-node Slurm, installed by apt (as root) where it is missing
	@$(PY) tests.slurm.cluster install || echo "no Slurm here and none to be installed: its tests are skipped" >&2
	$(PY) pytest -m slurm tests/slurm

test-report: install  ## the report in a real browser, Debian's Chromium, installed by apt (as root) where it is missing
	@$(PY) tests.report.browser install || echo "no Chromium here and none to be installed: its tests are skipped" >&2
	$(PY) pytest -m browser tests/report

smoke: fig3  ## train and draw Figure 3 at smoke scale

bench: install  ## speeds as ratios within one run, 25 minutes; QUICK=1, ONLY="peers memory", WRITE=1 (docs/performance.md)
	@$(PY) experiments.bench $(if $(QUICK),--quick) $(if $(ONLY),--only $(ONLY)) $(if $(WRITE),--write)

profile: install  ## a flame graph of one HiPPO iteration on Ant Gather, docs/pictures/profile_ant_gather.svg
	@$(PY) experiments.bench_flame

install-render:  ## what off-screen drawing needs, by apt (as root)
	apt-get update -qq && apt-get install -y -qq --no-install-recommends libegl1 libgl1-mesa-dri

video: install  ## a video of a trained policy: make video RUN=runs/<run_id>
	@[ -n "$(RUN)" ] || { echo "error: RUN=: name a run folder, as in make video RUN=runs/<run_id>" >&2; exit 2; }
	@$(PY) experiments.video $(RUN)

clean:  ## remove what was installed and trained here (asks nothing)
	rm -rf .venv runs paper_figures/out build *.egg-info

help:  ## this list
	@awk -F ':.*## ' '/^[a-z%-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  make figN        train what is missing and draw: $(FIGURES)"
	@echo "  make tableN      the same for: $(or $(TABLES),none yet)"
	@echo "  make plan-figN   what it would train and cost, without training"

.PHONY: install install-render all report skills-gallery claims results lint test test-slow test-slurm test-report smoke bench profile video clean help $(FIGURES) $(TABLES)
