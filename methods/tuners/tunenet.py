"""TuneNet: residual tuning, Allevato et al., CoRL 2019, arXiv 1907.11200, Eq. 1 and Algorithm 1.

A network h estimates the difference of parameters from two observations, o_P of the proposed
simulation and o_T of the target. Algorithm 1 repeats

    (1)  zeta_k = zeta_{k-1} + h(o_P, o_T)

which stops at a root of h as a function of zeta, wherever that is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from methods.learning.broyden_search import MIN_STEP, BroydenSearch
from methods.learning.input_features import FeatureConfig
from methods.learning.pair_network import PUBLISHED_DESIGN, PairNetworkDesign, PairTuner
from methods.tuner import Proposal, Task, TunerGenerator


@dataclass(eq=False)
class TuneNet(PairTuner):
    """Network that estimates the parameter difference from two observations.

    It is trained on pairs of simulations, and recommends its newest guess.

    The default differs from the published method in the input features
    (`learning.input_features`), in the training (`pair_network.PairNetworkDesign`), in h(o, o) = 0
    by construction, and in the step: it solves h = 0 by Broyden's method (in one dimension the
    secant method, `methods.learning.broyden_search`), whose first step is (1). This converges also
    if the network's scale is wrong, as outside its training range.

    Attributes:
        scenarios: training scenarios, at most as many as the budget allows.
        each: simulations in each scenario, at least 2 (dim + 1); every two of them are a training
            pair.
        points: points to which each run is resampled; L in Algorithm 1.
        inputs: maximum number of features of an observation.
        strictness: see `methods.learning.input_features.make_weighted_features`.
        noise: sensor noise in the training of a second network, 1 sigma, in units of each channel's
            standard deviation in training; it is used if the target is rougher than the
            simulations. 0 for no second network.
        epochs: passes over the training data.
        rate: learning rate at the beginning.
        weight_decay: lambda in Eq. 1.
        told: read also what is known of the scenario, if scenarios differ in it.
        channels: first and last channel that is read, by number, if targets do not show the
            others; None for all.
        clean: whether targets may be as clean as simulations. False for a sensor whose errors last
            for many samples: a smooth target need not be clean then, and there is one network,
            trained with `noise`.
        broyden: solve h = 0 by Broyden's method; False for the steps of Algorithm 1.
    """

    name: ClassVar[str] = "tunenet"

    scenarios: int = 100
    each: int = 8
    points: int = 400
    inputs: int = 400
    strictness: float = 1000.0
    noise: float = 0.01
    epochs: int = 300
    rate: float = 3e-3
    weight_decay: float = 1e-5
    told: bool = True
    channels: tuple[int, int] | None = None
    clean: bool = True
    broyden: bool = True

    def make_network_design(self) -> PairNetworkDesign:
        """Return the design of the network."""
        return PairNetworkDesign(epochs=self.epochs, rate=self.rate, weight_decay=self.weight_decay)

    def choose_training_layout(self, dim: int) -> tuple[int, int]:
        """Return the maximum number of training scenarios and the number of simulations in each."""
        return self.scenarios, max(self.each, 2 * (dim + 1))

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Run Algorithm 1, with one simulation per iteration.

        Each guess is the last one plus the network's estimate of the difference to the target (1),
        or a step of Broyden's method with `broyden`, which ends when the guess no longer
        changes.

        Args:
            task: task of the target.
            rng: not used.
        """
        estimate = self.get_trained_network().select_for(task).make_estimator(task)
        search = BroydenSearch(task)
        guess = task.start
        while True:
            evaluation = yield Proposal(guess, recommend=guess)
            point = evaluation.proposals[0]
            residual = estimate(evaluation.observations)
            if self.broyden:
                guess = search.propose_next(point, residual)
                if np.abs(guess - search.best).max() <= MIN_STEP:
                    return "the estimate no longer changes"
            else:
                # This is (1); a failed simulation gives no information, and its point is repeated.
                guess = np.clip(point + np.nan_to_num(residual), 0.0, 1.0)


@dataclass(eq=False)
class TuneNetPublished(PairTuner):
    """TuneNet as published: network, training, data and steps of the authors' code.

    Attributes:
        points: points to which each run is resampled; L in Algorithm 1.
    """

    name: ClassVar[str] = "tunenet-published"
    known_failures: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("check_easy_problem_is_improved", "check_beats_random_search"),
        "240 training simulations in raw units are too few "
        "for 200 epochs of plain gradient descent",
    )

    points: int = 400

    def make_network_design(self) -> PairNetworkDesign:
        """Return the published design of the network."""
        return PUBLISHED_DESIGN

    def make_feature_config(self) -> FeatureConfig:
        """Return the configuration of the inputs."""
        return FeatureConfig(self.points, noise=0.0, raw=True)

    def choose_training_layout(self, dim: int) -> tuple[int, int]:  # noqa: ARG002 (the contract's signature)
        """Return the maximum number of training scenarios and the number of simulations in each."""
        return 800, 2

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:  # noqa: ARG002
        """Run Algorithm 1; guesses are limited to non-negative values only, as published.

        Each step is zeta_k = zeta_{k-1} + h(o_P, o_T) (1), with the network h, the observation o_P
        of the proposed simulation and o_T of the target.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: unused; the method is deterministic.
        """
        estimate = self.get_trained_network().select_for(task).make_estimator(task)
        guess = task.start
        while True:
            evaluation = yield Proposal(guess, recommend=guess)
            residual = np.nan_to_num(estimate(evaluation.observations))
            guess = np.maximum(evaluation.proposals[0] + residual, 0.0)  # (1)
