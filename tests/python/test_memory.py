"""One limit of memory: asked of the machine or given, kept by a whole search, refused beyond it before allocation."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ftlm
from ftlm.errors import ModelError
from ftlm.estimation.output_error import fit_output_error
from ftlm.utils.resources import (
    DEFAULT_MEMORY_FRACTION,
    FALLBACK_MEMORY_BYTES,
    MEMORY_VARIABLE,
    available_memory,
    memory_limit,
)

REFUSED = re.compile(r"(\d+) regressors of all runs.* need (\d+) bytes, more than the limit of (\d+)")


def machine(folder, **files):
    """Files of a system, by their paths with __ for /."""
    for name, text in files.items():
        path = folder / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


MEMINFO = "MemTotal:       24000000 kB\nMemFree:  1 kB\nMemAvailable:   8000000 kB\n"
V2 = {
    "proc__self__cgroup": "0::/jobs/mine\n",
    "sys__fs__cgroup__jobs__mine__memory.max": "max\n",
    "sys__fs__cgroup__jobs__mine__memory.current": "7\n",
    "sys__fs__cgroup__jobs__memory.max": "3000000000\n",
    "sys__fs__cgroup__jobs__memory.current": "1000000000\n",
    "sys__fs__cgroup__jobs__memory.stat": "anon 5\ninactive_file 400000000\nfile 9\n",
}
V1 = {
    "proc__self__cgroup": "5:cpu,cpuacct:/other\n4:memory:/box\n",
    "sys__fs__cgroup__memory__memory.limit_in_bytes": "9223372036854771712\n",
    "sys__fs__cgroup__memory__memory.usage_in_bytes": "1\n",
    "sys__fs__cgroup__memory__box__memory.limit_in_bytes": "500000000\n",
    "sys__fs__cgroup__memory__box__memory.usage_in_bytes": "100000000\n",
}


@pytest.mark.parametrize(
    ("files", "left"),
    [
        ({"proc__meminfo": MEMINFO}, 8_000_000 << 10),
        ({"proc__meminfo": MEMINFO, **V2}, 2_400_000_000),
        ({"proc__meminfo": MEMINFO, **V1}, 400_000_000),
        ({"proc__meminfo": MEMINFO, "proc__self__cgroup": "nonsense\n1:memory\n0::/../..\n"}, 8_000_000 << 10),
        (dict(V1), 400_000_000),
        ({**V1, "sys__fs__cgroup__memory__box__memory.usage_in_bytes": "600000000\n"}, 1),
    ],
    ids=["kernel", "groups", "older groups", "strange groups", "groups alone", "beyond its limit"],
)
def test_a_machine_is_asked_what_it_has_left(tmp_path, monkeypatch, files, left):
    monkeypatch.delenv(MEMORY_VARIABLE, raising=False)
    system = machine(tmp_path, **files)
    assert available_memory(system) == left
    assert memory_limit(system) == int(DEFAULT_MEMORY_FRACTION * left)


def test_a_changed_limit_and_another_group_are_noticed(tmp_path, monkeypatch):
    system = machine(tmp_path, proc__meminfo=MEMINFO, **V2)
    assert available_memory(system) == 2_400_000_000
    machine(tmp_path, **{"sys__fs__cgroup__jobs__mine__memory.max": "1000\n"})
    assert available_memory(system) == 993
    machine(tmp_path, **{"sys__fs__cgroup__jobs__mine__memory.current": "500\n"})
    assert available_memory(system) == 500
    machine(tmp_path, proc__self__cgroup="0::/jobs\n")
    assert available_memory(system) == 2_400_000_000
    machine(tmp_path, **{"sys__fs__cgroup__memory.max": "70\n", "sys__fs__cgroup__memory.current": "9\n"})
    assert available_memory(system) == 61
    # Usage and cache of a group matter only if it has a limit.
    opened, plain = [], Path.open
    monkeypatch.setattr(Path, "open", lambda path, *a, **k: (opened.append(path.name), plain(path, *a, **k))[1])
    machine(tmp_path, **{"sys__fs__cgroup__memory.max": "max\n", "sys__fs__cgroup__jobs__memory.max": "max\n"})
    opened.clear()
    assert available_memory(system) == 8_000_000 << 10
    assert opened == ["meminfo", "cgroup", "memory.max", "memory.max"]


def test_a_machine_that_tells_nothing_gives_what_is_safe(tmp_path, monkeypatch):
    monkeypatch.delenv(MEMORY_VARIABLE, raising=False)
    assert available_memory(tmp_path) > 1 << 20
    monkeypatch.setattr("os.sysconf", lambda _: (_ for _ in ()).throw(ValueError), raising=False)
    assert available_memory(tmp_path) is None
    assert memory_limit(tmp_path) == FALLBACK_MEMORY_BYTES


def test_this_machine_answers():
    assert 1 << 20 < memory_limit() < 1 << 50


SIZES = {"1": 1, "12345": 12345, "3K": 3072, "2GiB": 2 << 30, "512M": 512 << 20, " 1T ": 1 << 40, "7MB": 7 << 20}


@pytest.mark.parametrize("text", SIZES)
def test_a_limit_that_is_given_counts(monkeypatch, text):
    monkeypatch.setenv(MEMORY_VARIABLE, text)
    assert memory_limit() == SIZES[text]


@pytest.mark.parametrize("text", ["0", "-1", "2 GiB", "much", "1e9", "nan", "٣", "9" * 18 + "T", "0x10"])
def test_a_limit_that_is_none_is_refused(monkeypatch, text):
    monkeypatch.setenv(MEMORY_VARIABLE, text)
    with pytest.raises(ModelError, match=r"FTLM_MEMORY=.* is not a memory size"):
        memory_limit()


def runs(count, length=200):
    rng = np.random.default_rng(0)
    t = np.arange(length) * 0.05
    made = []
    for k in range(count):
        u = np.sign(np.sin((1 + k) * t))
        y = ftlm.fractional_integral(u, 1.4, step=0.05) + 0.01 * rng.standard_normal(length)
        made.append(ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y}, step=0.05))
    return made


ONE = ftlm.equation("D^alpha y = a D^beta y + b u", initial="rest")
LAW = ftlm.flexible_link(form="published")
CASES = {
    "one equation": (ONE, {"coefficients": "least-squares"}),
    "by recursion": (ONE, {"coefficients": "multi-innovation"}),
    "by instruments": (ONE, {"coefficients": "instrumental-variables"}),
    "brute force": (ONE, {"coefficients": "least-squares", "pruning": False}),
}


def search(structure, runs, **options):
    lattice = (
        ftlm.order_grid(increment=0.1)
        if structure is ONE
        else ftlm.OrderGrid(increment=0.1, orders={"alpha": (1.9, 2.0)})
    )
    return ftlm.search_orders(runs, structure, lattice, m=64, top=5, **options)


def needed(monkeypatch, structure, runs, **options):
    """Columns and bytes that a search says it needs."""
    monkeypatch.setenv(MEMORY_VARIABLE, "1")
    with pytest.raises(ModelError) as refused:
        search(structure, runs, **options)
    assert "or raise the memory limit by FTLM_MEMORY" in str(refused.value)
    told = REFUSED.search(str(refused.value))
    return int(told[1]), int(told[2])


def ranking(found):
    """Rows of the table of a search."""
    return [line for line in str(found).splitlines() if re.match(r"\s*\d+\s", line)]


@pytest.mark.parametrize("case", CASES)
def test_the_border_is_exact_and_all_runs_count(monkeypatch, case):
    structure, options = CASES[case]
    of_one = runs(1)
    columns, one = needed(monkeypatch, structure, of_one, **options)
    same, three = needed(monkeypatch, structure, 3 * of_one, **options)
    assert columns == same
    # A bank of each run at least.
    assert three - one >= 2 * 8 * 64 * columns
    monkeypatch.setenv(MEMORY_VARIABLE, str(one))
    found = search(structure, of_one, **options)
    monkeypatch.setenv(MEMORY_VARIABLE, str(one - 1))
    with pytest.raises(ModelError, match=f"need {one} bytes, more than the limit of {one - 1}"):
        search(structure, of_one, **options)
    monkeypatch.delenv(MEMORY_VARIABLE)
    # Findings may differ: simulations of the best candidates are refined only as far as memory allows.
    assert ranking(found)
    assert ranking(search(structure, of_one, **options)) == ranking(found)


def test_a_layout_and_the_banks_of_all_its_equations_count_together(monkeypatch, plant, drive):
    run = plant("A").simulate(drive("A", samples=201), tolerance=1e-5)
    options = {"coefficients": "least-squares"}
    monkeypatch.setenv(MEMORY_VARIABLE, "1")
    with pytest.raises(ModelError, match="rows of the join of coupled equations need") as refused:
        search(LAW, [run], **options)
    layout = int(re.search(r"need (\d+) bytes", str(refused.value))[1])
    monkeypatch.setenv(MEMORY_VARIABLE, str(layout))
    search(LAW, [run], **options)
    with pytest.raises(ModelError) as refused:
        search(LAW, [run] * 300, **options)
    assert "and the join of coupled equations need" in str(refused.value)
    both = int(REFUSED.search(str(refused.value))[2])
    assert both > layout
    monkeypatch.setenv(MEMORY_VARIABLE, str(layout - 1))
    with pytest.raises(ModelError, match=f"rows of the join of coupled equations need {layout} bytes"):
        search(LAW, [run], **options)


PEAK_MEMORY = """
def peak_memory():
    # getrusage counts the peak of the parent process too; /proc counts this process only.
    with open("/proc/self/status") as status:
        return int(next(line for line in status if line.startswith("VmHWM")).split()[1])
