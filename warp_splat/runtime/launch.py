"""The only place that calls ``wp.launch``: streams, memory, and views of torch tensors.

On the CPU, a Warp launch runs on the thread that makes it and releases the interpreter's lock. Every kernel here takes
the first index of its slice, so that the threads of :mod:`.pool` can share a launch. A kernel writes each element
from one index only, so the result does not depend on the slices, bit for bit. On a GPU a launch is one slice, on
torch's current stream: kernels of Warp and of torch follow each other in the order of the calls.

No launch is recorded: tapes are the process's, and a user's would try to differentiate the package's own kernels.

All memory is torch's, on either device: its caching allocator gives what a stage frees to the next.
"""

import ctypes
import functools
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import psutil
import torch
import warp as wp

from warp_splat.errors import InputError
from warp_splat.kernels.compiler import once
from warp_splat.runtime.devices import choose_device, kernels_kept
from warp_splat.runtime.pool import even_slices, in_slices, set_threads

#: Else Warp leaves assembling to newer drivers; benchmarks/cubins.py looks at what its own assembler makes.
wp.config.cuda_output = wp.config.cuda_output or "cubin"
#: What a kernel gets as an array and as the number of its indices; what makes its arguments of all else.
_Array, _Bounds = wp._src.types.array_t, wp._src.types.launch_bounds_t  # pyright: ignore[reportAttributeAccessIssue]
_pack = wp._src.context.pack_arg  # pyright: ignore[reportAttributeAccessIssue]


def prepare(device: str, threads: int) -> torch.device:
    """Set up the process for a run: Warp's messages, torch's threads, number of threads (0: all cores), memory.

    Args:
        device: "auto", "cpu" or "cuda".
        threads: of CPU launches.

    Returns:
        The device to work on.

    Raises:
        InputError: if that device cannot be used here; the message says why.
    """
    wp.config.log_level = wp.LOG_ERROR  # no list of devices and modules
    # One thread for torch: its sums would depend on the number of threads, and its idle threads would spin beside ours.
    # Ours call torch, too, and share its work on many rows (torch_slices).
    torch.set_num_threads(1)
    # Autograd's thread for a GPU and ours would wait for each other: 5.2 instead of 3.7 ms for a small step.
    torch.autograd.set_multithreading_enabled(False)
    if threads:
        set_threads(threads)
    _keep_freed_memory()
    return choose_device(device)


