"""Tuning problem of an experiment: simulator, unit cube, channels, and the loss of points.

`TuningProblem` has the simulator and the channels with their scale; it is rebuilt from the
experiment in every process. `ProposalEvaluator` computes the loss of points on the runs of one
target. Targets (`problem.targets`) are made in the parent process alone, which stores their true
parameters. Learned tuners access the simulator through
`bench.benchmark.problem.training_simulator`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from bench.benchmark.problem.experiment_config import Experiment
from bench.benchmark.problem.experiment_recording import (
    ObservedRuns,
    RecordedRuns,
    load_recorded_runs,
)
from bench.benchmark.problem.robot_experiment import (
    complete_robot_experiment,
    get_simulator_class,
)
from bench.benchmark.problem.targets import draw_scenario
from methods.tuner import ScenarioInfo
from sims.core.simulator import (
    Array,
    InputError,
    Parameter,
    Scenario,
    Simulator,
    make_unknown_name_error,
)
from sims.core.unit_cube import UnitCube


class TuningProblem:
    """Tuning problem of an experiment; counts its simulations.

    Attributes:
        experiment: configuration of the experiment.
        simulator: simulator that is tuned.
        world: simulator that makes the targets; the tuned one unless the experiment names another.
        cube: map between the parameters' bounds and the unit cube.
        channels: observed channels, in order.
        error_channel: index of the channel in which errors are reported.
        noise: (C,) standard deviation of each channel's noise, 0 if unknown.
        scale: (C,) divisor of the residuals: the noise, or the typical magnitude of the channel.
        recording: content of the experiment's recording; None for simulated targets.
        salt: salt from which targets are drawn.
        simulated: number of simulations made so far.

    Args:
        experiment: configuration of the experiment.
        salt: secret salt, which only the process that draws the targets has; None for the
            experiment's own.
    """

    def __init__(self, experiment: Experiment, salt: str | None = None) -> None:
        """Build the simulators, and read the recording if the experiment has one.

        `simulator` is tuned, `world` is the true system that makes the targets (the same unless the
        experiment names another), and `cube` maps parameters to the unit cube. For C channels,
        `noise` (C,) is the standard deviation of their noise, 0 for none, and `scale` (C,) divides
        their errors. `error_channel` is the index of the channel whose error is reported, and
        `simulated` counts the simulated points.

        Args:
            experiment: experiment that neither sweeps over values nor names other experiments.
            salt: salt from which targets are drawn; None for that of the experiment.

        Raises:
            InputError: a part of the experiment does not fit its simulator.
        """
        if experiment.sweep:
            swept = ", ".join(experiment.sweep)
            remedy = "run the experiments that `experiment_config.expand_sweep` returns"
            raise InputError(f"experiment {experiment.name}: sweeps over {swept}; {remedy}")
        if experiment.experiments:
            experiment_names = ", ".join(experiment.experiments)
            raise InputError(f"experiment {experiment.name}: names {experiment_names}; run these")
        self.experiment = experiment = complete_robot_experiment(experiment)
        self.simulated = 0
        self.salt = experiment.salt if salt is None else salt

        simulator_class = get_simulator_class(experiment)
        observe = experiment.observe or tuple(c.name for c in simulator_class.channels)
        self.simulator = self._build_simulator(simulator_class, observe, experiment.settings)
        self.world = self.simulator
        if experiment.world:
            self.world = self._build_simulator(simulator_class, observe, experiment.world)
            self._check_world()

        self._check_constants()
        self.cube = UnitCube(
            apply_parameter_changes(self.simulator.parameters, experiment.parameters)
        )
        self.channels = self.simulator.channels
        self.error_channel = self._find_channel(experiment.error_channel or self.channels[0].name)

        self.recording: RecordedRuns | None = None
        noise = dict(experiment.noise)
        for name in (*noise, *experiment.resolution):
            self._find_channel(name)
        if experiment.recording:
            self.recording = load_recorded_runs(experiment.recording.path, self.simulator)
            # Noise in the experiment file has priority over noise in the recording.
            noise = {**self.recording.noise, **noise}
        self.noise: Array = np.array([noise.get(c.name, 0.0) for c in self.channels])
        # Channels with different units are scaled by their noise, or else by their typical
        # magnitude.
        channel_scales = [c.scale for c in self.channels]
        self.scale: Array = np.where(self.noise > 0, self.noise, channel_scales)

    def _build_simulator(
        self, kind: type[Simulator], observe: Sequence[str], settings: Mapping[str, Any]
    ) -> Simulator:
        """Build a simulator; a setting that it does not accept becomes an error of the experiment.

        It is called for the tuned simulator, and for the one that makes the targets if that is a
        different one.

        Args:
            kind: class of the simulator.
            observe: names of the observed channels.
            settings: further arguments of its constructor.
        """
        experiment = self.experiment
        try:
            return kind(constants=experiment.fixed, observe=observe, **settings)
        except TypeError as error:  # a setting that its constructor does not accept
            subject = f"experiment {experiment.name}: simulator {kind.name}"
            raise InputError(f"{subject}: {error}") from None

    def _check_world(self) -> None:
        """Raise an error if the parameters of `world` are not the first of the tuned ones.

        `world` makes the targets, so a parameter that only `world` has could not be tuned. The
        tuned simulator may have further parameters.
        """
        tuned_parameters, world_parameters = (
            [parameter.name for parameter in simulator.parameters]
            for simulator in (self.simulator, self.world)
        )
        if world_parameters != tuned_parameters[: len(world_parameters)]:
            raise InputError(
                f"experiment {self.experiment.name}: world: expected none but the first of the "
                f"tuned parameters {', '.join(tuned_parameters)}, "
                f"found {', '.join(world_parameters)}; "
                "name effects in fixed = { NAME = COEFFICIENT }"
            )

    def _check_constants(self) -> None:
        """Raise an error for random constants that the simulator does not have or accept.

        The simulator checks the constants of a scenario: first all lower ends of the ranges from
        which constants are drawn, then all upper ends.
        """
        constants = self.experiment.constants.items()
        ranges = {name: limits for name, limits in constants if isinstance(limits, tuple)}
        lower_ends = {name: low for name, (low, _) in ranges.items()}
        upper_ends = {name: high for name, (_, high) in ranges.items()}
        for extreme_values in (lower_ends, upper_ends):
            self.simulator.run_constants(Scenario(np.zeros(1), constants=extreme_values))

    def close(self) -> None:
        """Close the simulators."""
        self.simulator.close()
        self.world.close()

    def _find_channel(self, name: str) -> int:
        """Return the index of an observed channel.

        Raises:
            InputError: no channel has this name.
        """
        names = [c.name for c in self.channels]
        if name not in names:
            raise make_unknown_name_error("channel", name, names)
        return names.index(name)

    def simulate(self, points: Array, scenarios: tuple[Scenario, ...]) -> Array:
        """Simulate points of the unit cube.

        Shapes: T samples, C channels.

        Args:
            points: (n, dim) points of the unit cube.
            scenarios: runs to simulate.

        Returns:
            Observations (n, T, C) with the samples of the scenarios concatenated.
        """
        self.simulated += len(points)
        theta = self.cube.to_physical(points)
        if len(scenarios) == 1:  # concatenation would copy the array
            return self.simulator.simulate(theta, scenarios[0])
        return np.concatenate([self.simulator.simulate(theta, s) for s in scenarios], axis=1)

    def draw_scenarios(self, rng: np.random.Generator) -> tuple[Scenario, ...]:
        """Return the recording's fitted runs, or one run with random initial state and inputs."""
        if self.recording:
            return self.recording.fitting.scenarios
        experiment = self.experiment
        return (draw_scenario(experiment, rng, experiment.initial, experiment.inputs),)

    def describe_scenarios(self, scenarios: Sequence[Scenario]) -> ScenarioInfo:
        """Return the scenario information for tuners: initial values, constants and inputs.

        An initial value of an observed channel is left out, because it is the first sample.

        Args:
            scenarios: Runs of the task, each with initial values, constants and inputs.

        Returns:
            Numbers of all runs, one run after the other, and inputs (T, U) of U signals, with the
            runs concatenated along the samples T.
        """
        observed_names = {c.name for c in self.channels}
        initial: list[float] = []
        inputs = []
        for scenario in scenarios:
            hidden = {k: v for k, v in scenario.initial.items() if k not in observed_names}
            # Sorted by name, so that each network input always has the same meaning.
            numbers = sorted({**hidden, **scenario.constants}.items())
            initial += [value for _, value in numbers]
            signals = np.array([values for _, values in sorted(scenario.inputs.items())])
            # A scenario without inputs gives an array (T, 0).
            inputs.append(signals.reshape(-1, scenario.times.size).T)
        return ScenarioInfo(np.array(initial, dtype=np.float64), np.concatenate(inputs))

    @property
    def has_several_parameters(self) -> bool:
        """True if identifiability is requested and there are several parameters."""
        return self.cube.dim > 1 and self.experiment.identifiability


