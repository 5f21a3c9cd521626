"""Neural classifier, trained on simulated recordings with every effect of the library.

This is amortised inference, as in learned tuners (A. Allevato et al., TuneNet, CoRL 2019): all
simulations are made before a recording is available, and an answer costs only a base fit. The input
of the network is, for each run, the residual of the base fit in units of the noise with the motion
and the inputs, on a fixed grid. Convolutions process a run; the mean over runs makes their order
and number irrelevant. The classes are the effects of the library, and no effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from itertools import count
from typing import Any, ClassVar

import numpy as np

from bench.core.diagnoser import Answer, Diagnoser, DiagnoserTrainingTask, DiagnosisCase, NamedCause
from bench.diagnosis.evaluation.noise_floor import compute_noise_floor
from bench.diagnosis.evaluation.noise_model import NoiseModel
from bench.diagnosis.evaluation.run_evaluator import RunEvaluator
from bench.diagnosis.fitting.base_fit import fit_base_model
from bench.logs.synthetic_recording import SimulationSpec, simulate_recording
from sims.core.effect import make_effect_parameters
from sims.core.simulation_counter import SimulationBudgetExceededError
from sims.core.simulator import Array, InputError
from sims.effects import list_effects_for as library_of
from sims.recording.recording import Recording
from sims.system_simulator import SystemSimulator

GRID_POINT_COUNT = 64
"""Number of grid points over a run."""
LAYER_WIDTH = 48
"""Number of channels of the network's layers."""
TRAINING_EPOCHS = 60
"""Number of training epochs."""
BATCH_SIZE = 64
"""Number of recordings per training step."""
CLEAN_EXAMPLE_SHARE = 0.25
"""Fraction of examples without an effect."""
TRAINING_RESIDUAL_RANGE = (1.15, 20.0)
"""Range of the residual RMS of training examples, in units of the noise."""
MIN_EXAMPLES = 8
"""Minimum number of training examples; with fewer, nothing is trained."""
CLEAN_PROBABILITY_THRESHOLD = 0.05
"""Probability of no effect below which something is missing."""
ALTERNATIVE_PROBABILITY_RATIO = 0.4
"""Minimum probability of an alternative, as a fraction of that of the most probable effect."""
MIN_NAMED_PROBABILITY = 0.25
"""Minimum total probability of the named effects; below it, the verdict is unknown."""
VALIDATION_SHARE = 0.15
"""Fraction of the examples used for validation, by which the epoch is selected."""
_RESIDUAL_CLIP = 30.0
"""Absolute value at which residuals are clipped, in units of the noise."""
_NOISE_RANGES = {"point": (2e-3, 2e-2), "linear": (1e-3, 1e-2), "rotary": (1e-3, 1e-2)}
"""Noise range of the first channel by kind of system, SI units."""
LEARNING_RATE = 2e-3
"""Learning rate of Adam."""
WEIGHT_DECAY = 1e-4
"""Weight decay of Adam."""
DROPOUT = 0.2
"""Share of units that are dropped in training."""
ALL_CHANNELS_SHARE = 0.4
"""Share of the training recordings in which all channels are observed."""


class NeuralClassifier(Diagnoser):
    """Neural network trained on simulated effects; it names the most probable ones (torch)."""

    name = "classifier"
    learned: ClassVar[bool] = True

    def cannot(self, kind: type[SystemSimulator]) -> str:
        """Reject robots: the training precedes the case, so their model file is not available."""
        if kind.has_model:
            return "it cannot be trained for a robot whose model file is not known beforehand"
        return ""

    def train(self, task: DiagnoserTrainingTask) -> Mapping[str, Array]:
        """Simulate recordings until the budget is used up, and train the network.

        Class 0 is "no effect", the others are the effects of the library in alphabetical order.

        Args:
            task: simulator, library, budget of simulations and random numbers of the training.

        Returns:
            Weights of the network; empty if there are too few examples.
        """
        classes = ["", *sorted(task.library)]
        images, labels = [], []
        # The loop ends when the budget of simulations is used up.
        for number in count():
            name = (
                "" if task.rng.random() < CLEAN_EXAMPLE_SHARE else str(task.rng.choice(classes[1:]))
            )
            # An image is the input of the network: resampled signals of all runs.
            try:
                image = _simulate_example(task, name, number)
            except SimulationBudgetExceededError:
                break
            except InputError:
                continue  # a simulation specification that is not possible
            if image is not None:
                images.append(image)
                labels.append(classes.index(name))
        if len(labels) < MIN_EXAMPLES:
            return {}
        return _train_network(
            images, np.array(labels), len(classes), int(task.rng.integers(1 << 31))
        )

    def diagnose(self, case: DiagnosisCase) -> Answer:
        """Name the most probable effects.

        The network was trained with all effects of the system; those that the recorded signals
        cannot show get the probability zero. The answer is "adequate" unless "no effect" is less
        probable than `CLEAN_PROBABILITY_THRESHOLD`. Effects at least
        `ALTERNATIVE_PROBABILITY_RATIO` as probable as the best are its alternatives; if all of them
        together are improbable, the answer is "unknown". Without trained weights it is
        "unidentifiable".

        Args:
            case: recording, simulator, effects, and the trained weights (`learned`).
        """
        if not case.learned:
            return Answer("unidentifiable")
        classes = ["", *sorted(library_of(case.kind.system))]
        image, _ = _compute_network_input(case.kind, case.recording)
        probabilities = _predict_probabilities(case.learned, image, len(classes))
        is_possible = np.array([not name or name in case.library for name in classes])
        probabilities = np.where(is_possible, probabilities, 0.0)
        probabilities = probabilities / probabilities.sum()
        clean_probability = float(probabilities[0])
        if clean_probability >= CLEAN_PROBABILITY_THRESHOLD:
            return Answer("adequate", p_value=None)
        # Class 0 is "no effect".
        effect_classes = [int(i) for i in np.argsort(-probabilities) if i != 0]
        min_probability = ALTERNATIVE_PROBABILITY_RATIO * float(probabilities[effect_classes[0]])
        named_classes = [i for i in effect_classes if probabilities[i] >= min_probability]
        if float(probabilities[named_classes].sum()) < MIN_NAMED_PROBABILITY:
            return Answer("unknown")
        most_probable, *alternatives = (classes[i] for i in named_classes)
        return Answer(
            "ambiguous" if alternatives else "named",
            (NamedCause(most_probable, tuple(alternatives)),),
        )


def _simulate_example(training_task: DiagnoserTrainingTask, name: str, number: int) -> Array | None:
    """Simulate one recording with an effect, as input of the network.

    Parameters, noise, inputs, channels, number and length of the runs are drawn, so that the
    network learns under varied conditions.

    Args:
        training_task: the training task.
        name: name of the effect; empty for none.
        number: number of the example, added to the random seed.

    Returns:
        The input of the network; None if the residual is above `TRAINING_RESIDUAL_RANGE`, or below
        it although there is an effect.

    Raises:
        SimulationBudgetExceededError: the budget is used up.
    """
    rng, kind = training_task.rng, training_task.kind
    system = kind.system
    low, high = _NOISE_RANGES[system.kind]
    sigma = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    # In SI units a rate is 5 times as noisy as a position, as in many cases of the benchmark.
    noise = {c.name: sigma * (5.0 if c.name in system.rates else 1.0) for c in kind.channels}
    effects = {name: _draw_coefficients(training_task, name)} if name else {}
    parameters = {p.name: float(rng.uniform(*p.training_range)) for p in system.parameters}
    channels = [c.name for c in kind.channels if not c.name.startswith("accel")]
    default_recording = system.usual_recording
    observe = list(default_recording.observe) or (
        channels if rng.random() < ALL_CHANNELS_SHARE else channels[:1]
    )
    inputs = dict(default_recording.inputs)
    # A servo keeps its usual input, and half of the rotary systems are not driven.
    if kind.inputs and not system.servo and (system.kind != "rotary" or rng.random() < 0.5):
        inputs[kind.inputs[0].name] = _draw_input_text(system.kind == "rotary", rng)
    specification = SimulationSpec(
        system=kind.name,
        parameters=parameters,
        effects=effects,
        noise={channel: noise[channel] for channel in observe},
        inputs=inputs,
        observe=tuple(observe),
        runs=int(rng.integers(3, 6)),
        seconds=float(rng.choice([2.0, 3.0, 4.0, 5.0])),
        rate=float(rng.choice([50, 100])),
        engine="batch",
        seed=int(rng.integers(1 << 31)) + number,
        force=True,  # without a check of the machine's resources
    )
    image, residual_rms = _compute_network_input(kind, simulate_recording(specification).recording)
    min_residual, max_residual = TRAINING_RESIDUAL_RANGE
    # An effect must be visible above the noise; without an effect the residual is noise alone.
    is_visible = not name or residual_rms >= min_residual
    return image if is_visible and residual_rms <= max_residual else None


