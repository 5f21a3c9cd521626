"""Study of what limits the published TuneNet, step by step: ``python -m
tests.benchmarks.tunenet_study [--out DIR]``.

On the published bouncing ball (`ball-drop`), the published network and training are changed one
item at a time until they are this project's, and each item is then removed from this project's
version. Further parts are sensor noise, an ensemble and its uncertainty, and the cost of training
and of one iteration. Writes tables (CSV) and figures; docs/tunenet.md explains them.
"""

import argparse
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from bench.benchmark.problem.experiment_config import load_experiment
from bench.benchmark.problem.targets import draw_targets
from bench.benchmark.problem.training_simulator import CountedTrainingSimulator
from bench.benchmark.problem.tuning_problem import ProposalEvaluator, TuningProblem
from bench.benchmark.runner.tuner_loop import drive_tuner
from bench.core.random_streams import make_rng
from bench.figures.figure_layout import make_panel_grid
from bench.figures.figure_output import write_figure
from bench.figures.style import BLACK, BLUE, CONNECTOR_GREY, ORANGE, VERMILION
from methods.learning.broyden_search import MIN_STEP, BroydenSearch
from methods.learning.input_features import FeatureConfig
from methods.learning.pair_network import (
    PUBLISHED_DESIGN,
    PairNetworkDesign,
    PairTuner,
    TrainedPairNetwork,
)
from methods.learning.training_data import generate_training_data
from methods.tuner import EMPTY_SCENE, Proposal, Task
from methods.tuners.tunenet import TuneNet, TuneNetPublished

AT = (1, 2, 3, 5, 10)
SEEDS, TARGETS, MEMBERS = 2, 100, 5
NOISE = 0.01
"""Sensor noise of the targets with noise, m."""
OURS = PairNetworkDesign(epochs=300)
RAW, WEIGHED = FeatureConfig(noise=0.0, raw=True), FeatureConfig(noise=0.0)


@dataclass(eq=False)
class Variant(PairTuner):
    """A network with its input features, training data and step.

    `spread` is the number of training scenarios and of simulations in each.
    """

    name = "variant"
    description: str = ""
    built: PairNetworkDesign = OURS
    reads: FeatureConfig = WEIGHED
    spread: tuple[int, int] = (100, 8)
    step: str = "broyden"
    members: list[TrainedPairNetwork] = field(default_factory=list)

    def make_network_design(self):
        return self.built

    def make_feature_config(self):
        return self.reads

    def estimator(self, task):
        if not self.members:
            return self.get_trained_network().select_for(task).make_estimator(task)
        each = [m.make_estimator(task) for m in self.members]
        return lambda seen: np.mean([estimate(seen) for estimate in each], axis=0)

    def tune(self, task, rng):
        estimate, search, guess = self.estimator(task), BroydenSearch(task), task.start
        while True:
            seen = yield Proposal(guess, recommend=guess)
            difference = estimate(seen.observations)
            if self.step == "broyden":
                guess = search.propose_next(seen.proposals[0], difference)
                if np.abs(guess - search.best).max() <= MIN_STEP:
                    return "the estimate no longer changes"
            else:
                guess = np.clip(seen.proposals[0] + difference, 0.0, 1.0)


def path():
    """Return the variants from the published network to this project's; changes are cumulative."""
    sgd = replace(PUBLISHED_DESIGN)
    linear = replace(sgd, bounded=False)
    adam = replace(linear, adam=True, rate=3e-3, weight_decay=1e-5, epochs=300, batch=10)
    pairs = replace(adam)
    relative = replace(pairs, relative=0.02)
    zero = replace(relative, antisymmetric=True)
    smooth = replace(zero, smooth=True)
    return [
        Variant("published", sgd, RAW, (800, 2), "plain"),
        Variant("+ linear output", linear, RAW, (800, 2), "plain"),
        Variant("+ Adam, batches of 10, 300 epochs", adam, RAW, (800, 2), "plain"),
        Variant("+ 28 pairs a scenario", pairs, RAW, (100, 8), "plain"),
        Variant("+ loss relative to the difference", relative, RAW, (100, 8), "plain"),
        Variant("+ h(o, o) = 0", zero, RAW, (100, 8), "plain"),
        Variant("+ smooth units", smooth, RAW, (100, 8), "plain"),
        Variant("+ inputs chosen and scaled", smooth, WEIGHED, (100, 8), "plain"),
        Variant("+ Broyden's step = tunenet", OURS, WEIGHED, (100, 8), "broyden"),
    ]


