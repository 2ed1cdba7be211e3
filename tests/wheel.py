"""Checks what auditwheel says of a wheel: it claims the policy that it meets and needs nothing but the C library.

auditwheel show --json wheels/*.whl | python tests/wheel.py

With --holds, that it brings license and notices; with --nameless also that it names no folder of the machine where it
was made, as wheels for others must not.

python tests/wheel.py --holds wheels/*.whl

With --floors it prints the lowest versions that ftlm promises to work with, as requirements; with --commands it runs
commands of the ftlm of its Python in the working folder, every reader and plot among them.
"""

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

#: The C library with its parts of old, and the compiler's run time: every Linux of a manylinux policy has them.
SYSTEM = {
    "libc.so.6",
    "libm.so.6",
    "libdl.so.2",
    "libpthread.so.0",
    "librt.so.1",
    "libgcc_s.so.1",
    "ld-linux-x86-64.so.2",
    "ld-linux-aarch64.so.1",
}


#: The whole C library of a Linux of a musllinux policy.
MUSL = {"libc.so"}


def met(found):
    """The policy that a wheel meets, and libraries that it needs from outside."""
    outside = set(found["external_libs"])
    if "musllinux" in found["wheel"] and outside <= MUSL:
        # A machine without musl does not have its C library, so that only symbols tell.
        return found["sym_tag"], set()
    return found["overall_tag"], outside


def faults(found):
    """What is wrong with a wheel, in words."""
    name, (tag, outside) = found["wheel"], met(found)
    claimed = name.removesuffix(".whl").rsplit("-", 1)[1].split(".")
    needed = set(found["versioned_symbols"]) | outside
    return [
        words
        for words, wrong in {
            f"it meets {tag}, which is no policy of manylinux or musllinux": not tag.startswith(
                ("manylinux_2_", "musllinux_1_")
            ),
            f"it claims {', '.join(claimed)} and meets {tag}": tag not in claimed,
            f"it needs {', '.join(sorted(needed - SYSTEM))}": needed - SYSTEM,
            f"outside the system it needs {', '.join(sorted(outside))}": outside,
            "it needs a newer processor than its tag says": found["unsupported_isa"],
            "it holds no extension": found["pure"],
        }.items()
        if wrong
    ]


#: What every wheel brings beside its code.
TERMS = ("LICENSE", "THIRD-PARTY-NOTICES.txt", "ftlm.cdx.json")


def folders():
    """Folders of this machine that a wheel must not name."""
    return [
        str(folder) for folder in (Path.home(), Path.cwd(), *map(Path, filter(None, [os.environ.get("CARGO_HOME")])))
    ]


def lacks(path, folders):
    """What is wrong with what a wheel holds, in words."""
    with zipfile.ZipFile(path) as wheel:
        files = {name: wheel.read(name) for name in wheel.namelist()}
    ends = {name.rsplit("/", 1)[-1] for name in files}
    told = [f"it lacks {name}" for name in TERMS if name not in ends]
    told += [
        f"{name} names {folder}"
        for name, content in files.items()
        for folder in folders
        if len(folder) > 1 and f"{folder}/".encode() in content
    ]
    return told


#: Extras of those who change ftlm; what they install is pinned.
TOOLS = {"docs", "test"}


def floors(project):
    """Requirements of the lowest versions in a [project] table."""
    extras = project["optional-dependencies"]
    asked = {*project["dependencies"], *(each for name in extras.keys() - TOOLS for each in extras[name])}
    return sorted(each.replace(">=", "==") for each in asked)


#: Writes a run of a small model in every format whose library has a floor.
RUNS = """
import distributed, h5py, numpy as np, scipy.io, starlette, uvicorn, ftlm, ftlm.sklearn
u = np.where(np.arange(401) % 160 < 90, 1.0, -0.6)
model = ftlm.Model(ftlm.equation("D^1.6 y = -3 D^0.6 y - 8 y + 5 u"))
run = model.simulate(ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": 0 * u}))
table = {"t": run.time, "u": run["u"], "y": run["y"]}
run.to_csv("run.csv"), run.to_parquet("run.parquet"), scipy.io.savemat("run.mat", table)
with h5py.File("run.h5", "w") as file:
    for name, values in table.items():
        file[name] = values
"""
EQUATION = "D^alpha y = a1 D^nu y + a0 y + b0 u"
COMMANDS = [
    ["--help"],
    ["identify", "--help-all"],
    ["doctor"],
    *(["inspect", f"run.{ending}", "-u", "u", "-y", "y"] for ending in ("csv", "parquet", "mat", "h5")),
    ["identify", "run.csv", "--structure", EQUATION, "-o", "model.json", "--report", "report.html", "--force"],
    ["identify", "run.csv", "--structure", EQUATION, "--method", "genetic", "--evaluations", "400"],
    ["compare", "model.json", "run.csv"],
    ["plot", "model.json", "--kind", "bode", "-o", "bode.png", "--force"],
    ["export", "model.json", "--to", "control", "--band", "0.1:100", "-o", "model.py", "--force"],
    ["demo", "--increment", "0.25", "-o", "demo", "--force"],
]


def run_commands():
    """Fails with the words of the first command that fails."""
    for words in (["-c", RUNS], *(["-m", "ftlm", *words] for words in COMMANDS)):
        ended = subprocess.run([sys.executable, "-W", "ignore", *words], capture_output=True, text=True, check=False)
        if ended.returncode:
            sys.exit(f"{' '.join(words)}: exit {ended.returncode}\n{ended.stdout}{ended.stderr}")


if __name__ == "__main__":
    if sys.argv[1:] == ["--floors"]:
        print("\n".join(floors(tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"])))
        sys.exit()
    if sys.argv[1:] == ["--commands"]:
        run_commands()
        sys.exit()
    if sys.argv[1:2] in (["--holds"], ["--nameless"]):
        named = folders() if sys.argv[1] == "--nameless" else []
        sys.exit("\n".join(f"{path}: {words}" for path in sys.argv[2:] for words in lacks(path, named)) or None)
    found = json.load(sys.stdin)
    wrong = faults(found)
    if wrong:
        sys.exit(f"{found['wheel']}: {'; '.join(wrong)}")
    needed = found["versioned_symbols"] or found["external_libs"]
    print(f"{found['wheel']}: {met(found)[0]}, needs {', '.join(sorted(needed))}")
