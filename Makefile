# Set-up and use need Python 3.11 or newer and make; everything else goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check
# What the program needs; and what its tests need besides.
READY := $(VENV)/ready
TOOLS := $(VENV)/tools

.PHONY: demo test quick test-all slow nightly lint mutants everything campaign bench docs gallery clean

demo: $(READY)
	$(BIN)/mmrjax loop measured --out runs/demo/loop --force
	$(BIN)/mmrjax sweep --robot runs/demo/loop/robot.toml --out runs/demo/table8 --force
	@echo "open runs/demo/loop/report.html, then runs/demo/table8/report.html"

PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --durations=10 --durations-min=2
# The compiler's older emitters, and few of its optimizations: a program compiles faster and runs slower, which short
# tests don't feel. Level 0 needs mmrjax.SOUND_AT_LEVEL_0 and brings these tests nothing more.
QUICK := XLA_FLAGS="--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters=true --xla_backend_optimization_level=1 --xla_cpu_parallel_codegen_split_count=1"

# The checks of `lint` beside them: they need one core of two.
test: $(TOOLS)
	@$(MAKE) --no-print-directory -j2 lint quick

# Bytecode is kept, whatever a machine's settings: tests start processes of their own.
quick: $(TOOLS)
	PYTHONDONTWRITEBYTECODE= $(QUICK) $(PYTEST) -m "not slow"

# The quick and the slow tests.
test-all: lint
	PYTHONDONTWRITEBYTECODE= $(QUICK) $(PYTEST) -m "not nightly"

slow: $(TOOLS)
	PYTHONDONTWRITEBYTECODE= $(QUICK) $(PYTEST) -m "slow and not nightly"

# Tests of a minute or more each: whole loops on planted truths, campaigns, notebooks, records of every command.
nightly: $(TOOLS)
	PYTHONDONTWRITEBYTECODE= $(QUICK) $(PYTEST) -m nightly

lint: $(TOOLS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m mypy

# Tries plausible mistakes; prints how many die by `make test` alone and by all tests.
mutants: $(TOOLS)
	$(QUICK) $(BIN)/python benchmarks/mutants.py --jobs 2

# All tiers, one after another, on all cores: one table at the end, and in runs/everything/table.json.
JOBS ?= $(shell $(PYTHON) -c "import os; print(os.cpu_count())")
everything: $(TOOLS)
	$(BIN)/python benchmarks/everything.py --jobs $(JOBS)

campaign: $(TOOLS)
	$(BIN)/python benchmarks/loop.py --clean-wide 1000 --noise 100 --library 500 --variants 300 --outside 300 --pairs 200 --triples 150 --drift 100 --cluster 120 --coverage 600 --clean-unstated 300 --clean-heavy 120 --clean-uneven 120 --clean-rounded 120 --library-unstated 150 --outside-unstated 100 --pairs-unstated 60
	$(BIN)/python benchmarks/loop_series.py --clean-wide 300 --noise 20 --library 120 --outside 60 --pairs 60 --event 60
	$(BIN)/python benchmarks/rigs.py --clean 500 --library 400 --outside 250
	$(BIN)/python benchmarks/rig_logs.py --clean 80 --library 80 --outside 40

bench: $(TOOLS)
	$(BIN)/python benchmarks/steady.py
	$(BIN)/python benchmarks/drive.py

# The docs as a site, in an environment of its own; open site/index.html, no network needed.
docs: $(READY)
	$(BIN)/python docs/site.py
	$(PYTHON) -m venv runs/docs-venv
	runs/docs-venv/bin/pip install --quiet --disable-pip-version-check "mkdocs-material>=9.5,<10"
	NO_MKDOCS_2_WARNING=1 runs/docs-venv/bin/mkdocs build --strict --quiet
	rm -f site/404.html  # of a server's root, which a site on disk has not
	@echo "open site/index.html"

# The pictures of the docs and the tutorial about the loop, from runs of today; needs chromium. RECORDS is a folder with
# records of others that are not packaged: drivetrain/log.csv and rig.toml, emps/train.csv (docs/howto/public-records.md).
RECORDS ?=
gallery: $(TOOLS)
	$(BIN)/mmrjax loop measured --out runs/gallery/loop --force
	$(BIN)/mmrjax simulate --configuration 6T2A --voltage 24 --slope 10 --out runs/gallery/run --force
	$(BIN)/mmrjax sweep --out runs/gallery/sweep --force
	$(BIN)/mmrjax simulate --profile patrol --battery --payload 5 --out runs/gallery/mission --force
	$(BIN)/mmrjax check --out runs/gallery/check --force
	$(BIN)/mmrjax size --out runs/gallery/size --force
	$(BIN)/mmrjax sensitivity --outputs total_current,slip --out runs/gallery/sensitivity --force
	$(BIN)/mmrjax loop docs/rigs/public/neo_dyno.csv --robot docs/rigs/public/neo_dyno.toml --out runs/gallery/neo_dyno --force
	$(BIN)/mmrjax loop docs/rigs/public/odrive.csv --robot docs/rigs/public/odrive.toml --out runs/gallery/odrive --force
	$(if $(RECORDS),$(BIN)/mmrjax calibrate $(RECORDS)/emps/train.csv --robot docs/rigs/public/emps_by_direction.toml --out runs/gallery/emps --force)
	$(if $(RECORDS),$(BIN)/mmrjax calibrate $(RECORDS)/drivetrain/log.csv --robot $(RECORDS)/drivetrain/rig.toml --feedforward simple --out runs/gallery/drivetrain --force)
	$(BIN)/python docs/site.py runs/gallery/loop
	$(BIN)/python docs/gallery/make.py $(foreach page,loop run sweep mission check size sensitivity neo_dyno odrive $(if $(RECORDS),drivetrain emps),$(page)=runs/gallery/$(page))

clean:
	rm -rf $(VENV) runs site

# Bytecode is compiled on all cores afterwards, not of OpenGL, which only `render` imports.
$(READY): requirements.lock pyproject.toml
	$(PYTHON) -c "import sys; sys.exit('mmrjax needs Python 3.11 or newer' if sys.version_info < (3, 11) else 0)"
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --no-compile -c requirements.lock setuptools
	$(INSTALL) --no-compile -c requirements.lock --no-build-isolation -e .
	$(BIN)/python -m compileall -qq -j 0 -x OpenGL $(VENV)/lib mmrjax calibration sweeps || true
	touch $(READY)

$(TOOLS): $(READY)
	$(INSTALL) -r requirements.lock
	touch $(TOOLS)
