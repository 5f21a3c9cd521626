"""A learned classifier: a network that has seen simulated recordings with every effect of the
library, and names the class of a new one.

Amortised inference, as tuners that learn have it (A. Allevato et al., TuneNet, CoRL 2019): all
simulations are spent before a recording is seen, and an answer costs a base fit alone. The network
sees of each run the residual of the base fit in units of the noise, with the motion and the inputs
beside it, on a fixed grid; convolutions read a run, the mean over runs makes their order and number
irrelevant. Classes are the library's effects, and nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from itertools import count
from typing import Any, ClassVar

import numpy as np

from bench.diagnoser import Answer, Case, Diagnoser, Lesson, Named
from bench.gap.model.base_fit import fit_base
from bench.gap.model.floor import noise_floor
from bench.gap.model.noise import Noise
from bench.gap.model.world import World
from bench.recordings.simulate import Wish, make
from sims.base import Array, InputError
from sims.effects import library as library_of
from sims.recording.recording import Recording
from sims.simulated import Simulated, effect_parameters
from sims.tally import SpentError

POINTS = 64
"""Of the grid over a run."""
WIDTH = 48
"""Of the network's layers."""
EPOCHS = 60
"""Through all examples."""
BATCH = 64
"""Recordings a step."""
CLEAN = 0.25
"""Share of examples with nothing hidden."""
SHOWN = (1.15, 20.0)
"""RMS of the base fit's residual in units of the noise of examples that are learned from."""
FEWEST = 8
"""Examples without which nothing is learned."""
ALARM = 0.05
"""Probability of nothing below which something is missing."""
SHARE = 0.4
"""Of the most probable effect's probability, from which another one stands beside it."""
SURE = 0.25
"""Probability of all that is named below which it is unknown."""
HELD_OUT = 0.15
"""Share of the examples by which the epoch is chosen."""
_CLIPPED = 30.0
"""Noises beyond which a residual is one."""
_NOISES = {"point": (2e-3, 2e-2), "linear": (1e-3, 1e-2), "rotary": (1e-3, 1e-2)}
"""Of the first channel, by kind of system, SI units."""


class Classifier(Diagnoser):
    """A network trained on simulated effects; it names the most probable ones (torch)."""

    name = "classifier"
    learned: ClassVar[bool] = True

    def cannot(self, kind: type[Simulated]) -> str:
        """It learns a system before anybody shows it a recording, or a model file."""
        return "nobody knows a robot's file before it is asked" if kind.has_model else ""

    def train(self, lesson: Lesson) -> Mapping[str, Array]:
        """Simulate recordings until the budget is spent, and fit the network."""
        classes = ["", *sorted(lesson.library)]
        images, labels = [], []
        for number in count():
            name = "" if lesson.rng.random() < CLEAN else str(lesson.rng.choice(classes[1:]))
            try:
                image = _example(lesson, name, number)
            except SpentError:
                break
            except InputError:
                continue  # a wish that cannot be simulated
            if image is not None:
                images.append(image)
                labels.append(classes.index(name))
        if len(labels) < FEWEST:
            return {}
        return _fitted(images, np.array(labels), len(classes), int(lesson.rng.integers(1 << 31)))

    def diagnose(self, case: Case) -> Answer:
        """What the network takes it for."""
        if not case.learned:
            return Answer("unidentifiable")
        classes = ["", *sorted(library_of(case.kind.system))]
        image, _ = _image(case.kind, case.recording)
        odds = _asked(case.learned, image, len(classes))
        # What the recording's signals cannot show is not asked.
        possible = np.array([not name or name in case.library for name in classes])
        odds = np.where(possible, odds, 0.0)
        odds = odds / odds.sum()
        nothing = float(odds[0])
        if nothing >= ALARM:
            return Answer("adequate", p_value=None)
        order = [int(i) for i in np.argsort(-odds) if i]
        top = float(odds[order[0]])
        named = [i for i in order if odds[i] >= SHARE * top]
        if float(odds[named].sum()) < SURE:
            return Answer("unknown")
        first, *others = (classes[i] for i in named)
        return Answer("ambiguous" if others else "named", (Named(first, tuple(others)),))


