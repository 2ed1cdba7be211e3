"""The local page without a browser: who is let in, what is refused before it is read, from a file to a model."""

import ast
import asyncio
import contextlib
import http.client
import json
import os
import re
import signal
import socket
import sqlite3
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import ftlm
import plants
from ftlm.app import server as serve
from ftlm.app import session as desks
from ftlm.app import views as view
from ftlm.app.forms import NAMED_STRUCTURES, FitRequest, RunSource, parse_fields, parse_structures, split_time
from ftlm.app.session import Session, safe_name
from ftlm.app.subprocess_task import Task, TaskError
from ftlm.app.web_application import CLIENT_TIMEOUT_S, TimedConnection, WebApplication
from ftlm.cli.main import app
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.svg.html_page import read_resource
from ftlm.utils.parameters import (
    FIELD_BY_PARAMETER,
    NAMED_COLUMNS,
    Placeholder,
    choose_text,
    layout_parameter,
    parameter,
    use_interface,
)
from ftlm.utils.resources import python_child

TOKEN, HOST = "0123456789abcdef", "127.0.0.1:8347"
HOSTILE = "<script>hacked=1</script><img src=x onerror=hacked=1>\"' & {{70707*7}}"
RAW = "application/octet-stream"


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


class Page:
    """A page and the one that asks it, without a network."""

    def __init__(self, folder, loop):
        folder.mkdir()
        self.desk = Session(folder)
        self.door = WebApplication(self.desk, TOKEN, (HOST, "localhost:8347"), "once")
        self.loop = loop
        self.pieces = 0
        self.all = []

    def ask(self, method, path, body=b"", headers=None, chunks=None, query="", cut=False):
        """Status, headers and text of one answer; ``chunks`` come one by one, ``cut`` ends them early."""
        given = {"host": HOST, **({} if method in ("GET", "HEAD") else {"origin": f"http://{HOST}"}), **(headers or {})}
        pairs = [(n.encode(), v.encode()) for n, v in given.items() if v is not None]
        coming = iter([body] if chunks is None else chunks)
        sent = []

        async def receive():
            self.pieces += 1
            piece = next(coming, None)
            if piece is None:
                return {"type": "http.disconnect"} if cut else {"type": "http.request", "body": b""}
            return {"type": "http.request", "body": piece, "more_body": chunks is not None}

        async def send(message):
            sent.append(message)

        scope = {"type": "http", "method": method, "path": path, "query_string": query.encode(), "headers": pairs}
        self.loop(self.door(scope, receive, send))
        start, end = sent
        text = end["body"].decode()
        headers = {n.decode(): v.decode("latin-1") for n, v in start["headers"]}
        self.all.append(text)
        return start["status"], headers, text

    def own(self, method, path, said=None, **more):
        """As the page itself asks."""
        body = b"" if said is None else json.dumps(said).encode()
        return self.ask(method, f"/{TOKEN}/{path}", body, **more)

    def upload(self, name, content, **more):
        return self.own(
            "POST", "files", None, headers={"content-type": RAW}, query=f"name={name}", chunks=[content], **more
        )


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


async def until(condition):
    """Wait for what other tasks of the loop bring about."""
    while not condition():
        await asyncio.sleep(0.005)


async def settled(desk):
    """Until nothing waits or runs."""
    await until(lambda: not any(m.is_busy for m in desk.models.values()))


def error_message(text):
    return json.loads(text)["error"]


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


@pytest.mark.parametrize("length", ["9" * 5000, "-1", "1e9", "²", ""])
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


async def put_beside(desk, name, size):
    """A file that is there without having been read, which costs a process."""
    file = desks.File(f"key-{name.partition('.')[0]}", name, size)
    desk.files[file.key] = file
    (desk.folder / file.stored_name).write_bytes(b"x" * size)


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
    assert page.desk.check_room("Run.csv.gz", 1) == "Run-2.csv.gz"
    assert page.desk.check_room("../run.csv", 1) == "run.csv"


# ------------------------------------------------------------------------------------------------ from file to model


