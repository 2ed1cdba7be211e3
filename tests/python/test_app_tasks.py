"""Work of the local page, its end and its limits, clients that keep it waiting, and the command that starts it."""

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
from typer.testing import CliRunner

import ftlm
import plants
from app_page import RAW, Page, put_beside, settled, until
from ftlm.app import server as serve
from ftlm.app import session as desks
from ftlm.app import views as view
from ftlm.app.forms import FitRequest, RunSource
from ftlm.app.subprocess_task import Task, TaskError
from ftlm.app.web_application import CLIENT_TIMEOUT_S, TimedConnection
from ftlm.cli.main import app
from ftlm.errors import DataError, FtlmError
from ftlm.utils.parameters import (
    FIELD_BY_PARAMETER,
    NAMED_COLUMNS,
    Placeholder,
    choose_text,
    layout_parameter,
    parameter,
    use_interface,
)
from ftlm.utils.resources import subprocess_arguments


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
        ran = subprocess.run(**subprocess_arguments(script, site=site), capture_output=True, text=True, check=True)
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