def _draw_input_text(is_rotary: bool, rng: np.random.Generator) -> str:
    """Draw an input signal for a training example, as the text of a `SimulationSpec`.

    The text has the form, the amplitude, and the duration of a step in s or frequencies in Hz, such
    as ``sine:2:0.5``.

    Args:
        is_rotary: whether the input is a torque (N m) and not a force (N).
        rng: random generator of the training.
    """
    forms = ("steps:{size}:{duration}", "sine:{size}:{frequency}", "chirp:{size}:0.3:{frequency}")
    size = rng.uniform(0.05, 0.2) if is_rotary else rng.uniform(0.5, 4.0)
    # A form uses only some of the numbers, but all are drawn.
    return str(rng.choice(forms)).format(
        size=f"{size:.3g}",
        duration=f"{rng.uniform(0.25, 1.0):.3g}",
        frequency=f"{rng.uniform(0.3, 2.5):.3g}",
    )


def _draw_coefficients(training_task: DiagnoserTrainingTask, name: str) -> tuple[float, ...]:
    """Draw coefficients of an effect for a training example.

    The magnitude of the first coefficient, the size, is drawn log-uniformly from 0.3 to 100 % of
    its upper bound, that of the others uniformly from 10 to 100 %. The sign is random if the lower
    bound is negative. The negative values of asymmetric bounds, such as those of a delay, may lie
    below the lower bound. Coefficients with a positive lower bound, such as a period, are drawn
    log-uniformly between their bounds.

    Args:
        training_task: simulator, library and random numbers of the training.
        name: name of the effect, with its place on a robot: ``drag.linear@elbow``.

    Returns:
        Coefficients in the order of the effect.
    """
    rng = training_task.rng
    values = []
    for index, parameter in enumerate(
        make_effect_parameters(training_task.library[name], training_task.kind.system)
    ):
        low, high = parameter.bounds
        if low > 0:
            values.append(float(np.exp(rng.uniform(np.log(low), np.log(high)))))
            continue
        # The first coefficient scales the effect and may be small; the others only modify it.
        share = 10 ** rng.uniform(-2.5, 0.0) if index == 0 else rng.uniform(0.1, 1.0)
        sign = rng.choice([-1.0, 1.0]) if low < 0 else 1.0
        values.append(float(sign * share * high))
    return tuple(values)


