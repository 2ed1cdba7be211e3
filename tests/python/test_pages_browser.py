"""Pages of the documentation on a telephone in a real browser: tables and formulas keep to its width."""

import shutil
import sys
import warnings
from pathlib import Path

import pytest

from test_browser import WIDTHS, Opened, axe, browser  # noqa: F401 — browser is a fixture

sphinx = pytest.importorskip("sphinx.application")
pytest.importorskip("myst_parser")
pytest.importorskip("pydata_sphinx_theme")

DOCS = Path(__file__).parents[2] / "docs"
#: Pages with tables of three and more columns, or with formulas; those that are built by the slow tests only.
NAMES = ("comparison", "findings", "frequency_data", "mathematics")
SLOW_NAMES = ("arm", "bad_data", "numbers", "rig", "threats")
#: Of long words: an address, types and arguments.
REFERENCE = ("autofunction:: ftlm.fractional_integral", "autofunction:: ftlm.search_orders", "autoclass:: ftlm.Run")
#: Settings of docs/conf.py that the appearance of a page depends on.
SETTINGS = (
    "extensions",
    "numpydoc_show_class_members",
    "source_suffix",
    "myst_enable_extensions",
    "html_math_renderer",
    "html_theme",
    "html_css_files",
)
WIDTH = 390

#: Tables, cells, formulas and pages that reach beyond the window, or whose contents scroll sideways.
TOO_WIDE = """() => {
  const scrolls = (e) => e.clientWidth && e.scrollWidth > e.clientWidth + 1;
  const parts = document.querySelectorAll('table, tbody td, svg.formula, .bd-article-container, :has(> table)');
  return [...parts].filter((e) => e.getBoundingClientRect().right > innerWidth + 1 || scrolls(e))
    .map((e) => [e.tagName, e.className.toString(), e.textContent.slice(0, 60)]);
}"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory, request):
    """The pages of the tests that run, without the reference and the pictures, whose making takes minutes."""
    source, built = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("built")
    tests = [item for item in request.session.items if item.path == request.path and hasattr(item, "callspec")]
    names = sorted({*NAMES, *(item.callspec.params.get("name", NAMES[0]) for item in tests)} - {"reference"})
    for name in names:
        shutil.copy(DOCS / f"{name}.md", source)
    listed = "".join(f".. {line}\n\n" for line in REFERENCE)
    (source / "reference.md").write_text(f"# Reference\n\n```{{eval-rst}}\n{listed}```\n", encoding="utf-8")
    listed = "\n".join((*names, "reference"))
    (source / "index.md").write_text(f"# Pages\n\n```{{toctree}}\n{listed}\n```\n", encoding="utf-8")
    # Extensions warn of what later versions of Sphinx remove.
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(action="ignore"):
        patch.syspath_prepend(str(DOCS))
        patch.delitem(sys.modules, "conf", raising=False)
        import conf

        settings = {name: getattr(conf, name) for name in SETTINGS}
        settings["html_static_path"] = [str(DOCS / "_static")]
        app = sphinx.Sphinx(source, None, built, built / ".trees", "html", settings, status=None, warning=None)
        app.build()
    return built


@pytest.mark.parametrize("name", [*NAMES, "reference", *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW_NAMES)])
def test_tables_and_formulas_keep_to_the_width_of_a_telephone(browser, pages, name):  # noqa: F811
    with Opened(browser, pages / f"{name}.html", viewport={"width": WIDTH, "height": 900}) as opened:
        assert opened.page.evaluate(TOO_WIDE) == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_cells_name_their_columns_on_a_telephone_only(browser, pages, scheme):  # noqa: F811
    for width in (WIDTH, WIDTHS[2]):
        size = {"width": width, "height": 900}
        with Opened(browser, pages / "comparison.html", viewport=size, color_scheme=scheme) as opened:
            row = opened.page.locator("table.stacked").first.locator("tbody tr").first
            heads = row.locator("p.head")
            assert heads.count() == 6
            assert heads.nth(1).text_content() == "validation fit, median [%]"
            assert all(heads.nth(k).is_visible() == (width == WIDTH) for k in range(6))
            assert opened.page.locator("table.stacked thead").first.bounding_box()["height"] > (
                1 if width > WIDTH else 0
            )
            found = axe.Axe().run(opened.page, ".stacked", {"runOnly": ["color-contrast"]})
            assert [v["id"] for v in found.response["violations"]] == []
