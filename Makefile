# `make demo` and `make test` do all set-up in .venv. On Windows use the pip lines of README.md.
VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= python3
CORE := $(shell find rust -name '*.rs') Cargo.toml Cargo.lock pyproject.toml
export RUSTDOCFLAGS := -D warnings

# The same commit gives the same wheel: what is in it is as old as the commit.
export SOURCE_DATE_EPOCH ?= $(shell git log -1 --format=%ct 2>/dev/null || echo 315532800)

.PHONY: demo test test-slow attack test-rust test-python lint docs bench fuzz wheel wheels wheels-twice \
	wheel-test sdist-test clean

demo: $(VENV)/.built
	$(BIN)/ftlm demo -o demo --force

test: lint test-rust test-python docs wheel-test

$(VENV)/.tools: requirements-test.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-test.txt
	@touch $@

$(VENV)/.built: $(VENV)/.tools $(CORE)
	. $(BIN)/activate && maturin develop --release --quiet
	@touch $@

# With the environment that maturin gives to PyO3, a check of the bindings does not make the next wheel compile anew.
AS_MATURIN = PYO3_BUILD_EXTENSION_MODULE=1 PYO3_CONFIG_FILE=$$(ls -t $${CARGO_TARGET_DIR:-$(CURDIR)/target}/maturin/pyo3-config-*.txt | head -1)

lint: $(VENV)/.built
	cargo fmt --check
	cargo clippy --release --all-targets --quiet -- -D warnings
	$(AS_MATURIN) cargo clippy --release --all-targets --features python --quiet -- -D warnings
	cargo doc --release --no-deps --quiet --features rig,oracles
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/python -m mypy.stubtest ftlm._core
	$(BIN)/python tests/notices.py --check

# Examples are checked by clippy; linking them again would take minutes.
test-rust:
	cargo test --release --lib --tests
	cargo test --release --doc

# A file is the work of one of two workers (tests/python/conftest.py).
test-python: $(VENV)/.built
	$(BIN)/python -m pytest -n 2

test-slow: $(VENV)/.built
	$(BIN)/python -m pytest -m slow --timeout 7200

# Attacks from outside, for minutes, in a temporary folder; a table of what was tried and what broke. So many calls of
# each entry of the extension; with ATTACK_COUNTS=FILE they go on where they stopped, which ATTACK_CALLS=100000 may ask for.
ATTACK_CALLS ?= 1300
attack: $(VENV)/.built
	$(BIN)/python tests/attack.py --calls $(ATTACK_CALLS) $(if $(ATTACK_COUNTS),--counts $(ATTACK_COUNTS))

# Pages in docs/_build/html; a warning is an error.
docs: $(VENV)/.built
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html

bench: $(VENV)/.built
	cargo bench --bench kernels
	$(BIN)/python benches/search.py
	$(BIN)/python benches/promises.py
	$(BIN)/python benches/rig.py

# A minute for each parser; FUZZ_SECONDS=600 for more. Inputs that break one are kept in tests/fuzz/regressions.
FUZZ_SECONDS ?= 60
fuzz: $(VENV)/.built
	$(BIN)/python tests/fuzz/fuzz.py --seconds $(FUZZ_SECONDS)

wheel: $(VENV)/.tools
	rm -rf wheels
	. $(BIN)/activate && maturin build --release --quiet --out wheels

# Wheels for any Linux from this one, and the source: zig links against the oldest C library of a policy, and no folder of
# this machine is named. WHEELS names fewer targets; rustup adds Rust's library of one that is not there.
WHEELS ?= x86_64-unknown-linux-gnu aarch64-unknown-linux-gnu x86_64-unknown-linux-musl aarch64-unknown-linux-musl
ZIG := $(VENV)-zig
CARGO_HOME ?= $(HOME)/.cargo
POLICY = $(if $(findstring musl,$(1)),musllinux_1_2,manylinux2014)
NAMELESS = --remap-path-prefix=$(CURDIR)=/ftlm --remap-path-prefix=$(CARGO_HOME)/registry/src=/crates

