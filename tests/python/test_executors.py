"""Searches and identifications on threads, processes and a cluster: the same bytes as on one machine."""

import contextlib
import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

import ftlm
from ftlm.errors import ConvergenceError, DataError, ModelError
from ftlm.order_search import batches
from ftlm.utils.checkpoint_file import CheckpointFile
from slow_cases import slow_after
from stores import keep_share

EQUATION = "D^alpha y = a D^beta y + c D^mu y + b D^nu u"


@pytest.fixture(scope="module")
def run(small_run, with_noise):
    return with_noise(small_run, 0.003, 1)


def search(run, executor=None, *, order_grid=None, **options):
    options = {"m": 32, "pruning": False, **options}
    equation = ftlm.equation(EQUATION, initial="rest")
    return ftlm.search_orders(run, equation, order_grid or ftlm.order_grid(increment=0.1), executor=executor, **options)


def bytes_of(found):
    """Bytes of what a search finds; a store keeps no runs, so a resumed search has no verdict."""
    table = {n: v for n, v in found.to_dict().items() if n not in ("verdict", "findings")}
    return json.dumps(table) + str(found.model) + repr(found.failures)


@pytest.fixture(scope="module")
def expected(run):
    return bytes_of(search(run))


@pytest.fixture(autouse=True)
def forget():
    batches._cached_searches.clear()


@contextlib.contextmanager
def cluster(folder):
    """A scheduler and two workers of one thread, each a process of its own on the loopback address."""
    pytest.importorskip("distributed")
    from distributed import Client

    file = folder / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    environment = {**os.environ, "DASK_DISTRIBUTED__ADMIN__TICK__LIMIT": "1h"}
    call = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    processes = [subprocess.Popen([*call, "--no-dashboard", "--scheduler-file", str(file)], env=environment, **quiet)]
    try:
        for name in ("one", "two"):
            call = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(file), "--name", name]
            call += ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1"]
            call += ["--local-directory", str(folder), "--memory-limit", "0"]
            processes.append(subprocess.Popen(call, env=environment, **quiet))
        while not file.exists():
            assert processes[0].poll() is None
            time.sleep(0.05)
        with Client(scheduler_file=str(file), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)
            yield client, processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_threads_give_the_same_bytes(run, expected):
    with ThreadPoolExecutor(3) as pool:
        reports = []
        found = search(run, pool, progress=lambda done, total: reports.append((done, total)))
        assert bytes_of(found) == expected
        assert reports[-1] == (found.candidates, found.candidates)
        assert [d for d, _ in reports] == sorted(d for d, _ in reports)
        assert bytes_of(search(run, pool, threads=2)) == expected


@pytest.mark.parametrize(
    "options",
    [
        {"pruning": True},
        {"pruning": True, "criterion": "equation-error", "norm": "l2", "row_basis": "time"},
        {"coefficients": "least-squares", "norm": "l2", "top": 3},
        {"pruning": True, "coefficients": "instrumental-variables", "order_grid": ftlm.order_grid(increment=0.2)},
    ],
)
def test_every_kind_of_search_gives_the_same_bytes(run, options):
    with ThreadPoolExecutor(2) as pool:
        assert bytes_of(search(run, pool, **options)) == bytes_of(search(run, **options))


def test_spawned_processes_give_the_same_bytes_and_resume(run, expected, tmp_path):
    path = tmp_path / "s.ftlm"
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert bytes_of(search(run, pool)) == expected
        assert bytes_of(search(run, pool, store=path)) == expected
        keep_share(path, 0.5)
        assert not ftlm.search_status(path)["y"].complete
        assert bytes_of(ftlm.resume_search(path, executor=pool)["y"]) == expected
    assert bytes_of(ftlm.resume_search(path)["y"]) == expected


def test_a_broken_pool_is_an_error_in_words_and_loses_nothing_finished(run, expected, tmp_path):
    path = tmp_path / "s.ftlm"
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:

        def kill(done, total):
            for process in pool._processes.values():
                os.kill(process.pid, signal.SIGKILL)

        with pytest.raises(ConvergenceError, match=r"the executor lost its work .* start a new one"):
            search(run, pool, store=path, progress=kill)
    assert 0 < ftlm.search_status(path)["y"].done_count < 19_295
    assert bytes_of(search(run, store=path)) == expected


