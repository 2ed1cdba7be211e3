"""A stand-in for the vendor's `quanser.hardware`: the listed calls with their types, error codes and rules, no more.

It drives the simulated arm on a virtual clock that advances with every read. Whatever the real package would choke on
(a list for an array, a wrong dtype, a count that is not the array's length) is noted in `Board.violations`, which every
test that uses it asserts to be empty. With a page it keeps real time and its outputs live in the page, where a watchdog
process guards them, so that a test can kill the program.
"""

import sys
import time
import types

import numpy as np

from ftlm import rig
from ftlm.rig import virtual_board, watchdog

STEP_LIMIT = 0x7FFFFFFF


class HILError(Exception):
    """The package's error."""

    def __init__(self, error_code):
        super().__init__(f"HIL error {error_code}")
        self.error_code = error_code

    def get_error_message(self):
        """Needs the vendor's runtime library, which is not here."""
        raise OSError("quanser_runtime cannot be loaded")


class Clock:
    """Clocks of a task."""

    HARDWARE_CLOCK_0 = 0


class EncoderQuadratureMode:
    """Modes."""

    X4 = 4


class BufferOverflowMode:
    """Modes."""

    ERROR = 0


class Board:
    """What is plugged in: settings and log that outlive a handle."""

    def __init__(self, parameters="linear", *, page=None, form=2025, seed=0):
        self.parameters = rig.ArmParameters.load(parameters)
        self.form = form
        self.violations = []
        self.log = []
        self.refuse = {}
        self.hooks = {}
        self.time = 0.0
        self.in_use = False
        self.page = None if page is None else watchdog.RegisterPage(page, create=True)
        self.random = np.random.default_rng(seed)
        self.reset()

    def reset(self):
        """Power-up state of what a handle can change."""
        self.arm = None
        self.volts = (0.0, 0.0)
        self.enables = {0: 1, 1: 1, 4: 0}
        self.analog_state, self.tristate = {}, set()
        self.timeout = self.last_reload = None
        self.expired, self.before = False, None
        self.task = None
        self.sample = 0
        self.process = None

    @property
    def writes(self):
        """Volts written, with the sample at which they were."""
        return [(at, values) for what, at, values in self.log if what == "write_analog"]

    @property
    def enabled(self):
        """Whether the amplifiers give current."""
        return self.enables == {0: 0, 1: 0, 4: 1}

    def sleep(self, seconds):
        """Passes time on the virtual clock."""
        self.time += seconds

    def note(self, what):
        """Notes something that the real package would not bear."""
        self.violations.append(what)

    def install(self, monkeypatch):
        """Makes `import quanser.hardware` find this board."""
        for name, module in self.modules().items():
            monkeypatch.setitem(sys.modules, name, module)

    def modules(self):
        """The package and its modules."""
        package, hardware = types.ModuleType("quanser"), types.ModuleType("quanser.hardware")
        enumerations = types.ModuleType("quanser.hardware.enumerations")
        board = self

        class BoundHIL({2022: HIL2022, 2025: HIL2025}[self.form]):
            """A handle on this board."""

            _board = board

        hardware.HIL, hardware.HILError, hardware.Clock = BoundHIL, HILError, Clock
        hardware.EncoderQuadratureMode = EncoderQuadratureMode
        enumerations.BufferOverflowMode = BufferOverflowMode
        package.hardware, hardware.enumerations = hardware, enumerations
        return {"quanser": package, "quanser.hardware": hardware, "quanser.hardware.enumerations": enumerations}


