"""Reports in a real browser: no request, no error, zoom, hostile names inert, accessible, whole without scripts."""

import os
import re
import shutil
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import ftlm
from ftlm.findings import make_finding
from ftlm.report.html_report import model_page
from slow_cases import slow_after

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
if CHROMIUM is None and not os.environ.get("CI"):
    pytest.skip("no Chromium here; apt-get install chromium", allow_module_level=True)

sync_api = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python.sync_playwright")

HOSTILE = "</script><script>window.hacked = 1</script>\"><img src=x onerror=hacked=1><svg onload=hacked=1> & 'x'"
WIDTHS = (360, 800, 1280)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, small_model, small_run, with_noise):
    """Reports of an output-error fit, of a searched model and of a saved model, names hostile."""
    where = tmp_path_factory.mktemp("pages")

    def named(run, words):
        return ftlm.Run.from_arrays(
            step=run.step, inputs={"u": run["u"]}, outputs={"y": run["y"]}, units=run.units, name=words + HOSTILE
        )

    run = named(with_noise(small_run, 0.02, 1), "run ")
    n = 600
    late = ftlm.Run.from_arrays(
        step=0.02, inputs={"u": np.sin(np.arange(n) ** 1.2 / 30)}, outputs={"y": np.zeros(n)}, units=run.units
    )
    other = named(with_noise(small_model.simulate(late, tolerance=1e-4), 0.02, 2), "other ")
    words = "D^alpha y = a D^nu y + c y + b u"
    fit = ftlm.identify(run, replace(ftlm.equation(words), name="fit " + HOSTILE))
    fit.report(where / "fit.html", validation=other)
    ftlm.identify(with_noise(small_run, 0.02, 1), ftlm.equation(words)).report(where / "plain.html")
    estimated = fit.comparison
    np.savez(
        where / "fit.npz",
        time=estimated.times[0],
        measured=estimated.measured["y"][0],
        simulated=estimated.simulated["y"][0],
    )
    free = ftlm.equation(words, orders={"alpha": "1.3:1.9:0.1", "nu": "0.2:1.2:0.1"})
    searched = ftlm.identify(run, replace(free, name="search " + HOSTILE), method="multi-innovation")
    noted = make_finding("data_note", text="a warning " + HOSTILE)
    warned = replace(searched, findings=(*searched.findings, noted))
    warned.report(where / "search.html")
    model_page(ftlm.load_model(fit.model.save(where / "m.json")), where / "model.html", validation=other)
    return where


@pytest.fixture(scope="module")
def at(request, folder):
    """Where a page is, by its name; the paper's is made when it is asked for."""

    def path(name):
        where = folder / f"{name}.html"
        if not where.exists():
            request.getfixturevalue("reproduction").page(where)
        return where

    return path


PAGES = ("fit", "search", "model")
#: The page of the paper takes minutes to make.
ALL = (*PAGES, pytest.param("paper", marks=pytest.mark.slow))


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


class Opened:
    """A page that notes what it says and what it asks for."""

    def __init__(self, browser, path, **options):
        options = {"viewport": {"width": 1280, "height": 900}, **options}
        self.context = browser.new_context(**options)
        # Of a page that hangs: a busy machine takes several times as long as a free one.
        self.context.set_default_timeout(240_000)
        self.page = self.context.new_page()
        self.said, self.asked = [], []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("dialog", lambda dialog: (self.said.append(f"dialog {dialog.message}"), dialog.dismiss()))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.context.close()


def view_of(page, svg="svg.chart.wide[data-frame]"):
    return [float(v) for v in page.locator(svg).first.get_attribute("data-view").split()]


@pytest.mark.parametrize("name", ALL)
def test_a_page_asks_for_nothing_and_complains_of_nothing(browser, at, name):
    with Opened(browser, at(name)) as opened:
        opened.page.wait_for_timeout(200)
        assert opened.said == []
        assert [url for url in opened.asked if not url.startswith(("file:", "data:"))] == []
        assert len([url for url in opened.asked if url.startswith("file:")]) == 1
        assert at(name).stat().st_size < 2_000_000


