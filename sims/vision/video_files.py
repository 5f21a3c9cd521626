"""Read and write video files with the optional packages that do so.

PyAV contains its own codecs and reports each frame's time as stated in the file, also for uneven
frame rates.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterable, Iterator, Mapping
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sims.core.files import atomic_replacement, check_absent, require_file, write_files
from sims.core.simulator import Array, InputError
from sims.vision.ball_renderer import RgbImage

REQUIRED_PACKAGES = ("av", "cv2")
"""Packages for films: PyAV reads and writes video files, OpenCV measures pictures."""

_MAX_CACHED_BYTES = 200_000_000
"""Maximum number of bytes of frames that are cached in memory."""


def check_installed(instead: str = "") -> None:
    """Check that the packages for films are installed, without importing them.

    Args:
        instead: Alternative for the user, appended to the message.

    Raises:
        InputError: A package is missing.
    """
    if not all(map(importlib.util.find_spec, REQUIRED_PACKAGES)):
        raise InputError(f'films need PyAV and OpenCV: pip install -e ".[vision]"{instead}')


@cache
def import_package(name: str) -> Any:
    """Import one of the packages for films, whose import takes time and is optional.

    Raises:
        InputError: The package is missing; the message says how to install it.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        check_installed()
        raise


_FRAME_RATE_RANGE = (1e-3, 1e7)
"""Range of plausible frame rates, frames per second."""
_TICKS_PER_SECOND = 90_000
"""Time stamps per second in the files written here, a multiple of the usual frame rates."""
_DEFAULT_RATE = 30.0
"""Frame rate in frames per second of a file that states neither times nor a rate."""
_HEAD_BYTES = 64
"""Number of bytes from which the kind of an unreadable file is determined."""


def write_video(
    path: Path,
    frames: Iterable[RgbImage],
    times: Array,
    crf: int = 18,
    extra_files: Mapping[Path, str] | None = None,
) -> None:
    """Write frames as H.264 in an .mp4 file, completely or not at all.

    Args:
        path: New file, whose name ends in .mp4.
        frames: Pictures (height, width, 3) of one size with even height and width.
        times: (n,) time of each frame in seconds, increasing; rounded to 1/90000 s.
        crf: Constant rate factor, 0 (lossless) to 51.
        extra_files: Texts of other new files that belong to it; they are written before the film
            becomes visible.

    Raises:
        InputError: The file exists or cannot be written, or the size of the frames cannot be
            encoded.
    """
    if path.suffix != ".mp4":
        raise InputError(f"{path}: expected a name that ends in .mp4")
    check_absent([path])
    try:
        # FFmpeg derives the format from the name.
        with atomic_replacement(path, keep_ending=True) as partial:
            _encode_frames(partial, frames, times, crf)
            # Encoding takes long; the file may have been created meanwhile.
            check_absent([path])
            write_files(extra_files or {})
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from None


