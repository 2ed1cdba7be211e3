"""Attacks ftlm from outside for some minutes, and prints how often and how often it broke.

Everything happens in a temporary folder, in processes with bounded memory and time; nothing is fetched. A crash, a
panic, a hang, an error without words, another answer or a live motor counts as broken, and is told in full.
"""

import argparse
import ast
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
STUB = HERE.parent / "python" / "ftlm" / "_core.pyi"
#: Longest call, and what Ctrl-C may take of its own processor time [s].
HANG, STOP = 5.0, 0.5
BATCH = 250
MEMORY = 4 << 30

# ----------------------------------------------------------------------------------------------------------------------
# Calls of every entry of the extension, with arguments that are nearly right or wild; this part runs in a child.


def entries():
    """(class or None, name, annotations of the arguments) of everything that can be called in the extension."""
    tree = ast.parse(STUB.read_text())
    aliases = {n.target.id: n.value for n in tree.body if isinstance(n, ast.AnnAssign) and n.value is not None}
    found = []
    for node in tree.body:
        own = node.name if isinstance(node, ast.ClassDef) else None
        for item in node.body if own else [node]:
            if isinstance(item, ast.FunctionDef) and item.name != "panic_on_purpose":
                skip = 1 if own else 0
                arguments = [(a.arg, a.annotation) for a in item.args.args[skip:]]
                if not any(isinstance(d, ast.Name) and d.id == "property" for d in item.decorator_list):
                    found.append((own, item.name, arguments))
    return aliases, found


class Values:
    """Values for annotations."""

    def __init__(self, seed, aliases):
        self.random, self.aliases = random.Random(seed), aliases
        self.wild = 0.15

    def number(self):
        r = self.random
        wild = [float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e308, 5e-324, 1e-300, -1e300, 1e16]
        return r.choice(wild) if r.random() < self.wild else round(r.uniform(0, 2.5), 3)

    def whole(self):
        r = self.random
        # Sizes between a million and what is refused are work, not an attack.
        wild = [-1, 0, 1 << 20, (1 << 31) - 1, 1 << 31, 1 << 40, 1 << 62, (1 << 63) - 1, 1 << 64]
        return r.choice(wild) if r.random() < self.wild else r.randrange(0, 9)

    def array(self, dimensions=None):
        import numpy as np

        r = self.random
        dimensions = dimensions or r.choice([1, 2, 2])
        shape = [
            r.choice([0, 1, 2, 3, 8, 33]) if r.random() < self.wild else r.choice([2, 3]) for _ in range(dimensions)
        ]
        shape[-1] = shape[-1] if r.random() < self.wild else 33
        values = np.random.default_rng(r.randrange(1 << 30)).standard_normal(shape)
        if r.random() < self.wild and values.size:
            values.flat[r.randrange(values.size)] = self.number()
        if r.random() < self.wild:
            values = r.choice(
                [values.astype(np.float32), values[..., ::2], values.T, np.asfortranarray(values), None, "x"]
            )
        return values

    def of(self, note):
        r = self.random
        if isinstance(note, ast.BinOp):
            return self.of(r.choice([note.left, note.right]))
        if isinstance(note, ast.Constant):
            return note.value
        if isinstance(note, ast.Name):
            simple = {
                "float": self.number, "int": self.whole, "bool": lambda: r.random() < 0.5, "Any": self.number,
                "bytes": lambda: r.randbytes(9), "str": self.word, "Guard": lambda: None, "object": lambda: None,
                "_Floats": self.array, "_Vector": lambda: self.array(1), "_Matrix": lambda: self.array(2),
            }  # fmt: skip
            return simple[note.id]() if note.id in simple else self.of(self.aliases[note.id])
        kind = note.value.id
        inner = note.slice.elts if isinstance(note.slice, ast.Tuple) else [note.slice]
        if kind == "Callable":
            return lambda *_: ((0.0, 0.0), True)
        if kind in ("Mapping", "dict"):
            return {k: self.number() for k in ("step", "slew")}
        if kind == "Literal":
            return self.of(r.choice(inner))
        if kind == "tuple":
            return tuple(self.of(part) for part in inner)
        count = r.choice([0, 1, 2, 3, 5]) if r.random() < 2 * self.wild else 2
        return [self.of(inner[0]) for _ in range(count)]

    def word(self):
        known = (
            "block-pulse", "trapezoidal", "grunwald-letnikov", "caputo", "riemann-liouville", "output-error", "l1",
            "l2", "equation-error", "linear", "log", "delay", "dead encoder", "", "\0", "x" * 9999,
        )  # fmt: skip
        return self.random.choice(known)


def guard_settings(values):
    from ftlm import rig

    return rig.Limits(late=values.number(), slew=(values.number(), 500.0)).guard(0.002)