def apply_parameter_changes(
    parameters: Sequence[Parameter], changes: Mapping[str, Mapping[str, Any]]
) -> tuple[Parameter, ...]:
    """Replace attributes of parameters as an experiment states.

    Args:
        parameters: Parameters of a simulator.
        changes: New attributes by parameter, such as ``{"restitution": {"training": (0.3, 0.7)}}``.

    Returns:
        The changed parameters.

    Raises:
        InputError: A parameter or attribute is unknown, or a value is not possible.
    """
    names = [p.name for p in parameters]
    allowed_attributes = ("nominal", "bounds", "training", "log")
    for name, change in changes.items():
        if name not in names:
            raise make_unknown_name_error("parameter", name, names)
        for attribute in change:
            if attribute not in allowed_attributes:
                raise make_unknown_name_error(
                    f"attribute of parameter {name}", attribute, allowed_attributes
                )
    pairs = ("bounds", "training")  # given as lists in an experiment's file
    changed_parameters = []
    for p in parameters:
        change = changes.get(p.name, {})
        new_values: dict[str, Any] = {k: tuple(v) if k in pairs else v for k, v in change.items()}
        changed = replace(p, **new_values)  # this also checks the new parameter
        # Parameters that are positive by nature, such as masses, must stay positive.
        (old_low, _), (new_low, _) = p.bounds, changed.bounds
        if old_low >= 0 and (new_low < 0 or (old_low > 0 and new_low == 0)):
            condition = "more than 0" if old_low > 0 else "at least 0"
            raise InputError(
                f"parameter {p.name}: bounds must be {condition}, found {changed.bounds}"
            )
        changed_parameters.append(changed)
    return tuple(changed_parameters)


