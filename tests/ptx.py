"""A GPU's code on the CPU: an interpreter of the PTX that Warp's kernels compile to, all threads of a launch at once.

NumPy holds a register of every thread in an array. Threads that stand at the same instruction take it together, those
that are furthest behind first; at barriers, shuffles and ballots they wait for the others of their block or warp.
Addresses of arrays need more than 32 bits. An access outside of what a launch was given, or not aligned, ends the run,
and so do threads that wait for others in vain. Shared memory and registers begin as NaN.

Not in it: races (the order of threads is one of many), the assembler that makes machine code of PTX, the memory model,
time. ``ex2.approx`` and ``rcp.approx`` are rounded correctly; a GPU's are off by a bit or two.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from cuda_on_host import Launch
from ptx_memory import SHARED, arrays_of, parameters_of, shared_of
from ptx_numbers import OPERATIONS, ROUNDED, TYPES, as_type

WARP = 32
END = 2**30  # the place of threads that are done
FILES = {"%p": np.bool_, "%rs": np.uint16, "%r": np.uint32, "%rd": np.uint64, "%f": np.float32, "%tmp": np.uint64}
WAITING = ("bar.", "shfl.", "vote.")
JUMPS = ("bra", "ret")
STATEMENT = re.compile(r"(?:@(!?)(%p\d+)\s+)?([a-z][\w.]*)\s*(.*)", re.DOTALL)
OPERAND = re.compile(r"\{[^}]*\}|\[[^\]]*\]|[^\s,{}\[\]]+")


def listed(text: str) -> list[str]:
    """Of ``a`` or ``{a, b}``."""
    return re.findall(r"[^\s,{}]+", text)


@dataclass
class Run:
    """What is in the launch's memory afterwards."""

    memory: list[np.ndarray]