def _keep_freed_memory() -> None:
    """Let glibc reuse what a step frees instead of returning it to the system and faulting it in again.

    A step allocates tens of megabytes; first touches of fresh pages cost 1 to 5 us each on virtual machines, up to
    half of a step. Elsewhere than on glibc nothing happens. No difference: huge pages (glibc.malloc.hugetlb=1).
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL("libc.so.6").mallopt
        m_trim_threshold, m_mmap_max = -1, -4  # of malloc.h
        mallopt(m_mmap_max, 0)
        mallopt(m_trim_threshold, 2**31 - 1)


def available_memory(device: torch.device) -> int:
    """Bytes that can be had on ``device``: without swapping, or with what torch holds in reserve."""
    if device.type == "cpu":
        return psutil.virtual_memory().available
    reserve = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + reserve


def check_memory(what: str, needed: int, device: torch.device, instead: str, share: float = 1.0) -> None:
    """Raise InputError if ``needed`` bytes are more than this share of what can be had.

    ``what`` takes them, a clause, and what to do ``instead``, another.
    """
    if needed > share * (available := available_memory(device)):
        raise InputError(f"{what} {needed / 2**30:.1f} GiB, but only {available / 2**30:.1f} GiB are free; {instead}.")


def launch(
    kernel: wp.Kernel,
    dim: int,
    inputs: Sequence,
    outputs: Sequence = (),
    *,
    bounds: list[int] | None = None,
    device: torch.device | str = "cpu",
    **adjoint,
) -> None:
    """Launch ``kernel`` on ``dim`` indices, sliced over the threads of the CPU, or at once on a GPU.

    Args:
        kernel: takes the first index of its slice before ``inputs``.
        dim: number of indices; nothing happens for 0.
        inputs: structs, scalars, Warp's arrays, torch's tensors and NumPy's arrays, seen as the kernel's types.
        outputs: likewise.
        bounds: bounds of the slices, by default one equal slice per thread; more slices than threads balance work.
        device: of the tensors behind ``inputs`` and ``outputs``.
        adjoint: ``adj_inputs`` and ``adj_outputs`` to run the generated adjoint instead.
    """
    if dim > 0:
        whole = torch.device(device).type == "cuda"
        in_slices(bind(kernel, inputs, outputs, device, **adjoint), [0, dim] if whole else bounds or even_slices(dim))


def bind(
    kernel: wp.Kernel, inputs: Sequence, outputs: Sequence, device: torch.device | str, **adjoint
) -> Callable[[int, int], object]:
    """A function that runs a slice of ``kernel``, with arguments as :func:`launch` takes them.

    So work on the same rows can share a slice, one after the other: threads wait for each other once, not each time.
    """
    middle = 1 + len(inputs)
    inputs, outputs = _viewed(kernel, inputs, 1), _viewed(kernel, outputs, middle)
    if adjoint:
        adj = [None, *_viewed(kernel, adjoint["adj_inputs"], 1)], _viewed(kernel, adjoint["adj_outputs"], middle)
        adjoint = {"adjoint": True, "adj_inputs": adj[0], "adj_outputs": adj[1]}
    if torch.device(device).type == "cuda":
        options = {"stream": _stream(device), "record_tape": False, **adjoint}
        return lambda low, high: wp.launch(kernel, high - low, [low, *inputs], outputs, **options)
    load("cpu", kernel)
    return _bound(kernel, [0, *inputs], outputs, adjoint)


def _viewed(kernel: wp.Kernel, values: Sequence, begin: int) -> list:
    """Arguments of ``kernel`` from that at ``begin`` on, torch's tensors and NumPy's arrays seen as its types."""
    given = (torch.from_numpy(value) if isinstance(value, np.ndarray) else value for value in values)
    pairs = zip(kernel.adj.args[begin : begin + len(values)], given, strict=True)
    return [view(value, a.type.dtype) if isinstance(value, torch.Tensor) else value for a, value in pairs]


#: By kernel, and whether its adjoint: its module, which stays loaded; a function; tables of what that is given.
_codes: dict[tuple[wp.Kernel, bool], tuple[Any, Callable, list[type[ctypes.Structure]]]] = {}


def _bound(kernel: wp.Kernel, inputs: Sequence, outputs: Sequence, adjoint: dict) -> Callable[[int, int], None]:
    """A function that runs a slice of ``kernel`` on the CPU.

    Warp's own launch tells once what there is to call: to look for it and to check arguments takes it 0.1 ms each time.
    """
    if wp.get_device("cpu").is_capturing:
        raise InputError("wp.ScopedCapture: expected none on the CPU, where it records no launch of warp_splat's.")
    if (code := _codes.get((kernel, bool(adjoint)))) is None:
        it = wp.launch(kernel, 1, inputs, outputs, device="cpu", record_tape=False, record_cmd=True, **adjoint)
        names, types = [argument.label for argument in kernel.adj.args], list(map(type, it.params[1:]))
        fields = [list(zip(names, types[i : i + len(names)], strict=True)) for i in range(0, len(types), len(names))]
        tables = [type("Arguments", (ctypes.Structure,), {"_fields_": of}) for of in fields]
        code = it.module_exec, it.hooks.backward if adjoint else it.hooks.forward, tables
        _codes[kernel, bool(adjoint)] = code
    _, begin, tables = code
    rows = [*inputs, *outputs], [*adjoint.get("adj_inputs", ()), *adjoint.get("adj_outputs", ())]
    arguments, *adjoints = (_packed(kernel, *pair) for pair in zip(tables, rows, strict=False))

    def run(low: int, high: int) -> None:
        own = type(arguments).from_buffer_copy(arguments)
        ctypes.c_int.from_buffer(own).value = low
        begin(ctypes.byref(_Bounds((high - low,))), ctypes.byref(own), *map(ctypes.byref, adjoints))

    return run


def _packed(kernel: wp.Kernel, table: type[ctypes.Structure], values: Sequence) -> ctypes.Structure:
    """Arguments of ``kernel`` as it reads them, or adjoints; Warp checks all but numbers and what :func:`view` made."""
    known, pairs = (_Array, int, float), zip(kernel.adj.args, values, strict=True)
    given = (v if isinstance(v, known) else _pack(kernel, a.type, a.label, v, "cpu", v is None) for a, v in pairs)
    packed: Any = table(*given)
    packed._ref = values  # whose memory nobody else may keep
    return packed


def open_tape() -> wp.Tape | None:
    """The tape of the caller's that records, if there is one."""
    return wp._src.context.runtime.tape  # pyright: ignore[reportAttributeAccessIssue] - the only way to ask for it


