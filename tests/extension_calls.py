"""Calls of every entry of the extension: arguments that hang together, and the same with one or two hostile values.

Arguments by chance contradict each other and are refused at the first check, which proves little of what lies behind.
So each entry has a recipe of sound arguments, which it answers, and a hostile call is a sound one in which a number, a
word, an array or a list was exchanged.
"""

import ast
import functools
import itertools
import math
import random
import re
from pathlib import Path
from unittest import mock

import numpy as np

from ftlm import _core, rig

STUB = Path(__file__).resolve().parent.parent / "python" / "ftlm" / "_core.pyi"
#: It panics by its purpose, so no attack calls it; tests of the attack do.
PANICS = "panic_on_purpose"
#: How often sound arguments stay sound, and get two hostile values rather than one.
SOUND, TWICE = 0.1, 0.3
#: Rows or columns of an array beyond memory, all of them one number; a rig that is run on so many samples runs on.
LARGE = 1 << 34
ENDLESS = {"VirtualArm.rest", "VirtualArm.run"}
#: Where a fit is told how often it may evaluate its cost, which it does; an attack asks it to so often at most.
EVALUATIONS, MAX_EVALUATIONS = {"JointProblem.minimize": 4}, 2000
#: Where a count multiplies other sizes, and the most of it: pulses a sample, pulses of a simulation, rows of up to 128
#: states.
COUNTS = {
    "Recording.experiment": (0, 1 << 12),
    "OutputSimulation.samples": (0, 1 << 12),
    "OutputSimulation.refine": (2, 1 << 12),
    "OutputSimulation.fit_past_inputs": (4, 1 << 12),
    "OutputSimulation.fit_initial_states": (1, 16),
}


class OursError(Exception):
    """What a hostile callback raises."""


def entries():
    """Names of everything that can be called or read in the extension, those of a class behind its own."""
    found = []
    for node in ast.parse(STUB.read_text()).body:
        own = f"{node.name}." if isinstance(node, ast.ClassDef) else ""
        found += [own + n.name for n in (node.body if own else [node]) if isinstance(n, ast.FunctionDef)]
    return [name for name in found if name != PANICS and not name.startswith("_")]


# ----------------------------------------------------------------------------------------------------------------------
# Sound arguments: a method a name of the extension, `a_b` for `A.b`; what is given by name comes last, as a dictionary,
# and the object of a method first.


def snake(name):
    return re.sub("(?<=[a-z])(?=[A-Z])", "_", name).lower()