def _example(lesson: Lesson, name: str, number: int) -> Array | None:
    """One simulated recording with an effect, as the network sees it; None where it does not show.

    Raises:
        SpentError: the budget is spent.
    """
    rng, kind = lesson.rng, lesson.kind
    system = kind.system
    low, high = _NOISES[system.kind]
    sigma = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    noise = {c.name: sigma * (5.0 if c.name in system.rates else 1.0) for c in kind.channels}
    effects = {name: _coefficients(lesson, name)} if name else {}
    parameters = {p.name: float(rng.uniform(*p.training_range)) for p in system.parameters}
    channels = [c.name for c in kind.channels if not c.name.startswith("accel")]
    usual = system.usual_recording
    observe = list(usual.observe) or (channels if rng.random() < 0.4 else channels[:1])
    forms = ("steps:{a}:{b}", "sine:{a}:{c}", "chirp:{a}:0.3:{c}")
    inputs = dict(usual.inputs)
    if kind.inputs and not system.servo and (system.kind != "rotary" or rng.random() < 0.5):
        size = rng.uniform(0.05, 0.2) if system.kind == "rotary" else rng.uniform(0.5, 4.0)
        text = str(rng.choice(forms)).format(
            a=f"{size:.3g}", b=f"{rng.uniform(0.25, 1.0):.3g}", c=f"{rng.uniform(0.3, 2.5):.3g}"
        )
        inputs[kind.inputs[0].name] = text
    wish = Wish(
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
        force=True,
    )
    image, left = _image(kind, make(wish).recording)
    shown = SHOWN[0] <= left <= SHOWN[1] if name else left <= SHOWN[1]
    return image if shown else None


def _coefficients(lesson: Lesson, name: str) -> tuple[float, ...]:
    """Sizes drawn over decades of what is plausible, shapes evenly on their range."""
    rng = lesson.rng
    values = []
    for place, parameter in enumerate(effect_parameters(lesson.library[name], lesson.kind.system)):
        low, high = parameter.bounds
        if low > 0:
            values.append(float(np.exp(rng.uniform(np.log(low), np.log(high)))))
            continue
        # What scales an effect may be small; what only modifies it is not.
        share = 10 ** rng.uniform(-2.5, 0.0) if place == 0 else rng.uniform(0.1, 1.0)
        sign = rng.choice([-1.0, 1.0]) if low < 0 else 1.0
        values.append(float(sign * share * high))
    return tuple(values)


def _image(kind: type[Simulated], recording: Recording) -> tuple[Array, float]:
    """(R, F, POINTS) of the runs: residuals in noises, motion, inputs, whether a channel is there;
    and the RMS of the residuals.
    """
    with closing(World(kind, recording, list(recording.runs), "batch", candidates=())) as world:
        noise = Noise(noise_floor(world, recording).sigma, np.zeros(len(world.channels)))
        fit = fit_base(world, noise).fit
        left = (world.observed - fit.simulated) / noise.sigma
        rms = float(np.sqrt(np.nanmean(np.square(left))))
        names = [c.name for c in kind.channels]
        inputs = [c.name for c in kind.inputs]
        image = np.zeros((len(world.tracks), 3 * len(names) + len(inputs) + 1, POINTS))
        grid = np.linspace(0.0, 1.0, POINTS)
        for r, track in enumerate(world.tracks):
            size = int(world.lengths[r])
            clock = np.linspace(0.0, 1.0, size)
            for c, name in enumerate(world.channels):
                place = names.index(name)
                seen = np.isfinite(left[r, :size, c])
                path = np.clip(np.nan_to_num(left[r, :size, c]), -_CLIPPED, _CLIPPED)
                image[r, place] = np.arcsinh(np.interp(grid, clock[seen], path[seen]))
                motion = fit.simulated[r, :size, c]
                spread = float(motion.std()) or 1.0
                image[r, len(names) + place] = np.interp(
                    grid, clock, (motion - motion.mean()) / spread
                )
                image[r, 2 * len(names) + place] = 1.0
            for i, name in enumerate(inputs):
                signal = np.asarray(track.scenario.inputs.get(name, np.zeros(size)))[:size]
                spread = float(np.abs(signal).max()) or 1.0
                image[r, 3 * len(names) + i] = np.interp(grid, clock, signal / spread)
            image[r, -1] = np.log(track.seconds)
    return np.nan_to_num(image), rms


