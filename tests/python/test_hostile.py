"""What an attacker tried that once got through: files, names, devices, interrupts; each stays an error in words."""

import os
import signal
import stat
import subprocess
import sys
import threading
import tomllib
import tracemalloc
from concurrent.futures import Executor, Future
from types import SimpleNamespace

import numpy as np
import pytest

import ftlm
from ftlm import _core, analysis, control, rig
from ftlm.cli.main import app
from ftlm.order_search.checkpoint import read_store
from ftlm.utils import files as output
from ftlm.utils.checkpoint_file import MAX_FILE_BYTES
from ftlm.utils.files import write_atomically


def run_of(length=60):
    t = np.arange(length) * 0.1
    return ftlm.Run.from_arrays(inputs={"u": np.sign(np.sin(t))}, outputs={"y": np.sin(t)}, step=0.1)


def ftlm_child(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "ftlm", *arguments],
        check=False,
        timeout=240,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


# ----------------------------------------------------------------------------------------------------------------------
# Files written


def test_force_overwrites_regular_files_alone(tmp_path):
    pipe, link, aim = tmp_path / "pipe", tmp_path / "link", tmp_path / "aim"
    os.mkfifo(pipe)
    aim.write_text("mine")
    link.symlink_to(aim)
    for path, what in ((pipe, "a device, pipe or socket"), (link, "a link")):
        with pytest.raises(ftlm.DataError, match=f"is {what}, no regular file"):
            write_atomically(path, b"x", force=True)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert link.is_symlink()
    assert aim.read_text() == "mine"
    device = tmp_path / "null"
    try:
        os.mknod(device, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    except PermissionError:
        return
    with pytest.raises(ftlm.DataError, match="is a device"):
        run_of().to_csv(device, force=True)
    assert stat.S_ISCHR(device.stat().st_mode)


@pytest.mark.parametrize("mode", [0o600, 0o640])
def test_a_file_that_is_overwritten_keeps_its_permissions(tmp_path, mode):
    path = tmp_path / "run.csv"
    path.write_text("mine")
    path.chmod(mode)
    run_of().to_csv(path, force=True)
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert [p.name for p in tmp_path.iterdir()] == ["run.csv"]


@pytest.mark.parametrize("links", [True, False])
def test_a_file_that_is_made_meanwhile_is_not_overwritten(tmp_path, monkeypatch, links):
    path = tmp_path / "run.csv"
    real = output.check_target

    def late(file, **options):
        found = real(file, **options)
        if not path.exists():
            path.write_text("theirs")
        return found

    monkeypatch.setattr(output, "check_target", late)
    if not links:
        monkeypatch.setattr(os, "link", lambda *_, **__: (_ for _ in ()).throw(PermissionError("no links here")))
    with pytest.raises(ftlm.DataError, match="exists"):
        write_atomically(path, b"ours", force=False)
    assert path.read_text() == "theirs"
    assert [p.name for p in tmp_path.iterdir()] == ["run.csv"]


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("force", [True, False])
def test_a_save_that_is_refused_leaves_nothing(tmp_path, monkeypatch, links, force):
    def refuse(*_, **__):
        raise PermissionError(13, "not here")

    monkeypatch.setattr(os, "replace", refuse)
    if not links:
        monkeypatch.setattr(os, "link", refuse)
    if links and not force:
        assert write_atomically(tmp_path / "a", b"ours", force=force).read_bytes() == b"ours"
        return
    with pytest.raises(ftlm.DataError, match="cannot be written"):
        write_atomically(tmp_path / "a", b"ours", force=force)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_links_takes_files_too(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "link", lambda *_, **__: (_ for _ in ()).throw(PermissionError("no links here")))
    assert write_atomically(tmp_path / "a", b"ours", force=False).read_bytes() == b"ours"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


# ----------------------------------------------------------------------------------------------------------------------
# Files read


@pytest.mark.parametrize("writing", [True, False])
def test_a_store_that_is_no_file_is_refused_at_once(tmp_path, writing):
    pipe = tmp_path / "store"
    os.mkfifo(pipe)
    for path in (pipe, "/dev/full", "/dev/zero"):
        with pytest.raises(ftlm.DataError, match=r"no regular file|cannot be"):
            ftlm.resume_search(path) if writing else read_store(path)


@pytest.mark.parametrize("start", [b"", b"SQLite format 3\0"])
def test_a_sparse_file_of_gigabytes_is_refused_before_it_is_read(tmp_path, start):
    path = tmp_path / "store"
    path.write_bytes(start)
    os.truncate(path, MAX_FILE_BYTES + 1)
    with pytest.raises(ftlm.DataError, match="more than the"):
        read_store(path)
    with pytest.raises(ftlm.DataError, match="more than the"):
        ftlm.resume_search(path)


def test_names_of_very_many_columns_are_compared_once_each():
    class Name(str):
        compared = 0

        def __eq__(self, other):
            Name.compared += 1
            return str.__eq__(self, other)

        __hash__ = str.__hash__

    from ftlm.io.dialect import check_distinct

    names = [Name(f"a{k}") for k in range(3000)]
    check_distinct(names, 1, "x.csv")
    # Every name beside every other would be 4.5 million.
    assert Name.compared < 100_000
    with pytest.raises(ftlm.DataError, match="'a7' occurs 2 times"):
        check_distinct([*names, Name("a7")], 1, "x.csv")


@pytest.fixture(scope="module")
def parquet(tmp_path_factory):
    pytest.importorskip("pyarrow")
    path = tmp_path_factory.mktemp("parquet") / "run.parquet"
    run_of().to_parquet(path)
    return path


@pytest.mark.usefixtures("reader_in_process")
def test_a_parquet_run_that_lost_rows_or_values_is_refused(parquet, tmp_path):
    import pyarrow.parquet

    table = pyarrow.parquet.read_table(parquet)
    assert ftlm.load(parquet).length == 60
    turned = table.select(table.column_names[::-1])
    for changed in (table.slice(0, 10), table.set_column(2, "y", [np.zeros(60)]), turned):
        kept = changed.replace_schema_metadata(table.schema.metadata)
        pyarrow.parquet.write_table(kept, tmp_path / "other.parquet")
        with pytest.raises(ftlm.DataError, match="rows were read instead of 60, or the checksum differs"):
            ftlm.load(tmp_path / "other.parquet")
    # A file of before, without a checksum, is read as it was.
    plain = {k: v for k, v in table.schema.metadata.items() if k != b"ftlm-check"}
    pyarrow.parquet.write_table(table.replace_schema_metadata(plain), tmp_path / "before.parquet")
    assert ftlm.load(tmp_path / "before.parquet").length == 60


@pytest.mark.slow
def test_no_flipped_byte_of_a_parquet_footer_is_another_run(parquet, tmp_path):
    whole, right = parquet.read_bytes(), ftlm.load(parquet)
    path = tmp_path / "run.parquet"
    footer = int.from_bytes(whole[-8:-4], "little")
    for at in range(len(whole) - footer - 8, len(whole), 5):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << at % 8)]) + whole[at + 1 :])
        try:
            run = ftlm.load(path)
        except ftlm.DataError:
            continue
        assert run.length == right.length, at
        assert all(np.array_equal(run[name], right[name]) for name in run.signals), at


