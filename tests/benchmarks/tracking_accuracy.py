"""Measure the error and the speed of the tracker on rendered drops.

Errors are given by the distance of the camera and by the speed of the ball. Run with
``OMP_NUM_THREADS=1 python -m tests.benchmarks.tracking_accuracy --out DIR``; writes table.csv,
drops.csv and a figure. The reference is the projection of the ball's centre through the camera
model. Every drop has its own published camera, light, colours, noise and compression, and is read
from a compressed video file.
"""

from __future__ import annotations

import argparse
import tempfile
from itertools import pairwise
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd

from sims.core.simulator import InputError, Scenario
from sims.systems.ball import Ball
from sims.vision.ball_renderer import BallScene, SceneAppearance
from sims.vision.ball_tracker import track_ball
from sims.vision.pinhole_camera import PinholeCamera
from sims.vision.video_files import VideoFile, write_video

RATE = 60.0
BINS = {"range [m]": [5, 7, 8.5, 10, 13], "speed [px/frame]": [0, 0.5, 1, 2, 4]}


def one(seed, folder, count):
    """Return a row for each of `count` frames of one drop, and a summary with frames per second."""
    times = np.arange(count) / RATE
    rng = np.random.default_rng([7, seed])
    camera, look = PinholeCamera.draw_published(rng), SceneAppearance.draw(rng)
    ball, z0 = Ball(observe=["z"], engine="batch"), rng.uniform(4, 5)
    z = ball.simulate(np.array([[rng.uniform(0.3, 0.9)]]), Scenario(times, {"z": z0}))[0, :, 0]
    points = np.stack([0 * z, 0 * z, z], axis=1)
    write_video(
        folder / f"{seed}.mp4",
        BallScene(camera, look, 0.5, rng).render_frames(points),
        times,
        look.crf,
    )
    truth = camera.project(points)
    reach = np.sqrt(camera.project_sphere(points, 0.5)[1].prod(axis=-1, keepdims=True))
    whole = ((truth > reach) & (truth < 99 - reach)).all(axis=1)
    begun = process_time()
    try:
        found = track_ball(VideoFile(folder / f"{seed}.mp4"))
        pixels, notes = np.stack([found.u, found.v], axis=1), " | ".join(found.notes)
    except InputError as error:
        pixels, notes = np.full(truth.shape, np.nan), str(error)
    seconds = process_time() - begun
    frames = {
        "seed": seed, "error": np.linalg.norm(pixels - truth, axis=1), "whole": whole,
        "range [m]": np.linalg.norm(points - camera.position, axis=1),
        "speed [px/frame]": np.linalg.norm(np.gradient(truth, axis=0), axis=1),
    }  # fmt: skip
    return pd.DataFrame(frames), {
        "seed": seed,
        "crf": look.crf,
        "frames_per_second": len(z) / seconds,
        "notes": notes,
    }


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values)))) if np.isfinite(values).any() else np.nan


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--drops", type=int, default=24)
    parser.add_argument(
        "--frames",
        type=int,
        default=120,
        help="120 end while most balls bounce, 400 after all rest",
    )
    parser.add_argument("--out", type=Path, default=Path("results/tracker"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        parts, drops = zip(
            *(one(seed, Path(folder), options.frames) for seed in range(options.drops)), strict=True
        )
    frames = pd.concat(parts)
    by_drop = frames.groupby("seed")["error"].agg(rms=rms, worst="max").reset_index()
    by_drop["missed"] = (
        frames[frames.whole].groupby("seed")["error"].apply(lambda e: float(e.isna().mean())).values
    )
    by_drop = by_drop.merge(pd.DataFrame(drops), on="seed")
    by_drop.to_csv(options.out / "drops.csv", index=False, float_format="%.4g")
    rows = [("all", "", frames)]
    for name, edges in BINS.items():
        labels = [f"{low:g} to {high:g}" for low, high in pairwise(edges)]
        groups = frames.groupby(
            pd.cut(frames[name], edges, include_lowest=True, labels=labels), observed=True
        )
        rows += [(name, str(interval), part) for interval, part in groups]
    table = pd.DataFrame(
        {
            "by": by, "bin": interval, "drops": part.seed.nunique(),
            "frames": int(part.error.notna().sum()),
            "rms_px": rms(part.error), "median_px": float(part.error.median()),
            "p95_px": float(part.error.quantile(0.95)),
            "missed_of_whole_balls": float(part.error[part.whole].isna().mean()),
        }
        for by, interval, part in rows
    )  # fmt: skip
    table.to_csv(options.out / "table.csv", index=False, float_format="%.4g")
    draw(table, by_drop, options.out, options.frames)
    print(table.to_string(index=False))
    print(by_drop.drop(columns="notes").describe().to_string())


def draw(table, drops, folder, count):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained", sharey=True)
    for axis, name in zip(axes, BINS, strict=False):
        part = table[table.by == name]
        places = np.arange(len(part))
        axis.bar(places, part.rms_px, color="#0072B2", width=0.6, label="RMS")
        axis.plot(places, part.median_px, "o", color="black", label="median")
        axis.set_xticks(
            places,
            [f"{b}\n{n} frames" for b, n in zip(part.bin, part.frames, strict=True)],
            fontsize=7,
        )
        axis.set_xlabel(name)
    axes[2].plot(
        np.arange(1, len(drops) + 1), np.sort(drops.rms), "o-", color="#0072B2", markersize=4
    )
    axes[2].set_xlabel(f"{len(drops)} drops, sorted by RMS")
    for axis in axes:
        axis.axhline(0.5, color="black", linestyle="--", linewidth=0.8)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("distance from the true centre [px]")
    axes[0].legend(frameon=False, fontsize=8)
    told = f"films of {count} frames, 100 × 100 px, compressed; dashed: 0.5 px"
    figure.suptitle(f"Tracked ball against the renderer's reference; {told}", fontsize=10)
    figure.savefig(folder / "accuracy.png", dpi=140)
    figure.savefig(folder / "accuracy.pdf", metadata={"CreationDate": None})


if __name__ == "__main__":
    main()
