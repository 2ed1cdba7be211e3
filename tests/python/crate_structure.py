"""Structure of the crate read from its source: module tree, uses between files, circles, entries of the bindings.

Every function takes a root folder, so that it can be tried on a small tree in which one rule is broken.
"""

import re


def circles(graph):
    """Sets of nodes that reach each other (Tarjan's strongly connected components), each in order."""
    number, low, stack, components = {}, {}, [], []

    def visit(node):
        number[node] = low[node] = len(number)
        stack.append(node)
        for other in graph.get(node, ()):
            if other not in number:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], number[other])
        if low[node] == number[node]:
            members = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(members) > 1 or node in graph.get(node, ()):
                components.append(sorted(members))

    for node in graph:
        if node not in number:
            visit(node)
    return sorted(components)


TOKEN = re.compile(
    r"""(?P<line>//[^\n]*)|(?P<block>/\*)|(?P<raw>\bb?r(?P<hashes>\#*)")|(?P<string>b?"(?:\\.|[^"\\])*")
    |(?P<char>b?'(?:\\(?:x[0-9a-fA-F]{2}|u\{[0-9a-fA-F_]+\}|.)|[^'\\\n])')""",
    re.VERBOSE | re.DOTALL,
)


def bare(text):
    """Rust source without comments and without what stands in its strings and characters; lines stay."""
    out, at = [], 0
    while (token := TOKEN.search(text, at)) is not None:
        out.append(text[at : token.start()])
        end = token.end()
        if token["block"]:
            depth = 1
            while depth and (mark := re.compile(r"/\*|\*/").search(text, end)) is not None:
                depth += 1 if mark[0] == "/*" else -1
                end = mark.end()
            end = len(text) if depth else end
        elif token["raw"]:
            close = text.find('"' + token["hashes"], end)
            end = len(text) if close < 0 else close + 1 + len(token["hashes"])
        out.append('""' if token["raw"] or token["string"] else "' '" if token["char"] else " ")
        out.append("\n" * text.count("\n", token.start(), end))
        at = end
    return "".join(out) + text[at:]


def closing(text, at, pair="{}"):
    """Place of the bracket that closes the one at a place."""
    depth = 0
    for place in range(at, len(text)):
        depth += (text[place] == pair[0]) - (text[place] == pair[1])
        if depth == 0:
            return place
    return len(text)


def without_tests(code):
    """Code without what is compiled for tests only."""
    while (mark := re.search(r"#\[cfg\(test\)\]", code)) is not None:
        body = re.compile(r"[{;]").search(code, mark.end())
        end = len(code) if body is None else closing(code, body.start()) + 1 if body[0] == "{" else body.end()
        code = code[: mark.start()] + "\n" * code.count("\n", mark.start(), end) + code[end:]
    return code


def use_tree(text):
    """Paths of a use declaration with the name each is known by: ``a::{self, b::C as D}`` and so on."""
    brace = text.find("{")
    if brace < 0:
        path, _, alias = re.sub(r"\s+as\s+", " as ", text.strip()).partition(" as ")
        names = tuple(part.strip() for part in path.split("::") if part.strip())
        return [(names, alias or names[-1])]
    prefix = tuple(part.strip() for part in text[:brace].split("::") if part.strip())
    inside, depth, start, uses = text[brace + 1 : text.rindex("}")] + ",", 0, 0, []
    for at, letter in enumerate(inside):
        depth += (letter == "{") - (letter == "}")
        if letter != "," or depth:
            continue
        for path, alias in use_tree(inside[start:at]) if inside[start:at].strip() else ():
            # In braces `self` is what stands before them.
            whole = prefix + path[: -1 if path[-1] == "self" else None]
            uses.append((whole, whole[-1] if alias == "self" else alias))
        start = at + 1
    return uses


