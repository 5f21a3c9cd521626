"""Find out why TuneNet on vision puts a ball's restitution at its bound in an extended model.

The ball is a table-tennis ball, and explain extended the model. The study also shows which training
avoids the error. The shots of a folder of bounce shots are tuned again, each in its extended model,
by networks with other training data. The reference is explain's own fit of the same model.

    simgap compare AIR.toml --targets 20 --salt public --out results/air     # balls: table-tennis
    python -m tests.benchmarks.vision_error_bound results/air OUT.csv
"""

import json
import sys
from pathlib import Path

import pandas as pd

from bench.benchmark.problem.experiment_config import TunerEntry, load_experiment
from bench.benchmark.runner.tuner_training import TrainingRequest, train_or_load
from bench.bounce_shot import drop_tuning
from bench.bounce_shot.shot_config import read_shot_config
from sims.core.files import write_atomically
from sims.recording.recording import read_recording
from sims.systems.ball import Ball

VISION = "tunenet-vision"
SEEDS = 3
BOUND = 0.9999
TO_ONE = {"restitution": {"training": [0.3, 1.0]}}
DRAG = {"drag.quadratic": (0.0, 0.2)}
FOUND = {
    "drag.quadratic": {"drag.quadratic": [0.16]},
    "drag.quadratic restitution.speed": {
        "drag.quadratic": [0.14],
        "restitution.speed": [-0.07],
    },
}
"""Effects that explain found for a shot, with typical coefficients."""
TRAINED = {
    "as published": {},
    "over drag": {"nuisance": DRAG},
    "over drag, range to 1": {"nuisance": DRAG, "parameters": TO_ONE},
    "in the extended simulator, range to 1": {"parameters": TO_ONE},
}


def grounds(base, changes, entry):
    """Yield (effects of the shots, training experiment); the effects are None for all shots."""
    # Select all at once, because a randomised entry needs its effects.
    base = base.chosen(**TRAINED[changes], tuners=(entry,))
    if "extended" not in changes:
        yield None, base
        return
    for effects, fixed in FOUND.items():
        settings = {**base.settings, "fixed": fixed}
        yield effects, base.chosen(settings=settings)


def tuned(experiment, folder, shot, entry, weights, effects):
    """Return the restitution that a network finds in the extended model of one shot."""
    path = folder / "recordings" / f"{shot}.csv"
    known = drop_tuning.ShotInputs(shot, path, None, {VISION: weights})
    recording = read_recording(path, Ball, whole=True)
    model = drop_tuning._tune_model(
        experiment, read_shot_config(experiment), entry, known, recording, effects
    )
    assert model.status in ("done", "converged"), model.reason
    return model.restitution


def rows(folder, base):
    """Yield a row for each training, seed and shot."""
    shots = pd.read_csv(folder / "shots.csv")
    own = shots[shots.method == drop_tuning.EXPLAIN_METHOD].set_index("shot")
    for trained in TRAINED:
        entry = TunerEntry(VISION, VISION, randomised="over drag" in trained)
        for found, ground in grounds(base, trained, entry):
            before = drop_tuning.make_tuning_experiment(ground, read_shot_config(ground), entry)
            # The tuned simulator is that of the shot, independent of the training of the network.
            plain = ground.chosen(settings=base.settings)
            for seed in range(SEEDS):
                weights = train_or_load(before, TrainingRequest(entry, seed)).path
                for shot, fit in own.restitution.items():
                    models = json.loads((folder / "shots" / f"{shot}.json").read_text())["models"]
                    explained = next(m for m in models if m["method"] == drop_tuning.EXPLAIN_METHOD)
                    effects = {name: tuple(c) for name, c in explained["effects"].items()}
                    names = " ".join(sorted(effects))
                    if found in (None, names):
                        value = tuned(plain, folder, shot, entry, weights, effects)
                        yield {
                            "trained": trained,
                            "seed": seed,
                            "shot": shot,
                            "effects": names,
                            "restitution": value,
                            "explained": fit,
                        }


if __name__ == "__main__":
    folder, out = map(Path, sys.argv[1:])
    base = load_experiment("bounce-shot")
    shot = {**base.shot, "balls": ["table-tennis"], "rows": [VISION]}
    base = base.chosen(trusted=True, shot=shot)
    frame = pd.DataFrame(rows(folder, base))
    write_atomically(out, frame.to_csv(index=False, float_format="%.5g"))
    off = (frame.restitution - frame.explained).abs()
    frame = frame.assign(off=off, bound=frame.restitution >= BOUND)
    by = frame.groupby(["trained", "effects"], sort=False)
    print(by.agg(shots=("off", "size"), off=("off", "mean"), bound=("bound", "sum")).to_string())
