"""What strangers may write: bytes and JSON changed by hypothesis, and how much memory and text an answer may take."""

import copy
import struct
import tracemalloc
from contextlib import contextmanager
from functools import reduce
from operator import getitem

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from warp_splat.errors import InputError

NUMBERS = [0, -1, 1, 2**31, 2**32, 10**12, 2**63, 10**400, 0.5, -0.0, 1e308, True, None, "", [], {}, [[]], "..", 5126]


def tried(examples, strategy, run, seeded=False):
    """Run on examples: the same ones each time, or, ``seeded``, those of ``--hypothesis-seed``."""
    checks = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}

    @settings(max_examples=examples, derandomize=not seeded, **checks)
    @given(strategy)
    def check(data):
        run(data)

    check()


@contextmanager
def little_memory(most):
    """What is run inside allocates at most so many bytes."""
    tracemalloc.start()
    try:
        yield
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < most


def one_sentence(error, path, most=600):
    """The message of an error, which names the file that is the matter."""
    message = str(getattr(error, "value", error))
    assert str(path) in message and "\n" not in message and len(message) < most + 2 * len(str(path)), message
    return message


def refusal(run, *words, match=None):
    """The sentence of the InputError that ``run`` raises, in which there are these words, and one that matches."""
    with pytest.raises(InputError, match=match) as caught:
        run()
    message = str(caught.value)
    assert message.endswith((".", "?")) and "\n" not in message and all(word in message for word in words), message
    return message


def replace(path, old, new):
    """Change bytes that are in a file."""
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))


def changed(draw, data):
    """``data`` with a few bytes changed, inserted, removed or repeated, or cut."""
    data = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(0, len(data) - 1)))
        match draw(st.sampled_from(["set", "word", "insert", "remove", "cut", "repeat"])):
            case "set":
                data[place : place + 1] = draw(st.binary(min_size=1, max_size=1))
            case "word":
                word = draw(st.sampled_from([0, 1, 2**31 - 1, 2**31, 2**32 - 1, 0x7F800000, 0x7FC00000, 10**9]))
                data[place : place + 4] = struct.pack("<I", word)
            case "insert":
                data[place:place] = draw(st.binary(max_size=40))
            case "remove":
                del data[place : place + draw(st.integers(1, 40))]
            case "cut":
                del data[place:]
            case "repeat":
                data[place:place] = data[place : place + draw(st.integers(1, 200))]
    return bytes(data)


def places(value, path=()):
    """Where the values of a JSON value are."""
    yield path
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from places(value[key], (*path, key))


def value_at(document, way):
    return reduce(getitem, way, document)


def changed_json(draw, document):
    """``document`` with a few values replaced by awkward ones, by others of it, or removed."""
    document = copy.deepcopy(document)
    for _ in range(draw(st.integers(1, 3))):
        paths = [path for path in places(document) if path]
        if not paths:
            break
        *way, last = draw(st.sampled_from(paths))
        holder = value_at(document, way)
        match draw(st.sampled_from(["number", "number", "other", "remove"])):
            case "number":
                holder[last] = copy.deepcopy(draw(st.sampled_from(NUMBERS)))
            case "other":
                holder[last] = copy.deepcopy(value_at(document, draw(st.sampled_from(paths))))
            case "remove":
                del holder[last]
    return document