def _compute_network_input(
    kind: type[SystemSimulator], recording: Recording
) -> tuple[Array, float]:
    """Compute the network's input from a recording.

    Each run is resampled to `GRID_POINT_COUNT` points. The F rows are, for the C channels of the
    simulator and its I inputs (those that are not recorded remain zero):

    * 0 to C - 1: residual of the fitted base model in units of the noise (arcsinh, clipped),
    * C to 2C - 1: simulated motion, standardised,
    * 2C to 3C - 1: 1 if the channel is recorded,
    * 3C to 3C + I - 1: inputs, divided by their maximum,
    * last: logarithm of the duration.

    Args:
        kind: simulator class.
        recording: recorded runs, with their channels, inputs and constants.

    Returns:
        Input of the network, (R, F, `GRID_POINT_COUNT`) for R runs and F rows, and the RMS of the
        residuals in units of the noise.
    """
    # The base model is fitted to all runs, without any effect.
    with closing(
        RunEvaluator(kind, recording, list(recording.runs), "batch", candidates=())
    ) as evaluator:
        noise = NoiseModel.make_white(compute_noise_floor(evaluator, recording).sigma)
        fit = fit_base_model(evaluator, noise).fit
        residual = (evaluator.observed - fit.simulated) / noise.sigma
        rms = float(np.sqrt(np.nanmean(np.square(residual))))
        names = [channel.name for channel in kind.channels]
        inputs = [channel.name for channel in kind.inputs]
        # First rows of the motion, of the marks of recorded channels, and of the inputs.
        first_motion_row, first_mark_row, first_input_row = (k * len(names) for k in (1, 2, 3))
        row_count = first_input_row + len(inputs) + 1
        image = np.zeros((len(evaluator.prepared_runs), row_count, GRID_POINT_COUNT))
        grid = np.linspace(0.0, 1.0, GRID_POINT_COUNT)
        for run_index, run_data in enumerate(evaluator.prepared_runs):
            size = int(evaluator.lengths[run_index])
            relative_times = np.linspace(0.0, 1.0, size)
            for recorded_index, name in enumerate(evaluator.channels):
                channel_index = names.index(name)
                is_recorded = np.isfinite(residual[run_index, :size, recorded_index])
                clipped_residual = np.clip(
                    np.nan_to_num(residual[run_index, :size, recorded_index]),
                    -_RESIDUAL_CLIP,
                    _RESIDUAL_CLIP,
                )
                image[run_index, channel_index] = np.arcsinh(
                    np.interp(grid, relative_times[is_recorded], clipped_residual[is_recorded])
                )
                motion = fit.simulated[run_index, :size, recorded_index]
                spread = float(motion.std()) or 1.0  # 1 if the channel does not move
                image[run_index, first_motion_row + channel_index] = np.interp(
                    grid, relative_times, (motion - motion.mean()) / spread
                )
                image[run_index, first_mark_row + channel_index] = 1.0
            for input_index, name in enumerate(inputs):
                signal = np.asarray(run_data.scenario.inputs.get(name, np.zeros(size)))[:size]
                peak = float(np.abs(signal).max()) or 1.0  # 1 without input
                image[run_index, first_input_row + input_index] = np.interp(
                    grid, relative_times, signal / peak
                )
            image[run_index, -1] = np.log(run_data.duration)
    return np.nan_to_num(image), rms


def _make_network(features: int, classes: int) -> Any:
    """Make the network: convolutions over a run, mean over runs, and dense layers.

    A run has F rows of resampled signals; the mean over the runs makes the answer independent of
    their order.

    Args:
        features: number of channels of the input, F.
        classes: number of classes: no effect, and each effect of the library.
    """
    import torch
    from torch import nn

    class Network(nn.Module):
        """Network described in this module."""

        def __init__(self) -> None:
            """Make the layers: `run` reads each run, `decide` scores the classes.

            Two pooling layers reduce the time grid to a quarter. Mean and maximum over time give
            two numbers for each channel, therefore `decide` has twice the layer width as input.
            """
            super().__init__()
            self.run = nn.Sequential(
                nn.Conv1d(features, LAYER_WIDTH, 5, padding=2),
                nn.ReLU(),
                nn.MaxPool1d(2),
                nn.Conv1d(LAYER_WIDTH, LAYER_WIDTH, 5, padding=2),
                nn.ReLU(),
                nn.MaxPool1d(2),
                nn.Conv1d(LAYER_WIDTH, LAYER_WIDTH, 3, padding=1),
                nn.ReLU(),
            )
            self.decide = nn.Sequential(
                nn.Linear(2 * LAYER_WIDTH, 2 * LAYER_WIDTH),
                nn.ReLU(),
                nn.Dropout(DROPOUT),
                nn.Linear(2 * LAYER_WIDTH, classes),
            )

        def forward(self, images: Any, weights: Any) -> Any:
            """Compute the class scores of B recordings from their R runs each.

            Args:
                images: inputs, (B, R, F, GRID_POINT_COUNT).
                weights: 1 for runs that exist, otherwise 0, (B, R).

            Returns:
                Logits, (B, classes).
            """
            batch, runs = images.shape[:2]
            features = self.run(images.flatten(0, 1))  # (B R, LAYER_WIDTH, time)
            features = torch.cat([features.mean(dim=2), features.amax(dim=2)], dim=1)
            features = features.reshape(batch, runs, -1) * weights[..., None]
            # Mean over the runs that exist.
            return self.decide(features.sum(dim=1) / weights.sum(dim=1, keepdim=True))

    return Network()