"""
TOO_LARGE = (
    PEAK_MEMORY
    + """
import numpy as np, ftlm
run = ftlm.Run.from_arrays(inputs={"u": np.ones(65537)}, outputs={"y": np.arange(65537.0)}, step=0.05)
equation = ftlm.equation("D^alpha y = a D^beta y + b u", initial="rest")
before = peak_memory()
try:
    ftlm.search_orders(run, equation, ftlm.order_grid(increment=0.005), coefficients="least-squares", m=1 << 16)
except ftlm.ModelError as error:
    print(error)
print(peak_memory() - before)
"""
)


@pytest.mark.skipif(sys.platform != "linux", reason="peaks are counted in kB on Linux")
def test_what_is_too_large_is_refused_before_it_is_allocated(monkeypatch):
    monkeypatch.setenv(MEMORY_VARIABLE, "300M")
    done = subprocess.run([sys.executable, "-c", TOO_LARGE], capture_output=True, text=True, check=True, timeout=240)
    message, peak = done.stdout.splitlines()
    told = REFUSED.search(message)
    assert int(told[2]) > 400 << 20
    assert int(told[3]) == 300 << 20
    assert int(peak) << 10 < 60 << 20, "its regressors alone would take several times that"


LONG = (
    PEAK_MEMORY
    + """
