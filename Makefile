# Everything runs in .venv, made from Python 3.11 or newer. No C compiler is needed: one comes with the Python package
# ziglang.

PYTHON ?= python3
BIN := .venv/bin
PBCGEN := $(BIN)/pbcgen

SYSTEMS := coupling_device rlc pera pera_integral elastic_pendulum
REFERENCE := coupling_device rlc pera

.DEFAULT_GOAL := help
.PHONY: help env demo test unit lint format generated figures docs firmware eva fuzz bench clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

env: .venv/installed ## install pbcgen and its tools into .venv

# The stamp is younger than pyproject.toml when all that it asks for is installed.
.venv/installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo 'pbcgen needs Python 3.11 or newer: make env PYTHON=python3.11'; exit 1; }
	@echo 'Installing pbcgen and its tools into .venv ...'
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

demo: $(SYSTEMS:%=demo-%) ## check, generate, validate, draw and report five systems
	@printf '\n%s\n' 'Proved, generated, compiled and validated:'
	@for system in $(SYSTEMS); do printf '  %-17s C in demo/%s/, picture demo/%s.png, report demo/%s.html\n' $$system $$system $$system $$system; done

demo-%: env
	@printf '\n======== %s ========\n\n' $*
	@mkdir -p demo
	@$(PBCGEN) check $*
	@echo
	@$(PBCGEN) generate $* -o demo/$*
	@echo
	@$(PBCGEN) validate $*
	@echo
	@$(PBCGEN) simulate $* --plot demo/$*.png
	@echo
	@$(PBCGEN) report $* -o demo/$*.html

test: lint ## lint, types and tests
	$(BIN)/python -m pytest -n 2 --dist loadgroup

unit: env ## the tests without those of whole systems: no compiler runs, emulation, browser, site or installation
	$(BIN)/python -m pytest -n 2 --dist loadgroup -m "not system"

lint: env ## style and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

format: env ## rewrite the sources in the project's style
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

generated: $(REFERENCE:%=generated-%) ## write the reference packages in generated/ again

generated-%: env
	@$(PBCGEN) generate $* -o generated/$*

figures: env ## draw the figures of docs/paper.md again, from the generated C
	@$(BIN)/python -m pbcgen.report.paper_figures docs/images/paper

docs: env ## build the documentation in build/site; a warning is an error
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo build/site/index.html

firmware: env ## run the C as a bare-metal image under QEMU (apt: gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm)
	$(BIN)/python -m pytest tests/firmware -s -rs

eva: env ## prove the absence of undefined behaviour in the C with Frama-C (apt: frama-c-base)
	$(BIN)/python -m pytest tests/emit/test_eva.py -s -rs

fuzz: env ## fuzz the step for 10 minutes (apt: clang); FUZZ_SECONDS=n for another time
	FUZZ_SECONDS=$${FUZZ_SECONDS:-600} $(BIN)/python -m pytest tests/emit/test_fuzz.py -s -rs

bench: env ## measure a step against other generators and a predictive controller, into benchmarks/results/
	$(BIN)/python -m benchmarks.tool
	$(BIN)/python -m benchmarks.step

clean: ## remove everything that make wrote, .venv too
	rm -rf .venv demo build dist .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
