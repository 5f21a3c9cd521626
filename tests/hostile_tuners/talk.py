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

    def say(self, task):
        """Return the bytes that are sent instead of the expected message."""
        return message(b"Z")

    def tune(self, task, rng):
        yield task.start[None]
        with contextlib.suppress(OSError):
            write(self.say(task))
        if self.waits:
            time.sleep(1000)
        while True:
            yield rng.uniform(size=(1, task.dim))


def asked(task, n=1, **head):
    return message(b"A", np.full((n, task.dim), 0.5).tobytes(), **{"size": n, **head})


class TooLong(Talk):
    name = "too-long"

    def say(self, task):
        return asked(task, length=1 << 60)


class TooMany(Talk):
    name = "too-many"

    def say(self, task):
        return asked(task, size=(1 << 32) - 1)


class TooFew(Talk):
    name = "too-few"

    def say(self, task):
        return asked(task, 3, size=1)


class Nothing(Talk):
    name = "nothing"

    def say(self, task):
        return message(b"A")


class HalfANumber(Talk):
    name = "half-a-number"

    def say(self, task):
        return message(b"A", b"123", size=1)


class HalfAMessage(Talk):
    """Sends an incomplete message and then nothing."""

    name = "half-a-message"
    ends = "timeout"

    def say(self, task):
        os.write(writing(), asked(task)[:-5])
        time.sleep(1000)


class Slowly(HalfAMessage):
    """Sends one byte every 0.2 s, so that there is always something to read."""

    name = "slowly"

    def say(self, task):
        for byte in asked(task, 1, length=8 * task.dim):
            os.write(writing(), bytes([byte]))
            time.sleep(0.2)
        return b""


class AllAtOnce(Talk):
    """Sends the answers to all future requests at once."""

    name = "all-at-once"

    def say(self, task):
        return asked(task) * task.budget


class BeforeItIsAsked(Talk):
    """Sends each answer while the harness simulates, so that no tuner time is measured."""

    name = "before-it-is-asked"
    # An answer that arrives after its request is valid.
    ends = ("crashed", "done")

    def tune(self, task, rng):
        threading.Thread(target=self.hurry, args=(asked(task),)).start()
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

    def say(self, task):
        return asked(task, flags=255)


class Noise(Talk):
    name = "noise"

    def say(self, task):
        return np.random.default_rng(0).bytes(1 << 16)


class LongReason(Talk):
    """Stops with a reason that is too long for a table."""

    name = "long-reason"
    ends = "converged"
    waits = True

    def say(self, task):
        return message(b"S", b"x" * (1 << 15))


class FoulReason(Talk):
    """Stops with a reason that has terminal codes, line ends, separators and invalid UTF-8."""

    name = "foul-reason"
    ends = "converged"
    waits = True

    def say(self, task):
        return message(b"S", b'\0\x1b[2J"\r\n",,\x85\xff\xfe=cmd()\xe2\x80\xa8;' * 3)


class FoulCrash(Talk):
    name = "foul-crash"

    def say(self, task):
        return message(b"D", b'\0\x1b[2J"\r\r\n\n",,\x85\xff')


class Deep(Talk):
    """Sends deeply nested JSON where no JSON is expected."""

    name = "deep"

    def say(self, task):
        return message(b"W", b"[" * 60_000) + message(b"L", json.dumps(["x"] * 1000).encode())
