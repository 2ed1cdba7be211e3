"""Writes notices and bill of materials of all crates that the extension links, on any platform; ``--check`` compares.

python tests/notices.py [--check]
"""

import argparse
import json
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FILE = ROOT / "THIRD-PARTY-NOTICES.txt"
#: maturin's own bill names the folder that it was made in.
BILL = ROOT / "ftlm.cdx.json"
HEAD = """The compiled part of ftlm links the Rust crates below, and the standard library of Rust (its project,
MIT OR Apache-2.0, whose texts are below, too). Crates that only build or test ftlm are not in it. Written by
tests/notices.py from Cargo.lock and the crates' own files.
"""
#: How files with terms begin.
TERMS = ("license", "licence", "copying", "notice", "copyright", "unlicense")


def linked(metadata):
    """Packages that end up in the extension: normal dependencies of it or of these, but no macros of the compiler."""
    packages = {package["id"]: package for package in metadata["packages"]}
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    root = metadata["resolve"]["root"]
    seen, open_ = set(), [root]
    while open_:
        here = open_.pop()
        kinds = {kind for target in packages[here]["targets"] for kind in target["kind"]}
        if here in seen or "proc-macro" in kinds:
            continue
        seen.add(here)
        for dependency in nodes[here]["deps"]:
            if any(kind["kind"] is None for kind in dependency["dep_kinds"]):
                open_.append(dependency["pkg"])
    return sorted((packages[i] for i in seen - {root}), key=lambda p: (p["name"], p["version"]))


def terms(package):
    """Texts of the files with a package's terms, by name."""
    folder = Path(package["manifest_path"]).parent
    files = [p for p in sorted(folder.iterdir()) if p.is_file() and p.name.lower().startswith(TERMS)]
    return {p.name: p.read_text(encoding="utf-8", errors="replace").strip().replace("\r\n", "\n") for p in files}


def notices(metadata):
    """The notices, each text once; refuse a crate that says nothing of its terms."""
    texts, crates = {}, []
    for package in linked(metadata):
        if not package["license"]:
            raise SystemExit(f"{package['name']} {package['version']} names no license; look into its source")
        numbers = [str(texts.setdefault(text, len(texts) + 1)) for text in terms(package).values()]
        where = f"text {', '.join(numbers)}" if numbers else "no text of its own"
        by = f"; {', '.join(a.split(' <')[0] for a in package['authors'])}" if package["authors"] else ""
        crates.append(f"{package['name']} {package['version']}: {package['license']} ({where}){by}")
    parts = [HEAD, *crates]
    for text, number in texts.items():
        parts += ["", "-" * 80, f"Text {number}", "", text]
    return "\n".join(parts) + "\n"


def bill(metadata, lock):
    """What is linked, as CycloneDX has it: nothing in it depends on where or when it was written."""
    checksums = {(p["name"], p["version"]): p.get("checksum") for p in lock["package"]}
    packages = {package["id"]: package for package in metadata["packages"]}
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    root, crates = packages[metadata["resolve"]["root"]], linked(metadata)
    within = {package["id"] for package in crates}

    def reference(package):
        return f"pkg:cargo/{package['name']}@{package['version']}"

    def component(package):
        checksum = checksums[package["name"], package["version"]]
        return {
            "type": "library",
            "bom-ref": reference(package),
            "name": package["name"],
            "version": package["version"],
            **({"hashes": [{"alg": "SHA-256", "content": checksum}]} if checksum else {}),
            "licenses": [{"expression": package["license"].replace("/", " OR ")}],
            "purl": reference(package),
        }

    def needed(package):
        linked_in = [d["pkg"] for d in nodes[package["id"]]["deps"] if any(k["kind"] is None for k in d["dep_kinds"])]
        return sorted(reference(packages[i]) for i in linked_in if i in within)

    whole = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": component(root)},
        "components": [component(package) for package in crates],
        "dependencies": [{"ref": reference(p), "dependsOn": needed(p)} for p in (root, *crates)],
    }
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true")
    given = parser.parse_args()
    call = ["cargo", "metadata", "--format-version", "1", "--locked", "--features", "python"]
    got = subprocess.run(call, cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout
    metadata, lock = json.loads(got), tomllib.loads((ROOT / "Cargo.lock").read_text(encoding="utf-8"))
    for file, made in ((FILE, notices(metadata)), (BILL, bill(metadata, lock))):
        if not given.check:
            file.write_text(made, encoding="utf-8")
        elif file.read_text(encoding="utf-8") != made:
            sys.exit(f"{file.name} is not that of Cargo.lock; run python tests/notices.py")


if __name__ == "__main__":
    main()
