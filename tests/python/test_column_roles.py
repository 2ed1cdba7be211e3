"""Columns that nobody names: what `open` assumes is what load and every command use, and is said."""

import numpy as np
import pytest

import ftlm
from command_line import run_command

EQUATION = "D {y} = a {y} + b {u}"


def write(path, names, *, scale=1.0):
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], 40), 10)
    empty = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0 * u})
    y = ftlm.Model(ftlm.equation("D y = -2 y + 3 u")).simulate(empty)["y"]
    rows = [
        ",".join(names),
        *(f"{0.05 * k:.2f},{a},{scale * b:.6f}" for k, (a, b) in enumerate(zip(u, y, strict=True))),
    ]
    path.write_text("\n".join(rows) + "\n")
    return str(path)


def test_load_chooses_what_open_assumes(tmp_path):
    file = write(tmp_path / "a.csv", ["t", "Motor voltage [V]", "Tip angle [deg]"])
    opened, run = ftlm.open_file(file), ftlm.load(file)
    assert run.inputs == ("Motor_voltage",)
    assert run.outputs == ("Tip_angle",)
    assert all(np.array_equal(run[n], opened.load()[n]) for n in run.signals)
    assert run.units == {"Motor_voltage": "V", "Tip_angle": "rad"}
    assert any("by their names" in str(w) for w in run.warnings)


def test_columns_that_are_named_are_not_said_to_be_assumed(tmp_path):
    run = ftlm.load(write(tmp_path / "a.csv", ["t", "u", "y"]), inputs=["u"], outputs=["y"])
    assert not any("by their names" in str(w) for w in run.warnings)


def test_ambiguous_names_are_refused_with_the_columns(tmp_path):
    file = write(tmp_path / "a.csv", ["t", "foo", "bar"])
    with pytest.raises(ftlm.DataError, match=r"no output is named.*'foo', 'bar'"):
        ftlm.load(file)


@pytest.mark.parametrize(
    ("names", "u", "y"),
    [
        (["t", "u", "y"], "u", "y"),
        (["t", "foo", "bar"], "foo", "bar"),
        (["t", "drive [V]", "Angle (deg)"], "drive", "Angle"),
    ],
)
def test_the_signals_of_an_equation_are_found_by_name(tmp_path, names, u, y):
    file, model = write(tmp_path / "a.csv", names), str(tmp_path / "model.json")
    made = run_command("identify", file, "--structure", EQUATION.format(u=u, y=y), "-o", model)
    assert made.returncode == 0, made.stderr
    assert ftlm.load_model(model).coefficients["a"] == pytest.approx(-2.0, rel=0.01)
    assert "by their names" not in made.stdout
    compared = run_command("compare", model, file)
    assert compared.returncode == 0, compared.stderr


def test_a_name_in_the_equation_that_no_column_has_is_an_error(tmp_path):
    made = run_command(
        "identify", write(tmp_path / "a.csv", ["t", "foo", "bar"]), "--structure", "D baz = a baz + b foo"
    )
    assert made.returncode == 3
    assert "-u NAME=COLUMN and -y NAME=COLUMN" in made.stderr
    assert "'foo', 'bar'" in made.stderr


def test_names_that_options_give_win(tmp_path):
    file = write(tmp_path / "a.csv", ["t", "u", "y"])
    made = run_command("identify", file, "-u", "x=u", "-y", "z=y", "--structure", "D z = a z + b x")
    assert made.returncode == 0, made.stderr


def test_inspect_needs_no_names(tmp_path):
    shown = run_command("inspect", write(tmp_path / "a.csv", ["t", "u", "y"]))
    assert shown.returncode == 0, shown.stderr
    assert "'u' is an input of 'y', by their names" in shown.stdout


def test_open_writes_a_columns_file_that_loads_the_same_run(tmp_path):
    file, columns = (
        write(tmp_path / "a.csv", ["t", 'Motor "A" voltage [V]', "Tip angle [deg]"]),
        tmp_path / "bench.toml",
    )
    shown = run_command("open", file, "--write-columns", str(columns))
    assert shown.returncode == 0, shown.stderr
    assert f"written: {columns}" in shown.stdout
    run, again = ftlm.open_file(file).load(), ftlm.load(file, columns=columns)
    assert run.units == again.units
    assert all(np.array_equal(run[n], again[n]) for n in run.signals)
    assert not any("by their names" in str(w) for w in again.warnings)
    assert run_command("open", file, "--write-columns", str(columns)).returncode == 3
    assert run_command("open", file, "--write-columns", str(columns), "--force").returncode == 0


def test_a_file_that_is_no_run_has_no_columns_to_write(tmp_path):
    file = write(tmp_path / "a.csv", ["t", "foo", "bar"])
    with pytest.raises(ftlm.DataError, match="has no columns to write"):
        ftlm.open_file(file).write_columns(tmp_path / "bench.toml")


def test_a_file_with_outputs_alone_is_a_free_response(tmp_path):
    path = tmp_path / "decay.csv"
    time = np.arange(200) * 0.1
    angle = np.exp(-0.1 * time) * np.cos(2 * time)
    path.write_text("time,angle\n" + "\n".join(f"{t:.12g},{y:.12g}" for t, y in zip(time, angle, strict=True)) + "\n")
    run = ftlm.load(path)
    assert (run.inputs, run.outputs) == ((), ("angle",))
    assert any("there is no input of 'angle', the only signal" in w for w in run.warnings)


@pytest.mark.parametrize(
    ("names", "inputs", "outputs"),
    [
        (["t", "x (mm)"], (), ("x",)),
        (["t", "Vin", "Vout"], ("Vin",), ("Vout",)),
        (["time (min)", "pump speed (%)", "pressure (bar)"], ("pump_speed",), ("pressure",)),
    ],
)
def test_roles_of_names_on_a_bench(tmp_path, names, inputs, outputs):
    path = tmp_path / "bench.csv"
    rows = [",".join(str(v) for v in (0.1 * k, k % 7, k % 5)[: len(names)]) for k in range(60)]
    path.write_text("\n".join([",".join(names), *rows]) + "\n")
    run = ftlm.load(path)
    assert (run.inputs, run.outputs) == (inputs, outputs)
