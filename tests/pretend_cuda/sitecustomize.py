"""A GPU that is not there, for every process of Python that starts with this folder in PYTHONPATH.

Tensors say that they are on cuda:0, and the CPU computes them; kernels run in fibers, memory that nobody has written
holds NaN. As on a card, what mixes devices raises an error, and so does what takes a tensor of the device for one of
the host. To torch's own C++ these tensors are on "meta", so autograd works as it does, without a driver.

Where the host has to wait for the device is noted. When the process ends, the notes are added to the file that
PRETEND_CUDA names, a line of JSON each: what waits, where, and in which iteration of the trainer.
"""

import atexit
import copy
import ctypes
import functools
import json
import os
import sys
import threading
import time
from contextlib import ExitStack, contextmanager

import torch
import warp as wp
from torch.multiprocessing.reductions import StorageWeakRef
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

CARD, META, HOST = torch.device("cuda", 0), torch.device("meta"), torch.device("cpu")
COPIES = ("aten::copy_", "aten::_to_copy")
WAIT = ("_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2", "unique_dim", "bincount", "is_nonzero")
GARBAGE = 0xFF  # of float, NaN

notes: list[dict] = []
launched = 0  # kernels and operations on the device so far
coming: list[tuple[torch.Tensor, torch.Tensor]] = []  # copies to page-locked memory that nobody has waited for
used: set[int] = set()  # streams in which kernels were launched
current = [0]  # torch's streams, the last one at work
memory: dict[int, tuple[int, int, StorageWeakRef]] = {}  # of the device: address and size
locked: dict[int, StorageWeakRef] = {}  # page-locked memory of the host


class Pretended(torch.Tensor):
    """A tensor of the device."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    device = property(lambda self: CARD)
    is_cuda, is_cpu, is_meta = (property(lambda self, is_so=is_so: is_so) for is_so in (True, False, False))

    @staticmethod
    def __new__(cls, inner):
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        found = torch.Tensor._make_wrapper_subclass(cls, inner.shape, device=META, **layout)
        found.inner, storage = inner, inner.untyped_storage()
        memory[storage._cdata] = (storage.data_ptr(), storage.nbytes(), StorageWeakRef(storage))
        return found

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return dispatch(func, args, kwargs or {})

    def data_ptr(self):
        return self.inner.data_ptr()

    def untyped_storage(self):
        return self.inner.untyped_storage()

    def tolist(self):
        return self.cpu().tolist()

    def numpy(self, **options):
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy it first.")

    __array__ = numpy

    def __repr__(self):
        return f"Pretended({self.inner})"


def on_card(device) -> bool:
    """Whether that is the device, by either of its names."""
    return torch.device(device).type != "cpu"


class Names(TorchFunctionMode):
    """Torch's C++ hears "meta" where the caller says "cuda"."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func is torch.device:
            return func(*args, **kwargs or {})
        if func is torch.Tensor.cuda:
            return args[0].to(META)
        if func in (torch.Tensor.__getitem__, torch.Tensor.__setitem__) and isinstance(args[1], tuple):
            index = tuple(torch.tensor(i) if isinstance(i, list | tuple) else i for i in args[1])
            args = (args[0], index, *args[2:])
        given = {name: self.swap(value) for name, value in (kwargs or {}).items()}
        if func is torch.Tensor.new_tensor:
            func, given, args = torch.tensor, {"dtype": args[0].dtype, "device": args[0].device} | given, args[1:]
        if func is torch.tensor and on_card(given.get("device", HOST)):  # there torch would look at no mode
            return func(*args, **given | {"device": HOST}).to(META)
        if (generator := given.get("generator")) is not None:
            card = given.get("device") == META or any(isinstance(x, Pretended) for x in args)
            if isinstance(generator, Generator) != card:
                raise RuntimeError(f"Expected a generator of the tensor's device ({func})")
            given["generator"] = getattr(generator, "inner", generator)
        return func(*map(self.swap, args), **given)

    def swap(self, value):
        named = isinstance(value, torch.device) or (isinstance(value, str) and value.startswith("cuda"))
        return META if named and on_card(value) else value


