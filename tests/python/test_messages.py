"""Messages and options: every option is used or refused; delays, units of time, brackets and help texts are printed."""

from __future__ import annotations

import ast
import inspect
import itertools
import json
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from ftlm.data.units import TIME_UNITS
from ftlm.estimation.methods import METHODS_BY_NAME
from ftlm.report.typesetting import equation_html
from ftlm.structure.equation import format_equation
from ftlm.utils.parameters import (
    NAMED_COLUMNS,
    Note,
    Placeholder,
    current_interface,
    layout_fields,
    layout_parameter,
    parameter,
    setting,
    use_interface,
)

WORDS = "D^1.6 y = a D^0.6 y + c y + b u"
FREE = "D^alpha y = a D^0.6 y + c y + b u"
PACKAGE = Path(ftlm.__file__).parent


def run_command(*words):
    return CliRunner().invoke(app, list(map(str, words)), env={"COLUMNS": "200", "NO_COLOR": "1"})


@pytest.fixture(scope="module")
def saved(small_run, tmp_path_factory):
    path = tmp_path_factory.mktemp("words") / "small.csv"
    small_run.to_csv(path)
    return path


# ------------------------------------------------------------------------------------------------ options of commands


@pytest.mark.parametrize(
    "words",
    [
        ["--friction"],
        ["--cross-stage", "torques"],
        ["--laws", "orders"],
        ["--laws", "none"],
        ["--coupling", "measured"],
        ["--input-order", "derived"],
        ["--cross-stage", "inertial"],
        ["--cross-sensitivity"],
    ],
)
@pytest.mark.parametrize("command", ["identify", "search"])
def test_options_of_the_flexible_link_are_refused_with_an_equation(command, words, saved):
    done = run_command(command, saved, "--structure", FREE, *words)
    assert done.exit_code == 2
    assert words[0] in done.stderr
    assert "not with one equation as text; leave it out" in done.stderr


def test_what_is_identified_live_needs_live(tmp_path):
    done = run_command("record", "-o", tmp_path / "r.csv", "--innovation-length", "3", "--orders", "alpha1=1.9")
    assert done.exit_code == 2
    assert "--orders, --innovation-length: only valid with --live" in done.stderr
    assert not (tmp_path / "r.csv").exists()


# ------------------------------------------------------------------------------------------------ delays


def test_a_delay_is_printed_wherever_the_equation_is(small_run):
    structure = ftlm.equation("D^1.6 y = -3 D^0.6 y - 8 y + 5 D^0.5 u + 2 u").with_delays({"u": 0.035})
    model = ftlm.Model(structure)
    assert str(model) == "D^1.6 y = -3 D^0.6 y - 8 y + 5 D^0.5 u(t - 0.035 s) + 2 u(t - 0.035 s)"
    plain = re.sub(r"<[^>]*>", "", str(equation_html(model.equations[0], structure.delay)))
    assert plain.count("u(t−0.035s)") == 2
    assert re.sub(r"<[^>]*>", "", model._repr_html_()).count("u(t−0.035s)") == 2
    assert "(t" not in format_equation(model.equations[0])
    found = ftlm.identify(small_run, ftlm.equation(WORDS).with_delays({"u": 0.04}), method="least-squares")
    assert "u(t - 0.04 s)" in str(found)
    assert "u(t - 0.04 s)" in found.to_dict()["equations"]["y"]
    assert "u(t−0.04s)" in re.sub(r"<[^>]*>", "", found._repr_html_())


# ------------------------------------------------------------------------------------------------ units of time


def table(path, header, scale=1.0, rows=40):
    lines = [f"{header},u,y"] + [f"{k * 0.01 / scale!r},{k % 3},{k % 7}" for k in range(rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


SIGNALS = {"inputs": {"u": "u"}, "outputs": {"y": "y"}}


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        ("time [ms]", "ms"),
        ("time (ms)", "ms"),
        ("Time_ms", "ms"),
        ("time/ms", "ms"),
        ("t [us]", "us"),
        ("t [µs]", "us"),
        ("t_μs", "us"),
        ("time [min]", "min"),
        ("t_h", "h"),
        ("time [msec]", "ms"),
        ("t (s)", "s"),
        ("time_s", "s"),
        ("T", "s"),
        ("seconds", "s"),
    ],
)
@pytest.mark.parametrize("named", [True, False])
def test_a_header_states_the_unit_of_time(header, unit, named, tmp_path):
    path = table(tmp_path / "r.csv", header, TIME_UNITS[unit])
    run = ftlm.load(path, **SIGNALS, **({"time": header} if named else {}))
    assert run.step == pytest.approx(0.01, rel=1e-9)
    said = [w for w in run.warnings if "time read in" in w]
    assert said == ([] if unit == "s" else [f"time read in {unit}, as the header {header!r} says"])