@pytest.mark.parametrize("name", PAGES)
def test_hostile_names_are_text(browser, folder, name):
    with Opened(browser, folder / f"{name}.html") as opened:
        page = opened.page
        assert page.evaluate("typeof window.hacked") == "undefined"
        assert HOSTILE in page.title()
        assert HOSTILE in page.locator("h1").inner_text()
        assert page.locator("main img, main iframe, main object, main script").count() == 0
        assert page.evaluate("document.scripts.length") == 1
        if name == "search":
            assert "a warning " + HOSTILE in page.locator("main").inner_text()
        # Even a script that found its way in would not run: the page allows its own by hash.
        page.evaluate(
            "() => { const s = document.createElement('script'); s.textContent = 'window.hacked = 2';"
            " document.body.append(s); }"
        )
        assert page.evaluate("typeof window.hacked") == "undefined"


def test_zoom_by_buttons(browser, folder):
    with Opened(browser, folder / "fit.html") as opened:
        page = opened.page
        chart = page.locator("svg.chart.wide[data-frame]").first
        whole = [float(v) for v in chart.get_attribute("data-frame").split()]
        labels = chart.locator(".ticks text").all_text_contents()
        bar = page.locator(".zoom.wide").first
        assert bar.get_by_role("button", name="Zoom out").is_disabled()
        bar.get_by_role("button", name="Zoom in").click()
        low, high, *heights = view_of(page)
        assert (high - low) == pytest.approx((whole[1] - whole[0]) / 2)
        assert heights == whole[2:]
        assert chart.locator(".ticks text").all_text_contents() != labels
        bar.get_by_role("button", name="Move right").click()
        assert view_of(page)[1] == pytest.approx(whole[1])
        bar.get_by_role("button", name="Move left").focus()
        page.keyboard.press("Enter")
        assert view_of(page)[0] < low + (high - low)
        bar.get_by_role("button", name="Show the whole chart").click()
        assert view_of(page) == whole
        assert chart.locator(".ticks text").count() >= 4
        assert opened.said == []


def test_zoom_by_dragging_shows_what_was_dragged_over(browser, folder):
    with Opened(browser, folder / "fit.html") as opened:
        page = opened.page
        chart = page.locator("svg.chart.wide[data-frame]").first
        chart.scroll_into_view_if_needed()
        box = chart.bounding_box()
        left, top, width, height = [float(v) for v in chart.get_attribute("data-plot").split()]
        whole = [float(v) for v in chart.get_attribute("data-frame").split()]
        scale = box["width"] / float(chart.get_attribute("viewBox").split()[2])

        def place(x, y):
            return box["x"] + scale * (left + x * width), box["y"] + scale * (top + y * height)

        page.mouse.move(*place(0.25, 0.5))
        page.mouse.down()
        page.mouse.move(*place(0.5, 0.52), steps=4)
        page.mouse.up()
        span = whole[1] - whole[0]
        assert view_of(page)[:2] == pytest.approx([whole[0] + 0.25 * span, whole[0] + 0.5 * span], abs=0.01 * span)
        inner = [float(v) for v in chart.locator("svg.plot").get_attribute("viewBox").split()]
        assert inner[0] == pytest.approx(0.25 * 10 * width, rel=0.02)
        assert inner[2] == pytest.approx(0.25 * 10 * width, rel=0.02)
        page.mouse.dblclick(*place(0.5, 0.5))
        assert view_of(page) == whole
        # A box, taller than a slip of the hand, zooms in both directions.
        page.mouse.move(*place(0.2, 0.1))
        page.mouse.down()
        page.mouse.move(*place(0.4, 0.9), steps=4)
        page.mouse.up()
        assert view_of(page)[2] > whole[2]
        assert view_of(page)[3] < whole[3]
        assert opened.said == []


def read(page, k=0):
    """What the slider of a chart reads out, by its words."""
    said = page.locator(".slide .reads").nth(k).locator("span")
    texts = [part.inner_text().replace("−", "-").replace("\u00a0", " ").rsplit(" ", 2) for part in said.all()]
    return {words[0]: float(words[1]) for words in texts}


