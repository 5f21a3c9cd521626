"""Recordings made by simulation: data whose truth is known, to try things out on.

The recording tells what a real one would; the truth goes to a file of its own, so that a blind test
stays blind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.problem.seeds import rng_for
from bench.problem.signals import signal
from bench.registry import simulators
from sims.base import Array, InputError, Scenario, Simulator, unknown
from sims.own import OwnSimulator
from sims.recording.recording import Recording, Run
from sims.recording.write import refuse_existing, write_recording
from sims.simulated import Simulated
from sims.system import UsualRecording

_DIGITS = 9


@dataclass(frozen=True)
class Wish:
    """A recording to make; texts are ``NAME=VALUE`` as on the command line.

    Attributes:
        system: registered name.
        theta: parameters other than their nominal values, or all of them in order with commas
            between.
        effects: coefficients, several with commas between.
        constants: other than the defaults.
        noise: 1 sigma, of every channel or by name.
        inputs: signals by name; see `bench.problem.signals`.
        initial: a value, or ``LOW:HIGH`` from which each run draws.
        observe: channels to record; the system's usual ones where empty.
        runs: how many.
        seconds: length of a run.
        rate: samples a second.
        engine: None for the batch engine where there is a choice.
        seed: of all that is drawn.
        held_out: how many of the last runs are marked; None for a third of them, at least one of
            several.
    """

    system: str
    theta: Sequence[str] = ()
    effects: Sequence[str] = ()
    constants: Sequence[str] = ()
    noise: Sequence[str] = ()
    inputs: Sequence[str] = ()
    initial: Sequence[str] = ()
    observe: Sequence[str] = ()
    runs: int = 4
    seconds: float = 4.0
    rate: float = 100.0
    engine: str | None = None
    seed: int = 0
    held_out: int | None = None


@dataclass(frozen=True)
class Made:
    """A simulated recording, its truth as TOML tables, and the simulator that made it."""

    recording: Recording
    truth: Mapping[str, Any] = field(repr=False)
    simulator: Simulator


def write(wish: Wish, out: Path) -> Made:
    """Simulate, and write `out`, its description and its truth: all three or none.

    Raises:
        InputError: something in the wish cannot be, or a file exists already.
    """
    import tomli_w

    if out.suffix != ".csv":
        raise InputError(f"--out {out}: expected a name that ends in .csv")
    truth = out.with_suffix(".truth.toml")
    refuse_existing([out, out.with_suffix(".toml"), truth])
    made = make(wish)
    beside = {truth: tomli_w.dumps(made.truth)}
    write_recording(out, made.recording, type(made.simulator), digits=_DIGITS, beside=beside)
    return made


def make(wish: Wish) -> Made:
    """Simulate the recording.

    Raises:
        InputError: something in the wish cannot be.
    """
    return _Maker(wish).make()


class _Maker:
    def __init__(self, wish: Wish) -> None:
        self.wish = wish
        self.kind = kind = simulators.get(wish.system)
        self.usual = _usual(kind)
        self.held_out = max(1, wish.runs // 3) if wish.held_out is None else wish.held_out
        if wish.held_out is None and wish.runs == 1:
            self.held_out = 0
        if not 0 <= self.held_out < wish.runs:
            raise InputError(
                f"--held-out {self.held_out}: expected fewer than the {wish.runs} runs"
            )
        self.theta = _theta(wish.theta, kind)
        self.effects = {
            n: _list("--effect", n, text) for n, text in _pairs("--effect", wish.effects).items()
        }
        self.engine = wish.engine
        if not self.engine and issubclass(kind, Simulated) and not issubclass(kind, OwnSimulator):
            self.engine = "batch"
        self.simulator = self._simulator()
        self.noise = _noise(wish.noise, [c.name for c in self.simulator.channels])
        initial = _pairs("--initial", wish.initial, kind.states, "initial state")
        given = {name: _range(name, text) for name, text in initial.items()}
        self.ranges = {**self.usual.initial, **given}
        known = [c.name for c in kind.inputs]
        self.inputs = {
            **self.usual.inputs,
            **_pairs("--input", wish.inputs, known, "input"),
        }
        self.times = _times(wish)

    def make(self) -> Made:
        scenarios = {str(number): self._scenario(number) for number in range(1, self.wish.runs + 1)}
        runs = tuple(self._run(int(name), scenario) for name, scenario in scenarios.items())
        stated = {name: sigma for name, sigma in self.noise.items() if sigma}
        constants, system = self.simulator.constant_values, self.wish.system
        recording = Recording(Path(), system, f"{system}, simulated", constants, stated, runs)
        truth = {
            "system": system,
            "engine": self.engine or "its own",
            "seed": self.wish.seed,
            "parameters": self.theta,
            "effects": self.effects,
            "noise": self.noise,
            "constants": constants,
            "inputs": self.inputs,
            "runs": {name: {"initial": dict(s.initial)} for name, s in scenarios.items()},
        }
        self.simulator.close()
        return Made(recording, truth, self.simulator)

    def _simulator(self) -> Simulator:
        constants = _pairs(
            "--constant", self.wish.constants, [c.name for c in self.kind.constants], "constant"
        )
        values = {name: _number("--constant", name, text) for name, text in constants.items()}
        observe = list(self.wish.observe) or list(self.usual.observe) or None
        if issubclass(self.kind, Simulated):
            return self.kind(values, observe, engine=self.engine, fixed=self.effects)
        if self.effects or self.engine:
            raise InputError(f"simulator {self.wish.system} takes neither effects nor an engine")
        return self.kind(values, observe)

    def _scenario(self, number: int) -> Scenario:
        """Run `number`; each of its draws has a stream of its own, so that none depends on what
        else there is.
        """
        initial = {
            name: low if low == high else self._rng("initial", name, number).uniform(low, high)
            for name, (low, high) in self.ranges.items()
        }
        inputs = {
            n: signal(text, self.times, self._rng("input", n, number))
            for n, text in self.inputs.items()
        }
        return Scenario(self.times, initial, inputs)

    def _run(self, number: int, scenario: Scenario) -> Run:
        observed = self.simulator.simulate(np.array([list(self.theta.values())]), scenario)[0]
        if not np.isfinite(observed).all():
            raise InputError(
                f"run {number}: the simulation failed; check --theta, --effect and --initial"
            )
        channels = {}
        for name, values in zip(self.noise, observed.T, strict=True):
            channels[name] = values + self.noise[name] * self._rng(
                "noise", name, number
            ).standard_normal(values.size)
        held_out = number > self.wish.runs - self.held_out
        return Run(str(number), self.times, channels, scenario.inputs, {}, {}, held_out)

    def _rng(self, what: str, name: str, number: int) -> np.random.Generator:
        return rng_for("simulate", self.wish.system, what, name, self.wish.seed, number)


def _times(wish: Wish) -> Array:
    samples = round(wish.seconds * wish.rate) if 0 < wish.seconds * wish.rate < 1e8 else 0
    if samples < 2:
        raise InputError(
            f"--seconds {wish.seconds:g} --rate {wish.rate:g}: expected at least 2 samples and below 1e8"
        )
    return np.array([float(f"{t:.{_DIGITS}g}") for t in (np.arange(samples) / wish.rate).tolist()])


def _theta(texts: Sequence[str], kind: type[Simulator]) -> dict[str, float]:
    names = [p.name for p in kind.parameters]
    if len(texts) == 1 and "=" not in texts[0]:
        cells = texts[0].split(",")
        if len(cells) != len(names):
            raise InputError(
                f"--theta {texts[0]}: expected {len(names)} values ({', '.join(names)}), found {len(cells)}"
            )
        given = dict(zip(names, cells, strict=True))
    else:
        given = _pairs("--theta", texts, names, "parameter")
    theta = {
        p.name: _number("--theta", p.name, given.get(p.name, str(p.nominal)))
        for p in kind.parameters
    }
    for p in kind.parameters:
        low, high = p.bounds
        if not low <= theta[p.name] <= high:
            raise InputError(
                f"--theta {p.name}={theta[p.name]:g}: expected {low:g} to {high:g} {p.unit}"
            )
    return theta


def _noise(texts: Sequence[str], channels: Sequence[str]) -> dict[str, float]:
    plain = [text for text in texts if "=" not in text]
    if len(plain) > 1:
        raise InputError(
            f"--noise {' '.join(plain)}: expected one number for all channels, or NAME=VALUE"
        )
    named = _pairs("--noise", [text for text in texts if "=" in text], channels, "recorded channel")
    values = {
        name: _number("--noise", name, named.get(name, (plain or ["0"])[0])) for name in channels
    }
    for name, value in values.items():
        if value < 0:
            raise InputError(f"--noise {name}={value:g}: expected at least 0")
    return values


def _usual(kind: type[Simulator]) -> UsualRecording:
    """Of its system; an extended simulator shows what the recording had that it was fitted to."""
    if not issubclass(kind, Simulated):
        return UsualRecording()
    usual = kind.system.usual_recording
    return usual if kind.name == kind.system.name else replace(usual, observe=())


def _pairs(option: str, texts: Sequence[str], known: Any = None, kind: str = "") -> dict[str, str]:
    """NAME=VALUE texts as a dictionary; names must be among `known` unless that is None."""
    pairs: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name or not value:
            raise InputError(f"{option} {text}: expected NAME=VALUE")
        if known is not None and name not in known:
            raise unknown(kind, name, list(known) or ["none"])
        if name in pairs:
            raise InputError(f"{option}: {name} is given twice")
        pairs[name] = value
    return pairs


def _number(option: str, name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise InputError(f"{option} {name}={text}: expected a number")
    return value


def _list(option: str, name: str, text: str) -> list[float]:
    return [_number(option, name, cell) for cell in text.split(",")]


def _range(name: str, text: str) -> tuple[float, float]:
    low, colon, high = text.partition(":")
    pair = _number("--initial", name, low), _number("--initial", name, high if colon else low)
    if pair[0] > pair[1]:
        raise InputError(f"--initial {name}={text}: expected LOW:HIGH")
    return pair
