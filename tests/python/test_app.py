"""The local page without a browser: who is let in, what is refused before it is read, from a file to a model."""

import ast
import asyncio
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import ftlm
import plants
from app_page import HOST, RAW, TOKEN, Page, error_message, put_beside, settled
from ftlm.app import session as desks
from ftlm.app import views as view
from ftlm.app.forms import NAMED_STRUCTURES, FitRequest, RunSource, parse_fields, parse_structures, split_time
from ftlm.app.session import Session, safe_name
from ftlm.app.subprocess_task import Task
from ftlm.app.web_application import WebApplication
from ftlm.errors import DataError, ModelError
from ftlm.svg.html_page import read_resource
from slow_cases import slow_after

HOSTILE = "<script>hacked=1</script><img src=x onerror=hacked=1>\"' & {{70707*7}}"


@pytest.fixture(scope="module", autouse=True)
def patience():
    """A busy machine may take long to open a file; the answers here are those of one that is open."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(desks, "OPEN_REPLY_TIMEOUT_S", 250.0)
        yield


@pytest.fixture(scope="module")
def loop():
    with asyncio.Runner() as runner:
        yield runner.run


@pytest.fixture
def page(tmp_path, loop):
    made = Page(tmp_path / "desk", loop)
    yield made
    loop(made.desk.close())


@pytest.fixture(scope="module")
def content():
    """A lag of first order, in volts and degrees."""
    return plants.written_lag(300, 5.0).encode()


@pytest.fixture(scope="module")
def used(tmp_path_factory, loop, content, patience):
    """A page with a file and the model of it."""
    made = Page(tmp_path_factory.mktemp("used") / "desk", loop)
    status, _, _ = made.upload("lag.csv", content)
    assert status == 200
    (key,) = made.desk.files
    wanted = {"estimation": key, "share": 0.3, "selection_mode": "fit", "structure": ["D y = a0 y + b0 u"]}
    status, _, text = made.own("POST", "models", wanted)
    assert status == 200, text
    (model,) = made.desk.models.values()
    loop(settled(made.desk))
    assert model.state == "made", model.error
    yield made
    loop(made.desk.close())


# ---------------------------------------------------------------------------------------------------- who is let in


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("GET", "/", {}, 404),
        ("GET", "/state", {}, 404),
        ("GET", f"/{TOKEN[:-1]}/", {}, 404),
        ("GET", f"/{TOKEN}x/", {}, 404),
        ("GET", "/é/", {}, 404),
        ("GET", f"/{TOKEN}/", {"host": "evil.example:8347"}, 403),
        ("GET", f"/{TOKEN}/", {"host": "127.0.0.1"}, 403),
        ("GET", f"/{TOKEN}/", {"host": "127.0.0.1:80"}, 403),
        ("GET", f"/{TOKEN}/", {"host": None}, 403),
        ("GET", f"/{TOKEN}/", {"origin": "http://evil.example"}, 403),
        ("GET", f"/{TOKEN}/", {"origin": "null"}, 403),
        ("POST", f"/{TOKEN}/models", {"origin": "http://evil.example"}, 403),
        ("POST", f"/{TOKEN}/models", {"origin": "https://127.0.0.1:8347"}, 403),
        ("POST", f"/{TOKEN}/models", {"origin": None}, 403),
        ("POST", f"/{TOKEN}/files", {"sec-fetch-site": "cross-site"}, 403),
        ("DELETE", f"/{TOKEN}/files/x", {"sec-fetch-site": "same-site"}, 403),
    ],
)
def test_strangers_are_refused_before_a_byte_of_a_body_is_read(page, method, path, headers, status):
    answer, sent, text = page.ask(method, path, b"x" * 100, headers)
    assert answer == status
    assert error_message(text)
    assert sent["content-security-policy"].startswith("default-src 'none'")
    assert page.pieces == 0


def test_a_header_that_is_given_twice_is_refused(page):
    pairs = [(b"host", HOST.encode()), (b"host", b"evil.example")]
    sent = []

    async def keep(message):
        sent.append(message)

    scope = {"type": "http", "method": "GET", "path": f"/{TOKEN}/", "query_string": b"", "headers": pairs}
    page.loop(page.door(scope, None, keep))
    assert sent[0]["status"] == 400


def test_the_first_address_is_good_once_and_leads_to_the_lasting_one(page):
    assert page.ask("GET", "/open/other")[0] == 404
    status, headers, _ = page.ask("GET", "/open/once")
    assert (status, headers["location"]) == (303, f"/{TOKEN}/")
    status, _, text = page.ask("GET", "/open/once")
    assert status == 404
    assert "terminal" in error_message(text)
    assert page.ask("GET", f"/{TOKEN}")[1]["location"] == f"/{TOKEN}/"
    without = WebApplication(page.desk, TOKEN, (HOST,))
    page.door = without
    assert page.ask("GET", "/open/")[0] == 404


@pytest.mark.parametrize("path", ["", "app.js", "app.css", "state", "comparison"])
def test_every_answer_forbids_other_scripts_frames_and_guesses(page, path):
    for method in ("GET", "HEAD"):
        status, headers, text = page.own(method, path)
        assert status == 200
        assert bool(text) == (method == "GET") or path == "comparison"
        policy = headers["content-security-policy"]
        assert "script-src 'self'" in policy
        assert "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert (headers["x-content-type-options"], headers["referrer-policy"]) == ("nosniff", "no-referrer")
        assert headers["cache-control"] == "no-store"


def test_the_page_names_nothing_that_is_not_its_own():
    assets = [
        view.script(),
        view.style(),
        *(read_resource(f"{n}.html.j2", "ftlm.app") for n in ("page", "file", "model", "comparison")),
    ]
    assert [re.findall(r"(?:https?:)?//\w+[.]\w+|@import|url\(", text) for text in assets] == [[]] * len(assets)
    # Nothing in a template runs as a script or brings a style of its own: the policy would refuse it.
    assert [re.findall(r"\son\w+=|<script(?! src)|<style|\sstyle=", text) for text in assets[2:]] == [[]] * 4


TRAVERSALS = [
    "..",
    "../..",
    "../../etc/passwd",
    "/etc/passwd",
    "....//",
    "..\\..\\x",
    "files/../../etc/passwd",
    "models/../../../etc/passwd/report",
    "models/..%2f..%2fetc%2fpasswd/report",
    "files/.",
    "app.js/../state",
    "models//report",
    "static/../app.js",
    "\0",
    "file:///etc/passwd",
    "work.py",
    "__init__.py",
]


@pytest.mark.parametrize("path", TRAVERSALS)
def test_no_file_of_the_machine_is_read_through_a_path(used, path):
    for method in ("GET", "POST", "DELETE"):
        status, _, text = used.own(method, path, {})
        assert status in (404, 405)
        assert "root:" not in text
        assert len(text) < 200


def test_ways_that_a_path_does_not_have_are_refused(used):
    (key,), (model,) = used.desk.files, used.desk.models
    paths = [
        "",
        "app.js",
        "app.css",
        "state",
        "files",
        "models",
        "check",
        "comparison",
        f"files/{key}",
        f"models/{model}",
        f"models/{model}/stop",
        f"models/{model}/resume",
        f"models/{model}/report",
        "files/0",
        "models/0",
    ]
    for path in paths:
        for method in ("PUT", "PATCH", "OPTIONS", "TRACE", "CONNECT", "PROPFIND", "X" * 50):
            status, _, _ = used.own(method, path)
            assert status in (404, 405), (method, path)
    assert used.own("GET", "files")[0] == used.own("DELETE", "models")[0] == 405
    assert used.own("GET", f"models/{model}/resume")[0] == 405
    # What is made stays made.
    assert used.own("POST", f"models/{model}/resume", {})[0] == 200
    assert list(used.desk.files) == [key]
    assert used.desk.models[model].state == "made"


# -------------------------------------------------------------------------------------------------- sizes and forms


def test_two_gigabytes_are_refused_by_their_length_alone(page):
    status, headers, text = page.own(
        "POST", "files", headers={"content-type": RAW, "content-length": str(2 << 30)}, query="name=big2.csv"
    )
    assert status == 413
    assert "256 MB" in error_message(text)
    assert headers["connection"] == "close"
    assert page.pieces == 0


@slow_after(2, "length", ["9" * 5000, "-1", "1e9", "²", ""])
def test_a_length_that_is_none_is_no_fault_and_what_comes_is_counted(page, content, monkeypatch, length):
    headers = {"content-type": RAW, "content-length": length}
    status, _, text = page.own("POST", "files", None, headers=headers, query="name=a.csv", chunks=[content])
    assert (status, "lag" in text or "a.csv" in text) == (200, True)
    monkeypatch.setattr(desks, "MAX_FILE_BYTES", 10)
    assert page.own("POST", "files", None, headers=headers, query="name=b.csv", chunks=[content])[0] == 413


def test_what_is_longer_than_it_said_is_refused_while_it_comes(page, monkeypatch):
    monkeypatch.setattr(desks, "MAX_FILE_BYTES", 10_000)
    for headers in ({}, {"content-length": "3"}, {"content-length": "x"}, {"content-length": "-5"}):
        page.pieces = 0
        status, _, _ = page.own(
            "POST",
            "files",
            headers={"content-type": RAW, **headers},
            query="name=long.csv",
            chunks=(b"x" * 1000 for _ in range(1000)),
        )
        assert status == 413
        assert page.pieces == 11
        assert list(page.desk.folder.iterdir()) == []
        assert page.desk.files == {}


def test_all_files_together_have_a_limit(page, monkeypatch):
    monkeypatch.setattr(desks, "MAX_TOTAL_BYTES", 1500)
    page.loop(put_beside(page.desk, "a.csv", 1000))
    status, _, text = page.own(
        "POST", "files", headers={"content-type": RAW}, query="name=b.csv", chunks=(b"x" * 100 for _ in range(10))
    )
    assert status == 413
    assert "remove one" in error_message(text)
    assert [p.name for p in page.desk.folder.iterdir()] == ["key-a.csv"]


def test_more_files_than_there_may_be_are_refused(page):
    for k in range(desks.MAX_FILES):
        page.loop(put_beside(page.desk, f"{k}.csv", 1))
    status, _, text = page.upload("one.csv", b"x")
    assert status == 413
    assert "20 files" in error_message(text)


def test_a_file_that_is_being_read_is_not_yet_fitted_and_says_so(page):
    page.loop(put_beside(page.desk, "large.csv", 1))
    wanted = {"estimation": "key-large", "structure": "D y = a y + b u"}
    for path in ("models", "check"):
        text = page.own("POST", path, wanted)[2]
        assert "'large.csv' is still being read; wait until its columns are shown" in error_message(text)
    # What was read before is no longer meant once it is read anew.
    page.desk.files["key-large"].preview = {"problem": "", "options": {}}
    page.desk.files["key-large"].task = Task({}, lambda _: None)
    assert "still being read" in error_message(page.own("POST", "models", wanted)[2])
    page.desk.files["key-large"].task = None
    page.desk.files["key-large"].preview["problem"] = "no output is named"
    assert "is not a run yet: no output is named" in error_message(page.own("POST", "models", wanted)[2])
    assert page.desk.models == {}


def test_an_upload_that_is_cut_off_leaves_nothing(page):
    status, _, text = page.own(
        "POST", "files", headers={"content-type": RAW}, query="name=cut.csv", chunks=[b"t,u,y\n"], cut=True
    )
    assert status == 400
    assert "cut off" in error_message(text)
    assert page.desk.files == {}
    assert list(page.desk.folder.iterdir()) == []


@pytest.mark.parametrize("kind", ["multipart/form-data; boundary=x", "text/plain", "", "application/json"])
def test_forms_are_no_files(page, kind):
    body = b'--x\r\nContent-Disposition: form-data; name="f"; filename="../../x"\r\n\r\nhi\r\n--y'
    status, _, text = page.own("POST", "files", headers={"content-type": kind}, query="name=x", chunks=[body])
    assert status == 415
    assert "octet-stream" in error_message(text)
    assert page.desk.files == {}
    assert page.pieces == 0


BODIES = [
    b"",
    b"{",
    b"[]",
    b"null",
    b'"x"',
    b"[" * 60_000,
    b"\xff\xfe",
    b"x" * 70_000,
    b'{"share": 1e999}',
    b'{"share": ' + b"9" * 4000 + b"}",
    b'{"structure": {}}',
    b'{"structure": [[]]}',
    b'{"selection_mode": []}',
]


@pytest.mark.parametrize("body", BODIES, ids=range(len(BODIES)))
def test_words_that_are_none_are_refused_in_words(used, body):
    (key,) = used.desk.files
    before = len(used.desk.models)
    for path in ("models", "check"):
        status, _, text = used.ask("POST", f"/{TOKEN}/{path}", body)
        assert status in (400, 413) or (status == 200 and path == "check")
        assert error_message(text)
    status, _, text = used.ask("POST", f"/{TOKEN}/files/{key}", body if body[:1] != b"{" else b'{"columns": 3}')
    assert status in (400, 413)
    assert len(used.desk.models) == before


def test_too_many_fields_of_an_address_are_refused(page):
    assert page.own("GET", "state", query="&".join(f"a{k}=1" for k in range(50)))[0] == 400


def test_a_fault_is_told_without_a_traceback(page, monkeypatch):
    monkeypatch.setattr(view, "state", lambda desk: 1 / 0)
    status, _, text = page.own("GET", "state")
    assert status == 500
    assert error_message(text) == "a fault in ftlm itself (ZeroDivisionError)"


NAMES = [
    "../../etc/passwd",
    "/etc/passwd",
    "..\\..\\boot.ini",
    "",
    ".",
    "..",
    "...",
    "/",
    "a\0b",
    "a\nb",
    "x" * 5000,
    "ä" * 300,
    "\ud800.csv",
    "x." + "y" * 5000,
]


@given(name=st.text() | st.sampled_from(NAMES))
def test_a_name_stays_in_its_folder(name):
    made = safe_name(name)
    assert made
    assert made not in (".", "..")
    assert not set(made) & set("/\\\0\n")
    assert len(made.encode("utf-8", "replace")) <= 200
    assert Path("/folder", made).parent == Path("/folder")


def test_two_files_of_one_name_are_two(page):
    page.loop(put_beside(page.desk, "run.csv.gz", 1))
    assert page.desk.unique_file_name("Run.csv.gz", 1) == "Run-2.csv.gz"
    assert page.desk.unique_file_name("../run.csv", 1) == "run.csv"


# ------------------------------------------------------------------------------------------------ from file to model


def test_a_file_is_told_as_ftlm_open_tells_it(used, content, tmp_path):
    (file,) = used.desk.files.values()
    path = tmp_path / "lag.csv"
    path.write_bytes(content)
    opened = ftlm.open_file(path).to_dict()
    assert json.loads(json.dumps(opened["columns"])) == file.preview["columns"]
    assert json.loads(json.dumps(opened["options"])) == file.preview["options"]
    assert file.preview["assumptions"] == [a.evidence for a in ftlm.open_file(path).assumptions]
    shown = view.file(file)
    assert "300 rows, step 0.05 s, 14.95 s in all" in shown
    assert "by their names" in shown
    assert [o["structure"] for o in file.preview["offers"]][:3] == [
        "D y = a0 y + b0 u",
        "D y = a0 y + b0 u(t - 0:1.5 s)",
        "D^alpha y = a0 y + b0 u",
    ]
    assert [len(ftlm.equation(o["structure"]).outputs) for o in file.preview["offers"]] == [1] * 9


def scripted(page, key, content, folder):
    """What the script of a model prints; its files are those of the page to the last bit."""
    status, headers, script = page.own("GET", f"models/{key}/script")
    assert status == 200
    assert re.fullmatch(r'attachment; filename="lag-\d-script.py"', headers["content-disposition"])
    (folder / "lag.csv").write_bytes(content)
    (folder / "script.py").write_text(script, encoding="utf-8")
    ran = subprocess.run([sys.executable, "script.py"], cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert page.own("GET", f"models/{key}/model")[2] == (folder / "lag-model.json").read_text(encoding="utf-8")
    assert page.own("GET", f"models/{key}/report")[2] == (folder / "lag-report.html").read_text(encoding="utf-8")
    return ran.stdout


def test_a_model_is_that_of_the_same_lines_of_python(used, content, tmp_path):
    (key,) = used.desk.models
    printed = scripted(used, key, content, tmp_path)
    assert printed.splitlines()[0].startswith(used.desk.models[key].description["verdict"]["level"].upper())
    model = ftlm.load_model(tmp_path / "lag-model.json")
    assert model.coefficients["a0"] == pytest.approx(-2, abs=0.1)


@slow_after(
    2,
    "structure",
    [
        "D y = a0 y + k y^3 + b0 u",
        "D y = a0 y + b0 u(t - 0:1.5 s)",
        "D^2 y = a1 D y - fc sign(D y) + b0 u",
        "D^3 y = a2 D^2 y + a1 D y + a0 y + b0 u",
    ],
)
def test_an_equation_with_a_power_a_delay_or_friction_is_fitted_on_the_page(page, content, loop, structure):
    assert page.upload("lag.csv", content)[0] == 200
    (key,) = page.desk.files
    wanted = {"estimation": key, "share": 0.3, "selection_mode": "fit", "structure": [structure]}
    assert page.own("POST", "models", wanted)[0] == 200
    loop(settled(page.desk))
    (model,) = page.desk.models.values()
    assert model.state == "made", model.error
    assert page.own("GET", f"models/{model.key}/report")[0] == 200


def test_a_choice_is_that_of_the_same_lines_and_knows_runs_in_motion(page, content, tmp_path):
    """What is chosen on a run from rest is validated on the part behind it, which starts in motion."""
    page.upload("lag.csv", content)
    (key,) = page.desk.files
    wanted = {
        "estimation": key,
        "share": 0.25,
        "selection_mode": "offered",
        "structure": ["D y = a0 y + b0 u", "D y = b0 u"],
    }
    status, _, text = page.own("POST", "models", wanted)
    assert status == 200, text
    page.loop(settled(page.desk))
    (model,) = page.desk.models.values()
    assert model.state == "made", model.error
    assert page.desk.files[key].preview["length"] == 300
    assert model.description["fits"][0]["validation"] > 95
    assert "Candidates" in model.description["choice"]["tables"][0]
    printed = scripted(page, model.key, content, tmp_path)
    assert printed.splitlines()[0] == model.description["choice"]["reason"]


def test_a_report_opens_where_it_reaches_nothing(used):
    (key,) = used.desk.models
    for what in ("report", "page", "model", "script"):
        _, headers, _ = used.own("GET", f"models/{key}/{what}")
        assert headers["content-security-policy"].startswith("sandbox allow-scripts;")
        assert ("attachment" in headers.get("content-disposition", "")) == (what != "page")
    assert used.own("GET", f"models/{key}/other")[0] == 404


def test_a_model_is_shown_verdict_first(used):
    (model,) = used.desk.models.values()
    shown = view.model(model)
    order = [
        shown.index(part) for part in ('class="first', 'class="equation"', "simulation fit", "<svg", "Download report")
    ]
    assert order == sorted(order)
    assert model.description["fits"][0]["validation"] > 90
    assert model.description["runs"] == ["lag", "lag"]
    assert view.comparison(used.desk).strip() == ""


def test_models_side_by_side_are_those_to_be_trusted_first(used):
    (first,) = used.desk.models.values()
    worse = desks.Model(
        "other",
        2,
        first.fit_request,
        state="made",
        description={
            **first.description,
            "verdict": {**first.description["verdict"], "level": "do not use"},
        },
    )
    best = desks.Model(
        "best",
        3,
        first.fit_request,
        state="made",
        description={
            **first.description,
            "verdict": {**first.description["verdict"], "level": "trust"},
            "fits": [{**first.description["fits"][0], "validation": 99.9}],
        },
    )
    desk = Session(used.desk.folder)
    desk.models = {"o": worse, "b": best}
    shown = view.comparison(desk)
    assert shown.index("#model-best") < shown.index("#model-other")
    assert "DO NOT USE" in shown


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"structure": ["D y = a0 z + b0 u"]}, "no signal 'z'"),
        ({"structure": ["D y = a0 y +"]}, None),
        ({"structure": ["D^alpha y"]}, None),
        ({"structure": []}, "no structure is given"),
        ({"structure": ["flexible_link(stage=1)"]}, "no signal"),
        ({"structure": ["__import__('os').system('id')"]}, None),
        ({"selection_mode": "guess"}, "selection_mode = 'guess' is not known"),
        ({"selection_mode": "offered", "structure": ["D y = a y + b u"]}, "a comparison needs at least two structures"),
        (
            {"selection_mode": "auto", "structure": [], "method": "least-squares"},
            "a structure selection uses output error",
        ),
        ({"method": "magic"}, "method = 'magic'"),
        ({"offset": "much"}, "offset = 'much'"),
        ({"loss": "none"}, "loss = 'none'"),
        ({"share": 0.95}, "outside [0, 0.8]"),
        ({"share": "x"}, "is not a number"),
        ({"share": True}, "is not a number"),
        ({"estimation": "nobody"}, "no file is chosen"),
        ({"validation": "nobody"}, "no file is chosen"),
        ({"structure": ["D y = a0 y + b0 u"] * 30}, "not an equation"),
        ({"structure": ["x" * 5000]}, "4000 letters"),
    ],
)
def test_what_is_asked_wrongly_is_said_in_ftlm_s_words(used, wanted, words):
    (key,) = used.desk.files
    usual = {"estimation": key, "share": 0.3, "selection_mode": "fit", "structure": ["D y = a0 y + b0 u"]}
    assert used.own("POST", "check", usual)[2] == '{"error": ""}'
    asked = used.own("POST", "check", {**usual, **wanted})[2]
    status, _, text = used.own("POST", "models", {**usual, **wanted})
    assert status == 400
    assert error_message(asked) == error_message(text)
    if words is not None:
        assert words in error_message(text)
    else:
        with pytest.raises(ModelError) as error:
            ftlm.equation(wanted["structure"][0])
        assert error_message(text) == str(error.value)
    assert len(used.desk.models) == 1


def test_names_with_scripts_in_them_are_text(used, loop):
    file = desks.File(
        "k",
        f"{HOSTILE}.csv",
        1,
        preview={
            **next(iter(used.desk.files.values())).preview,
            "kind": HOSTILE,
            "problem": HOSTILE,
            "assumptions": [HOSTILE],
            "notes": [HOSTILE],
            "advice": [HOSTILE],
            "columns": [
                {
                    "name": HOSTILE,
                    "role": "input",
                    "signal": HOSTILE,
                    "unit": HOSTILE,
                    "first": None,
                    "low": None,
                    "high": None,
                    "description": HOSTILE,
                }
            ],
            "options": {"inputs": {HOSTILE: HOSTILE}, "units": {HOSTILE: HOSTILE}, "outputs": {HOSTILE: HOSTILE}},
            "offers": [{"name": HOSTILE, "why": HOSTILE, "structure": HOSTILE, "output": HOSTILE}],
        },
    )
    fit_request = FitRequest(RunSource(f"{HOSTILE}.csv"), structure=(HOSTILE,))
    failed = desks.Model("m", 1, fit_request, state="failed", error=HOSTILE)
    broken = desks.File("b", f"{HOSTILE}.csv", 1, error=HOSTILE, version=1)
    for shown in (view.file(file), view.file(broken), view.model(failed)):
        assert "<script" not in shown
        assert "<img" not in shown
        assert "494949" not in shown
    assert HOSTILE not in view.file(file)


@given(
    name=st.sampled_from([HOSTILE, "a\"b'c", "x\\", "ä b", "a\u2028b", '"""', "$(id)", "\ud800"]) | st.text(min_size=1),
    text=st.sampled_from(["D y = a y + b u", '"); import os #', "x\n'''", *NAMED_STRUCTURES]) | st.text(min_size=1),
)
def test_a_script_is_python_whatever_names_are_in_it(name, text):
    options = {"time": name, "inputs": {name: text}, "units": {name: "V"}, "window": [0.5, None], "step": 0.1}
    fit_request = FitRequest(RunSource(name, options), RunSource(name), structure=(text,), method="least-squares")
    script = fit_request._script(None)
    tree = ast.parse(script.encode())
    calls = [ast.unparse(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call)]
    own = ("ftlm.load", "ftlm.equation", "ftlm.flexible_link", "ftlm.identify", "print", "result.summary")
    assert set(calls) <= {*own, "result.validate", "result.model.save", "result.report"}
    load = next(n for n in ast.walk(tree) if isinstance(n, ast.Call) and ast.unparse(n.func) == "ftlm.load")
    assert ast.literal_eval(load.args[0]) == name
    assert {k.arg: ast.literal_eval(k.value) for k in load.keywords} == options


