"""Mean of a friction law over the runs of a recording, for models that have no such law."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bench.diagnosis.datasheet.constants_groups import ConstantsGroup
from bench.diagnosis.datasheet.sheet_content import SheetContent
from sims.core.effect import Friction
from sims.core.simulator import Array
from sims.core.system import StateSnapshot
from sims.extended_simulator import FittedValue
from sims.recording.recording import Run


def compute_mean_friction_limit(
    sheet: SheetContent,
    group: ConstantsGroup,
    effect: type[Friction],
    numbers: Mapping[str, FittedValue],
) -> float:
    """Compute the mean limit of a friction law over the samples of some runs, in N or N·m.

    The limit is the largest force with which the friction holds the joint. MuJoCo has only a
    constant limit, of which the mean is the best approximation.

    Args:
        sheet: Content of the data sheet.
        group: Runs with equal constants.
        effect: Friction law.
        numbers: Its fitted coefficients by name; missing ones are zero.
    """
    limits = [_compute_friction_limits(sheet, group, run, effect, numbers) for run in group.runs]
    values = np.concatenate(limits)
    return float(values[np.isfinite(values)].mean())


def _compute_friction_limits(
    sheet: SheetContent,
    group: ConstantsGroup,
    run: Run,
    effect: type[Friction],
    numbers: Mapping[str, FittedValue],
) -> Array:
    """Compute the limit (T,) of a friction law at each sample of a run, as one batch."""
    kind = sheet.subject.kind
    system = kind.system()
    (coordinate,) = system.coordinates
    position = run.channels[coordinate]
    rate = np.gradient(position, run.times)
    shape = (len(position), 1)
    theta = np.array([[group.numbers[p.name] for p in kind.parameters]])
    effect_coefficients = effect.on(system)
    coefficients = [
        numbers[c.name].value if c.name in numbers else 0.0 for c in effect_coefficients
    ]
    moment = StateSnapshot(
        system,
        np.repeat(theta, len(position), axis=0),
        {c.name: np.full(shape, group.numbers[c.name]) for c in kind.constants},
        (run.times - run.times[0])[:, None],
        position[:, None],
        rate[:, None],
        {name: values[:, None] for name, values in run.inputs.items()},
    )
    c = np.array(coefficients)[:, None, None]
    limit: Array = effect().limit(np.broadcast_to(c, (len(c), *shape)), moment)[:, 0]
    return limit
