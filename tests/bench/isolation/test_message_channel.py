"""Tests of the message channel between harness and tuner process, and of invalid messages on it."""

import os
import socket
import struct
from time import perf_counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.benchmark.isolation.fork_server import EXIT_CODE
from bench.benchmark.isolation.message_channel import (
    Message,
    MessageChannel,
    PeerClosedError,
    ProtocolError,
    decode_rng_state,
    encode_rng_state,
    pack_arrays,
    to_printable,
    unpack_arrays,
)
from bench.benchmark.isolation.process_errors import RunEndedError
from bench.benchmark.isolation.tuner_processes import IsolatedProcess

HEAD = struct.Struct("<cBxxIQ")


class Ends:
    """A channel and the raw ends of its pipes."""

    def __init__(self):
        (self.reading, there), (here, self.writing) = os.pipe(), os.pipe()
        os.set_blocking(self.writing, False)
        self.channel = MessageChannel(here, there)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.channel.close()
        for descriptor in (self.reading, self.writing):
            if descriptor is not None:
                os.close(descriptor)

    def write_bytes(self, whole):
        os.write(self.writing, whole)

    def hang_up(self):
        os.close(self.writing)
        self.writing = None


@pytest.fixture
def ends():
    with Ends() as both:
        yield both


def soon():
    return perf_counter() + 0.05


def body(*parts):
    return memoryview(b"".join(bytes(part) for part in parts))


