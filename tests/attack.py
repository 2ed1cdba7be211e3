"""Attacks ftlm from outside for some minutes, and prints how often and how often it broke.

Everything happens in a temporary folder, in processes with bounded memory and time; nothing is fetched. A crash, a
panic, a hang, an error without words, another answer or a live motor counts as broken, and is told in full.
"""

import argparse
import hashlib
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

# Threads of BLAS that wait for one another on a busy machine take seconds of processor time. Read when NumPy loads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

HERE = Path(__file__).resolve().parent
#: Longest call, and what Ctrl-C may take of its own processor time [s].
HANG, STOP = 5.0, 0.5
#: So many times longer a call may be silent that has not had that much of a processor: it may wait for others' work.
PATIENCE = 30
#: Calls of each entry that a child makes; half a second goes by before its first.
BATCH = 200
MEMORY = 4 << 30

# ----------------------------------------------------------------------------------------------------------------------
# Calls of every entry of the extension; each batch is made in a child.

CALLS = "calls of the extension"
#: Refusals in words; whatever else is raised breaks the promise.
WORDS = {
    "DataError",
    "ModelError",
    "ConvergenceError",
    "TypeError",
    "ValueError",
    "OverflowError",
    "MemoryError",
    "KeyError",
    "UnicodeEncodeError",
}
#: What hostile callbacks raise, and what a flag that is set is for.
ASKED_FOR = {"OursError", "KeyboardInterrupt"}


def call_batch(seed, count, only, show):
    """Calls each entry, announced before and judged after; what hangs or ends the process is the last announced.

    With `show`, the announcement has the arguments.
    """
    import extension_calls

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sound = extension_calls.Sound(seed)
    names = only or extension_calls.entries()
    if show:
        extension_calls.np.set_printoptions(threshold=20)
    for _ in range(count):
        for name in names:
            call, given, named = sound.call(name)
            kept = sound.random.random() < extension_calls.SOUND
            if not kept:
                try:
                    given, named = extension_calls.attacked(name, given, named, sound.random)
                except (MemoryError, ValueError):
                    # The attacker's own: no memory, or a shape that NumPy cannot iterate over.
                    continue
            os.write(1, f"{name} {f'{given} {named}' if show else ''}\n".encode(errors="backslashreplace"))
            try:
                call(*given, **named)
                told = "sound" if kept else "answered"
            except BaseException as error:
                told = type(error).__name__
                # An object may remember a hostile call, and no estimator solves whatever noise there may be.
                faulty = kept and told != "ConvergenceError" and ("." not in name or name.endswith("__new__"))
                if told not in WORDS | ASKED_FOR or faulty or (not str(error) and told in WORDS):
                    told = f"{told}: {' '.join(str(error).split())[:300]}: {given!r:.2000} {named}".replace("\n", " ")
            os.write(1, f"={told}\n".encode(errors="backslashreplace"))


def spent(child):
    """Processor time of a process [s]; infinite where the system does not tell it."""
    try:
        return time.clock_gettime((~child.pid << 3) | 2)
    except (AttributeError, OSError):
        return float("inf")


def waited(child):
    """Time that threads of a process were ready and others had the processors [s]; 0 where nothing tells it."""
    try:
        told = [task.read_text() for task in Path(f"/proc/{child.pid}/task").glob("*/schedstat")]
        return 1e-9 * sum(int(text.split()[1]) for text in told)
    except (OSError, IndexError, ValueError):
        return 0.0


def lines_of(command, folder, hang):
    """Lines that a child writes, then in words how it ended if that was no good end.

    It is ended by silence of `hang` s of its own processor time, and by a longer one in which it could have had one.
    """
    with (
        (folder / "errors").open("w") as errors,
        subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=errors) as child,
    ):
        started, at, used, starved, buffer = False, time.monotonic(), spent(child), 0.0, b""
        os.set_blocking(child.stdout.fileno(), False)
        while True:
            got = child.stdout.read()
            if got:
                started, at, used, starved = True, time.monotonic(), spent(child), waited(child)
                *lines, buffer = (buffer + got).split(b"\n")
                for line in lines:
                    yield line.decode()
            elif child.poll() is not None:
                break
            # Python and NumPy are imported before the first line.
            elif (silent := time.monotonic() - at - (0 if started else 20)) > hang and (
                silent - (waited(child) - starved) > PATIENCE * hang or not spent(child) - used <= hang
            ):
                child.kill()
                yield f"!took more than {hang:g} s"
                return
            else:
                time.sleep(0.002)
    if child.returncode:
        words = (folder / "errors").read_text(errors="replace").strip()[-200:]
        yield f"!ended the process with {child.returncode}: {words}"