def test_no_other_header_states_one(tmp_path):
    for header in ("time_abs", "t (run 3)", "clock", "time of ms"):
        run = ftlm.load(table(tmp_path / "r.csv", header), time=header, **SIGNALS)
        assert (run.step, [w for w in run.warnings if "time read" in w]) == (0.01, [])


def test_a_header_and_an_argument_that_contradict_each_other_are_refused(tmp_path):
    path = table(tmp_path / "r.csv", "time [ms]", 1e-3)
    assert ftlm.load(path, **SIGNALS, time_unit="ms").step == pytest.approx(0.01, rel=1e-9)
    with pytest.raises(ftlm.DataError, match=r"its header states 'ms', and time_unit='s' is given; leave"):
        ftlm.load(path, **SIGNALS, time_unit="s")
    unknown = table(tmp_path / "x.csv", "time [samples]")
    with pytest.raises(ftlm.DataError, match=r"its header states the unit 'samples', which is unknown"):
        ftlm.load(unknown, **SIGNALS)
    assert ftlm.load(unknown, **SIGNALS, time_unit="ms").step == pytest.approx(1e-5)
    with pytest.raises(ftlm.DataError, match="is the unit of time=, which is not used; step= is in s"):
        ftlm.load(path, **SIGNALS, step=0.1, time_unit="s")
    frame = {"t [ms]": np.arange(40) * 10.0, "u": np.ones(40), "y": np.arange(40.0)}
    assert ftlm.Run.from_frame(frame, time="t [ms]", inputs=["u"], outputs=["y"]).step == pytest.approx(0.01)


def test_the_command_line_takes_a_unit_of_time(tmp_path):
    path = table(tmp_path / "r.csv", "clock", 1e-3)
    words = ["inspect", path, "--time", "clock", "-u", "u", "-y", "y"]
    done = run_command(*words, "--time-unit", "ms", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)[0]["step"] == pytest.approx(0.01)
    done = run_command(
        "inspect", table(tmp_path / "s.csv", "time [ms]", 1e-3), "-u", "u", "-y", "y", "--time-unit", "s"
    )
    assert done.exit_code == 3
    assert "--time-unit s is given; leave --time-unit out" in done.stderr
    readers = {n for n, c in get_command(app).commands.items() if any("--time" in p.opts for p in c.params)}
    takers = {n for n, c in get_command(app).commands.items() if any("--time-unit" in p.opts for p in c.params)}
    assert readers == takers
    assert len(readers) >= 8


# ------------------------------------------------------------------------------------------------ help and messages


@pytest.mark.parametrize("name", sorted(get_command(app).commands))
def test_every_bracket_of_a_help_text_shows(name):
    shown = "".join(run_command(name, "--help-all").stdout.split())
    for option in get_command(app).commands[name].params:
        text = "".join((getattr(option, "help", None) or "").split())
        assert text in shown, option.name


#: What is no message: code that is written for other programs, an argument of another library, a call in Python.
OTHER_TEXTS = (
    "control.ss(",
    ", outputs=",
    ", name=",
    "laws=(",
    "np.asarray",
    "GeneticAlgorithm(",
    "pass an object, method=",
    "flexible_link(",
    "identify(",
    "dict(decimal=",
)


def public_parameters():
    """Names of the parameters of what is public, and of the fields of a layout."""
    found = {"layout"}
    for owner in (ftlm, ftlm.control, ftlm.analysis, ftlm.rig):
        for name in getattr(owner, "__all__", ()):
            value = getattr(owner, name)
            members = [m for m in vars(value).values() if inspect.isfunction(m)] if inspect.isclass(value) else []
            for function in [value, *members] if callable(value) else members:
                try:
                    found |= set(inspect.signature(function).parameters)
                except (TypeError, ValueError):
                    continue
    return found - {"self", "cls", "path", "name", "x", "data"}


