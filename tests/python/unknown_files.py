"""Files as other people's programs write them, all of one record whose truth is known."""

import datetime
import functools
import gzip
import zipfile
from dataclasses import dataclass, field

import numpy as np
from scipy import special

import ftlm

STEP = 0.02
ROWS = 240
TRUTH = {"alpha": 1.3, "a0": -4.0, "b0": 3.0}
EQUATION = "D^alpha y = a0 y + b0 u"


@functools.cache
def record():
    """Time, input, output: a held input of uneven length, an output with 1 % noise."""
    u = np.where(np.arange(ROWS) % 90 < 50, 1.0, -0.5)
    u[:5] = 0.0
    blank = ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": np.zeros(ROWS)})
    clean = ftlm.Model(ftlm.equation("D^1.3 y = -4 y + 3 u")).simulate(blank)["y"]
    return np.arange(ROWS) * STEP, u, np.round(clean + 0.01 * np.random.default_rng(0).standard_normal(ROWS), 6)


@dataclass(frozen=True)
class Stranger:
    """A file: its name, its bytes, what a person types to name its columns, and how exact its numbers are."""

    name: str
    content: bytes
    words: tuple[str, ...] = ()
    start: float = 0.0
    load: dict = field(default_factory=dict)


def table(form="{:.6f}", separator=",", time=1.0, gain=1.0):
    """Rows of text."""
    return "".join(
        separator.join(form.format(v) for v in (time * t, u, gain * y)) + "\n"
        for t, u, y in zip(*record(), strict=True)
    )


def german():
    """A German spreadsheet's csv: a title, semicolons, decimal commas, units in names, the encoding of Windows."""
    text = "Messprotokoll Prüfstand 3;;\n;;\nZeit [ms];Strom (A);Weg [mm]\n"
    text += table(separator=";", time=1e3, gain=1e3).replace(".", ",")
    return Stranger(
        "messung.csv", text.replace("\n", "\r\n").encode("cp1252"), ("-u", "u=Strom", "-y", "y=Weg", "--units", "y=mm")
    )


def labview():
    """LabVIEW's text: two headers, tabs, a column of remarks that rows leave out."""
    text = (
        "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n"
        "Multi_Headings\tNo\nX_Columns\tOne\nTime_Pref\tAbsolute\nDate\t2024/05/01\nTime\t12:01:02.25\n"
        f"***End_of_Header***\t\n\t\nChannels\t2\t\t\nSamples\t{ROWS}\t{ROWS}\t\nDate\t2024/05/01\t2024/05/01\t\n"
        "Y_Unit_Label\tVolts\tVolts\t\nX_Dimension\tTime\tTime\t\nX0\t0.0E+0\t0.0E+0\t\nDelta_X\t0.020000\t0.020000\t\n"
        "***End_of_Header***\t\t\t\nX_Value\tVoltage_0\tVoltage_1\tComment\n"
    )
    return Stranger("run.lvm", (text + table(separator="\t")).encode(), ("-u", "u=Voltage_0", "-y", "y=Voltage_1"))


def oscilloscope():
    """An oscilloscope's export: its settings, names, a line of units in brackets, a blank line, time before 0."""
    text = "Model,MSO24\nFirmware Version,1.28\nWaveform Type,ANALOG\nSample Interval,2.0E-02\nRecord Length,240\n,\n"
    text += "Time,Channel A,Channel B\n(ms),(V),(V)\n\n"
    t, u, y = record()
    text += "".join(f"{1e3 * (a - 1):.3f},{b:.6f},{c:.6f}\n" for a, b, c in zip(t, u, y, strict=True))
    return Stranger("scope.csv", text.encode(), ("-u", "u=Channel A", "-y", "y=Channel B"), start=-1.0)


def moments(form):
    """Times of the rows, from shortly before midnight on."""
    begin = datetime.datetime(2023, 12, 31, 23, 59, 58)
    return [format(begin + datetime.timedelta(seconds=round(t, 6)), form) for t in record()[0].tolist()]


