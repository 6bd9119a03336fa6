# Thin: each target calls cmake, ctest or python.
PYTHON := .venv/bin/python
JOBS := $(shell nproc 2>/dev/null || echo 2)
MAKEFLAGS += --no-print-directory
FUZZ_SECONDS ?= 600
# compiles the plant when its sources have changed, so that no test waits for it
COMPILE_PLANT = $(PYTHON) sil_plant/run.py --bus inproc --duration 0.01 --quiet && \
    $(PYTHON) sil_plant/run.py --bus inproc --scenario sil_plant/scenarios/faults.toml --quiet
# those on a real bus run alone: in the virtual machine time is short
TESTS = $(wildcard tests/fuzz tests/pil tests/rules tests/sil tests/bus)
C_FILES = find firmware tests/unit tests/fuzz tools -name '*.[ch]' -not -path '*/generated/*'

.DEFAULT_GOAL := help
.PHONY: help setup firmware images fmu budget bench demo paper campaign test faults coverage fuzz fuzz-corpus lint format generate clean

help: ## list the targets
	@echo "DIARC ECU: make TARGET"
	@echo
	@awk -F ': ## ' '/^[a-z-]+: ## / { printf "  %-12s %s\n", $$1, $$2 }' Makefile

setup: ## install what the demo and the tests need: Debian packages and .venv
	@tools/setup.sh test

firmware: ## build the Linux ECU, firmware/diarc_ecu, and the libraries for Python (cmake and gcc only)
	@cmake --preset default
	@cmake --build build --parallel $(JOBS)

images: ## the Cortex-M images, build/cortex-m4f/diarc_ecu.elf and build/cortex-m3/diarc_ecu.elf
	@for preset in cortex-m4f cortex-m3; do \
	    cmake --preset $$preset && cmake --build --preset $$preset --parallel $(JOBS) && \
	    arm-none-eabi-size build/$$preset/diarc_ecu.elf || exit 1; done

fmu: ## build/diarc_ecu.fmu and build/diarc_plant.fmu: the ECU and the arm for other simulation tools
	@tools/setup.sh demo
	@cmake -S . -B build -DDIARC_PYTHON=$(abspath $(PYTHON))
	@cmake --build build --target fmu --parallel $(JOBS)
	@$(PYTHON) tools/export_fmu.py plant -o build/diarc_plant.fmu

budget: ## flash, RAM, worst-case stack and instructions a tick of both images, beside their goals
	@tools/setup.sh test
	@$(MAKE) firmware
	@$(PYTHON) tools/budget.py

bench: ## how fast the closed loop is, beside MuJoCo, SciPy and numpy: build/bench.json and build/bench.png
	@tools/setup.sh test
	@$(MAKE) firmware
	@$(PYTHON) tools/bench.py

demo: ## the ECU moves a simulated arm; needs no CAN hardware
	@tools/setup.sh demo
	@$(MAKE) firmware
	@$(PYTHON) tools/demo.py

paper: ## the paper's figures and tables beside ours: out/paper/report.html
	@tools/setup.sh demo
	@$(MAKE) firmware
	@$(PYTHON) tools/paper.py

campaign: ## a thousand arms with production tolerances: out/campaigns/production/report.html
	@tools/setup.sh demo
	@$(MAKE) firmware
	@$(PYTHON) tools/campaign.py sil_plant/campaigns/production.toml --resume

test: ## every test: unit tests in C, then pytest
	@tools/setup.sh test
	@cmake --preset test
	@cmake --build build --parallel $(JOBS)
	@$(COMPILE_PLANT)
	@ctest --test-dir build --output-on-failure --no-tests=error --parallel $(JOBS)
	@$(PYTHON) -m pytest --numprocesses $(JOBS) --dist loadfile --no-loadscope-reorder $(filter-out tests/bus,$(TESTS))
	@$(PYTHON) -m pytest tests/bus

faults: ## break everything on purpose: the fault matrix, build/faults.json
	@tools/setup.sh test
	@$(MAKE) firmware
	@$(PYTHON) tools/faults.py

coverage: ## lines of the law and the ECU that the unit tests run: all of them, or it fails
	@tools/setup.sh test
	@$(PYTHON) tools/coverage.py

fuzz: ## fuzz the ECU, FUZZ_SECONDS (600) for each harness; crashes go to build/fuzz, see docs/fuzzing.md
	@tools/setup.sh test
	@FUZZ_SECONDS=$(FUZZ_SECONDS) $(PYTHON) -m pytest tests/fuzz -k breaks_the_ecu

fuzz-corpus: ## after make fuzz: put what it found into tests/fuzz/corpus, as few inputs as reach the same
	@for corpus in tests/fuzz/corpus/*; do \
	    name=$${corpus##*/} && rm -rf build/fuzz/merged && mkdir build/fuzz/merged && \
	    build/fuzz/tests/fuzz_$${name}_double -merge=1 -use_counters=0 build/fuzz/merged $$corpus build/fuzz/found-$$name && \
	    rm -rf $$corpus && mv build/fuzz/merged $$corpus || exit 1; done

rules: ## MISRA C:2012: write tests/rules/misra_findings.txt and the counts in docs/misra.md
	@tools/setup.sh test
	@$(PYTHON) tools/misra.py --update

lint: ## check the style of Python and C
	@tools/setup.sh demo
	@.venv/bin/ruff check
	@.venv/bin/ruff format --check
	@$(C_FILES) -exec .venv/bin/clang-format --dry-run --Werror {} +

format: ## format Python and C
	@tools/setup.sh demo
	@.venv/bin/ruff check --fix --exit-zero
	@.venv/bin/ruff format
	@$(C_FILES) -exec .venv/bin/clang-format -i {} +

generate: ## make the generated files again: the frames in C from the DBC, and what follows from it
	@tools/setup.sh demo
	@$(PYTHON) tools/generate.py

clean: ## remove what was built; .venv stays
	@rm -rf build firmware/diarc_ecu .pytest_cache .ruff_cache
	@find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +
