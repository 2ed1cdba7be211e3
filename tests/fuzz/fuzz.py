"""Fuzzes what reads other people's data: `python tests/fuzz/fuzz.py [target …] --seconds 60`.

Mutations are seeded, so a run can be repeated. With `--atheris` (Linux; pip install atheris) libFuzzer chooses them by
the lines that they reach; inputs that reach new ones are kept in the folder given with `--corpus`. An input that ends
in anything but a result or an FtlmError is written to tests/fuzz/regressions and the exit code is 1: fix it, keep the
file.
"""

import argparse
import hashlib
import random
import sys
import time
import warnings
from pathlib import Path

HERE = Path(__file__).resolve().parent
REGRESSIONS = HERE / "regressions"
sys.path.insert(0, str(HERE))

#: Pieces that parsers treat in their own way.
WORDS = [
    b"\0",
    b"\n",
    b"\r",
    b",",
    b";",
    b"\t",
    b'"',
    b"'",
    b"{",
    b"}",
    b"[",
    b"]",
    b"(",
    b")",
    b"^",
    b"D^",
    b"=",
    b":",
    b"-",
    b"+",
    b"*",
    b"/",
    b".",
    b"e",
    b"nan",
    b"NaN",
    b"inf",
    b"-inf",
    b"1e308",
    b"1e309",
    b"5e-324",
    b"-0",
    b"0x1",
    b"99999999999999999999",
    b"-1",
    b"0",
    b"1",
    b"null",
    b"true",
    b"\xff\xfe",
    b"\xef\xbb\xbf",
    "ä∂²".encode(),
    b"\xc3",
    b"\x80\x00\x00\x00",
    b"\xff\xff\xff\xff",
    b"\x00\x00\x00\x00\x00\x00\xf0\x7f",
    b"__import__('os')",
    b"alpha",
    b"y",
    b"lambda:0",
    b"a" * 300,
    b"(" * 200,
    b"1" * 400,
    b"[" * 2000,
]


def mutate(choose, seeds):
    """One input: a good one with some of it changed."""
    data = bytearray(choose.choice(seeds))
    for _ in range(1 << choose.randrange(5)):
        at = choose.randrange(len(data) + 1)
        kind = choose.randrange(8)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << choose.randrange(8)
        elif kind == 1 and at < len(data):
            data[at] = choose.randrange(256)
        elif kind == 2:
            del data[at : at + choose.choice((1, 2, 4, 8, 30))]
        elif kind == 3:
            data[at:at] = choose.choice(WORDS)
        elif kind == 4:
            word = choose.choice(WORDS)
            data[at : at + len(word)] = word
        elif kind == 5:
            end = at + choose.choice((1, 4, 16, 60))
            data[at:at] = data[at:end] * choose.choice((1, 2, 9))
        elif kind == 6:
            del data[at:]
        else:
            other = choose.choice(seeds)
            start = choose.randrange(len(other) + 1)
            data[at:at] = other[start : start + choose.choice((4, 20, 100))]
        if len(data) > 1 << 18:
            del data[1 << 18 :]
    return bytes(data)


def fault(target, data):
    """What an input ends in that it must not end in, or None."""
    import ftlm
    from targets import TARGETS

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            TARGETS[target](data)
    except ftlm.InternalError as error:
        return error
    except ftlm.FtlmError:
        return None
    except Exception as error:
        return error
    return None


def keep(target, data):
    """Write an input that found a fault to the regressions."""
    folder = REGRESSIONS / target
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / hashlib.sha256(data).hexdigest()[:12]
    path.write_bytes(data)
    return path


def fuzz(target, *, seed=0, inputs=None, seconds=None):
    """Try mutations: how many, and the faults found by what they are."""
    from targets import seeds

    choose = random.Random(f"{target} {seed}")
    good = seeds(target)
    for data in good:
        error = fault(target, data)
        if error is not None:
            raise AssertionError(f"the seed of {target} is refused") from error
    tried, faults, end = 0, {}, None if seconds is None else time.monotonic() + seconds
    while (inputs is None or tried < inputs) and (end is None or time.monotonic() < end):
        data = mutate(choose, good)
        tried += 1
        error = fault(target, data)
        if error is not None:
            trace = error.__traceback__
            while trace.tb_next is not None:
                trace = trace.tb_next
            where = f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"
            faults.setdefault(f"{type(error).__name__} at {where}: {error}"[:200], data)
    return tried, faults


def guided(target, seconds, corpus):
    """Let libFuzzer choose."""
    import atheris

    with atheris.instrument_imports(include=["ftlm"]):
        import targets

    folder = Path(corpus) / target
    folder.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(targets.seeds(target)):
        (folder / f"seed{number}").write_bytes(data)

    def one(data):
        error = fault(target, data)
        if error is not None:
            print("kept:", keep(target, data))
            raise error

    atheris.Setup(
        [sys.argv[0], f"-max_total_time={seconds}", "-max_len=8192", "-print_final_stats=1", str(folder)], one
    )
    atheris.Fuzz()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*")
    parser.add_argument("--seconds", type=int, default=60, help="for each target")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--atheris", action="store_true")
    parser.add_argument("--corpus", default="fuzz-corpus")
    asked = parser.parse_args()
    if asked.atheris:
        (target,) = asked.targets
        guided(target, asked.seconds, asked.corpus)
        return 0
    from targets import TARGETS

    bad = 0
    for target in asked.targets or TARGETS:
        tried, faults = fuzz(target, seed=asked.seed, seconds=asked.seconds)
        bad += len(faults)
        print(f"{target}: {tried} inputs, {len(faults)} faults", flush=True)
        for what, data in faults.items():
            print(f"  {what}\n  kept: {keep(target, data)}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