def logger():
    """A data logger: German dates over midnight, decimal commas, a column of words."""
    _, u, y = record()
    rows = (f"{d[:-3]};{a:.6f};{b:.6f};ok\n" for d, a, b in zip(moments("%d.%m.%Y %H:%M:%S,%f"), u, y, strict=True))
    text = "Datum/Uhrzeit;Heizung;Temperatur;Status\n" + "".join(rows).replace(".", ",")
    text = "".join(line[:10].replace(",", ".") + line[10:] for line in text.splitlines(keepends=True))
    return Stranger("logger.csv", text.encode("utf-8-sig"), ("-u", "u=Heizung", "-y", "y=Temperatur"))


def matlab73(folder):
    """MATLAB 7.3: an HDF5 file behind 512 bytes of its own, matrices turned."""
    import h5py

    path = folder / "made.h5"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in zip("tuy", record(), strict=True):
            file.create_dataset(name, data=values[None, :]).attrs["MATLAB_class"] = np.bytes_("double")
        note = file.create_dataset("note", data=np.array([[104], [105]], np.uint16))
        note.attrs["MATLAB_class"] = np.bytes_("char")
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    return Stranger("run73.mat", head + path.read_bytes()[128:], ("-u", "u", "-y", "y"))


def excel(folder):
    """A workbook: a merged title, names, units, a second sheet that is empty."""
    import openpyxl

    book = openpyxl.Workbook()
    sheet = book.active
    sheet.title = "Messung 1"
    sheet["A1"] = "Prüfstand 3, 1. Mai"
    sheet.merge_cells("A1:C1")
    sheet.append(["Zeit", "Strom", "Winkel"])
    sheet.append(["ms", "A", "deg"])
    for t, u, y in zip(*(v.tolist() for v in record()), strict=True):
        sheet.append([1000 * t, u, y])
    book.create_sheet("Tabelle2")
    book.save(folder / "made.xlsx")
    return Stranger(
        "messung.xlsx", (folder / "made.xlsx").read_bytes(), ("-u", "u=Strom", "-y", "y=Winkel", "--units", "y=rad")
    )


ODS = (
    '<?xml version="1.0" encoding="UTF-8"?><office:document-content '
    'xmlns:office="urn:oasis:names:tc:opendocument:xmlns:office:1.0" '
    'xmlns:table="urn:oasis:names:tc:opendocument:xmlns:table:1.0" '
    'xmlns:text="urn:oasis:names:tc:opendocument:xmlns:text:1.0"><office:body><office:spreadsheet>'
    '<table:table table:name="Sheet1">{}</table:table></office:spreadsheet></office:body></office:document-content>'
)


def packed(folder, files):
    """A zip archive."""
    path = folder / "made.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path.read_bytes()


def opendocument(folder):
    """A sheet of a free office program."""
    kind = "application/vnd.oasis.opendocument.spreadsheet"

    def row(cells):
        return f"<table:table-row>{''.join(cells)}</table:table-row>"

    def word(text):
        return f'<table:table-cell office:value-type="string"><text:p>{text}</text:p></table:table-cell>'

    def number(value):
        text = f"<text:p>{value:.2f}</text:p>"
        return f'<table:table-cell office:value-type="float" office:value="{value!r}">{text}</table:table-cell>'

    rows = [row(map(word, ("time (s)", "input", "output")))]
    rows += [row(map(number, cells)) for cells in zip(*(v.tolist() for v in record()), strict=True)]
    manifest = (
        '<?xml version="1.0"?><manifest:manifest xmlns:manifest="urn:oasis:names:tc:opendocument:xmlns:manifest:1.0">'
        f'<manifest:file-entry manifest:full-path="/" manifest:media-type="{kind}"/></manifest:manifest>'
    )
    files = {"mimetype": kind, "META-INF/manifest.xml": manifest, "content.xml": ODS.format("".join(rows))}
    return Stranger("sheet.ods", packed(folder, files), ("-u", "u=input", "-y", "y=output"))


