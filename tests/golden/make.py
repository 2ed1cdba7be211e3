"""Makes the files that later versions must read: `python tests/golden/make.py`, once for a release, never again.

They are kept as they are. A version that cannot read them breaks its users' files.
"""

import json
import sys
from pathlib import Path

import numpy as np

import ftlm
from ftlm.order_search.checkpoint import Rounds, Store
from ftlm.order_search.options import SearchSettings
from ftlm.order_search.search import make_job

HERE = Path(__file__).resolve().parent


def run():
    """A short noisy run."""
    n = 65
    u = np.where(np.arange(n) % 16 < 9, 1.0, -1.0)
    t = np.arange(n) * 0.05
    y = np.cumsum(np.convolve(u, np.exp(-3 * t))[:n]) * 0.01 + 1e-3 * np.random.default_rng(7).standard_normal(n)
    return ftlm.Run.from_arrays(
        step=0.05, inputs={"u": u}, outputs={"y": y}, units={"u": "A", "y": "rad"}, name="golden"
    )


def main():
    """Write model, run, finished stores and a half-finished one."""
    folder = HERE / ftlm.__version__
    if folder.exists():
        sys.exit(f"{folder} is there already, and stays as it is")
    folder.mkdir()
    given = run()
    given.to_csv(folder / "run.csv")
    found = ftlm.identify(given, ftlm.equation("D^1.4 y = a D^0.4 y + c y + b u"), m=64, threads=1)
    found.model.save(folder / "model.json")
    structure = ftlm.equation("D^alpha y = a D^beta y + c D^mu y + b u", initial="rest")
    lattice = ftlm.order_grid(increment=0.05, beta=(0.0, 1.0), mu=(0.0, 1.0))
    options = {"m": 32, "pruning": False, "threads": 1, "top": 5, "prior_covariance": 1.0}
    whole = ftlm.search_orders(given, structure, lattice, store=folder / "search.ftlm", **options)
    settings = SearchSettings(top=5, pruning=False)
    job = make_job(given, structure, lattice, settings, m=32, threads=1)
    with Store(folder / "half.ftlm", [job.request("y")]) as store:
        work = job.equation_problem()
        part = work.build_evaluator().evaluate_batches(0, 1, [], None, 1, None, None)
        store.append_block(Rounds(0, 0, 1, part))
        # A stretch that has only begun.
        store.save(0, 1, 2, ((1, 0, 0, 0, float("inf")), ((), (0,) * 7, ())))
    expected = {
        "coefficients": found.model.coefficients,
        "orders": found.model.orders,
        "table": whole.to_dict()["table"],
        "candidates": whole.candidates,
        "exclusion_counts": whole.exclusion_counts,
    }
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n", encoding="utf-8")
    under_a_law(folder, given)


def under_a_law(folder, given):
    """A finished store of a search under an order law, and its table."""
    structure = ftlm.equation("D^alpha y = a D^beta y + b D^(alpha-beta) u", initial="rest")
    options = {"m": 32, "threads": 1, "top": 5, "prior_covariance": 1.0, "store": folder / "law.ftlm"}
    found = ftlm.search_orders(given, structure, ftlm.order_grid(increment=0.05), **options)
    (folder / "law.json").write_text(json.dumps(found.to_dict(), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
