"""The demonstration, as a newcomer meets it: one screen, and everything else behind -v."""

import pytest

from ftlm.cli.framework import wrap_line
from ftlm.reproduction.demo import PULSE_FIT_TITLE, demo_details, demo_page, demo_text, run_demo


@pytest.mark.slow
def test_the_demo_is_one_screen_and_its_page_leads_with_measured_and_simulated(tmp_path, monkeypatch):
    told, named = [], []
    demo = run_demo(
        tmp_path,
        increment=0.35,
        noise=1e-4,
        seed=1,
        threads=None,
        force=False,
        log=named.append,
        progress=lambda *done: told.append(done),
    )
    lines = demo_text(demo).splitlines()
    # With what is said beforehand, what was written and the prompt.
    assert len(lines) + 4 <= 40
    assert max(map(len, lines)) <= 120
    assert sum(": TRUST: " in line for line in lines) == 2
    assert not any(line.startswith("warning") for line in lines)
    # The same on a terminal of 80 columns, as the command line breaks its lines.
    monkeypatch.setenv("COLUMNS", "80")
    broken = [part for line in demo_text(demo).splitlines() for part in wrap_line(line)]
    assert len(broken) + 4 <= 42
    assert max(map(len, broken)) <= 80
    assert sum(line.startswith("! ") for line in lines) <= 3
    # Nothing is lost behind it.
    said = [w for results in demo.results.values() for r in results.values() for w in r.warnings]
    assert all(w in demo_details(demo) for w in said)
    page = demo_page(demo, tmp_path / "demo.html").read_text("utf-8").replace("\xa0", " ")
    assert page.index("Stage 1, output error: trust") < page.index("Stage 2, output error: trust")
    order = [
        "The models then simulate",
        "Measured and simulated",
        "Verdicts</h2>",
        "Fit of every model</h2>",
        "Stage 1</h2>",
    ]
    assert [page.index(text) for text in order] == sorted(page.index(text) for text in order)
    # Two fits of one model: to pulse means in bars and tables, to every sample in verdicts and charts; both say so.
    mean, sampled = demo.stages[1].candidates["output error"].fits[1], demo.validations[1].fit["theta11"]
    assert f"{mean:.2f}" != f"{sampled:.2f}"
    charts, bars = (page[page.index(order[k]) : page.index(order[k + 1])] for k in (1, 3))
    assert bars.count(f"{PULSE_FIT_TITLE} of") >= 4
    assert f"{mean:.2f}" in bars
    assert f"{sampled:.2f}" not in bars
    assert "Verdicts and charts of measured and simulated angles give the fit to all samples" in bars
    assert f"fit {sampled:.3f} %" in charts
    assert f"theta11 {sampled:.2f} %" in demo_text(demo)
    assert sum("fits to pulse means" in line and "verdicts have fits to every sample" in line for line in lines) == 1
    # One course over the whole, which never goes back.
    shares = [done / total for done, total in told]
    assert shares == sorted(shares)
    assert len(named) == 13