import numpy as np, sys, ftlm
with np.load(sys.argv[1]) as kept:
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": kept["u"]}, outputs={"y": kept["y"]})
structure = ftlm.equation("D^alpha y = a y + b u")
ftlm.identify(run.window(0, 5), structure, threads=1)
before = peak_memory()
found = ftlm.identify(run, structure, threads=1)
print(found.orders["alpha"], peak_memory() - before)
"""
)


@pytest.mark.skipif(sys.platform != "linux", reason="peaks are counted in kB on Linux")
def test_a_long_record_is_fitted_in_little_memory(tmp_path):
    rng, samples = np.random.default_rng(0), 50_000
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 50), 50)
    blank = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": 0.0 * u})
    y = ftlm.Model(ftlm.equation("D^1.4 y = -4 y + 2 u")).simulate(blank, tolerance=1e-4)["y"]
    np.savez(tmp_path / "run.npz", u=u, y=y + 0.01 * np.std(y) * rng.standard_normal(samples))
    # Blocks go back to the system as they are freed: what counts is what is held at once, not what a heap keeps.
    heap = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "131072"}
    command = [sys.executable, "-c", LONG, str(tmp_path / "run.npz")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=240, env=heap)
    alpha, peak = map(float, done.stdout.split())
    assert alpha == pytest.approx(1.4, abs=1e-3)
    assert peak * 1024 < 150e6


HALF_MILLION = (
    PEAK_MEMORY
    + """
