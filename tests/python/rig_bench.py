"""A rig under test, virtual or with the stand-in for the board: what it did, and whether it is safe."""

import numpy as np
import pytest

import ftlm
from ftlm import rig
from ftlm.rig import watchdog
from ftlm.rig.quanser import QuanserBoard
from quanser_stand_in import Board


class Watched(rig.VirtualBoard):
    """A virtual board that logs its writes and can do something at one of them."""

    def __init__(self, **options):
        super().__init__(**options)
        self.log, self.hook = [], None

    def _output_volts(self, volts1, volts2):
        # The first write sets up; from then on there is one a sample.
        at = len(self.log) - 1
        if self.hook is not None:
            self.hook(self, at)
        found = super()._output_volts(volts1, volts2)
        self.log.append((at, (volts1, volts2)))
        return found

    def write(self, volts):
        if volts == (0.0, 0.0) and self._page is not None and (self._page.has_expired or self.gate.reason):
            self.log.append((len(self.log) - 1, volts))
        super().write(volts)


class Bench:
    """One rig under test: its board, and what it did."""

    def __init__(self, kind, tmp_path, monkeypatch, parameters="linear", rate=500.0):
        self.kind, self.rate, self.acted = kind, rate, False
        self.parameters = rig.ArmParameters.load(parameters)
        if kind == "virtual":
            self.page = tmp_path / "page"
            self.board = Watched(parameters=self.parameters, register_file=self.page)
        else:
            self.hardware = Board(self.parameters)
            self.hardware.install(monkeypatch)
            self.board = QuanserBoard(clock=lambda: self.hardware.time, sleep=self.hardware.sleep)

    def rig(self, **options):
        return rig.Rig(self.board, rate=self.rate, **options)

    def at(self, sample, act):
        """Does something at a sample, counted from the end of the rest."""
        sample += 100 if self.kind == "virtual" else 101

        def hook(board, at=None):
            if (board.sample if at is None else at) == sample and not self.acted:
                self.acted = True
                act()

        if self.kind == "virtual":
            self.board.hook = hook
        else:
            self.hardware.hooks["watchdog_reload"] = hook

    def inject(self, what, sample, channel=0, number=0.0):
        seconds = sample / self.rate
        if self.kind == "virtual":
            self.board.inject = (*self.board.inject, (what, channel, seconds, number))
            return
        first = sample + 100

        def reading(board, analog, counts, digital):
            if board.sample <= first:
                self.frozen = counts[channel % 2].copy()
                return 1
            if what == "dead encoder":
                counts[channel] = self.frozen
            elif what == "saturated gauge":
                analog[channel] = 10.0 - 20.0 / 2**16
            elif what == "limit switch":
                digital[channel] = 0
            elif what == "deflection":
                analog[channel] -= number / (0.013636, 0.018694)[channel]
            elif what == "late" and board.sample == first + 1:
                board.time += number
            elif what == "lost samples":
                return 0
            return 1

        self.hardware.hooks["reading"] = reading

    def trip_at_rest(self, line):
        """Trips a limit switch before a run begins."""
        if self.kind == "q8":
            self.inject("limit switch", -100, line)
            return
        start = self.board.start

        def started(rate):
            start(rate)
            self.board._arm.inject("limit switch", line, 0, 0.0)

        self.board.start = started

    @property
    def writes(self):
        return self.board.log if self.kind == "virtual" else self.hardware.writes

    @property
    def samples(self):
        return self.board._arm.sample if self.kind == "virtual" else self.hardware.sample

    @property
    def enabled(self):
        if self.kind == "virtual":
            page = watchdog.RegisterPage(self.page)
            found = bool(page.get("enabled"))
            page.close()
            return found
        return self.hardware.enabled

    def assert_safe(self, within=None):
        """0 V was written last, the amplifiers are off, task, watchdog and board are let go."""
        at, volts = self.writes[-1] if self.kind == "virtual" else (self.hardware.sample, self.hardware.volts)
        assert volts == (0.0, 0.0)
        assert not self.enabled
        if within is not None:
            driven = [at for at, volts in self.writes if volts != (0.0, 0.0)]
            assert at - driven[-1] <= 2
            assert self.samples <= within
        if self.kind == "virtual":
            assert self.board._process is None
            assert self.board._page is None
            assert not self.board._started
        else:
            assert self.hardware.violations == []
            assert not self.hardware.in_use
            ends = [what for what, _, _ in self.hardware.log[-6:]]
            if "expired" in ends:
                # What the watchdog has put out stays: clearing it would bring back what was there before.
                assert ends[-4:] == ["expired", "task_stop", "task_delete", "close"]
            else:
                assert ends == ["write_analog", "write_digital", "task_stop", "task_delete", "watchdog_stop", "close"]


def drive(samples=400, current=0.3):
    return np.full((samples, 2), current)


def recorded(bench, tmp_path, **options):
    """A record on the bench's board that is expected to fail, and what was kept of it."""
    path = tmp_path / "run.csv"
    with pytest.raises(ftlm.RigFault) as fault:
        rig.record(bench.board, arm=True, rate=bench.rate, out=path, **{"duration": 2.0, **options})
    loaded = ftlm.load(path)
    assert np.array_equal(loaded["theta11"], fault.value.run["theta11"])
    assert loaded.metadata["faults"]
    assert any("the rig stopped the run" in w for w in loaded.notes)
    assert str(path) in str(fault.value)
    assert sorted(p.name for p in tmp_path.iterdir() if p.name != "page") == ["run.csv"]
    bench.assert_safe()
    return str(fault.value), loaded
