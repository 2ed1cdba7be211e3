"""Searches of orders that are kept in a store, and what is compared of them."""

import json

import ftlm
from ftlm.order_search.options import SearchSettings
from ftlm.order_search.search import make_job
from ftlm.utils.checkpoint_file import CheckpointFile
from small_lattice import EQUATION

COARSE = ftlm.order_grid(increment=0.1)


def search(run, path=None, *, order_grid=COARSE, **options):
    """Brute force has the shortest rounds: five of them, in three waves."""
    options = {"m": 32, "pruning": False, **options}
    return ftlm.search_orders(run, ftlm.equation(EQUATION, initial="rest"), order_grid, store=path, **options)


def bytes_of(found):
    """Bytes of what a search finds; a store keeps no runs, so a resumed search has no verdict."""
    table = {n: v for n, v in found.to_dict().items() if n not in ("verdict", "findings")}
    return json.dumps(table) + str(found.model) + repr(found.failures)


def tables_of(text):
    """Printed searches without the verdicts that a resumed search lacks."""
    return {
        name: {n: v for n, v in found.items() if n not in ("verdict", "findings")}
        for name, found in json.loads(text).items()
    }


def records(path):
    """Payloads of an intact store."""
    with CheckpointFile(path, "search") as file:
        payloads, damage = file.read()
    assert damage is None
    return payloads


def job_of(run, structure, order_grid, *, m, top=20, pruning=True):
    settings = SearchSettings(top=top, pruning=pruning)
    return make_job(run, structure, order_grid, settings, m=m)