$(ZIG)/.tools: requirements-wheels.txt
	$(PYTHON) -m venv $(ZIG)
	$(ZIG)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-wheels.txt
	@touch $@

wheels: $(ZIG)/.tools
	rm -rf wheels
	for target in $(WHEELS); do rustup target list --installed | grep -qx $$target || rustup target add $$target || exit 1; done
	. $(ZIG)/bin/activate && export RUSTFLAGS="$(NAMELESS)" && $(foreach target,$(WHEELS),maturin build --release \
		--locked --quiet --zig --target $(target) --compatibility $(call POLICY,$(target)) --out wheels &&) true
	. $(ZIG)/bin/activate && maturin sdist --out wheels
	$(ZIG)/bin/python tests/wheel.py --nameless wheels/*.whl
	$(ZIG)/bin/python -m abi3audit --strict wheels/*.whl
	for wheel in wheels/*.whl; do \
		case $$wheel in *musllinux*) where="--ldpaths /nonexistent";; *) where=;; esac; \
		$(ZIG)/bin/auditwheel show --json $$where $$wheel | $(ZIG)/bin/python tests/wheel.py || exit 1; done

# Wheels of the last commit, made in two folders from nothing: the same bytes.
wheels-twice: WHEELS = x86_64-unknown-linux-gnu
wheels-twice: $(ZIG)/.tools
	folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && for copy in one two/deeper; do \
		mkdir -p $$folder/$$copy && git archive HEAD | tar x -C $$folder/$$copy && \
		$(MAKE) -C $$folder/$$copy wheels ZIG=$(abspath $(ZIG)) WHEELS="$(WHEELS)" || exit 1; done && \
	for made in $$folder/one/wheels/*; do cmp $$made $$folder/two/deeper/wheels/$${made##*/} || exit 1; done

# The wheel alone, in environments that have nothing else: what a user gets from pip. PYTHONS names several. At last with
# the lowest versions that pyproject.toml allows.
PYTHONS ?= $(PYTHON)
wheel-test: wheel
	for python in $(PYTHONS); do rm -rf $(VENV)-wheel && $$python -m venv $(VENV)-wheel && \
		$(VENV)-wheel/bin/python -m pip install --quiet --disable-pip-version-check wheels/*.whl && \
		(cd wheels && ../$(VENV)-wheel/bin/ftlm doctor && ../$(VENV)-wheel/bin/ftlm demo --increment 0.1 -o demo --force) || \
		exit 1; done
	rm -rf $(VENV)-floors && $(PYTHON) -m venv $(VENV)-floors
	$(BIN)/python tests/wheel.py --floors > wheels/floors.txt
	$(VENV)-floors/bin/python -m pip install --quiet --disable-pip-version-check --only-binary :all: -r wheels/floors.txt wheels/*.whl
	cd wheels && ../$(VENV)-floors/bin/python ../tests/wheel.py --commands
	$(BIN)/python -m abi3audit --strict wheels/*.whl
ifeq ($(shell uname -s),Linux)
	$(BIN)/auditwheel show --json wheels/*.whl | $(BIN)/python tests/wheel.py
	$(BIN)/python tests/wheel.py --holds wheels/*.whl
endif
	rm -rf $(VENV)-wheel $(VENV)-floors
	find wheels -mindepth 1 ! -name '*.whl' -delete

# The source distribution alone builds and works, in an environment that has only pip; Rust is needed.
sdist-test: $(VENV)/.tools
	rm -rf sdist $(VENV)-sdist
	. $(BIN)/activate && maturin sdist --out sdist
	$(PYTHON) -m venv $(VENV)-sdist
	$(VENV)-sdist/bin/python -m pip install --quiet --disable-pip-version-check sdist/*.tar.gz
	cd sdist && ../$(VENV)-sdist/bin/ftlm doctor
	rm -rf $(VENV)-sdist sdist

clean:
	rm -rf $(VENV) $(VENV)-wheel $(VENV)-floors $(VENV)-sdist $(ZIG) wheels sdist demo target docs/_build docs/_pictures docs/_reference