def _encode_frames(path: Path, frames: Iterable[RgbImage], times: Array, crf: int) -> None:
    """Encode frames as H.264 with their own times, such that the same frames give the same file.

    Args:
        path: file to write.
        frames: pictures, all of the same size.
        times: (n,) times of the frames, s.
        crf: constant rate factor of x264: larger numbers mean smaller files and less quality.

    Raises:
        InputError: width or height of a frame is odd.
    """
    av = import_package("av")
    ticks = np.rint((times - times[0]) * _TICKS_PER_SECOND).astype(int)
    # Mean frame rate, which the file states in addition to the times.
    rate = Fraction(30)
    if len(times) > 1:
        seconds = Fraction(max(1, int(ticks[-1])), _TICKS_PER_SECOND)
        rate = Fraction(len(times) - 1, 1) / seconds
    # Write the index first, so that a truncated file can be read up to the end.
    with av.open(str(path), "w", options={"movflags": "faststart"}) as file:
        stream = file.add_stream("libx264", rate=rate.limit_denominator(1000))
        stream.pix_fmt = "yuv420p"
        stream.thread_count = 1
        stream.options = {
            "crf": str(crf),
            "preset": "veryfast",
            # No B-frames, so that frames are stored in the order of their times.
            "bf": "0",
            # The same output on every processor: with x264's fast code paths alone, the file
            # differs occasionally.
            "x264-params": "cpu-independent=1",
        }
        stream.codec_context.time_base = Fraction(1, _TICKS_PER_SECOND)
        converter = av.video.reformatter.VideoReformatter()
        for tick, picture in zip(ticks.tolist(), frames, strict=True):
            if not stream.codec_context.is_open:  # the first frame
                stream.height, stream.width = picture.shape[:2]
                if stream.height % 2 or stream.width % 2:
                    raise InputError(
                        f"{path}: expected an even number of pixels, found {picture.shape[:2]}"
                    )
            # One converter with one thread: by default PyAV starts as many threads as there are
            # cores for each frame.
            coloured = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame = converter.reformat(coloured, format="yuv420p", threads=1)
            frame.pts = tick
            frame.time_base = Fraction(1, _TICKS_PER_SECOND)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


class VideoFile:
    """Video file that can be read frame by frame, repeatedly.

    Args:
        path: Any file that FFmpeg reads.
        fps: Frame rate in frames per second, instead of the file's own time stamps.

    Attributes:
        notes: Faults of the file that did not prevent reading, in sentences; complete after one
            pass.

    Raises:
        InputError: The file does not exist, or contains no video.
    """

    def __init__(self, path: Path, fps: float | None = None) -> None:
        """Check the frame rate, and that the file can be opened as a video.

        Args:
            path: Video file.
            fps: Frames per second; None for the time stamps of the file.

        Raises:
            InputError: The file cannot be read, or the frame rate is not plausible.
        """
        require_file(path)
        if fps is not None and not _FRAME_RATE_RANGE[0] <= fps <= _FRAME_RATE_RANGE[1]:
            expected = f"more than 0, from {_FRAME_RATE_RANGE[0]:g} to {_FRAME_RATE_RANGE[1]:g}"
            raise InputError(f"frames a second, {fps:g}: expected {expected}")
        self.path, self.fps = path, fps
        self.notes: list[str] = []
        with self._open_file():
            pass

    def __iter__(self) -> Iterator[tuple[float, RgbImage]]:
        """Iterate over time in seconds and picture of each readable frame.

        Frames whose times do not increase are left out. After the last frame, `notes` describes the
        faults of the file.
        """
        self.notes = []
        last_time = -np.inf
        count = 0
        dropped_count = 0
        is_broken = False
        with self._open_file() as file:
            stated_count = file.streams.video[0].frames
            for seconds, picture in self._decode_frames(file):
                if picture is None:
                    is_broken = True
                    break
                time = count / self.fps if self.fps else seconds
                count += 1
                # The times of a recording must increase, those of a file need not.
                if time <= last_time:
                    dropped_count += 1
                    continue
                last_time = time
                yield time, picture
        self._check_pass(count, stated_count, is_broken, dropped_count)

    def _open_file(self) -> Any:
        """Open the file with PyAV, as a context manager.

        Raises:
            InputError: the file cannot be read, or contains no moving pictures.
        """
        av = import_package("av")
        try:
            file = av.open(str(self.path))
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read ({error.strerror})") from None
        # FFmpeg errors without a Python class, such as an unexpected end of the file.
        except (ValueError, av.FFmpegError):
            raise InputError(f"{self.path}: {_describe_unreadable_file(self.path)}") from None
        if file.streams.video:
            return file
        # FFmpeg takes some files for a container without any stream: they are no video at all.
        has_streams = len(file.streams) > 0
        file.close()
        if not has_streams:
            raise InputError(f"{self.path}: {_describe_unreadable_file(self.path)}")
        raise InputError(f"{self.path}: expected a video, found a file without a video stream")

    def _decode_frames(self, file: Any) -> Iterator[tuple[float, RgbImage | None]]:
        """Iterate over time in seconds and picture of each frame.

        A frame without a stamp gets its time from the frame rate. A decoding error ends the frames
        with an item whose picture is None; the frames before it are not lost.

        Args:
            file: file as opened by PyAV.
        """
        av = import_package("av")
        stream = file.streams.video[0]
        stream.thread_count = 1
        rate = float(stream.average_rate or _DEFAULT_RATE)
        converter = av.video.reformatter.VideoReformatter()
        number = 0
        try:
            for frame in file.decode(stream):
                seconds = frame.time if frame.time is not None else number / rate
                picture = converter.reformat(frame, format="rgb24", threads=1)
                yield seconds, _apply_rotation(picture, frame.rotation)
                number += 1
        except av.FFmpegError:
            yield np.nan, None

    def _check_pass(
        self, count: int, stated_count: int, is_broken: bool, dropped_count: int
    ) -> None:
        """Add notes about the faults that were found while reading all frames.

        Args:
            count: Number of frames read.
            stated_count: Number of frames that the file states; 0 if unknown.
            is_broken: Whether decoding failed.
            dropped_count: Number of frames whose times do not increase.

        Raises:
            InputError: No frame could be read.
        """
        if not count:
            raise InputError(
                f"{self.path}: no frame of it can be read; the file is damaged or truncated"
            )
        if is_broken or count < stated_count:
            total_text = f" of {stated_count}" if stated_count > count else ""
            self.notes.append(
                f"the file is truncated or damaged: {count}{total_text} frames could be read"
            )
        if dropped_count:
            self.notes.append(
                f"{dropped_count} frames whose time stamps do not increase were left out"
            )


def _apply_rotation(frame: Any, degrees: float) -> RgbImage:
    """Return the picture of a frame, rotated as the file states.

    Telephones store how they were held instead of rotating the picture.

    Args:
        frame: frame of PyAV.
        degrees: rotation that the file states, anticlockwise, a multiple of 90.
    """
    picture: RgbImage = frame.to_ndarray()
    turns = round(degrees / 90) % 4
    return np.ascontiguousarray(np.rot90(picture, turns)) if turns else picture


def _describe_unreadable_file(path: Path) -> str:
    """Describe why a file is not a readable video, from its first bytes."""
    with path.open("rb") as file:
        start = file.read(_HEAD_BYTES)
    if not start:
        return "expected a video, found an empty file"
    # These bytes begin an MP4 file, whose index may be at its end.
    if start[4:8] == b"ftyp":
        return "is truncated before its index, so no frame can be read; copy the whole file again"
    text = all(32 <= byte < 127 or byte in b"\t\r\n" for byte in start)
    return f"expected a video, found {'a text file' if text else 'something else'}"


class FrameCache:
    """Frames that are cached if they are few and small, and otherwise read again each time."""

    def __init__(self, source: Iterable[tuple[float, RgbImage]]) -> None:
        self._source = source
        self._cached_frames: list[tuple[float, RgbImage]] | None = None

    def __iter__(self) -> Iterator[tuple[float, RgbImage]]:
        """Yield time and picture of each frame, and store the frames in the first full pass.

        More than `_MAX_CACHED_BYTES` bytes of pictures are not stored, and the film is read again
        in each pass.
        """
        if self._cached_frames is not None:
            yield from self._cached_frames
            return
        frames = []
        stored_bytes = 0
        for time, picture in self._source:
            stored_bytes += picture.nbytes
            if stored_bytes <= _MAX_CACHED_BYTES:
                frames.append((time, picture))
            else:
                # Too many frames: release those cached so far at once.
                frames.clear()
            yield time, picture
        if stored_bytes <= _MAX_CACHED_BYTES:
            self._cached_frames = frames