class Crate:
    """The module tree of a crate: what each file says, declares, brings into scope and mentions."""

    def __init__(self, root):
        self.root = root
        self.code, self.scope, self.uses, self.mentions = {}, {}, {}, {}
        self.paths = {}
        for path in sorted(root.rglob("*.rs")):
            parts = path.relative_to(root).with_suffix("").parts
            module = parts[:-1] if parts[-1] in ("mod", "lib") else parts
            self.paths[module] = path
            self.code[module] = without_tests(bare(path.read_text(encoding="utf-8")))
        for module in self.paths:
            self._read(module)

    def _read(self, module):
        """Scope and paths of a file; an inline module within it counts ``super`` from where it stands."""
        code = self.code[module]
        inline = []
        for mark in re.finditer(r"\bmod\s+(\w+)\s*\{", code):
            inline.append((mark.end() - 1, closing(code, mark.end() - 1), mark[1]))
        self.scope[module], self.uses[module], self.mentions[module] = {}, [], []
        covered = []
        for mark in re.finditer(r"\buse\s+([^;]+);", code):
            covered.append(mark.span())
            inner = tuple(name for start, end, name in inline if start < mark.start() < end)
            for path, name in use_tree(mark[1]):
                absolute = self._absolute(path, (*module, *inner))
                if absolute is None:
                    continue
                self.uses[module].append(absolute)
                if not inner:
                    self.scope[module].setdefault(name, []).append(absolute)
        for mark in re.finditer(r"(?<![\w:])\$?((?:\w+\s*::\s*)+\w+)", code):
            if any(start <= mark.start() < end for start, end in covered):
                continue
            inner = tuple(name for start, end, name in inline if start < mark.start() < end)
            path = tuple(part.strip() for part in mark[1].split("::"))
            self.mentions[module].append((path, (*module, *inner)))

    def _absolute(self, path, here):
        """A written path from the root of the crate, or None where it leads out of it."""
        if path[0] == "crate":
            return path[1:]
        if path[0] == "self":
            return (*here, *path[1:])
        ups = next((i for i, name in enumerate(path) if name != "super"), len(path))
        if ups:
            return (*here[: len(here) - ups], *path[ups:])
        return (*here, *path) if (*here, path[0]) in self.paths else None

    def is_face(self, module):
        """Whether a file only declares modules and passes their names on."""
        code = re.sub(r"#!?\[[^\]]*\]", "", self.code[module])
        code = re.sub(r"\b(?:pub(?:\([^)]*\))?\s+)?(?:mod\s+\w+|use\s+[^;]+|extern\s+crate\s+\w+)\s*;", "", code)
        return not code.strip()

    def defines(self, module, name):
        """Whether a file defines an item."""
        item = rf"\b(?:fn|struct|enum|union|const|static|trait|type|macro_rules!)\s+(?:mut\s+)?{re.escape(name)}\b"
        return re.search(item, self.code[module]) is not None

    def homes(self, path, visited=frozenset()):
        """Files that a path from the root leads to, through whatever passes a name on."""
        if path in visited:
            return set()
        module = next(path[:n] for n in range(len(path), -1, -1) if path[:n] in self.paths)
        rest, visited = path[len(module) :], visited | {path}
        if not rest:
            return {module}
        if rest[0] == "*":
            return set().union(*(self.homes(p, visited) for ps in self.scope[module].values() for p in ps), {module})
        if not self.defines(module, rest[0]):
            for target in self.scope[module].get(rest[0], ()):
                return self.homes((*target, *rest[1:]), visited)
            for passed in self.scope[module].get("*", ()):
                for home in self.homes(passed[:-1], visited):
                    if self.defines(home, rest[0]):
                        return {home}
        return {module}

    def edges(self):
        """Of each file, which others it uses; faces are looked through and stand for nothing themselves."""
        graph = {}
        for module in self.paths:
            targets = set().union(*(self.homes(path) for path in self.uses[module]), set())
            for path, here in self.mentions[module]:
                absolute = self._absolute(path, here)
                if absolute is not None:
                    targets |= self.homes(absolute)
                for target in self.scope[module].get(path[0], ()) if absolute is None else ():
                    targets |= self.homes((*target, *path[1:]))
            if not self.is_face(module):
                graph[module] = {t for t in targets if t != module and not self.is_face(t)}
        return graph


def rust_circles(root):
    """Circles of files of a crate."""
    crate = Crate(root)
    name = {module: str(path.relative_to(root)) for module, path in crate.paths.items()}
    return circles({name[module]: {name[t] for t in targets} for module, targets in crate.edges().items()})


#: Head of a function.
HEAD = re.compile(r"\b(?:pub(?:\([^)]*\))?\s+)?(?:const\s+)?fn\s+(\w+)\s*(?:<[^>]*>)?\s*\(")


def functions_of(code, start, end):
    """Names and bodies of the functions of a stretch of code."""
    at = start
    while (head := HEAD.search(code, at, end)) is not None:
        opened = code.find("{", closing(code, head.end() - 1, "()"))
        at = closing(code, opened)
        yield head[1], code[opened : at + 1]


def entries(root):
    """Bodies of what a Python program can call in the bindings below a folder: {file::Class.name: body}."""
    entry_bodies, helpers = {}, {}
    for path in sorted(root.rglob("*.rs")):
        code = without_tests(bare(path.read_text(encoding="utf-8")))
        bodies = helpers[path] = {}
        for mark in re.finditer(r"#\[pyfunction", code):
            name, body = next(functions_of(code, mark.end(), len(code)))
            entry_bodies[f"{path.stem}::{name}"] = body
        for mark in re.finditer(r"#\[pymethods\]\s*impl(?:<[^>]*>)?\s+(\w+)[^{]*\{", code):
            for name, body in functions_of(code, mark.end(), closing(code, mark.end() - 1)):
                entry_bodies[f"{path.stem}::{mark[1]}.{name}"] = body
        bodies.update(functions_of(code, 0, len(code)))
    return entry_bodies, {name: body for bodies in helpers.values() for name, body in bodies.items()}


def unwrapped(root, wrappers):
    """Entries that call neither a wrapper nor a helper that does; what detaches and catches by itself is one too."""
    bodies, helpers = entries(root)
    wraps = {
        *wrappers,
        *(name for name, body in helpers.items() if calls(body, ["detach"]) and calls(body, ["caught"])),
    }
    while more := {name for name, body in helpers.items() if name not in wraps and calls(body, wraps)}:
        wraps |= more
    return sorted(name for name, body in bodies.items() if not calls(body, wraps))


def calls(body, names):
    """Whether a body calls one of some functions."""
    return any(re.search(rf"\b{re.escape(name)}(?:::<[^>]*>)?\s*\(", body) for name in names)