class Operations(TorchDispatchMode):
    """Every operation of torch, those that make tensors of the device above all."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return dispatch(func, args, kwargs or {})


def wait(kind: str) -> None:
    """Note that the host waits, and where; what was on its way has then arrived."""
    frame, places, iteration = sys._getframe(1), [], None
    while frame:
        name = frame.f_code.co_filename
        if "/warp_splat/" in name:
            places.append(f"{name.rpartition('/warp_splat/')[2]}:{frame.f_code.co_name}")
            if name.endswith("training/trainer.py") and frame.f_code.co_name in ("differentiate", "update"):
                iteration = frame.f_locals["iteration"]
        frame = frame.f_back
    notes.append({"kind": kind, "where": " < ".join(places[:6]), "iteration": iteration})
    arrive(len(coming))


def arrive(count: int) -> None:
    """Complete as many copies to the host."""
    for target, source in coming[:count]:
        target.copy_(source)
    del coming[:count]


def is_locked(tensor: torch.Tensor) -> bool:
    known = locked.get(tensor.untyped_storage()._cdata)
    return known is not None and not known.expired()


def lock(tensor: torch.Tensor) -> torch.Tensor:
    locked[tensor.untyped_storage()._cdata] = StorageWeakRef(tensor.untyped_storage())
    return tensor


def dispatch(func, args, kwargs):
    """What the operation gives, after a look at which devices meet."""
    global launched
    name, given = func._schema.name, [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    there, here = ([x for x in given if isinstance(x, Pretended) == is_there] for is_there in (True, False))
    device, plain = kwargs.get("device"), dict(kwargs)
    card = bool(there) if device is None else on_card(device)
    pinned = plain.pop("pin_memory", False)
    check_devices(name, args, there, here)
    note_waits(name, args, kwargs, card)
    source, target, later = copy_of(name, args, kwargs)
    if name in ("aten::_pin_memory", "aten::is_pinned"):
        if there:
            raise RuntimeError(f"cannot pin 'torch.cuda.FloatTensor': only dense CPU tensors can be pinned ({name})")
        return lock(args[0].clone()) if name == "aten::_pin_memory" else is_locked(args[0])
    inner = lambda x: x.inner if isinstance(x, Pretended) else HOST if isinstance(x, torch.device) else x  # noqa: E731
    found = func(*tree_map(inner, args), **tree_map(inner, plain))
    if name == "aten::_to_copy" and device is not None and given:
        found = found if found.data_ptr() != inner(given[0]).data_ptr() else found.clone()
    launched += card
    if card and not func.is_view:
        used.add(current[-1])
    if card and ("::empty" in name or "::new_empty" in name) and found.numel():
        found.untyped_storage().fill_(GARBAGE)
    if pinned and not card:
        lock(found)
    if later and isinstance(source, Pretended) and comes_later(target, device):
        target = lock(found) if target is None else target
        coming.append((target, inner(source).clone()))
        target.untyped_storage().fill_(GARBAGE)
    wrap = lambda x: Pretended(x) if card and isinstance(x, torch.Tensor) and not isinstance(x, Pretended) else x  # noqa: E731
    found = tree_map(wrap, found)
    return return_and_correct_aliasing(func, args, kwargs, found) if given else found


def check_devices(name, args, there, here) -> None:
    """Raise what torch raises where devices do not go together."""
    both = "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu!"
    if there and name in ("aten::index", "aten::index_put", "aten::index_put_"):
        if not isinstance(args[0], Pretended):
            raise RuntimeError("indices should be either on cpu or on the same device as the indexed tensor (cpu)")
        if len(args) > 2 and not isinstance(args[2], Pretended) and args[2].dim():
            raise RuntimeError(both)
    elif there and name not in COPIES and any(x.dim() for x in here):
        raise RuntimeError(f"{both} ({name})")


def note_waits(name, args, kwargs, card) -> None:
    """Of operations that end only when the host knows something, or has handed something over."""
    short = name.removeprefix("aten::")
    if name in COPIES:
        source, target, later = copy_of(name, args, kwargs)
        to_card = isinstance(target, Pretended) if target is not None else card
        if isinstance(source, Pretended) and not to_card:
            if not later or (target is not None and not is_locked(target)):
                wait("copy to the host")
        elif not isinstance(source, Pretended) and to_card and source.numel() and not (later and is_locked(source)):
            wait("copy from the host")
    elif card or any(isinstance(x, Pretended) for x in args):
        indices = [x for x in tree_leaves(args[1]) if isinstance(x, torch.Tensor)] if short.startswith("index") else []
        sizes = short == "repeat_interleave" and kwargs.get("output_size") is None
        if short in WAIT or sizes or any(x.dtype == torch.bool or not isinstance(x, Pretended) for x in indices):
            wait(short)


def copy_of(name, args, kwargs):
    """Source and target of a copy, none if it makes one, and whether nobody waits for it; of no copy nothing."""
    if name == "aten::copy_":
        return args[1], args[0], bool(kwargs.get("non_blocking") or (len(args) > 2 and args[2]))
    return (args[0], None, bool(kwargs.get("non_blocking"))) if name in COPIES else (None, None, False)


def comes_later(target, device) -> bool:
    """Whether a copy goes to page-locked memory of the host."""
    return not on_card(device or CARD) if target is None else is_locked(target)


class Generator(torch.Generator):
    """Random numbers of the device."""

    def __new__(cls, device="cpu"):
        if not on_card(device):
            return torch._C.Generator(device)
        made = torch._C.Generator.__new__(cls)
        made.inner = torch._C.Generator()
        return made

    device = property(lambda self: CARD)

    def manual_seed(self, seed):
        self.inner.manual_seed(seed)
        return self


class Event:
    """A place in the stream."""

    def __init__(self, **options):
        self.time, self.count, self.launched = 0.0, 0, 0

    def record(self, stream=None):
        self.time, self.count, self.launched = time.perf_counter(), len(coming), launched

    def synchronize(self):
        if self.launched == launched:  # nothing for the device to do meanwhile
            wait("event")
        arrive(min(self.count, len(coming)))

    def elapsed_time(self, other):
        return 1e3 * (other.time - self.time)


def pointers(value):
    """Addresses of the tensors in an argument of a kernel."""
    if isinstance(value, wp.array):
        yield from [value.ptr] * hasattr(value, "_tensor")
    elif hasattr(value, "strides"):
        yield value.data if all(value.shape[axis] for axis in range(value.ndim)) else 0
    elif hasattr(value, "__ctype__"):
        yield from pointers(value.__ctype__())
    elif isinstance(value, ctypes.Structure):
        for name, *_ in value._fields_:
            yield from pointers(getattr(value, name))


def launching(launch):
    """A launch of Warp on the device, by fibers, or on the host: of arrays that are there."""

    def run(kernel, *args, **options):
        global launched
        tables = [options.get(name) or () for name in ("inputs", "outputs", "adj_inputs", "adj_outputs")]
        arrays = [value for table in tables for value in table if isinstance(value, wp.array)]
        stream = options.pop("stream", None)
        card = stream is not None or any(array.device is warp_device(CARD) for array in arrays)
        for storage in [key for key, (*_, alive) in memory.items() if alive.expired()]:
            del memory[storage]
        for pointer in {p for table in tables for value in table for p in pointers(value) if p}:
            known = any(begin <= pointer < begin + size for begin, size, _ in memory.values())
            if known != card:
                raise RuntimeError(f"an illegal memory access was encountered: {kernel.key}")
        launched += card
        if card:
            used.add((stream or warp_device(CARD).stream).cuda_stream)
        return launch(kernel, *args, **(options | {"device": warp_device(CARD if card else HOST)}))

    return run


def warp_device(device):
    """Warp's; of the card another one, of the CPU. As Warp's own function it fails before ``wp.init``."""
    host = wp._src.context.runtime.cpu_device
    return warp_card(id(host)) if on_card(device) else host


class Stream:
    """One of torch's, or of Warp's."""

    def __init__(self, number, device):
        self.cuda_stream, self.device = number, device


class Memory:
    """What Warp takes on the device."""

    def __init__(self, host):
        self.host, self.expired = host, lambda: False

    def allocate(self, size):
        address = self.host.allocate(size)
        memory[-address] = (address, size, self)
        return address

    def deallocate(self, address, size):
        del memory[-address]
        self.host.deallocate(address, size)


@functools.cache
def warp_card(_host):
    card = copy.copy(wp._src.context.runtime.cpu_device)
    card._stream, card.default_allocator = Stream(0, card), Memory(card.default_allocator)
    return card


@contextmanager
def at_work(stream):
    """What torch.cuda.stream does."""
    current.append(stream.cuda_stream)
    yield
    current.pop()


def as_tensor(to_torch, array, requires_grad=None):
    """The tensor of an array of Warp's."""
    found = to_torch(array, requires_grad=False)
    found = Pretended(found) if array.device is warp_device(CARD) else found
    if array.requires_grad if requires_grad is None else requires_grad:
        found.requires_grad_()
        found.grad = as_tensor(to_torch, array.grad, False) if array.grad is not None else None
    return found


