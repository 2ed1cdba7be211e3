"""`ftlm open`: what names say of columns, what is asked, what is printed, and that its options work."""

import json
import shlex

import numpy as np
import pytest

import ftlm
from command_line import run_command
from ftlm.data.units import SIGNAL_UNITS, parse_unit
from ftlm.io.cell_parsing import split_unit
from ftlm.io.column_roles import guess_roles, known_unit, signal_names
from test_files import messages, rows, write
from test_unknown_files import command


@pytest.mark.parametrize(
    ("columns", "roles"),
    [
        (["u", "y"], (["u"], ["y"])),
        (["u1", "u2", "y1", "y2"], (["u1", "u2"], ["y1", "y2"])),
        (["Im1_meas_A", "th11_deg", "th12_deg"], (["Im1_meas_A"], ["th11_deg", "th12_deg"])),
        (["Motor Voltage (V)", "Shaft Speed (rpm)"], (["Motor Voltage (V)"], ["Shaft Speed (rpm)"])),
        (["input angle", "output angle"], (["input angle"], ["output angle"])),
        (["inputVoltage", "outputVoltage"], (["inputVoltage"], ["outputVoltage"])),
        (["Strom (A)", "Kanal 2"], (["Strom (A)"], ["Kanal 2"])),
        (["Channel A", "Temperature"], (["Channel A"], ["Temperature"])),
        # A reference neither enters a plant nor leaves it, and a measured current stands for its command.
        (["Im1_cmd_A", "Im1_meas_A", "Im2_cmd_A", "th1_ref", "th1"], (["Im1_meas_A", "Im2_cmd_A"], ["th1"])),
        (["ref", "y"], (["ref"], ["y"])),
        # Nothing is guessed where names leave anything open.
        (["CH1", "CH2"], ([], [])),
        (["Voltage_0", "Voltage_1"], ([], [])),
        (["u", "a", "b"], ([], [])),
        # A motor's current follows its voltage, a cell's voltage its current.
        (["Current [A]", "Voltage [V]"], ([], [])),
        (["y"], ([], ["y"])),
        (["u"], ([], [])),
        ([], ([], [])),
    ],
)
def test_roles_by_names(columns, roles):
    assert guess_roles(columns) == roles


def test_names_and_units_that_equations_and_runs_can_hold():
    named = signal_names({"Strom (A)": "u", "2nd": "u", "D": "y", "größe": "y", "a b": "u", "a  b": "u", "g/x": "y"})
    assert named == {
        "Strom (A)": "Strom",
        "2nd": "u",
        "D": "y",
        "größe": "größe",
        "a b": "a_b",
        "a  b": "a_b_2",
        "g/x": "x",
    }
    for name in named.values():
        assert ftlm.equation(f"D^alpha {name} = a0 {name} + b0 drive").equations
    units = {"Volt": "V", "deg": "deg", "degrees": "deg", "furlong": "", "U/min": "rpm", "": ""}
    assert {stated: known_unit(stated) for stated in units} == units


def test_units_as_people_spell_them():
    spelled = {
        "grd": "deg",
        "Grad": "deg",
        "°": "°",
        "º": "°",
        "deg.": "deg",
        "Degrees": "deg",
        "°/s": "deg/s",
        "Grad/s": "deg/s",
        "mA": "mA",
        "MA": "",
        "Amps": "A",
        "Vdc": "V",
        "VAC": "",
        "Nm": "Nm",
        "N m": "Nm",
        "nm": "",
        "U/min": "rpm",
        "1/min": "rpm",
        "RPM": "rpm",
        "rev/min": "rpm",
        "min⁻¹": "rpm",
        "m/s²": "m/s²",
        "m/s2": "m/s^2",
        "μm": "µm",
        "um": "µm",
        "℃": "",
        "° C": "°C",
        "Sek.": "",
        "%": "",
        "Ω": "",
    }
    assert {stated: known_unit(stated) for stated in spelled} == spelled
    assert [known_unit(unit, "Oil Temperature") for unit in ("°", "Grad", "°C", "K")] == ["", "", "°C", "K"]
    for word in ("furlong", "Zeit", "x" * 10**6, "U", "Motor"):
        assert parse_unit(word) is None
    # What a file spells is converted as what ftlm knows.
    assert all(known_unit(unit) in SIGNAL_UNITS for unit in spelled)


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        ("Zeit;Strom;Winkel\ns;A;grd", "deg"),
        ("Zeit;Strom;Winkel\nSek.;mA;°", "°"),
        ("Zeit;i;M\n[s];[A];[N m]", "Nm"),
        ('"Zeit";"Strom";"Drehzahl"\n"s";"A";"U/min"', "rpm"),
        ("Zeit / s;Strom / A;Winkel / Grad", "deg"),
        ("Zeit, s;Strom, A;Winkel, deg.", "deg"),
        ("Zeit in s;Strom in A;Winkel in °", "°"),
        ("Zeit ; Strom ; Weg\ns ; A ; mm", "mm"),
        ("t / (s);Strom / (A);v / (m/s)", "m/s"),
        ("Motor;;Geber\nZeit;Strom;Winkel\ns;A;Grad", "deg"),
    ],
)
def test_units_are_no_names(tmp_path, header, unit):
    path = write(tmp_path, header + "\n" + rows().replace(",", ";"))
    opened = ftlm.open_file(path, inputs={"u": 1}, outputs={"y": 2})
    assert not opened.problem
    time, drive, answer = opened.columns
    assert (time.role, known_unit(drive.unit)) == ("time", "mA" if "mA" in header else "A")
    assert (known_unit(answer.unit), opened.options["units"]["y"]) == (unit, unit)
    names = (split_unit(c.name)[0] for c in (time, drive, answer))
    assert all(name[0].isalpha() and parse_unit(name) is None for name in names)
    run = opened.load()
    si, scale = SIGNAL_UNITS[unit]
    assert (run.units["y"], run.step) == (si, pytest.approx(0.01))
    np.testing.assert_allclose(run["y"], scale * ftlm.load(path, **{**opened.options, "units": {"y": ""}})["y"])