class Sound:
    """Arguments that hang together, otherwise by chance."""

    def __init__(self, seed):
        self.random, self.normal = random.Random(seed), np.random.default_rng(seed).standard_normal
        self.kept = {}

    def call(self, name):
        """(what is called, its arguments, those given by name)."""
        own, _, attribute = name.rpartition(".")
        made = getattr(self, f"{snake(own)}_{attribute.strip('_')}" if own else name)()
        target = None
        if own and attribute != "__new__":
            target, made = made[0], made[1]
            bound = getattr(type(target), attribute)
            if not callable(bound):
                return (lambda: getattr(target, attribute)), [], {}
            target = getattr(target, attribute)
        *given, named = made if made and isinstance(made[-1], dict) and name in NAMED else (*made, {})
        return target or getattr(_core, own or name), given, named

    def one(self, *choices):
        return self.random.choice(choices)

    def number(self, low, high):
        return round(self.random.uniform(low, high), 3)

    def order(self):
        return self.one(0.4, 0.5, 1.0, 1.6, 2.0, self.number(0.1, 2.5))

    def m(self):
        return self.one(8, 16, 32, 64)

    def step(self):
        return self.one(0.01, 0.05, 0.1)

    def samples(self, count=None):
        return self.normal(count or self.m())

    def sensor(self, m, step):
        return _core.filter_series([(1.0, 0.0)], [(0.1, 1.0), (1.0, 0.0)], m, step)

    # ------------------------------------------------------------------------------------------ kernels and transforms

    def block_pulse_kernels(self):
        return np.array([self.order(), self.order()]), self.m(), self.step(), {"derivative": self.one(True, False)}

    def toeplitz_apply(self):
        m = self.m()
        kernels = 0.1 * self.normal((2, m))
        kernels[:, 0] = 1.0
        return kernels, self.normal((3, m)), [0, 1, self.one(0, 1)]

    toeplitz_solve = toeplitz_apply

    def haar_transform(self):
        return (self.normal((self.one(1, 3), self.m())),)

    haar_inverse = haar_transform

    def haar_matrix(self):
        return (self.m(),)

    def block_pulse_matrix(self):
        return self.order(), self.m(), self.step()

    def operational_matrix(self):
        return *self.block_pulse_matrix(), {"dense": self.one(True, False)}

    def triangular_factor(self):
        return (self.normal((self.one(1, 2, 4), self.m())),)

    singular_values = triangular_factor

    def series_multiply(self):
        m = self.m()
        return self.samples(m), self.samples(m), m, {"naive": self.one(True, False)}

    def series_divide(self):
        m = self.m()
        divisor = 0.1 * self.samples(m)
        divisor[0] = 1.0
        return self.samples(m), divisor, {"naive": self.one(True, False)}

    def fractional_integral(self):
        rule = self.one("block-pulse", "trapezoidal", "grunwald-letnikov")
        return self.normal((self.one(1, 2), self.m())), self.order(), self.step(), rule

    def fractional_derivative(self):
        rows, order = self.one(1, 2), self.order()
        definition = self.one("grunwald-letnikov", "riemann-liouville", "caputo")
        initial = np.zeros((rows, math.ceil(order) if definition == "caputo" else 0))
        return self.normal((rows, self.m())), order, self.step(), definition, initial

    # ---------------------------------------------------------------------------------------------- samples to records

    def pulse_mean_rows(self):
        m = self.m()
        return self.normal((self.one(1, 2), m * self.one(1, 2) + 1)), m, self.one(True, False)

    def point_samples(self):
        return (self.samples(),)

    def delay_samples(self):
        return self.samples(), self.number(0, 5), self.number(-1, 1)

    def filter_series(self):
        return [(1.0, 0.0), (0.1, 0.5)], [(0.1, 1.6), (0.3, 0.5), (1.0, 0.0)], self.m(), self.step()

    # ------------------------------------------------------------------------------------------------------ estimators
    #
    # Records hold two outputs and one input.

    INPUTS = (False, False, True)

    def record(self, m=None, sensor=True):
        m, step = m or self.m(), self.step()
        series = self.sensor(m, step) if sensor and self.random.random() < 0.2 else None
        if self.random.random() < 0.7:
            return step, self.normal((3, m)), series
        # In motion: whose sensors held something, where signals began, answers of the filter.
        answers = self.normal((self.one(1, 2), m)) if series is not None and self.random.random() < 0.5 else None
        begun = [self.one(True, False) for _ in range(3)], [self.number(-2.0, 2.0) for _ in range(3)], answers
        return step, self.normal((3, m)), series, begun

    def runs(self):
        return [self.record() for _ in range(self.one(1, 1, 2))]

    def structure(self, output=0):
        alpha = self.one(0.8, 1.0, 1.6, 2.0)
        terms = [(output, 0.0), (2, 0.0)]
        if alpha > 1:
            terms.insert(1, (output, self.one(0.5, 0.9)))
        if self.random.random() < 0.3:
            terms.append((1 - output, self.one(0.0, 0.3)))
        return output, alpha, terms

    def equation(self, output=0):
        structure = self.structure(output)
        return structure, [self.number(-2, -0.1) if s == output else self.number(-1, 1) for s, _ in structure[2]]

    def fixed(self, structure):
        return [self.number(-1, 1) if self.random.random() < 0.2 else None for _ in structure[2]]

    def terms(self):
        return self.one((True, []), (False, []), (False, [0.0]), (True, [], 1), (False, [0.0, 1.0], 2))

    def multi_innovation_rows(self):
        count, problems, width = self.one(8, 16), self.one(1, 2), self.one(1, 3)
        q, m = self.normal((count * problems, width)), self.normal(count * problems)
        return q, m, count, self.one(1, 3, 7), [self.number(0.1, 9.0) for _ in range(width)], self.one(True, False)

    def least_squares(self):
        structure = self.structure()
        return self.runs(), structure, list(self.INPUTS), self.fixed(structure), self.terms()

    def projected_errors(self):
        runs, (output, alpha, _), inputs, _, terms = self.least_squares()
        other = (1 - output, self.number(0.0, 0.4))
        own = [alpha, self.number(0.0, 0.5)]
        points = [[-self.number(1.0, 50.0), -self.number(0.1, 5.0)] for _ in range(self.one(1, 3))]
        return runs, (output, alpha, [other]), inputs, [self.one(None, 0.7)], terms, own, points

    def multi_innovation(self):
        return (
            *self.least_squares(),
            self.one(1, 2, 7),
            self.one(1.0, 1e6),
            self.one(True, False),
            self.one(True, False),
        )

    def instrumental_variables(self):
        structures = [self.structure(0), self.structure(1)]
        fixed = [[None] * len(s[2]) for s in structures]
        runs = [(*run[:2], None) for run in self.runs()]
        return runs, structures, list(self.INPUTS), fixed, self.terms(), self.one(1, 4), 1e-4

    def experiments(self, own=False):
        """Records of one output and one input with samples of the output; with `own`, at times of their own."""
        filtered = self.random.random() < 0.2
        return [self.experiment(own, filtered) for _ in range(self.one(1, 2))]

    def experiment(self, own, filtered):
        m, every, step = self.one(16, 32, 64), self.one(1, 2), self.step()
        places = self.places(m)
        count = len(places) if own else m // every + 1
        # The first and the last regular sample are not compared.
        shares = np.ones((1, count if own else count - 2)) if self.random.random() < 0.2 else None
        series = (self.sensor(m, step), [True]) if filtered else None
        instants = [(None, False), (self.samples(count), True)] if self.random.random() < 0.2 else []
        jumps = (self.places(m)[:3], self.samples(3))
        return {
            "record": (step, self.normal((2, m)), None),
            "pulses_per_sample": every,
            "samples": self.normal((1, count)),
            "filter": series,
            "weights": [1.0],
            "signals": instants,
            "robust_weights": shares,
            "sample_times": (places, [None, self.one(None, jumps)]) if own else None,
        }

    def free_inputs(self, *laws):
        """What is free of the second signal."""
        value = {"delay": ((0.0, 0.1), 0.05), "saturation": ((0.1, 3.0), 1.0), "dead_zone": ((0.0, 1.0), 0.1)}
        return [(1, law, *value[law]) for law in self.one((), *((law,) for law in laws))]

    # ------------------------------------------------------------------------------------------------------ joint fits

    def joint_problem_new(self):
        plain = 0.0, []
        terms = [(0, plain, "a", -1.0), (1, plain, "b", 1.0)]
        inputs = [
            (f"{kind}_u", signal, kind, ends) for signal, kind, ends, _ in self.free_inputs("saturation", "dead_zone")
        ]
        hints = {"highest": None, "natural": [("alpha", [1.0])], "exceeds": [], "positive": [], "known": [("b", 1.0)]}
        told = {
            "signals": ["y", "u"],
            "derived": [],
            "equations": [(0, (0.0, [("alpha", 1.0)]), terms, None)],
            "bounds": self.one([], [("alpha", (0.5, 2.0))]),
            "priors": self.one([], [("b", (self.number(-2.0, 2.0), self.number(-0.1, 2.0)))]),
            "coupled": self.one(True, False),
            "delayed": False,
            "initial": self.terms(),
            "history": False,
            "inputs": inputs,
            "laws": [],
            "hints": self.one(hints, hints),
        }
        return (told,)

    def recording_new(self, inputs=(), *, uniform=False):
        """A run of the structure of `joint_problem_new`."""
        rows = 33
        channel = {"nonuniform": None, "delay": None, "limits": [], "filtered": False, "enters_others": True}
        limits = [(kind, None) for _, _, kind, _ in inputs]
        given = {
            "name": "run",
            "step": 0.05,
            "times": None,
            "signals": [
                {**channel, "name": "y", "samples": self.normal(rows), "role": "output"},
                {**channel, "name": "u", "samples": self.normal(rows), "role": "zoh", "limits": limits},
            ],
            "outputs": [0],
            "filter": None,
            "filter_states": 0,
            "at_rest": self.one(True, False),
            "coupled": self.one(True, False),
            "friction": False,
            "free": [(signal, kind) for _, signal, kind, _ in inputs],
        }
        if not inputs and not uniform and self.random.random() < 0.3:
            given["times"] = np.append(0.0, 0.05 * np.arange(1, rows) + self.number(-0.02, 0.02))
            for signal in given["signals"]:
                signal["nonuniform"] = self.normal(rows)
        if self.random.random() < 0.3:
            signals = given["signals"]
            signals[self.one(0, 1)]["filtered"] = True
            given["filter"], given["filter_states"] = (
                ([(9.0, 0.0)], [(1.0, 2.0), (3.0, 1.0), (9.0, 0.0)]),
                self.one(0, 2),
            )
        return (given,)

    def recording_pulses(self):
        return self.one_of("Recording"), (self.one(8, 32, 96), self.one(True, False))

    def recording_experiment(self):
        return self.one_of("Recording"), (self.one(1, 2), self.one(1, 2), [1.0], None)

    def recording_jumps(self):
        return self.one_of("Recording"), (self.one(0, 1),)

    recording_acting_samples = recording_jumps

    def recording_values_at(self):
        return self.one_of("Recording"), (self.one(0, 1), np.sort(np.abs(self.normal(5))))

    def experiment_compared_count(self):
        return self.one_of("Recording").experiment(1, 1, [1.0]), ()

    experiment_robust_weights = experiment_compared_count

    def nonuniform_means(self):
        times = np.append(0.0, np.cumsum(0.05 + np.abs(self.normal(20))))
        return times, self.normal(21), self.one(8, 30), 0.1, self.one(True, False)

    def sampled(self):
        """A problem, its runs, and values of everything free."""
        (told,) = self.joint_problem_new()
        problem = _core.JointProblem(told)
        runs = [_core.Recording(*self.recording_new(told["inputs"])) for _ in range(self.one(1, 2))]
        return problem, runs, [1.2, 1.5, 0.7, *(1.0 for _ in told["inputs"])]

    def heard(self):
        return self.one(None, lambda done, of: None)

    def joint_problem_orders(self):
        return self.one_of("JointProblem"), ()

    def joint_problem_coefficients(self):
        return self.one_of("JointProblem"), ()

    def joint_problem_products(self):
        return self.one_of("JointProblem"), ()

    def joint_problem_bounds(self):
        return self.one_of("JointProblem"), ()

    def joint_problem_feasible(self):
        problem, _, values = self.sampled()
        return problem, (np.array(values), np.array(values) * self.one(1.0, 1.4))

    def joint_problem_minimize(self):
        problem, runs, values = self.sampled()
        held = self.one((), (0,), (1, 2))
        given = self.experiments(own=len(values) == 3 and self.one(True, False))
        return problem, (
            self.one([run.experiment(1, 1, [1.0]) for run in runs], given),
            (values, []),
            self.one(True, False),
            held,
            self.one(0, 1, 20),
            1e-6,
            self.one(True, False),
            self.one(None, _core.Stop()),
        )

    def joint_multistart(self):
        problem, runs, _ = self.sampled()
        return problem, runs, (self.one(1, 2), 1 << 30), self.heard(), self.one(None, _core.Stop())

    def joint_fit(self):
        problem, runs, values = self.sampled()
        warm_start, initial_guess = self.one((values, [1.0], 1), None), self.one(values, None)
        raced = self.one(None, _core.joint_multistart(problem, runs, (1, 1 << 30)))
        return (
            problem,
            runs,
            self.one([], [values]),
            initial_guess,
            warm_start,
            raced,
            self.one(True, False),
            self.one(True, False),
            (self.one(1, 2), 1 << 30),
            self.heard(),
            self.one(None, _core.Stop()),
        )

    def state_of_fit(self):
        """Problem, runs and the state of a fit."""
        problem, runs, values = self.sampled()
        numbers = np.array(values)
        state = {
            "estimate": numbers,
            "on_grid": numbers,
            "weights": [1.0],
            "robust_weights": None,
            "pulses_per_sample": self.one(1, 2),
            "step_converged": self.one(True, False),
            "requires_stability": self.one(True, False),
        }
        return problem, runs, state

    def profile_intervals(self):
        options = {"threads": self.one(1, 2), "evaluations": self.one(1, 20), "budget": self.one(None, (40, 1))}
        return *self.state_of_fit(), self.one(None, [0]), 1.96, options

    def cost_surface(self):
        return *self.state_of_fit(), [0, 1], [0.1, 0.1], self.one(1, 3), {"refit": self.one(True, False)}

    def minimize(self):
        rows, limits = self.one(([[1.0, 1.0]], [1.0]), (np.zeros((0, 2)), []))
        options = {"evaluations": self.one(1, 20), "signal_norm": self.one(0.0, 1.0)}
        callbacks = (lambda v: v - 1.0), (lambda v: np.eye(len(v)))
        return *callbacks, np.zeros(2), np.array(rows), np.array(limits), options

    def covariance_of(self):
        return self.normal((3, 40)), [self.normal(20), self.normal(20)], self.number(0.1, 50.0)

    def fit_covariance(self):
        jacobian, series, _ = self.covariance_of()
        return jacobian, series, self.one(None, np.ones(40))

    def long_run_covariance(self):
        return self.covariance_of()[:2]

    def whitening_filter(self):
        return [self.normal(50), self.normal(40)], self.one(0, 3, 10)

    autocovariances = whitening_filter

    def prediction_ratio(self):
        basis = np.ascontiguousarray(np.linalg.qr(self.normal((90, 4)))[0].T)
        blocks = self.one([[(0, 50), (50, 90)]], [[(0, 50)], [(50, 90)]])
        return basis[: self.one(0, 2, 3)], basis, self.normal(90), blocks, self.one(0, 3, 10)

    def arx_model(self):
        return [self.normal(50), self.normal(40)], [[self.normal(50), self.normal(40)]], self.one(0, 3, 10)

    def is_white(self):
        return self.normal(60), self.one(5, 25)

    def variance_inflation(self):
        return (self.normal(self.one(3, 60)),)

    def portmanteau(self):
        return [self.normal(50), self.normal(40)], self.one(5, 20)

    def chi_squared(self):
        return float(self.one(1, 5, 20)), self.one(1.6, 2.3)

    def friction_respond(self):
        law = self.one((0.3, 0.0, 1.0), (0.3, 0.1, 0.5), (0.0, 0.0, 1.0))
        (_, _, terms), coefficients = self.equation()
        equation = (0, self.one(1.6, 2.0), [(s, v) for s, v in terms if s != 1])
        kept = [c for (s, _), c in zip(terms, coefficients, strict=True) if s != 1]
        return self.record(sensor=False), [(equation, kept)], [(0, law)], [[(0.0, 0.1), (1.0, -0.2)]]

    def has_unstable_pole(self):
        return self.one(1.0, 1.6, 2.0), [(self.number(-3, -0.1), 0.0), (self.number(-1, 0.1), 0.5)]

    def streaming_new(self):
        structure = (0, 1.6, [(0, 0.0), (2, 0.0)])
        return (
            0.01,
            64,
            list(self.INPUTS),
            [(structure, self.fixed(structure))],
            self.one(1, 3),
            self.one(None, 1e3),
            0.99,
            (True, []),
        )

    def streaming_push(self):
        stream = self.one_of("Streaming")
        return stream, (self.normal((2, 3)),)

    def streaming_coefficients(self):
        return self.one_of("Streaming"), ()

    streaming_pulses = streaming_coefficients

    # ------------------------------------------------------------------------------------------------------ simulation

    def powers(self):
        return [(0.0, self.number(-1, 1)), (1.0, self.number(-1, 1))] if self.random.random() < 0.5 else []

    def model(self):
        return [self.equation(output) for output in range(self.one(1, 2))]

    def respond(self):
        model = self.model()
        return self.record(), model, list(self.INPUTS), [self.powers() for _ in model]

    def respond_with_initial(self):
        model, record = self.model(), self.record(sensor=False)
        applies = self.sensor(record[1].shape[1], record[0]), [True, False][: len(model)]
        return record, model, list(self.INPUTS), self.terms(), self.one(None, None, applies)

    def output_simulation_new(self):
        """A free run, or a body with friction, on a run of the structure of `joint_problem_new`."""
        run = _core.Recording(*self.recording_new(uniform=True))
        model = [((0, 1.5, [(0, 0.0), (1, 0.0)]), [-3.0, self.number(-1, 1)])]
        return run, model, self.one([], [(0, (0.3, 0.1, 0.5))]), None

    def output_simulation_samples(self):
        terms = self.one((False, [[(0.0, 0.2)]], False), (True, [[(0.0, 0.0), (1.0, 0.0)]], self.one(True, False)))
        return _core.OutputSimulation(*self.output_simulation_new()[:2], [], None), (self.one(2, 3), terms)

    def output_simulation_refine(self):
        target, (_, terms) = self.output_simulation_samples()
        return target, (terms, 1e-3, 1 << 11, self.one(8, 1 << 14), 1 << 30)

    def output_simulation_fit_past_inputs(self):
        target, _ = self.output_simulation_samples()
        exponents = self.one([[0.0, 0.5, 1.0]], [[0.0, 1.0]])
        return target, (exponents, [[0.0]], self.one(True, False), 1e-3, 1 << 11, self.one(8, 1 << 14), 1 << 30)

    def output_simulation_exact_samples(self):
        run, _, _, _ = self.output_simulation_new()
        model = [((0, self.one(1.0, 2.0), [(0, 0.0), (1, 0.0)]), [-3.0, self.number(-1, 1)])]
        _, (_, terms) = self.output_simulation_samples()
        return _core.OutputSimulation(run, model, [], None), (terms,)

    def output_simulation_fit_initial_states(self):
        run, model, _, times = self.output_simulation_new()
        return _core.OutputSimulation(run, model, [(0, (0.3, 0.1, 0.5))], times), ((True, []), self.one(1, 2))

    def richardson_limit(self):
        return [(self.normal((2, 20)), [self.number(-1, 1)]) for _ in range(self.one(1, 4, 5))], [self.one(0, 1)]

    def equation_error(self):
        return self.record(), self.equation(), list(self.INPUTS), self.terms()

    def explicit_euler(self):
        model = [((0, 2.0, [(0, 0.0), (0, 1.0), (2, 0.0)]), [-3.0, self.number(-1, 0), 1.0])]
        return self.normal((3, self.m())), self.step(), model, list(self.INPUTS)

    def trace_errors(self):
        record, structure = self.record(), self.structure()
        trace = 0.1 * self.normal((record[1].shape[1], len(structure[2])))
        return record, structure, list(self.INPUTS), trace

    def nyquist_margin(self):
        return self.has_unstable_pole()[1], self.step()

    def correlation(self):
        lengths = [self.one(16, 40) for _ in range(self.one(1, 2))]
        return [self.samples(n) for n in lengths], [self.samples(n) for n in lengths], self.one(3, 10)

    def places(self, m):
        return np.sort(np.array([self.random.uniform(0.5, m - 0.5) for _ in range(9)]))

    def interpolate_samples(self):
        m = self.m()
        return self.normal((self.one(1, 2), m)), self.places(m)

    def kink_correction(self):
        m = self.m()
        return m, self.places(m), (self.places(m), self.samples(9)), self.order(), self.step()

    def metrics(self):
        count = self.m()
        return self.samples(count), 0.1 * self.samples(count)

    def fractional_memory(self):
        return self.samples(), self.number(0.1, 0.9), self.step(), self.one(1e-6, 1e-10)

    # -------------------------------------------------------------------------------------------------------- searches

    def orders(self):
        own = sorted({self.number(0, 0.9) for _ in range(3)})
        return 0, [1.0, 1.2, 1.6], [(0, own, self.one(True, False)), (2, [0.0, 0.3], False)]

    def settings(self):
        instruments = 3 if self.random.random() < 0.2 else 0
        return {
            "criterion": self.one("output-error", "equation-error"),
            "norm": self.one("l1", "l2"),
            "innovation_length": self.one(0, 3),
            "prior_covariance": 1e4,
            "haar_rows": self.one(True, False),
            "top": self.one(1, 5, 20),
            "threads": self.one(1, 2),
            "pruning": self.one(True, False),
            "iterations": instruments,
            "memory": 1 << 31,
        }

    def progress(self):
        return self.one(None, lambda *_: None)

    def order_grid_size(self):
        return self.orders(), list(self.INPUTS)

    def asked(self):
        """What the search of one equation takes."""
        runs = [(*run[:2], None) for run in self.runs()]
        return runs, self.orders(), list(self.INPUTS), [None, None], self.terms(), self.settings()

    def search(self):
        return *self.asked(), self.progress()

    order_search_new = asked

    def certify(self):
        low = self.number(0.6, 1.2)
        alpha = low, self.one(low, low + 0.3)
        terms = [(0, 0.0, self.number(0.0, low)), (2, 0.0, self.one(0.0, 0.4))]
        named = {
            "output": 0,
            "alpha": alpha,
            "terms": terms,
            "min_separation": self.one(0.05, 0.2),
            "tolerance": self.number(0.01, 0.9),
            "max_term_ratio": self.one(5.0, 100.0),
            "max_cells": self.one(64, 500, 3000),
            "threads": self.one(1, 2),
            "memory": 1 << 28,
            "progress": self.progress(),
        }
        return [self.record(sensor=False)], named

    def force_portable(self):
        return (self.one(True, False),)

    def search_plan(self):
        _, orders, inputs, _, terms, settings = self.asked()
        return orders, inputs, terms, settings

    def search_join(self):
        if "parts" not in self.kept or self.random.random() < 0.05:
            asked = self.asked()
            runs, orders, inputs, _, terms, settings = asked
            whole = _core.OrderSearch(*asked)
            _, waves = _core.search_plan(orders, inputs, terms, settings)
            ends = [0, *waves] if waves[0] else waves
            parts = [whole.evaluate_batches(a, b, [], None, 1, None, None) for a, b in itertools.pairwise(ends)]
            samples = sum(run[1].shape[1] for run in runs)
            self.kept["parts"] = orders, inputs, terms, settings, samples, parts
        return self.kept["parts"]

    def order_search_evaluate_batches(self):
        place = ((0, 0, 0, 0, math.inf, 0), True, ([], (0,) * 7, []))
        seed = self.one([], [(0, 10.0)], [(0, 10.0), (3, 12.0)])
        save = self.one(None, lambda _: None)
        return self.one_of("OrderSearch"), (0, 1, seed, self.one(None, place), 1, self.progress(), save)

    def stage(self):
        """What the search of a stage takes."""
        weights = [(1.0, 0.0), (0.0, 1.0)]
        laws = [
            (output, (0.0, [1.0, 0.0]), [(output, (0.0, list(weights[1]))), (2, (0.0, [0.0, 0.0]))])
            for output in (0, 1)
        ]
        runs = [(*run[:2], None) for run in self.runs()]
        axes = [[1.05, 1.4, 1.8], [0.0, 0.4, 0.8]]
        return (runs, axes, laws, list(self.INPUTS), [[None, None]] * 2, [1.0, 2.0], self.terms(), self.settings())

    def search_stage(self):
        return *self.stage(), self.progress()

    def stage_search_new(self):
        return *self.stage(), True

    def stage_search_pending_spans(self):
        return self.one_of("StageSearch"), ()

    stage_search_state = stage_search_pending_spans

    def stage_search_evaluate_spans(self):
        search = self.one_of("StageSearch")
        return search, (search.pending_spans(), 1, self.progress())

    def stage_search_record_outcomes(self):
        search = self.one_of("StageSearch")
        if not search.pending_spans():
            search = self.one_of("StageSearch", new=True)
        values, kinds = search.evaluate_spans(search.pending_spans(), 1, None)
        return search, (values, kinds, 1)

    def stage_search_outcome(self):
        search = self.one_of("StageSearch")
        while search.pending_spans():
            search.record_outcomes(*search.evaluate_spans(search.pending_spans(), 1, None), 1)
        return search, ()

    def points_new(self):
        return self.runs(), 0, [0, 2], list(self.INPUTS), self.one(True, False)

    def points_scores(self):
        rows = [[self.order(), 0.0, 0.0, self.number(-2, 0), 1.0] for _ in range(self.one(1, 4))]
        return self.one_of("Points"), (np.array(rows), self.one(math.inf, 10.0), 1)

    # ------------------------------------------------------------------------------------------------------------- rig

    def guard_new(self):
        return of_guard(self.one(None, (0.01, 0.7)))

    def virtual_arm_new(self):
        return of_arm()

    def reading(self):
        return [self.number(-1, 1) for _ in range(4)], [self.random.randrange(-99, 99), 7], [1, 1, 1, 1]

    def guard_rest(self):
        return self.one_of("Guard"), self.reading()

    def guard_read(self):
        return self.one_of("Guard"), (*self.reading(), self.one(0.0, 0.01))

    def guard_command(self):
        return self.one_of("Guard"), ([self.number(-1, 1), 0.0],)

    def guard_fail(self):
        return self.one_of("Guard"), (self.one("", "a cable hangs loose"),)

    def guard_fault(self):
        return self.one_of("Guard"), ()

    guard_last_currents = guard_bias = guard_missed_deadlines = guard_fault

    def virtual_arm_start(self):
        return self.one_of("VirtualArm"), (self.one(True, False),)

    def virtual_arm_read(self):
        return self.one_of("VirtualArm"), ([self.number(-1, 1) for _ in range(4)],)

    def virtual_arm_advance(self):
        return self.one_of("VirtualArm"), ([self.number(-1, 1), 0.1], self.one(True, False))

    def virtual_arm_inject(self):
        what = self.one("dead encoder", "saturated gauge", "limit switch", "deflection", "lost samples")
        return self.one_of("VirtualArm"), (what, self.one(0, 1), self.one(0, 3, 50), self.number(0, 0.1))

    def virtual_arm_rest(self):
        guard = _core.Guard(*self.guard_new())
        return self.one_of("VirtualArm"), (guard, self.normal((5, 4)), lambda a, b: ((a, b), True))

    def virtual_arm_run(self):
        guard, noise, out = self.virtual_arm_rest()[1]
        return self.one_of("VirtualArm"), (guard, 0.1 * self.normal((5, 2)), noise, out)

    def virtual_arm_take(self):
        return self.one_of("VirtualArm"), ()

    virtual_arm_sample = virtual_arm_angles = virtual_arm_memory = virtual_arm_take

    def stop_new(self):
        return ()

    def stop_set(self):
        return _core.Stop(), ()

    stop_is_set = stop_set

    def panic_on_purpose(self):
        return ("call",)

    def one_of(self, name, new=False):
        """An object of this class, kept for some calls."""
        if new or name not in self.kept or self.random.random() < 0.1:
            self.kept[name] = getattr(_core, name)(*getattr(self, f"{snake(name)}_new")())
        return self.kept[name]


