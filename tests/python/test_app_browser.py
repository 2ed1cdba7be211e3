"""The local page as a person uses it: its own server, a real browser, from a dropped file to downloads."""

import contextlib
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from urllib.parse import urlsplit

import pytest

import ftlm
import plants
from slow_cases import slow_after

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
HOSTILE = "<img src=x onerror=window.hacked=1>"
SLOW = "D^a1 y = p1 D^m1 y + p2 D^m2 y + p3 D^m3 y + p4 D^m4 y + p5 D^m5 y + p6 D^m6 y + p7 y + b0 u"


@pytest.fixture(scope="module")
def content():
    """A lag of first order; one column bears markup as its name."""
    return plants.written_lag(200, 4.0, **{HOSTILE: 0})


class Served:
    """The command in a process of its own."""

    def __init__(self, folder, *words):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ftlm", "app", "--no-browser", "--port", "0", *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": str(folder)},
            start_new_session=True,
        )
        self.address = re.search(r"http://\S+", self.process.stdout.readline())[0]
        parts = urlsplit(self.address)
        self.port, self.path, self.host = parts.port, parts.path, parts.netloc

    def end(self, how=signal.SIGINT):
        if self.process.poll() is None:
            self.process.send_signal(how)
        return self.process.communicate(timeout=120)


@pytest.fixture(scope="module")
def served(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("served")
    (folder / "own").mkdir()
    (folder / "first.csv").write_text(content)
    made = Served(folder / "own", folder / "first.csv")
    yield made
    _, said = made.end()
    assert "Traceback" not in said
    assert list((folder / "own").iterdir()) == []


# ------------------------------------------------------------------------------------------------------ its server


def test_a_thousand_requests_are_answered(served):
    connection = http.client.HTTPConnection("127.0.0.1", served.port, timeout=120)
    seen = set()
    for k in range(1000):
        connection.request("GET", f"{served.path}state" if k % 2 else "/nothing", headers={"Host": served.host})
        answer = connection.getresponse()
        answer.read()
        seen.add((k % 2, answer.status))
    connection.close()
    assert seen == {(0, 404), (1, 200)}


def raw(port, *pieces):
    """What comes back for bytes that no browser sends; one that is cut off is what it is."""
    with socket.create_connection(("127.0.0.1", port), timeout=120) as sock:
        got = b""
        with contextlib.suppress(ConnectionError):
            for piece in pieces:
                sock.sendall(piece)
            while chunk := sock.recv(1 << 16):
                got += chunk
        return got


def test_what_no_browser_sends_is_refused(served):
    head = f"POST {served.path}files?name=x HTTP/1.1\r\nHost: {served.host}\r\nOrigin: http://{served.host}\r\n"
    kind = "Content-Type: application/octet-stream\r\n"
    big = raw(served.port, f"{head}{kind}Content-Length: {2 << 30}\r\n\r\n".encode())
    assert big.startswith(b"HTTP/1.1 413")
    assert b"256 MB" in big
    form = raw(served.port, f"{head}Content-Type: multipart/form-data\r\nContent-Length: 3\r\n\r\n--x".encode())
    assert form.startswith(b"HTTP/1.1 415")
    for nonsense in (
        b"\0" * 100 + b"\r\n\r\n",
        b"GET\r\n\r\n",
        b"GET / HTTP/9.9\r\n\r\n",
        b"\x16\x03\x01 \r\n\r\n",
        f"{head}{kind}Transfer-Encoding: chunked\r\n\r\nZZZ\r\n".encode(),
        f"{head}{kind}Content-Length: 3\r\nContent-Length: 4\r\n\r\nabcd".encode(),
        b"GET / HTTP/1.1\r\nHost: x\r\nX: " + b"y" * 200_000 + b"\r\n\r\n",
    ):
        assert raw(served.port, nonsense)[:12] in (b"HTTP/1.1 400", b"HTTP/1.1 403", b"")
    strange = f"GET {served.path} HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n"
    assert raw(served.port, strange.encode()).startswith(b"HTTP/1.1 403")
    up = f"{served.path}..%2f..%2fetc%2fpasswd"
    for path in ("/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", up):
        asked = f"GET {path} HTTP/1.1\r\nHost: {served.host}\r\nConnection: close\r\n\r\n"
        assert raw(served.port, asked.encode()).startswith(b"HTTP/1.1 404")


def test_it_listens_on_this_machine_alone(served):
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))
        other = probe.getsockname()[0]
        if not other.startswith("127."):
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((other, served.port), timeout=5)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", served.port), timeout=5)