def test_fields_become_arguments():
    columns = [
        {"name": "t", "role": "time", "signal": "", "unit": ""},
        {"name": "u [V]", "role": "input", "signal": " u ", "unit": "V"},
        {"name": "y", "role": "output", "signal": "", "unit": ""},
        {"name": "z", "role": "", "signal": "", "unit": ""},
    ]
    said = {"columns": columns, "step": "", "from": "1.5", "to": "", "header": "1", "decimal": "comma", "missing": ""}
    assert parse_fields(said) == {
        "window": [1.5, None],
        "layout": {"decimal": "comma", "header": 1},
        "time": "t",
        "inputs": {"u": "u [V]"},
        "outputs": {"y": "y"},
        "units": {"u": "V"},
    }
    assert parse_fields({}) == {}


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"step": "fast"}, "step: 'fast' is not a number"),
        ({"skip": "1.5"}, "skip: '1.5'"),
        ({"skip": "9" * 40}, "not a number of lines"),
        ({"skip": "²"}, "not a number of lines"),
        ({"decimal": []}, "decimal is not text"),
        ({"columns": "x"}, "not a list"),
        ({"columns": [3]}, "not an object"),
        ({"columns": [{"name": "a", "role": "boss"}]}, "'boss' of column 'a'"),
        ({"columns": [{"name": n, "role": "time"} for n in "ab"]}, "both have the role time"),
        (
            {"columns": [{"name": n, "role": r, "signal": "s"} for n, r in (("a", "input"), ("b", "output"))]},
            "two columns",
        ),
    ],
)
def test_fields_that_say_nothing_usable_are_refused(said, words):
    with pytest.raises(DataError, match=re.escape(words)):
        parse_fields(said)