def made_by(name, make):
    """Arguments with which ftlm makes an object of the extension."""
    with mock.patch.object(_core, name) as seen:
        make()
    return seen.call_args.args


# They are always the same, and to make them takes longer than a call.
@functools.cache
def of_guard(deflection):
    return made_by("Guard", lambda: rig.Limits().guard(0.002, deflection))


@functools.cache
def of_arm():
    return made_by("VirtualArm", lambda: rig.ArmParameters.load("linear").arm(0.002, 1.0))


#: Entries whose last arguments are given by name.
NAMED = {
    "block_pulse_kernels",
    "certify",
    "cost_surface",
    "minimize",
    "operational_matrix",
    "profile_intervals",
    "series_multiply",
    "series_divide",
}

# ----------------------------------------------------------------------------------------------------------------------
# Hostile values


NUMBERS = (
    math.nan,
    math.inf,
    -math.inf,
    0.0,
    -0.0,
    -1.0,
    1.0,
    2.0,
    1e308,
    -1e308,
    5e-324,
    1e-300,
    -1e300,
    1e16,
    1e-9,
)
FLOATS = (*NUMBERS, None, "x", 1j, 10**400)
#: Sizes between a million and what is refused are work, not an attack.
WHOLES = (
    -1,
    0,
    1,
    2,
    3,
    1 << 20,
    (1 << 31) - 1,
    1 << 31,
    1 << 40,
    1 << 62,
    (1 << 63) - 1,
    1 << 63,
    1 << 64,
    -(1 << 63),
    None,
    0.5,
    "x",
)
WORDS = (
    "",
    "\0",
    "x" * 9999,
    "\ud800",
    "linear",
    "held",
    "excess",
    "delay",
    "late",
    "grunwald-letnikov",
    None,
    3,
    b"l1",
)
ODD = (None, 0, "x", {}, float)


