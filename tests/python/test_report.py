"""Reports are whole, inert and honest: one file, no request, no script, and every number that of the result."""

import base64
import hashlib
import html
import itertools
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

import ftlm
from ftlm import report
from ftlm.estimation.linear import trace_chart
from ftlm.order_search.result import MAX_REPORT_ROWS, search_summary, search_top
from ftlm.order_search.search import landscape
from ftlm.plot.comparison_charts import compared_bars, error_chart, residual_charts, residual_series
from ftlm.plot.model_charts import bode_charts, pole_charts
from ftlm.report.html_report import settings_table
from ftlm.report.typesetting import equation_html, parameter_table
from ftlm.reproduction.demo import PAPER_TABLE_WIDTHS, paper_table
from ftlm.reproduction.report import letters_of, table_text
from ftlm.reproduction.stage import Candidate
from ftlm.svg import figure as axes
from ftlm.svg.charts import BarChart, CorrelationMap, PlaneChart, histogram
from ftlm.svg.figure import LINE_HEIGHT_PX
from ftlm.svg.html_page import ReportMixin
from ftlm.svg.line_chart import LineChart
from ftlm.utils import formatting as words
from ftlm.utils.formatting import number
from ftlm.validation.comparison import errors_table

HOSTILE = "</script><script>alert(1)</script>\"><svg onload=alert(1)> & 'x'"
VOID = {"meta", "link", "br", "hr", "img", "input"}
ORDERS = {"gamma1": 0.95, "beta2": 0.1, "mu2": 0.85}


def run_of(shape, name, *, seed, seconds=4.0, step=0.004):
    t = np.arange(round(seconds / step) + 1) * step
    inputs = {"I1": shape(t)}
    clean = ftlm.link_model(orders=ORDERS, coefficients={"d1": 6.63, "d2": -9.1}, form="published").simulate(
        ftlm.Run.from_arrays(step=step, inputs=inputs, outputs={"theta11": t}, units={"I1": "A"})
    )
    noise = np.random.default_rng(seed)
    outputs = {n: clean[n] + 1e-5 * noise.standard_normal(t.size) for n in clean.outputs}
    units = {"I1": "A", "theta11": "rad", "theta12": "rad"}
    return ftlm.Run.from_arrays(step=step, inputs=inputs, outputs=outputs, units=units, name=name)


@pytest.fixture(scope="module")
def square():
    return run_of(lambda t: 0.3 * np.sign(np.sin(np.pi * (t + 1e-9))), "square " + HOSTILE, seed=1)


@pytest.fixture(scope="module")
def sine():
    return run_of(lambda t: 0.3 * np.sin(np.pi * t), "sine", seed=2)


@pytest.fixture(scope="module")
def identified(square):
    lattice = ftlm.order_grid(0.05, alpha1=2.0, alpha2=2.0, gamma1=(0.9, 1.0), beta2=(0.05, 0.15), mu2=(0.8, 0.9))
    # Initial terms although the run starts at rest, so that the page has them to show.
    structure = ftlm.flexible_link(form="published", stage=1, parameters="effective")
    structure = replace(structure, initial="caputo")
    return ftlm.identify(square, structure, method=ftlm.LeastSquares(order_grid=lattice))