@pytest.mark.parametrize("width", [WIDTHS[0], WIDTHS[2]])
def test_a_slider_reads_out_measured_and_simulated(browser, folder, width):
    with Opened(browser, folder / "fit.html", viewport={"width": width, "height": 900}) as opened:
        page = opened.page
        kept = np.load(folder / "fit.npz")
        page.get_by_role("heading", name="Estimation: measured and simulated").click()
        slide = page.locator(".slide").filter(has=page.get_by_label(re.compile("estimation: run"))).first
        every = page.locator(".slide")
        assert every.count() == 2
        own = next(k for k in range(2) if "estimation" in every.nth(k).inner_html())
        # It begins where the two are farthest apart.
        apart = np.abs(kept["measured"] - kept["simulated"])
        far = int(np.argmax(apart))
        texts = read(page, own)
        assert texts["time"] == pytest.approx(kept["time"][far], rel=1e-3)
        assert texts["largest difference"] == pytest.approx(apart[far], rel=2e-3)
        handle = slide.locator("input")
        for key, at in (("Home", 0), ("ArrowRight", 1), ("End", -1)):
            handle.press(key)
            texts = read(page, own)
            assert texts["time"] == pytest.approx(kept["time"][at], abs=1e-3)
            for name in ("measured", "simulated"):
                assert texts[name] == pytest.approx(kept[name][at], rel=1e-3, abs=1e-5)
            assert texts["difference"] == pytest.approx(apart[at], rel=2e-3, abs=1e-4)
        assert handle.get_attribute("aria-valuetext").startswith("time ")
        # Where the chart is zoomed into, its window follows.
        kind = "narrow" if width < 620 else "wide"
        figure = page.locator("figure").filter(has=slide)
        figure.locator(f".zoom.{kind}").get_by_role("button", name="Zoom in").click()
        chart = figure.locator(f"svg.{kind}[data-frame]")
        for key, at in (("Home", 0), ("End", -1)):
            handle.press(key)
            low, high = [float(v) for v in chart.get_attribute("data-view").split()][:2]
            assert low <= kept["time"][at] <= high
            left, _, across, _ = [float(v) for v in chart.get_attribute("data-plot").split()]
            mark = float(chart.locator(".cursor path").get_attribute("d")[1:].split()[0])
            assert mark == pytest.approx(left + across * (kept["time"][at] - low) / (high - low), abs=0.1)
            assert chart.locator(".cursor circle").count() == 2
        assert opened.said == []


def test_a_click_on_a_chart_moves_its_slider(browser, folder):
    with Opened(browser, folder / "fit.html") as opened:
        page = opened.page
        chart = page.locator("svg.wide[data-readings]").first
        chart.scroll_into_view_if_needed()
        box, frame = chart.bounding_box(), [float(v) for v in chart.get_attribute("data-frame").split()]
        left, top, width, height = [float(v) for v in chart.get_attribute("data-plot").split()]
        scale = box["width"] / float(chart.get_attribute("viewBox").split()[2])
        page.mouse.click(box["x"] + scale * (left + 0.25 * width), box["y"] + scale * (top + 0.5 * height))
        span = frame[1] - frame[0]
        assert read(page)["time"] == pytest.approx(frame[0] + 0.25 * span, abs=0.01 * span)
        assert chart.get_attribute("data-view") is None
        assert opened.said == []


@slow_after(2, "name", ["fit", "search", "model", "paper"])
def test_without_scripts_everything_but_zoom_and_sliders_is_there(browser, at, name):
    def open_details(page):
        for summary in page.locator("details.part > summary").all():
            summary.click()

    with Opened(browser, at(name)) as opened:
        opened.page.evaluate("document.querySelectorAll('.zoom, .slide').forEach((z) => z.remove())")
        open_details(opened.page)
        with_scripts = opened.page.locator("main").inner_text()
    with Opened(browser, at(name), java_script_enabled=False) as opened:
        open_details(opened.page)
        assert opened.page.locator("main").inner_text() == with_scripts
        assert opened.page.locator(".zoom, .slide").count() == 0
        boxes = [c.bounding_box() for c in opened.page.locator("svg.chart.wide").all()]
        assert len(boxes) >= 4
        assert all(b["width"] > 200 and b["height"] > 80 for b in boxes)


#: Each page and each scheme; make test-slow takes all pairs.
IN_SCHEMES = [("fit", "dark"), ("search", "light")]


@slow_after(
    len(IN_SCHEMES),
    "name, scheme",
    sorted(product((*PAGES, "paper"), ("light", "dark")), key=lambda pair: pair not in IN_SCHEMES),
)
def test_the_accessibility_check_passes(browser, at, name, scheme):
    # Narrow in one scheme and wide in the other: colors and widths do not interact.
    width = WIDTHS[0 if scheme == "dark" else 2]
    with Opened(browser, at(name), viewport={"width": width, "height": 900}, color_scheme=scheme) as opened:
        opened.page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
        found = axe.Axe().run(opened.page)
        broken = [(v["id"], [n["html"][:120] for n in v["nodes"]][:3]) for v in found.response["violations"]]
        assert broken == []
        assert len(found.response["passes"]) > 10


