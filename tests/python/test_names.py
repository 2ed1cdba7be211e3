"""Names and first sentences of the source: no bare participle, no one-word constant, no tiny module."""

import ast
import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PYTHON = sorted((ROOT / "python").rglob("*.py"))
RUST = sorted((ROOT / "rust").rglob("*.rs"))

#: Participles without -ed or -ing that have stood as names, and adverbs.
IRREGULAR = frozenset(
    """
    told held made built drawn driven begun left kept found given known seen shown taken written chosen lost
    laid met said sent spent slid bent done brought bought fallen torn unknown unread unseen untold won broken
    struck stuck swept dealt meant sold paid heard led fed apart abreast afterwards again ahead alike along
    already alone aside away beforehand behind below beside between beyond elsewhere enough here instead
    lastly late later most much near nearby never now often once others rather since then there together
    twice whence within whole
    """.split()  # noqa: SIM905 — read as words, not as a column of literals
)
#: Participles with which no description begins.
FIRST_WORDS = IRREGULAR & {
    "told",
    "held",
    "made",
    "built",
    "drawn",
    "given",
    "found",
    "kept",
    "taken",
    "known",
    "left",
    "seen",
}
#: Nouns and verbs that end as participles and adverbs do.
NOUNS = frozenset(
    """
    embed encoding spelling breed shed weed indeed learning family
    seed speed need feed string ring spring sampling damping spacing timing warning setting settings meaning
    heading padding mapping logging reading testing rounding bearing ceiling filling opening coupling scaling
    smoothing weighting plotting recording streaming indexing ordering loading screening pruning reply apply only
    multiply family assembly thing king hundred feedback
    """.split()  # noqa: SIM905 — read as words, not as a column of literals
)
#: Boolean properties, and names that an interface of a library or of the core dictates.
ALLOWED = {
    "fixed",
    "Finding",
    "failed",
    "passed",
    "trusted",
    # A model, as sorted(…) is a list.
    "linearized",
}


def words_of(name):
    """Words of a name in snake_case, CamelCase or UPPER_CASE."""
    return [w.lower() for w in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z0-9]+", name.strip("_"))]


def is_bare_participle(name):
    """Whether a name is one participle or adverb."""
    words = words_of(name)
    if len(words) != 1 or name.startswith("__") or words[0] in NOUNS:
        return False
    return words[0] in IRREGULAR or re.fullmatch(r"[a-z]{2,}ed|[a-z]{3,}(?:ing|ly)", words[0]) is not None


def begins_badly(text):
    """Whether a description begins with What, with a participle, or with Whether what."""
    first = re.match(r"\W*([A-Za-z'-]+)(?:\s+([A-Za-z'-]+))?", text)
    if first is None:
        return False
    word = first[1].lower()
    if first[1] == "What" or (word == "whether" and (first[2] or "").lower() == "what"):
        return True
    return word not in NOUNS and (word in FIRST_WORDS or re.fullmatch(r"[a-z]{2,}ed", word) is not None)


def is_one_word_constant(name):
    """Whether a module constant says neither its unit nor what it limits."""
    return name.isupper() and len(words_of(name)) == 1 and len(name) > 1


def python_findings(path):
    """Violations of one Python file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    for node in ast.walk(tree):
        if isinstance(node, kinds) and is_bare_participle(node.name) and node.name not in ALLOWED:
            yield f"{path.name}:{node.lineno}: {node.name} is a bare participle or adverb"
        if isinstance(node, ast.Module | kinds) and begins_badly(text := ast.get_docstring(node) or ""):
            yield f"{path.name}: a docstring begins badly: {text.splitlines()[0]}"
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names = [n.id for t in targets if t is not None for n in ast.walk(t) if isinstance(n, ast.Name)]
        if isinstance(node, ast.Assign | ast.AnnAssign):
            yield from (f"{path.name}:{node.lineno}: {n} is one word" for n in names if is_one_word_constant(n))


def rust_findings(path):
    """Violations of one Rust file."""
    text = path.read_text(encoding="utf-8")
    for item in re.finditer(
        r"^\s*(?:pub(?:\([a-z: ]+\))? )?(?:const |async )*(?:fn|struct|enum|trait) (\w+)", text, re.M
    ):
        if is_bare_participle(item[1]) and item[1] not in ALLOWED:
            yield f"{path.name}: {item[1]} is a bare participle or adverb"
    for item in re.finditer(r"^(?:pub(?:\([a-z: ]+\))? )?(?:const|static) ([A-Z][A-Z0-9_]*)\s*:", text, re.M):
        if is_one_word_constant(item[1]):
            yield f"{path.name}: {item[1]} is one word"
    for item in re.finditer(r"((?:^[ \t]*//[/!] ?.*\n)+)", text, re.M):
        if begins_badly(re.sub(r"^[ \t]*//[/!] ?", "", item[1].split("\n")[0])):
            yield f"{path.name}: a comment begins badly: {item[1].strip()[:80]}"


def test_names_and_first_sentences_of_python():
    assert [found for path in PYTHON for found in python_findings(path)] == []


def test_names_and_first_sentences_of_rust():
    assert [found for path in RUST for found in rust_findings(path)] == []


def test_the_formatter_wraps_every_line():
    marks = re.compile(r"#\s*fmt:\s*(?:skip|off)")
    own = Path(__file__).name
    files = [*PYTHON, *(p for p in (ROOT / "tests").rglob("*.py") if p.name != own)]
    assert [path.name for path in files if marks.search(path.read_text(encoding="utf-8"))] == []


def test_no_small_module_serves_one_other_alone():
    users = defaultdict(set)
    names = {".".join(p.relative_to(ROOT / "python").with_suffix("").parts): p for p in PYTHON if p.stem != "__init__"}
    for path in PYTHON:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                for name in (node.module or "", *(f"{node.module}.{a.name}" for a in node.names)):
                    if names.get(name, path) != path:
                        users[name].add(path)
    small = {n for n, p in names.items() if len(p.read_text(encoding="utf-8").splitlines()) < 80}
    assert {name for name in small if len(users[name]) == 1} == set()


def test_violations_are_found(tmp_path):
    (tmp_path / "a.py").write_text(
        '"""What it is."""\n\nMOST = 3\n\n\ndef told():\n    pass\n\n\ndef holds():\n    """Held."""\n'
    )
    (tmp_path / "a.rs").write_text("//! What it is.\nconst MOST: f64 = 1.0;\n\npub fn held() {}\n")
    assert len(list(python_findings(tmp_path / "a.py"))) == 4
    assert len(list(rust_findings(tmp_path / "a.rs"))) == 3