def test_roles_are_changed_and_what_is_missing_is_said(page, content):
    status, _, text = page.upload("x.csv", content.replace(b"u [V]", b"first").replace(b"y [deg]", b"second"))
    assert status == 200
    assert "To do" in text
    assert "inputs=" not in text
    (key,) = page.desk.files
    roles = {"time [s]": "time", "first": "input", "second": "output"}
    columns = [{"name": n, "role": r, "signal": n[0] if r != "time" else "", "unit": ""} for n, r in roles.items()]
    status, _, text = page.own("POST", f"files/{key}", {"columns": columns, "from": "1", "to": "9"})
    assert status == 200
    assert "To do" not in text
    assert page.desk.files[key].preview["options"]["window"] == [1.0, 9.0]
    assert page.desk.files[key].preview["length"] == 160
    assert page.own("DELETE", f"files/{key}")[0] == 200
    assert list(page.desk.folder.iterdir()) == []


def test_no_folder_of_the_machine_is_shown(used, page):
    status, _, text = page.upload("broken.mat", b"no matrix at all" * 100)
    assert status == 200
    assert "cannot be read" in text
    assert "&#39;broken.mat&#39;" in text
    page.own("GET", "")
    for one in (used, page):
        assert one.all
        assert [t for t in one.all if str(one.desk.folder) in t or str(Path.home()) + "/" in t] == []


def test_a_share_is_cut_where_rows_are():
    for rows in (10, 300, 1001):
        for step in (0.05, 1 / 3, 1e-3, 7e5):
            cut = split_time(rows, step, 0.3)
            assert cut == pytest.approx(round(0.7 * rows) * step)


def test_recipes_survive_json():
    fit_request = FitRequest(RunSource("a", {"step": 0.1}), RunSource("b"), 0.0, ("D y = a y + b u",), "inside")
    assert FitRequest.of(json.loads(json.dumps(fit_request.to_dict()))) == fit_request
    assert [s.name for s in parse_structures(fit_request)] == ["equation"]
    assert [parse_structures(FitRequest(RunSource("a"), structure=(n,)))[0].name for n in NAMED_STRUCTURES]
