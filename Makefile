# Each target sets itself up: a virtual environment with the tested pins, then the work.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: demo check check-code test lint lint-types lint-rest docs charts stress bench changelog format wheel sbom clean

demo: $(INSTALLED)
	$(BIN)/hoigs demo --out runs/demo --overwrite

# one worker a core; a file stays with one worker, whose fixtures its tests share
test: $(INSTALLED)
	$(BIN)/python -m pytest -n auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder \
		--max-worker-restart 3

# the fast lane, under 90 s on 2 cores: types in one process; style, import rules and quick tests in
# another. FAST takes about a minute of one core; `make test` runs every test
FAST ?= tests/core/values tests/core/model tests/core/registry tests/core/spec tests/metrics
check: $(INSTALLED)
	@$(MAKE) --no-print-directory --jobs 2 --output-sync lint-types check-code

check-code: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -p no:xdist -m "not slow" $(FAST)

# types in one process, all else in another
lint: $(INSTALLED)
	@$(MAKE) --no-print-directory --jobs 2 --output-sync lint-types lint-rest

lint-types: $(INSTALLED)
	$(BIN)/mypy

lint-rest: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/python scripts/check_types_for_users.py
	$(BIN)/python scripts/licences.py > /dev/null

# the site, into build/site; strict: a dead link or a page without a link to it is an error
docs: $(INSTALLED)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# accuracy against cost, into docs/results/chart; the same command continues after a kill
CHART_CLIPS ?= builtin:lift-and-swing builtin:carry builtin:throw-and-catch
CHART_SPECS ?= hoigs,hoigs-paper@matched,hoigs-no-interaction,hoigs-object-mlp,4dgs@matched,d3dgs@matched,e-d3dgs@matched,ex4dgs@matched,exavatar@matched,hugs@matched,hold-gs@matched,hosnerf-gs@matched,static-3dgs@matched
CHART_BUDGETS ?= 1200
CHART_SEEDS ?= 3
CHART_OUT ?= runs/results-chart
charts: $(INSTALLED)
	$(BIN)/hoigs study compare $(CHART_CLIPS) --specs "$(CHART_SPECS)" --budgets $(CHART_BUDGETS) \
		--seeds $(CHART_SEEDS) --out $(CHART_OUT)
	mkdir -p docs/results/chart
	cp $(addprefix $(CHART_OUT)/,chart.md chart.json chart-*.png) docs/results/chart/

# where methods break, into docs/results/stress; the same command continues after a kill
STRESS_CASES ?= all
STRESS_SPECS ?= hoigs,4dgs@matched,d3dgs@matched,e-d3dgs@matched,ex4dgs@matched,exavatar@matched,static-3dgs@matched
STRESS_SEEDS ?= 3
STRESS_STEPS ?= 300
STRESS_JOBS ?= 1
STRESS_OUT ?= runs/results-stress
stress: $(INSTALLED)
	$(BIN)/hoigs study stress --cases "$(STRESS_CASES)" --specs "$(STRESS_SPECS)" \
		--seeds $(STRESS_SEEDS) --steps $(STRESS_STEPS) --jobs $(STRESS_JOBS) --threads 1 \
		--out $(STRESS_OUT)
	mkdir -p docs/results/stress
	cp $(addprefix $(STRESS_OUT)/,stress.md stress.json stress-matrix.png stress-curves.png) \
		docs/results/stress/

# times of this tree against the last release's, or another commit's, in turns on this CPU
BENCH_COMMIT ?= $(shell git describe --tags --abbrev=0 2>/dev/null || echo main)
bench: $(INSTALLED)
	$(BIN)/python benchmarks/against_commit.py --commit $(BENCH_COMMIT)

# fragments of changelog.d, collected into CHANGELOG.md
changelog: $(INSTALLED)
	$(BIN)/python scripts/changelog.py

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# the wheel, built twice: both have the same bytes
wheel: $(INSTALLED)
	rm -rf build/again
	$(BIN)/python -m hatchling build -t wheel -d dist
	$(BIN)/python -m hatchling build -t wheel -d build/again
	for wheel in build/again/*.whl; do cmp $$wheel dist/$$(basename $$wheel); done

# what the pins hold, as CycloneDX
sbom:
	$(PYTHON) -m venv build/sbom
	build/sbom/bin/pip install --quiet --disable-pip-version-check 'cyclonedx-bom>=7,<8'
	mkdir -p dist
	build/sbom/bin/cyclonedx-py requirements constraints.txt --pyproject pyproject.toml \
		--output-reproducible --of JSON -o dist/hoigs-sbom.json

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,docs]'
	touch $@

clean:
	rm -rf $(VENV) build dist
