"""What a recorded launch takes anew each time: threads, numbers, structures; and that threads do not share it."""

import ctypes
import threading

import torch
import warp as wp

from torch_backend.native import func_native, initialised_warp, launch_on


def adding():
    """out[i] += value, by a kernel of its own."""
    initialised_warp()

    def add(out: wp.uint64, value: wp.float32, tid: wp.int32): ...

    native = func_native("((float*)out)[tid] += value;")(add)

    def entry(out: wp.uint64, value: wp.float32):
        native(out, value, wp.tid())

    return wp.Kernel(entry, key="launching_add", module=wp.get_module("tests.launching"))


KERNEL = adding()
CPU = torch.device("cpu")


def test_threads_and_numbers_are_those_of_each_call():
    out = torch.zeros(6)
    launch_on(KERNEL, 2, [out.data_ptr(), 1.0], CPU)
    launch_on(KERNEL, 6, [out.data_ptr(), 2.0], CPU)
    launch_on(KERNEL, 0, [out.data_ptr(), 64.0], CPU)
    other = torch.zeros(3)
    launch_on(KERNEL, 3, [other.data_ptr(), 8.0], CPU)
    launch_on(KERNEL, 1, [out.data_ptr(), 16.0], CPU)
    assert out.tolist() == [19.0, 3.0, 2.0, 2.0, 2.0, 2.0] and other.tolist() == [8.0, 8.0, 8.0]


def test_threads_of_python_launch_beside_each_other():
    outs = [torch.zeros(500) for _ in range(4)]

    def work(n):
        for _ in range(200):
            launch_on(KERNEL, 100 * (n + 1), [outs[n].data_ptr(), float(n + 1)], CPU)

    workers = [threading.Thread(target=work, args=(n,)) for n in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for n, out in enumerate(outs):
        assert (out[: 100 * (n + 1)] == 200.0 * (n + 1)).all() and not out[100 * (n + 1) :].any()


def test_a_bare_structure_stands_for_a_warp_structure():
    wp_struct = wp.struct(type("Both", (), {"__annotations__": {"out": wp.uint64, "value": wp.float32}}))

    def fill(args, tid): ...

    fill.__annotations__ = {"args": wp_struct, "tid": wp.int32}
    native = func_native("((float*)args.out)[tid] = args.value;")(fill)

    def entry(args):
        native(args, wp.tid())

    entry.__annotations__ = {"args": wp_struct}
    kernel = wp.Kernel(entry, key="launching_fill", module=wp.get_module("tests.launching.structure"))
    out = torch.zeros(4)
    for count, value in ((3, 5.0), (2, 7.0)):
        bare = wp_struct.ctype()
        assert isinstance(bare, ctypes.Structure)
        bare.out, bare.value = out.data_ptr(), value
        launch_on(kernel, count, [bare], CPU)
    assert out.tolist() == [7.0, 7.0, 5.0, 0.0]
