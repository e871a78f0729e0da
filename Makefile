# Everything sets itself up: `make demo` and `make test` work in a fresh clone with Python, make and git alone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Every worker of pytest, and every process that a test starts, would otherwise compile the same modules again.
unexport PYTHONDONTWRITEBYTECODE
READY := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs-ready
NOTEBOOKS_READY := $(VENV)/.notebooks-ready

.PHONY: demo test test-thorough test-wheel test-pictures pictures notebooks bench bench-against coverage test-long test-hosts test-compose test-fresh test-faults test-mutants test-simulated test-simulated-mutants docs lint lint-types lint-rest setup clean

demo: $(READY)
	$(BIN)/evedrop demo

# What needs more than processors and a disk has a target of its own, below: packages to install, a driver that draws, root.
ELSEWHERE := long or campaign or hosts or containers or fresh or notebooks or wheel or pictures
test: $(READY)
	$(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder -m "not (thorough or $(ELSEWHERE))"

# The tests that take a second or more each.
test-thorough: $(READY)
	$(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder -m "thorough and not ($(ELSEWHERE))"

# The wheel, built and installed into environments of its own.
test-wheel: $(READY)
	$(BIN)/python -m pytest -n 2 -m wheel tests/test_wheel.py

# Pictures and videos, drawn by Rerun's viewer without a screen. Without a Vulkan driver they are skipped.
test-pictures: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "pictures and not long" tests/show/view

# The pictures of README and docs/, drawn again by the commands that the pages name: some minutes. They need a Vulkan driver.
# NAMES=vehicle.gif: only that file.
NAMES ?=
pictures: $(READY)
	$(BIN)/python -m tests.docs.pictures $(NAMES)

COVERING := $(addprefix tests/,model live/protocol)

# Branch coverage of the mathematics and of the message readers, by tests that run in one process; fails below 100 %. Tests with
# random examples are left out, so that it is the same in every run.
coverage: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not long and not hypothesis and not thorough" --cov --cov-report=term-missing:skip-covered $(COVERING)

# Every performance metric as a Markdown table (docs/performance.md). QUICK=--quick: small sizes, to see only that everything runs.
QUICK ?=
bench: $(READY)
	$(BIN)/python benchmarks/bench.py $(QUICK)

# What became slower than a commit, by default the last tag: both run the same commands in turns, most of an hour.
BASE ?=
bench-against: $(READY)
	$(BIN)/python benchmarks/against.py $(BASE) $(QUICK)

# Also the tests with random examples, with more examples than in `make test`.
test-long: $(READY)
	$(BIN)/python -m pytest -n 2 --hypothesis-profile=full -m "long or hypothesis"

# Every notebook of docs/notebooks from top to bottom, in a kernel.
notebooks: $(NOTEBOOKS_READY)
	$(BIN)/python -m pytest -n 2 -m notebooks tests/notebooks

# As root: every process in a network namespace of its own. Where that cannot be, it says so and fails nothing. Most of the time
# cables are out and others wait, so there are more tests at a time than processors.
test-hosts: $(READY)
	$(BIN)/python -m pytest -n 3 -m hosts tests/hosts

# As root: docker-compose.yml brought up by a Docker daemon of its own. Where that cannot be, it says so and fails nothing.
test-compose: $(READY)
	$(BIN)/python -m pytest -m containers tests/containers

# As root: README's two commands on bare Debian 12 and 13, each without a compiler and with one. Where that cannot be, it says so
# and fails nothing. FRESH=debian13 is that one alone; `in-turn` is another one with every commit.
FRESH ?= all
test-fresh: $(READY)
	$(BIN)/python -m pytest -s -m fresh --machine=$(FRESH) tests/fresh

# Disturbs live runs, wires and studies at random, by number: the same SEED is the same case. SEED alone repeats that one case, and
# COUNT is how many from SEED on. As root small disks can be filled and broken as well. What cannot be done here is said at the end.
SEED ?=
COUNT ?= $(if $(SEED),1,60)
test-faults: $(READY)
	$(BIN)/python -m tests.faults.campaign --seed $(or $(SEED),1) --count $(COUNT)

# Whether that campaign notices mistakes: each of tests/mutants.toml is put into a copy of the package, and cases are run
# against it. Takes an hour or more. ONLY=wire: those whose file or description contains the word.
ONLY ?=
test-mutants: $(READY)
	$(BIN)/python -m tests.faults.mutation --only "$(ONLY)"

# Runs whose programs all live in one interpreter, in virtual time: COUNT seeds from SEED on. EXPLAIN=17 shrinks and shows the case of
# that seed alone; VIEW=run.rrd also writes it as a recording for Rerun, and VIEW=window opens a viewer (docs/maintainers/simulated-world.md).
# The tests of the campaign itself come first, except where one case is played.
EXPLAIN ?=
VIEW ?=
test-simulated: $(READY)
	$(if $(EXPLAIN)$(filter 1,$(COUNT)),,$(BIN)/python -m pytest -n 2 -m campaign tests/virtual)
	$(BIN)/python -m tests.virtual.simulated --seed $(or $(SEED),1) --count $(COUNT) $(if $(EXPLAIN),--explain $(EXPLAIN)) \
		$(if $(VIEW),--view $(VIEW:window=))

# The same for the simulated world, of the mistakes that it must notice: in some of 400 seeds, or in a case of regressions.toml.
test-simulated-mutants: $(READY)
	$(BIN)/python -m tests.virtual.mutation --only "$(ONLY)"

# The pages as a site, in build/site. Prints how many words each page has, and fails on too many, on broken links, on pages that
# the navigation does not have, and on commands that do not print what a page shows; BUILD_ONLY=1 leaves out the commands, which
# take minutes. The environment gets what builds the site only here, so that the other targets do not wait for it.
docs: $(DOCS_READY)
	$(BIN)/python tools/site/words.py
	NO_MKDOCS_2_WARNING=1 PYTHONPATH=tools/site $(BIN)/python -m mkdocs build --clean
ifndef BUILD_ONLY
	$(BIN)/python -m tests.docs.reports build/site/screens
	$(BIN)/python -m pytest -n 2 tests/docs/test_consoles.py tests/docs/test_view_pictures.py tests/docs/test_screens.py
endif
	@echo "the site is in build/site; to read it: python3 -m http.server --bind 127.0.0.1 --directory build/site"

# `make -j2 -O lint` checks types in parallel with the rest.
lint: lint-types lint-rest

lint-types: $(READY)
	$(BIN)/mypy
	$(BIN)/mypy benchmarks/*.py

lint-rest: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/python tools/package_drawing.py --check
	$(BIN)/python -m pytest -q tools/lint
	$(BIN)/python tools/lines_of_code.py

setup: $(READY)

# The locked versions, each checked against its hash; then this project itself, which needs no download. Its C kernels are
# compiled with the machine's compiler, or that of the package ziglang if it is in the environment; without either, pip succeeds
# all the same, and numpy does their work.
$(READY): tools/constraints/project.txt pyproject.toml tools/hatch_build.py $(wildcard emulator/evedrop/model/kernels/binding.py emulator/evedrop/model/kernels/source/*)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python tools/install.py tools/constraints/project.txt
	$(BIN)/python tools/install.py --project .
	touch $(READY)

# Versions of the packages that build the site, each checked against its hash.
$(DOCS_READY): $(READY) tools/constraints/docs.txt
	$(BIN)/python tools/install.py tools/constraints/docs.txt
	touch $(DOCS_READY)

# Versions of the packages that run notebooks, each checked against its hash.
$(NOTEBOOKS_READY): $(READY) tools/constraints/notebooks.txt
	$(BIN)/python tools/install.py tools/constraints/notebooks.txt
	touch $(NOTEBOOKS_READY)

clean:
	rm -rf $(VENV) build/site build/gallery emulator/evedrop/model/kernels/_compiled.* .mypy_cache .ruff_cache .pytest_cache .hypothesis build/test-base-*.tar*