def test_an_end_mark_of_old_programs_is_no_row(tmp_path):
    whole = ftlm.open_file(write(tmp_path, "Time,u,y\n" + rows(), "a.csv"))
    assert ftlm.open_file(write(tmp_path, "Time,u,y\n" + rows() + "\x1a", "b.csv")).rows == whole.rows


def test_what_names_leave_open_is_asked_and_then_answered(tmp_path):
    path = write(tmp_path, "Time,CH1,CH2,note\n" + rows().replace("\n", ",a\n"))
    opened = ftlm.open_file(path)
    assert (opened.step, opened.command()) == (None, "")
    assert "there are 'CH1', 'CH2'" in opened.problem
    messages(["no output is named"], opened.load)
    shown = command("open", path)
    assert shown.exit_code == 0
    assert "to do: the column names do not say which are inputs and which are outputs" in shown.stdout
    assert "-u NAME=COLUMN and -y NAME=COLUMN" in shown.stdout
    assert "no numbers (line 2: 'a' is not a number)" in shown.stdout
    answered = command("open", path, "-u", "CH1", "-y", "y=CH2", "--units", "y=mm", "--window", "0.02:", "--json")
    output = json.loads(answered.stdout)
    assert (output["step"], output["problem"]) == (0.01, "")
    words = shlex.split(output["commands"][1])
    assert words[:3] == ["ftlm", "identify", str(path)]
    assert words[3:-2] == ["--time", "Time", "--window", "0.02:", "-u", "CH1", "-y", "y=CH2", "--units", "y=mm"]
    assert json.loads(command(*shlex.split(output["commands"][0])[1:], "--json").stdout)[0]["rows"] == 10


@pytest.mark.parametrize("names", ["Frequency (Hz),Z' (Ohm),-Z'' (Ohm)", "f,Magnitude [dB],Phase [deg]"])
def test_a_spectrum_is_called_one(tmp_path, names):
    path = tmp_path / "cell.csv"
    path.write_text(names + "\n" + "".join(f"{k + 1},{k * k + 2},{k + 3}\n" for k in range(9)))
    opened = ftlm.open_file(path)
    assert "frequency response or an impedance spectrum" in opened.problem
    assert "ftlm.identify_frequency(ftlm.load_frequency(path)" in str(opened)
    assert "ftlm identify-frequency" in command("open", str(path)).stdout
    # With a time it is a run whose columns have odd names.
    assert "spectrum" not in ftlm.open_file(path, step=0.1).problem


def test_a_run_of_ftlm_is_opened_as_one(tmp_path, small_run):
    small_run.to_csv(tmp_path / "run.csv")
    opened = ftlm.open_file(tmp_path / "run.csv")
    assert (opened.problem, opened.assumptions, opened.step) == ("", (), small_run.step)
    assert [c.role for c in opened.columns] == ["time", "input", "output"]
    assert opened.load()["y"].tobytes() == small_run["y"].tobytes()
    assert shlex.split(opened.command("select"))[3:] == ["-u", "u", "-y", "y", "--structure", "auto"]


def test_what_stands_in_the_way_is_said_and_the_options_that_help_are_passed_on(tmp_path):
    uneven = "t,u,y\n" + "".join(f"{0.1 * k + 0.03 * (k % 2)},{k % 3},{k}\n" for k in range(9))
    path = write(tmp_path, uneven)
    opened = ftlm.open_file(path)
    assert "jitter" in opened.problem
    assert "resample=STEP" in opened.problem
    mended = ftlm.open_file(path, resample=0.1)
    assert mended.problem == ""
    assert "--resample 0.1" in mended.command()
    assert mended.load().step == 0.1
    gaps = write(tmp_path, "t,u,y\n0,1,2\n1,1,\n2,1,3\n3,1,5\n4,1,5\n", "gaps.csv")
    assert "missing='weight'" in ftlm.open_file(gaps).problem
    assert "--missing weight" in ftlm.open_file(gaps, missing="weight").command()
    clockless = write(tmp_path, "a,u,y\n" + rows(), "clockless.csv")
    assert "name it with time=" in ftlm.open_file(clockless).problem
    assert ftlm.open_file(clockless, step=0.5).step == 0.5
    assert ftlm.open_file(clockless, time="a", time_unit="ms").step == pytest.approx(1e-5)