class Counting(Executor):
    """Runs tasks at once; counts them, and what they carry; fails some."""

    def __init__(self, *, fail=()):
        self.tasks, self.carried, self.fail = [], 0, set(fail)

    def submit(self, function, /, *args, **options):
        future = Future()
        _, *task = args  # after the function that the worker calls
        self.tasks.append(task)
        self.carried += task[1] is not None
        if len(self.tasks) in self.fail:
            future.set_exception(OSError("the network is down"))
        else:
            future.set_result(function(*args, **options))
        return future


def test_the_record_is_sent_once_a_worker_and_tasks_are_ranges(run, expected):
    pool = Counting()
    assert bytes_of(search(run, pool)) == expected
    assert pool.carried == 1
    key, _, first, last, seed, start, threads = pool.tasks[-1]
    assert (len(key), last > first, start, threads) == (32, True, None, 1)
    assert all(isinstance(i, int) and isinstance(s, float) for i, s in seed)
    assert len(seed) <= 20
    ranges = sorted((task[2], task[3]) for task in pool.tasks)
    assert {end for _, end in ranges} >= {1, 3, 5}


def test_a_task_that_fails_is_sent_again_and_given_up_after_the_third(run, expected):
    assert bytes_of(search(run, Counting(fail={2, 4}))) == expected
    with pytest.raises(ConvergenceError, match="the network is down"):
        search(run, Counting(fail=range(2, 50)))


def test_a_worker_keeps_few_searches_ready(run):
    with ThreadPoolExecutor(1) as pool:
        for m in (16, 32, 64):
            search(run, pool, m=m)
    assert len(batches._cached_searches) == batches.MAX_CACHED_SEARCHES


def test_an_error_of_the_search_is_the_one_of_one_machine(run):
    with ThreadPoolExecutor(2) as pool:
        for here in (None, pool):
            with pytest.raises(ModelError, match=r"order 0\.7 of u is above alpha = 0\.5"):
                search(
                    run, here, order_grid=ftlm.OrderGrid(orders={"alpha": [0.5], "nu": [0.7], "beta": [0.1], "mu": [0]})
                )


def test_an_executor_that_is_closed_is_said(run):
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    with pytest.raises(ConvergenceError, match="lost its work"):
        search(run, pool)


# ----------------------------------------------------------------------------------------------------------------------
# A stage under its order law


@pytest.fixture(scope="module")
def stage_run(plant, drive, with_noise):
    return with_noise(plant("A").simulate(drive("A", samples=301), tolerance=1e-5), 1e-5, 3)


def search_stage(run, executor=None, **options):
    order_grid = ftlm.OrderGrid(increment=0.1, orders={"alpha": (1.8, 2.0)})
    options = {"m": 64, "top": 8, "coefficients": "least-squares", **options}
    return ftlm.search_orders(run, ftlm.flexible_link(form="published"), order_grid, executor=executor, **options)


@pytest.fixture(scope="module")
def stage_expected(stage_run):
    return bytes_of(search_stage(stage_run))


def test_threads_give_the_same_bytes_of_a_stage(stage_run, stage_expected):
    reports = []
    with ThreadPoolExecutor(3) as pool:
        found = search_stage(stage_run, pool, progress=lambda *done: reports.append(done))
        assert bytes_of(search_stage(stage_run, pool, threads=2)) == stage_expected
    assert bytes_of(found) == stage_expected
    assert reports[-1][0] == reports[-1][1]
    assert [d for d, _ in reports] == sorted(d for d, _ in reports)


def test_spawned_processes_give_the_same_bytes_of_a_stage_and_resume(stage_run, stage_expected, tmp_path):
    path = tmp_path / "s.ftlm"
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert bytes_of(search_stage(stage_run, pool, store=path)) == stage_expected
        keep_share(path, 0.5)
        assert not ftlm.search_status(path)["stage"].complete
        assert bytes_of(ftlm.resume_search(path, executor=pool)["stage"]) == stage_expected
    assert bytes_of(ftlm.resume_search(path)["stage"]) == stage_expected