def pretend() -> None:
    """Put all that in the place of torch's and Warp's."""
    names = {"is_available": True, "device_count": 1, "current_device": 0, "is_initialized": True, "empty_cache": None}
    names |= {"get_device_name": "A GPU that is pretended", "mem_get_info": (2**34, 2**35)}
    names |= dict.fromkeys(("memory_reserved", "memory_allocated", "max_memory_allocated"), 0)
    names |= dict.fromkeys(("reset_peak_memory_stats", "set_device", "set_sync_debug_mode"))
    for name, value in names.items():
        setattr(torch.cuda, name, lambda *args, value=value, **options: value)
    torch.cuda.synchronize = lambda *args: wait("synchronize")
    torch.cuda.stream, torch.cuda.current_stream = at_work, lambda *args: Stream(current[-1], CARD)
    torch.cuda.Event, torch.Generator = Event, Generator
    torch.Tensor.pin_memory = lambda tensor: torch.ops.aten._pin_memory(tensor)  # noqa: PLW0108 - an attribute that is a function
    wp.config.enable_cpu_blocks = True
    wp.launch, wp.launch_tiled = launching(wp.launch), launching(wp.launch_tiled)
    wp.is_cuda_available, wp.get_cuda_driver_version = (lambda: True), wp.get_cuda_toolkit_version
    wp.stream_from_torch = lambda stream: Stream(stream.cuda_stream, warp_device(stream.device))
    wp.stream_to_torch = lambda device: Stream(device.stream.cuda_stream, CARD)
    device = wp._src.context.Device  # a GPU to who asks in this package, to Warp the CPU
    device.is_cuda = property(lambda it: it._stream and "/warp_splat/" in sys._getframe(1).f_code.co_filename)
    device.stream = property(lambda it: it._stream)
    device.set_stream = lambda it, stream, sync=True: setattr(it, "_stream", stream)
    read = wp.array.numpy
    wp.array.numpy = lambda array: (array.device is warp_device(CARD) and wait("copy to the host")) or read(array)
    wp.device_from_torch = wp._src.torch.device_from_torch = warp_device
    wp.to_torch = wp._src.torch.to_torch = functools.partial(as_tensor, wp.to_torch)
    start = threading.Thread._bootstrap_inner

    def start_pretending(thread):
        with Names(), Operations():
            start(thread)

    threading.Thread._bootstrap_inner = start_pretending
    modes = ExitStack()  # till the process ends
    modes.enter_context(Names())
    modes.enter_context(Operations())
    atexit.register(modes.close)


def tell(path: str) -> None:
    """Add the notes to the file."""
    with open(path, "a") as file:
        file.writelines(json.dumps(note) + "\n" for note in notes)


pretend()
if os.environ.get("PRETEND_CUDA"):
    atexit.register(tell, os.environ["PRETEND_CUDA"])