def raises(*_):
    raise OursError


class Liar:
    """A list that says that it is longer than memory."""

    def __len__(self):
        return 1 << 60

    def __getitem__(self, _):
        return 1.0


def hostile_array(array, r, large):
    """Another array, or none."""
    if array.size > 1 << 22:
        return array
    how = r.randrange(12)
    if how < 4 and array.size and array.dtype == float:
        array = array.copy()
        if how == 3:
            array[...] = r.choice(NUMBERS)
        else:
            array.flat[r.randrange(array.size)] = r.choice(NUMBERS)
        return array
    ways = [
        lambda: array.astype(np.float32),
        lambda: array.astype(">f8"),
        lambda: array.astype(np.int64),
        lambda: array[..., ::2],
        lambda: array[..., ::-1],
        lambda: array.T,
        lambda: array[..., :0],
        lambda: array[:0],
        lambda: array[..., :1],
        lambda: array[:1],
        lambda: array[..., None],
        lambda: np.asfortranarray(array),
        lambda: np.concatenate([array, array]),
        array.tolist,
        lambda: None,
    ]
    if large:
        ways += [
            lambda: np.broadcast_to(np.float64(1.0), (*array.shape[:-1], LARGE)),
            lambda: np.broadcast_to(np.float64(1.0), (LARGE, *array.shape[1:])),
        ]
    return r.choice(ways)()


