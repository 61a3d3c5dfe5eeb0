# Set-up and use need Python 3.11 or newer and make; everything else goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
# A command that ends with 3 is done, with some runs that did not converge; their status says why.
DONE := || [ $$? -eq 3 ]

.PHONY: demo test slow lint bench clean

demo: $(READY)
	$(BIN)/mmrjax sweep --out runs/demo/table8 --force $(DONE)
	$(BIN)/mmrjax compare measured --out runs/demo/measured --force $(DONE)
	@echo "open runs/demo/table8/report.html and runs/demo/measured/report.html"

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow"

slow: $(READY)
	$(BIN)/python -m pytest -m slow

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

bench: $(READY)
	$(BIN)/python benchmarks/steady.py
	$(BIN)/python benchmarks/drive.py

clean:
	rm -rf $(VENV) runs

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -c "import sys; sys.exit('mmrjax needs Python 3.11 or newer' if sys.version_info < (3, 11) else 0)"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
	touch $(READY)