def call_batch(seed, count):
    """Runs calls, each announced before it; a panic ends the batch with a word."""
    from ftlm import _core, rig

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    aliases, all_entries = entries()
    values = Values(seed, aliases)
    made = {"Guard": guard_settings, "VirtualArm": lambda _: rig.ArmParameters.of("linear").arm(0.002, 1.0)}
    objects = {}
    for index in range(count):
        own, name, arguments = values.random.choice(all_entries)
        given = [values.of(note) for _, note in arguments]
        print(f"{index} {own or ''}.{name}", flush=True)
        try:
            if own is None:
                getattr(_core, name)(*given)
            elif name == "__new__":
                objects[own] = getattr(_core, own)(*given)
            else:
                if own not in objects:
                    objects[own] = (
                        made[own](values)
                        if own in made
                        else getattr(_core, own)(
                            *[
                                values.of(note)
                                for o, n, args in all_entries
                                if (o, n) == (own, "__new__")
                                for _, note in args
                            ]
                        )
                    )
                given = [made["Guard"](values) if isinstance(note, ast.Name) and note.id == "Guard" else g
                         for g, (_, note) in zip(given, arguments, strict=True)]  # fmt: skip
                getattr(objects[own], name)(*given)
            print("ANSWERED", flush=True)
        except Exception as error:
            if type(error).__name__ == "InternalError":
                print(f"PANIC {error}", flush=True)
        except BaseException as error:
            print(f"PANIC {type(error).__name__} {error}", flush=True)


def calls(table, count, folder):
    tried, names, answered = 0, set(), set()
    answers = 0
    for seed in range(-(-count // BATCH)):
        with (folder / "errors").open("w") as errors:
            command = [sys.executable, __file__, "--batch", str(seed)]
            child = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=errors)
        # The clock starts anew at every announcement.
        last, at, buffer = "", time.monotonic(), ""
        os.set_blocking(child.stdout.fileno(), False)
        while True:
            got = child.stdout.read()
            if got:
                at, buffer = time.monotonic(), buffer + got.decode()
                *lines, buffer = buffer.split("\n")
                for line in lines:
                    if line.startswith("PANIC"):
                        table.broken("calls of the extension", f"batch {seed}: {last}: {line}")
                    elif line == "ANSWERED":
                        answers += 1
                        answered.add(last.partition(" ")[2])
                    else:
                        last, tried = line, tried + 1
                        names.add(last.partition(" ")[2])
            elif child.poll() is not None:
                break
            elif time.monotonic() - at > HANG + (10 if not last else 0):
                child.kill()
                table.broken("calls of the extension", f"batch {seed}: {last} took more than {HANG} s")
                break
            else:
                time.sleep(0.005)
        if child.wait() not in (0, -9):
            table.broken("calls of the extension", f"batch {seed}: {last} ended the process with {child.returncode}")
    table.tried("calls of the extension", tried)
    # Refused arguments alone would prove little.
    table.notes.append(f"{answers} calls of {len(answered)} of {len(names)} entries were answered, the others refused")
    table.notes += [f"never answered: {', '.join(sorted(names - answered))}"] if names - answered else []


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
    found = ftlm.search_orders(run, equation, ftlm.lattice(step=0.1), store=store, m=32)
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
    run, equation, ftlm.lattice(step={step}), store={store!r}, m=64, early_stopping=False, threads=2
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
    ("output-error", "l1", 0, 1e6, False, 20, 2, True, 0, 1 << 31), None)
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
call = lambda: ftlm.search_orders(run, equation, ftlm.lattice(step=0.01))
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
    table.notes += [f"{what}: at most {cpu:.2f} s of processor time, {wall:.2f} s of the clock, from Ctrl-C to its end"
                    for what, (cpu, wall) in worst.items()]  # fmt: skip


# ----------------------------------------------------------------------------------------------------------------------
# The rig


def way_out(table):
    import pytest

    sys.path.insert(0, str(HERE / "python"))
    import test_way_out as rig

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


class Table:
    """What was tried and what broke."""

    def __init__(self):
        self.counts, self.breaks, self.notes = {}, {}, []

    def tried(self, what, count):
        self.counts[what] = count
        print(f"{what}: {count} tried, {len(self.breaks.get(what, []))} broken", file=sys.stderr, flush=True)

    def broken(self, what, how):
        self.breaks.setdefault(what, []).append(how)

    def __str__(self):
        rows = [f"| {what} | {count} | {len(self.breaks.get(what, []))} |" for what, count in self.counts.items()]
        told = [f"- {what}: {how}" for what, hows in self.breaks.items() for how in hows[:10]]
        return "\n".join(["| attack | tried | broken |", "| --- | --- | --- |", *rows, "", *self.notes, *told])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=20_000, help="calls of the extension")
    parser.add_argument("--files", type=int, default=1_000, help="damaged files of each kind, a twentieth of parquet")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--batch", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.batch is not None:
        call_batch(given.batch, BATCH)
        return
    table = Table()
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="ftlm-attack-") as name:
        folder = Path(name)
        os.environ |= {"HOME": name, "TMPDIR": name}
        os.chdir(folder)
        way_out(table)
        outputs(table, folder)
        files(table, folder, given.files)
        presses(table, folder)
        kills(table, folder, given.kills)
        calls(table, given.calls, folder)
        os.chdir("/")
    print(f"{table}\n{time.monotonic() - began:.0f} s")
    sys.exit(1 if table.breaks else 0)


if __name__ == "__main__":
    main()
