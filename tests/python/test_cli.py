"""The command line as a stranger types it: results, exit codes, typos in every argument, nothing overwritten."""

from __future__ import annotations

import io
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import ftlm
from command_line import run_command
from ftlm import progress
from ftlm.app.server import DEFAULT_PORT
from ftlm.cli import framework
from ftlm.cli.framework import print_text, wrap_line
from ftlm.cli.main import COMMAND_HELP, CommandTable, app
from ftlm.cli.options import StructureOptions
from ftlm.order_search.search import score_profiles
from ftlm.utils.formatting import EscapedStream, escape_standard_streams
from measured import DATA, needs_data


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of a known second-order relaxation, twice, and a columns file."""
    where = tmp_path_factory.mktemp("cli")
    t = np.arange(1025) * 0.01
    truth = ftlm.Model(ftlm.equation("D^1.5 y = -2.0 D^0.5 y - 4.0 y + 3.0 u"))
    for name, u in (("square", np.sign(np.sin(2 * np.pi * t / 3))), ("sine", np.sin(2.1 * t))):
        blank = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": 0 * t}, name=name)
        run = truth.simulate(blank)
        run.to_csv(where / f"{name}.csv")
        table = np.column_stack([t, run["u"], 1000 * run["y"]])
        np.savetxt(
            where / f"{name}-foreign.csv", table, delimiter=",", header="seconds,volts,mm", comments="", fmt="%.17g"
        )
    (where / "columns.toml").write_text(
        'time = "seconds"\n[inputs]\nu = "volts"\n[outputs]\ny = "mm"\n[units]\ny = "mm"\n', encoding="utf-8"
    )
    return where


EQUATION = "D^alpha y = a1 D^nu y + a0 y + b0 u"
SEARCH = (
    "--structure",
    EQUATION,
    "--method",
    "least-squares",
    "--order-grid",
    "alpha=1.3:1.7:0.1",
    "--order-grid",
    "nu=0.3:0.7:0.1",
)
MULTI_INNOVATION = tuple("multi-innovation" if word == "least-squares" else word for word in SEARCH)


def test_help_is_a_command_as_well() -> None:
    assert CliRunner().invoke(app, ["help"]).output == CliRunner().invoke(app, ["--help"]).output
    for name in ("identify", "open"):
        assert CliRunner().invoke(app, ["help", name]).output == CliRunner().invoke(app, [name, "--help"]).output
    assert CliRunner().invoke(app, ["help", "nonsense"]).exit_code == 2


def test_two_commands_from_a_file_to_a_validated_model(folder: Path) -> None:
    found = run_command("identify", "square.csv", *SEARCH, "-o", "model.json", "--report", "page.html", cwd=folder)
    assert found.returncode == 0, found.stderr
    assert "alpha" in found.stdout
    assert "1.5" in found.stdout
    checked = run_command("identify", "square.csv", *SEARCH, "--validation", "sine.csv", "--json", cwd=folder)
    assert json.loads(checked.stdout)["validation"]["output_error"]["y"]["fit"] > 99
    compared = run_command("compare", "model.json", "sine.csv", "--min-fit", "99", cwd=folder)
    assert compared.returncode == 0, compared.stderr
    assert "equation error" in compared.stdout
    assert "output error" in compared.stdout
    assert "<html" in (folder / "page.html").read_text(encoding="utf-8")


def test_foreign_csv_by_options_and_by_columns_file_give_the_same_numbers(folder: Path) -> None:
    common = ("identify", "square-foreign.csv", *SEARCH, "--json")
    by_options = run_command(*common, "--time", "seconds", "-u", "u=volts", "-y", "y=mm", "--units", "y=mm", cwd=folder)
    by_file = run_command(*common, "--columns", "columns.toml", cwd=folder)
    own = run_command("identify", "square.csv", *SEARCH, "--json", cwd=folder)
    found = [json.loads(r.stdout) for r in (by_options, by_file, own)]
    assert found[0]["coefficients"] == found[1]["coefficients"]
    assert found[0]["orders"] == found[2]["orders"] == {"alpha": 1.5, "nu": 0.5}
    for name, value in found[2]["coefficients"].items():
        assert found[0]["coefficients"][name] == pytest.approx(value, rel=1e-9)


def test_json_prints_the_figures_that_compare_prints(folder: Path) -> None:
    identified = run_command("identify", "square.csv", *SEARCH, "-o", "again.json", "--force", "--json", cwd=folder)
    compared = run_command("compare", "again.json", "square.csv", "--json", cwd=folder)
    first, second = json.loads(identified.stdout), json.loads(compared.stdout)
    for figure, value in first["output_error"]["y"].items():
        assert second["output_error"]["y"][figure] == pytest.approx(value, rel=1e-12)
    for figure, value in first["equation_error"]["y"].items():
        assert second["equation_error"]["y"][figure] == pytest.approx(value, rel=1e-12)


def test_search_prints_a_ranked_table_and_counts(folder: Path) -> None:
    words = [w if w != "--method" else "--coefficients" for w in SEARCH]
    found = run_command("search", "square.csv", *words, "--top", "3", "--json", cwd=folder)
    assert found.returncode == 0, found.stderr
    table = json.loads(found.stdout)["y"]
    assert [row["rank"] for row in table["table"]] == [1, 2, 3]
    assert len(table["table"]) + sum(table["exclusion_counts"].values()) == table["candidates"] == 25


def test_simulate_writes_a_run_that_loads_without_columns(folder: Path) -> None:
    run_command("identify", "square.csv", *SEARCH, "-o", "sim.json", "--force", cwd=folder)
    found = run_command("simulate", "sim.json", "sine.csv", "-o", "out.csv", "--force", cwd=folder)
    assert found.returncode == 0, found.stderr
    simulated, measured = ftlm.load(folder / "out.csv"), ftlm.load(folder / "sine.csv")
    assert np.max(np.abs(simulated["y"] - measured["y"])) < 2e-3 * np.max(np.abs(measured["y"]))
    assert np.array_equal(simulated["u"], measured["u"])


def test_residual_tests_of_a_saved_model_have_an_exit_code(folder: Path) -> None:
    rng = np.random.default_rng(1)
    clean = ftlm.load(folder / "square.csv")
    noisy = ftlm.Run.from_arrays(
        step=clean.step, inputs={"u": clean["u"]}, outputs={"y": clean["y"] + 0.02 * rng.standard_normal(clean.length)}
    )
    noisy.to_csv(folder / "noisy.csv", force=True)
    for name, a0, code in (("true", -4.0, 0), ("wrong", -3.0, 4)):
        model = ftlm.Model(ftlm.equation(f"D^1.5 y = -2.0 D^0.5 y + {a0} y + 3.0 u"))
        model.save(folder / f"{name}.json", force=True)
        ran = run_command("resid", f"{name}.json", "noisy.csv", cwd=folder)
        assert ran.returncode == code, ran.stdout + ran.stderr
        assert ("FAILED" in ran.stdout) is (code == 4)
        document = json.loads(run_command("resid", f"{name}.json", "noisy.csv", "--json", cwd=folder).stdout)
        assert document["passed"] is (code == 0)
    assert run_command("resid", "true.json", "noisy.csv", "--lags", "9999", cwd=folder).returncode == 3


def test_export_writes_for_other_tools_and_overwrites_nothing(folder: Path) -> None:
    ftlm.Model(ftlm.equation("D^1.5 y = -2.0 D^0.5 y - 4.0 y + 3.0 u")).save(folder / "out.json", force=True)
    matlab = run_command("export", "out.json", "--to", "matlab", cwd=folder)
    assert matlab.returncode == 0, matlab.stderr
    assert "fotf(G_y_u.a" in matlab.stdout
    assert json.loads(run_command("export", "out.json", "--to", "json", cwd=folder).stdout)["outputs"] == ["y"]
    as_json = json.loads(run_command("export", "out.json", "--to", "matlab", "--json", cwd=folder).stdout)
    assert as_json["text"].rstrip() == matlab.stdout.rstrip()
    written = run_command("export", "out.json", "--to", "control", "--band", "0.1:100", "-o", "sys.py", cwd=folder)
    assert written.returncode == 0, written.stderr
    assert "control.ss(" in (folder / "sys.py").read_text()
    again = run_command("export", "out.json", "--to", "json", "-o", "sys.py", cwd=folder)
    assert (again.returncode, "exists" in again.stderr) == (3, True)
    for band in ([], ["--band", "3"], ["--band", "1:"], ["--band", "5:1"]):
        refused = run_command("export", "out.json", "--to", "control", *band, cwd=folder)
        assert refused.returncode == 2, band


def test_a_report_of_a_saved_model(folder: Path) -> None:
    ftlm.Model(ftlm.equation("D^1.5 y = -2.0 D^0.5 y - 4.0 y + 3.0 u")).save(folder / "given.json", force=True)
    words = ("report", "given.json", "--validation", "sine.csv", "-o", "given.html")
    ran = run_command(*words, cwd=folder)
    assert ran.returncode == 0, ran.stderr
    assert "written: given.html" in ran.stdout
    text = (folder / "given.html").read_text("utf-8")
    assert "validation: sine" in text
    again = run_command(*words, cwd=folder)
    assert (again.returncode, "--force" in again.stderr) == (3, True)
    assert run_command(*words, "--force", "--json", cwd=folder).returncode == 0
    alone = run_command("report", "given.json", "-o", "alone.html", cwd=folder)
    assert alone.returncode == 0, alone.stderr
    assert "No validation run was given" in (folder / "alone.html").read_text("utf-8")
    for words in (("report", "given.json", "-o", "x.pdf"), ("identify", "square.csv", *SEARCH, "--report", "x.pdf")):
        other = run_command(*words, cwd=folder)
        assert other.returncode == 2
        assert "x.pdf does not end in .html; use this extension" in other.stderr
    missing = run_command("report", "given.json", "-o", "nowhere/x.html", cwd=folder)
    assert (missing.returncode, "is not a folder; create it first" in missing.stderr) == (3, True)
    np.savetxt(folder / "other.csv", np.ones((60, 2)).cumsum(axis=0), delimiter=",", header="t,w", comments="")
    refused = run_command(
        "report", "given.json", "--validation", "other.csv", "--time", "t", "-y", "w", "-o", "x.html", cwd=folder
    )
    assert refused.returncode == 3
    assert "has no signal" in refused.stderr
    assert not (folder / "x.html").exists()


def test_inspect_and_doctor_speak(folder: Path) -> None:
    inspected = run_command("inspect", "square.csv", cwd=folder)
    assert inspected.returncode == 0
    assert "1025 rows" in inspected.stdout
    assert "advice on square" in inspected.stdout
    assert json.loads(run_command("inspect", "square.csv", "--json", cwd=folder).stdout)[0]["rows"] == 1025
    doctor = json.loads(run_command("doctor", "--json", cwd=folder).stdout)
    assert doctor["ftlm"] == ftlm.__version__
    assert run_command("--version", cwd=folder).stdout.split() == ["ftlm", ftlm.__version__]


BAD = [
    (("identify",), 2, "Missing"),
    (("identify", "none.csv", "--structure", EQUATION), 3, "none.csv"),
    (("identify", "square.csv"), 2, "structure"),
    (("identify", "square.csv", "--structure", "flexible-link:3"), 2, "flexible-link:3"),
    (("identify", "square.csv", "--structure", EQUATION, "--structure", "D y = a y"), 2, "is given 2 times"),
    (("identify", "square.csv", "--structure", "D^alpha y = = u"), 2, "character"),
    (("identify", "square.csv", "--structure", "D^1.5 z = a0 z + b0 u"), 3, "z"),
    (("identify", "square.csv", "--structure", EQUATION, "--method", "magic"), 2, "magic"),
    (
        ("identify", "square.csv", *MULTI_INNOVATION, "--innovation-length", "0"),
        2,
        "--innovation-length 0",
    ),
    (
        ("identify", "square.csv", *MULTI_INNOVATION, "--prior-covariance", "-1"),
        2,
        "--prior-covariance -1",
    ),
    (("identify", "square.csv", *SEARCH, "--m", "4096"), 2, "4096"),
    (("identify", "square.csv", *MULTI_INNOVATION, "--m", "1000"), 2, "power of two"),
    (("identify", "square.csv", *SEARCH, "--threads", "0"), 2, "threads"),
    (("identify", "square.csv", *SEARCH, "--top", "0"), 2, "choose the number of rows"),
    (("identify", "square.csv", *SEARCH, "--window", "5"), 2, "--window"),
    (("identify", "square.csv", *SEARCH, "--window", "5:4"), 3, "--window"),
    (("identify", "square.csv", *SEARCH, "--orders", "alhpa=1.5"), 2, "alpha"),
    (("identify", "square.csv", *SEARCH, "--orders", "alpha=10.5"), 2, "10.5"),
    (("identify", "square.csv", *SEARCH, "--fixed", "a1=x"), 2, "'x'"),
    (("identify", "square.csv", *SEARCH, "--delay", "u=-1"), 2, "delay"),
    (("identify", "square.csv", *SEARCH, "--initial", "sleepy"), 2, "sleepy"),
    (("identify", "square.csv", *SEARCH, "--order-grid", "beta=0:1:0.1"), 2, "beta"),
    (("identify", "square.csv", *SEARCH[:4], "--increment", "1e-7"), 2, "raise the increment"),
    (("identify", "square.csv", *SEARCH, "--validation", "none.csv"), 3, "none.csv"),
    (("identify", "square.csv", *SEARCH, "-o", "nowhere/model.json"), 3, "nowhere"),
    (("identify", "square-foreign.csv", *SEARCH, "-u", "u=amps", "-y", "y=mm"), 3, "amps"),
    (("identify", "square-foreign.csv", *SEARCH, "-u", "u=volts", "-y", "y=mm", "--units", "y=furlong"), 3, "furlong"),
    (("identify", "square-foreign.csv", *SEARCH, "-u", "=volts", "-y", "y=mm"), 2, "NAME=VALUE"),
    (("inspect", "square-foreign.csv", "-u", "Motor (A)", "-y", "y=mm"), 2, '-u "motor=Motor (A)"'),
    (("inspect", "square-foreign.csv", "-u", "x[0]", "-y", "y=mm"), 3, "column 'x[0]'"),
    (("identify", "square.csv", *SEARCH, "-o", "."), 3, ". is a folder; name a file in it"),
    (("search", "square.csv", "--structure", "D^1.5 y = a0 y + b0 u"), 2, "nothing to search"),
    (("compare", "none.json", "square.csv"), 3, "none.json"),
    (("compare", "square.csv", "square.csv"), 3, "not an ftlm model"),
    (("simulate", "none.json", "square.csv", "-o", "x.csv"), 3, "none.json"),
    (("simulate", "none.json", "square.csv"), 2, "Missing"),
    (("demo", "-o", "square.csv"), 3, "square.csv"),
    (("demo", "--noise", "-1", "-o", "quiet"), 2, "noise"),
    (("identify", "square.csv", *SEARCH, "-o", "model.txt"), 2, "model.txt does not end in .json; use this extension"),
    (("frobnicate",), 2, "frobnicate"),
    (("validate", "x.json", "square.csv"), 2, "ftlm compare MODEL FILE"),
    (("identify", "square.csv", *SEARCH[:2], "--step", "0,05"), 2, "'0,05' is not a number; write '0.05'"),
    (("identify", "square.csv", *SEARCH[:2], "--m", "3.5"), 2, "'3.5' is not a whole number"),
    (("identify", "square.csv", *SEARCH[:2], "--bounds", "a0=5"), 2, "write --bounds a0=LOW:HIGH"),
    (
        ("identify", "square.csv", *SEARCH, "--validation", "sine.csv", "--validation-window", "99:100"),
        3,
        "--validation-window: limit 99.0 s is out of range",
    ),
    (("identify", "square.csv", "--structure", "D y ="), 2, "found the end"),
    (("identify", "square.csv", "--structure", "D Shaft angle = a y + b u"), 2, "write 'Shaft_angle' for one signal"),
    (("identify", "square.csv", "--structure", "D^2 y = -b D y + k u - f*sgn(D y)"), 2, "did you mean 'sign'?"),
    (("simulate", "model.jsn", "square.csv", "-o", "x.csv"), 3, "cannot be read: No such file or directory"),
    (("compare", "columns.tml", "square.csv"), 3, "(did you mean 'columns.toml'?)"),
]


@pytest.mark.parametrize(("words", "code", "said"), BAD, ids=[f"{i}-{b[2]}" for i, b in enumerate(BAD)])
def test_a_mistake_is_named_with_the_right_exit_code_and_writes_nothing(
    folder: Path, words: tuple[str, ...], code: int, said: str
) -> None:
    before = {p.name: p.stat().st_mtime_ns for p in folder.iterdir() if p.is_file()}
    found = run_command(*words, cwd=folder)
    assert found.returncode == code, found.stderr
    assert said in found.stderr
    assert "Traceback" not in found.stderr
    assert found.stdout == ""
    assert {p.name: p.stat().st_mtime_ns for p in folder.iterdir() if p.is_file()} == before


def test_nothing_is_overwritten_without_force(folder: Path) -> None:
    kept = folder / "kept.json"
    kept.write_text("mine", encoding="utf-8")
    refused = run_command("identify", "square.csv", *SEARCH, "-o", "kept.json", cwd=folder)
    assert refused.returncode == 3
    assert "--force" in refused.stderr
    assert kept.read_text(encoding="utf-8") == "mine"
    assert run_command("identify", "square.csv", *SEARCH, "-o", "kept.json", "--force", cwd=folder).returncode == 0
    assert ftlm.load_model(kept).orders == {"alpha": 1.5, "nu": 0.5}


def test_validation_below_what_was_asked_exits_with_four(folder: Path) -> None:
    run_command(
        "identify",
        "square.csv",
        "--structure",
        "D^1.5 y = a0 y + b0 u",
        "--method",
        "least-squares",
        "-o",
        "poor.json",
        "--force",
        cwd=folder,
    )
    found = run_command("compare", "poor.json", "sine.csv", "--min-fit", "99.9", cwd=folder)
    assert found.returncode == 4
    assert "99.9" in found.stderr


def test_a_closed_pipe_is_no_error(folder: Path) -> None:
    command = f"{sys.executable} -m ftlm inspect square.csv | head -c 1"
    ran = subprocess.run(
        ["bash", "-o", "pipefail", "-c", command], cwd=folder, capture_output=True, text=True, check=False
    )
    assert "Traceback" not in ran.stderr


def test_ctrl_c_ends_a_search_with_130_and_shows_progress_before(folder: Path) -> None:
    # A pseudo-terminal, so that the progress bar is there too.
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "ftlm",
            "search",
            "square.csv",
            "--structure",
            "D^alpha y = a2 D^nu y + a1 D^mu y + a0 D^xi y + b0 u",
            "--coefficients",
            "least-squares",
            "--increment",
            "0.005",
            "--order-grid",
            "alpha=1.0:2.0:0.005",
        ],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=slave,
        env={**os.environ, "TERM": "xterm"},
    )
    os.close(slave)
    seen = b""
    deadline = time.monotonic() + 120
    while b"searching" not in seen and time.monotonic() < deadline:
        seen += os.read(master, 4096)
    assert b"searching" in seen
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=120) == 130
    os.close(master)


@pytest.mark.slow
@needs_data
def test_the_real_arm_from_csv_and_from_mat_files_is_one_model(tmp_path: Path) -> None:
    signals = {"theta11": "th11", "theta12": "th12", "theta21": "th21", "theta22": "th22"}
    csv = 'time = "t_s"\n[inputs]\nI1 = "Im1_meas_A"\nI2 = "Im2_meas_A"\n[outputs]\n'
    csv += "".join(f'{n} = "{c}_deg"\n' for n, c in signals.items())
    mat = '[inputs]\nI1 = "data_Im1.3"\nI2 = "data_Im2.3"\n[outputs]\n'
    mat += "".join(f'{n} = "data_{c}.3"\n' for n, c in signals.items())
    ending = "[units]\n" + "".join(f'{n} = "deg"\n' for n in signals) + '[intersample]\nI1 = "foh"\nI2 = "foh"\n'
    (tmp_path / "csv.toml").write_text(csv + ending, encoding="utf-8")
    (tmp_path / "mat.toml").write_text(mat + ending, encoding="utf-8")
    run = DATA / "two_link_psf"
    mats = sorted(str(p) for p in run.glob("*.mat"))
    assert len(mats) == 6
    for cross in ((), ("--cross-stage", "torques")):
        options = (
            "--window",
            "1.1:7.1",
            "--structure",
            "flexible-link:1",
            "--coupling",
            "measured",
            "--method",
            "least-squares",
            "--increment",
            "0.2",
            "--initial",
            "caputo",
            "--json",
            "--force",
            *cross,
        )
        found = [
            run_command("identify", *files, "--columns", columns, *options, "-o", out, cwd=tmp_path)
            for files, columns, out in (([str(run / "psf.csv")], "csv.toml", "a.json"), (mats, "mat.toml", "b.json"))
        ]
        assert [f.returncode for f in found] == [0, 0], [f.stderr for f in found]
        first, second = (json.loads(f.stdout) for f in found)
        assert first["orders"] == second["orders"]
        for name, value in first["coefficients"].items():
            assert second["coefficients"][name] == pytest.approx(value, rel=1e-6)
        compared = run_command(
            "compare",
            "a.json",
            str(DATA / "two_link_lqr" / "lqr.csv"),
            "--columns",
            "csv.toml",
            "--window",
            "0:6",
            cwd=tmp_path,
        )
        assert compared.returncode == 0, compared.stderr
        for words in ("equation error", "output error", "theta11", "theta12"):
            assert words in compared.stdout


@needs_data
@pytest.mark.parametrize(
    ("file", "options", "structure", "least"),
    [
        (
            "robot_arm/robot_arm.dat",
            ("--step", "1", "-u", "torque=c1", "-y", "acceleration=c2", "--order-grid", "alpha=1.5:2.5:0.1"),
            "D^alpha acceleration = a1 D^nu acceleration + a0 acceleration + b0 torque + b1 D^mu torque",
            0.0,
        ),
        (
            "heating/heating_system.dat",
            ("--time", "c1", "-u", "voltage=c2", "-y", "temperature=c3", "--units", "temperature=degC"),
            "D^alpha temperature = a0 temperature + b0 voltage",
            80.0,
        ),
    ],
)
def test_the_classic_data_sets_give_a_model_each(
    tmp_path: Path, file: str, options: tuple[str, ...], structure: str, least: float
) -> None:
    # Least squares does badly on the robot arm, whose noise is large; the model is there and says so.
    rest = ("--structure", structure, "--method", "least-squares", "--increment", "0.1", "--json", "-o", "m.json")
    if "alpha=1.5:2.5:0.1" not in options:
        rest = (*rest, "--order-grid", "alpha=0.3:1.5:0.05")
    found = run_command("identify", str(DATA / file), *options, *rest, cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    data = json.loads(found.stdout)
    (fit,) = (figures["fit"] for figures in data["output_error"].values())
    assert fit > least
    assert ftlm.load_model(tmp_path / "m.json").outputs == tuple(data["output_error"])


def test_an_equation_is_a_structure(folder: Path) -> None:
    for words in (["--equation", EQUATION], [f"--equation={EQUATION}"]):
        found = run_command("identify", "square.csv", *words, cwd=folder)
        assert found.returncode == 2
        assert "No such option: --equation; --structure takes equations as text" in found.stderr
    # Where there is no structure, it is as unknown as any other.
    assert "No such option: --equation" in run_command("doctor", "--equation", "x", cwd=folder).stderr


LONG = {
    "D^2.0001 theta11 = 628.554 theta12 - 62.9418 D^0.95 theta11 + 6.64195 D^0.7498 theta12 + 140.4 I1(t - 0.035 s)": [
        "D^2.0001 theta11 = 628.554 theta12 - 62.9418 D^0.95 theta11",
        "  + 6.64195 D^0.7498 theta12 + 140.4 I1(t - 0.035 s)",
    ],
    "  gain   theta11 from I1: none, it integrates: 2.2312 ± 0.0027 rad/A; order 0.95 ± 0.01": [
        "  gain   theta11 from I1: none, it integrates:",
        "         2.2312 ± 0.0027 rad/A; order 0.95 ± 0.01",
    ],
    "! residuals of y are not white: the model leaves something out, of which nothing is known": [
        "! residuals of y are not white: the model leaves something",
        "  out, of which nothing is known",
    ],
    "a row  of a table  with  many cells  stays as it is  whatever  its length may be in the end": None,
    "next: ftlm identify a.csv -u u -y y --structure 'D^alpha y = a0 y + b0 u' --time t --time-unit ms": None,
    "short": None,
}


@pytest.mark.parametrize("line", LONG)
def test_lines_break_between_words_and_equations_between_terms(monkeypatch, line):
    monkeypatch.setenv("COLUMNS", "60")
    parts = wrap_line(line)
    assert parts == (LONG[line] or [line])
    assert " ".join(p.strip() for p in parts) == line.strip()
    # Who reads a pipe gets each line whole.
    monkeypatch.setattr("sys.stdout", io.StringIO())
    print_text(line)
    assert sys.stdout.getvalue() == f"{line}\n"


def test_the_list_of_commands_is_whole_sentences_and_no_help_names_a_type_of_python():
    """At 80 columns; units in square brackets are there, and what people read has no angle brackets but choices."""
    listed = CliRunner().invoke(app, ["-h"], env={"COLUMNS": "80"}).output
    names = re.findall(r"^  ([a-z-]+)  +(\S.*)$", listed.partition("Commands:")[2], re.MULTILINE)
    assert len(names) == 25
    assert all(words.endswith(".") and not words.endswith("..") for _, words in names)
    for name, _ in names:
        told = CliRunner().invoke(app, [name, "-h"], env={"COLUMNS": "80"}).output
        assert max(map(len, told.splitlines())) <= 95, name
        assert not re.search(r"<(list|str|int|float|bool)", told), name
        for line in re.findall(r"<[^>]*>", told):
            assert "|" in line, (name, line)
    assert (
        "Sampling interval [s] of files" in CliRunner().invoke(app, ["identify", "-h"], env={"COLUMNS": "120"}).output
    )


# ----------------------------------------------------------------------------------------------------------------------
# Names that a terminal would obey

#: A title, colours, an erased line and a turned text, as names of files, columns, units and models may hold them.
ACTS = "\x1b]0;PWN\x07\x1b[31m\x9b2K\r\u202egpj\u2066\x7f"
CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
EVERY_COMMAND = """
import json, sys
from ftlm.cli.main import COMMAND_HELP, main
commands = json.loads(sys.argv[1])
known = set(COMMAND_HELP)
assert known == {words[0] for words in commands}, known ^ {words[0] for words in commands}
for words in commands:
    sys.argv = ["ftlm", *words]
    sys.stderr.write(f"== {words[0]}\\n")
    try:
        main()
    except SystemExit as ended:
        sys.stderr.write(f"exit {ended.code}\\n")