class ProposalEvaluator:
    """Evaluator of unit-cube points: simulates them, and computes and stores their errors.

    The loss of simulated y against observed o, over C channels of scale s and the N_c present
    samples of each, is the root mean square

        L^2 = 1/C sum_c 1/(N_c s_c^2) S_c,   S_c = sum_t (y_tc - o_tc)^2        (1)
        RMSE_c^2 = S_c / N_c                                                    (2)
    """

    def __init__(self, problem: TuningProblem, side: ObservedRuns) -> None:
        """Prepare factors that convert sums of squared errors to the loss (1) and to the RMSE (2).

        There are C channels, of which channel c has N_c samples and the scale s_c. `_mean_factors`
        and `_loss_factors` (C,) are the factors 1/N_c of (2) and 1/(C N_c s_c^2) of (1);
        `_single_loss_factor` is the latter as a number, for a single channel. `_missing` marks
        missing samples (T, C); it is None if no sample is missing. `_evaluated_squares` collects
        the sums of squares (n, C) of all batches, in which `compute_rmse` looks up points.

        Args:
            problem: tuning problem.
            side: runs of the target with their observations.
        """
        self._problem = problem
        self._scenarios = side.scenarios
        missing = np.isnan(side.observed)
        self._missing = missing if missing.any() else None
        self._observed = np.where(missing, 0.0, side.observed)
        # N_c of each channel; at least 1, because it is a divisor below.
        sample_counts = np.maximum((~missing).sum(axis=0), 1)
        self._mean_factors = 1.0 / sample_counts  # (2)
        self._loss_factors = 1.0 / (sample_counts * problem.scale**2 * len(problem.scale))  # (1)
        self._single_loss_factor = float(self._loss_factors[0])
        self._evaluated_squares: list[Array] = []

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Simulate points and compute their losses: root mean square errors by (1).

        Sums of squared errors are kept for `compute_rmse`.

        Shapes: T samples, C channels.

        Args:
            points: (n, dim) points of the unit cube.

        Returns:
            Observations (n, T, C) and losses (n,). A failed simulation has NaN observations and an
            infinite loss.
        """
        observations = self._problem.simulate(points, self._scenarios)
        has_one_point_and_channel = observations.shape[0] == observations.shape[2] == 1
        if has_one_point_and_channel and self._missing is None:
            return observations, self._compute_single_loss(observations)
        squares = self._sum_squared_errors(observations)
        self._evaluated_squares.append(squares)
        losses: Array = np.sqrt(squares @ self._loss_factors)  # (1)
        # The loss of a failed simulation is infinite, because comparisons with NaN are always
        # false.
        if not all(map(math.isfinite, losses.tolist())):
            losses[~np.isfinite(losses)] = np.inf
        return observations, losses

    def _compute_single_loss(self, observations: Array) -> Array:
        """Compute the loss (1,) of one observation of one channel without missing samples.

        Most evaluations are of this kind, and this takes a third of the time of the general case.

        Args:
            observations: (1, T, 1) simulated channel.

        Returns:
            Root of the mean squared error in units of the channel's scale; infinite if it is not
            finite.
        """
        difference = (observations - self._observed).ravel()
        square = float(difference.dot(difference))  # S of (1)
        self._evaluated_squares.append(np.array([[square]]))
        loss = square * self._single_loss_factor
        return np.array([math.sqrt(loss) if math.isfinite(loss) else math.inf])

    def _sum_squared_errors(self, observations: Array) -> Array:
        """Compute sums (n, C) of squared errors over present samples, in squared channel units.

        Shapes: T samples, C channels.

        Args:
            observations: (n, T, C) simulated channels of n proposals.
        """
        difference = observations - self._observed
        if self._missing is not None:
            difference[:, self._missing] = 0.0
        # Squared in place, because a further array of this size might not fit in memory.
        difference *= difference
        sums: Array = np.add.reduce(difference, axis=1)
        return sums

    def compute_rmse(self, proposals: Array, recommendations: Array) -> Array:
        """Compute the RMS errors of recommended points, in channel units.

        Points among `proposals` are looked up. The others are simulated outside the tuner's budget,
        because these simulations only measure the error.

        Args:
            proposals: (m, dim) points simulated so far, in their order.
            recommendations: (k, dim) recommended points.

        Returns:
            (k, C) root-mean-square errors.
        """
        rows_by_point = {
            point.tobytes(): row
            for point, row in zip(proposals, self._stack_evaluated_rows(), strict=True)
        }
        mean_squares = np.empty((len(recommendations), len(self._mean_factors)))
        for i, point in enumerate(recommendations):
            # Points are compared by their bytes, so that only an identical point is looked up.
            key = point.tobytes()
            if key not in rows_by_point:
                rows_by_point[key] = self._sum_squared_errors(
                    self._problem.simulate(point[None], self._scenarios)
                )[0]
            mean_squares[i] = rows_by_point[key]
        errors: Array = np.sqrt(mean_squares * self._mean_factors)  # (2)
        return errors

    def _stack_evaluated_rows(self) -> Array:
        if self._evaluated_squares:
            return np.concatenate(self._evaluated_squares)
        return np.empty((0, len(self._mean_factors)))


@contextmanager
def numeric_warnings_silenced() -> Iterator[None]:
    """Silence NumPy's floating-point warnings and other RuntimeWarnings; also a decorator.

    A simulation that overflows is a valid result: its loss is infinite, and status and report say
    so. A warning for each of its time steps gives no further information.
    """
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield
