"""Track a film: write the recording, its description, and a figure of the track."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.recordings import metres
from sims.ball.system import BallSystem
from sims.base import InputError, frozen
from sims.camera.files import beside, read_filmed
from sims.camera.track import Track, rough, track
from sims.camera.video import Video
from sims.limits import LENGTH
from sims.recording.recording import Recording, Run
from sims.recording.write import refuse_existing, write_recording

_DIGITS = 9
"""Number of significant digits in the table, finer than a pixel's noise."""


class Found(NamedTuple):
    """Result of tracking a film.

    Attributes:
        notes: Notes for the user, to be shown first.
        frames: Number of recorded frames.
        seen: Number of these frames that show the ball.
        how: Method by which heights in metres were found.
        noise_pixels: 1 sigma of one sample in pixels.
        noise: 1 sigma of a height in metres.
        lines: The result as text.
    """

    notes: tuple[str, ...]
    frames: int
    seen: int
    how: str
    noise_pixels: float
    noise: float
    lines: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return the result as a JSON document."""
        return {
            "frames": self.frames,
            "frames_with_ball": self.seen,
            "metres_from": self.how,
            "noise_pixels": self.noise_pixels,
            "noise_metres": self.noise,
            "notes": self.notes,
        }


Draw = Callable[[Track, metres.Heights, slice, str], tuple[bytes, bytes | None]]
"""Draws a track, its heights, the recorded frames and a title, as a PNG and a PDF or None."""


def write(
    video: Path,
    out: Path,
    draw: Draw,
    diameter: float | None = None,
    fps: float | None = None,
    scale: str | None = None,
    pdf: bool = False,
) -> Found:
    """Track `video`; write `out`, its description, and a figure of the track in the same folder.

    Args:
        video: Path of the film.
        out: Path NAME.csv of a new file.
        draw: Function that draws the figure, see `bench.figures.track.drawn`.
        diameter: Diameter of the ball, m.
        fps: Frames per second, instead of the file's time stamps.
        scale: "camera", "diameter" or "fall"; None for the best available one.
        pdf: Whether `draw` makes a PDF, too.

    Raises:
        InputError: The film cannot be tracked or the files cannot be written; one line.
    """
    if out.suffix != ".csv":
        raise InputError(f"{out}: expected a name that ends in .csv")
    pictures = [out.with_suffix(ending) for ending in (".png", ".pdf")]
    # Check this before the work, since tracking a film takes a while.
    refuse_existing([out, out.with_suffix(".toml"), *pictures[: 2 if pdf else 1]])
    if diameter is not None and not LENGTH[0] <= diameter <= LENGTH[1]:
        wanted = f"more than 0 m, from {LENGTH[0]:g} to {LENGTH[1]:g} m"
        raise InputError(f"ball diameter {diameter:g}: expected {wanted}")

    film = Video(video, fps)
    try:
        seen = track(film)
        heights = _heights(seen, video, diameter, scale)
    except InputError as error:
        # Some error messages already name the film, others do not.
        text = str(error)
        raise InputError(text if text.startswith(str(video)) else f"{video}: {text}") from None

    first, last = metres.released(seen), int(seen.seen[-1])
    part = slice(first, last + 1)
    notes = [*film.notes, *seen.notes, *heights.notes]
    if first > seen.seen[0]:
        until = f"the ball is held until {seen.times[first]:.2f} s"
        notes.append(f"{until}; what is before that is left out")
    noise = _noise(seen, heights, part)

    # The recording and its figures are published together, so that none exists without the others.
    drawn = draw(seen, heights, part, f"{video.name}: {heights.how}")
    shown = {
        path: content for path, content in zip(pictures, drawn, strict=True) if content is not None
    }
    recording = _recording(seen, heights, noise, part, video)
    write_recording(out, recording, BallSystem, digits=_DIGITS, beside=shown)

    count, frames = int(np.isfinite(heights.z[part]).sum()), part.stop - part.start
    lines = (
        f"{out}: {count} of {frames} frames with the ball, z in metres {heights.how}",
        f"noise of one sample: {seen.noise:.2g} px, {1e3 * noise:.2g} mm",
        f"{pictures[0]}: the track",
    )
    return Found(tuple(notes), frames, count, heights.how, float(seen.noise), noise, lines)


def _noise(seen: Track, heights: metres.Heights, part: slice) -> float:
    """Estimate 1 sigma of a height, m: the larger of the scatter of neighbours and of flights."""
    z = heights.z[part]
    noise = float(np.nanmax([rough(z), metres.scatter(seen.times[part], z), 0.0]))
    if noise > 0:
        return noise
    # A few frames give neither estimate: use the noise in pixels, scaled by the median radius.
    return seen.noise * heights.radius / float(np.nanmedian(seen.radius))


def _heights(seen: Track, video: Path, diameter: float | None, scale: str | None) -> metres.Heights:
    known = beside(video)
    if scale == "camera" or (scale is None and known.is_file()):
        return metres.by_camera(seen, read_filmed(known))
    if scale == "diameter" and diameter is None:
        raise InputError("scale diameter: expected the ball's diameter in metres")
    return metres.by_scale(seen, diameter, scale)


def _recording(
    seen: Track, heights: metres.Heights, noise: float, part: slice, video: Path
) -> Recording:
    pixels = {"u": seen.u, "v": seen.v, "radius_px": seen.radius}
    run = Run(
        "1",
        frozen(seen.times[part]),
        {"z": frozen(heights.z[part])},
        {},
        {},
        {},
        False,
        {name: frozen(values[part]) for name, values in pixels.items()},
    )
    title = f"{video.name}, tracked; z {heights.how}"
    constants = {"radius": heights.radius, "gravity": metres.GRAVITY}
    return Recording(
        Path(), BallSystem.name, title, constants, {"z": noise}, (run,), dict.fromkeys(pixels, "px")
    )
