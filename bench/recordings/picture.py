"""The picture of a track: where the ball was seen, over the scene, and its height over time."""

from __future__ import annotations

import io

import numpy as np

from bench.recordings.metres import Heights
from sims.camera.render import Image
from sims.camera.track import Track

_SEEN, _MISSING = "#0072B2", "#A03C00"
_SHOWN = 6


def drawn(track: Track, heights: Heights, part: slice, title: str) -> tuple[bytes, bytes]:
    """The picture as PNG and PDF."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.patches import Circle

    figure, (scene, above, below) = plt.subplots(
        1, 3, figsize=(13, 4.3), layout="constrained", gridspec_kw={"width_ratios": (1, 1.2, 1.2)}
    )
    scene.imshow(_overlaid(track), interpolation="nearest")
    scene.plot(track.u, track.v, "-", color="white", linewidth=2.4)
    scene.plot(track.u, track.v, ".-", color=_SEEN, linewidth=0.8, markersize=2.5)
    for k in _some(track):
        scene.add_patch(
            Circle(
                (track.u[k], track.v[k]), track.radius[k], fill=False, color="black", linewidth=1.6
            )
        )
        scene.add_patch(
            Circle(
                (track.u[k], track.v[k]), track.radius[k], fill=False, color="white", linewidth=0.8
            )
        )
    scene.set(xlabel="u [px]", ylabel="v [px]", title="the track; circles: outlines found")
    t, gone = track.times, ~np.isfinite(track.u)
    for axis, values, label in (
        (above, heights.z, "height of the centre z [m]"),
        (below, track.radius, "radius [px]"),
    ):
        axis.axvspan(t[part][0], t[part][-1], color="#EEEEEE", linewidth=0)
        axis.plot(t, values, ".-", color=_SEEN, markersize=3, linewidth=0.7)
        axis.plot(
            t[gone],
            np.full(gone.sum(), 0.02),
            "|",
            color=_MISSING,
            markersize=7,
            transform=axis.get_xaxis_transform(),
        )
        axis.set(xlabel="time [s]", ylabel=label)
        axis.spines[["top", "right"]].set_visible(False)
    above.axhline(heights.radius, color="black", linewidth=0.6, linestyle=":")
    above.set_title("dotted: ball on the ground", fontsize=9)
    below.set_title("grey: recorded; marks at the foot: no ball seen", fontsize=9)
    figure.suptitle(
        f"{title}\n{int((~gone).sum())} of {len(t)} frames", parse_math=False, fontsize=10
    )
    png, pdf = io.BytesIO(), io.BytesIO()
    figure.savefig(png, format="png", dpi=140)
    figure.savefig(pdf, format="pdf", metadata={"CreationDate": None})
    plt.close(figure)
    return png.getvalue(), pdf.getvalue()


def _some(track: Track) -> list[int]:
    """Numbers of a few kept frames with the ball, spread over its way."""
    seen = [k for k in track.seen.tolist() if k % 1 == 0]
    way = np.concatenate(
        [[0.0], np.cumsum(np.hypot(np.diff(track.u[seen]), np.diff(track.v[seen])))]
    )
    return [
        seen[i]
        for i in np.unique(
            np.searchsorted(way, np.linspace(0, way[-1], _SHOWN)).clip(0, len(seen) - 1)
        )
    ]


def _overlaid(track: Track) -> Image:
    """The background with the balls of a few frames in it."""
    picture = track.background.copy()
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    for k, frame in track.pictures.items():
        if 0 <= k < len(track.u) and np.isfinite(track.u[k]):
            ball = np.hypot(u - track.u[k], v - track.v[k]) <= track.radius[k]
            picture[ball] = frame[ball]
    return picture