# ----------------------------------------------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None and not os.environ.get("CI"):
        pytest.skip("no Chromium here; apt-get install chromium")
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@contextlib.contextmanager
def opened(browser, served, **options):
    """The page, with what it says and what it asks for."""
    context = browser.new_context(viewport={"width": 1280, "height": 900}, **options)
    # Of a page that hangs: a busy machine takes several times as long as a free one.
    context.set_default_timeout(240_000)
    page = context.new_page()
    page.said, page.asked = [], []
    page.on("console", lambda message: page.said.append(message.text))
    page.on("pageerror", lambda error: page.said.append(str(error)))
    page.on("request", lambda request: page.asked.append(request.url))
    page.goto(served.address)
    try:
        yield page
    finally:
        context.close()


def made(page, number):
    """The card of a model, once it is made."""
    card = page.locator(".model", has=page.locator("h3", has_text=re.compile(rf"^{number} · ")))
    card.locator(".first").wait_for()
    return card


def test_from_a_dropped_file_to_downloads(browser, served, content, tmp_path):
    with opened(browser, served) as page:
        # The file of the command line is there already; another one is dropped.
        page.locator(".file h3", has_text="first.csv").wait_for()
        data = page.evaluate_handle(
            "(text) => { const d = new DataTransfer(); d.items.add(new File([text], 'dropped.csv')); return d; }",
            content,
        )
        page.dispatch_event("#drop", "drop", {"dataTransfer": data})
        card = page.locator(".file", has=page.locator("h3", has_text="dropped.csv"))
        card.wait_for()
        assert card.get_by_label("role of u [V]").input_value() == "input"
        assert "by their names" in card.inner_text()
        assert HOSTILE in card.inner_text()
        # A changed unit is read again.
        card.get_by_label("unit of y [deg]").fill("rad")
        card.get_by_label("unit of y [deg]").press("Enter")
        page.get_by_text("Read again.").wait_for()
        page.get_by_label("Fit to").select_option(label="dropped.csv")
        page.get_by_role("button", name="Lag first order").click()
        page.get_by_label("Equation", exact=True).fill("D y = a0 yy + b0 u")
        page.get_by_text("did you mean 'y'").wait_for()
        page.get_by_role("button", name="Make the model").click()
        page.get_by_text("did you mean 'y'").wait_for()
        assert page.locator(".model").count() == 0
        page.get_by_role("button", name="Lag first order").click()
        page.get_by_role("button", name="Make the model").click()
        model = made(page, 1)
        assert model.locator(".first strong").inner_text().lower() in ("trust", "with care", "do not use")
        assert model.locator("svg.chart").first.is_visible()
        for name, ending in (
            ("Download report", "report.html"),
            ("Download script", "script.py"),
            ("Download model", "model.json"),
        ):
            with page.expect_download() as waiting:
                model.get_by_role("link", name=name, exact=True).click()
            assert waiting.value.suggested_filename == f"dropped-1-{ending}"
            waiting.value.save_as(tmp_path / ending)
        found = ftlm.load_model(tmp_path / "model.json")
        assert found.coefficients["a0"] == pytest.approx(-2, abs=0.2)
        assert found.units["y"] == "rad"
        page.get_by_role("button", name="Lag of free order").click()
        page.get_by_role("button", name="Make the model").click()
        made(page, 2)
        page.get_by_label("Models compared").wait_for()
        assert page.get_by_label("Models compared").locator("tbody tr").count() == 2
        with page.context.expect_page() as waiting:
            model.get_by_role("link", name="Open the report").click()
        waiting.value.wait_for_load_state()
        assert "rad" in waiting.value.locator("body").inner_text()
        assert page.evaluate("typeof window.hacked") == "undefined"
        # A browser notes the one request that was refused.
        assert [words for words in page.said if "400 (Bad Request)" not in words] == []
        own = (f"http://{served.host}/", "data:", "blob:")
        assert [url for url in page.asked if not url.startswith(own)] == []