def launch_on_tape(kernel: wp.Kernel, dim: int, inputs: Sequence, outputs: Sequence, device: wp.Device) -> None:
    """The one launch that a caller's tape records; on a GPU on Warp's own stream, without a tape as :func:`launch`."""
    if open_tape() or device.is_cuda:
        wp.launch(kernel, dim=dim, inputs=[0, *inputs], outputs=outputs, device=device)
    else:
        launch(kernel, dim, inputs, outputs)


def launch_in_lanes(
    make: Callable[[int], wp.Kernel], lanes: int, inputs: Sequence, outputs: Sequence = (), run: int = 1, sums: int = 0
) -> torch.Tensor:
    """Launch ``make(lanes)``, a kernel for so many rows at once, on rows of tensors, ``make(1)`` on those left over.

    Args:
        make: of a number of lanes.
        lanes: of the device.
        inputs: dense tensors of as many rows, or what is the same for all and no tensor.
        outputs: likewise.
        run: groups of rows that an index of the kernel takes.
        sums: how many numbers each index writes besides.

    Returns:
        Those numbers, a row for each index of both kernels; none, if not asked for.
    """
    first = next(table for table in inputs if isinstance(table, torch.Tensor))
    count, whole, device = len(first), len(first) - len(first) % lanes, first.device
    most, left = -(-(whole // lanes) // run), -(-(count - whole) // run)
    found = torch.empty(most + left, sums, dtype=torch.float32, device=device)
    if count == 0:
        return found

    def bound(size: int, rows: slice, indices: slice) -> Callable[[int, int], object]:
        kernel = make(size)
        tables = [table[rows] if isinstance(table, torch.Tensor) else table for table in (*inputs, *outputs)]
        return bind(kernel, grouped(kernel, tables), [found[indices]] if sums else [], device)

    def run_slice(low: int, high: int) -> None:
        if low < most:
            in_groups(low, min(high, most))
        if high > most:  # while other threads are still at work
            bound(1, slice(whole, count), slice(most, None))(max(low - most, 0), high - most)

    in_groups = bound(lanes, slice(0, whole), slice(0, most))
    in_slices(run_slice, even_slices(most + left, each=lanes * run, device=device))
    return found


def send(values: torch.Tensor, device: torch.device) -> torch.Tensor:
    """``values`` of the host on ``device``, without waiting until a GPU takes them."""
    return (values.pin_memory() if device.type == "cuda" else values).to(device, non_blocking=True)


def read_later(values: torch.Tensor) -> Callable[[], list]:
    """What returns ``values``, which are on their way to the host: it waits for what was launched so far, no longer.

    So the GPU works on meanwhile, if more has been launched since.
    """
    on_gpu = values.device.type == "cuda"
    here = torch.empty_like(values, device="cpu", pin_memory=on_gpu).copy_(values, non_blocking=True)
    if not on_gpu:
        return here.tolist
    arrived = torch.cuda.Event()
    arrived.record(torch.cuda.current_stream(values.device))

    def read() -> list:
        arrived.synchronize()
        return here.tolist()

    return read


def filled_up(tensor: torch.Tensor, rows: int) -> torch.Tensor:
    """With rows of zeros up to so many; the tensor itself, if it has them."""
    missing = rows - tensor.shape[0]
    return torch.cat([tensor, tensor.new_zeros(missing, *tensor.shape[1:])]) if missing else tensor


def grouped(kernel: wp.Kernel, values: Sequence, begin: int = 1) -> list:
    """Arguments of ``kernel`` from the one at ``begin`` on; in a row of a tensor as many numbers as its type has."""
    pairs = zip(kernel.adj.args[begin:], values, strict=False)
    return [v.view(-1, *getattr(a.type.dtype, "_shape_", ())) if isinstance(v, torch.Tensor) else v for a, v in pairs]


@once
@kernels_kept
def load(device: torch.device | str, *kernels: wp.Kernel) -> None:
    """Compile and load ``kernels``, and what else is in their modules."""
    wp.init()
    for kernel in kernels:
        wp.load_module(kernel.module, device=wp.device_from_torch(device))


def launch_blocks(
    kernel: wp.Kernel, blocks: int, inputs: Sequence, outputs: Sequence, device: torch.device | str, **adjoint
) -> None:
    """Launch ``kernel`` on ``blocks`` blocks of as many threads as it was made for; nothing happens for 0.

    With ``adj_inputs`` and ``adj_outputs``, the generated adjoint instead.
    On the CPU that is a check of the kernels, not a way to work: only ``wp.config.enable_cpu_blocks`` makes a block of
    more than one thread there, and it makes it of slow fibers.
    """
    if blocks == 0:
        return
    where = {"stream": _stream(device)} if torch.device(device).type == "cuda" else {"device": "cpu"}
    where |= {"block_dim": kernel.module.options["block_dim"], "record_tape": False, "adjoint": bool(adjoint)}
    tables = {"inputs": inputs, "outputs": outputs, **adjoint}
    given = {name: _viewed(kernel, tables[name], len(inputs) * name.endswith("outputs")) for name in tables}
    wp.launch_tiled(kernel, dim=[blocks], **where, **given)


def _stream(device: torch.device | str) -> wp.Stream:
    """Torch's current stream as one of Warp's."""
    return _wrap(torch.cuda.current_stream(device))


@functools.cache  # one per stream in use, mostly one: wrapping costs tens of microseconds
def _wrap(stream: torch.cuda.Stream) -> wp.Stream:
    wp.init()  # launches do so, but need the stream before
    return wp.stream_from_torch(stream)


def view(tensor: torch.Tensor, dtype):
    """``tensor`` as a kernel argument of element type ``dtype``, without a copy. The caller keeps the tensor alive.

    In a third of the time of ``wp.from_torch``; a step asks for over a hundred of these, mostly of few shapes.
    """
    array = _Array.from_buffer_copy(_described(tensor.shape, tensor.stride(), tensor.dtype, dtype))
    array.data, array._ref = tensor.data_ptr(), tensor  # a copy, say, that nobody else has
    return array


@functools.lru_cache(1024)
def _described(shape: torch.Size, strides: tuple[int, ...], number: torch.dtype, dtype) -> bytes:
    """An array of that shape, at no place yet."""
    inner, size = getattr(dtype, "_shape_", ()), number.itemsize
    dims = len(shape) - len(inner)
    fits = dims > 0 and shape[dims:] == inner and strides[dims:] in ((), (*inner[1:], 1))
    if not fits or ctypes.sizeof(dtype._type_) != size:
        raise TypeError(f"expected elements of {dtype.__name__}, got {number} {list(shape)} with strides {strides}")
    return bytes(_Array(0, 0, dims, shape, [size * stride for stride in strides]))


def pack_struct(struct, **fields):
    """A ``struct`` of kernel arguments: tensors, as :func:`view`, Warp arrays or numbers. The caller keeps them alive.

    5 us for seven arrays, which a launch then takes 6 us less to pass; its slices share it.
    """
    packed = struct()
    for name, value in fields.items():
        given = view(value, struct.vars[name].type.dtype) if isinstance(value, torch.Tensor) else value
        setattr(packed.__ctype__(), name, given.__ctype__() if isinstance(given, wp.array) else given)
    return packed


def empty(count: int, dtype, device: torch.device | str) -> wp.array:
    """A Warp array of ``count`` elements in memory of torch's that lives as long as the array."""
    wp.init()  # it may be the first that a process asks of Warp
    memory = torch.empty(count * wp.types.type_size_in_bytes(dtype), dtype=torch.uint8, device=device)
    where = wp.device_from_torch(memory.device)
    array = wp.array(ptr=memory.data_ptr(), dtype=dtype, shape=count, device=where, copy=False)
    array._tensor = memory  # pyright: ignore[reportAttributeAccessIssue] - as wp.from_torch does
    return array