def test_a_file_is_told_as_ftlm_open_tells_it(used, content, tmp_path):
    (file,) = used.desk.files.values()
    path = tmp_path / "lag.csv"
    path.write_bytes(content)
    opened = ftlm.open_file(path).to_dict()
    assert json.loads(json.dumps(opened["columns"])) == file.preview["columns"]
    assert json.loads(json.dumps(opened["options"])) == file.preview["options"]
    assert file.preview["assumed"] == [a.words for a in ftlm.open_file(path).assumed]
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


@pytest.mark.parametrize(
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
            "assumed": [HOSTILE],
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
                    "words": HOSTILE,
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


# -------------------------------------------------------------------------------------- work, its end, and its limits


LONG = FitRequest(RunSource("a.csv"), structure=("D y = a y + b u",))


async def asleep(self, seconds=None):
    """A task that ends when it is told to."""
    while not self._ended:
        await asyncio.sleep(0.01)
    raise TaskError("stopped")


def test_models_wait_for_each_other_and_stop_in_any_state(page, monkeypatch):
    monkeypatch.setattr(Task, "answer", asleep)

    async def course():
        desk = page.desk
        await put_beside(desk, "a.csv", 1)
        models = [desk.start(LONG) for _ in range(desks.MAX_QUEUED_MODELS)]
        with pytest.raises(DataError, match="8 models are already in the queue"):
            desk.start(LONG)
        await until(lambda: models[0].state == "running")
        assert [m.state for m in models] == ["running", *["waiting"] * 7]
        with pytest.raises(DataError, match="in use"):
            desk.remove_file("key-a")
        desk.stop(models[1].key)
        desk.stop(models[0].key)
        await until(lambda: [m.state for m in models][:3] == ["stopped", "stopped", "running"])
        desk.remove_model(models[2].key)
        await until(lambda: models[3].state == "running")
        for model in models[3:]:
            desk.stop(model.key)
        await settled(desk)
        desk.remove_file("key-a")
        monkeypatch.setattr(desks, "MAX_MODELS", len(desk.models))
        with pytest.raises(DataError, match="are kept"):
            desk.start(LONG)

    page.loop(course())


class Quiet:
    """Told how far it is."""

    def phase(self, words):
        pass

    def __call__(self, done, total):
        pass


def test_a_choice_that_was_stopped_goes_on_where_it_was(tmp_path, content, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("lag.csv").write_bytes(content)
    options = json.loads(json.dumps(ftlm.open_file("lag.csv").to_dict()["options"]))
    words = tuple(f"D y = a0 y + b0 u{more}" for more in ("", " + c", " + b1 D^0.5 u"))
    fit_request = FitRequest(RunSource("lag.csv", options), share=0.25, structure=words, selection_mode="offered")
    plain, store = fit_request.fit_model(Quiet()), Path("choice.ftlm")
    fit_request.fit_model(Quiet(), str(store))
    # As a kill in the middle leaves it.
    with contextlib.closing(sqlite3.connect(store)) as file, file:
        (count,) = file.execute("SELECT count(*) FROM selection").fetchone()
        file.execute("DELETE FROM selection WHERE number > ?", (count // 2,))
    went_on = fit_request.fit_model(Quiet(), str(store))
    with contextlib.closing(sqlite3.connect(store)) as file:
        assert file.execute("SELECT count(*) FROM selection").fetchone() == (count,)
    assert went_on.choice.reason == plain.choice.reason
    assert went_on.result.coefficients == plain.result.coefficients
    # Nothing is left to be fitted, so nothing is kept once more.
    again = store.read_bytes()
    fit_request.fit_model(Quiet(), str(store))
    assert store.read_bytes() == again


def test_what_was_stopped_goes_on_with_the_same_store_as_long_as_its_file_is_there(page, monkeypatch):
    asked = []

    async def noted(self, seconds=None):
        asked.append(self._request["store"])
        await asleep(self)

    monkeypatch.setattr(Task, "answer", noted)
    choice = FitRequest(RunSource("a.csv"), structure=("D y = a y + b u",), selection_mode="inside")

    async def course():
        desk = page.desk
        await put_beside(desk, "a.csv", 1)
        model, fit = desk.start(choice), desk.start(LONG)
        for number, one in enumerate((model, fit), 1):
            await until(lambda number=number: len(asked) == number)
            desk.stop(one.key)
        await until(lambda: not desk._jobs)
        (desk.folder / f"{model.key}.ftlm").write_bytes(b"x")
        assert "Go on" in view.model(model)
        assert "Start again" in view.model(fit)
        for one in (model, fit):
            before = one.version
            assert desk.resume(one.key) is one
            assert (one.state, one.version) == ("waiting", before + 1)
            await until(lambda one=one: one.state == "running")
            # Who asks twice has it once.
            assert desk.resume(one.key).version == before + 2
            desk.stop(one.key)
            await until(lambda: not desk._jobs)
        assert asked == [str(desk.folder / f"{model.key}.ftlm"), None] * 2
        # Another file of that name is another file.
        desk.remove_file("key-a")
        desk.files["other"] = desks.File("other", "a.csv", 1)
        with pytest.raises(DataError, match="no longer on the page"):
            desk.resume(model.key)
        assert model.state == "stopped"
        desk.remove_model(model.key)
        assert not (desk.folder / f"{model.key}.ftlm").exists()

    page.loop(course())


def test_a_file_that_takes_long_is_on_the_page_and_can_be_removed(page, monkeypatch):
    monkeypatch.setattr(Task, "answer", asleep)
    monkeypatch.setattr(desks, "OPEN_REPLY_TIMEOUT_S", 0.01)
    status, _, text = page.upload("long.csv", b"t,u,y")
    assert status == 200
    assert "Reading" in text
    (file,) = page.desk.files.values()
    task = file.task
    assert page.own("DELETE", f"files/{file.key}")[0] == 200
    assert task._ended
    assert list(page.desk.folder.iterdir()) == []


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("how", ["stopped", "killed", "closed"])
def test_a_process_that_works_ends_and_the_page_goes_on(page, how):
    """It sleeps, and would never end by itself."""

    async def course():
        model = page.desk.start(LONG)
        await until(lambda: model.task is not None and model.task._process is not None)
        pid = model.task._process.pid
        os.kill(pid, signal.SIGSTOP)
        if how == "stopped":
            page.desk.stop(model.key)
        elif how == "killed":
            os.kill(pid, 9)
        else:
            await page.desk.close()
        await settled(page.desk)
        await until(lambda: not page.desk._jobs)
        assert not alive(pid)
        assert model.state == ("failed" if how == "killed" else "stopped")
        if how == "killed":
            assert "SIGKILL" in model.error

    page.loop(course())
    assert page.own("GET", "state")[0] == 200


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        (lambda: parameter("time", Placeholder("COLUMN")), "the role “time”"),
        (lambda: parameter("resample", Placeholder("STEP")), "the field “Put on the step”"),
        (lambda: f"{parameter('resample', 0.01)} leaves 2 rows", "the field “Put on the step” = 0.01 leaves 2 rows"),
        (lambda: parameter("missing", "hold"), "the field “Gaps” = hold"),
        (lambda: layout_parameter(sheet=Placeholder("NAME")), "the field “Sheet”"),
        (lambda: parameter("inputs", NAMED_COLUMNS), "the role “input”"),
        (lambda: parameter("window", (1.004, None)), "the fields “From” and “To” = 1.004 to none"),
        (lambda: parameter("reference"), "the option reference of Python"),
        (lambda: choose_text("validate(run)", "--validation FILE"), "validate(run)"),
    ],
)
def test_errors_speak_of_what_the_page_has(message, shown):
    with use_interface("app"):
        assert message() == shown


def test_the_form_has_the_fields_that_messages_name():
    forms = (files("ftlm.app") / "file.html.j2").read_text() + (files("ftlm.app") / "page.html.j2").read_text()
    for place in FIELD_BY_PARAMETER.values():
        for label in re.findall("“(.*?)”", place):
            assert label in forms, place


def test_progress_is_told_in_shares_and_words():
    model = desks.Model("k", 1, LONG, state="running")
    desks._record_progress(model, {"phase": "fitting"})
    assert (model.phase, model.share, model.time_left) == ("fitting", None, "")
    model.phase_started_at -= 10
    desks._record_progress(model, {"done": 500, "total": 1000})
    assert model.share == 0.5
    assert re.fullmatch(r"about \d+ s left", model.time_left)
    desks._record_progress(model, {"done": 5, "total": 0})
    assert model.share == 0.5
    # Candidates are counted: more of them come up, and no share may go back.
    desks._record_progress(model, {"phase": "choosing a structure"})
    desks._record_progress(model, {"done": 9, "total": 10})
    desks._record_progress(model, {"done": 10, "total": 20})
    assert model.share is None
    assert model.time_left == "10 of 20 candidates known so far are fitted"


# -------------------------------------------------------------------------------------- clients that keep it waiting


class Wire:
    """The other end of a connection, with a clock of its own: what was written, whether it was cut."""

    def __init__(self):
        self.now, self.due, self.unread, self.cut, self.closing = 0.0, [], 0, False, False
        self.written = b""

    def time(self):
        return self.now

    def call_later(self, seconds, call):
        handle = asyncio.TimerHandle(self.now + seconds, call, (), self)
        self.due.append(handle)
        return handle

    def _timer_handle_cancelled(self, handle):
        self.due = [h for h in self.due if h is not handle]

    def call_exception_handler(self, context):
        raise context["exception"]

    def get_debug(self):
        return False

    def create_task(self, coroutine, **_):
        coroutine.close()
        return type("Done", (), {"add_done_callback": lambda self, call: None})()

    def get_write_buffer_size(self):
        return self.unread

    def abort(self):
        self.cut = True

    def is_closing(self):
        return self.closing

    def close(self):
        self.closing = True

    def write(self, data):
        self.written += data

    def get_extra_info(self, _):
        return None

    def pause_reading(self):
        pass

    resume_reading = pause_reading

    def pass_time(self, seconds):
        end = self.now + seconds
        while self.due and (first := min(self.due, key=lambda h: h.when())).when() <= end and not self.cut:
            self.now = first.when()
            self.due.remove(first)
            first._run()
        self.now = end


async def nobody(scope, receive, send):
    """An application that is never asked."""


def answered(connection):
    """A connection whose request has been answered."""
    h11 = pytest.importorskip("h11")
    connection.conn.send(h11.Response(status_code=200, headers=[("content-length", "0")]))
    connection.conn.send(h11.EndOfMessage())
    connection.on_response_complete()


@pytest.fixture
def wired():
    uvicorn = pytest.importorskip("uvicorn")
    from uvicorn.server import ServerState

    def make():
        config = uvicorn.Config(nobody, lifespan="off", ws="none", timeout_keep_alive=15, log_config=None)
        wire = Wire()
        connection = TimedConnection(config, ServerState(), {}, wire)
        connection.connection_made(wire)
        return wire, connection, CLIENT_TIMEOUT_S

    return make


HEAD = b"POST /x/files HTTP/1.1\r\nHost: x\r\nContent-Length: 1000\r\n\r\n"


@pytest.mark.parametrize("begun", [b"", b"G", HEAD[:-2]])
def test_who_opens_a_connection_and_says_nothing_loses_it(wired, begun):
    wire, connection, patience = wired()
    assert connection in connection.connections
    if begun:
        connection.data_received(begun)
    wire.pass_time(0.9 * patience)
    assert not wire.cut
    wire.pass_time(0.7 * patience)
    assert wire.cut
    connection.connection_lost(None)
    assert connection not in connection.connections


def test_a_head_that_drips_is_no_sign_of_life(wired):
    wire, connection, patience = wired()
    for k in range(30):
        if not wire.cut:
            connection.data_received(HEAD[k : k + 1])
            wire.pass_time(patience / 10)
    assert wire.cut
    assert wire.now <= 3.1 * patience


def test_a_body_may_take_its_time_as_long_as_it_comes(wired):
    wire, connection, patience = wired()
    connection.data_received(HEAD)
    for _ in range(9):
        connection.data_received(b"x" * 100)
        wire.pass_time(0.9 * patience)
    assert not wire.cut
    wire.pass_time(patience)
    assert wire.cut


def test_work_on_a_request_may_take_as_long_as_it_takes(wired):
    wire, connection, patience = wired()
    connection.data_received(HEAD + b"x" * 1000)
    wire.pass_time(50 * patience)
    assert not wire.cut
    answered(connection)
    connection.data_received(b"GE")
    wire.pass_time(1.6 * patience)
    assert wire.cut


def test_who_does_not_read_an_answer_loses_it(wired):
    wire, connection, patience = wired()
    connection.data_received(HEAD + b"x" * 1000)
    answered(connection)
    for unread in (9000, 5000, 100):
        wire.unread = unread
        wire.pass_time(0.9 * patience)
    assert not wire.cut
    wire.pass_time(2 * patience)
    assert wire.cut


# ----------------------------------------------------------------------------------------------------- the command


def run_command(*words):
    return CliRunner().invoke(app, ["app", *map(str, words)])


def test_no_child_imports_an_uploaded_file(tmp_path, content):
    """Modules of the names that a child imports first, and an empty entry of the path, which is the working folder."""
    pytest.importorskip("uvicorn")
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "ftlm", "app", "--port", "0", "--no-browser"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f":{tmp_path / 'nothing'}", "TMPDIR": str(temporary)},
    )
    try:
        address = re.search(r"http://(127\.0\.0\.1:\d+)(/\S+/)", process.stdout.readline())
        mark = tmp_path / "ran"
        module = f"open({str(mark)!r}, 'a').write(__file__)\n".encode()
        names = ("sitecustomize", "usercustomize", "jinja2", "numpy", "scipy", "json", "runpy")
        for name, body in [*((f"{name}.py", module) for name in names), ("lag.csv", content)]:
            client = http.client.HTTPConnection(address[1], timeout=120)
            headers = {"Origin": f"http://{address[1]}", "Content-Type": RAW}
            client.request("POST", f"{address[2]}files?name={name}", body, headers)
            assert client.getresponse().status == 200
            client.close()
        stored = [path.name for path in temporary.rglob("*.*")]
        assert len(stored) == len(names) + 1
        assert all(re.fullmatch(r"[0-9a-f]{16}\.(py|csv)", name) for name in stored)
    finally:
        process.terminate()
        process.wait(120)
        process.stdout.close()
    assert not mark.exists()


