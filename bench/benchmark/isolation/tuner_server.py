"""Server in an isolated process: builds a tuner, and executes the requests of the harness.

The harness cannot trust this process once a plugin's code runs in it. Everything that counts for
the results is counted on the harness's side of the pipe.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from bench.benchmark.isolation.cpu_affinity import set_processor
from bench.benchmark.isolation.isolation_layers import AccessPolicy
from bench.benchmark.isolation.message_channel import (
    EVALUATION_SIMULATOR_FLAG,
    MAX_HARNESS_MESSAGE_BYTES,
    MAX_TEXT_BYTES,
    SIMULATE_FLAG,
    Message,
    MessageChannel,
    MessageKind,
    PeerClosedError,
    decode_rng_state,
    encode_rng_state,
    pack_arrays,
    to_points,
    unpack_arrays,
)
from methods.tuner import (
    Array,
    BudgetExceededError,
    Evaluation,
    Proposal,
    ScenarioInfo,
    Task,
    TrainingSimulator,
    Tuner,
    TunerGenerator,
)


def serve_requests(channel: MessageChannel, policy: AccessPolicy, active_layers: list[str]) -> None:
    """Serve requests until the harness closes the channel; the harness is the process that scores.

    First the active isolation layers are reported. An error in the tuner's code is reported and
    ends its run, but not this process.

    Args:
        channel: channel to the harness.
        policy: folder and files that this process may access.
        active_layers: names of the active isolation layers.
    """
    channel.send_document(MessageKind.READY, active_layers)
    # NumPy was preloaded, so code that uses its global generator would get the same numbers in each
    # run.
    np.random.seed()  # noqa: NPY002
    with suppress(PeerClosedError):
        tuner = None
        reported_paths: set[str] = set()
        while True:
            message = channel.receive(MAX_HARNESS_MESSAGE_BYTES)
            if message.kind == MessageKind.WRITTEN_FILES:
                _report_written_files(channel, policy.folder, reported_paths)
                continue
            try:
                tuner = _handle_message(channel, message, tuner)
            except PeerClosedError:
                return
            except BaseException:
                # This includes SystemExit: it comes from the tuner and ends its run.
                _report_failure(channel, traceback.format_exc())


def _report_written_files(channel: MessageChannel, folder: str, reported_paths: set[str]) -> None:
    """Report files that the tuner has written since the last report.

    Hidden files and compiled Python files are left out, because libraries write them and they are
    not needed.

    Args:
        channel: channel to the parent process.
        folder: folder of the tuner.
        reported_paths: paths that were reported, extended in place.
    """
    # The number of files is limited, which bounds the time. If a tuner writes more of them, some
    # are never reported.
    first_files = islice(_iterate_written_files(folder), _MAX_COUNTED_FILES)
    new_files = [path for path in first_files if path not in reported_paths]
    reported_paths.update(new_files)
    # A note names at most three files.
    names = [os.path.relpath(path, folder) for path in sorted(new_files)[:3]]
    channel.send_document(MessageKind.WRITTEN_FILES, {"count": len(new_files), "names": names})


_MAX_COUNTED_FILES = 10_000
"""Maximum number of files that are counted."""


def _iterate_written_files(folder: str) -> Iterator[str]:
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if name[0] != "." and name != "__pycache__"]
        yield from (os.path.join(parent, name) for name in files if name[0] != ".")


def _report_failure(channel: MessageChannel, text: str) -> None:
    """Report a failure; a long text is cut to its end, which has the error.

    Args:
        channel: channel to the parent process.
        text: traceback or message.
    """
    channel.send(MessageKind.FAILURE, text.encode("utf-8", "replace")[-MAX_TEXT_BYTES // 2 :])


def _handle_message(channel: MessageChannel, message: Message, tuner: Tuner | None) -> Tuner | None:
    """Execute the request of one message, and return the present tuner.

    A request builds a tuner, loads its weights, runs it on a task, or trains it. A message of
    another kind is ignored.

    Args:
        channel: Channel to the harness.
        message: Request of the harness.
        tuner: Tuner that was built before; None before the first request.

    Returns:
        The new tuner after a request to build one, otherwise `tuner`.
    """
    if message.kind == MessageKind.BUILD:
        description = message.to_document()
        tuner = load_class(description)(**description["options"])
        channel.send(MessageKind.DONE)
    elif tuner is None:
        raise RuntimeError("a request came before the tuner was built")
    elif message.kind == MessageKind.WEIGHTS:
        tuner.restore(unpack_arrays(message.body))
        channel.send(MessageKind.DONE)
    elif message.kind == MessageKind.TASK:
        _run_tuner(channel, message, tuner)
    elif message.kind == MessageKind.FIT:
        _train_tuner(channel, message, tuner)
    return tuner


def load_class(description: dict[str, Any], base: type[Any] = Tuner) -> type[Any]:
    """Import the file or module of a tuner or another plugin, and find its class by its name.

    Args:
        description: ``name`` of the class, and its ``file`` or ``module``.
        base: required base class.

    Raises:
        ImportError: the class is not there any more.
    """
    module = (
        _load_plugin_file(description["file"])
        if description["file"]
        else importlib.import_module(description["module"])
    )
    for value in vars(module).values():
        if (
            inspect.isclass(value)
            and issubclass(value, base)
            and getattr(value, "name", "") == description["name"]
        ):
            return value
    raise ImportError(
        f"{description['file'] or description['module']} has no {base.__name__.lower()} "
        f"{description['name']}"
    )


def _load_plugin_file(path: str) -> Any:
    """Execute a plugin file as a module, and return the module.

    Args:
        path: Path of a Python file that defines a tuner.

    Returns:
        The module, named after the file with the prefix `simgap_plugin_`.
    """
    stem = os.path.splitext(os.path.basename(path))[0]
    spec = importlib.util.spec_from_file_location(f"simgap_plugin_{stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up their module when they are made.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def make_generator(arrays: dict[str, NDArray[Any]]) -> np.random.Generator:
    """Return the random generator of the run; see `bench.core.random_streams`."""
    return np.random.default_rng(arrays["stream"].astype(np.uint32))


def _run_tuner(channel: MessageChannel, message: Message, tuner: Tuner) -> None:
    """Run the tuner on the task of a message, and exchange its proposals for evaluations.

    Its last message says how the run ended: "stopped" with the tuner's reason, or "done" after the
    harness closed the run.

    Args:
        channel: Channel to the harness.
        message: The task: start point, observed signals, scales of the channels, training range,
            budget of simulations, and lengths of the runs in samples.
        tuner: Tuner to run.
    """
    arrays = unpack_arrays(message.body)
    task = Task(
        dim=arrays["start"].size,
        start=arrays["start"],
        observed=arrays["observed"],
        scale=arrays["scale"],
        training=arrays["training"],
        budget=int(arrays["budget"]),
        lengths=tuple(arrays["lengths"].tolist()),
        scene=ScenarioInfo(arrays["initial"], arrays["inputs"]),
    )
    steps = tuner.tune(task, make_generator(arrays))
    try:
        _exchange_evaluations(channel, steps, task)
    # The generator's return value is the tuner's reason for stopping.
    except StopIteration as stop:
        reason = str(stop.value or "the tuner stopped")
        channel.send(MessageKind.STOPPED, reason.encode("utf-8", "replace")[: MAX_TEXT_BYTES // 2])
    # The harness closed the run, for example because the budget is used up.
    except GeneratorExit:
        steps.close()
        channel.send(MessageKind.DONE)


def _exchange_evaluations(channel: MessageChannel, steps: TunerGenerator, task: Task) -> NoReturn:
    """Send proposals to the harness, and evaluations to the tuner, until one of them ends the run.

    A message with proposals contains the recommended point, if the tuner states one, and the points
    to simulate. The answer, an evaluation, contains n points as they were simulated, their n
    losses, and their observations, one after the other. Any other answer ends the run.

    Args:
        channel: message channel to the harness.
        steps: generator of the tuner, which yields proposals.
        task: task of the target.

    Raises:
        StopIteration: the tuner stopped.
        GeneratorExit: the harness ends the run.
        Exception: the tuner failed.
    """
    dim, used_simulations = task.dim, 0
    length, channels = task.observed.shape
    proposal = next(steps)
    while True:
        recommendation: bytes | Array = b""
        if type(proposal) is Proposal:
            proposal, recommend = proposal
            if recommend is not None:
                recommendation = to_points(recommend, dim, "recommendations")[0]
        points = to_points(proposal, dim, "proposals")
        # One point beyond the budget is enough for the harness to see that the budget is exceeded.
        points = points[: max(task.budget - used_simulations, 0) + 1]
        channel.send(
            MessageKind.PROPOSALS,
            recommendation,
            points,
            flags=len(recommendation) > 0,
            size=len(points),
        )
        answer = channel.receive(MAX_HARNESS_MESSAGE_BYTES)
        if answer.kind != MessageKind.EVALUATION:
            raise GeneratorExit
        # The flags say on which processor to run, see `cpu_affinity.AffinityController`.
        if answer.flags:
            set_processor(answer.flags)
        numbers, point_count = answer.to_array(), answer.size
        used_simulations += point_count
        # Positions in `numbers`, which has the points, then the losses, then the observations.
        losses_start = point_count * dim
        observations_start = losses_start + point_count
        proposals = numbers[:losses_start].reshape(point_count, dim)
        losses = numbers[losses_start:observations_start]
        observations = numbers[observations_start:].reshape(point_count, length, channels)
        proposals.setflags(write=False)
        losses.setflags(write=False)
        proposal = steps.send(Evaluation(proposals, observations, losses))


class _RemoteTrainingSimulator:
    """Training simulator of a learned tuner, which simulates on the harness's side of the pipe."""

    def __init__(self, channel: MessageChannel, which: int) -> None:
        """Request the properties of a simulator.

        Args:
            channel: channel to the harness, which has the simulators.
            which: 0 for the simulator for training, or `EVALUATION_SIMULATOR_FLAG`.
        """
        self._channel, self._which = channel, which
        channel.send(MessageKind.TRAINING_REQUEST, flags=which)
        self._read_properties(channel.receive(MAX_HARNESS_MESSAGE_BYTES))

    def _read_properties(self, answer: Message) -> dict[str, NDArray[Any]]:
        """Store the properties of the training simulator from an answer, and return its arrays.

        Every answer contains these properties. `used` and `budget` are the numbers of simulations
        so far and allowed. A refusal by the harness is raised here as the exception that a local
        simulator would raise.
        """
        if answer.kind == MessageKind.REFUSAL:
            refusal = answer.to_document()
            error_types = {"budget": BudgetExceededError, "value": ValueError}
            raise error_types.get(refusal["kind"], RuntimeError)(refusal["says"])
        arrays = unpack_arrays(answer.body)
        self.training, self.scale = arrays["training"], arrays["scale"]
        self.dim = self.training.shape[1]
        self.lengths = tuple(arrays["lengths"].tolist())
        self.scene = ScenarioInfo(arrays["initial"], arrays["inputs"])
        self.used, self.budget = arrays["counts"].tolist()
        return arrays

    def sample(self, rng: np.random.Generator, n: int) -> Array:
        return rng.uniform(self.training[0], self.training[1], size=(n, self.dim))

    def simulate(self, rng: np.random.Generator, points: Array) -> Array:
        """Simulate points with the harness; see `methods.tuner.TrainingSimulator.simulate`.

        The state of the random generator travels with the request, because the harness draws
        scenarios and noise from it; the advanced state comes back, so that a training has the same
        random numbers as in the harness's process.

        Args:
            rng: random generator.
            points: (n, dim) points of the unit cube.

        Returns:
            Observations (n, T, C) of T samples and C channels.
        """
        state = rng.bit_generator.state
        is_sendable = state["bit_generator"] == "PCG64"
        # Only the state of a PCG64 generator can be sent. One of another type seeds a new one.
        rng_state = (
            state if is_sendable else np.random.PCG64(rng.integers(0, 1 << 62, 4).tolist()).state
        )
        requested = np.array(points, dtype=np.float64).reshape(-1, self.dim)
        request = pack_arrays({"rng": encode_rng_state(rng_state), "points": requested})
        self._channel.send(
            MessageKind.TRAINING_REQUEST, *request, flags=SIMULATE_FLAG | self._which
        )
        arrays = self._read_properties(self._channel.receive(MAX_HARNESS_MESSAGE_BYTES))
        if is_sendable:
            rng.bit_generator.state = decode_rng_state(arrays["rng"])
        return arrays["observations"]


