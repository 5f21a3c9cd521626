"""Diagnoser that asks a language model through a command of the user's.

The command reads a prompt from its standard input and prints an answer that contains a JSON object
like verdict.json. Which model it asks, and how, is the user's choice. The model sees a summary of
the recording: the simulator, the effects that may be missing, and the residual of the fitted base
model in units of the noise.

Source: the way in which LLM-SR (P. Shojaee et al., LLM-SR: scientific equation discovery via
programming with large language models, ICLR 2025, arXiv:2404.18400) puts data to a language model,
here with a library of effects in place of free equations.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
from contextlib import closing
from typing import Any

import numpy as np

from bench.core.diagnoser import VERDICTS, Answer, Diagnoser, DiagnosisCase
from bench.diagnosis_benchmark.diagnosers.regression_evidence import RegressionEvidence
from sims.core.root_mean_square import compute_rms
from sims.core.simulator import Array, InputError

COMMAND_VARIABLE = "SIMGAP_DIAGNOSER_COMMAND"
"""Environment variable with the command, which `simgap compare --command` sets."""
_MAX_SAMPLES = 40
"""Maximum number of samples of each series in the prompt."""
_MAX_ANSWER_LENGTH = 1_000_000
"""Maximum number of characters of an answer that are searched."""
_INSTRUCTIONS = """\
A simulator was fitted to a measured recording. Decide what physical effect the simulator lacks, if
any. The JSON below has the simulator's parameters and channels, the effects that may be missing,
and for each run the measured channels, the inputs and the residual (measured minus simulated, in
units of the noise: an adequate simulator leaves white noise of about 1).

Answer with one JSON object: {"verdict": one of VERDICTS,
"causes": [{"effect": a name from "effects", "alternatives": [names that explain it as well]}]}.
"adequate": nothing is missing. "named": the causes explain the residual. "ambiguous": the data do
not tell the alternatives apart. "unknown": none of the effects explains the residual.
""".replace("VERDICTS", ", ".join(f'"{verdict}"' for verdict in VERDICTS))


class LanguageModel(Diagnoser):
    """A language model, asked through the command of `simgap compare --command`."""

    name = "language-model"

    def diagnose(self, case: DiagnosisCase) -> Answer:
        """Ask the model for a verdict and its causes."""
        prompt = f"{_INSTRUCTIONS}\n{json.dumps(summarise_case(case))}\n"
        return parse_answer(_run_command(prompt, case.left))


def summarise_case(case: DiagnosisCase) -> dict[str, Any]:
    """Summarise a recording and the residual of its fitted base model as a JSON document.

    Series are thinned to at most `_MAX_SAMPLES` samples, and numbers rounded to four digits, so
    that the prompt stays short.

    Args:
        case: task of a diagnoser: recording, simulator and effects, without the hidden causes.
    """
    with closing(RegressionEvidence.collect(case)) as evidence:
        names = list(evidence.evaluator.channels)
        sigma = dict(zip(names, map(float, evidence.noise.sigma), strict=True))
        residual = evidence.residual / np.asarray(evidence.noise.sigma)
        runs = [*case.recording.training(), *case.recording.held_out()]
        run_documents = []
        for run, values in zip(runs, residual, strict=True):
            count = len(run.times)  # shorter runs are filled up in the array of residuals
            run_documents.append(
                {
                    "t": _thin_series(run.times),
                    "inputs": {name: _thin_series(series) for name, series in run.inputs.items()},
                    "measured": {name: _thin_series(run.channels[name]) for name in names},
                    "residual": {
                        name: _thin_series(values[:count, i]) for i, name in enumerate(names)
                    },
                    "residual_rms": {
                        name: _round_value(compute_rms(values[:count, i]))
                        for i, name in enumerate(names)
                    },
                }
            )
    return {
        "simulator": (case.kind.__doc__ or "").split("\n")[0],
        "constants": dict(case.recording.constants),
        "parameters": [f"{p.name} [{p.unit}]" for p in case.kind.parameters],
        "noise": {name: _round_value(value) for name, value in sigma.items()},
        "effects": {
            name: (kind.__doc__ or "").split("\n")[0] for name, kind in case.library.items()
        },
        "runs": run_documents,
    }


def _thin_series(series: Array) -> list[float | None]:
    """Return at most `_MAX_SAMPLES` samples at equal intervals; None for a missing one."""
    step = max(-(-len(series) // _MAX_SAMPLES), 1)
    return [_round_value(float(x)) if np.isfinite(x) else None for x in series[::step]]


def _round_value(value: float) -> float:
    return float(f"{value:.4g}")


def _run_command(prompt: str, seconds: float) -> str:
    """Run the user's command on a prompt.

    Args:
        prompt: text on the command's standard input.
        seconds: time limit.

    Returns:
        The command's standard output.

    Raises:
        InputError: there is no command, it fails, or it takes too long.
    """
    command = os.environ.get(COMMAND_VARIABLE, "")
    if not command:
        raise InputError(
            "language-model: expected the command of a language model, found none; run simgap "
            'compare EXPERIMENT --command "COMMAND"'
        )
    try:
        process = subprocess.run(
            shlex.split(command),
            input=prompt,
            capture_output=True,
            text=True,
            timeout=max(seconds, 1.0),
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"language-model: {command}: {error}") from None
    if process.returncode:
        # The last line of the errors; empty if the command printed none.
        last = "".join(process.stderr.strip().splitlines()[-1:])
        raise InputError(f"language-model: {command}: exit code {process.returncode}: {last:.200}")
    return process.stdout


def parse_answer(text: str) -> Answer:
    """Find the last JSON object with a verdict in a text; models often write words around it.

    Decoding is tried from every opening brace, since braces occur in the words, too.

    Args:
        text: answer of the model; only its end is searched, at most `_MAX_ANSWER_LENGTH`
            characters.

    Raises:
        InputError: there is none, or it is not a valid answer.
    """
    decoder, answer = json.JSONDecoder(), None
    shortened = text[-_MAX_ANSWER_LENGTH:]
    for start in (i for i, letter in enumerate(shortened) if letter == "{"):
        try:
            document, _ = decoder.raw_decode(shortened, start)
        except (ValueError, RecursionError):
            continue
        if isinstance(document, dict) and "verdict" in document:
            answer = document
    if answer is None:
        raise InputError(
            'language-model: expected a JSON object with "verdict" in the answer, found '
            f"{text.strip()!r:.80}; ask the model for JSON alone"
        )
    return Answer.of(answer)
