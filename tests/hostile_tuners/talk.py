"""Tuners that send their own messages to the harness; `ends` is the expected status of the run."""

import contextlib
import gc
import json
import os
import struct
import sys
import threading
import time

import numpy as np

from methods.tuners.random_search import RandomSearch

HEAD = struct.Struct("<cBxxIQ")


def message(kind, body=b"", flags=0, size=0, length=None):
    return HEAD.pack(kind, flags, size, len(body) if length is None else length) + body


def writing():
    """Return the file descriptor of the pipe to the harness."""
    (channel,) = (one for one in gc.get_objects() if type(one).__name__ == "MessageChannel")
    return channel._writing


def write(whole):
    for _ in range(10_000):
        try:
            whole = whole[os.write(writing(), whole) :]
        except BlockingIOError:
            time.sleep(0.001)
        if not whole:
            return


class Talk(RandomSearch):
    """Sends a message that was not requested."""

    name = "talk"
    ends = "crashed"
    waits = False  # for an answer: two messages may or may not be read together

    def forge(self, task):
        """Return the bytes that are sent instead of the expected message."""
        return message(b"Z")

    def tune(self, task, rng):
        yield task.start[None]
        with contextlib.suppress(OSError):
            write(self.forge(task))
        if self.waits:
            time.sleep(1000)
        while True:
            yield rng.uniform(size=(1, task.dim))


def make_answer(task, n=1, **head):
    return message(b"A", np.full((n, task.dim), 0.5).tobytes(), **{"size": n, **head})


class TooLong(Talk):
    name = "too-long"

    def forge(self, task):
        return make_answer(task, length=1 << 60)


class TooMany(Talk):
    name = "too-many"

    def forge(self, task):
        return make_answer(task, size=(1 << 32) - 1)


class MissingPoints(Talk):
    name = "too-few"

    def forge(self, task):
        return make_answer(task, 3, size=1)


class Nothing(Talk):
    name = "nothing"

    def forge(self, task):
        return message(b"A")


class HalfANumber(Talk):
    name = "half-a-number"

    def forge(self, task):
        return message(b"A", b"123", size=1)


class HalfAMessage(Talk):
    """Sends an incomplete message and then nothing."""

    name = "half-a-message"
    ends = "timeout"

    def forge(self, task):
        os.write(writing(), make_answer(task)[:-5])
        time.sleep(1000)


class Slowly(HalfAMessage):
    """Sends one byte every 0.2 s, so that there is always something to read."""

    name = "slowly"

    def forge(self, task):
        for byte in make_answer(task, 1, length=8 * task.dim):
            os.write(writing(), bytes([byte]))
            time.sleep(0.2)
        return b""


class AllAtOnce(Talk):
    """Sends the answers to all future requests at once."""

    name = "all-at-once"

    def forge(self, task):
        return make_answer(task) * task.budget


class EarlyAnswers(Talk):
    """Sends each answer while the harness simulates, so that no tuner time is measured."""

    name = "before-it-is-asked"
    # An answer that arrives after its request is valid.
    ends = ("crashed", "done")

    def tune(self, task, rng):
        threading.Thread(target=self.hurry, args=(make_answer(task),)).start()
        while True:
            # The simulation takes long enough that the answer arrives before the request.
            yield np.repeat(task.start[None], 5, axis=0)

    def hurry(self, answer):
        main = threading.main_thread().ident
        while sys._current_frames()[main].f_code.co_name != "_read_available_bytes":
            time.sleep(0)
        write(answer)


class Flags(Talk):
    name = "flags"

    def forge(self, task):
        return make_answer(task, flags=255)


class Noise(Talk):
    name = "noise"

    def forge(self, task):
        return np.random.default_rng(0).bytes(1 << 16)


class LongReason(Talk):
    """Stops with a reason that is too long for a table."""

    name = "long-reason"
    ends = "converged"
    waits = True

    def forge(self, task):
        return message(b"S", b"x" * (1 << 15))


class FoulReason(Talk):
    """Stops with a reason that has terminal codes, line ends, separators and invalid UTF-8."""

    name = "foul-reason"
    ends = "converged"
    waits = True

    def forge(self, task):
        return message(b"S", b'\0\x1b[2J"\r\n",,\x85\xff\xfe=cmd()\xe2\x80\xa8;' * 3)


class FoulCrash(Talk):
    name = "foul-crash"

    def forge(self, task):
        return message(b"D", b'\0\x1b[2J"\r\r\n\n",,\x85\xff')


class Deep(Talk):
    """Sends deeply nested JSON where no JSON is expected."""

    name = "deep"

    def forge(self, task):
        return message(b"W", b"[" * 60_000) + message(b"L", json.dumps(["x"] * 1000).encode())