import numpy as np, sys, ftlm
from scipy.signal import cont2discrete, lfilter
rng, samples = np.random.default_rng(1), 500_000
u = np.repeat(rng.choice([-1.0, 1.0], samples // 20), 20)
b, a, _ = cont2discrete(([8.0, 144.0], [1.0, 1.2, 144.0]), 0.01)[:3]
y = lfilter(np.ravel(b), a, u) + 0.02 * rng.standard_normal(samples)
run = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": y})
before = peak_memory()
found = ftlm.identify(run, ftlm.equation(sys.argv[1] + " y = a1 D y + a0 y + b1 D u + b0 u"), threads=1)
print(found.values["a0"], peak_memory() - before)
"""
)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="peaks are counted in kB on Linux")
@pytest.mark.parametrize(("derivative", "limit"), [("D^2", 250e6), ("D^alpha", 310e6)])
def test_half_a_million_samples_are_fitted_in_little_memory(derivative, limit):
    command = [sys.executable, "-c", HALF_MILLION, derivative]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    stiffness, peak = map(float, done.stdout.split())
    assert stiffness == pytest.approx(-144, rel=0.01)
    assert peak * 1024 < limit


INTEGRATE = """
import resource
import numpy as np
from ftlm import kernels
def peak_memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
x = np.ones((10_000, 2048))
kernels.integrate(x[:64], 0.5, step=0.1)
before = peak_memory()
out = kernels.integrate(x, 0.5, step=0.1)
print(peak_memory() - before - out.nbytes)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="peaks are counted in kB on Linux")
def test_integrals_of_a_batch_need_little_more_than_their_result():
    done = subprocess.run([sys.executable, "-c", INTEGRATE], capture_output=True, text=True, check=True, timeout=240)
    # A byte a value is taken by the check that all are finite.
    assert int(done.stdout) < 10_000 * 2048 + 10e6


def long_run(rows):
    t = 0.1 * np.arange(rows)
    return ftlm.Run.from_arrays(step=0.1, inputs={"u": np.sin(t)}, outputs={"y": np.cos(t)}, name="long")


def test_a_simulation_asks_for_memory_before_it_takes_it(monkeypatch):
    monkeypatch.setenv("FTLM_MEMORY", "100K")
    with pytest.raises(ftlm.ModelError, match=r"the 10000 pulses of a simulation of run 'long' need .* FTLM_MEMORY"):
        ftlm.Model(ftlm.equation("D^0.7 y = -2 y + u")).simulate(long_run(5000))


def test_a_fit_asks_for_the_memory_of_its_grids(monkeypatch):
    structure, start = ftlm.equation("D^alpha y = a y + b u", initial="rest"), {"alpha": 0.7, "a": -2.0, "b": 1.0}
    monkeypatch.setenv("FTLM_MEMORY", "100K")
    with pytest.raises(ftlm.ModelError, match=r"grids of 1 pulses per sample of run 'long' need .* FTLM_MEMORY"):
        fit_output_error([long_run(5000)], structure, start=start)