def calls(table, count, folder, only=(), hang=HANG, counts=None, until=float("inf")):
    """So many calls of each entry, or those before a Ctrl-C; the table gets their sum and a line for each.

    A file of counts gets a line a batch, and what it has is not called again; no batch begins after `until`, a time of
    the monotonic clock.
    """
    done = {} if counts is None else counted_before(counts)
    try:
        for batch in range(-(-count // BATCH)):
            size = min(BATCH, count - batch * BATCH)
            if batch in done and done[batch]["size"] >= size:
                continue
            if time.monotonic() > until:
                table.notes.append(f"{CALLS}: time is up before batch {batch} of {-(-count // BATCH)}")
                break
            done[batch] = {"core": core(), "batch": batch, "size": size, "calls": {}, "broken": []}
            make_batch(table, done[batch], folder, only, hang)
            if counts is not None:
                with counts.open("a") as file:
                    file.write(json.dumps(done[batch]) + "\n")
    except KeyboardInterrupt:
        table.notes.append(f"{CALLS}: interrupted")
    kinds = {}
    records = [done[batch] for batch in sorted(done)]
    for record in records:
        for name, counted in record["calls"].items():
            kinds.setdefault(name, Counter()).update(counted)
    table.breaks |= {CALLS: told} if (told := [how for r in records for how in r["broken"]]) else {}
    table.tried(CALLS, sum(counted["calls"] for counted in kinds.values()))
    # Refused arguments alone would prove little.
    table.calls = kinds


def core():
    """What tells one build of the extension from another."""
    from ftlm import _core

    return hashlib.sha256(Path(_core.__file__).read_bytes()).hexdigest()[:16]


def counted_before(path):
    """Batches in a file of counts by their number, the larger of two; a line that a kill cut off is none."""
    text = path.read_text() if path.exists() else ""
    if text and not text.endswith("\n"):
        text = text[: text.rfind("\n") + 1]
        path.write_text(text)
    records = [json.loads(line) for line in text.splitlines()]
    if any(r["core"] != core() for r in records):
        sys.exit(f"{path} has counts of another build of the extension; name another file")
    return {r["batch"]: r for r in sorted(records, key=lambda r: r["size"])}


def make_batch(table, record, folder, only, hang):
    """Make the calls of a batch, counted in its record as they come back."""
    batch, kinds = record["batch"], record["calls"]
    command = [sys.executable, __file__, "--batch", str(batch), "--size", str(record["size"]), "--only", ",".join(only)]
    last = "nothing yet"

    def broken(how):
        record["broken"].append(how)
        table.broken(CALLS, how)

    for line in lines_of(command, folder, hang):
        if line[:1] == "!":
            broken(f"batch {batch}: {last} {line[1:]}")
        elif line[:1] != "=":
            last = line.strip()
            kinds.setdefault(last, Counter())["calls"] += 1
        else:
            kind = line[1:].partition(":")[0]
            kinds[last][kind] += 1
            if ":" in line:
                broken(f"batch {batch}: {last}: {line[1:]}")


def table_of_calls(kinds):
    """Rows of a table: entry, calls, answers to sound and to hostile arguments, refusals by kind of error."""
    shown = ("calls", "sound", "answered")
    others = sorted({kind for counted in kinds.values() for kind in counted} - set(shown))
    head = ["entry", "calls", "sound, answered", "hostile, answered", *others]
    rows = [[name, *(str(counted[kind] or "") for kind in (*shown, *others))] for name, counted in kinds.items()]
    total = ["all", *(str(sum(counted[kind] for counted in kinds.values())) for kind in (*shown, *others))]
    never = [name for name, counted in kinds.items() if not counted["answered"]]
    told = f"{len(never)} of {len(kinds)} entries answered no hostile call{': ' if never else ''}{', '.join(never)}."
    return "\n".join(["| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows, total)] + ["", told])


# ----------------------------------------------------------------------------------------------------------------------
# Files


def sample_run():
    import numpy as np

    import ftlm

    t = np.arange(80) * 0.05
    u = np.sign(np.sin(3 * t))
    return ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": np.cumsum(u) * 0.05}, step=0.05)


def same(one, other):
    import numpy as np

    return one.length == other.length and all(np.array_equal(one[n], other[n]) for n in one.signals)


def damaged(whole, r):
    """Flipped, cut, doubled or overwritten somewhere."""
    at = r.randrange(len(whole))
    how = r.randrange(4)
    if how == 0:
        return whole[:at] + bytes([whole[at] ^ (1 << r.randrange(8))]) + whole[at + 1 :]
    if how == 1:
        return whole[:at]
    if how == 2:
        return whole[:at] + whole[at // 2 :]
    return whole[:at] + r.randbytes(r.randrange(1, 20)) + whole[at + 1 :]


def files(table, folder, counts):
    import ftlm

    run = sample_run()
    r = random.Random(1)
    equation = ftlm.equation("D^alpha y = c y + b u", initial="rest")
    store = folder / "whole.ftlm"
    found = ftlm.search_orders(run, equation, ftlm.order_grid(increment=0.1), store=store, m=32)
    run.to_csv(folder / "whole.csv")
    found.model.save(folder / "whole.json")
    kinds = {
        "damaged csv": ("csv", counts, ftlm.load, None),
        "damaged models": ("json", counts, ftlm.load_model, None),
        "damaged stores": ("ftlm", counts, ftlm.resume_search, lambda got: str(got) == str_of_store),
    }
    str_of_store = str(ftlm.resume_search(store))
    try:
        import pyarrow  # noqa: F401

        run.to_parquet(folder / "whole.parquet")
        kinds["damaged parquet"] = ("parquet", counts // 20, ftlm.load, lambda got: same(got, run))
    except ImportError:
        pass
    for what, (suffix, count, read, right) in kinds.items():
        whole = (folder / f"whole.{suffix}").read_bytes()
        for k in range(count):
            path = folder / f"damaged.{suffix}"
            content = damaged(whole, r)
            path.write_bytes(content)
            try:
                got = read(path)
            except ftlm.FtlmError as error:
                if isinstance(error, ftlm.InternalError):
                    table.broken(what, f"{k}: {error}")
            except Exception as error:
                table.broken(what, f"{k}: {type(error).__name__}: {error}")
            else:
                if right is not None and content != whole and not right(got):
                    table.broken(what, f"{k}: another answer")
            (folder / f"damaged.{suffix}.damaged").unlink(missing_ok=True)
        table.tried(what, count)


def outputs(table, folder):
    """What must not be overwritten, whatever is asked."""
    import ftlm

    run = sample_run()
    pipe, link, plain = folder / "pipe", folder / "link", folder / "aim"
    os.mkfifo(pipe)
    plain.write_text("mine")
    link.symlink_to(plain)
    for path in (pipe, link, Path("/dev/full"), folder):
        before = path.lstat()
        try:
            run.to_csv(path, force=True)
            table.broken("outputs that are no files", f"{path} was written")
        except ftlm.DataError:
            pass
        if path.lstat().st_ino != before.st_ino or plain.read_text() != "mine":
            table.broken("outputs that are no files", f"{path} is another one")
    table.tried("outputs that are no files", 4)


# ----------------------------------------------------------------------------------------------------------------------
# Kills and Ctrl-C

SEARCH = """
import sys
sys.path.insert(0, {here!r})
import attack, ftlm
run = attack.sample_run()
equation = ftlm.equation("D^alpha y = a D^beta y + c D^mu y + b u", initial="rest")
found = ftlm.search_orders(
    run, equation, ftlm.order_grid(increment={step}), store={store!r}, m=64, pruning=False, threads=2
)
print(found)
"""


def kills(table, folder, count):
    r = random.Random(2)

    def script(store, step=0.03):
        return [sys.executable, "-c", SEARCH.format(here=str(HERE), store=str(folder / store), step=step)]

    began = time.monotonic()
    right = subprocess.run(script("right.ftlm"), capture_output=True, text=True, check=False, cwd=folder).stdout
    took = time.monotonic() - began
    for k in range(count):
        name = f"killed{k}.ftlm"
        child = subprocess.Popen(script(name), cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(r.uniform(0.1, 1.0) * took)
        child.kill()
        child.wait()
        done = subprocess.run(script(name), capture_output=True, text=True, check=False, cwd=folder)
        if done.stdout != right:
            table.broken("searches killed and resumed", f"{k}: {done.stderr[-300:] or 'another table'}")
    table.tried("searches killed and resumed", count)


LONG = {
    "order-law search": """
ax = lambda lo, hi: np.linspace(lo, hi, 800).tolist()
law = lambda *w: (0.0, list(w))
laws = [(0, law(1., 0., 0.), [(0, law(0., 1., 0.)), (2, law(0., 0., 1.))]),
        (1, law(0., 1., 1.), [(1, law(0., .5, .1)), (2, law(0., .3, .1))])]
call = lambda: _core.search_stage([(0.01, rng.standard_normal((3, 2000)), None)], [ax(1.05, 2), ax(.1, 1), ax(.1, 1)],
    laws, [False, False, True], [[None] * 2] * 2, [1., 1.], (True, []),
    {"criterion": "output-error", "norm": "l1", "innovation_length": 0, "prior_covariance": 1e6, "haar_rows": False,
     "top": 20, "threads": 2, "pruning": True, "iterations": 0, "memory": 1 << 31}, None)
""",
    "integral of 2^23 samples": """
x = rng.standard_normal(1 << 23)
call = lambda: ftlm.fractional_integral(x, 0.5, step=0.1)
""",
    "derivative of 2^23 samples": """
x = rng.standard_normal(1 << 23)
call = lambda: ftlm.fractional_derivative(x, 0.5, step=0.1)
""",
    "search of one equation": """
run = ftlm.Run.from_arrays(inputs={"u": rng.standard_normal(2000)}, outputs={"y": rng.standard_normal(2000)}, step=0.01)
equation = ftlm.equation("D^alpha y = a D^beta y + c D^mu y + b u", initial="rest")
call = lambda: ftlm.search_orders(run, equation, ftlm.order_grid(increment=0.01))
""",
    "identification": """
run = ftlm.Run.from_arrays(inputs={"u": rng.standard_normal(4000)}, outputs={"y": rng.standard_normal(4000)}, step=0.01)
call = lambda: ftlm.identify(run, ftlm.equation("D^alpha y = a D^beta y + c y + b u"))
""",
}
PRESSED = """
import os, signal, sys, threading, time
import numpy as np
import ftlm
from ftlm import _core
signal.signal(signal.SIGINT, signal.default_int_handler)
rng = np.random.default_rng(0)
{set_up}
told = []
def press():
    time.sleep({after})
    told.append((time.process_time(), time.perf_counter()))
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=press, daemon=True).start()
try:
    while True:
        call()
except KeyboardInterrupt:
    print(time.process_time() - told[0][0], time.perf_counter() - told[0][1])
"""


def presses(table, folder):
    worst = {}
    for what, set_up in LONG.items():
        for after in (0.2, 0.7, 1.5):
            script = PRESSED.format(set_up=set_up, after=after)
            command = [sys.executable, "-c", script]
            done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, timeout=120)
            if done.returncode or not done.stdout:
                table.broken("Ctrl-C in long calls", f"{what} after {after} s: {done.stderr[-300:]}")
                continue
            cpu, wall = map(float, done.stdout.split())
            worst[what] = max(worst.get(what, (0.0, 0.0)), (cpu, wall))
            if cpu > STOP:
                table.broken("Ctrl-C in long calls", f"{what} after {after} s took {cpu:.2f} s of its processor time")
    table.tried("Ctrl-C in long calls", 3 * len(LONG))
    table.notes += [
        f"{what}: at most {cpu:.2f} s of processor time, {wall:.2f} s of the clock, from Ctrl-C to its end"
        for what, (cpu, wall) in worst.items()
    ]


# ----------------------------------------------------------------------------------------------------------------------
# The rig


def way_out(table):
    import pytest

    sys.path.insert(0, str(HERE / "python"))
    import test_shutdown as rig

    for failing in (*rig.PAIRS, *rig.TRIPLES):
        for raises in (False, True):
            with pytest.MonkeyPatch.context() as patch:
                try:
                    rig.check_failing(patch, failing, raises)
                except AssertionError as error:
                    table.broken("way out with failing calls", f"{failing} {raises}: {error}")
    table.tried("way out with failing calls", 2 * len(rig.PAIRS + rig.TRIPLES))
    tried = 0
    for number in rig.SIGNALS:
        for raises in (False, True):
            with pytest.MonkeyPatch.context() as patch:
                try:
                    tried += rig.check_lines(patch, number, raises, 1)
                except AssertionError as error:
                    table.broken("signals in every line of the way out", f"{number} {raises}: {error}")
    table.tried("signals in every line of the way out", tried)


def loops(table, count):
    """Controllers, shapers and a rig's loop with bad arguments."""
    import unchecked_calls

    for name, wrong in unchecked_calls.calls(random.Random(2), count):
        if wrong is not None:
            table.broken("calls of control and a rig's loop", f"{name}: {wrong}")
    table.tried("calls of control and a rig's loop", count)


def odd_arguments(table):
    """Every public function and method with an odd value for each argument."""
    import matplotlib as mpl

    mpl.use("agg")
    import public_calls

    tried = 0
    for name, parameter, word, wrong in public_calls.calls():
        tried += 1
        if wrong is not None:
            table.broken("odd arguments of public functions", f"{name}({parameter}={word}): {wrong}")
    table.tried("odd arguments of public functions", tried)


class Table:
    """What was tried and what broke."""

    def __init__(self):
        self.counts, self.breaks, self.notes, self.calls = {}, {}, [], {}

    def tried(self, what, count):
        self.counts[what] = count
        print(f"{what}: {count} tried, {len(self.breaks.get(what, []))} broken", file=sys.stderr, flush=True)

    def broken(self, what, how):
        self.breaks.setdefault(what, []).append(how)
        print(f"{what} broken: {how[:500]}", file=sys.stderr, flush=True)

    def __str__(self):
        rows = [f"| {what} | {count} | {len(self.breaks.get(what, []))} |" for what, count in self.counts.items()]
        told = [f"- {what}: {how}" for what, hows in self.breaks.items() for how in hows[:10]]
        calls = ["", table_of_calls(self.calls)] if self.calls else []
        return "\n".join(["| attack | tried | broken |", "| --- | --- | --- |", *rows, "", *self.notes, *told, *calls])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=1_300, help="calls of each entry of the extension")
    parser.add_argument("--files", type=int, default=1_000, help="damaged files of each kind, calls of control")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--only-calls", action="store_true", help="nothing but calls of the extension")
    parser.add_argument("--only", default="", help="entries of the extension to call, with commas between")
    parser.add_argument("--counts", type=Path, help="file that keeps counts of these calls, and where they go on")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="no more of these calls after so many")
    parser.add_argument("--batch", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--show", action="store_true", help="with --batch and --size: the arguments of each call")
    parser.add_argument("--size", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    only = [name for name in given.only.split(",") if name]
    if given.batch is not None:
        call_batch(given.batch, given.size, only, given.show)
        return
    if given.counts is not None:
        if only:
            parser.error("--counts is of every entry; leave --only out")
        # What is damaged or of another build is said before anything is attacked.
        given.counts = given.counts.resolve()
        counted_before(given.counts)
    table = Table()
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="ftlm-attack-") as name:
        folder = Path(name)
        os.environ |= {"HOME": name, "TMPDIR": name}
        os.chdir(folder)
        if not given.only_calls:
            way_out(table)
            loops(table, given.files)
            odd_arguments(table)
            outputs(table, folder)
            files(table, folder, given.files)
            presses(table, folder)
            kills(table, folder, given.kills)
        until = time.monotonic() + 60 * given.minutes
        calls(table, given.calls, folder, only, counts=given.counts, until=until)
        os.chdir("/")
    print(f"{table}\n{time.monotonic() - began:.0f} s")
    sys.exit(1 if table.breaks else 0)


if __name__ == "__main__":
    main()