def test_digits_have_no_underscores_in_files(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,u,y\n0,1,1\n1,2,3_0.0\n2,3,4\n")
    with pytest.raises(ftlm.DataError, match=r"'3_0\.0' is not a number"):
        ftlm.load(path, inputs="u", outputs="y")


def test_a_signal_whose_name_is_a_number_comes_back(tmp_path):
    t = np.arange(9) * 0.1
    run = ftlm.Run.from_arrays(inputs={"nan": np.cos(t)}, outputs={"y": np.sin(t)}, step=0.1)
    run.to_csv(tmp_path / "a.csv")
    assert np.array_equal(ftlm.load(tmp_path / "a.csv")["nan"], run["nan"])


def test_one_column_is_not_an_input_and_an_output(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,u,y\n0,1,1\n1,2,3\n2,3,4\n")
    with pytest.raises(ftlm.DataError, match="column 'y' is the input 'a' and the output 'b'"):
        ftlm.load(path, inputs={"a": "y"}, outputs={"b": "y"})


def test_a_number_of_thousands_of_digits_is_an_error_in_words(written, tmp_path):
    path = tmp_path / "columns.toml"
    path.write_text(f"step = {'9' * 5000}\n")
    with pytest.raises(ftlm.DataError, match="is not a TOML file"):
        ftlm.load(written, columns=path)


SMALL_FILES = {
    "model": lambda path, written: ftlm.load_model(path),
    "controller": lambda path, written: control.load_controller(path),
    "parameters": lambda path, written: rig.ArmParameters.load(path),
    "columns": lambda path, written: ftlm.load(written, columns=path),
}


@pytest.mark.parametrize("kind", SMALL_FILES)
def test_a_small_file_is_a_regular_file_of_little_size(kind, written, tmp_path):
    pipe, device, folder, large, absent, closed = (tmp_path / f"{n}.toml" for n in ("p", "d", "f", "l", "a", "c"))
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    folder.mkdir()
    with open(large, "wb") as stream:
        stream.truncate(60 << 30)
    closed.write_bytes(b"\xff\x00" * 100)
    for path, words in (
        (pipe, "is not a regular file"),
        (device, "is not a regular file"),
        (folder, "is not a regular file"),
        (large, "has 64424509440 bytes"),
        (absent, "No such file"),
        (closed, "c.toml"),
    ):
        with pytest.raises(ftlm.DataError, match=words) as refused:
            SMALL_FILES[kind](path, written)
        assert str(path) in str(refused.value)


# ----------------------------------------------------------------------------------------------------------------------
# Calls


def test_a_multisine_of_years_is_refused():
    with pytest.raises(
        ftlm.ModelError, match=r"period = 1e\+09 s of a multisine is longer than any run; give at most 600 s"
    ):
        rig.Excitation("multisine", period=1e9).commands(500.0, 1.0)


LINK = ftlm.Model(ftlm.equation("D^2 y = -3 D y - 8 y + 5 u"))
FREE = ftlm.equation("D^alpha y = a D^beta y + b u")
#: Arguments that set a size, with numbers that a slip of the finger makes.
SIZES = {
    "rate of an excitation": lambda n: rig.Excitation().commands(n, 1.0),
    "duration of an excitation": lambda n: rig.Excitation().commands(500.0, n),
    "rate of a recording": lambda n: rig.record(rate=n),
    "duration of a recording": lambda n: rig.record(duration=n, limit=600.0),
    "rate of a loop": lambda n: rig.control(lambda *_: (0.0, 0.0), (0.0, 0.0), duration=1.0, rate=n),
    "duration of a loop": lambda n: rig.control(lambda *_: (0.0, 0.0), (0.0, 0.0), duration=n),
    "step of a resampling": lambda n: run_of().resample(1.0 / n),
    "size of a Haar matrix": lambda n: ftlm.haar_matrix(1 << int(n).bit_length()),
    "size of an operational matrix": lambda n: ftlm.operational_matrix(0.5, 1 << int(n).bit_length(), step=1.0),
    "block pulses": lambda n: ftlm.identify(run_of(), FREE, method="least-squares", m=int(n)),
    "increment of a grid": lambda n: ftlm.search_orders(run_of(), FREE, ftlm.order_grid(1.0 / n), m=64),
    "lags": lambda n: ftlm.resid(LINK, run_of(), lags=int(n)),
    "population": lambda n: ftlm.GeneticAlgorithm(population=int(n)),
    "seeds": lambda n: ftlm.GeneticAlgorithm(seeds=range(int(n))),
    "records of a reproduction": lambda n: ftlm.reproduce(records=int(n)),
    "segments": lambda n: ftlm.consistency(run_of(), LINK.structure, segments=int(n)),
    "rate of a path": lambda n: control.point_to_point(1.0, 1.0, n),
    "duration of a path": lambda n: control.point_to_point(1.0, n),
    "rate of a shaper": lambda n: control.input_shaper(LINK).impulses(n),
    "samples of a design": lambda n: control.fractional_pid(LINK, crossover=3.0, samples=int(n)),
    "order of an approximation": lambda n: analysis.approximate(LINK, band=(0.1, 10.0), order=int(n)),
}


@pytest.mark.parametrize("argument", SIZES)
def test_a_size_is_checked_before_anything_is_allocated(argument):
    tracemalloc.start()
    try:
        for size in (2e8, 1e12):
            with pytest.raises((ftlm.ModelError, ftlm.DataError)):
                SIZES[argument](size)
        assert tracemalloc.get_traced_memory()[1] < 32 << 20
    finally:
        tracemalloc.stop()


class Empty(Executor):
    """Tasks that come back with something that no task returns."""

    def __init__(self, result):
        self.result, self.sent = result, 0

    def submit(self, *_, **__):
        self.sent += 1
        # Who waits for ever is found by this, not by a clock.
        assert self.sent < 100
        future = Future()
        future.set_result(self.result)
        return future


@pytest.mark.parametrize("result", [None, 3, (1.0, 2, 3)])
def test_an_executor_that_returns_nothing_ends(small_run, result):
    with pytest.raises(ftlm.ConvergenceError, match="lost its work"):
        ftlm.search_orders(
            small_run,
            ftlm.equation("D^a y = c D^b y + d u"),
            ftlm.order_grid(increment=0.2),
            m=32,
            executor=Empty(result),
        )


def test_what_is_no_executor_is_refused(small_run):
    with pytest.raises(ftlm.ModelError, match="is not an executor"):
        ftlm.search_orders(
            small_run,
            ftlm.equation("D^a y = c D^b y + d u"),
            ftlm.order_grid(increment=0.2),
            m=32,
            executor=SimpleNamespace(),
        )


CAPSULE = """
import builtins, ftlm, numpy
from ftlm import _core
real = builtins.__import__
def interrupted(name, *a, **k):
    if "multiarray" in name:
        raise KeyboardInterrupt
    return real(name, *a, **k)
builtins.__import__ = interrupted
print(_core.pulse_mean_rows(numpy.ones((1, 4)), 3, True)[0])
"""


def test_numpys_interface_is_there_before_a_ctrl_c_can_arrive():
    done = subprocess.run([sys.executable, "-c", CAPSULE], check=True, capture_output=True, text=True, timeout=240)
    assert done.stdout.strip() == "[1. 1. 1.]"


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads are counted in /proc")
@pytest.mark.parametrize(
    "transform",
    [lambda x: ftlm.fractional_integral(x, 0.5, step=0.1), ftlm.haar_transform, ftlm.haar_inverse],
    ids=["integral", "haar", "inverse"],
)
def test_ctrl_c_does_not_wait_for_a_transform(transform):
    x = np.random.default_rng(0).standard_normal(1 << 23)

    def transforms():
        for _ in range(100):
            transform(x)

    def is_left_computing(delay):
        """Interrupt transforms; return whether one is still being computed, which is not so between two of them."""
        kept = signal.signal(signal.SIGINT, signal.default_int_handler)
        before = len(os.listdir("/proc/self/task"))
        threading.Timer(delay, signal.raise_signal, [signal.SIGINT]).start()
        try:
            with pytest.raises(KeyboardInterrupt):
                transforms()
        finally:
            signal.signal(signal.SIGINT, kept)
        return len(os.listdir("/proc/self/task")) > before

    assert any(is_left_computing(delay) for delay in np.linspace(0.1, 0.3, 30).tolist())


def test_more_points_than_memory_holds_are_refused():
    for m in (2**31, 2**40, 2**62):
        with pytest.raises(ftlm.ModelError, match="m = "):
            _core.series_multiply(np.ones(3), np.ones(3), m)
        with pytest.raises(ftlm.ModelError, match="m = "):
            _core.pulse_mean_rows(np.ones((1, 3)), m, False)
        with pytest.raises(ftlm.ModelError, match="m = "):
            _core.filter_series([(1.0, 0.0)], [(1.0, 0.0), (1.0, 1.0)], m, 0.1)


def test_an_order_that_is_no_number_does_not_turn_for_ever():
    for terms in ([(1.679, 1.526), (-1.0, np.inf)], [(np.nan, 0.5)]):
        with pytest.raises(ftlm.DataError, match="output terms"):
            _core.has_unstable_pole(1.135, terms)


class Liar:
    """A sequence that hands over other than it tells of."""

    def __init__(self, told):
        self.told = told

    def __len__(self):
        return self.told

    def __getitem__(self, _):
        return 1.0


@pytest.mark.parametrize("values", [range(2**40), Liar(2**60), Liar(3), np.broadcast_to(1.0, 2**34)])
def test_a_sequence_is_not_believed_when_it_tells_its_length(values):
    with pytest.raises(ftlm.ModelError, match="a sequence "):
        _core.order_grid_size((0, values, []), [True])
    assert _core.order_grid_size((0, np.array([1.0, 2.0]), []), [True]) == 2
    assert _core.order_grid_size((0, range(1, 3), []), [True]) == 2
    for words in ("12", {1.0: 2.0}, {1.0, 2.0}):
        with pytest.raises(TypeError, match="is not a sequence"):
            _core.order_grid_size((0, words, []), [True])


def test_an_array_that_repeats_one_number_is_not_copied_beyond_memory():
    for shape in ((2**34,), (2**34, 3), (3, 2**34), (2**20, 2**20)):
        values = np.broadcast_to(1.0, shape)
        with pytest.raises(ftlm.ModelError, match=r"array|length"):
            _core.metrics(values, values) if len(shape) == 1 else _core.haar_transform(values)


def test_jumps_without_sizes_are_refused():
    places = np.array([3.0, 4.5, 7.0])
    with pytest.raises(ftlm.DataError, match="jumps has length 2, but 3 is needed"):
        _core.kink_correction(16, places, (places, np.ones(2)), 0.5, 0.1)
    with pytest.raises(ftlm.ModelError, match="the jump times decrease at index 1"):
        _core.kink_correction(16, places, (np.array([3.0, 4.5, -1e300]), np.ones(3)), 0.5, 0.1)


# ----------------------------------------------------------------------------------------------------------------------
# The command line


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("written") / "run.csv"
    run_of().to_csv(path)
    return path


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a disk that is always full")
def test_a_full_output_is_one_line(written):
    with open("/dev/full", "w") as full:
        done = ftlm_child("inspect", str(written), stdout=full)
    assert done.returncode == 3
    assert done.stderr.startswith("ftlm: the system refuses: No space left on device")
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_what_a_reader_that_has_gone_leaves_is_nobodys_loss(written):
    read, write = os.pipe()
    os.close(read)
    done = ftlm_child("inspect", str(written), stdout=write)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(os.name == "nt", reason="a shell that closes an output")
@pytest.mark.parametrize(("closed", "said"), [("<&- >&-", ""), (">&- -u x", "ftlm: ")])
def test_an_output_that_was_closed_stays_closed(written, closed, said):
    call = f'"$0" -m ftlm inspect "$1" {closed}'
    done = subprocess.run(
        ["sh", "-c", call, sys.executable, str(written)], check=False, timeout=240, capture_output=True, text=True
    )
    assert done.stderr[:6] == said
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert (done.returncode == 0) == (not said)


def test_a_terminal_that_knows_ascii_alone_gets_its_result(tmp_path):
    t = np.arange(60) * 0.1
    ftlm.Run.from_arrays(inputs={"u": np.cos(t)}, outputs={"θ": np.sin(t)}, step=0.1).to_csv(tmp_path / "a.csv")
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = ftlm_child("inspect", str(tmp_path / "a.csv"), stdout=subprocess.PIPE, env=environment)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    assert "\\u03b8" in done.stdout


def test_a_working_folder_that_is_gone_is_one_line(written, tmp_path, monkeypatch, capsys):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with pytest.raises(SystemExit) as ended:
        app(["record", "--duration", "0.1", "-o", "run.csv"], standalone_mode=True)
    assert ended.value.code == 3
    assert capsys.readouterr().err.startswith("ftlm: ")


#: Ctrl-C when a module is looked for, as if it was pressed while the command line is imported.
PRESSED_AT = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
class Presses:
    def find_spec(name, path, target=None):
        if name == pressed:
            sys.meta_path.remove(Presses)
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Presses)
pressed, sys.argv[1] = sys.argv[1], "--version"
from ftlm.__main__ import main
main()
"""


@pytest.mark.parametrize("module", ["ftlm.cli", "numpy", "ftlm._core", "typer", "ftlm.cli.framework"])
def test_an_interrupt_while_the_command_line_is_imported_is_one_line(module, root):
    done = subprocess.run([sys.executable, "-c", PRESSED_AT, module], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "ftlm: interrupted; nothing was written\n")
    entry = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]["ftlm"]
    assert entry == "ftlm.__main__:main"


def test_what_ignores_interrupts_goes_on_ignoring_them():
    script = PRESSED_AT.replace("signal.default_int_handler", "signal.SIG_IGN", 1)
    done = subprocess.run([sys.executable, "-c", script, "typer"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()[0], done.stderr) == (0, "ftlm", "")