def test_who_leaves_in_the_middle_finds_the_model_and_who_stops_loses_nothing(browser, served):
    with opened(browser, served) as page:
        before = page.locator(".model").count()
        page.get_by_label("Equation", exact=True).fill(SLOW)
        page.get_by_role("button", name="Make the model").click()
        page.locator(".model progress").wait_for()
    with opened(browser, served) as page:
        card = page.locator(".model", has=page.locator("progress"))
        card.wait_for()
        card.get_by_role("button", name="Stop").click()
        page.get_by_text("Stopped").first.wait_for()
        assert page.locator(".model").count() == before + 1
        assert page.locator(".model[data-state=made]").count() == before
        card = page.locator(".model[data-state=stopped]").first
        card.get_by_role("button", name=re.compile("Remove")).click()
        card.wait_for(state="detached")
        assert page.locator(".model").count() == before
        assert page.said == []


# Colors and widths do not interact.
@slow_after(2, "scheme, checked_width", [("light", 1280), ("dark", 360), ("light", 360), ("dark", 1280)])
def test_the_accessibility_check_passes_and_no_width_scrolls_sideways(browser, served, scheme, checked_width):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    with opened(browser, served, color_scheme=scheme) as page:
        page.locator(".file").first.wait_for()
        for width in (360, 1280):
            page.set_viewport_size({"width": width, "height": 900})
            page.evaluate("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            # On a telephone, rows are blocks whose cells state the heads of their columns; no table is cut.
            heads = page.locator(".file td[data-head=role]").first
            head = heads.evaluate("(cell) => getComputedStyle(cell, '::before').content")
            assert head == ('"role"' if width < 620 else "none")
            if width < 620:
                cut = "(all) => all.filter((e) => e.scrollWidth > e.clientWidth + 1).map((e) => e.ariaLabel)"
                assert page.locator(".scroll").evaluate_all(cut) == []
        page.set_viewport_size({"width": checked_width, "height": 900})
        found = axe.Axe().run(page)
        broken = [(v["id"], [n["html"][:120] for n in v["nodes"]][:3]) for v in found.response["violations"]]
        assert broken == []
        assert len(found.response["passes"]) > 10


def test_all_of_it_goes_by_keyboard(browser, served):
    with opened(browser, served) as page:
        page.locator(".file").first.wait_for()
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.id") == "pick"
        reached = set()
        for _ in range(60):
            page.keyboard.press("Tab")
            reached.add(page.evaluate("document.activeElement.id || document.activeElement.textContent.trim()"))
        assert {"estimation", "validation", "structure", "Make the model"} <= reached


# ----------------------------------------------------------------------------------------------------------- its end


@pytest.mark.parametrize(
    "how", [signal.SIGINT, *(pytest.param(s, marks=pytest.mark.slow) for s in (signal.SIGTERM, signal.SIGHUP))]
)
def test_it_ends_cleanly_with_its_work(tmp_path, content, how):
    (tmp_path / "own").mkdir()
    (tmp_path / "run.csv").write_text(content)
    served = Served(tmp_path / "own", tmp_path / "run.csv")
    headers = {"Host": served.host, "Origin": f"http://{served.host}"}
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", served.port, timeout=120)) as connection:
        connection.request("GET", f"{served.path}state", headers=headers)
        (key,) = json.loads(connection.getresponse().read())["files"]
        body, answer = json.dumps({"estimation": key, "structure": SLOW}), b"still being read"
        while b"still being read" in answer:
            connection.request("POST", f"{served.path}models", body, headers)
            response = connection.getresponse()
            answer = response.read()
        assert response.status == 200
    _, said = served.end(how)
    assert served.process.returncode == 0
    assert "Traceback" not in said
    assert "has ended" in said
    assert list((tmp_path / "own").iterdir()) == []
