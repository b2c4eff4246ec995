"""Frames written in a thread during the next frame: in order, one at a time, with errors reported, no partial files."""

import threading

import pytest

from torch_backend.contract import Cancelled
from torch_backend.freeze.take.background_writer import MAX_BACKGROUND_BYTES, BackgroundWriter


def test_frame_is_written_while_the_next_is_rendered():
    free, done = threading.Event(), []
    with BackgroundWriter() as out:
        out.write(lambda: done.append(free.wait(20)), 1)
        assert done == []
        free.set()  # the main thread reaches this line, so it does not wait for the write
    assert done == [True]


def test_one_is_written_at_a_time_and_in_order():
    done, most, now, lock = [], 0, 0, threading.Lock()

    def work(n):
        nonlocal most, now
        with lock:
            now += 1
            most = max(most, now)
        done.append(n)
        with lock:
            now -= 1

    with BackgroundWriter() as out:
        for n in range(20):
            out.write(lambda n=n: work(n), 1)
            assert done[:n] == list(range(n)), "the one before is on disk by now"
    assert done == list(range(20)) and most == 1


def test_oversized_frame_is_written_synchronously():
    thread = []
    with BackgroundWriter() as out:
        out.write(lambda: thread.append(threading.current_thread()), MAX_BACKGROUND_BYTES + 1)
        assert thread == [threading.main_thread()]
        out.write(lambda: thread.append(threading.current_thread()), MAX_BACKGROUND_BYTES)
    assert thread[1] is not threading.main_thread()


def fails():
    raise OSError(28, "No space left on device")


def test_what_a_write_raises_comes_out_of_the_next_one_and_nothing_more_is_written():
    done = []
    with pytest.raises(OSError, match="No space left"), BackgroundWriter() as out:
        out.write(fails, 1)
        out.write(lambda: done.append(1), 1)
    assert done == []


def test_what_the_last_write_raises_comes_out_at_the_end():
    with pytest.raises(OSError, match="No space left"), BackgroundWriter() as out:
        out.write(fails, 1)


def test_a_cancel_lets_what_was_begun_be_written():
    free, done = threading.Event(), []
    with pytest.raises(Cancelled), BackgroundWriter() as out:
        out.write(lambda: done.append(free.wait(20)), 1)
        free.set()
        raise Cancelled
    assert done == [True]
    with pytest.raises(Cancelled), BackgroundWriter() as out:
        out.write(fails, 1)
        raise Cancelled