"""


@pytest.mark.slow
def test_no_command_prints_what_a_terminal_obeys(tmp_path):
    t = np.arange(200) * 0.05
    rows = "\n".join(f"{a},{np.sign(np.sin(a))},{np.sin(a)}" for a in t)
    text, mat, model, store, absent = (f"{ACTS}.{ending}" for ending in ("csv", "mat", "json", "ftlm", "none"))
    (tmp_path / text).write_text(f"t,u{ACTS} [{ACTS}],y{ACTS}\n{rows}\n", encoding="utf-8")
    (tmp_path / "plain.csv").write_text(f"t,u,y\n{rows}\n", encoding="utf-8")
    # A damaged matrix whose name the library passes on in its message.
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    label = ACTS.encode()
    body = struct.pack("<IIIIIIII", 6, 8, 6, 0, 5, 8, 9, 9) + struct.pack("<II", 1, len(label)) + label
    (tmp_path / mat).write_bytes(head + struct.pack("<II", 14, len(body)) + body)
    saved = ftlm.Model(ftlm.equation("D y = -0.5 y + 0.5 u"))
    saved.save(tmp_path / "plain.json")
    document = json.loads((tmp_path / "plain.json").read_text(encoding="utf-8"))
    (tmp_path / model).write_text(json.dumps({**document, "name": ACTS, "about": {ACTS: ACTS}}), encoding="utf-8")
    (tmp_path / store).write_bytes(b"no store")
    (tmp_path / f"{ACTS}.toml").write_text(f'"{ACTS.encode("unicode_escape").decode()}" = 3\n'.replace("\\x", "\\u00"))
    equation, signals = f"D y = a y + b {ACTS}", ["-u", f"u=u{ACTS}", "-y", f"y=y{ACTS}", "--time", "t"]
    fit = ["--structure", "D y = a y + b u", "--method", "least-squares"]
    done = subprocess.run(
        [
            *(sys.executable, "-c", EVERY_COMMAND),
            json.dumps(
                [
                    *([name, ACTS, absent] for name in ("app", "open", "inspect", "status", "resume")),
                    *([name, f] for name in ("open", "inspect", "status", "resume") for f in (absent, text, mat)),
                    *([name, store] for name in ("status", "resume")),
                    ["open", text, "--json"],
                    ["inspect", text, *signals],
                    ["inspect", text, "--columns", f"{ACTS}.toml"],
                    ["inspect", text, *signals, "--units", f"y={ACTS}"],
                    *(
                        [n, text, *signals, "--structure", equation]
                        for n in ("identify", "search", "certify", "select")
                    ),
                    ["consistency", text, *signals, "--structure", equation],
                    ["identify", text, *signals, *fit, "--orders", f"{ACTS}=1"],
                    ["identify", text, *signals, *fit, "-o", f"{ACTS}-made.json", "--report", f"{ACTS}.html"],
                    ["identify", text, *signals, *fit, "-o", f"{ACTS}-made.json"],
                    ["identify-frequency", text, "--structure", "D y = a y + b u"],
                    ["orders", absent],
                    *([name, file, "plain.csv"] for name in ("compare", "resid") for file in (model, absent, store)),
                    *([name, model, text, *signals] for name in ("compare", "resid")),
                    ["simulate", model, "plain.csv", "-o", f"{ACTS}-simulated.csv"],
                    ["simulate", model, absent, "-o", f"{ACTS}-simulated.csv"],
                    ["report", model, "-o", f"{ACTS}-report.html"],
                    ["report", model, "-o", f"{ACTS}-report.html"],
                    *(
                        [name, file]
                        for name in ("export", "plot", "control", "input-shaper")
                        for file in (model, absent)
                    ),
                    ["export", model, "--to", "json", "-o", f"{ACTS}-export.txt"],
                    ["control", model, "--crossover", "1", "-o", f"{ACTS}-pid.json"],
                    ["design-input", model, "--reference-run", absent],
                    ["design-input", absent],
                    ["record", "--duration", "0.1", "-o", f"{ACTS}-run.csv"],
                    ["record", "--duration", "0.1", "-o", f"{ACTS}-run.csv"],
                    ["record", "--parameters", f"{ACTS}.toml", "-o", "x.csv"],
                    ["demo", "-o", f"{ACTS}/nowhere/{ACTS}"],
                    ["reproduce", "-o", f"{ACTS}/nowhere", "--arms", ACTS],
                    ["doctor", ACTS],
                    ["doctor"],
                ]
            ),
        ],
        cwd=tmp_path,
        capture_output=True,
        check=False,
        timeout=120,
    )
    printed = (done.stdout + done.stderr).decode()
    assert done.returncode == 0, printed
    assert "Traceback" not in printed
    assert sorted(set(CONTROLS.findall(printed))) == []
    # They are shown, not dropped.
    assert "\\u001b]0;PWN\\u0007" in printed
    assert "\\u202egpj" in printed


def test_a_bar_is_drawn_and_its_label_escaped(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    escape_standard_streams()
    progress.BAR_DELAY_S, before = 0.0, progress.BAR_DELAY_S
    try:
        with progress.Progress(ACTS) as bar:
            bar(1, 10)
            print(f"above {ACTS}", file=sys.stderr)
            bar(10, 10)
    finally:
        progress.BAR_DELAY_S = before
    drawn = terminal.getvalue()
    assert "\x1b[" in drawn
    assert "PWN\x07" not in drawn
    assert "\x9b" not in drawn
    assert "\u202e" not in drawn
    assert isinstance(sys.stderr, EscapedStream)


# ------------------------------------------------------------------------------------------------ start


@pytest.mark.parametrize("words", [["--version"], ["-h"], ["open", "run.csv"]])
def test_a_command_imports_what_it_needs_alone(words, tmp_path):
    (tmp_path / "run.csv").write_text("t,u,y\n" + "".join(f"{k / 100},{k % 7},{k % 5}\n" for k in range(200)))
    code = (
        "import sys; from ftlm.cli import app\n"
        f"try: app({words!r})\nexcept SystemExit as end: assert not end.code, end.code\n"
        "heavy = ('ftlm.estimation', 'ftlm.rig', 'ftlm.control', 'ftlm.app', 'ftlm.reproduction', 'rich', 'scipy')\n"
        "print('imported:', sorted(set(heavy) & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert out.stdout.splitlines()[-1] == "imported: []"


def test_every_option_has_a_help_text():
    table = CommandTable(COMMAND_HELP)
    bare = [(name, p.name) for name in COMMAND_HELP for p in table[name].params if not getattr(p, "help", None)]
    assert bare == []
    # Docstrings are not computed.
    (port,) = (p for p in table["app"].params if p.name == "port")
    assert f"default {DEFAULT_PORT}," in port.help


def test_a_file_to_write_is_checked_before_the_work(tmp_path):
    done = []

    @framework.command
    def work(*, out: framework.OutputFile, force: bool = False) -> None:
        done.append((out, force))

    commands, path = typer.Typer(), tmp_path / "a.csv"
    commands.command()(work)
    assert CliRunner().invoke(commands, ["-o", str(path)]).exit_code == 0
    path.write_text("mine")
    for words in (["-o", str(path)], ["--out", str(tmp_path / "no" / "a.csv")]):
        refused = CliRunner().invoke(commands, words)
        assert refused.exit_code == 3
        assert "overwrite it with --force" in refused.stderr or "is not a folder; create it first" in refused.stderr
    assert CliRunner().invoke(commands, ["-o", str(path), "--force"]).exit_code == 0
    assert done == [(str(path), False), (str(path), True)]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["identify", "x.csv", "--structure", "auto", "--method", "output-eror"], "(did you mean 'output-error'?)"),
        (["open", "x.csv", "--separator", "coma"], "(did you mean 'comma'?)"),
        (["identify", "x.csv", "--structure", "atuo"], "(did you mean 'auto'?)"),
        (["search", "x.csv", "--structure", "auto"], "selects a structure in ftlm identify and ftlm select"),
        (["select", "x.csv", "--circuit", "R0"], "ftlm identify-frequency takes circuits: fit each"),
    ],
)
def test_a_word_that_is_no_choice_is_refused_with_the_nearest_one(folder: Path, words: list[str], text: str) -> None:
    found = run_command(*[word.replace("x.csv", "square.csv") for word in words], cwd=folder)
    assert found.returncode == 2
    assert text in " ".join(found.stderr.split())


def test_search_writes_a_report_of_its_table_profiles_and_validation(tmp_path: Path) -> None:
    plant = ftlm.Model(ftlm.equation("D^0.8 y = -0.7 y + 1.4 u"))
    for k in range(2):
        g = np.random.default_rng(k)
        u = np.repeat(g.choice([-1.0, 1.0], 20), 15)
        clean = plant.simulate(ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0 * u}))
        columns = np.c_[0.05 * np.arange(u.size), u, clean["y"] + 0.01 * g.standard_normal(u.size)]
        np.savetxt(tmp_path / f"{k}.csv", columns, delimiter=",", header="t,u,y", comments="")
    words = ("0.csv", "--structure", "D^alpha y = a y + b u", "--order-grid", "alpha=0.6:1:0.02", "--top", "4")
    plain = run_command("search", *words, cwd=tmp_path)
    found = run_command("search", *words, "--report", "s.html", "--validation", "1.csv", cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    assert found.stdout.startswith(plain.stdout)
    fit = re.search(r"validation on 1: fit y ([\d.]+) %; WITH CARE: ", found.stdout)
    assert fit is not None
    assert float(fit[1]) > 95.0
    page = (tmp_path / "s.html").read_text()
    assert f"Fit on validation data (1): y {float(fit[1]):.2f}" in page
    part = page[page.index("Order search</h2>") :]
    assert "Best 4 of 21 candidates" in part
    assert "Score over α" in part
    document = json.loads(run_command("search", *words, "--validation", "1.csv", "--json", cwd=tmp_path).stdout)
    assert document["validation"]["output_error"]["y"]["fit"] == pytest.approx(float(fit[1]), abs=0.01)
    written = run_command("search", *words, "-o", "s.json", cwd=tmp_path)
    assert (written.returncode, written.stdout) == (0, plain.stdout)
    assert ftlm.load_model(tmp_path / "s.json").orders == {"alpha": pytest.approx(0.8, abs=0.05)}
    again = run_command("search", *words, "--report", "s.html", cwd=tmp_path)
    assert again.returncode != 0
    assert "--force" in again.stderr


def test_a_score_profile_has_the_scores_of_the_search_along_one_order(tmp_path: Path) -> None:
    g = np.random.default_rng(3)
    u = np.repeat(g.choice([-1.0, 1.0], 20), 15)
    plant = ftlm.Model(ftlm.equation("D^0.8 y = -0.7 y + 1.4 u"))
    run = plant.simulate(ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0 * u}))
    run = run.with_outputs({"y": run["y"] + 0.01 * g.standard_normal(u.size)})
    structure = ftlm.equation("D^alpha y = a D^beta y + b u")
    grid = ftlm.OrderGrid(orders={"alpha": [0.7, 0.75, 0.8, 0.85], "beta": [0.0, 0.1, 0.2]})
    search = ftlm.search_orders(run, structure, grid, top=12)
    charts = score_profiles([run], structure, search, grid)
    assert [chart.title for chart in charts] == ["Score over α", "Score over β"]
    scores = {(r.orders["alpha"], r.orders["beta"]): r.score for r in search.table}
    best = search.orders
    (_, along), (_, marked) = charts[1].lines
    assert along == pytest.approx([scores[best["alpha"], beta] for beta in grid.orders["beta"]], rel=1e-9)
    assert np.nanmin(marked) == pytest.approx(search.score, rel=1e-9)
    assert np.count_nonzero(np.isfinite(marked)) == 1


def test_equations_are_coupled_as_in_python():
    words = "D x = -a x + b y; D y = -c y + d u"
    assert StructureOptions().structure(words).coupling == ftlm.equation(words).coupling == "measured"


def test_tables_fit_a_terminal_of_80_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Columns without room follow in a second table, and long structures and reasons take several lines."""
    monkeypatch.setenv("COLUMNS", "80")
    rng = np.random.default_rng(3)
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 10)
    y = np.convolve(u, 0.02 * 0.98 ** np.arange(400))[:400] + 0.001 * rng.standard_normal(400)
    np.savetxt(
        tmp_path / "a.csv", np.column_stack([0.02 * np.arange(400), u, y]), header="t,u,y", comments="", delimiter=","
    )
    run = ftlm.load(tmp_path / "a.csv")
    inspected = str(run.inspect()).splitlines()
    assert [line.split()[3:] for line in inspected if line.startswith("signal")] == [
        ["first", "low", "high", "mean", "sd"],
        ["noise", "quantum"],
    ]
    long = "D y = a y + b u + c u*u + d u*u*u + e y*u + f y*y*u + g abs(y)*u"
    choice = ftlm.select(run, [ftlm.equation(text) for text in ("D y = a y + b u", long, "D y = k exp(1e7*y) + b u")])
    failed = [trial for trial in choice.trials if trial.failure]
    assert failed
    lines = choice.ranking_text().splitlines()
    table = lines[1 : next(k for k, line in enumerate(lines) if line.startswith("Chosen"))]
    assert max(map(len, table)) <= 80
    words = " ".join(" ".join(line.split()) for line in table)
    assert all(trial.name in words for trial in choice.trials)
    assert failed[0].failure in words
    table_of_orders = ftlm.search_orders(
        run, ftlm.equation("D^alpha y = a y + b u"), ftlm.order_grid(0.1, alpha=(0.9, 1.1))
    )
    assert max(map(len, str(table_of_orders).partition("next: ")[2].splitlines())) <= 80