def without():
    """Return variants of this project's network with one item removed."""
    sgd = {
        "adam": False,
        "rate": 0.1,
        "batch": 50,
        "epochs": 200,
        "weight_decay": PUBLISHED_DESIGN.weight_decay,
    }
    return [
        Variant("tunenet, tanh at the output", replace(OURS, bounded=True)),
        Variant("tunenet, plain SGD as published", replace(OURS, **sgd)),
        Variant("tunenet, batches of 50", replace(OURS, batch=50)),
        Variant("tunenet, one pair a scenario", OURS, WEIGHED, (400, 2)),
        Variant("tunenet, loss in plain squares", replace(OURS, relative=0.0)),
        Variant("tunenet, h(o, o) not 0", replace(OURS, antisymmetric=False)),
        Variant("tunenet, rectified units", replace(OURS, smooth=False)),
        Variant("tunenet, raw inputs", OURS, RAW),
        Variant("tunenet, Algorithm 1's step", OURS, WEIGHED, step="plain"),
        Variant(
            "published, 1000 epochs", replace(PUBLISHED_DESIGN, epochs=1000), RAW, (800, 2), "plain"
        ),
        Variant(
            "published, batches of 10", replace(PUBLISHED_DESIGN, batch=10), RAW, (800, 2), "plain"
        ),
    ]


class Study:
    """Targets and training simulations, which are made once."""

    def __init__(self, targets=TARGETS):
        self.problem = TuningProblem(load_experiment("ball-drop").chosen(targets=targets))
        self.targets = draw_targets(self.problem)
        self._data = {}

    def data(self, spread, seed):
        if (spread, seed) not in self._data:
            practice, rng = (
                CountedTrainingSimulator(self.problem, 1600),
                make_rng("tunenet study", *spread, seed),
            )
            self._data[spread, seed] = generate_training_data(practice, rng, 1600, *spread)
        return self._data[spread, seed]

    def train(self, variant, seed):
        begin = time.perf_counter()
        variant.train_on(
            self.data(variant.spread, seed), make_rng("tunenet study", variant.description, seed)
        )
        return time.perf_counter() - begin

    def errors(self, tuner, budget=10, noise=0.0):
        """Return absolute errors, and the seconds of the tuner for each simulation.

        Errors have one row per target and one column per simulation.
        """
        rows, seconds = [], []
        for target in self.targets:
            sealed, side = target.blinded, target.blinded.fitting
            observed = side.observed + noise * make_rng("noise", sealed.name).standard_normal(
                side.observed.shape
            )
            cube = self.problem.cube
            task = Task(
                1,
                sealed.start,
                observed,
                self.problem.scale,
                cube.training,
                budget,
                (len(observed),),
            )
            trace = drive_tuner(
                tuner, task, ProposalEvaluator(self.problem, side), make_rng("study", sealed.name)
            )
            assert trace.status in ("done", "converged"), trace.reason
            error = np.abs(cube.to_physical(trace.recommendations) - target.truth)[:, 0]
            rows.append(np.append(error, np.full(budget + 1 - len(error), error[-1])))
            seconds += trace.tuner_seconds[1:].tolist()
        return np.array(rows), seconds

    def rows(self, what, tuners, noise=0.0, seconds=0.0):
        """Return rows of a table: mean errors of trained tuners, one per seed, by range."""
        found = np.mean([self.errors(tuner, noise=noise)[0] for tuner in tuners], axis=0)
        kinds = np.array([target.blinded.range for target in self.targets])
        for kind in ("in", "wide"):
            part = found[kinds == kind]
            means = {f"mean_{k}": part[:, k].mean() for k in AT} | {
                "median_3": np.median(part[:, 3])
            }
            yield {
                "variant": what,
                "range": kind,
                **means,
                "train_seconds": seconds,
                "targets": len(part),
            }


