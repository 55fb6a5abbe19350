# make render: a first picture.   make test: the tests.   make verify: the long checks.
# make lint: style and types.     make gallery: all stills.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
# Two processes, since half of the tests' time is Python's; a file's tests share what they have made
TWO    := -n 2 --dist loadfile

.PHONY: render test verify lint gallery clean

render: $(VENV)/.installed
	mkdir -p out
	$(BIN)/nil-mitsuba render scenes/showcase.xml -o out/showcase.exr --png out/showcase.png

test: $(VENV)/.installed-test
	$(BIN)/python -m pytest $(TWO) --durations=10

verify: $(VENV)/.installed-test
	$(BIN)/python -m pytest $(TWO) -m verify

lint: $(VENV)/.installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy

gallery: $(VENV)/.installed-denoise
	$(BIN)/python examples/gallery.py

clean:
	rm -rf $(VENV) out

# The package is installed editable: only a change of its requirements calls for a new install.
# The stamp of each extra says which requirements are in place.
$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/.installed-%: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	touch $@