class _RemoteTrainingCallback:
    """Training callback that reports progress to the harness."""

    def __init__(self, channel: MessageChannel) -> None:
        self._channel = channel

    @property
    def ground(self) -> TrainingSimulator:
        return _RemoteTrainingSimulator(self._channel, EVALUATION_SIMULATOR_FLAG)

    def epoch(self, stage: str, epoch: int, epochs: int, loss: float, held_out: float) -> None:
        report = [stage, epoch, epochs, float(loss), float(held_out)]
        self._channel.send_document(MessageKind.PROGRESS, report)
        self._channel.receive(MAX_HARNESS_MESSAGE_BYTES)


def _train_tuner(channel: MessageChannel, message: Message, tuner: Tuner) -> None:
    """Train the tuner on the harness's training simulator, and send its weights.

    Progress is reported to the harness if the flags of the message ask for it.

    Args:
        channel: Channel to the harness, which simulates.
        message: Request with the budget and the seed of the random generator.
        tuner: Tuner to train.
    """
    arrays = unpack_arrays(message.body)
    tuner.watch = _RemoteTrainingCallback(channel) if message.flags else None
    tuner.fit(_RemoteTrainingSimulator(channel, 0), make_generator(arrays), int(arrays["budget"]))
    tuner.watch = None
    channel.send(MessageKind.WEIGHTS, *pack_arrays(tuner.state()))