def test_children_search_neither_the_working_folder_nor_relative_entries(tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text("raise SystemExit('imported')")
    script = tmp_path / "script.py"
    script.write_text(
        "import json, os, sys, ftlm; print(json.dumps([os.getcwd(), sys.path, os.environ.get('PYTHONPATH')]))"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", f":.:{tmp_path}")
    monkeypatch.setattr(sys, "path", ["", ".", str(tmp_path), "relative", *sys.path])
    for site in (True, False):
        ran = subprocess.run(**python_child(script, site=site), capture_output=True, text=True, check=True)
        folder, searched, variable = json.loads(ran.stdout)
        assert (Path(folder), variable) == (Path(sys.prefix), None)
        assert all(map(os.path.isabs, searched))
        assert str(tmp_path) not in searched


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setattr(serve.importlib.util, "find_spec", lambda name: None)
    done = run_command("--no-browser")
    assert done.exit_code == 2
    assert "pip install 'ftlm[app]'" in done.stderr


def test_a_file_that_is_not_there_is_refused_before_anything_is_served(tmp_path):
    done = run_command(tmp_path / "nobody.csv", "--no-browser")
    assert done.exit_code == 3
    assert "nobody.csv" in done.stderr


@pytest.mark.parametrize("port", [-1, 70000])
def test_a_port_that_is_none_is_refused(port):
    done = run_command("--port", port, "--no-browser")
    assert done.exit_code == 2
    assert str(port) in done.stderr


def test_a_second_one_on_the_port_is_told(monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = run_command("--port", port, "--no-browser")
        assert done.exit_code == 3
        assert f"--port {port} is taken" in done.stderr
        monkeypatch.setattr(serve, "DEFAULT_PORT", port)
        sock, note = serve.open_socket(None)
        with sock:
            assert sock.getsockname()[0] == "127.0.0.1"
            assert sock.getsockname()[1] != port
            assert str(port) in note


def test_errors_are_ftlm_s_own():
    assert issubclass(TaskError, FtlmError)