def literals():
    """Every text in the package that is no docstring, without those of commands, pages and charts."""
    for path in sorted(PACKAGE.rglob("*.py")):
        folder = path.relative_to(PACKAGE).parts[0]
        if folder in ("cli", "app", "svg", "report") or path.stem in ("parameters", "watchdog", "quanser"):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        docstrings = {
            id(node.body[0].value)
            for node in ast.walk(tree)
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
            and node.body
            and isinstance(node.body[0], ast.Expr)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                # A name that is put in, and what it is followed by.
                pairs = itertools.pairwise(node.values)
                yield from (
                    (f"{path.relative_to(PACKAGE)}:{node.lineno}", f"window{after.value}")
                    for name, after in pairs
                    if isinstance(name, ast.FormattedValue)
                    and isinstance(after, ast.Constant)
                    and after.value[:2] == "= "
                )
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
                yield f"{path.relative_to(PACKAGE)}:{node.lineno}", node.value


def test_no_message_writes_out_a_parameter():
    """A literal ``window=`` is a parameter of Python wherever it is read; parameter("window") is that of who reads."""
    names = "|".join(sorted(public_parameters(), key=len, reverse=True))
    pattern = re.compile(rf"(?<![\w.'\"-])({names})=(?![\w\"]*\"/?>)")
    every = list(literals())
    assert len(every) > 2000
    found = [
        (at, text)
        for at, text in every
        if pattern.search(text) and not any(other in text for other in OTHER_TEXTS) and "<" not in text
    ]
    assert found == []
    assert pattern.search("avoid them with window=")
    flags = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
    # Where the two say a thing by different means, both texts stand beside each other.
    written = [(at, text) for at, text in every if flags.search(text) and not text.startswith("--")]
    assert [(at, text) for at, text in written if "ftlm " not in text and "multisine" not in text] == []


PYTHON_AND_COMMANDS = [
    (lambda: f"overwrite it with {parameter('force', True)}", "force=True", "--force"),
    (lambda: parameter("negated", False), "negated=False", "--no-negated"),
    (lambda: parameter("resample", Placeholder("STEP")), "resample=STEP", "--resample STEP"),
    (lambda: parameter("method", "output-error"), "method='output-error'", "--method output-error"),
    (lambda: parameter("units", {"y": "m s"}), "units={'y': 'm s'}", "--units y='m s'"),
    (lambda: parameter("window"), "window=", "--window"),
    (lambda: parameter("window", (1.004, None)), "window=(1.004, None)", "--window 1.004:"),
    (lambda: parameter("window", (1.1, 19.5)), "window=(1.1, 19.5)", "--window 1.1:19.5"),
    (lambda: f"{parameter('time')} and {parameter('step')}: both", "time= and step=: both", "--time and --step: both"),
    (lambda: parameter("prior_covariance"), "prior_covariance=", "--prior-covariance"),
    (lambda: f"{parameter('inputs')} {parameter('outputs')}", "inputs= outputs=", "-u -y"),
    (lambda: parameter("inputs", NAMED_COLUMNS), "inputs={name: column}", "-u NAME=COLUMN"),
    (
        lambda: layout_parameter(separator="comma", decimal="comma"),
        "layout=dict(separator='comma', decimal='comma')",
        "--separator comma --decimal comma",
    ),
    (lambda: layout_parameter(skip=Placeholder("LINES")), "layout=dict(skip=LINES)", "--skip LINES"),
    (lambda: f"{layout_fields('skip')} is -1", "layout=: skip is -1", "--skip is -1"),
    (lambda: f"{setting('top')} 0 is outside", "top = 0 is outside", "--top 0 is outside"),
    (lambda: f"{setting('noise of y')} 0", "noise of y = 0", "noise of y = 0"),
]


@pytest.mark.parametrize(("message", "python", "command"), PYTHON_AND_COMMANDS)
def test_a_parameter_is_shown_as_who_reads_it_gives_it(message, python, command):
    assert message().endswith(python) or message() == python
    with use_interface("command line"):
        assert message().endswith(command)
        with use_interface("python"):
            assert message().endswith(python)
        assert current_interface() == "command line"
    assert current_interface() == "python"


def test_a_report_names_no_option_as_it_is_typed(saved, tmp_path):
    """Who reads a page is at no command line: neither the command that wrote it nor Python gives its words."""
    path, folder = tmp_path / "page.html", ["--report", tmp_path / "page.html"]
    done = run_command("identify", saved, "--structure", WORDS, *folder)
    assert done.exit_code == 0, done.output
    page = path.read_text("utf-8")
    assert "validate the model on another run" in page
    assert "--validation FILE" in done.output
    body = re.sub(r"<(style|script)>.*?</\1>", "", page, flags=re.DOTALL)
    assert re.findall(r"(?<![\w-])--?[a-z][a-z-]+\b|\b\w+='", re.sub(r"<[^<>]*>", " ", body)) == []
    with use_interface("report"):
        assert parameter("offset", "auto") == "the option offset = auto"
        assert parameter("friction", False) == "no option friction"
        assert parameter("intersample", {"u": "foh"}) == "the option intersample: u = foh"
    # A note on an assumption has the option that replaces it only where it is typed.
    note = pickle.loads(pickle.dumps(Note("decimal commas", "--decimal point")))
    assert (note, note.fact) == ("decimal commas; otherwise --decimal point", "decimal commas")
    finding = ftlm.Finding("data_note", numbers={"text": note.fact, "override": note.override})
    assert finding.text == note
    with use_interface("report"):
        assert finding.text == note.fact


def test_a_command_leaves_the_interface_as_it_was(saved, tmp_path):
    """Also where it fails, and whatever thread makes the message."""
    for words in (["inspect", saved], ["inspect", tmp_path / "none.csv"], ["identify", saved, "--structure", "arm:7"]):
        run_command(*words)
        assert current_interface() == "python"
    with pytest.raises(ftlm.ModelError, match=r"^top = 0 is outside"):
        ftlm.LeastSquares(top=0)
    done = run_command("identify", saved, "--structure", FREE, "--method", "least-squares", "--top", 0)
    assert done.stderr.startswith("ftlm: --top 0 is outside")


def test_names_of_files_and_signals_are_shown_as_typed(tmp_path):
    """A name with ``step=`` or ``m=3`` in it is a name."""
    for name in ("runs step=0.02.csv", "amp 0.3 rate=500 m=3.csv"):
        done = run_command("inspect", tmp_path / name, "-u", "m=3", "-y", "y")
        assert done.exit_code == 3
        assert name in done.stderr
    path = table(tmp_path / "window=3.csv", "t")
    done = run_command("inspect", path, "-u", "force=method=", "-y", "y")
    assert "'method='" in done.stderr
    done = run_command("inspect", path, "-u", "u", "-y", "y")
    assert done.stdout.startswith("run window=3:")


#: A call with bad input each: command, its words, what its message says, and what no message of a command says.
BAD_CALLS = [
    (["inspect", "RUN", "-u", "u", "-y", "y", "--window", "5:4"], "--window"),
    (["inspect", "RUN", "-u", "u", "-y", "y", "--time", "t", "--step", "0"], "--time and --step: both are given"),
    (["inspect", "RUN", "-u", "u", "-y", "y", "--skip", "-1"], "--skip is -1"),
    (["inspect", "RUN", "-u", "u", "-y", "y", "--intersample", "y=foh"], "--intersample"),
    (["inspect", "RUN", "-u", "u", "-y", "y", "--time-unit", "s", "--step", "1"], "--time-unit s"),
    (["inspect", "RUN", "-u", "u", "-y", "y", "--units", "y=furlong"], "furlong"),
    (["inspect", "NAN", "-u", "u", "-y", "y"], "--missing weight"),
    (["inspect", "NAN", "-u", "y", "-y", "u"], "--missing hold"),
    (["identify", "RUN", "--structure", FREE, "--method", "multi-innovation", "--loss", "huber"], "--loss is not used"),
    (
        ["identify", "RUN", "--structure", FREE, "--method", "multi-innovation", "--prior-covariance", "0"],
        "-covariance 0",
    ),
    (["identify", "RUN", "--structure", FREE, "--method", "least-squares", "--m", "0"], "--m 0"),
    (["identify", "RUN", "--structure", FREE, "--threads", "0"], "--threads 0"),
    (["identify", "RUN", "--structure", FREE, "--reference", "u", "--intervals", "profile"], "--intervals quadratic"),
    (
        ["search", "RUN", "--structure", FREE, "--coefficients", "least-squares", "--row-basis", "time"],
        "--row-basis is not",
    ),
    (["certify", "RUN", "--structure", FREE, "--tolerance", "5"], "--tolerance 5"),
    (["certify", "RUN", "--structure", FREE, "--initial", "caputo"], "--initial rest"),
    (["consistency", "RUN", "--structure", FREE, "--segments", "1"], "--segments 1"),
    (["record", "-o", "OUT", "--rate", "0"], "--rate 0"),
    (["record", "-o", "OUT", "--duration", "40"], "raise --limit"),
    (["record", "-o", "RUN"], "--force"),
    (["record", "-o", "OUT", "--input", "csv"], "give it as --file"),
    (["app", "--port", "70000"], "--port 70000"),
]


@pytest.mark.parametrize(("words", "said"), BAD_CALLS)
def test_a_refused_command_names_its_own_options(words, said, saved, tmp_path):
    bare = tmp_path / "bare.csv"
    bare.write_text("t,u,y\n0,1,2\n1,2,3\n2,1,nan\n3,1,1\n", encoding="utf-8")
    files = {"RUN": saved, "NAN": bare, "OUT": tmp_path / "out.csv"}
    done = run_command(*(files.get(word, word) for word in words))
    assert done.exit_code in (2, 3), done.output
    assert said in done.stderr
    names = "|".join(public_parameters())
    assert not re.search(rf"(?<![\w'\"])({names}) ?=(?![^ ]*furlong)", done.stderr), done.stderr


def test_commands_speak_of_their_options(saved, tmp_path):
    path = tmp_path / "bare.csv"
    path.write_text("t,u,y\n0,1,2\n1,2,3\n2,1,nan\n3,1,1\n", encoding="utf-8")
    other = tmp_path / "other.csv"
    other.write_text("t,foo,bar\n0,1,2\n1,2,3\n2,1,4\n3,1,1\n", encoding="utf-8")
    done = run_command("inspect", other)
    assert done.exit_code == 3
    assert "-u NAME=COLUMN and -y NAME=COLUMN" in done.stderr
    assert "inputs=" not in done.stderr
    done = run_command("inspect", path, "-u", "u", "-y", "y")
    assert "--window" in done.stderr
    assert "window=" not in done.stderr


# ------------------------------------------------------------------------------------------------ flags and arguments

#: Flags that belong to the command line alone: where results go, how they are shown, what is done around a call.
COMMAND_LINE_FLAGS = {
    *(
        "json",
        "verbose",
        "force",
        "out",
        "report",
        "help",
        "validation",
        "validation-window",
        "min-fit",
        "only",
        "detrend",
    ),
    *(
        "plot",
        "trajectory",
        "save",
        "write-columns",
        "filtered-signals",
        "no-filtered",
        "not-negated",
        "no-browser",
        "kind",
        "circuit",
    ),
}


def functions_behind():
    """Functions and records of Python behind each command."""
    from ftlm.analysis.conversion import export_text
    from ftlm.app.server import serve
    from ftlm.estimation.linear import Streaming
    from ftlm.reproduction.cross_validation import cross_validate_orders
    from ftlm.reproduction.demo import run_demo

    reading = (ftlm.load, ftlm.open_file, ftlm.Layout)
    structure = (ftlm.equation, ftlm.flexible_link)
    run = ftlm.rig.record
    design = (ftlm.control.fractional_pid, ftlm.control.lqg, ftlm.control.inverse_dynamics)
    estimation = (*reading, *structure)
    return {
        "open": reading,
        "inspect": reading,
        "doctor": (),
        "record": (run, Streaming, ftlm.equation),
        "identify": (*estimation, ftlm.identify, ftlm.select, ftlm.order_grid, *METHODS_BY_NAME.values()),
        "search": (*estimation, ftlm.identify, ftlm.search_orders, ftlm.order_grid),
        "certify": (*estimation, ftlm.identify, ftlm.certify_orders, ftlm.order_grid),
        "resume": (ftlm.resume_search,),
        "status": (),
        "identify-frequency": (ftlm.load_frequency, ftlm.Layout, ftlm.identify_frequency),
        "select": (*estimation, ftlm.select, ftlm.identify),
        "consistency": (*estimation, ftlm.consistency, ftlm.identify, ftlm.OutputError),
        "compare": (*reading, ftlm.compare),
        "resid": (*reading, ftlm.resid),
        "simulate": (*reading, ftlm.simulate),
        "report": reading,
        "plot": reading,
        "export": (export_text,),
        "control": design,
        "input-shaper": (ftlm.control.input_shaper, ftlm.control.fractional_pid),
        "design-input": (*reading, ftlm.design_input),
        "demo": (run_demo,),
        "reproduce": (*reading, ftlm.reproduce, ftlm.GeneticAlgorithm),
        "orders": (*reading, cross_validate_orders),
        "app": (serve,),
    }


def test_every_flag_is_the_name_of_an_argument():
    behind = functions_behind()
    commands = get_command(app).commands
    assert set(behind) == set(commands)
    used = set()
    for name, command in commands.items():
        known = {p.replace("_", "-") for f in behind[name] for p in inspect.signature(f).parameters}
        flags = {
            o.removeprefix("--")
            for p in command.params
            if p.param_type_name == "option"
            for o in (*p.opts, *p.secondary_opts)
            if o.startswith("--")
        }
        assert flags <= known | COMMAND_LINE_FLAGS, (name, flags - known - COMMAND_LINE_FLAGS)
        used |= (flags - known) & COMMAND_LINE_FLAGS
    assert used | {"help"} == COMMAND_LINE_FLAGS


def test_a_method_shows_its_own_options():
    def options(*words):
        return set(re.findall(r"^  (?:-\w, )?(--[a-z-]+)", run_command(*words).stdout, re.MULTILINE))

    every = options("identify", "--help-all")
    own = {
        "output-error": {"--loss", "--intervals", "--start", "--reference"},
        "multi-innovation": {"--innovation-length", "--prior-covariance", "--row-basis"},
        "genetic": {"--seeds", "--evaluations"},
        "least-squares": set(),
    }
    shared = {"--order-grid", "--increment", "--norm"}
    ranking = {"--criterion", "--top", "--store"}
    of_methods = set().union(*own.values(), shared, ranking)
    assert of_methods < every
    assert options("identify", "--help") == options("identify", "--method", "output-error", "--help")
    for method, flags in own.items():
        wanted = flags | (set() if method == "output-error" else shared)
        wanted |= ranking if method in ("multi-innovation", "least-squares") else set()
        for words in (["--method", method], [f"--method={method}"]):
            assert options("identify", *words, "--help") & of_methods == wanted, method
    assert "--innovation-length" in options("search", "--help")
    assert "--innovation-length" not in options("search", "--coefficients", "least-squares", "--help")
    shown = run_command("identify", "--help").stdout
    heads = re.findall(r"^(\w[^:\n]*):$", shown, re.MULTILINE)
    assert heads == ["Arguments", "File", "Structure", "Method of output-error", "Output", "Options"]


def test_help_texts_are_short():
    """At most 60 characters beside a default, a unit and a reference in brackets."""
    for name, command in get_command(app).commands.items():
        for option in command.params:
            text = (getattr(option, "help", None) or "").rstrip(".")
            text = re.sub(r"; default .*| \[[^\]]*\]$", "", text)
            assert len(text) <= 60, (name, option.name, len(text), text)


def test_a_validation_run_has_its_own_window(tmp_path, small_run, saved):
    words = ["identify", saved, "--structure", FREE, "--method", "least-squares", "--order-grid", "alpha=1.6:1.6:0.1"]
    half = small_run.duration / 2
    fits = []
    for window in ([], ["--validation-window", f"0:{half}"]):
        shown = run_command(*words, "--validation", saved, *window, "--json")
        assert shown.exit_code == 0, shown.output
        (checked,) = json.loads(shown.stdout)["validation"]["runs"]
        fits.append(checked["output_error"]["y"]["fit"])
    # The window is a part of the run, with a fit of its own.
    assert abs(fits[0] - fits[1]) > 1e-6
    alone = run_command(*words, "--validation-window", "0:1")
    assert alone.exit_code == 2
    assert "--validation-window is a part of the run that --validation names" in alone.stderr
    assert (
        "--validation-window '3' is not an interval; give FROM:TO"
        in run_command(*words, "--validation", saved, "--validation-window", 3).stderr
    )
