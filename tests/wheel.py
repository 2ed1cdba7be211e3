"""Checks what auditwheel says of a wheel: it claims the policy that it meets and needs nothing but the C library.

auditwheel show --json wheels/*.whl | python tests/wheel.py
"""

import json
import sys

#: The C library, its mathematics, and the compiler's run time: every Linux of a manylinux policy has them.
SYSTEM = {"libc.so.6", "libm.so.6", "libgcc_s.so.1"}


def faults(found):
    """What is wrong with a wheel, in words."""
    name, tag = found["wheel"], found["overall_tag"]
    claimed = name.removesuffix(".whl").rsplit("-", 1)[1].split(".")
    needed = set(found["versioned_symbols"]) | set(found["external_libs"])
    return [
        words
        for words, wrong in {
            f"it meets {tag}, which is no manylinux policy": not tag.startswith("manylinux_2_"),
            f"it claims {', '.join(claimed)} and meets {tag}": tag not in claimed,
            f"it needs {', '.join(sorted(needed - SYSTEM))}": needed - SYSTEM,
            f"outside the system it needs {', '.join(found['external_libs'])}": found["external_libs"],
            "it needs a newer processor than its tag says": found["unsupported_isa"],
            "it holds no extension": found["pure"],
        }.items()
        if wrong
    ]


if __name__ == "__main__":
    found = json.load(sys.stdin)
    wrong = faults(found)
    if wrong:
        sys.exit(f"{found['wheel']}: {'; '.join(wrong)}")
    print(f"{found['wheel']}: {found['overall_tag']}, needs {', '.join(sorted(found['versioned_symbols']))}")
