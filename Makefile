# Every target does its own set-up, in the local virtual environment $(VENV).
#
#   make demo     a co-design study of the Soft Finger, with a report to look at
#   make test     all tests               make lint    ruff            make types   mypy
#   make bench    speed and accuracy      make clean   remove caches and build leftovers
#   make docs     the site, in site/      make docs-images    its pictures, in docs/images/
#   make setup    the set-up alone        make lock    write requirements.lock anew
#
# PYTHON=python3.12      another interpreter (3.11 to 3.13; requirements.lock is made for 3.11)
# PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu"    a small torch, without CUDA
# ARGS="-k cable -x"     further arguments of pytest (make test), softgym bench (make bench), docs/make_images.py (make
#                        docs-images) or pip (make lock)

VENV ?= .venv
WORKERS ?= 2
DEMO ?= results/demo
BIN := $(VENV)/bin
SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))
PYTHON ?= $(shell for python in python3.11 python3 python3.12 python3.13; do \
	$$python -c '$(SUPPORTED)' 2>/dev/null && echo $$python && break; done)

# What the wheels of gmsh (at import) and vtk (off-screen pictures) load from the system, by Debian package.
SYSTEM_PACKAGES := libegl1 libfontconfig1 libgl1 libglu1-mesa libgomp1 libx11-6 libxcursor1 libxext6 libxfixes3 \
	libxft2 libxinerama1 libxrender1
SYSTEM_CHECK := import gmsh, pyvista; plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64)); \
	plotter.add_mesh(pyvista.Sphere()); sys = __import__("sys"); \
	sys.exit(not plotter.screenshot(return_img=True).std() > 0)

# Tests of studies in a database start a PostgreSQL server of their own. Debian keeps its programs off the search path.
POSTGRES_CHECK := ls /usr/lib/postgresql/*/bin/initdb || command -v initdb

.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: setup postgres demo test lint types bench docs docs-images lock clean

setup: $(VENV)/.stamp-system

$(VENV)/.stamp: requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "setup: no Python 3.11, 3.12 or 3.13 found; name one with PYTHON=..." >&2; exit 1; }
	$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install $(PIP_ARGS) -r requirements.lock
	$(BIN)/python -m pip install --no-deps --no-build-isolation -e .
	@touch $@

# The stamp is left only when gmsh imports and a picture can be drawn: a machine without is told each time.
$(VENV)/.stamp-system: $(VENV)/.stamp
	@check() { $(BIN)/python -c '$(SYSTEM_CHECK)' >/dev/null 2>&1; }; \
	if ! check && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "setup: installing the system libraries of gmsh and vtk"; \
		{ apt-get update && DEBIAN_FRONTEND=noninteractive \
			apt-get install -y --no-install-recommends $(SYSTEM_PACKAGES); } </dev/null || true; \
	fi; \
	if check; then touch $@; else \
		echo "setup: gmsh or off-screen pictures do not work here; install (Debian names): $(SYSTEM_PACKAGES)" >&2; \
	fi

# The package would make and start a server of the system's own, which the tests do not use: NO_CLUSTER keeps it from that.
NO_CLUSTER := /etc/postgresql-common/createcluster.d/softgym-setup.conf
postgres:
	@check() { { $(POSTGRES_CHECK); } >/dev/null 2>&1; }; \
	if ! check && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "setup: installing PostgreSQL, for the tests of shared studies"; \
		mkdir -p $(dir $(NO_CLUSTER)) && echo "create_main_cluster = false" > $(NO_CLUSTER); \
		{ apt-get update && DEBIAN_FRONTEND=noninteractive \
			apt-get install -y --no-install-recommends postgresql; } </dev/null || true; \
		rm -f $(NO_CLUSTER); \
	fi; \
	check || echo "setup: PostgreSQL is missing, its tests are skipped; install (Debian name): postgresql" >&2

demo: setup
	$(BIN)/softgym codesign --config configs/codesign/finger_reach.yaml --folder $(DEMO)

# One thread in each process: the matrices are small, and the test workers fill the cores.
test bench docs docs-images: export OMP_NUM_THREADS = 1
test bench docs docs-images: export OPENBLAS_NUM_THREADS = 1
test bench docs docs-images: export MKL_NUM_THREADS = 1
test bench docs docs-images: export NUMBA_NUM_THREADS = 1

test: setup postgres
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal $(ARGS)

bench: setup
	$(BIN)/softgym bench $(ARGS)

# A notice of the theme about its successor is no warning of this build.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "site: $(CURDIR)/site/index.html"

docs-images: setup
	$(BIN)/python docs/make_images.py $(ARGS)

lint: $(VENV)/.stamp
	$(BIN)/ruff check .

types: $(VENV)/.stamp
	$(BIN)/mypy

# The newest set that pyproject.toml allows, under the comment at the head of the present lock. The CUDA packages of torch
# are left out: pip adds them where the build of torch in use asks for them.
lock:
	rm -rf build/lock
	$(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install $(PIP_ARGS) --upgrade setuptools $(ARGS) -e '.[test,docs]'
	{ sed '/^[^#]/,$$d' requirements.lock && build/lock/bin/python -m pip freeze --all --exclude-editable \
		| sed 's/+[^+]*$$//' | grep -vE '^(pip|wheel|triton|nvidia-.*|cuda-.*)=='; } > build/requirements.lock
	mv build/requirements.lock requirements.lock
	rm -rf build/lock

clean:
	rm -rf build dist site *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find softgym_envs agents codesign tests benchmarks examples -name __pycache__ -type d -prune -exec rm -rf {} +
