# Every target sets up what it needs in the local virtual environment $(VENV).
#
#   make demo     co-design study of the Soft Finger, with a report
#   make check    lint, types and fast tests (a minute)
#   make test     all tests                        make slow-tests    all tests, and update the list of slow ones
#   make lint     ruff                             make types         mypy
#   make bench    speed                            make clean         remove caches and build leftovers
#   make docs     site, in site/                   make docs-images   pictures of the site, in docs/images/
#   make setup    set-up only                      make lock          renew requirements.lock
#   make test-clients           the snippets for other libraries, each in an environment of its own
#
# PYTHON=python3.12      use another interpreter (3.11 to 3.14; requirements.lock is made for 3.11)
# TORCH_INDEX=           install the torch of PyPI, which has CUDA on Linux (several GB), where make finds no NVIDIA GPU
# PIP_ARGS="--retries 9" pass more arguments to pip
# ARGS="-k cable -x"     pass more arguments to pytest (make check, make test), softgym bench (make bench),
#                        docs/make_images.py (make docs-images) or pip (make lock)

VENV ?= .venv
WORKERS ?= 2
DEMO ?= results/demo
BIN := $(VENV)/bin
# Torch without CUDA, for Linux without an NVIDIA GPU. With one, torch comes from pip's own index, like everything else.
TORCH_INDEX ?= $(shell [ "$$(uname -s)" != Linux ] || nvidia-smi -L >/dev/null 2>&1 || echo https://download.pytorch.org/whl/cpu)
SUPPORTED := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 15))
PYTHON ?= $(shell for python in python3.11 python3 python3.12 python3.13 python3.14; do \
	$$python -c '$(SUPPORTED)' 2>/dev/null && echo $$python && break; done)

# System libraries, as Debian packages, that the wheels of gmsh (at import) and vtk (off-screen pictures) load.
SYSTEM_PACKAGES := libegl1 libfontconfig1 libgl1 libglu1-mesa libgomp1 libx11-6 libxcursor1 libxext6 libxfixes3 \
	libxft2 libxinerama1 libxrender1
SYSTEM_CHECK := import gmsh, pyvista; plotter = pyvista.Plotter(off_screen=True, window_size=(64, 64)); \
	plotter.add_mesh(pyvista.Sphere()); sys = __import__("sys"); \
	sys.exit(not plotter.screenshot(return_img=True).std() > 0)

# Tests of studies in a database start their own PostgreSQL server; tests of reports open them in Chromium. Debian keeps
# the programs of PostgreSQL off the search path. (A shell function must not be called "chromium": "command -v" finds it.)
POSTGRES_CHECK := ls /usr/lib/postgresql/*/bin/initdb || command -v initdb
CHROMIUM_CHECK := command -v chromium || command -v chromium-browser || command -v google-chrome

# Shell command that installs Debian packages. Mirrors fail now and then, and other programs lock the package database: it
# waits and tries three times. A list that does not update (apt-get update) need not be the one of these packages.
APT_OPTIONS := -o Acquire::Retries=3 -o DPkg::Lock::Timeout=120
apt_install = { for pause in 0 20 60; do sleep $$pause; apt-get $(APT_OPTIONS) update; DEBIAN_FRONTEND=noninteractive \
	apt-get $(APT_OPTIONS) install -y --no-install-recommends $(1) && break; done; } </dev/null || true

.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: setup test-programs demo check test test-clients slow-tests lint types bench docs docs-images lock clean

setup: $(VENV)/.stamp-system

$(VENV)/.stamp: requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "setup: no Python 3.11 to 3.14 found; name one with PYTHON=..." >&2; exit 1; }
	$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	@test -z "$(TORCH_INDEX)" || $(BIN)/python -m pip install --no-deps --retries 2 --timeout 15 $(PIP_ARGS) \
		--index-url $(TORCH_INDEX) $$(grep '^torch==' requirements.lock) \
		|| echo "setup: no torch from $(TORCH_INDEX); pip takes that of its own index, on Linux several GB with CUDA" >&2
	$(BIN)/python -m pip install $(PIP_ARGS) -r requirements.lock
	$(BIN)/python -m pip install --no-deps --no-build-isolation -e .
	@touch $@

# The stamp is written only when gmsh imports and a picture can be drawn, so that the message below is repeated until then.
$(VENV)/.stamp-system: $(VENV)/.stamp
	@check() { $(BIN)/python -c '$(SYSTEM_CHECK)' >/dev/null 2>&1; }; \
	if ! check && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "setup: installing the system libraries of gmsh and vtk"; \
		$(call apt_install,$(SYSTEM_PACKAGES)); \
	fi; \
	if check; then touch $@; else \
		echo "setup: gmsh or off-screen pictures do not work here; install (Debian names): $(SYSTEM_PACKAGES)" >&2; \
	fi

# The Debian package of PostgreSQL would create and start a system server, which the tests do not use: NO_CLUSTER prevents it.
NO_CLUSTER := /etc/postgresql-common/createcluster.d/softgym-setup.conf
test-programs:
	@has_postgres() { { $(POSTGRES_CHECK); } >/dev/null 2>&1; }; has_chromium() { { $(CHROMIUM_CHECK); } >/dev/null 2>&1; }; \
	missing="$$(has_postgres || echo postgresql) $$(has_chromium || echo chromium)"; \
	if [ "$$missing" != " " ] && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "setup: installing programs of the tests: $$missing"; \
		mkdir -p $(dir $(NO_CLUSTER)) && echo "create_main_cluster = false" > $(NO_CLUSTER); \
		for package in $$missing; do $(call apt_install,$$package); done; \
		rm -f $(NO_CLUSTER); \
	fi; \
	has_postgres || echo "setup: without PostgreSQL, tests of shared studies are skipped; install (Debian name): postgresql" >&2; \
	has_chromium || echo "setup: without Chromium, tests of reports in a browser are skipped; install (Debian name): chromium" >&2

demo: setup
	$(BIN)/softgym demo --folder $(DEMO)

# One thread per process: the matrices are small, and the test workers occupy the cores.
check test slow-tests bench docs docs-images: export OMP_NUM_THREADS = 1
check test slow-tests bench docs docs-images: export OPENBLAS_NUM_THREADS = 1
check test slow-tests bench docs docs-images: export MKL_NUM_THREADS = 1
check test slow-tests bench docs docs-images: export NUMBA_NUM_THREADS = 1

check: lint types setup
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -q -m "not slow" $(ARGS)

test: setup test-programs
	$(BIN)/python -m tests.compile_kernels
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal $(ARGS)

# ARGS="torchrl skrl" runs these clients only.
test-clients: setup
	$(BIN)/python examples/clients/run.py $(ARGS)

slow-tests: setup test-programs
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal --update-slow-tests

bench: setup
	$(BIN)/softgym bench $(ARGS)

# The theme prints a notice about its successor, which would look like a warning of this build.
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "site: $(CURDIR)/site/index.html"

docs-images: setup
	$(BIN)/python docs/make_images.py $(ARGS)

lint: $(VENV)/.stamp
	$(BIN)/ruff check .

types: $(VENV)/.stamp
	$(BIN)/mypy

# Freeze the newest versions that pyproject.toml allows, and keep the comment at the head of the present lock. The CUDA
# packages of torch are left out: pip adds them if the installed build of torch requires them.
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
