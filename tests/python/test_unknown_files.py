"""Files of strangers: from each to a validated model by one command, the truth within its intervals; `ftlm open`."""

import json
import re
import shlex

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
import unknown_files
from ftlm.cli.main import app
from slow_cases import slow_after


def command(*words):
    return CliRunner().invoke(app, list(map(str, words)), env={"COLUMNS": "200", "NO_COLOR": "1"})


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Each stranger's file in a folder."""
    folder = tmp_path_factory.mktemp("strangers")
    made = {name: unknown_files.write_file(name, folder) for name in unknown_files.MAKERS}
    for stranger in made.values():
        (folder / stranger.name).write_bytes(stranger.content)
    return folder, made


@slow_after(2, "name", unknown_files.MAKERS)
@pytest.mark.usefixtures("reader_in_process")
def test_one_command_from_a_strangers_file_to_a_validated_model(files, name):
    folder, made = files
    path = folder / made[name].name
    done = command(
        "identify",
        path,
        *made[name].words,
        "--structure",
        unknown_files.EQUATION,
        "--window",
        ":3.6",
        "--intervals",
        "quadratic",
        "--validation",
        path,
        "--json",
    )
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    for number, true in unknown_files.TRUTH.items():
        low, high = found["intervals"][number]
        assert low < true < high, number
        assert high - low < 0.2 * abs(true), number
    assert found["validation"]["output_error"]["y"]["fit"] > 95


def test_a_heated_rods_csv_becomes_a_model_of_half_an_order(tmp_path):
    """From a file that physics wrote, and no equation of ours, to a model that predicts another one."""
    (tmp_path / "other.csv").write_bytes(unknown_files.rod([(20, 5), (120, 8), (260, -13), (330, 10)], 9))
    within = []
    for seed in range(2):
        (tmp_path / "rod.csv").write_bytes(
            unknown_files.rod([(10, 12), (150, -9), (230, 9), (290, -12), (350, 6)], seed)
        )
        done = command(
            "identify",
            tmp_path / "rod.csv",
            "-u",
            "P=Heizleistung",
            "-y",
            "T=Temperatur",
            "--structure",
            "D^alpha T = a T + b P + c",
            "--intervals",
            "quadratic",
            "--validation",
            tmp_path / "other.csv",
            "--json",
        )
        assert done.exit_code == 0, done.output
        found = json.loads(done.stdout)
        for number, true in unknown_files.ROD.items():
            low, high = found["intervals"][number]
            assert high - low < 0.03 * abs(true), number
            within.append(low < true < high)
        assert found["verdict"]["level"] == "trust"
        assert found["validation"]["output_error"]["T"]["fit"] > 98
    # 95 % of six; of 24 seeds 70 of 72 lay within.
    assert sum(within) >= 5
    # What is above the table, its units, its commas and its letters were seen without a word.
    opened = ftlm.open_file(tmp_path / "rod.csv")
    assert [(c.role, c.unit) for c in opened.columns] == [("time", "s"), ("input", "W"), ("output", "°C")]


@pytest.mark.parametrize("name", unknown_files.MAKERS)
@pytest.mark.usefixtures("reader_in_process")
def test_the_record_is_the_one_that_was_written_and_open_says_all_that_was_assumed(files, name):
    folder, made = files
    path, stranger = folder / made[name].name, made[name]
    asked = {"inputs": {"u": stranger.words[1].partition("=")[2] or "u"}}
    asked["outputs"] = {"y": stranger.words[3].partition("=")[2] or "y"}
    opened = ftlm.open_file(path, **asked)
    assert (opened.problem, opened.rows) == ("", unknown_files.ROWS)
    run = opened.load()
    _, u, y = unknown_files.record()
    factor = np.pi / 180 if opened.options.get("units", {}).get("y") == "deg" else 1.0
    assert (run.length, run.step) == (unknown_files.ROWS, pytest.approx(unknown_files.STEP, rel=1e-12))
    assert run.start == pytest.approx(stranger.start, abs=1e-12)
    np.testing.assert_allclose(run["u"], u, rtol=0, atol=1e-12)
    np.testing.assert_allclose(run["y"], factor * y, rtol=0, atol=1e-12)
    # Said explicitly, nothing is assumed any more, and the run is the same.
    said = {str(a) for a in opened.assumptions if a.affects_run and a.option not in ("inputs", "outputs")}
    assert not said & set(run.warnings)
    plain = ftlm.load(path, **asked, units=opened.options.get("units"))
    assert said <= set(plain.warnings)
    assert plain.step == run.step == opened.step
    assert all(run[n].tobytes() == plain[n].tobytes() for n in run.signals)


def test_the_manual_shows_what_is_printed(files, monkeypatch, root):
    folder, made = files
    monkeypatch.chdir(folder)
    (block,) = re.findall(r"^```text\n(.*?)^```", (root / "docs" / "files.md").read_text(encoding="utf-8"), re.S | re.M)
    shown, printed = block.splitlines(), command("open", made["German csv"].name).stdout.splitlines()
    assert shown[0] == "$ ftlm open messung.csv"
    for line, real in zip(shown[1:], printed, strict=True):
        assert real.startswith(line.removesuffix("…"))


@pytest.mark.parametrize("name", ["German csv", "LabVIEW text", "oscilloscope", "dates", "xlsx", "utf-16"])
def test_the_command_that_open_names_works(files, name):
    folder, made = files
    path, stranger = folder / made[name].name, made[name]
    shown = command("open", path, *stranger.words)
    assert shown.exit_code == 0, shown.output
    lines = [line.removeprefix("next: ") for line in shown.stdout.splitlines() if line.startswith("next: ")]
    assert [line.split()[1] for line in lines] == ["inspect", "identify"]
    assert "layout=" not in shown.stdout
    looked = command(*shlex.split(lines[0])[1:], "--json")
    assert looked.exit_code == 0, looked.output
    (figures,) = json.loads(looked.stdout)
    assert (figures["rows"], figures["step"]) == (unknown_files.ROWS, pytest.approx(unknown_files.STEP))
    words = shlex.split(lines[1])[1:]
    assert words[words.index("--structure") + 1] == "auto"