def npz(folder):
    """Arrays of NumPy's, with a number and a text beside them."""
    t, u, y = record()
    np.savez(folder / "made.npz", time=t, u=u, y=y, rate=1 / STEP, note=np.array("a note"))
    return Stranger("run.npz", (folder / "made.npz").read_bytes(), ("-u", "u", "-y", "y"))


def frame():
    """A pandas frame with dates."""
    import pandas as pd

    t, u, y = record()
    stamps = pd.Timestamp("2024-05-01 12:00:00") + pd.to_timedelta(t, unit="s").round("us")
    return pd.DataFrame({"stamp": stamps, "u": u, "y": y})


def feather(folder):
    """A feather file with dates."""
    frame().to_feather(folder / "made.feather")
    return Stranger("run.feather", (folder / "made.feather").read_bytes(), ("-u", "u", "-y", "y"))


def gzipped():
    """A csv packed by gzip."""
    return Stranger("run.csv.gz", gzip.compress(b"t,u,y\n" + table().encode(), mtime=0), ("-u", "u", "-y", "y"))


def unicode_text():
    """A spreadsheet's Unicode text: UTF-16, tabs, decimal commas."""
    text = "Zeit (s)\tEingang\tAusgang\n" + table(separator="\t").replace(".", ",")
    return Stranger("text.txt", text.replace("\n", "\r\n").encode("utf-16"), ("-u", "u=Eingang", "-y", "y=Ausgang"))


def columns():
    """Columns of blanks with decimal commas, names, a line of units."""
    text = "   t      force   tip\n   min    N       mm\n"
    t, u, y = record()
    rows = (f"  {a / 60:.12f}   {b:8.4f}   {c:12.6f}\n" for a, b, c in zip(t, u, 1e3 * y, strict=True))
    return Stranger(
        "bench.dat",
        (text + "".join(rows).replace(".", ",")).encode(),
        ("-u", "u=force", "-y", "y=tip", "--units", "y=mm"),
    )


#: What a heated rod is made of: conductance of its surface and strength of its heater, over what sqrt(k rho c) says.
ROD = {"alpha": 0.5, "a": -0.08, "b": 0.35}


def rod(changes, seed, rows=450):
    """A long rod heated at its end, which loses heat there, from Carslaw and Jaeger: a German csv with a line of units.

    Each step of the power P raises the end by P b/a (1 - exp(a^2 t) erfc(a sqrt(t))) (Conduction of Heat in Solids,
    section 2.7), whose equation is D^0.5 T = -a T + b P above the room's temperature.
    """
    t, a, b = np.arange(rows) * 1.0, -ROD["a"], ROD["b"]
    power, end = np.zeros(rows), np.full(rows, 21.4)
    for at, change in changes:
        late = np.maximum(t - at, 0.0)
        power += np.where(t >= at, change, 0.0)
        end += change * b / a * (1.0 - special.erfcx(a * np.sqrt(late)))
    end += 0.05 * np.random.default_rng(seed).standard_normal(rows)
    text = "Heizstab 2, Messung vom 3. Mai;;\n;;\nZeit;Heizleistung;Temperatur\ns;W;°C\n"
    rows_of = "".join(f"{x:.1f};{p:.1f};{y:.2f}\n" for x, p, y in zip(t, power, end, strict=True))
    return (text + rows_of.replace(".", ",")).replace("\n", "\r\n").encode("cp1252")


#: How each is made; those that need a folder are given one.
MAKERS = {
    "German csv": german,
    "LabVIEW text": labview,
    "oscilloscope": oscilloscope,
    "dates": logger,
    "MATLAB 7.3": matlab73,
    "xlsx": excel,
    "ods": opendocument,
    "npz": npz,
    "feather": feather,
    "gz": gzipped,
    "utf-16": unicode_text,
    "line of units": columns,
}


def write_file(name, folder):
    """One of them."""
    maker = MAKERS[name]
    return maker(folder) if maker.__code__.co_argcount else maker()
