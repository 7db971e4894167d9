"""Ctrl-C waits until a record is written, and no longer; what others do with it is left alone."""

from __future__ import annotations

import signal
import threading

import pytest

from ctreg_cli.io.interrupts import records, uninterrupted


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def test_it_waits_for_the_end_of_the_outermost_block_and_comes_once() -> None:
    done = []

    def write() -> None:
        with uninterrupted():
            with uninterrupted():
                press()
                done.append("inner")
            press()
            done.append("outer")
        done.append("beyond")

    with records():
        with pytest.raises(KeyboardInterrupt):
            write()
        with uninterrupted():
            done.append("next")
    assert done == ["inner", "outer", "next"]


def test_between_records_it_comes_at_once_and_afterwards_all_is_as_before() -> None:
    before = signal.getsignal(signal.SIGINT)
    with records():
        with uninterrupted():
            pass
        with pytest.raises(KeyboardInterrupt):
            press()
    assert signal.getsignal(signal.SIGINT) is before
    with uninterrupted(), pytest.raises(KeyboardInterrupt):
        press()


def test_an_error_meanwhile_says_more() -> None:
    def fail() -> None:
        with uninterrupted():
            press()
            raise OSError("disk")

    with records(), pytest.raises(OSError, match="disk"):
        fail()


def test_where_ctrl_c_is_ignored_it_stays_so() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with records(), uninterrupted():
            press()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_another_thread_neither_changes_the_handler_nor_holds_anything() -> None:
    def write() -> None:
        with records(), uninterrupted():
            inside.append(signal.getsignal(signal.SIGINT))

    inside: list[object] = []
    thread = threading.Thread(target=write)
    thread.start()
    thread.join()
    assert inside == [signal.default_int_handler]