@pytest.mark.parametrize("size", [0, 1, 1000, (1 << 20) // 8 - 2, (1 << 20) // 8, 300_000])
def test_a_message_comes_out_as_it_went_in(size):
    import threading

    numbers = np.random.default_rng(0).normal(size=size)
    (reading, there), (here, writing) = os.pipe(), os.pipe()
    one, other = MessageChannel(reading, writing), MessageChannel(here, there)
    sending = threading.Thread(target=lambda: one.send(b"A", numbers, flags=7, size=size))
    sending.start()
    message = other.receive(1 << 30, perf_counter() + 10.0)
    assert (message.kind, message.flags, message.size) == (b"A", 7, size)
    np.testing.assert_array_equal(message.to_array(), numbers)
    sending.join()
    one.close()
    with pytest.raises(PeerClosedError):
        other.receive()
    other.close()


def test_what_is_cut_off_waits_until_its_time_is_over_or_the_other_side_is_gone(ends):
    whole = HEAD.pack(b"A", 0, 1, 8) + bytes(8)
    for length in (0, 1, HEAD.size - 1, HEAD.size, len(whole) - 1):
        with Ends() as other:
            other.write_bytes(whole[:length])
            with pytest.raises(TimeoutError):
                other.channel.receive(deadline=soon())
            with Ends() as gone:
                gone.write_bytes(whole[:length])
                gone.hang_up()
                with pytest.raises(PeerClosedError):
                    gone.channel.receive()


def test_a_length_beyond_the_limit_is_foul_before_anything_is_allocated(ends):
    ends.write_bytes(HEAD.pack(b"A", 0, 1, 1 << 62))
    with pytest.raises(ProtocolError, match="bytes at once"):
        ends.channel.receive(1 << 31)


def test_a_length_within_it_takes_no_memory_before_the_bytes_are_there(ends):
    import tracemalloc

    ends.write_bytes(HEAD.pack(b"L", 0, 1, 1 << 30))
    tracemalloc.start()
    with pytest.raises(TimeoutError):
        ends.channel.receive(1 << 31, soon())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


def test_two_messages_at_once_are_foul(ends):
    ends.write_bytes(HEAD.pack(b"A", 0, 1, 0) * 2)
    with pytest.raises(ProtocolError, match="without a request"):
        ends.channel.receive()


def test_an_answer_before_the_question_ends_the_run(ends):
    copies = (os.dup(one) for one in (ends.channel._reading, ends.channel._writing))
    control, supervisor = socket.socketpair()
    child = IsolatedProcess(MessageChannel(*copies), control, lambda: None)
    child.send(b"E", deadline=soon())
    ends.write_bytes(HEAD.pack(b"A", 0, 1, 8) + bytes(8))
    supervisor.send(EXIT_CODE.pack(-9))
    with pytest.raises(RunEndedError, match="without a request"):
        child.send(b"E", deadline=soon())
    assert supervisor.recv(1) == b"", "the supervisor must kill the process"
    supervisor.close()


def test_who_does_not_read_makes_nobody_wait_for_ever(ends):
    before = perf_counter()
    with pytest.raises(TimeoutError):
        ends.channel.send(b"E", bytes(1 << 22), deadline=soon())
    assert perf_counter() - before < 5.0


@settings(max_examples=300, deadline=None, derandomize=True)
@given(st.binary(max_size=200), st.sampled_from(["nothing", "head", "arrays"]))
def test_whatever_comes_is_a_message_or_said_to_be_none(noise, front):
    heads = {
        "nothing": b"",
        "head": HEAD.pack(b"A", 0, 1, len(noise)),
        "arrays": HEAD.pack(b"L", 0, 1, len(noise) + 20) + b'[["a", "<f8", [2]]]\n',
    }
    with Ends() as both:
        both.write_bytes(heads[front] + noise)
        both.hang_up()
        try:
            message = both.channel.receive(1 << 16, perf_counter() + 5.0)
        except (ProtocolError, PeerClosedError):
            return
        for read in (message.to_array, message.to_document, lambda: unpack_arrays(message.body)):
            try:
                read()
            except ProtocolError:
                continue
        assert message.to_text() == to_printable(message.to_text())


kinds = st.sampled_from(["<f8", "<f4", "<i8", "|u1", "|b1", "|O", "<U3", ">f8", "<M8", 3, None])
sizes = st.lists(st.one_of(st.integers(-2, 5), st.sampled_from([1 << 39, 1 << 62, 1.5, "2", None])))
array_descriptions = st.one_of(
    st.lists(
        st.tuples(st.one_of(st.text(max_size=5), st.none(), st.lists(st.text())), kinds, sizes)
    ),
    st.recursive(st.none() | st.integers() | st.text(), st.lists),
)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(array_descriptions, st.binary(max_size=64))
def test_any_description_of_arrays_gives_arrays_or_an_error(description, rest):
    import json

    try:
        arrays = unpack_arrays(body(json.dumps(description).encode(), b"\n", rest))
    except ProtocolError:
        return
    assert len(arrays) == len(description)
    assert sum(array.nbytes for array in arrays.values()) == len(rest)
    assert all(name.isprintable() for name in arrays)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.data())
def test_arrays_come_out_as_they_went_in(data):
    from hypothesis.extra import numpy as some

    of = st.sampled_from(["f8", "f4", "i8", "i4", "u1", "b1"])
    names = st.text(st.characters(categories=["L", "Nd"]), min_size=1, max_size=8)
    shapes = some.array_shapes(min_dims=0, min_side=0, max_side=4)
    arrays = data.draw(st.dictionaries(names, some.arrays(data.draw(of), shapes), max_size=4))
    again = unpack_arrays(body(*pack_arrays(arrays)))
    assert list(again) == list(arrays)
    for name, array in arrays.items():
        assert again[name].dtype == array.dtype
        np.testing.assert_array_equal(again[name], array)
        assert again[name].flags.writeable


@pytest.mark.parametrize(
    "description",
    [
        b'[["a", "<f8", [1]], ["a", "<f8", [1]]]\n',
        b'[["", "<f8", [2]]]\n',
        b'[["a\\u0000", "<f8", [2]]]\n',
        b'[["a", "<f8", [2]]]',
        b'[["a", "<f8", [3]]]\n',
        b'[["a", "<f8", [1]]]\n',
        b"[" * 100_000,
        b'{"a": 1}\n',
    ],
)
def test_invalid_arrays_are_an_error(description):
    with pytest.raises(ProtocolError):
        unpack_arrays(body(description, bytes(16)))


def test_json_is_bounded_whatever_else_a_message_may_have():
    long = Message(b"W", 0, 0, memoryview(b"1" * 70_000))
    with pytest.raises(ProtocolError, match="bytes of JSON"):
        long.to_document()
    assert Message(b"W", 0, 0, memoryview(b"[1, NaN]")).to_document()[0] == 1


def test_text_moves_no_cursor_and_ends_no_row():
    text = Message(
        b"S", 0, 0, memoryview("a\0\x1b[2J\r\n\tb\u2028\x85".encode() + b"\xff")
    ).to_text()
    assert text == "a\ufffd\ufffd[2J\ufffd\n\tb\ufffd\ufffd\ufffd"


def test_a_stream_goes_through_as_numbers_and_one_that_stands_still_does_not():
    rng = np.random.default_rng(3)
    rng.integers(0, 10, dtype=np.int32)
    numbers = encode_rng_state(rng.bit_generator.state)
    other = np.random.default_rng()
    other.bit_generator.state = decode_rng_state(numbers)
    np.testing.assert_array_equal(other.random(5), rng.random(5))
    # With this increment, the generator would always give its first number.
    still = {**rng.bit_generator.state["state"], "inc": 4}
    for wrong in (
        {"state": still},
        {"has_uint32": 1 << 70},
        {"bit_generator": "MT19937"},
        {"x": 1},
    ):
        text = encode_rng_state({**rng.bit_generator.state, **wrong})
        with pytest.raises(ValueError, match="not the state of a random generator"):
            decode_rng_state(text)
    for noise in (b"", b"{}", b"[" * 100_000, b'{"state": 1}'):
        with pytest.raises(ValueError, match="not the state of a random generator"):
            decode_rng_state(np.frombuffer(noise, dtype=np.uint8))