class Grid:
    """All threads of a launch."""

    def __init__(self, text: str, name: str, launch: Launch, dynamic: int):
        head, body = re.search(rf"\.entry {name}\((.*?)\n\).*?\n\{{(.*?)\n\}}", text, re.DOTALL).groups()
        assert launch.block_dim % WARP == 0
        self.launch, self.count = launch, launch.blocks * launch.block_dim
        self.active = np.arange(self.count)  # the threads that take the next instruction
        self.block, thread = np.divmod(self.active, launch.block_dim)
        self.warp, self.lane = self.active // WARP, (self.active % WARP).astype(np.uint32)
        special = {"tid": thread, "ctaid": self.block, "ntid": launch.block_dim, "nctaid": launch.blocks}
        self.registers = {f"%{n}.x": np.full(self.count, numbers, np.uint32) for n, numbers in special.items()}
        arrays, self.bases = arrays_of(launch)
        parameters, symbols = parameters_of(launch, head, self.bases)
        shared, more, self.shared_size = shared_of(text, launch.blocks, dynamic)
        self.spaces, self.symbols = {"global": arrays, "param": parameters, "shared": shared}, symbols | more
        self.read(body)

    def read(self, body: str) -> None:
        """Into runs of instructions that threads take together; those at which they wait begin one."""
        self.code: list[list[str]] = [[]]
        self.labels: dict[str, int] = {}
        for text in re.sub("//.*", "", body).split(";"):
            labels, statement = re.findall(r"(\$\w+):", text), re.sub(r"\$\w+:", "", text).strip().lstrip("{} \t\n")
            if labels or statement.startswith(WAITING):
                self.code.append([])
            self.labels |= dict.fromkeys(labels, len(self.code) - 1)
            if statement and not statement.startswith("."):
                self.code[-1].append(statement)
                if jumps(statement):
                    self.code.append([])
        self.compiled: dict[int, list[Callable[[], None]]] = {}

    # Operands.

    def register(self, name: str) -> np.ndarray:
        if name not in self.registers:
            dtype = np.dtype(FILES[re.match(r"%[a-z]+", name)[0]])
            unknown = np.full(self.count * dtype.itemsize, 0 if dtype.kind == "b" else 0xFF, np.uint8)
            self.registers[name] = unknown.view(dtype)
        return self.registers[name]

    def source(self, text: str, dtype: type) -> Callable[[], np.ndarray]:
        """What reads an operand: of each active thread."""
        if text.startswith("%"):
            numbers = self.register(text)
            wanted = np.bool_ if numbers.dtype == bool else dtype
            return lambda: as_type(numbers[self.active], wanted)
        if text.startswith("0f"):
            value = np.uint32(int(text[2:], 16)).view(np.float32)
        else:
            value = self.symbols[text] if text in self.symbols else int(text, 0)
            value = np.array(value % 2**64, np.uint64).astype(dtype)[()]
        return lambda: np.full(self.active.shape, value)

    def target(self, name: str) -> Callable[[np.ndarray], None]:
        """What writes a register."""
        numbers = self.register(name)

        def write(found: np.ndarray) -> None:
            numbers[self.active] = as_type(found, numbers.dtype.type)

        return write

    def elements(self, parts: list[str], text: str) -> tuple[np.ndarray, int, Callable[[], np.ndarray]]:
        """A space as an array, how many elements an access takes, and what finds the first of them."""
        memory, dtype, count = self.spaces[parts[1]], TYPES[parts[-1]], {"v2": 2, "v4": 4}.get(parts[2], 1)
        name, _, more = text.strip("[]").partition("+")
        base, size, offset = self.source(name, np.uint64), np.dtype(dtype).itemsize, np.uint64(int(more or 0))

        def find() -> np.ndarray:
            addresses, part = base() + offset, 0
            if parts[1] == "shared":
                assert np.all(addresses < SHARED + self.shared_size), f"outside of the block: {addresses}"
                part = self.block[self.active] * self.shared_size
            return memory.places(addresses, size, count, part)

        return memory.content.view(dtype), count, find

    # Instructions.

    def compile(self, statement: str) -> Callable[[], None]:
        """Raise NotImplementedError if it is not known."""
        try:
            return self.compile_known(statement)
        except (KeyError, TypeError, ValueError) as unknown:
            raise NotImplementedError(f"The interpreter of PTX does not know {statement!r}; teach it.") from unknown

    def compile_known(self, statement: str) -> Callable[[], None]:
        _, condition, opcode, rest = STATEMENT.match(statement).groups()
        if condition:
            raise ValueError("a condition of what is no jump")
        operands, parts = OPERAND.findall(rest), opcode.split(".")
        others = {"ld": self.load, "st": self.store, "atom": self.add_at, "cvt": self.convert}
        others |= {"shfl": self.shuffle, "vote": self.ballot, "bar": lambda *_: lambda: None}
        if parts[0] in others:
            return others[parts[0]](parts, operands)
        operation = OPERATIONS[".".join(part for part in parts[:-1] if part != "rn")]
        write, *reads = self.target(operands[0]), *(self.source(text, TYPES[parts[-1]]) for text in operands[1:])
        return lambda: write(operation(*(read() for read in reads)))

    def convert(self, parts: list[str], operands: list[str]) -> Callable[[], None]:
        _, *how, to, given = parts
        write, read, dtype = self.target(operands[0]), self.source(operands[1], TYPES[given]), TYPES[to]
        rounded = ROUNDED[how[0]] if "f" in to + given else np.asarray
        if to.startswith("f") or not given.startswith("f"):
            return lambda: write(rounded(read()).astype(dtype))
        ends = np.iinfo(dtype)  # beyond which a number becomes the last
        return lambda: write(np.nan_to_num(rounded(read().astype(np.float64))).clip(ends.min, ends.max).astype(dtype))

    def load(self, parts: list[str], operands: list[str]) -> Callable[[], None]:
        (content, count, find), writes = self.elements(parts, operands[1]), [*map(self.target, listed(operands[0]))]
        assert len(writes) == count

        def load() -> None:
            places = find()
            for element, write in enumerate(writes):
                write(content[places + element])

        return load

    def store(self, parts: list[str], operands: list[str]) -> Callable[[], None]:
        content, count, find = self.elements(parts, operands[0])
        reads = [self.source(text, TYPES[parts[-1]]) for text in listed(operands[1])]
        assert len(reads) == count

        def store() -> None:
            places = find()
            for element, read in enumerate(reads):
                content[places + element] = read()

        return store

    def add_at(self, parts: list[str], operands: list[str]) -> Callable[[], None]:
        """atom: one thread after another."""
        if parts[2] != "add":
            raise ValueError(parts[2])
        (content, _, find), write = self.elements(parts, operands[1]), self.target(operands[0])
        read = self.source(operands[2], TYPES[parts[-1]])

        def add() -> None:
            before = np.empty(len(self.active), content.dtype)
            for thread, (place, more) in enumerate(zip(find(), read(), strict=True)):
                before[thread], content[place] = content[place], content[place] + more
            write(before)

        return add

    def shuffle(self, parts: list[str], operands: list[str]) -> Callable[[], None]:
        """shfl: the number of another lane, one's own if there is no such lane."""
        (write, came), numbers = map(self.target, operands[0].split("|")), self.register(operands[1])
        other, clamp, members = (self.source(text, np.uint32) for text in operands[2:])
        move = {"bfly": np.bitwise_xor, "down": np.add}[parts[2]]

        def shuffle() -> None:
            lane, segment = self.lane[self.active], clamp() >> 8 & 31
            given = move(lane, other())
            inside = given <= ((lane & segment) | (clamp() & 31 & ~segment))
            given = np.where(inside, given, lane)
            assert np.all(members() >> given & 1), "a lane that is not waited for"
            write(numbers[self.active - lane + given])
            came(inside)

        return shuffle

    def ballot(self, parts: list[str], operands: list[str]) -> Callable[[], None]:
        if parts[2] != "ballot":
            raise ValueError(parts[2])
        write, read = self.target(operands[0]), self.source(operands[1], np.bool_)
        return lambda: write(self.bits(read()))

    def bits(self, said: np.ndarray) -> np.ndarray:
        """Of the warp of each active thread: the active lanes that say so."""
        bits = np.zeros(self.count // WARP, np.uint32)
        np.bitwise_or.at(bits, self.warp[self.active], said.astype(np.uint32) << self.lane[self.active])
        return bits[self.warp[self.active]]

    # Control.

    def run(self) -> Run:
        self.places = np.zeros(self.count, np.int64)
        while self.places.min() != END:
            place = self.choose()
            if place not in self.compiled:
                self.compiled[place] = [self.compile(text) for text in self.code[place] if not jumps(text)]
            for instruction in self.compiled[place]:
                instruction()
            self.places[self.active] = self.following(place)
        content = self.spaces["global"].content
        memory = [content[base : base + len(array)] for base, array in zip(self.bases, self.launch.memory, strict=True)]
        return Run(memory)

    def choose(self) -> int:
        """The place of the active threads: the first at which some need not wait."""
        if self.activate(lowest := self.places.min()):
            return lowest
        for place in np.unique(self.places):
            if place != END and self.activate(place):
                return place
        raise AssertionError("Threads wait for others that do not come.")

    def activate(self, place: int) -> bool:
        """Whether there are threads at a place that need not wait for others."""
        self.active = np.flatnonzero(self.places == place)
        opcode, _, rest = (self.code[place] or [""])[0].partition(" ")
        if opcode.startswith("bar."):
            assert (opcode, rest.strip()) == ("bar.sync", "0")
            here = np.bincount(self.block[self.active], minlength=self.launch.blocks)
            self.active = self.active[here[self.block[self.active]] == self.launch.block_dim]
        elif opcode.startswith(WAITING):
            members = self.source(OPERAND.findall(rest)[-1], np.uint32)()
            self.active = self.active[self.bits(np.ones(self.active.shape)) & members == members]
        return len(self.active) > 0

    def following(self, place: int) -> np.ndarray | int:
        """Where the active threads go from the end of a run of instructions."""
        if not self.code[place] or not jumps(self.code[place][-1]):
            return place + 1
        negated, condition, opcode, label = STATEMENT.match(self.code[place][-1]).groups()
        to = END if opcode == "ret" else self.labels[label]
        if not condition:
            return to
        return np.where(self.registers[condition][self.active] != bool(negated), to, place + 1)


def jumps(statement: str) -> bool:
    return STATEMENT.match(statement)[3].split(".")[0] in JUMPS


def execute(text: str, name: str, launch: Launch, shared: int) -> Run:
    """Repeat ``launch`` by the kernel ``name`` of the PTX ``text``, with so many bytes of shared memory on request."""
    with np.errstate(all="ignore"):
        return Grid(text, name, launch, shared).run()