BAD = {
    "no such file": (["no.csv"], "does not exist"),
    "no such column": (["x.csv", "-u", "w"], "column 'w' (signal 'w') is not in"),
    "no such unit": (["x.csv", "--units", "y=furlong", "-y", "y"], "furlong"),
    "detrend": (["x.csv", "--detrend", "constant"], "--detrend is not used with open"),
    "skip": (["x.csv", "--skip", "-3"], "skip is -3"),
    "header": (["x.csv", "--header", "7"], "header is 7"),
    "sheet": (["x.csv", "--sheet", "a"], "--sheet is not used with text"),
    "dates": (["x.csv", "--dates", "ydm"], "'ydm'"),
    "encoding": (["x.csv", "--encoding", "klingon"], "'klingon'"),
    "two files": (["x.csv", "x.csv"], "unexpected extra argument"),
}


@pytest.mark.parametrize("case", BAD)
def test_typos_are_refused_in_words(tmp_path, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "t,u,y\n" + rows())
    words, said = BAD[case]
    done = command("open", *words)
    text = " ".join((done.stderr + done.stdout).split())
    assert said in text
    if case == "no such unit":
        assert (done.exit_code, "to do: unit" in text) == (0, True)
        return
    assert done.exit_code in (2, 3)
    assert "Traceback" not in text
    messages(["path is a list"], lambda: ftlm.open_file(["x.csv"]))


def test_a_file_whose_name_looks_like_an_option_is_named_so_that_it_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "t,u,y\n" + rows(), "-u.csv")
    arguments = shlex.split(ftlm.open_file("-u.csv").command("inspect"))
    assert command(*arguments[1:]).exit_code == 0


def test_what_is_opened_is_a_record(tmp_path):
    opened = ftlm.open_file(write(tmp_path, "t,u,y\n" + rows()))
    with pytest.raises(AttributeError):
        opened.rows = 3
    assert [(c.name, c.role, c.first) for c in opened.columns[:1]] == [("t", "time", 0.0)]
    assert json.loads(json.dumps(opened.to_dict()))["columns"][2]["high"] == pytest.approx(1.1)
    assert np.isfinite([c.high for c in opened.columns]).all()


def test_several_inputs_drive_and_one_drives(tmp_path):
    for header, verb in (("t,u,y", "'u' is an input of 'y'"), ("t,u1,u2,y", "'u1', 'u2' are inputs of 'y'")):
        cells = header.count(",")
        (tmp_path / "run.csv").write_text(header + "\n" + "".join(f"{k}{f',{k % 3}' * cells}\n" for k in range(9)))
        assert any(verb in a.evidence for a in ftlm.open_file(tmp_path / "run.csv").assumptions)


def test_a_written_columns_file_maps_columns_to_the_signals_of_a_structure(tmp_path):
    g = np.random.default_rng(0)
    u = np.repeat(g.uniform(-1.0, 1.0, 20), 30)
    arm = ftlm.Model(ftlm.equation("D^2 p = 20 q - 2 D p + 5 i; D^2 q = -420 q - 3 D q + 2 D p - 5 i"))
    run = arm.simulate(ftlm.Run.from_arrays(step=0.004, inputs={"i": u}, outputs={"p": 0 * u, "q": 0 * u}))
    heads = "Time (s),Motor current (A),Hub angle (rad),Tip deflection (rad)"
    np.savetxt(tmp_path / "bench.csv", np.c_[run.time, u, run["p"], run["q"]], delimiter=",", header=heads, comments="")
    written = run_command("open", "bench.csv", "--write-columns", "bench.toml", cwd=tmp_path)
    assert written.returncode == 0, written.stderr
    identify = ("identify", "bench.csv", "--columns", "bench.toml", "--structure")
    integers = {"alpha1": 2, "gamma1": 1, "beta2": 0, "mu2": 1}
    orders = [w for n, v in integers.items() for w in ("--orders", f"{n}={v}")]
    refused = run_command(*identify, "flexible-link:1", *orders, cwd=tmp_path)
    assert refused.returncode == 3
    for line in ('theta11 = "COLUMN", theta12 = "COLUMN" under [outputs]', 'I1 = "COLUMN" under [inputs]'):
        assert line in refused.stderr
    assert "-y theta11=COLUMN -y theta12=COLUMN -u I1=COLUMN" in refused.stderr
    text = (tmp_path / "bench.toml").read_text()
    for name, signal in (("Motor_current", "I1"), ("Hub_angle", "theta11"), ("Tip_deflection", "theta12")):
        text = text.replace(f'"{name}" =', f"{signal} =")
    (tmp_path / "bench.toml").write_text(text)
    found = run_command(*identify, "flexible-link:1", *orders, "--json", cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    assert json.loads(found.stdout)["output_error"]["theta11"]["fit"] > 99.0
    link = run_command("identify", "bench.csv", "--columns", "bench.toml", "--structure", "arm:1", cwd=tmp_path)
    assert link.returncode == 0, link.stderr