@pytest.mark.parametrize("name", ALL)
def test_no_width_makes_a_page_scroll_sideways(browser, at, name):
    with Opened(browser, at(name)) as opened:
        page = opened.page
        page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            narrow, wide = (page.locator(f"svg.chart.{kind}").first for kind in ("narrow", "wide"))
            assert narrow.is_visible() == (width < 620)
            assert wide.is_visible() == (width >= 620)
            assert page.locator(".zoom:visible").count() == page.locator("svg.chart[data-frame]:visible").count()


@pytest.mark.parametrize("name", ALL)
def test_charts_have_the_size_of_their_text(browser, at, name):
    widest = "Math.max(...all.map((e) => e.getBoundingClientRect().width / e.getAttribute('width')))"
    for width, most in ((1280, 1.001), (600, 1.201)):
        with Opened(browser, at(name), viewport={"width": width, "height": 900}) as opened:
            opened.page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
            assert 0 < opened.page.locator("svg.chart").evaluate_all(f"(all) => {widest}") <= most


@pytest.mark.parametrize("width", [360, 1280])
def test_no_table_is_cut(browser, folder, width):
    with Opened(browser, folder / "plain.html", viewport={"width": width, "height": 900}) as opened:
        opened.page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
        cut = "(all) => all.filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => e.ariaLabel)"
        assert opened.page.locator(".scroll").evaluate_all(cut) == []
        heads = opened.page.locator(".stacked td[data-head]")
        # The heads of the columns stand in the cells where the row of heads is not shown.
        shown = "(all) => all.map((e) => getComputedStyle(e, '::before').content)"
        assert all((text != "none") == (width < 620) for text in heads.evaluate_all(shown))


def test_paper_has_no_buttons_and_equations_are_typeset(browser, folder):
    with Opened(browser, folder / "fit.html") as opened:
        page = opened.page
        # Typeset: the exponent stands above the line of its base.
        up, base = (page.locator(f"math msup > :nth-child({k})").first.bounding_box() for k in (2, 1))
        assert up["y"] < base["y"]
        page.emulate_media(media="print")
        assert page.locator(".zoom:visible, .slide:visible, .cursor:visible").count() == 0
        assert page.locator("nav").is_hidden()
        parts = page.locator("details.part")
        assert parts.count() > 4
        assert all(part.bounding_box()["height"] > 100 for part in parts.all())
        printed = page.pdf(format="A4")
        assert printed.startswith(b"%PDF")
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"


@pytest.mark.slow
def test_the_paper_s_page_names_what_holds_first(browser, at):
    with Opened(browser, at("paper"), viewport={"width": 360, "height": 900}) as opened:
        page = opened.page
        heads = page.locator("h2").all_inner_texts()
        assert heads[0] == "What holds and what does not"
        rows = page.locator("section").first.locator("table").first.locator("tbody tr")
        assert rows.count() == page.locator(".verdict strong").count() == 17
        assert "316 times less" in rows.first.inner_text()
        assert rows.locator("svg.share").count() == 17
        # Numbers stand behind folds, closed on a screen and open on paper.
        assert not page.locator(".verdict strong").first.is_visible()
        page.locator("summary").first.click()
        assert page.locator(".verdict strong").first.is_visible()
        assert page.locator(".warnings").count() == 0
        assert page.locator("svg.chart.narrow").first.is_visible()
        # Zooming works here, too.
        page.locator(".zoom.narrow button:visible").first.click()
        assert opened.said == []


def test_the_fit_comes_first_and_details_open(browser, folder):
    with Opened(browser, folder / "search.html") as opened:
        heads = opened.page.locator("h2").all_inner_texts()
        assert heads[0].startswith("Measured and simulated")
        assert {"Equations", "Warnings", "Errors", "Residuals", "Frequency response"} <= set(heads)
        residuals = opened.page.locator("details", has=opened.page.get_by_role("heading", name="Residuals"))
        assert not residuals.locator("svg:visible").count()
        residuals.locator("summary").click()
        assert residuals.locator("svg:visible").count()
        assert {"Convergence of the recursion", "Order search", "Settings"} <= set(heads)


def test_the_accessibility_check_can_fail(browser, tmp_path):
    path = tmp_path / "poor.html"
    path.write_text(
        '<html><title>x</title><body style="color:#bbb;background:#fff"><img src="data:,">faint</body></html>'
    )
    with Opened(browser, path) as opened:
        found = {v["id"] for v in axe.Axe().run(opened.page).response["violations"]}
        assert {"image-alt", "color-contrast", "html-has-lang"} <= found
