"""Checks what auditwheel says of a wheel: it claims the policy that it meets and needs nothing but the C library.

auditwheel show --json wheels/*.whl | python tests/wheel.py

With --holds, that it brings license and notices; with --nameless also that it names no folder of the machine where it
was made, as wheels for others must not.

python tests/wheel.py --holds wheels/*.whl
"""

import json
import os
import sys
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


if __name__ == "__main__":
    if sys.argv[1:2] in (["--holds"], ["--nameless"]):
        named = folders() if sys.argv[1] == "--nameless" else []
        sys.exit("\n".join(f"{path}: {words}" for path in sys.argv[2:] for words in lacks(path, named)) or None)
    found = json.load(sys.stdin)
    wrong = faults(found)
    if wrong:
        sys.exit(f"{found['wheel']}: {'; '.join(wrong)}")
    needed = found["versioned_symbols"] or found["external_libs"]
    print(f"{found['wheel']}: {met(found)[0]}, needs {', '.join(sorted(needed))}")