def _stack_with_mask(images: Sequence[Array]) -> tuple[Any, Any]:
    """Stack inputs with different numbers of runs into one tensor, filled up with zeros.

    Args:
        images: inputs of B recordings, each (R, F, GRID_POINT_COUNT) with its own number of runs R.

    Returns:
        Inputs (B, largest R, F, GRID_POINT_COUNT), and weights (B, largest R) that are 1 for runs
        that exist.
    """
    import torch

    max_runs = max(len(image) for image in images)
    stacked = np.zeros((len(images), max_runs, *images[0].shape[1:]), dtype=np.float32)
    mask = np.zeros((len(images), max_runs), dtype=np.float32)
    for row, weights, image in zip(stacked, mask, images, strict=True):
        row[: len(image)] = image
        weights[: len(image)] = 1.0
    return torch.from_numpy(stacked), torch.from_numpy(mask)


def _train_network(
    images: Sequence[Array], labels: Array, classes: int, seed: int
) -> dict[str, Array]:
    """Train the network with Adam, and return the weights with the best validation loss.

    The loss is the cross entropy. The first `VALIDATION_SHARE` of the examples are not trained on.

    Args:
        images: inputs of E examples, each (R, F, GRID_POINT_COUNT) with R runs and F rows of
            resampled signals.
        labels: index of the class of each example, (E,).
        classes: number of classes.
        seed: seed of initial weights, order of the examples and dropout.

    Returns:
        Weights by the name of the layer.
    """
    import torch
    from torch.nn.functional import cross_entropy

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _make_network(images[0].shape[1], classes)
        inputs, weights = _stack_with_mask(images)
        targets = torch.from_numpy(labels.astype(np.int64))
        split = max(1, round(VALIDATION_SHARE * len(labels)))
        validation, training = slice(0, split), np.arange(split, len(labels))
        optimiser = torch.optim.Adam(
            network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY
        )
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, TRAINING_EPOCHS)
        best, state = np.inf, network.state_dict()  # validation loss and its weights
        for _ in range(TRAINING_EPOCHS):
            network.train()
            order = training[torch.randperm(len(training)).numpy()]
            for part in np.array_split(order, max(1, len(order) // BATCH_SIZE)):
                optimiser.zero_grad()
                loss = cross_entropy(network(inputs[part], weights[part]), targets[part])
                loss.backward()  # type: ignore[no-untyped-call]
                optimiser.step()
            schedule.step()
            network.eval()
            with torch.no_grad():
                validation_loss = float(
                    cross_entropy(
                        network(inputs[validation], weights[validation]), targets[validation]
                    )
                )
            if validation_loss < best:
                best = validation_loss
                state = {name: array.clone() for name, array in network.state_dict().items()}
    return {name: tensor.numpy() for name, tensor in state.items()}


def _predict_probabilities(
    trained_arrays: Mapping[str, Array], image: Array, classes: int
) -> Array:
    """Compute the class probabilities of one recording, (classes,).

    Args:
        trained_arrays: trained weights by the name of the layer.
        image: input of the network, (R, F, GRID_POINT_COUNT), with R runs and F rows of resampled
            signals.
        classes: number of classes: no effect, and each effect of the library.
    """
    import torch

    # Creating the network draws random weights; the global random generator is restored.
    with torch.random.fork_rng(devices=[]):
        network = _make_network(image.shape[1], classes)
    network.load_state_dict(
        {name: torch.from_numpy(np.array(array)) for name, array in trained_arrays.items()}
    )
    network.eval()
    inputs, weights = _stack_with_mask([image])
    with torch.no_grad():
        probabilities: Array = (
            torch.softmax(network(inputs, weights)[0], dim=0).numpy().astype(np.float64)
        )
    return probabilities