def _network(features: int, classes: int) -> Any:
    """Convolutions over a run, the mean over runs, and a decision."""
    import torch
    from torch import nn

    class Network(nn.Module):
        """See this module."""

        def __init__(self) -> None:
            super().__init__()
            self.run = nn.Sequential(
                nn.Conv1d(features, WIDTH, 5, padding=2),
                nn.ReLU(),
                nn.MaxPool1d(2),
                nn.Conv1d(WIDTH, WIDTH, 5, padding=2),
                nn.ReLU(),
                nn.MaxPool1d(2),
                nn.Conv1d(WIDTH, WIDTH, 3, padding=1),
                nn.ReLU(),
            )
            self.decide = nn.Sequential(
                nn.Linear(2 * WIDTH, 2 * WIDTH),
                nn.ReLU(),
                nn.Dropout(0.2),
                nn.Linear(2 * WIDTH, classes),
            )

        def forward(self, images: Any, weights: Any) -> Any:
            """Log odds (B, classes) of images (B, R, F, POINTS), runs weighed by (B, R)."""
            batch, runs = images.shape[:2]
            read = self.run(images.flatten(0, 1))
            read = torch.cat([read.mean(dim=2), read.amax(dim=2)], dim=1)
            read = read.reshape(batch, runs, -1) * weights[..., None]
            return self.decide(read.sum(dim=1) / weights.sum(dim=1, keepdim=True))

    return Network()


def _stacked(images: Sequence[Array]) -> tuple[Any, Any]:
    """Images of different numbers of runs as one tensor, and which runs there are."""
    import torch

    most = max(len(image) for image in images)
    whole = np.zeros((len(images), most, *images[0].shape[1:]), dtype=np.float32)
    there = np.zeros((len(images), most), dtype=np.float32)
    for row, weights, image in zip(whole, there, images, strict=True):
        row[: len(image)] = image
        weights[: len(image)] = 1.0
    return torch.from_numpy(whole), torch.from_numpy(there)


def _fitted(images: Sequence[Array], labels: Array, classes: int, seed: int) -> dict[str, Array]:
    """The network's weights, those of the epoch that did best on examples that it did not see."""
    import torch
    from torch.nn.functional import cross_entropy

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _network(images[0].shape[1], classes)
        inputs, weights = _stacked(images)
        wanted = torch.from_numpy(labels.astype(np.int64))
        split = max(1, round(HELD_OUT * len(labels)))
        kept, seen = slice(0, split), np.arange(split, len(labels))
        optimiser = torch.optim.Adam(network.parameters(), lr=2e-3, weight_decay=1e-4)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, EPOCHS)
        best, state = np.inf, network.state_dict()
        for _ in range(EPOCHS):
            network.train()
            order = seen[torch.randperm(len(seen)).numpy()]
            for part in np.array_split(order, max(1, len(order) // BATCH)):
                optimiser.zero_grad()
                loss = cross_entropy(network(inputs[part], weights[part]), wanted[part])
                loss.backward()  # type: ignore[no-untyped-call]
                optimiser.step()
            schedule.step()
            network.eval()
            with torch.no_grad():
                lost = float(cross_entropy(network(inputs[kept], weights[kept]), wanted[kept]))
            if lost < best:
                best, state = lost, {k: v.clone() for k, v in network.state_dict().items()}
    return {name: tensor.numpy() for name, tensor in state.items()}


def _asked(learned: Mapping[str, Array], image: Array, classes: int) -> Array:
    """(classes,) probabilities."""
    import torch

    # weights drawn at random for a moment, and from nobody's generator
    with torch.random.fork_rng(devices=[]):
        network = _network(image.shape[1], classes)
    network.load_state_dict({k: torch.from_numpy(np.array(v)) for k, v in learned.items()})
    network.eval()
    inputs, weights = _stacked([image])
    with torch.no_grad():
        odds: Array = torch.softmax(network(inputs, weights)[0], dim=0).numpy().astype(np.float64)
    return odds