@pytest.fixture(scope="module")
def page(identified, sine, tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "arm.html"
    assert report.identification_page(identified, path, validation=sine) == path
    return path.read_text("utf-8")


class Page(HTMLParser):
    """Elements and text of a page; refuses what is not balanced."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.attributes, self.text, self.data = [], [], [], [], []
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value) for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)
        if tag == "data":
            self.data.append(dict(attrs)["value"])

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value) for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not {"style", "script"} & set(self.open):
            self.text.append(data)


def written(tmp_path, *sections, **options):
    return report.write_page(tmp_path / "p.html", title="t", sections=sections, **options).read_text("utf-8")


# ------------------------------------------------------------------------------------------------ the page


def test_page_is_balanced_and_needs_nothing_else(page):
    parsed = Page(page)
    assert parsed.tags.count("script") == 1
    script = re.search(r"<script>(.*?)</script>", page, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page
    assert "unsafe-eval" not in page
    assert not re.search(r"https?:|url\(|@import|src=|javascript:", page)
    for tag, name, value in parsed.attributes:
        assert not name.startswith("on"), (tag, name)
        if name in ("href", "src", "action", "data", "srcset", "poster"):
            assert value.startswith("#") or value == "data:,", (tag, name, value)
    assert len(page.encode()) < 2_000_000
    ids = [value for _, name, value in parsed.attributes if name == "id"]
    assert len(ids) == len(set(ids))
    assert {value[1:] for _, name, value in parsed.attributes if name == "href" and value[0] == "#"} <= set(ids)


def test_page_says_what_it_must(page, identified):
    text = " ".join(Page(page).text)
    for word in (
        "Warnings",
        "Equations",
        "Errors",
        "Order search",
        "Settings",
        "Initial terms",
        "equation error",
        "output error",
    ):
        assert word in text
    assert "estimation" in text
    assert "validation" in text
    for name in ("M", "initial terms", "estimator"):
        assert name in text
    assert "standard error" in text  # that there are none
    heads = [text.index(head) for head in ("Validation: measured and simulated", "Equations", "Warnings", "Errors")]
    assert heads == sorted(heads)
    assert f"{identified.fit['theta12']:.4g}\u00a0%" in text


def test_charts_are_named_for_those_who_cannot_see_them(page):
    parsed = Page(page)
    charts = re.findall(r'<svg class="chart [^>]*>', page)
    fits = 2 * 2  # outputs, runs
    residuals = 2 * 2 * 2  # outputs; itself and the current; runs
    bode, maps = 2 * 2, 1 + 3  # a map, and a profile of each searched order
    inputs, series = 2, 2 * fits  # over time and histogram
    own = 1 + 2  # poles, steps
    assert len(charts) == 2 * (fits + inputs + residuals + series + bode + maps + own)  # wide and narrow
    assert all('role="img"' in c and "viewBox" in c for c in charts)
    assert parsed.tags.count("desc") == len(charts)
    assert "prefers-color-scheme" in page


def test_numbers_are_those_of_the_comparison(page, identified, square, sine):
    shown = {float(v) for v in Page(page).data}
    for comparison in (identified.model.compare(square), identified.model.compare(sine)):
        for found in (comparison.equation_error, comparison.output_error):
            for m in found.values():
                assert {m.error, m.rmse, m.nr, m.fit} <= shown
    assert set(identified.coefficients.values()) <= shown
    assert set(identified.orders.values()) <= shown


def test_warnings_come_before_details(tmp_path, identified):
    notes = tuple(ftlm.Finding("data_note", numbers={"text": text}) for text in (HOSTILE, "second"))
    unstable = ftlm.Identification(
        identified.model, "least-squares", identified.comparison, {}, identified.settings, notes
    )
    path = report.identification_page(unstable, tmp_path / "p.html")
    text = path.read_text("utf-8")
    parsed = Page(text)
    # Notes on the data are no warnings.
    assert "No check raised a warning" in text
    assert f"{HOSTILE}." in parsed.text
    assert text.index("second") < text.index("Errors</h2>")
    assert "No validation run was given" in text


def test_a_validation_that_validates_nothing_is_said(tmp_path, identified, square):
    text = report.identification_page(identified, tmp_path / "p.html", validation=[square]).read_text("utf-8")
    assert "so it does not validate the model" in text


def test_a_lost_fit_is_said(tmp_path, identified, sine):
    other = ftlm.Run.from_arrays(
        step=sine.step,
        inputs={"I1": sine["I1"]},
        name="other",
        outputs={"theta11": -sine["theta11"], "theta12": -sine["theta12"]},
        units=sine.units,
    )
    text = report.identification_page(identified, tmp_path / "p.html", validation=other).read_text("utf-8")
    assert "validation run other: the fit of theta12 drops from" in text


def test_hostile_names_are_inert(tmp_path, page):
    assert "square " + HOSTILE in " ".join(Page(page).text)
    assert page.count("<script") == 1
    assert "onload=alert(1)>" not in page
    chart = LineChart([0, 1], [(HOSTILE, [0, 1])], title=HOSTILE, x_label=HOSTILE, y_label=HOSTILE)
    table = report.Table(HOSTILE, (HOSTILE, "n"), [(HOSTILE, 1.0)], ((HOSTILE, 2),), {0: HOSTILE}, HOSTILE)
    section = report.Section(HOSTILE, [HOSTILE], [HOSTILE], [table], [chart])
    text = written(tmp_path, section, lead=HOSTILE)
    parsed = Page(text)
    assert parsed.tags.count("script") == 1
    assert not [a for a in parsed.attributes if a[1].startswith("on")]
    lone = report.Section("half a pair \ud800")
    assert "half a pair" in written(tmp_path, lone, force=True)


def test_existing_files_are_kept(tmp_path, identified):
    path = tmp_path / "p.html"
    path.write_text("mine")
    with pytest.raises(ftlm.DataError, match="exists"):
        report.write_page(path, title="t", sections=[])
    with pytest.raises(ftlm.DataError, match="exists"):
        report.identification_page(identified, path)
    assert path.read_text() == "mine"
    report.write_page(path, title="t", sections=[], force=True)
    assert path.read_text("utf-8").startswith("<!doctype html>")
    assert [p.name for p in tmp_path.iterdir()] == ["p.html"]


def test_a_folder_that_cannot_be_written_is_said_before_any_work(tmp_path, identified, monkeypatch):
    with pytest.raises(ftlm.DataError, match="is not a folder; create it first"):
        identified.report(tmp_path / "nowhere" / "p.html")
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(ftlm.DataError, match="is read-only; choose another folder"):
        identified.report(tmp_path / "p.html")


def test_intervals_that_are_none_are_said(tmp_path, small_run, with_noise):
    found = ftlm.identify(with_noise(small_run, 0.02, 1), ftlm.equation("D^alpha y = a D^0.6 y + c y + b u"))
    broken = replace(found.joint, covariance=np.full_like(found.joint.covariance, np.nan))
    result = replace(found, joint=broken)
    text = " ".join(Page(result.report(tmp_path / "p.html").read_text("utf-8")).text)
    assert text.count("undefined") >= 3 * 4
    assert "the standard errors of alpha, a, c, b are not defined" in text
    table = parameter_table(found.model, found.joint)
    low, high = found.intervals["alpha"]
    assert table.rows[0][1:5] == [found.orders["alpha"], found.standard_errors["alpha"], low, high]


def test_a_saved_model_has_a_report_of_its_own(tmp_path, small_run, small_model, with_noise):
    found = ftlm.identify(with_noise(small_run, 0.02, 1), ftlm.equation("D^alpha y = a D^0.6 y + c y + b u"))
    loaded = ftlm.load_model(found.model.save(tmp_path / "m.json"))
    mirrored = ftlm.Run.from_arrays(
        step=small_run.step, inputs={"u": small_run["u"]}, outputs={"y": -small_run["y"]}, name="mirrored"
    )
    page = report.model_page(loaded, tmp_path / "m.html", validation=mirrored).read_text("utf-8")
    text = " ".join(Page(page).text)
    assert "validation run mirrored: the fit of y drops from" in text
    assert "95 % interval" in text
    assert {found.standard_errors["alpha"], found.orders["alpha"]} <= {float(v) for v in Page(page).data}
    again = report.model_page(loaded, tmp_path / "again.html", validation=with_noise(small_run, 0.02, 1))
    assert "the run has the name of a run from which the model was identified" in again.read_text("utf-8")
    alone = report.model_page(small_model, tmp_path / "alone.html").read_text("utf-8")
    assert "No validation run was given" in alone
    assert "Without standard errors, the number of significant digits" in alone


def test_the_landscape_is_the_search(small_run, with_noise):
    run = with_noise(small_run, 0.02, 1)
    lattice = ftlm.order_grid(0.1, alpha=(1.2, 2.0), nu="0.0:1.0:0.1")
    structure = ftlm.equation("D^alpha y = a D^nu y + c y + b u")
    found = ftlm.search_orders(run, structure, lattice, top=10_000)
    drawn = landscape(run, structure, found, lattice)
    assert drawn.names == ("alpha", "nu")
    assert drawn.scores.shape == (11, 9)
    for row in found.table:
        i = int(np.argmin(np.abs(drawn.y - row.orders["nu"])))
        j = int(np.argmin(np.abs(drawn.x - row.orders["alpha"])))
        assert drawn.scores[i, j] == row.score
    finite = np.isfinite(drawn.scores)
    assert finite.sum() == sum(np.isfinite(r.score) for r in found.table)
    Page(drawn.svg)
    assert "Best: α = " in drawn.caption
    with pytest.raises(ftlm.ModelError, match="two different orders"):
        landscape(run, structure, found, lattice, orders=("alpha", "alpha"))


def test_charts_of_residuals_and_frequencies_are_their_numbers(small_model, small_run, with_noise):
    tests = small_model.resid(with_noise(small_run, 0.02, 1))
    charts = residual_charts(tests)
    assert [c.title for c in charts] == ["Residual of y with itself", "Residual of y with u"]
    stems = re.findall(r"M(\d+) (\d+)V(-?\d+)", charts[1].svg)
    assert len(stems) == 51
    heights = np.array([int(zero) - int(y) for _, zero, y in stems], dtype=float)
    values = tests.outputs["y"].inputs["u"].values
    np.testing.assert_allclose(
        heights / heights[np.argmax(np.abs(values))] * values[np.argmax(np.abs(values))],
        values,
        atol=0.02 * np.max(np.abs(values)),
    )
    w = np.geomspace(0.1, 100, 50)
    gain, phase = bode_charts(small_model, w)
    (strokes,) = paths_of(gain.svg)
    drawn = np.concatenate(strokes)[:, 1]
    exact = 20 * np.log10(np.abs(small_model.frequency_response(w)[0, 0]))
    fitted = np.polyfit(drawn, exact, 1)
    np.testing.assert_allclose(np.polyval(fitted, drawn), exact, atol=0.2)
    assert "phase" in phase.title


def test_results_are_rich_in_a_notebook(identified, square):
    shown = {
        "identification": identified._repr_html_(),
        "model": identified.model._repr_html_(),
        "comparison": identified.model.compare(square)._repr_html_(),
        "residuals": identified.resid(square)._repr_html_(),
        "search": identified.searches["stage"]._repr_html_(),
        "advice": square.advice()._repr_html_(),
        "run": square._repr_html_(),
        "structure": ftlm.flexible_link(form="published")._repr_html_(),
    }
    for name, text in shown.items():
        parsed = Page(text)
        assert not {"script", "img"} & set(parsed.tags), name
        # Its free run is worth a picture; the others are tables.
        assert ("svg" in parsed.tags) == (name == "identification"), name
        assert not re.search(r"https?:|src=", text), name
    assert "<math>" in shown["identification"]
    values = {float(v) for v in Page(shown["identification"]).data}
    assert set(identified.coefficients.values()) <= values
    assert identified.fit["theta12"] in values
    for warning in identified.warnings:
        assert warning in " ".join(Page(shown["identification"]).text)
    plain = ftlm.Model(ftlm.equation("D^1.5 y = -y + u"))._repr_html_()
    assert "<table" not in plain
    assert "<math>" in plain


def test_same_result_same_bytes(tmp_path, identified):
    one, two = (report.identification_page(identified, tmp_path / n).read_bytes() for n in ("a.html", "b.html"))
    assert one == two


def test_a_paragraph_is_not_taken_apart():
    section = report.Section("h", "one text", "one warning")
    assert (section.paragraphs, section.warnings) == (("one text",), ("one warning",))


def test_many_runs_stay_within_two_megabytes(tmp_path, identified, square):
    rng = np.random.default_rng(3)
    c = identified.comparison
    runs = 120
    many = ftlm.Comparison(
        c.output_error,
        c.equation_error,
        [(f"run {k}", c.per_run[0][1], c.per_run[0][2]) for k in range(runs)],
        {o: [rng.standard_normal(c.m)] * runs for o in c.simulated},
        {o: [rng.standard_normal(c.m)] * runs for o in c.measured},
        c.step * runs,
        c.m,
        [{}] * runs,
    )
    result = ftlm.Identification(identified.model, identified.method, many, {}, identified.settings)
    text = report.identification_page(result, tmp_path / "p.html").read_text("utf-8")
    assert len(text.encode()) < 2_000_000
    assert "further charts are left out" in text


# ------------------------------------------------------------------------------------------------ tables


def test_numbers_read_alike():
    assert words.number(-863.33256) == "−863.33"
    assert words.number(0.1) == "0.10000"
    assert words.number(12345.0) == "12345"
    assert words.number(1.23456e-7) == "1.2346×10⁻⁷"
    assert words.number(313845) == words.number(np.int64(313845)) == "313\u202f845"
    assert words.number(words.Exact(0.95)) == "0.95"
    assert words.number(0.0) == "0"
    assert words.number(math.inf) == "∞ diverged"
    assert words.number(-math.inf) == "−∞ diverged"
    assert words.number(math.nan) == "undefined"


def test_names_are_written_by_hand():
    assert words.symbol("theta12") == "θ₁₂"
    assert words.symbol("I1") == "I₁"
    assert words.symbol("motor2") == "motor2"
    assert words.symbol("<b>") == "<b>"
    assert str(words.symbol_html("mu2")) == "<i>μ</i><sub>2</sub>"
    assert str(words.symbol_html("<b>")) == "<i>&lt;b&gt;</i>"


def test_equation_reads_as_on_paper():
    model = ftlm.Model(ftlm.equation("D^1.95 theta12 = -863.3325 D^0.1 theta12 + 2 theta11 - 0.5 u"))
    parsed = Page(str(equation_html(model.equations[0])))
    assert "".join("".join(parsed.text).split()) == "D1.95θ12=−863.33D0.1θ12+2.0000θ11−0.50000u"
    assert parsed.tags.count("msup") == 2
    assert parsed.tags.count("msub") == 3
    assert parsed.tags.count("math") == 4  # it breaks between terms
    tiny = equation_html(ftlm.equation("D^2 y = 1.5e-9 D^(-0.5) y_long + u").equations[0])
    assert "<msup><mn>10</mn><mrow><mo>−</mo><mn>9</mn></mrow></msup>" in tiny
    assert "<mrow><mo>−</mo><mn>0.5</mn></mrow>" in tiny


def test_errors_table_is_the_comparison(identified, sine):
    validation = identified.model.compare(sine)
    table = errors_table([("estimation", identified.comparison), ("validation", validation)])
    rows = iter(table.rows)
    for found in (identified.comparison, validation):
        for name in found.output_error:
            e, o = found.equation_error[name], found.output_error[name]
            assert next(rows)[1:] == [e.error, e.rmse, e.nr, e.fit, o.error, o.rmse, o.nr, o.fit]
    assert next(rows, None) is None


def test_errors_of_several_runs_together_and_alone(identified, square, sine):
    found = identified.model.compare([square, sine])
    table = errors_table([("both", found)])
    assert len(table.rows) == 2 * 3
    assert table.rows[0][5] == found.output_error["theta11"].error
    assert table.rows[4][5] == found.per_run[1][2]["theta11"].error


def test_parameters_stand_beside_the_stated_ones(identified):
    table = parameter_table(identified.model)
    values = [row[1] for row in table.rows]
    assert values == [*identified.orders.values(), *identified.coefficients.values()]
    stated = identified.model.structure.nominal_values
    assert [row[2] for row in table.rows[-8:]] == [stated[n] for n in identified.coefficients]
    plain = parameter_table(ftlm.Model(ftlm.equation("D y = a y + b u").with_coefficients({"a": -1, "b": 2})))
    assert plain.columns == ("parameter", "value", "unit", "what it is")
    assert [row[1] for row in plain.rows] == [-1, 2]


def paper_models(identified):
    comparison = identified.comparison
    infinite = ftlm.Metrics(math.inf, math.inf, math.inf, -math.inf)
    diverged = replace(comparison, output_error=dict.fromkeys(comparison.output_error, infinite))
    models = {"integer-order model of the maker": (ftlm.link_model(form="published"), comparison)}
    models |= {f"p = {p}": (identified.model, comparison) for p in (1, 3, 5, 7)}
    models["diverged"] = (identified.model, diverged)
    return {label: Candidate(model, errors, None, {}) for label, (model, errors) in models.items()}


def test_paper_table_has_the_papers_columns(identified):
    table = paper_table(paper_models(identified))
    assert [re.sub("<.*?>", "", c) for c in table.columns[:9]] == ["model", *"γαβμabdg"]
    assert [text for text, _ in table.groups][3:] == ["equation error", "output error (free run)"]
    assert sum(width for _, width in table.groups) == len(table.columns) == 15
    deflection = table.rows[7]
    o, c, comparison = identified.orders, identified.coefficients, identified.comparison
    assert deflection[1:5] == [1.05, o["alpha2"], o["beta2"], o["mu2"]]
    assert deflection[5:9] == [c["a2"], c["b2"], c["d2"], c["g2"]]
    e, f = comparison.equation_error["theta12"], comparison.output_error["theta12"]
    assert deflection[9:] == [e.error, e.rmse, e.nr, f.error, f.rmse, f.nr]
    html = str(table.to_html())
    Page(html)
    assert "∞ diverged" in html
    assert sorted(table.headings) == [0, 6]
    with pytest.raises(ftlm.ModelError, match="output 'theta21' does not occur"):
        letters_of(identified.model, "theta21")


def test_paper_table_fits_a_terminal(identified):
    lines = table_text(paper_table(paper_models(identified)), 16, PAPER_TABLE_WIDTHS)
    assert max(map(len, lines)) <= 120
    assert lines[-1].startswith("∞: diverged")
    assert len([line for line in lines if line.startswith("  p = ")]) == 8
    row = next(line for line in lines if line.startswith("  p = 7")).split()
    assert float(row[3]) == identified.orders["gamma1"] or identified.orders["gamma1"] in map(float, row[3:7])
    assert float(row[7]) == pytest.approx(identified.coefficients["a1"], rel=1e-4)
    assert float(row[-1]) == pytest.approx(identified.output_error["theta11"].nr, rel=0.05, abs=5e-5)


def test_search_tables_account_for_every_candidate(identified):
    search = identified.searches["stage"]
    summary = search_summary(identified.searches)
    name, _, candidates, kept, *left_out = summary.rows[0]
    assert "stage" in name
    assert candidates == search.candidates == kept + sum(left_out)
    top = search_top("stage", search)
    assert len(top.rows) == min(MAX_REPORT_ROWS, len(search.table))
    assert top.rows[0][1] == search.score
    assert top.rows[0][2:] == [*search.orders.values(), *search.coefficients.values()]


def test_settings_name_what_the_result_depends_on(identified, square):
    text = str(settings_table(identified).to_html())
    assert str(identified.settings["m"]) in text
    assert "least-squares" in text
    at = ftlm.flexible_link(form="published").with_orders(identified.orders)
    paper = ftlm.identify(square, at, method=ftlm.MultiInnovation(prior_covariance=100.0))
    rows = {str(row[0]): row[1] for row in settings_table(paper).rows}
    assert rows["innovation length, p"] == 7
    assert rows["prior covariance, K<sub>0</sub>"] == 100


# ------------------------------------------------------------------------------------------------ charts


@pytest.mark.parametrize("seed", range(200))
def test_ticks_are_sane(seed):
    rng = np.random.default_rng(seed)
    low = float(rng.standard_normal() * 10.0 ** rng.integers(-12, 12))
    high = low + float(abs(rng.standard_normal()) * 10.0 ** rng.integers(-3, 3) * (abs(low) + 1e-12))
    found = axes.ticks(low, high, 5)
    steps = np.diff(found.values)
    slack = 1e-6 * (high - low)
    assert 2 <= len(found.values) <= 12
    assert low - slack <= found.values[0]
    assert found.values[-1] <= high + slack
    np.testing.assert_allclose(steps, steps[0], rtol=1e-3)
    mantissa = steps[0] / 10.0 ** math.floor(math.log10(steps[0]) + 1e-9)
    assert min(abs(mantissa / s - 1) for s in (1, 2, 5, 10)) < 1e-3
    assert len(set(found.labels)) == len(found.labels)


def test_no_tick_label_leaves_the_drawing():
    chart = LineChart([0.01, 1.0, 1e4], [("model", [1.0, 2.0, 3.0])], title="", x_label="f", y_label="y", log_x=True)
    (last,) = re.findall(r'<text x="([0-9.]+)"[^>]*text-anchor="(\w+)"[^>]*>10000<', chart.narrow)
    assert last == (f"{axes.NARROW_WIDTH_PX:.1f}", "end")
    middle = re.findall(r'<text [^>]*text-anchor="middle"[^>]*>([^<]+)<', chart.narrow)
    assert "1" in middle


def test_ticks_are_round():
    assert axes.ticks(0, 10, 5).labels == ["0", "2", "4", "6", "8", "10"]
    assert axes.ticks(-0.1, 0.1, 5).labels == ["−0.10", "−0.05", "0.00", "0.05", "0.10"]
    assert axes.ticks(0, 0.3, 3).values == [0, 0.1, 0.2, 0.3]
    small = axes.ticks(-1e-7, 1e-7, 5)
    assert (small.labels[0], small.factor) == ("−100", "×10⁻⁹")


def test_a_long_staircase_keeps_its_corners():
    levels = np.repeat(np.random.default_rng(4).integers(0, 2, 60), 20).astype(float)
    levels[100:103] = np.nan
    rows = axes.decimate(levels, 200)
    # Between two rows that are drawn one after the other, the value does not change in a row that is left out.
    for first, last in itertools.pairwise(rows):
        between = levels[first : last + 1]
        assert last == first + 1 or np.isnan(between).any() or np.ptp(between) == 0.0, (first, last)
    assert {99, 103} <= set(rows.tolist())


def test_decimation_keeps_extremes_and_ends():
    rng = np.random.default_rng(5)
    y = rng.standard_normal(100_000)
    y[[12_345, 54_321, 77_777]] = [40.0, -50.0, np.nan]
    kept = axes.decimate(y)
    assert kept.size <= axes.MAX_LINE_POINTS
    assert np.all(np.diff(kept) > 0)
    assert {0, 12_345, 54_321, y.size - 1} <= set(kept.tolist())
    assert np.all(np.isfinite(y[kept]))
    # No part of the line is lost: wherever one looks, a smallest and a largest value were kept.
    for part in np.array_split(np.arange(y.size), 300):
        inside = kept[(kept >= part[0]) & (kept <= part[-1])]
        assert inside.size >= 2
    np.testing.assert_array_equal(axes.decimate([1.0, np.inf, 2.0]), [0, 2])
    assert axes.decimate(np.full(3, np.nan)).size == 0


def paths_of(svg):
    """Points of the lines of a chart in tenths of a pixel, one list of strokes a line."""
    lines = []
    for d in re.findall(r'class="line\d"[^>]* d="(M-?\d+ ?-?\d+h0[^"]*)"', svg):
        strokes = []
        for command, a, b in re.findall(r"([Ml])(-?\d+) ?(-?\d+)", d):
            point = np.array([int(a), int(b)])
            if command == "M":
                strokes.append([point])
            else:
                strokes[-1].append(strokes[-1][-1] + point)
        lines.append([np.array(s) for s in strokes])
    return lines


def test_drawn_line_is_the_data():
    x = np.linspace(0, 10, 400)
    y = np.sin(x) * np.exp(-x / 5)
    chart = LineChart(x, [("y", y)], title="t", x_label="x", y_label="y")
    (strokes,) = paths_of(chart.svg)
    assert len(strokes) == 1
    drawn = strokes[0]
    assert drawn.shape == (400, 2)
    fitted = np.polyfit(drawn[:, 1], y, 1)
    np.testing.assert_allclose(np.polyval(fitted, drawn[:, 1]), y, atol=2e-3)
    assert fitted[0] < 0  # up is up
    assert not chart.note


def test_what_is_not_finite_leaves_a_gap_and_is_said():
    x = np.arange(100.0)
    y = x.copy()
    y[40:50], y[70] = np.nan, np.inf
    y[90:] = 1e305  # beyond what can be drawn
    chart = LineChart(x, [("y", y)], title="t", x_label="time [s]", y_label="y", caption="Words.")
    (strokes,) = paths_of(chart.svg)
    assert [len(s) for s in strokes] == [40, 20, 19]
    assert chart.note.startswith("Words. y: 21 of 100 values are not finite (first at time [s] = 40)")
    assert "nan" not in chart.svg
    assert "inf" not in chart.svg
    nothing = LineChart(x, [("y", np.full(100, np.nan))], title="t", x_label="x", y_label="y")
    assert paths_of(nothing.svg) == []
    assert "no finite value to draw" in nothing.svg
    assert "100 of 100" in nothing.note


def test_a_lone_point_is_a_dot():
    chart = LineChart([0, 1, 2], [("y", [np.nan, 1, np.nan])], title="t", x_label="x", y_label="y")
    assert [len(s) for s in paths_of(chart.svg)[0]] == [1]


def read_out(chart):
    """What a slider reads out of a chart: instants, values by line, and where it begins."""
    (chart_values,) = re.findall(r' data-readings="([^"]*)"', chart.svg)
    chart_values = json.loads(html.unescape(chart_values))

    def values(said):
        return np.array([np.nan if k is None else float(f"{k}e{said[0]}") for k in said[1]])

    return (
        values(chart_values["at"]),
        {line["name"]: values(line["at"]) for line in chart_values["lines"]},
        chart_values,
    )


@pytest.mark.parametrize("n", [1, 2, 7, 600, 749, 750, 751, 40_000])
def test_a_slider_has_samples_and_the_largest_difference_among_them(n):
    rng = np.random.default_rng(n)
    x = 3.0 + np.arange(n) * 0.0017
    y, z = 1e-6 * rng.standard_normal(n), 1e-6 * rng.standard_normal(n)
    chart = LineChart(
        x, [("measured", y), ("simulated", z)], title="t", x_label="time [s]", y_label="y [m]", slider=True
    )
    assert "data-readings" not in chart.narrow
    at, lines, chart_values = read_out(chart)
    assert 1 <= at.size <= 753
    assert n > 750 or at.size == n
    places = [int(np.argmin(np.abs(x - v))) for v in at]
    assert at == pytest.approx(x[places], abs=1e-4 * 0.0017 * n + 1e-9)
    for name, values in (("measured", y), ("simulated", z)):
        assert lines[name] == pytest.approx(values[places], abs=1e-5 * (np.ptp(values) + 1e-12))
    assert places[chart_values["begin"]] == np.argmax(np.abs(y - z))
    assert {0, n - 1} <= set(places)
    assert (chart_values["name"], chart_values["unit"], chart_values["y"]) == ("time", "s", "m")


def test_a_slider_has_nothing_where_there_is_nothing():
    t, gaps = np.arange(5.0), np.array([1.0, np.nan, np.inf, -1e300, 2e5])
    drawn = {"x_label": "time [s]", "y_label": "y", "title": "t", "slider": True}
    at, lines, chart_values = read_out(LineChart(t, [("measured", gaps), ("simulated", np.full(5, np.nan))], **drawn))
    assert at.tolist() == t.tolist()
    assert np.isnan(lines["simulated"]).all()
    assert np.isnan(lines["measured"]).tolist() == [False, True, True, False, False]
    assert lines["measured"][3] == -1e300
    assert (chart_values["apart"], chart_values["y"]) == (False, "")
    for other in ({"log_x": True}, {"log_y": True}, {"slider": False}):
        assert "data-readings" not in LineChart(t + 1, [("", t + 1)], **{**drawn, **other}).svg


def test_a_run_that_strays_does_not_flatten_the_measured_one():
    x = np.linspace(0, 10, 500)
    measured = np.sin(x)
    chart = LineChart(x, [("measured", measured), ("simulated", np.exp(3 * x))], title="t", x_label="x", y_label="y")
    heights = np.concatenate(paths_of(chart.svg)[0])[:, 1]
    assert np.ptp(heights) > 100  # tenths of a pixel
    assert "simulated leaves the axis (to 1.07×10¹³)" in chart.note
    assert len(chart.svg) < 20_000


def test_logarithmic_axis():
    x = np.arange(1, 1001)
    y = 1e4 / x**2.0
    y[5] = 0.0
    chart = LineChart(x, [("p = 7", y)], title="t", x_label="x", y_label="y", log_y=True)
    (strokes,) = paths_of(chart.svg)
    assert [len(s) for s in strokes] == [5, 994]
    drawn, kept = np.concatenate(strokes), np.delete(y, 5)
    fitted = np.polyfit(drawn[:, 1], np.log10(kept), 1)
    np.testing.assert_allclose(np.polyval(fitted, drawn[:, 1]), np.log10(kept), atol=0.01)
    assert "0 or less" in chart.note
    for low, high in ((0.1, 1000.0), (3.1, 3.9), (2.0, 60.0), (1e-30, 1e40)):
        small = LineChart([0, 1], [("y", [low, high])], title="t", x_label="x", y_label="y", log_y=True)
        assert len(re.findall('text-anchor="end">', small.svg)) >= 3


def test_lines_are_told_apart_without_colour():
    lines = [("measured", [0, 1])] + [(f"p = {p}", [p, p]) for p in (1, 3, 5, 7)]
    chart = LineChart([0, 1], lines, title="t", x_label="x", y_label="y")
    assert len(set(re.findall(r'stroke-dasharray="([\d ]+)"', chart.svg))) >= 3
    for name, _ in lines:
        assert f">{name}</text>" in chart.svg
        assert f">{name}</text>" in chart.narrow
    heights = [
        float(y) for y in re.findall(r'<text x="[\d.]+" y="([\d.]+)" text-anchor="start">(?:measured|p = )', chart.svg)
    ]
    assert np.min(np.diff(np.sort(heights))) >= LINE_HEIGHT_PX - 0.11


def test_extreme_data_still_draw():
    for y in ([0, 0], [5, 5], [-1e299, 1e299], [1e-300, 2e-300], [1, 1 + 1e-15], [0, 5e-324]):
        chart = LineChart([0, 1], [("y", y)], title="t", x_label="x", y_label="y")
        assert "nan" not in chart.svg
        Page(chart.svg)
    chart = LineChart([0], [("measured", [1])], title="t", x_label="x", y_label="y")
    Page(chart.svg)


def test_charts_refuse_what_does_not_fit():
    with pytest.raises(ftlm.DataError, match="at least one line"):
        LineChart([0, 1], [], title="t", x_label="x", y_label="y")
    with pytest.raises(ftlm.DataError, match="one length"):
        LineChart([0, 1], [("y", [1, 2, 3])], title="t", x_label="x", y_label="y")


def test_convergence_and_error_charts(square, identified):
    equation = identified.model.structure.equation("theta12")
    free = ftlm.flexible_link(form="published", laws=()).equation("theta12")
    orders = dict(zip(("alpha2", "beta2", "gamma2", "mu2"), (2.0, 0.1, 1.05, 0.85), strict=True))
    assert equation.outputs == free.outputs
    traces = [
        (f"p = {p}", ftlm.multi_innovation_trace(square, free.with_orders(orders), innovation_length=p, every=16))
        for p in (1, 7)
    ]
    chart = trace_chart(traces, title="Convergence")
    assert len(paths_of(chart.svg)) == 2
    other = ftlm.multi_innovation_trace(square, free.with_orders(orders), every=32)
    with pytest.raises(ftlm.DataError, match="other steps"):
        trace_chart([*traces, ("x", other)], title="t")
    found = error_chart([("best", identified.comparison)], "theta12", units={"theta12": "rad"})
    assert "|error| [rad]" in found.svg
    assert found._repr_html_().startswith("<figure>")


# ------------------------------------------------------------------------------------------------ pictures


def test_a_pole_map_has_every_pole_and_its_sector():
    model = ftlm.Model(ftlm.equation("D^1.8 y = -0.6 D^0.8 y - 9 y + 4 u"))
    (figure,) = pole_charts(model)
    assert "s^0.9" in figure.title
    lam = [m.pole**0.9 for m in model.modes()]
    assert f"{lam[0].real:.3g}".replace("-", "−")[:5] in figure.svg
    assert "2 points in the plane" in figure.svg
    assert "|arg s^0.9| < 81 degrees" in figure.caption
    assert "it has no pole" in figure.caption
    (grown,) = pole_charts(ftlm.Model(ftlm.equation("D^2 y = 0.6 D y - 9 y + u")))
    assert grown.title == "Poles in the plane of s"
    assert "it has 1 of 1 modes, so the model is not stable" in grown.caption
    assert "2 in the shaded sector" in grown.svg
    # A relaxation of fractional order stands on the negative axis.
    (slow,) = pole_charts(ftlm.Model(ftlm.equation("D^0.5 y = -2 y + u")))
    assert "−2.00 + 0j" in slow.svg
    assert pole_charts(ftlm.Model(ftlm.equation("D^2 y = -3 D y + 6 u - 0.5*sign(D y)"))) == []
    with pytest.raises(ftlm.errors.DataError, match="point 1 of 2 is not finite"):
        PlaneChart([1j, complex("nan")], title="t", x_label="x", y_label="y")
    for bad in (0.0, 4.0, -1.0):
        with pytest.raises(ftlm.errors.DataError, match="not an angle"):
            PlaneChart([1j], title="t", x_label="x", y_label="y", sector=bad)


def test_a_correlation_map_has_every_number():
    values = np.array([[1.0, -0.5], [-0.5, 1.0]])
    figure = CorrelationMap(["alpha", HOSTILE], values, title="t")
    assert figure.svg.count("−.50") == 2
    assert HOSTILE not in figure.svg
    assert "The largest" in figure.svg
    assert "–" in CorrelationMap(["a", "b"], [[1, np.nan], [np.nan, 1]], title="t").svg
    for names, bad, message in (
        (["a"], values, "shape"),
        ([], np.zeros((0, 0)), "shape"),
        (["a", "b"], 3 * values, r"outside \[-1, 1\]"),
    ):
        with pytest.raises(ftlm.errors.DataError, match=message):
            CorrelationMap(names, bad, title="t")


def test_a_histogram_counts_every_value():
    values = np.random.default_rng(1).standard_normal(500)
    figure = histogram([*values, np.nan], title="t", x_label="x")
    heights = [float(h) for h in re.findall(r'<rect class="shade2"[^>]* height="([\d.]+)"', figure.svg)]
    reach = np.max(np.abs(values - values.mean()))
    counts, _ = np.histogram(values, values.mean() + np.linspace(-reach, reach, len(heights) + 1))
    assert np.allclose(np.array(heights) / max(heights), counts / counts.max(), atol=0.01)
    assert "1 values are not finite" in figure.caption
    assert "Histogram of 500 values" in figure.svg
    constant = histogram([2.0, 2.0, 2.0], title="t", x_label="x")
    assert "standard deviation 0" in constant.svg
    for bad in ([], [1.0], [np.nan, np.inf, 1.0]):
        with pytest.raises(ftlm.errors.DataError, match="two finite values"):
            histogram(bad, title="t", x_label="x")


def test_models_stand_side_by_side_as_bars(identified, square, sine):
    own, other = identified.comparison, identified.model.compare(sine)
    both = [
        ("one", [("estimation", own), ("validation", other)]),
        (HOSTILE, [("estimation", own), ("validation", own)]),
    ]
    figures = compared_bars(both)
    assert [f.title for f in figures] == ["Fit of the simulation of θ₁₁", "Fit of the simulation of θ₁₂"]
    assert HOSTILE not in figures[0].svg
    widths = [float(w) for w in re.findall(r'<rect class="shade1"[^>]* width="([\d.]+)"', figures[1].svg)]
    assert widths[0] == widths[1] > 0
    below = BarChart(["a", "b"], [("fit", [-50.0, np.nan])], title="t", x_label="x", high=100.0)
    assert "−50.00" in below.svg
    assert "–" in below.svg
    for bad, message in (
        ([], "compared is empty"),
        ([("one", [("estimation", own)]), ("two", [("validation", own)])], "give comparisons on the same runs"),
    ):
        with pytest.raises(ftlm.errors.DataError, match=message):
            compared_bars(bad)
    for names, groups in (([], [("a", [])]), (["x"], []), (["x"], [("a", [1.0])] * 6), (["x"], [("a", [1.0, 2.0])])):
        with pytest.raises(ftlm.errors.DataError, match=r"names|shape"):
            BarChart(names, groups, title="t", x_label="x")


def test_residuals_over_time_are_those_of_the_comparison(identified):
    figures = residual_series(identified.comparison, units=identified.model.units, label="estimation")
    assert [f.title.rpartition(": ")[2] for f in figures] == ["over time", "histogram"] * 2
    missed = identified.comparison.measured["theta11"][0] - identified.comparison.simulated["theta11"][0]
    assert f"from {number(float(missed.min()), 4)} to {number(float(missed.max()), 4)}" in figures[0].svg
    assert "[rad]" in figures[1].svg


def test_coefficients_have_units_and_an_offset_its_number():
    model = ftlm.Model(
        ftlm.equation("D^2 y = a y + b u").with_coefficients({"a": -4.0, "b": 2.0}), units={"y": "rad", "u": "A"}
    )
    table = parameter_table(model)
    at = table.columns.index("unit")
    assert [str(row[at]) for row in table.rows] == ["s^-2", "s^-2 rad/A"]
    assert "s<sup>−2</sup> rad/A" in table.to_html()
    # The first derivative has no exponent.
    first = ftlm.equation("D y = a y + b D u").with_coefficients({"a": -4.0, "b": 2.0})
    assert "of D <i>u</i> in the equation" in parameter_table(ftlm.Model(first)).to_html()
    assert "<mn>1</mn>" not in equation_html(ftlm.Model(first).equations[0])
    html = str(equation_html(model.equations[0], offset={"constant": -0.25, "ramp": 0.5}))
    assert "0.25000" in html
    assert html.count('class="term"') == 4
    assert "<mi>c</mi>" in str(equation_html(model.equations[0], offset=" + c"))


def test_a_result_without_a_page_cannot_be_made():
    with pytest.raises(TypeError, match=r"abstract method '?_page"):
        type("Bare", (ReportMixin,), {})()


@pytest.mark.parametrize("narrow", [False, True])
def test_time_axes_above_one_another_are_aligned_and_exponents_raised(narrow):
    t = np.linspace(0.0, 8.0, 50)
    outputs = LineChart(
        t, [("measured", np.sin(t)), ("simulated", np.cos(t))], title="y", x_label="time [s]", y_label="y [m]"
    )
    inputs = LineChart(t, [("", 0.05 * np.sign(np.sin(t)))], title="u", x_label="time [s]", y_label="u [A s^-0.9]")
    places = []
    for drawing in (outputs.draw(narrow=narrow), inputs.draw(narrow=narrow)):
        left, _, width, _ = map(float, re.search(r'data-plot="([^"]*)"', drawing)[1].split())
        places.append((left, width))
    assert places[0] == places[1]
    raised = inputs.draw(narrow=narrow)
    assert '>u [A s<tspan dy="-5" font-size="9">−0.9</tspan><tspan dy="5">]</tspan></text>' in raised


def test_pages_show_minus_signs_and_keep_code(tmp_path):
    words = "correlation -0.75 at lag 3 (bound -.5), try --delay u=-0.01:0.1, p-1, 3 - 2"
    table = report.Table("estimates", ("name", "gain"), [["y", "order -1.05"]])
    section = report.Section("-2", [words], warnings=[words], more=[words], tables=[table])
    page = report.write_page(tmp_path / "page.html", title="t", sections=[section], lead=words).read_text("utf-8")
    assert page.count("correlation −0.75 at lag 3 (bound −.5), try --delay u=-0.01:0.1, p-1, 3 - 2") == 4
    assert "order −1.05" in page


def test_a_split_table_repeats_the_names_of_its_rows():
    groups = [("", 1), ("first", 2), ("second", 1)]
    table = report.Table("t", ("name", "a", "b", "c"), [["x", 1.0, 2.0, 3.0]], groups=groups, headings={0: "of x"})
    left, right = table.split(3)
    assert (left.columns, left.rows, left.groups) == (("name", "a", "b"), [["x", 1.0, 2.0]], groups[:2])
    assert (right.columns, right.rows, right.groups) == (["name", "c"], [["x", 3.0]], [("", 1), ("second", 1)])
    assert table.heads == ["name", "first a", "first b", "second c"]
    assert right.headings == {0: "of x"}
    assert 'data-head="second c"' in table.to_html()
    assert "data-head" not in right.to_html()