def ablation(study):
    """Return rows of all variants over all seeds, and the tuners of the first seed by name."""
    rows, kept = [], {}
    for variant in [*path(), *without()]:
        trained = [replace(variant, members=[]) for _ in range(SEEDS)]
        seconds = np.mean([study.train(tuner, seed) for seed, tuner in enumerate(trained)])
        kept[variant.description] = trained[0]
        rows += study.rows(variant.description, trained, seconds=seconds)
        print(*(f"{key} {value}" for key, value in rows[-1].items()), sep="  ", flush=True)
    return pd.DataFrame(rows), kept


def noisy(study, kept):
    """Return rows of targets with sensor noise."""
    both = Variant("tunenet, with a second network for noise", OURS, FeatureConfig(noise=0.01))
    study.train(both, 0)
    variants = [kept["published"], kept["+ Broyden's step = tunenet"], both]
    names = ["published", "tunenet, trained without noise", both.description]
    return pd.DataFrame(
        [r for n, v in zip(names, variants, strict=True) for r in study.rows(n, [v], noise=NOISE)]
    )


def ensemble(study):
    """Return rows of one network and of an ensemble, and the spread and error of its members."""
    data, members = study.data((100, 8), 0), []
    for seed in range(MEMBERS):
        one = Variant(f"member {seed}")
        one.train_on(data, make_rng("member", seed))
        members.append(one)
    rows = list(study.rows("one network (mean over members)", members))
    together = Variant(
        "mean of the members", members=[m.get_trained_network().clean for m in members]
    )
    rows += study.rows(f"{together.description} ({MEMBERS})", [together])
    spread = []
    for target in study.targets:
        side = target.blinded.fitting
        truth = study.problem.cube.to_unit_cube(target.truth)
        task = Task(1, target.blinded.start, side.observed, study.problem.scale,
        study.problem.cube.training, 1,
                    (len(side.observed),))  # fmt: skip
        seen = study.problem.simulate(target.blinded.start[None], side.scenarios)
        h = np.array(
            [
                m.get_trained_network().select_for(task).make_estimator(task)(seen)[0]
                for m in members
            ]
        )
        off = abs(h.mean() - (truth[0] - target.blinded.start[0]))
        spread.append((target.blinded.range, h.std(ddof=1), off))
    return pd.DataFrame(rows), pd.DataFrame(spread, columns=["range", "spread", "error"])


def cost(study):
    """Return seconds of a training as in `compare`, and of one iteration without its simulation."""
    rows = []
    for tuner in (TuneNet(), TuneNetPublished()):
        begin = time.perf_counter()
        tuner.fit(CountedTrainingSimulator(study.problem, 1600), make_rng("cost"), 1600)
        seconds = time.perf_counter() - begin
        each = study.errors(tuner)[1]
        rows.append((tuner.name, seconds, 1e3 * np.median(each), 1e3 * np.percentile(each, 95)))
    return pd.DataFrame(
        rows, columns=["tuner", "train_seconds", "iteration_ms_median", "iteration_ms_95"]
    )


def path_figure(table):
    names = [v.description for v in path()]
    figure, grid = make_panel_grid(1, 2, (10.0, 4.6), sharey=True)
    axes = grid[0]
    kinds = {"in": "Targets in the training range", "wide": "Targets anywhere"}
    curves = ((1, ORANGE, "s", ":"), (3, BLUE, "o", "-"), (10, BLACK, "^", "--"))
    for ax, (kind, title) in zip(axes, kinds.items(), strict=True):
        part = table[table["range"] == kind].set_index("variant").loc[names]
        for k, colour, marker, line in curves:
            shown = np.maximum(part[f"mean_{k}"].to_numpy(), 1e-12)
            label = f"after {k} simulation{'s' * (k > 1)}"
            ax.plot(shown, range(len(names)), marker=marker, color=colour, ls=line, label=label)
        ax.set(
            xscale="log",
            title=f"{title} ({part['targets'].iloc[0]})",
            xlabel="mean error of restitution [1]",
        )
        ax.grid(alpha=0.3)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    axes[0].legend(loc="upper left")
    figure.suptitle(
        f"From the published TuneNet, one change added after another ({SEEDS} trainings each)",
        fontsize=11,
    )
    return figure