class HIL:
    """The handle; it has the listed calls only."""

    _board = None

    def __init__(self, card_type=None, card_identifier=None):
        self._open = False
        if card_type is not None:
            self.open(card_type, card_identifier)

    # Rules shared by all calls -----------------------------------------------------------------------------------

    def _enter(self, name, *, locked=True):
        board = self._board
        if name in board.hooks:
            board.hooks[name](board)
        if name in board.refuse:
            raise HILError(board.refuse[name])
        if name != "open" and not self._open:
            raise HILError(-1072)
        self._expire()
        if locked and board.expired:
            # After an expiry the board refuses access until it is cleared.
            raise HILError(-600)
        return board

    def _expire(self):
        board = self._board
        if board.page is not None:
            board.expired = board.page.has_expired
            return
        if board.timeout and not board.expired and board.time - board.last_reload > board.timeout:
            board.expired = True
            if len(board.tristate) == 8 and set(board.analog_state) == {0, 1}:
                board.before = (board.volts, dict(board.enables))
                board.volts = (board.analog_state[0], board.analog_state[1])
                board.enables = {0: 1, 1: 1, 4: 0}
                board.log.append(("expired", board.sample, board.volts))

    def _array(self, call, name, array, dtype, count):
        board = self._board
        if not isinstance(array, np.ndarray):
            board.note(f"{call}: {name} is a {type(array).__name__}, not an array")
        elif array.dtype != dtype:
            board.note(f"{call}: {name} is {array.dtype}, not {np.dtype(dtype)}")
        elif array.ndim != 1 or not array.flags.c_contiguous:
            board.note(f"{call}: {name} is not a contiguous vector")
        elif not isinstance(count, int) or len(array) != count:
            board.note(f"{call}: {name} has {len(array)} elements and the count is {count!r}")

    def _channels(self, call, channels, count, most):
        self._array(call, "channels", channels, np.uint32, count)
        if isinstance(channels, np.ndarray) and channels.size and channels.max() >= most:
            raise HILError(-118)

    # The listed calls ----------------------------------------------------------------------------------------------

    def open(self, card_type, card_identifier):
        board = self._enter("open", locked=False)
        if card_type != "q8_usb":
            raise HILError(-179)
        if not isinstance(card_identifier, str):
            board.note("open: the identifier is not a text")
        if self._open:
            raise HILError(-1073)
        if board.in_use:
            raise HILError(-109)
        board.in_use = self._open = True

    def close(self):
        board = self._enter("close", locked=False)
        board.in_use = self._open = False
        board.log.append(("close", board.sample, None))

    def is_valid(self):
        return self._open

    def set_card_specific_options(self, options, size):
        board = self._enter("set_card_specific_options")
        if options not in ("update_rate=normal;decimation=1", "update_rate=fast;decimation=1"):
            board.note(f"options {options!r}")
        if not isinstance(size, int) or len(options) >= size:
            board.note("the size of the options does not hold them")
        board.fast = "fast" in options

    def set_analog_input_ranges(self, channels, count, low, high):
        self._ranges("set_analog_input_ranges", channels, count, low, high)

    def set_analog_output_ranges(self, channels, count, low, high):
        self._ranges("set_analog_output_ranges", channels, count, low, high)

    def _ranges(self, call, channels, count, low, high):
        self._enter(call)
        self._channels(call, channels, count, 8)
        self._array(call, "minima", low, np.float64, count)
        self._array(call, "maxima", high, np.float64, count)
        if {*np.abs(low), *np.abs(high)} - {5.0, 10.0}:
            raise HILError(-127)

    def set_digital_directions(self, inputs, input_count, outputs, output_count):
        self._enter("set_digital_directions")
        self._channels("set_digital_directions", inputs, input_count, 8)
        self._channels("set_digital_directions", outputs, output_count, 8)

    def set_encoder_quadrature_mode(self, channels, count, modes):
        self._enter("set_encoder_quadrature_mode")
        self._channels("set_encoder_quadrature_mode", channels, count, 8)
        self._array("set_encoder_quadrature_mode", "modes", modes, np.int32, count)

    def set_encoder_counts(self, channels, count, counts):
        self._enter("set_encoder_counts")
        self._channels("set_encoder_counts", channels, count, 8)
        self._array("set_encoder_counts", "counts", counts, np.int32, count)

    def task_create_reader(self, samples, a_ch, na, e_ch, ne, d_ch, nd, o_ch, no):
        board = self._enter("task_create_reader")
        if not isinstance(samples, int) or samples < 1:
            board.note(f"task_create_reader: {samples!r} samples in the buffer")
        if board.task is not None:
            board.note("a second reader: its samples would be of another instant")
        for channels, count in ((a_ch, na), (e_ch, ne), (d_ch, nd), (o_ch, no)):
            if channels is None and count == 0:
                continue
            self._channels("task_create_reader", channels, count, 8)
        board.task, board.counts = object(), (na, ne, nd, no)
        board.overflow = None
        return board.task

    def task_set_buffer_overflow_mode(self, task, mode):
        board = self._enter("task_set_buffer_overflow_mode")
        if task is not board.task:
            raise HILError(-130)
        board.overflow = mode

    def task_start(self, task, clock, frequency, samples):
        board = self._enter("task_start")
        if task is not board.task:
            raise HILError(-130)
        if board.overflow != BufferOverflowMode.ERROR:
            board.note("the task starts although an overflow would not be an error")
        if not isinstance(frequency, float) or frequency > (8000.0 if board.fast else 1000.0):
            raise HILError(-131)
        if clock != Clock.HARDWARE_CLOCK_0 or samples != STEP_LIMIT:
            board.note("task_start: clock or number of samples")
        board.rate = frequency
        board.arm = board.parameters.arm(1.0 / frequency, 60.0)
        board.start = time.monotonic()

    def task_stop(self, task):
        board = self._enter("task_stop", locked=False)
        if task is not board.task:
            raise HILError(-130)
        board.arm = None
        board.log.append(("task_stop", board.sample, None))

    def task_delete(self, task):
        board = self._enter("task_delete", locked=False)
        if task is not board.task:
            raise HILError(-130)
        if board.arm is not None and "task_stop" not in board.refuse:
            board.note("task_delete: the task runs")
        board.task = None
        board.log.append(("task_delete", board.sample, None))

    def task_read(self, task, count, analog, counts, digital, other):
        board = self._enter("task_read")
        if task is not board.task or board.arm is None:
            raise HILError(-130)
        na, ne, nd, no = board.counts
        self._array("task_read", "analog", analog, np.float64, na)
        self._array("task_read", "counts", counts, np.int32, ne)
        self._array("task_read", "digital", digital, np.int8, nd)
        if other is not None or no:
            board.note("task_read: other channels were not asked for")
        if count != 1:
            board.note("task_read: more than one sample at a time")
        if board.sample:
            volts = board.page.volts if board.page is not None else board.volts
            board.arm.advance(list(volts), board.enabled)
        board.sample += 1
        board.time = max(board.time, board.sample / board.rate)
        if board.page is not None:
            time.sleep(max(0.0, board.start + board.sample / board.rate - time.monotonic()))
        noise = board.random.standard_normal(4).tolist()
        values = board.arm.read(noise)
        analog[:], counts[:], digital[:] = values
        if "reading" in board.hooks:
            return board.hooks["reading"](board, analog, counts, digital)
        return 1

    def write_analog(self, channels, count, volts):
        board = self._enter("write_analog")
        self._channels("write_analog", channels, count, 8)
        self._array("write_analog", "volts", volts, np.float64, count)
        if not np.isfinite(volts).all() or np.abs(volts).max() > 10.0:
            raise HILError(-127)
        board.volts = (float(volts[0]), float(volts[1]))
        if board.page is not None:
            board.page.set("volts1", volts[0])
            board.page.set("volts2", volts[1])
            if board.page.has_expired:
                # A process may be stopped between the check above and this write; the outputs of a board are locked.
                board.page.set("volts1", board.analog_state[0])
                board.page.set("volts2", board.analog_state[1])
        board.log.append(("write_analog", board.sample, board.volts))

    def write_digital(self, channels, count, states):
        board = self._enter("write_digital")
        self._channels("write_digital", channels, count, 8)
        self._array("write_digital", "states", states, np.int8, count)
        board.enables |= dict(zip(channels.tolist(), states.tolist(), strict=True))
        board.log.append(("write_digital", board.sample, dict(board.enables)))

    def watchdog_set_analog_expiration_state(self, channels, count, volts):
        board = self._enter("watchdog_set_analog_expiration_state")
        self._before_start()
        self._channels("watchdog_set_analog_expiration_state", channels, count, 8)
        self._array("watchdog_set_analog_expiration_state", "volts", volts, np.float64, count)
        board.analog_state |= dict(zip(channels.tolist(), volts.tolist(), strict=True))
        if board.page is not None:
            board.page.set("state1", volts[0])
            board.page.set("state2", volts[1])

    def watchdog_set_digital_expiration_state(self, channels, count, states):
        board = self._enter("watchdog_set_digital_expiration_state")
        self._before_start()
        self._channels("watchdog_set_digital_expiration_state", channels, count, 8)
        self._array("watchdog_set_digital_expiration_state", "states", states, np.int32, count)
        board.tristate |= {c for c, s in zip(channels.tolist(), states.tolist(), strict=True) if s == 2}
        if board.page is not None:
            board.page.set("tristate", len(board.tristate) == 8)

    def _before_start(self):
        if self._board.timeout is not None:
            self._board.note("an expiration state is set after the watchdog was started")

    def watchdog_start(self, seconds):
        board = self._enter("watchdog_start")
        if not isinstance(seconds, float) or seconds <= 0:
            board.note(f"watchdog_start({seconds!r})")
        board.timeout, board.last_reload = seconds, board.time
        if board.page is not None:
            board.process = virtual_board.spawn_watchdog(board.page, keep=True)
            virtual_board.wait_for_watchdog(board.process, board.page)
            board.page.set("timeout", seconds)

    def watchdog_reload(self):
        board = self._enter("watchdog_reload", locked=False)
        if board.timeout is None:
            raise HILError(-601)
        if board.page is not None:
            board.page.set("beat", board.page.get("beat") + 1)
        if board.expired:
            return False
        board.last_reload = board.time
        return True

    def watchdog_stop(self):
        board = self._enter("watchdog_stop", locked=False)
        board.timeout = None
        if board.page is not None:
            board.page.set("timeout", 0.0)
            board.page.set("closed", 1)
            board.process.wait(timeout=10)
        board.log.append(("watchdog_stop", board.sample, None))

    def watchdog_clear(self):
        board = self._enter("watchdog_clear", locked=False)
        if not board.expired:
            raise HILError(-599)
        board.expired, board.timeout = False, None
        if board.before is not None:
            # The vendor's page: the hardware is restored to its state prior to the expiry, if possible.
            board.volts, board.enables = board.before
            board.before = None
            board.log.append(("cleared", board.sample, board.volts))
        if board.page is not None:
            board.page.set("expired", 0)


class HIL2025(HIL):
    """The package of 2025 returns texts."""

    def get_string_property(self, code, size):
        self._enter("get_string_property")
        return "Q8-USB"[:size]


class HIL2022(HIL):
    """The package of 2022 fills a buffer, and overruns one of its own where a name is longer than a character."""

    def get_string_property(self, code, buffer, size):
        raise SystemError("the process would have been aborted")