def hostile(value, r, large=True):
    """Something else than this."""
    if isinstance(value, np.ndarray):
        return hostile_array(value, r, large)
    if isinstance(value, bool):
        return r.choice([not value, not value, None, 2])
    if isinstance(value, int):
        return r.choice(WHOLES)
    if isinstance(value, float):
        return r.choice(FLOATS)
    if isinstance(value, str):
        return r.choice(WORDS)
    if isinstance(value, bytes):
        at = r.randrange(len(value) + 1)
        return r.choice([value[:at], value[:at] + b"\xff" + value[at + 1 :], value + value, b"", "x", None])
    if isinstance(value, dict):
        return r.choice([{}, None, dict(list(value.items())[1:])])
    if isinstance(value, (list, tuple)):
        same = type(value)
        shorter, longer = same(value[:-1]), same([*value, *value[:1]])
        return r.choice([shorter, longer, same(reversed(value)), same(), same(value * 9), *ODD, range(1 << 40), Liar()])
    if callable(value):
        return r.choice([raises, lambda *_: None, lambda *_: ((math.nan, math.inf), True), lambda: None, *ODD])
    if isinstance(value, _core.Stop):
        told = _core.Stop()
        told.set()
        return r.choice([told, *ODD])
    return r.choice([*ODD, math.nan, -1, raises])


def places(value, path=()):
    """Where something can be exchanged: paths of what is within, and within that."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, item in items:
        yield (*path, key)
        if isinstance(item, (list, tuple, dict)):
            yield from places(item, (*path, key))


def exchanged(value, path, change):
    """The same with what lies at the path changed."""
    if not path:
        return change(value)
    if isinstance(value, dict):
        return {**value, path[0]: exchanged(value[path[0]], path[1:], change)}
    parts = list(value)
    parts[path[0]] = exchanged(parts[path[0]], path[1:], change)
    return type(value)(parts)


def attacked(name, given, named, r):
    """Arguments of which one or two were exchanged."""
    arguments = (list(given), dict(named))
    large = name not in ENDLESS
    for _ in range(2 if r.random() < TWICE else 1):
        spots = [path for path in places(arguments) if len(path) > 1]
        if spots:
            arguments = exchanged(arguments, r.choice(spots), lambda value: hostile(value, r, large))
    for at, most in (COUNTS.get(name, (None, 0)), (EVALUATIONS.get(name), MAX_EVALUATIONS)):
        if at is not None and isinstance(arguments[0][at], int):
            arguments[0][at] = min(arguments[0][at], most)
    return arguments
