"""Neural posterior estimation: a normalising flow learns p(parameters | observation).

Sources: G. Papamakarios, I. Murray, Fast ε-free inference of simulation models with Bayesian
conditional density estimation, NeurIPS 2016, arXiv 1605.06376; D. Greenberg, M. Nonnenmacher, J.
Macke, Automatic posterior transformation for likelihood-free inference, ICML 2019, arXiv
1905.07488; the flow: G. Papamakarios, T. Pavlakou, I. Murray, Masked autoregressive flow for
density estimation, NeurIPS 2017, arXiv 1705.07057. Built and trained by the optional package `sbi`
(JOSS 5(52), 2020, doi:10.21105/joss.02505): pip install -e ".[npe]".

With θ drawn uniformly from the training range and o simulated from it, the flow q of weights w is
trained by

    (1)  the minimum over w of the mean of -log q_w(θ | o)

whose minimum over all densities is the posterior p(θ | o).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from methods.learning.input_features import FeatureConfig, InputFeatures
from methods.learning.library_isolation import NullTracker, isolated_library_call
from methods.learning.training_data import generate_training_data
from methods.tuner import Array, Proposal, Task, TrainingSimulator, Tuner, TunerGenerator


@dataclass(eq=False)
class NeuralPosteriorEstimation(Tuner):
    """Neural posterior estimation; recommends the posterior mean, then the best sample.

    It simulates the mean of the learned posterior, then samples from it, and keeps the lowest loss.
    It reads the input features of the target alone (`learning.input_features`).

    Attributes:
        scenarios: training scenarios, at most as many as the budget allows.
        each: simulations in each scenario, at least 2 (dim + 1).
        points: points to which each run is resampled.
        inputs: maximum number of features of an observation.
        strictness: see `methods.learning.input_features.make_weighted_features`.
        noise: sensor noise of every second training observation, 1 sigma, in units of each
            channel's standard deviation in training.
        hidden: units of each layer of the flow.
        transforms: autoregressive layers of the flow.
        epochs: maximum number of passes over the training data; training stops when the held-out
            loss no longer falls.
        draws: posterior samples behind the mean.
        told: as in `methods.tuners.tunenet.TuneNet`.
    """

    name: ClassVar[str] = "npe"
    requires: ClassVar[tuple[str, ...]] = ("torch", "sbi")
    learned: ClassVar[bool] = True

    scenarios: int = 400
    each: int = 4
    points: int = 400
    inputs: int = 100
    strictness: float = 100.0
    noise: float = 0.01
    hidden: int = 50
    transforms: int = 5
    epochs: int = 300
    draws: int = 1000
    told: bool = True
    _flow: Any = field(default=None, init=False, repr=False)
    _features: InputFeatures | None = field(default=None, init=False, repr=False)

    def fit(self, simulator: TrainingSimulator, rng: np.random.Generator, budget: int) -> None:
        """Train on at most `budget` simulations of the training range.

        Args:
            simulator: training simulator.
            rng: random generator.
            budget: maximum number of simulations.

        Raises:
            ValueError: the budget is smaller than two scenarios.
        """
        dim = simulator.dim
        points_per_scenario = max(self.each, 2 * (dim + 1))
        training_data = generate_training_data(
            simulator, rng, budget, self.scenarios, points_per_scenario
        )
        noisy_data = training_data.with_noise(
            self.noise * training_data.flattened_observations.std(axis=(0, 1)), rng
        )
        self._features = features = InputFeatures.fit(training_data, self._make_feature_config())
        # Each simulation is used twice, with and without noise, because targets may be of either
        # kind.
        feature_rows = np.concatenate(
            [
                features.compute_rows(part).reshape(-1, features.feature_count)
                for part in (training_data, noisy_data)
            ]
        )
        theta = np.tile(training_data.parameters.reshape(-1, dim), (2, 1))
        with isolated_library_call(rng):
            from sbi import inference

            trainer = inference.NPE(
                density_estimator=self._make_flow_builder(),
                tracker=NullTracker(),
                show_progress_bars=False,
            )
            trainer.append_simulations(_to_tensor(theta), _to_tensor(feature_rows))
            # Minimises the mean of -log q(parameters | inputs) of the flow's density q, until this
            # loss no longer decreases on the rows that sbi holds out.
            self._flow = trainer.train(
                max_num_epochs=self.epochs,
                training_batch_size=min(100, len(feature_rows) // 4),
            )

    def _make_feature_config(self) -> FeatureConfig:
        return FeatureConfig(
            self.points, self.inputs, self.strictness, use_scenario_features=self.told
        )

    def _make_flow_builder(self) -> Callable[[Any, Any], Any]:
        """Return sbi's function that builds the network: a masked autoregressive flow (MAF).

        It is called with the training parameters and inputs, from which it takes sizes and scales.
        """
        from sbi.neural_nets import posterior_nn

        builder: Callable[[Any, Any], Any] = posterior_nn(
            "maf",
            hidden_features=self.hidden,
            num_transforms=self.transforms,
        )
        return builder

    def state(self) -> dict[str, Array]:
        """Return the flow's tensors and the input features by name; empty before `fit`."""
        if self._features is None:
            return {}
        tensors = {
            f"flow.{name}": np.array(t.numpy()) for name, t in self._flow.state_dict().items()
        }
        return tensors | self._features.to_arrays()

    def restore(self, state: dict[str, Array]) -> None:
        """Restore the arrays that `state` returned.

        Raises:
            ValueError: arrays have other names or shapes, or numbers that are not finite.
        """
        flow_arrays = {name: array for name, array in state.items() if name.startswith("flow.")}
        feature_arrays = {name: array for name, array in state.items() if name not in flow_arrays}
        features, foreign = InputFeatures.from_arrays(feature_arrays, self._make_feature_config())
        not_finite = [name for name, array in flow_arrays.items() if not np.isfinite(array).all()]
        if foreign or not_finite:
            name, *_ = *foreign, *not_finite  # the first one is reported
            raise ValueError(f"array {name}: expected an array of the flow, of finite numbers")
        self._flow = self._rebuild_flow(
            {name.removeprefix("flow."): array for name, array in flow_arrays.items()},
            features.feature_count,
        )
        self._features = features

    def _rebuild_flow(self, arrays: dict[str, Array], inputs: int) -> Any:
        """Rebuild the trained normalising flow from its arrays, such as those of a weights file.

        The number of parameters follows from the arrays.

        Args:
            arrays: arrays of the flow, by sbi's names.
            inputs: number of input features.

        Raises:
            ValueError: the arrays are not those of a flow of the default design.
        """
        import torch

        # The first transform shifts each parameter.
        sizes = {
            array.size for name, array in arrays.items() if name.endswith("_transforms.0._shift")
        }
        dim = sizes.pop() if sizes else 0
        # A damaged file could state any number, and a flow of this size would be built.
        if not 0 < dim < 1000:
            raise ValueError("expected the arrays of a flow, found others")
        rng = np.random.default_rng(0)
        with isolated_library_call(rng):
            # sbi takes the sizes from example data; the scaling is part of the tensors.
            theta = _to_tensor(rng.standard_normal((4, dim)))
            rows = _to_tensor(rng.standard_normal((4, inputs)))
            flow = self._make_flow_builder()(theta, rows)
            try:
                flow.load_state_dict(
                    {name: torch.from_numpy(np.array(array)) for name, array in arrays.items()}
                )
            except (RuntimeError, TypeError) as error:
                raise ValueError(
                    f"expected the arrays of a flow: {' '.join(str(error).split())[:200]}"
                ) from None
        return flow

    def tune(self, task: Task, rng: np.random.Generator) -> TunerGenerator:
        """Propose the mean of the posterior, then samples of it.

        Args:
            task: start, observations, number of parameters and budget of the run.
            rng: random numbers of the run.
        """
        if self._features is None:
            raise RuntimeError("npe has not been trained; call fit or restore first")
        row = self._features(task.observed[None], task.lengths, task.scene)
        with isolated_library_call(rng):
            count = max(self.draws, task.budget)
            samples = self._flow.sample((count,), condition=_to_tensor(row))
            raw = samples.detach()[:, 0].numpy()
        # A flow has mass outside the range of its training, and may overflow far from it.
        draws = np.clip(np.nan_to_num(raw.astype(np.float64), nan=0.5), 0.0, 1.0)
        mean = draws.mean(axis=0)
        yield Proposal(mean, recommend=mean)
        for point in draws:
            yield point[None]
        return "all posterior samples are used"


def _to_tensor(array: Array) -> Any:
    import torch

    return torch.as_tensor(array, dtype=torch.float32)
