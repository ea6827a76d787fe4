# make demo | test | test-all | check | package | extras | sbom | bench | bench-gpu | bench-flights | bench-latency: each
# sets itself up in .venv and is quick the second time.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2
# A worker takes whole files, so that what a file draws is drawn once, and one thread.
# Bytecode is kept: tests start some fifty interpreters.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: demo test test-slow test-all check package extras sbom docs bench bench-gpu integrity simulated bench-flights bench-latency clean

# The stamps follow pyproject.toml: a changed dependency is installed at the next make, and nothing otherwise.
$(VENV)/run.stamp: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --editable '.[desk]'
	touch $@

$(VENV)/dev.stamp: $(VENV)/run.stamp
	$(PIP) install --quiet --editable '.[dev]'
	touch $@

$(VENV)/bench.stamp: $(VENV)/dev.stamp
	$(PIP) install --quiet --editable '.[bench]'
	touch $@

demo: $(VENV)/run.stamp
	$(BIN)/scenematch demo --force

test: $(VENV)/dev.stamp
	$(PYTEST) -m "not slow"

test-slow: $(VENV)/dev.stamp
	$(PYTEST) -m slow

test-all: $(VENV)/dev.stamp
	$(PYTEST)

check: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The wheel as a stranger gets it: built, installed beside nothing else, and flown from another folder, first as on a
# vehicle and then as on a desk.
package: $(VENV)/dev.stamp
	rm -rf dist build/clean build/flown
	$(BIN)/python -m build --outdir dist .
	$(PYTHON) -m venv build/clean
	build/clean/bin/pip --disable-pip-version-check install --quiet dist/*.whl
	cd build && clean/bin/scenematch doctor && clean/bin/scenematch simulate --frames 4 --out flown
	cd build/flown && ../clean/bin/scenematch track --map map.tif --surface dsm.tif --camera camera.yaml \
		--frames frames --telemetry telemetry.csv --out track
	build/clean/bin/pip --disable-pip-version-check install --quiet "$$(echo dist/*.whl)[desk]"
	cd build && clean/bin/scenematch demo --frames 4 --out flown/demo

extras: package
	.ci/extras

# What is installed beside the wheel of `make package`, or in SBOM_OF's environment, as CycloneDX.
SBOM_OF ?= build/clean/bin/python
sbom:
	test -x $(SBOM_OF) || { echo "expected $(SBOM_OF): run make package first"; exit 1; }
	$(PYTHON) -m venv build/sbom
	build/sbom/bin/pip --disable-pip-version-check install --quiet 'cyclonedx-bom>=7,<8'
	mkdir -p dist
	build/sbom/bin/cyclonedx-py environment --pyproject pyproject.toml --mc-type library --output-reproducible \
		--output-file dist/sbom.cdx.json $(SBOM_OF)

docs: $(VENV)/dev.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

bench: $(VENV)/bench.stamp
	mkdir -p .benchmarks
	$(BIN)/python -m pytest bench/speed --benchmark-only --benchmark-json=.benchmarks/run.json --benchmark-save-data
	$(BIN)/python -m bench.pages.report .benchmarks/run.json

# One table of a GPU beside the CPU; without CUDA it says so and ends well.
bench-gpu: $(VENV)/dev.stamp
	$(BIN)/python -m bench.gpu

integrity: $(VENV)/dev.stamp
	$(BIN)/python -m bench.accuracy.integrity
	$(BIN)/python -m bench.accuracy.nees

simulated: $(VENV)/dev.stamp
	$(BIN)/python -m bench.accuracy.simulated

bench-flights: $(VENV)/dev.stamp
	$(BIN)/python -m bench.accuracy.flights

bench-latency: $(VENV)/dev.stamp
	$(BIN)/python -m bench.live.latency

clean:
	rm -rf $(VENV) demo-report build dist *.egg-info
