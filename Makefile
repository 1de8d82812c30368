# The front door. `make help` lists the targets; every target installs what it needs first.

SHELL := /bin/bash
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PYTHON ?= python3
SCALE ?= smoke
LAUNCHER ?= local
RUNS_DIR ?= runs
#= SCALE=smoke|laptop|paper  how much is trained: minutes (default), hours to days, a cluster
#= PROTOCOL=paper|modern      how it is trained: as printed (default), or as strong as today
#= LAUNCHER=local|slurm      where: on this machine (default), or as jobs of a Slurm cluster
#= PROFILE=FILE              slurm: what jobs ask for, a copy of experiments/conf/slurm/default.yaml
#= WORKERS=N                 local: runs trained at once (default: one per core)
#= YES=1                     agree to training what takes 2 core-hours or more
#= FRESH=1                   ignore committed results
#= RUNS_DIR=FOLDER           where runs are kept (default: runs)
BIN := .venv/bin
PY = $(BIN)/python -m
q = '$(subst ','\'',$(1))'# one word to the shell, whatever it holds
given = $(call q,$(value $(1)))# a variable as it was typed: make reads no $ in it

EDITION = --scale $(call given,SCALE) $(if $(value PROTOCOL),--protocol $(call given,PROTOCOL))
PLAN_FLAGS = $(EDITION) --runs-dir $(call given,RUNS_DIR) $(if $(FRESH),--fresh)
SWEEP_FLAGS = $(PLAN_FLAGS) --launcher $(call given,LAUNCHER) $(if $(YES),--yes) $(if $(filter slurm,$(LAUNCHER)),--wait)
SWEEP_FLAGS += $(if $(value PROFILE),--profile $(call given,PROFILE)) $(if $(value WORKERS),--workers $(call given,WORKERS))
DRAW_FLAGS = $(EDITION) --runs-dir $(call given,RUNS_DIR)

FIGURES := $(filter fig%,$(basename $(notdir $(wildcard paper_figures/fig*.py))))
TABLES := $(filter table%,$(basename $(notdir $(wildcard paper_figures/table*.py))))

install: .venv/installed  ## make .venv with the locked versions (nothing to do when nothing changed)

.venv/installed: requirements.lock pyproject.toml
	@$(call given,PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python >= 3.11 is needed; set PYTHON=..." >&2; exit 2; }
	$(call given,PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --requirement requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

planned = $(wildcard experiments/conf/figure/$(1).yaml)# of those that train something
BAD_INPUT := 2

draw = $(if $(call planned,$(1)),$(PY) experiments.sweep write $(1) $(PLAN_FLAGS) &&) $(PY) paper_figures.draw $(call q,$(1)) $(DRAW_FLAGS)

$(FIGURES) $(TABLES): install
	@$(if $(call planned,$@),$(PY) experiments.sweep run $@ $(SWEEP_FLAGS) || { code=$$?; \
		[ $$code = $(BAD_INPUT) ] || { $(call draw,$@); }; exit $$code; })
	@$(PY) paper_figures.draw $@ $(DRAW_FLAGS)

all: install  ## every figure and table at SCALE
	@$(MAKE) --no-print-directory --keep-going $(FIGURES) $(TABLES)

draw-%: install
	@$(call draw,$*)

draw-all: plans  ## draw everything that is there at SCALE; train nothing
	@$(PY) paper_figures.draw all $(DRAW_FLAGS)

plans: install
	@$(PY) experiments.sweep write all $(PLAN_FLAGS)

report: draw-all claims  ## one page with everything that is there at SCALE; trains nothing
	@$(PY) analysis.report $(DRAW_FLAGS)

skills-gallery: install  ## measure and draw the given skills, and a short video of each where OpenGL works
	@$(PY) experiments.artefacts.gallery paper_figures/data/skills/*.pt
	@$(PY) paper_figures.gallery
	@$(PY) experiments.artefacts.gallery paper_figures/data/skills/*.pt --videos paper_figures/out/gallery || [ $$? -eq 1 ]  # no OpenGL

claims: plans  ## the paper's comparative sentences and what the results at SCALE say about them
	@$(PY) analysis.claims $(DRAW_FLAGS)

results: install  ## docs/results.md and its pictures, from the committed results
	@for protocol in paper modern; do for scale in laptop paper; do \
		edition="--scale $$scale --protocol $$protocol --runs-dir build/results"; \
		$(PY) experiments.sweep write all $$edition || exit; \
		[ $$protocol = paper ] && folder=$$scale || folder=$$protocol/$$scale; \
		for csv in $$(ls paper_figures/data/$$folder/fig?.csv 2> /dev/null); do \
			figure=$$(basename $$csv .csv); \
			$(PY) paper_figures.$$figure $$edition --out build/results/out > /dev/null && \
			{ [ $$protocol = paper ] || $(PY) paper_figures.aggregate $$figure $$edition --out build/results/out > /dev/null; } && \
			for png in build/results/out/$$folder/$$figure{,.aggregate}.png; do \
				[ ! -e $$png ] || cp $$png docs/pictures/$${folder/\//_}_$$(basename $$png) || exit; \
			done || exit; \
		done; \
	done; done
	@$(PY) analysis.results --runs-dir build/results

plan-%: install
	@$(PY) experiments.sweep plan $(call q,$*) $(SWEEP_FLAGS)

lint: install  ## ruff (format and rules) and mypy
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

FAST_TESTS = -m "not slow and not slurm and not browser" --numprocesses logical --maxprocesses 4 --dist loadfile

# Of those in folders of their own; tests/slurm and tests/report have targets below.
TEST_GROUPS := $(filter-out slurm report,$(patsubst tests/%/__init__.py,%,$(wildcard tests/*/__init__.py)))
not_a_group = $(filter-out $(TEST_GROUPS),$(value ONLY))

