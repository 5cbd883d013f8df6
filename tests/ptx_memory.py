"""Memory of the interpreter of PTX, and what of it may be touched."""

import re

import numpy as np
from cuda_on_host import Launch
from warp._src.types import launch_bounds_t  # what wp.launch hands to a kernel

GLOBAL = 0x7A_4000_0000  # address of the first array
SHARED = 1024  # of shared memory: the first KiB belongs to the system
APART = 256  # bytes between arrays, which nobody may touch


class Memory:
    """Bytes at addresses from ``start`` on, of which some may be touched."""

    def __init__(self, start: int, size: int, fill: int = 0):
        self.start, self.content, self.allowed = start, np.full(size, fill, np.uint8), np.zeros(size, bool)

    def put(self, place: int, content: np.ndarray) -> None:
        self.content[place : place + len(content)] = content
        self.allowed[place : place + len(content)] = True

    def places(self, addresses: np.ndarray, size: int, count: int, offset: np.ndarray | int) -> np.ndarray:
        """Of ``count`` elements of ``size`` bytes at each address, in units of ``size``."""
        places = addresses.astype(np.int64) - self.start + offset
        assert np.all(places % (size * count) == 0), f"not aligned: {addresses}"
        assert np.all((places >= 0) & (places < len(self.content))), f"outside of all arrays: {addresses}"
        assert self.allowed[places].all() and self.allowed[places + size * count - 1].all(), f"outside: {addresses}"
        return places // size


def arrays_of(launch: Launch) -> tuple[Memory, np.ndarray]:
    """The launch's memory, and where each array begins in it."""
    sizes = [-(-len(array) // APART) * APART + APART for array in launch.memory]
    bases, memory = np.cumsum([APART, *sizes])[:-1], Memory(GLOBAL, APART + sum(sizes))
    for base, array in zip(bases, launch.memory, strict=True):
        memory.put(base, array)
    return memory, bases


def parameters_of(launch: Launch, head: str, bases: np.ndarray) -> tuple[Memory, dict[str, int]]:
    """Each as long as the kernel declares it, and the place of each name."""
    contents = [bytearray(launch_bounds_t(launch.shape))]
    for content, pointers in launch.arguments:
        contents.append(bytearray(content))
        for place, array, offset in pointers:
            address = int(GLOBAL + bases[array] + offset)
            contents[-1][place : place + 8] = address.to_bytes(8, "little")
    declared = re.findall(r"\.param (?:\.align \d+ )?\.[bufs](\d+) (\w+)(?:\[(\d+)\])?", head)
    places = np.cumsum([0, *(-(-len(content) // 16) * 16 for content in contents)])
    memory, symbols = Memory(0, places[-1]), {}
    for content, place, (bits, name, elements) in zip(contents, places[:-1], declared, strict=True):
        assert len(content) == int(bits) // 8 * int(elements or 1), f"{name} has {len(content)} bytes"
        memory.put(place, np.frombuffer(content, np.uint8))
        symbols[name] = int(place)
    return memory, symbols


def shared_of(text: str, blocks: int, dynamic: int) -> tuple[Memory, dict[str, int], int]:
    """What a module declares, then what the launch adds, for each block; the place of each name, a block's bytes."""
    place, symbols = SHARED, {}
    for bits, name, elements in re.findall(r"\.shared \.align \d+ \.[bufs](\d+) (\w+)(?:\[(\d+)\])?;", text):
        symbols[name] = place
        place += -(-int(bits) // 8 * int(elements or 1) // 16) * 16
    symbols["_ZN2wp17dynamic_smem_baseE"] = place
    size = place - SHARED + -(-dynamic // 16) * 16
    memory = Memory(SHARED, size * blocks, 0xFF)
    memory.allowed[:] = True
    return memory, symbols, size