@pytest.mark.parametrize("laws", [(), ("orders", "coefficients")])
def test_an_identification_by_the_lattice_shares_its_searches_out(stage_run, laws):
    structure = ftlm.flexible_link(form="published", laws=laws, coupling="measured")
    method = ftlm.LeastSquares(order_grid=ftlm.OrderGrid(increment=0.3, alpha=(1.8, 2.0)), top=5)
    with ThreadPoolExecutor(2) as pool:
        found = ftlm.identify(stage_run, structure, method=replace(method, executor=pool), m=64)
    alone = ftlm.identify(stage_run, structure, method=method, m=64)
    assert json.dumps(found.to_dict()) == json.dumps(alone.to_dict())


def test_of_a_stage_the_record_is_sent_once_and_tasks_are_ranges(stage_run, stage_expected):
    pool = Counting(fail={3})
    assert bytes_of(search_stage(stage_run, pool)) == stage_expected
    assert pool.carried == 1
    spans = [span for _, _, some, _ in pool.tasks for span in some]
    assert all(
        first < last and (equation, len(span)) in {(0, 4), (1, 4)}
        for span in spans
        for equation, first, last, _ in [span]
    )
    assert len(pickle.dumps(pool.tasks[-1])) < 10_000
    with pytest.raises(ConvergenceError, match="the network is down"):
        search_stage(stage_run, Counting(fail=range(2, 50)))


# ----------------------------------------------------------------------------------------------------------------------
# A cluster


def killed_half_way(run, folder, **options):
    """A search on two workers, one killed half-way: seconds until the next part came, and the result."""
    with cluster(folder) as (client, workers):
        times = {}

        def report_progress(done, total):
            now = time.monotonic()
            times.setdefault("first", now)
            if "killed" in times:
                times.setdefault("next", now)
            elif 2 * done >= total:
                os.kill(workers[1].pid, signal.SIGKILL)
                times["killed"] = time.monotonic()
            times["last"] = now

        found = search(run, client.get_executor(), progress=report_progress, **options)
        assert workers[1].wait(timeout=60) == -signal.SIGKILL
    return times, found


def test_a_cluster_that_loses_a_worker_gives_the_same_bytes(run, expected, tmp_path):
    times, found = killed_half_way(run, tmp_path)
    assert "killed" in times
    assert bytes_of(found) == expected


def test_a_cluster_gives_the_same_bytes_of_a_stage(stage_run, stage_expected, tmp_path):
    with cluster(tmp_path) as (client, _):
        assert bytes_of(search_stage(stage_run, client.get_executor())) == stage_expected
        # The client itself is none, whose futures have other methods.
        with pytest.raises(
            ftlm.ModelError, match=r"Client.*is not an executor .*; pass .*Client\(…\)\.get_executor\(\)"
        ):
            search_stage(stage_run, client)


@pytest.mark.slow
def test_ten_million_candidates_on_a_cluster_that_loses_a_worker(run, tmp_path):
    options = {"order_grid": ftlm.order_grid(increment=0.0205), "m": 256, "pruning": True}
    began = time.monotonic()
    whole = search(run, **options, threads=2)
    alone = time.monotonic() - began
    assert whole.candidates > 10**7
    times, found = killed_half_way(run, tmp_path, **options)
    assert bytes_of(found) == bytes_of(whole)
    before, after = times["killed"] - times["first"], times["last"] - times["killed"]
    print(
        f"\n{found.candidates} candidates; one machine, two threads: {alone:.1f} s; two workers until one was killed "
        f"half-way: {before:.1f} s, one worker from there: {after:.1f} s; next part "
        f"{times['next'] - times['killed']:.2f} s"
        " after the kill"
    )


# ----------------------------------------------------------------------------------------------------------------------
# Many runs