test: install  ## every test but the slow ones; ONLY=envs or ONLY="hippo baselines" runs groups of tests/
	$(if $(not_a_group),$(error ONLY=$(not_a_group) is no group of tests; choose from: $(TEST_GROUPS)))
	$(PY) pytest $(FAST_TESTS) $(ONLY:%=tests/%)

coverage: install  ## the lines of each package, in per cent, that `make test` runs, in processes of their own too
	$(PY) pytest $(FAST_TESTS) --cov --cov-report=term
	@for package in hippo baselines experiments analysis paper_figures; do \
		echo "$$package: $$($(PY) coverage report --include "$$package/*" --format=total) %"; done

test-slow: install  ## the tests that take minutes
	$(PY) pytest -m slow -rP --numprocesses logical --maxprocesses 4 --dist load

test-slurm: install  ## the launcher on a real one-node Slurm, installed by apt (as root) where it is missing
	@$(PY) tests.slurm.cluster install || echo "no Slurm here and none to be installed: its tests are skipped" >&2
	$(PY) pytest -m slurm tests/slurm

test-report: install  ## the report in a real browser, Debian's Chromium, installed by apt (as root) where it is missing
	@$(PY) tests.report.browser install || echo "no Chromium here and none to be installed: its tests are skipped" >&2
	$(PY) pytest -m browser tests/report

smoke: fig3  ## train and draw Figure 3 at smoke scale

bench: install  ## speeds as ratios within one run, 25 minutes; QUICK=1, ONLY="peers memory" or "learning", WRITE=1 (docs/performance.md)
	@$(PY) experiments.bench $(if $(QUICK),--quick) $(if $(ONLY),--only $(foreach part,$(ONLY),$(call q,$(part)))) $(if $(WRITE),--write)

profile: install  ## a flame graph of one HiPPO iteration on Ant Gather, docs/pictures/profile_ant_gather.svg
	@$(PY) experiments.bench.flame

install-render:  ## what off-screen drawing needs, by apt (as root)
	apt-get update -qq && apt-get install -y -qq --no-install-recommends libegl1 libgl1-mesa-dri

video: install  ## a video of a trained policy: make video RUN=runs/<run_id>
	@[ -n $(call given,RUN) ] || { echo "error: RUN=: name a run folder, as in make video RUN=runs/<run_id>" >&2; exit 2; }
	@$(PY) experiments.video $(call given,RUN)

clean:  ## remove what was installed and trained here (asks nothing)
	rm -rf .venv runs paper_figures/out build *.egg-info

help:  ## this list
	@awk -F ':.*## ' '/^[a-z%-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  make figN           train what is missing, asking from 2 core-hours on, and draw: $(FIGURES)"
	@echo "  make tableN         the same for: $(TABLES)"
	@echo "  make draw-figN      draw what is there, committed or trained here, and name what is missing; train nothing"
	@echo "  make plan-figN      what it would train and cost, without training"
	@echo "variables, as in make fig3 SCALE=laptop:"
	@sed -n 's/^#= /  /p' $(MAKEFILE_LIST)

.PHONY: install install-render all draw-all plans report skills-gallery claims results lint test coverage test-slow test-slurm test-report smoke bench profile video clean help $(FIGURES) $(TABLES)
