"""Recorded launches: threads, numbers and structures that are refreshed each time; threads do not share them.

Also tests the workers that run a CPU stage together.
"""

import ctypes
import os
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import warp as wp

from torch_backend import native
from torch_backend.native import (
    INTEGER,
    POINTER,
    Snippet,
    func_native,
    initialised_warp,
    launch_on,
    run_workers,
    torch_threads,
)


def adding():
    """Kernel that computes out[i] += value."""
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
    second = torch.zeros(3)
    launch_on(KERNEL, 3, [second.data_ptr(), 8.0], CPU)
    launch_on(KERNEL, 1, [out.data_ptr(), 16.0], CPU)
    assert out.tolist() == [19.0, 3.0, 2.0, 2.0, 2.0, 2.0] and second.tolist() == [8.0, 8.0, 8.0]


def test_python_threads_launch_concurrently():
    outs = [torch.zeros(500) for _ in range(4)]

    def work(n):
        for _ in range(200):
            launch_on(KERNEL, 100 * (n + 1), [outs[n].data_ptr(), float(n + 1)], CPU)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    for n, out in enumerate(outs):
        assert (out[: 100 * (n + 1)] == 200.0 * (n + 1)).all() and not out[100 * (n + 1) :].any()


def test_plain_structure_replaces_a_warp_structure():
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


COUNTING = Snippet(
    "launching_count", {"out": POINTER, "units": INTEGER},
    "for (long long u; (u = __atomic_fetch_add(&P.counter, 1, __ATOMIC_RELAXED)) < P.units;) P.out[u] += stage + 1;",
)  # fmt: skip


def counted(threads, stages, units=5000):
    out = torch.zeros(units)
    for stage in range(stages):
        COUNTING.run(threads, stage, out=out.data_ptr(), units=units)
    return out


@pytest.mark.parametrize("threads", [1, 2, 9])
def test_workers_do_every_unit_of_every_stage_once(threads):
    assert (counted(threads, 3) == 6.0).all()


def test_callers_that_run_workers_at_once_do_not_mix():
    def work(n):
        return [counted(4, n + 1, 700) for _ in range(30)]

    with ThreadPoolExecutor(4) as pool:
        for n, outs in enumerate(pool.map(work, range(4))):
            assert all((out == (n + 1) * (n + 2) / 2).all() for out in outs)


class Block(ctypes.Structure):
    _fields_ = [("counter", ctypes.c_int64)]


@pytest.mark.parametrize("failing", [0, 2])
def test_an_error_of_a_worker_is_the_callers_once_all_have_ended(failing):
    ended = []

    def run(_address, stage, worker):
        if worker == failing:
            raise ArithmeticError(f"worker {worker} of stage {stage}")
        ended.append(worker)

    with pytest.raises(ArithmeticError, match=f"worker {failing} of stage 7"):
        run_workers(run, Block(), 7, 4)
    assert sorted([*ended, failing]) == [0, 1, 2, 3]
    ended.clear()
    run_workers(lambda _address, _stage, worker: ended.append(worker), Block(), 0, 4)
    assert sorted(ended) == [0, 1, 2, 3]


@pytest.mark.skipif(sys.platform == "win32", reason="a signal for one thread is POSIX")
def test_an_interrupt_is_raised_when_no_worker_is_at_the_block_any_more():
    main, at_work, begun, ended = threading.get_ident(), threading.Event(), [], []

    def run(_address, _stage, worker):
        if threading.get_ident() == main:
            assert at_work.wait(30.0)
        else:
            begun.append(worker)
            at_work.set()
            time.sleep(0.5)
            ended.append(worker)

    def interrupt():
        at_work.wait()
        time.sleep(0.1)
        signal.pthread_kill(main, signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            run_workers(run, Block(), 0, 3)
    finally:
        signal.signal(signal.SIGINT, before)
    assert begun and sorted(begun) == sorted(ended)
    thread.join()


def test_a_caller_does_itself_what_no_worker_has_begun():
    """Late or sleeping workers must not delay the caller."""
    crew, done, hold = native._Crew(), [], threading.Event()

    def busy(_address, _stage, _worker):
        hold.wait()

    crew.submit(native._Task(busy, 0, 0, 1), 1)  # its only thread is busy with another request
    ask = native._Task(lambda _address, _stage, worker: done.append(worker), 0, 0, 5)
    ask.carry_out(crew, 1)
    assert sorted(done) == [0, 1, 2, 3, 4] and not ask.errors
    hold.set()


def interrupted_at(step, work):
    """Run `work` with a Ctrl-C before the `step`-th instruction of `native` in this thread; False if there are fewer.

    Other threads get time to proceed before the interrupt.
    """
    passed = 0

    def look(frame, event, _arg):
        nonlocal passed
        frame.f_trace_opcodes = True
        if event == "opcode":
            passed += 1
            if passed == step:
                time.sleep(0.005)
                raise KeyboardInterrupt
        return look

    before = sys.gettrace()
    module_file = native.__file__
    sys.settrace(lambda frame, event, arg: look(frame, event, arg) if frame.f_code.co_filename == module_file else None)
    try:
        work()
    except KeyboardInterrupt:
        pass
    finally:
        sys.settrace(before)
    return passed >= step


def test_no_interrupt_leaves_a_worker_at_the_block():
    """For every moment of the interrupt: the block's memory is freed as soon as the caller returns."""
    main, at_block = threading.get_ident(), []

    def run(_address, _stage, worker):
        if threading.get_ident() != main:
            at_block.append(worker)
            time.sleep(0.02)
            at_block.remove(worker)

    run_workers(lambda *_: time.sleep(0.01), Block(), 0, 3)  # starts its threads
    step = 1
    while interrupted_at(step, lambda: run_workers(run, Block(), 0, 3)):
        assert not at_block, f"after {step} instructions"
        step += 1
    assert step > 50


def test_a_caller_that_gets_no_threads_does_it_all_itself(monkeypatch):
    """The system limits the number of threads, and no thread can start while Python shuts down."""

    def start(_self):
        raise RuntimeError("can't start new thread")

    crew, done = native._Crew(), []
    ask = native._Task(lambda _address, _stage, worker: done.append(worker), 0, 0, 4)
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", start)
        ask.carry_out(crew, 3)
    assert sorted(done) == [0, 1, 2, 3] and not ask.errors
    assert crew._queue.empty(), "nobody would ever take what lies there"


def test_workers_may_have_workers():
    """A task that runs workers itself must not deadlock."""
    done = []

    def inner(_address, stage, worker):
        time.sleep(0.001)
        done.append((stage, worker))

    def outer(_address, _stage, worker):
        run_workers(inner, Block(), worker, 3)

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda _: run_workers(outer, Block(), 0, 4), range(3)))
    assert sorted(done) == sorted([(stage, worker) for stage in range(4) for worker in range(3)] * 3)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows does not fork")
def test_forked_child_has_new_workers():
    counted(3, 1)
    child = os.fork()
    if child == 0:
        whole = bool((counted(3, 2) == 3.0).all())
        os._exit(0 if whole else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_torch_works_on_small_pictures_with_one_thread_and_gets_its_threads_back():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        for values, threads in ((3 * 320 * 240, 1), (3 * 640 * 480, 2), (3 * 1920 * 1080, 3)):
            with pytest.raises(ArithmeticError), torch_threads(values):
                assert torch.get_num_threads() == threads
                raise ArithmeticError
            assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