def differences_figure(study, kept):
    figure, grid = make_panel_grid(1, 2, (9.0, 4.2), sharex=True, sharey=True)
    axes = grid[0]
    names = {
        "published": "Published network",
        "+ Broyden's step = tunenet": "This project's network",
    }
    rng, low, high = make_rng("differences"), *study.problem.cube.training[:, 0]
    points = rng.uniform(size=(400, 2))
    (scenario,) = study.problem.draw_scenarios(rng)
    seen = study.problem.simulate(points.reshape(-1, 1), (scenario,)).reshape(400, 2, -1, 1)
    inside = ((points > low) & (points < high)).all(axis=1)
    for ax, (key, title) in zip(axes, names.items(), strict=True):
        network = kept[key].get_trained_network().clean
        pairs = [network.features(seen[:, i], (seen.shape[2],), EMPTY_SCENE) for i in (0, 1)]
        h, true = network.predict_difference(*pairs)[:, 0], points[:, 1] - points[:, 0]
        ax.plot([-1, 1], [-1, 1], color=CONNECTOR_GREY, lw=1)
        ax.plot(
            true[~inside],
            h[~inside],
            "x",
            color=VERMILION,
            ms=4,
            label="one of them outside the training range",
        )
        ax.plot(true[inside], h[inside], "o", color=BLUE, ms=3, label="both in the training range")
        ax.set(title=title, xlabel="true difference of restitution [1]", ylim=(-1.5, 1.5))
        ax.grid(alpha=0.3)
    axes[0].set_ylabel("estimated difference [1]")
    axes[0].legend(loc="upper left", fontsize=8)
    figure.suptitle(
        "One estimate for each of 400 pairs of simulations, one drop height", fontsize=11
    )
    return figure


def spread_figure(spread):
    figure, grid = make_panel_grid(1, 1, (5.2, 4.2))
    ax = grid[0, 0]
    marks = (
        ("in", "o", BLUE, "targets in the training range"),
        ("wide", "x", VERMILION, "targets anywhere"),
    )
    for kind, marker, colour, label in marks:
        part = spread[spread["range"] == kind]
        ax.plot(
            part["spread"],
            part["error"],
            marker,
            color=colour,
            ms=4,
            label=f"{label} ({len(part)})",
        )
    line = np.array([spread["spread"].min(), spread["spread"].max()])
    ax.plot(line, line, color=CONNECTOR_GREY, label="error = spread")
    ax.set(
        xscale="log",
        yscale="log",
        xlabel="standard deviation over the members [1]",
        ylabel="error of their mean [1]",
    )
    ax.set_title(f"First estimate of {MEMBERS} networks", fontsize=11)
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
    return figure


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("results/tunenet-study"))
    parser.add_argument("--targets", type=int, default=TARGETS)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    study = Study(options.targets)
    table, kept = ablation(study)
    table.to_csv(options.out / "ablation.csv", index=False)
    members, spread = ensemble(study)
    for name, frame in (
        ("noise", noisy(study, kept)),
        ("ensemble", members),
        ("spread", spread),
        ("cost", cost(study)),
    ):
        frame.to_csv(options.out / f"{name}.csv", index=False)
        print(frame.to_string() if len(frame) < 20 else "", flush=True)
    for kind, part in spread.groupby("range"):
        ranks = part[["spread", "error"]].rank().corr().iloc[0, 1]
        within = (part["error"] <= 2.0 * part["spread"]).mean()
        ratio = (part["error"] / part["spread"]).median()
        print(
            f"{kind}: rank correlation {ranks:.2f}, within 2 spreads {within:.0%}, median "
            f"error/spread {ratio:.2g}"
        )
    write_figure(path_figure(table), options.out / "figures" / "path")
    write_figure(differences_figure(study, kept), options.out / "figures" / "differences")
    write_figure(spread_figure(spread), options.out / "figures" / "spread")


if __name__ == "__main__":
    main()
