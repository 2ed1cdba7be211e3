"""Fixtures that several test files share: reference files, the synthetic plants with their records, seeded noise."""

import io
import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

# Workers of the suite share the processor's cores: threads of each would wait for one another. Read when NumPy loads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Otherwise each program that a test starts compiles the package anew, which takes it a second.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import numpy as np
import pytest
from hypothesis import settings
from xdist.scheduler import LoadScopeScheduling

import ftlm
from ftlm.estimation.extensions import ExtensionTests
from ftlm.io import binary_reader, isolated_reader

# Otherwise each worker rewrites the assertions of all tests anew, half of the time of their collection.
sys.dont_write_bytecode = False

ROOT = Path(__file__).resolve().parents[2]
REFERENCE = ROOT / "tests" / "reference"

#: What Windows lacks, and the imports of tests that have never run there.
POSIX_ONLY = re.compile(
    r"fcntl|import (pty|resource)|os\.fork|os\.kill|SIG(KILL|INT|TERM|HUP)|mkfifo|preexec_fn|/(proc|dev)/|"
    r"from (test_cli|app_page|rig_bench|stored_searches) "
)
if os.name == "nt":
    collect_ignore = [
        p.name for p in Path(__file__).parent.glob("test_*.py") if POSIX_ONLY.search(p.read_text("utf-8"))
    ]

# The same examples in every run, and no clock.
settings.register_profile("ftlm", derandomize=True, deadline=None)
settings.load_profile("ftlm")


#: Files that share what takes long to make, such as the reproduction or the drawn formulas, by the file's name.
SHARED_SCOPES = {
    "test_browser.py": "reproduction",
    "test_reproduction.py": "reproduction",
    "test_documents.py": "documents",
    "test_pages_browser.py": "documents",
}
#: Files that take longest, which start first: one that starts last keeps the other workers waiting.
LONGEST_FILES = (
    "test_automatic.py",
    "test_reproduction.py",
    "test_browser.py",
    "test_documents.py",
    "test_pages_browser.py",
    "test_rig_safety.py",
    "test_first_rows.py",
    "test_order_search.py",
    "test_files.py",
    "test_app_browser.py",
    "test_app.py",
    "test_store.py",
    "test_extensions.py",
    "test_monte_carlo.py",
    "test_rig.py",
    "test_friction.py",
    "test_two_frictions.py",
    "test_filtered_signals.py",
)


class ByFile(LoadScopeScheduling):
    """One worker takes a file, so that what its tests share is made once."""

    def _split_scope(self, nodeid):
        file = nodeid.split("::", 1)[0]
        return SHARED_SCOPES.get(file.rpartition("/")[2], file)


def pytest_xdist_make_scheduler(config, log):
    """Groups of pytest-xdist 3.8 are marked in names that pytest 9.2 no longer reads."""
    # The files of most tests are not those that take longest.
    config.option.loadscopereorder = False
    return ByFile(config, log)


def pytest_collection_modifyitems(items):
    """Sort the files that take longest to the front, in their sequence."""
    ranks = {name: rank for rank, name in enumerate(LONGEST_FILES)}
    items.sort(key=lambda item: ranks.get(item.path.name, len(ranks)))


@pytest.fixture(scope="module")
def no_extension_tests():
    """Fits without the fits of extended structures, most of the time of a fit whose residuals are colored.

    For files whose tests are about parameters and not about findings.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ftlm.estimation.identify.run_extension_tests", lambda fit, tests: ExtensionTests([]))
        yield


@pytest.fixture
def reader_in_process(monkeypatch):
    """Binary files are read by the reader's own code in this process, which saves starting Python for each.

    For sound files; a damaged one can crash the libraries.
    """

    def run(*, args, **_):
        kind, told, *paths = args[args.index("-c") + 2 :]
        out = io.BytesIO()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for path in paths:
                binary_reader.write_result(kind, path, out, binary_reader.SIZE_LIMIT, json.loads(told)["sheet"])
        return SimpleNamespace(stdout=out.getvalue(), returncode=0)

    started = SimpleNamespace(run=run, DEVNULL=subprocess.DEVNULL, TimeoutExpired=subprocess.TimeoutExpired)
    monkeypatch.setattr(isolated_reader, "subprocess", started)


@pytest.fixture(scope="session")
def root():
    """Folder of the repository."""
    return ROOT


@pytest.fixture(scope="session")
def reference():
    """Reader of the generated reference files."""
    return lambda name: json.loads((REFERENCE / f"{name}.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def plants(reference):
    """Plants A and A2 as the reference file describes them."""
    return reference("plants")["plants"]


@pytest.fixture(scope="session")
def plant(plants):
    """Maker of a plant's true model: ``plant("A", coupling="measured")``."""

    def make(name, **options):
        described = plants[name]
        coefficients = {t["name"]: t["coefficient"] for e in described["equations"] for t in e["terms"]}
        return ftlm.link_model(
            stage=described["stage"],
            orders=described["free_orders"],
            coefficients=coefficients,
            form="published",
            **options,
        )

    return make


@pytest.fixture(scope="session")
def drive(plants):
    """Maker of a plant's input as a run whose outputs are still zero: 5 000 held samples unless told otherwise."""

    def make(name, samples=None):
        described = plants[name]["input"]
        step, n = described["sample_step"], samples or described["samples"]
        period = round(described["period"] / step)
        current = described["amplitude"] * np.where(np.arange(n) % period < period // 2, 1.0, -1.0)
        stage, zero = plants[name]["stage"], np.zeros(n)
        outputs = {f"theta{stage}1": zero, f"theta{stage}2": zero}
        units = {described["signal"]: "A", f"theta{stage}1": "rad", f"theta{stage}2": "rad"}
        return ftlm.Run.from_arrays(
            step=step, inputs={described["signal"]: current}, outputs=outputs, units=units, name=f"plant {name}"
        )

    return make


@pytest.fixture(scope="session")
def clean_a(plant, drive):
    """Plant A's 5 000 point samples without noise, converged to 1e-8."""
    return plant("A").simulate(drive("A"), tolerance=1e-8)


@pytest.fixture(scope="session")
def with_noise():
    """Adder of seeded white noise to every output: ``with_noise(run, sigma, seed)``."""

    def add(run, sigma, seed):
        rng = np.random.default_rng(seed)
        return ftlm.Run.from_arrays(
            step=run.step,
            inputs={name: run[name] for name in run.inputs},
            outputs={name: run[name] + sigma * rng.standard_normal(run.length) for name in run.outputs},
            units={name: unit for name, unit in run.units.items() if unit},
            name=f"{run.name}, noise {sigma:g}, seed {seed}",
        )

    return add


@pytest.fixture(scope="session")
def small_model():
    """One stable equation of two own terms and one input."""
    return ftlm.Model(ftlm.equation("D^1.6 y = -3 D^0.6 y - 8 y + 5 u"), units={"y": "rad", "u": "A"}, m=256)


@pytest.fixture(scope="session")
def small_run(small_model):
    """513 noise-free samples of the small model under a square input of uneven length."""
    n = 513
    u = np.where(np.arange(n) % 160 < 90, 1.0, -0.6)
    empty = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": np.zeros(n)}, name="small")
    return small_model.simulate(empty, tolerance=1e-9)


@pytest.fixture(scope="session")
def reproduction():
    """The paper's section 5 on a coarse lattice, with few evaluations of the other optimizers and two arms."""
    return ftlm.reproduce(
        increment=0.25, genetic=ftlm.GeneticAlgorithm(seeds=(0, 1), evaluations=800), arms=["integer orders"], records=1
    )
