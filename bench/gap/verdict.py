"""The verdict: what explain answers, as an object and as verdict.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.gap.causes.rules import BORDERING, CUT, FAULTY, MEANING, OPEN, VerdictName
from bench.gap.model.watch import Cut
from bench.gap.propose import Experiment
from sims.extended import Number

Document = dict[str, Any]


@dataclass(frozen=True, repr=False)
class Cause:
    """One effect that the simulator lacks.

    Attributes:
        effect: its name.
        alternatives: effects that would explain the same share as well, the most plausible first.
        says: the effect in a sentence that a person understands.
        coefficients: its fitted numbers with their 95 % intervals, by name.
        p_value: chance of a gain like its own if it were not there.
        form: ``soft`` where dry friction has the solver parameters of the robot's model file, or
            MuJoCo's defaults; left out where it is stiff, and of all other causes.
    """

    effect: str
    alternatives: tuple[str, ...]
    says: str
    coefficients: Mapping[str, Number]
    p_value: float
    form: str | None = None

    @property
    def open_numbers(self) -> dict[str, Number]:
        """Its numbers that are not results: at a bound, or without an interval. How a robot is
        stepped was chosen, and has no interval.
        """
        if self.effect.startswith("numerics."):
            return {}
        return {name: n for name, n in self.coefficients.items() if not n.is_result}

    def document(self) -> Document:
        """As in verdict.json."""
        return {
            "effect": self.effect,
            "alternatives": list(self.alternatives),
            "says": self.says,
            "coefficients": _estimates(self.coefficients),
            "p_value": self.p_value,
            **({"form": self.form} if self.form is not None else {}),
        }

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Cause:
        """From verdict.json."""
        return cls(
            document["effect"],
            tuple(document["alternatives"]),
            document["says"],
            _numbers(document["coefficients"]),
            document["p_value"],
            document.get("form"),
        )

    def __repr__(self) -> str:
        names = " or ".join([self.effect, *self.alternatives])
        numbers = [f"{name} = {_short(number)}" for name, number in self.coefficients.items()]
        return f"Cause({names}: {', '.join(numbers)})"


@dataclass(frozen=True, repr=False)
class Heldout:
    """Errors on held-out runs, or on each run left out of the fit in turn where two or three runs
    are not marked; None where the data give no number.

    Attributes:
        rmse_base: of the tuned base model, in the unit.
        rmse_extended: of the extended model.
        noise_floor: what a perfect model would leave.
        gap_closed: (base - extended) / (base - floor).
        low: end of its 95 % interval.
        high: the other end.
        unit: of the errors; empty if unknown.
    """

    rmse_base: float | None
    rmse_extended: float | None
    noise_floor: float | None
    gap_closed: float | None
    low: float | None
    high: float | None
    unit: str = ""

    def document(self) -> Document:
        """As in verdict.json, where what is no number is null."""
        numbers = {
            "rmse_base": self.rmse_base,
            "rmse_extended": self.rmse_extended,
            "noise_floor": self.noise_floor,
            "gap_closed": self.gap_closed,
            "low": self.low,
            "high": self.high,
        }
        return {**numbers, "unit": self.unit}

    def __repr__(self) -> str:
        change = f"{_figure(self.rmse_base)} -> {_figure(self.rmse_extended)} {self.unit}".rstrip()
        floor, closed = _figure(self.noise_floor), _figure(self.gap_closed)
        return f"Heldout({change}, floor {floor}, closed {closed})"


@dataclass(frozen=True, repr=False)
class Candidate:
    """One effect of the library, and the evidence for it about the base model.

    Attributes:
        effect: its name.
        score: twice the gain in log likelihood by it alone, less log n for each of its numbers
            beyond the first, of n samples.
        p_value: chance of the best score of a library being as high with nothing missing.
        heldout_gain: share of the gap on held-out runs that it closes alone; None if not measured.
    """

    effect: str
    score: float
    p_value: float
    heldout_gain: float | None

    def document(self) -> Document:
        """As in verdict.json."""
        return {
            "effect": self.effect,
            "score": self.score,
            "p_value": self.p_value,
            "heldout_gain": self.heldout_gain,
        }

    def __repr__(self) -> str:
        return f"Candidate({self.effect}: score {self.score:.3g}, p {self.p_value:.2g})"


@dataclass(frozen=True)
class RecordingFault:
    """A wrong unit or a reversed sign of recorded signals that explains nearly all of the misfit.

    Attributes:
        signals: channels and inputs that are concerned.
        factor: by which SI values of the first one have to be multiplied.
        unit: that its numbers are in; None where its sign alone is wrong.
        says: what is wrong, and the change of the description that corrects it.
        lines: of each signal, its table in the description and the keys to set.
        error_before: RMS of the base model's residual on the fitted runs, in units of the noise;
            None where it was not measured.
        error_after: the same with the correction; None likewise.
        alternatives: other corrections that explain the recording as well, a sentence each.
    """

    signals: tuple[str, ...]
    factor: float
    unit: str | None
    says: str
    lines: tuple[str, ...]
    error_before: float | None
    error_after: float | None
    alternatives: tuple[str, ...] = ()

    def document(self) -> Document:
        """As in verdict.json."""
        return {
            "signals": list(self.signals),
            "factor": self.factor,
            "unit": self.unit,
            "says": self.says,
            "lines": list(self.lines),
            "error_before": self.error_before,
            "error_after": self.error_after,
            "alternatives": list(self.alternatives),
        }

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> RecordingFault:
        """From verdict.json."""
        lists = ("signals", "lines", "alternatives")
        return cls(**{**document, **{name: tuple(document[name]) for name in lists}})


@dataclass(frozen=True, repr=False)
class Verdict:
    """What explain answers.

    Attributes:
        verdict: one of six words.
        system: of the recording.
        engine: that stepped the simulator; ``its own`` where it steps itself.
        causes: what the simulator lacks, strongest first.
        parameters: the base parameters with their 95 % intervals, by name.
        heldout: the gain on held-out runs, or on runs left out in turn; None where there are
            neither, or the simulation failed.
        candidates: the library, the strongest first; empty where nothing was scored.
        next_experiment: what to record next; None where nothing is open.
        simulations: how many were spent.
        seconds: how long it took.
        cut: that the search was ended early, and what was not asked; None where it came to its end.
        recording_faults: wrong units or signs of the recording, for which no cause was searched;
            left out where there are none.
        recording_notes: how samples of the recording were taken, such as those in which drives are
            off; left out where there is nothing to say.
    """

    verdict: VerdictName
    system: str
    engine: str
    causes: tuple[Cause, ...]
    parameters: Mapping[str, Number]
    heldout: Heldout | None
    candidates: tuple[Candidate, ...]
    next_experiment: Experiment | None
    simulations: int
    seconds: float
    cut: Cut | None = None
    recording_faults: tuple[RecordingFault, ...] = ()
    recording_notes: tuple[str, ...] = ()

    @property
    def says(self) -> str:
        """What the word means, in one sentence."""
        if self.recording_faults:
            return FAULTY
        if self.cut is None and self.has_open_numbers:
            return OPEN
        if self.cut is None and self.bordering:
            return BORDERING
        return MEANING[self.verdict] if self.cut is None else CUT[self.verdict]

    @property
    def has_open_numbers(self) -> bool:
        """Whether the verdict is `partial` and a number of a cause is not a result."""
        return self.verdict == "partial" and any(cause.open_numbers for cause in self.causes)

    @property
    def bordering(self) -> dict[str, Number]:
        """Base parameters at a bound of their range, where that makes the verdict `partial`."""
        if self.verdict != "partial" or not self.causes:
            return {}
        numbers = self.parameters.items()
        return {k: n for k, n in numbers if n.at_bound is not None and not n.is_result}

    def document(self) -> Document:
        """The content of verdict.json."""
        # The order of the keys is that of the page that explains them, and of older files.
        proposed = self.next_experiment
        faults = [fault.document() for fault in self.recording_faults]
        return {
            "verdict": self.verdict,
            "system": self.system,
            "engine": self.engine,
            "causes": [cause.document() for cause in self.causes],
            "parameters": _estimates(self.parameters),
            "heldout": self.heldout.document() if self.heldout is not None else None,
            "candidates": [candidate.document() for candidate in self.candidates],
            "next_experiment": proposed.document() if proposed is not None else None,
            "simulations": self.simulations,
            "seconds": self.seconds,
            "cut": self.cut.document() if self.cut is not None else None,
            **({"recording_faults": faults} if faults else {}),
            **({"recording_notes": list(self.recording_notes)} if self.recording_notes else {}),
        }

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Verdict:
        """From the content of a verdict.json that explain has written."""
        # Null stands for what there was nothing to say of.
        heldout, proposed = document["heldout"], document["next_experiment"]
        # Older files do not know of it.
        cut = document.get("cut")
        return cls(
            document["verdict"],
            document["system"],
            document["engine"],
            tuple(Cause.of(cause) for cause in document["causes"]),
            _numbers(document["parameters"]),
            Heldout(**heldout) if heldout is not None else None,
            tuple(Candidate(**candidate) for candidate in document["candidates"]),
            Experiment(**proposed) if proposed is not None else None,
            document["simulations"],
            document["seconds"],
            Cut.of(cut) if cut is not None else None,
            tuple(RecordingFault.of(fault) for fault in document.get("recording_faults", ())),
            tuple(document.get("recording_notes", ())),
        )

    def __repr__(self) -> str:
        names = ", ".join(" or ".join([c.effect, *c.alternatives]) for c in self.causes)
        found = f": {names}" if names else ""
        return f"Verdict({self.verdict}{found}; {self.system}, {self.simulations} simulations)"


def finite(value: float) -> float | None:
    """A number as JSON has it: None where the data gave none."""
    # NaN is no JSON: strict readers refuse the whole file for it.
    return value if np.isfinite(value) else None


def _estimates(numbers: Mapping[str, Number]) -> Document:
    """Numbers as in verdict.json, by name."""
    return {name: _estimate(number) for name, number in numbers.items()}


def _estimate(number: Number) -> Document:
    found: Document = {key: getattr(number, key) for key in ("value", "unit", "low", "high")}
    # What says nothing of a number is left out.
    for key in ("at_bound", "stated", "total", "total_unit"):
        if (value := getattr(number, key)) not in (None, ""):
            found[key] = value
    if number.usual_range is not None:
        found["usual_range"] = list(number.usual_range)
    return found


def _numbers(document: Mapping[str, Any]) -> dict[str, Number]:
    return {name: _number(estimate) for name, estimate in document.items()}


def _number(estimate: Mapping[str, Any]) -> Number:
    usual = estimate.get("usual_range")
    ends = (float(usual[0]), float(usual[1])) if usual is not None else None
    return Number(**{**estimate, "usual_range": ends})


def _short(number: Number) -> str:
    return f"{number.value:.3g} {number.unit}"


def _figure(value: float | None) -> str:
    return "?" if value is None else f"{value:.3g}"
