"""Extended simulator: the base simulator with fitted values and found effects."""

from __future__ import annotations

from bench.diagnosis.pipeline.search_result import SearchResult
from sims import extended_simulator as extend
from sims.extended_simulator import ExtendedSimulator


def build_extended_simulator(result: SearchResult) -> ExtendedSimulator:
    """Build the extended simulator from the model of the found effects.

    It is the simulator of the recording with fitted parameters, fitted values of the constants that
    the user freed (made parameters of the fit), and added effects, as written to ``extended.toml``.

    Args:
        result: result of the search.
    """
    runs, model = result.runs, result.finding.model
    evaluator, recording = runs.fitting, runs.recording
    # Estimates by index in the parameter vector: base parameters, freed constants, coefficients.
    estimates = result.estimates.values
    base_values = {
        p.name: estimates[i]
        for i, p in enumerate(evaluator.parameters[: evaluator.system_parameter_count])
    }
    # A freed constant becomes a constant of the extended simulator, with its fitted value.
    freed_constants = {
        p.name: estimates[evaluator.system_parameter_count + i].value
        for i, p in enumerate(evaluator.freed_constants)
    }
    # The simulator's order keeps the file independent of the order of the search.
    added_effects = {
        effect: result.estimates.select_coefficients(effect)
        for effect in evaluator.coefficient_slices
        if effect in model.effects
    }
    return ExtendedSimulator(
        name=extend.make_extended_name(recording.system),
        system=recording.system,
        engine=runs.engine,
        title=recording.title,
        parameters=base_values,
        effects=added_effects,
        constants={**recording.constants, **freed_constants},
        observe=evaluator.channels,
        kind=runs.kind,
        robot=extend.get_robot_reference(runs.kind),
    )