def test_many_runs_are_identified_and_one_that_fails_does_not_stop_the_rest(small_run, with_noise):
    structure = ftlm.equation("D^1.6 y = a D^0.6 y + c y + b u")
    runs = [with_noise(small_run, 0.003, seed) for seed in range(3)]
    other = ftlm.Run.from_arrays(step=0.02, inputs={"v": runs[0]["u"]}, outputs={"y": runs[0]["y"]}, name="other")
    items = [runs[0], other, [runs[1], runs[2]]]
    options = {"method": "least-squares", "m": 256}
    reports = []
    here = ftlm.identify_many(items, structure, progress=lambda *done: reports.append(done), **options)
    assert reports == [(1, 3), (2, 3), (3, 3)]
    assert [i.error is None for i in here] == [True, False, True]
    assert isinstance(here[1].error, DataError)
    assert "'u'" in str(here[1])
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        reports.clear()
        there = ftlm.identify_many(items, structure, executor=pool, progress=lambda *d: reports.append(d), **options)
    assert reports == [(1, 3), (2, 3), (3, 3)]
    assert [str(i) for i in there] == [str(i) for i in here]
    assert there[0].result.model.coefficients == ftlm.identify(runs[0], structure, **options).model.coefficients
    assert here[2].name == ", ".join(r.name for r in runs[1:])


def test_an_executor_that_fails_is_the_error_of_each_run(small_run):
    structure = ftlm.equation("D^1.6 y = a D^0.6 y + c y + b u")
    pool = ThreadPoolExecutor(1)
    pool.shutdown()
    found = ftlm.identify_many([small_run, small_run], structure, executor=pool, method="least-squares")
    assert [type(i.error) for i in found] == [ConvergenceError] * 2


@pytest.mark.parametrize("runs", [[], [1], [[]], ["run"]])
def test_what_is_no_run_is_refused(runs):
    with pytest.raises(ModelError, match="run"):
        ftlm.identify_many(runs, ftlm.equation("D^1.6 y = a y + b u"))


#: A search with a store on workers of a method; the first report writes their process numbers.
SEARCH_ON_WORKERS = """
import multiprocessing, os, sys
from concurrent.futures import ProcessPoolExecutor
import numpy as np
import ftlm

def report(done, total):
    if done > 0 and not os.path.exists("pids"):
        open("new", "w").write(" ".join(str(p.pid) for p in multiprocessing.active_children()))
        os.rename("new", "pids")

if __name__ == "__main__":
    t = np.arange(2049) * 0.02
    u = np.sign(np.sin(1.3 * t))
    run = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": ftlm.fractional_integral(u, 1.4, step=0.02)}, step=0.02)
    equation = ftlm.equation("D^alpha y = a D^beta y + c D^mu y + b D^nu u", initial="rest")
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context(sys.argv[1])) as pool:
        ftlm.search_orders(
            run, equation, ftlm.order_grid(increment=0.02), m=1024, executor=pool, store="a.ftlm", progress=report)
"""


def is_running(process):
    try:
        return (Path("/proc") / str(process) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@slow_after(1, "method", ["fork", "spawn"])
def test_a_killed_search_leaves_neither_a_lock_nor_workers(tmp_path, method):
    (tmp_path / "search.py").write_text(SEARCH_ON_WORKERS)
    words = [sys.executable, "-W", "ignore", "search.py", method]
    with subprocess.Popen(words, cwd=tmp_path, stderr=subprocess.DEVNULL) as process:
        until = time.monotonic() + 120
        while not (tmp_path / "pids").exists():
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.05)
        process.kill()
    # In the moment of the kill, while the workers may live.
    CheckpointFile(tmp_path / "a.ftlm", "search", "resume").close()
    workers = [int(word) for word in (tmp_path / "pids").read_text().split()]
    assert workers
    try:
        until = time.monotonic() + 120
        while any(map(is_running, workers)):
            assert time.monotonic() < until, "workers outlive their search"
            time.sleep(0.05)
    finally:
        for worker in filter(is_running, workers):
            os.kill(worker, signal.SIGKILL)
