# SPDX-License-Identifier: Apache-2.0
"""A world model that misbehaves in the way that the first pixel of its first observation says; see `WAYS`.

With pixel 0 it does as it should: each frame is the observation, brightened by the number of the frame.
"""

from __future__ import annotations

import ctypes
import gc
import locale
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings

import numpy as np

import wiw

SIZE = (8, 16)
KEPT: list[object] = []


class Leaving(BaseException):
    """Exception of a library that passes all handlers of `Exception`."""


def imagine(observations, controls):
    steps = np.arange(len(controls[0].actions) + 1, dtype=np.uint8)
    return observations.image[:, None] + steps[:, None, None, None]


class Bad(wiw.WorldModel):
    accepts = wiw.accepts(control="image", view="perspective", size=SIZE, frames=3)

    def rollout(self, observations, controls, seeds):
        way = WAYS[int(observations.image[0, 0, 0, 0]) - 1] if observations.image[0, 0, 0, 0] else None
        frames = imagine(observations, controls)
        answer = None if way is None else way(observations, controls, seeds, frames)
        return frames if answer is None else answer


def segfault(*_):
    ctypes.string_at(0)


def abort(*_):
    os.abort()


def kill_itself(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def overflow_stack(*_):
    ctypes.CFUNCTYPE(None)(lambda: None)
    (ctypes.c_char * 64).from_address(8)[:] = b"x" * 64


def exit_at_once(*_):
    os._exit(0)


def call_sys_exit(*_):
    sys.exit(0)


def raise_exception(*_):
    raise ValueError("no \x1b[31mcolour")


class SpeechlessError(Exception):
    def __str__(self):
        raise KeyError("words")


def raise_without_words(*_):
    raise SpeechlessError


def raise_base_exception(*_):
    raise Leaving("enough")


def raise_keyboard_interrupt(*_):
    raise KeyboardInterrupt


def recurse(*_):
    recurse()


def eat_memory(*_):
    while True:
        KEPT.append(np.ones(2**24, np.uint8))


def hang(*_):
    time.sleep(1000)


def hang_in_compiled_code(*_):
    ctypes.PyDLL(None).sleep(1000)  # with Python's lock held


def hang_without_signals(*_):
    signal.pthread_sigmask(signal.SIG_BLOCK, set(signal.valid_signals()))
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(1000)


def stop_itself(*_):
    os.kill(os.getpid(), signal.SIGSTOP)


def start_daemon_thread(*_):
    threading.Thread(target=time.sleep, args=(1000,), daemon=True).start()


def start_thread(*_):
    threading.Thread(target=time.sleep, args=(1000,)).start()


def fork(*_):
    if os.fork() == 0:
        time.sleep(1000)
        os._exit(0)


def start_process(*_):
    KEPT.append(subprocess.Popen(["sleep", "1000"]))


def change_random_state(*_):
    np.random.seed(7)  # noqa: NPY002 - what models do
    random.seed(7)


def change_arguments(observations, controls, seeds, frames):
    observations.image[:] = 255
    seeds[:] = 9
    for control in controls:
        control.trajectory[:] = 4.0


def write_to_stdout(*_):
    print("noise" * 100)
    os.write(1, b"more noise")
    sys.stdout.flush()


def close_streams(*_):
    for stream in (sys.stdin, sys.stdout):
        stream.close()
    os.close(0)
    os.close(1)


def change_surroundings(*_):
    os.chdir("/")
    os.environ["WIW_NUM_THREADS"] = "99"
    sys.path.clear()
    sys.argv[:] = ["rm"]
    os.umask(0)
    locale.setlocale(locale.LC_ALL, "C")
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    np.seterr(all="raise")
    warnings.simplefilter("error")
    gc.disable()
    sys.setrecursionlimit(50_000)
    threading.stack_size(2**20)


def lie_about_shapes(observations, controls, seeds, frames):
    return frames[:, :, :4]


def lie_about_types(observations, controls, seeds, frames):
    class Array(np.ndarray):
        shape = frames.shape
        dtype = np.dtype(np.uint8)

    return np.zeros(3).view(Array)


def answer_without_numbers(observations, controls, seeds, frames):
    return np.full(frames.shape, np.nan)


def change_answer_later(observations, controls, seeds, frames):
    threading.Timer(0.05, frames.fill, (255,)).start()


def leak_descriptors(*_):
    KEPT.extend(os.open(os.devnull, os.O_RDONLY) for _ in range(200))


def close_descriptors(*_):
    os.closerange(3, 256)


def shout_into_connection(*_):
    for descriptor in range(3, 64):
        try:
            other = socket.socket(fileno=os.dup(descriptor))
            other.sendall(b"\xff" * 64)
        except OSError:
            continue


def break_imports(*_):
    sys.modules["numpy"] = None
    sys.modules["wiw"] = None


def change_torch(*_):
    try:
        import torch
    except ImportError:
        return
    torch.set_num_threads(7)
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(7)


FATAL = (
    segfault,
    abort,
    kill_itself,
    overflow_stack,
    exit_at_once,
    hang,
    hang_in_compiled_code,
    hang_without_signals,
    stop_itself,
    eat_memory,
    close_descriptors,
    shout_into_connection,
)
"""Cost the call and the process."""
FAILING = (
    call_sys_exit,
    raise_exception,
    raise_without_words,
    raise_base_exception,
    raise_keyboard_interrupt,
    recurse,
    lie_about_shapes,
    lie_about_types,
    answer_without_numbers,
)
"""Cost the call."""
HARMLESS = (
    start_daemon_thread,
    start_thread,
    fork,
    start_process,
    change_random_state,
    change_arguments,
    write_to_stdout,
    close_streams,
    change_surroundings,
    change_answer_later,
    leak_descriptors,
    break_imports,
    change_torch,
)
"""Cost nothing: the answer is as it should be."""
WAYS = (*FATAL, *FAILING, *HARMLESS)


class Peeping(wiw.WorldModel):
    """Tells what it finds around it."""

    accepts = Bad.accepts

    def describe(self):
        simulators = [thing for thing in gc.get_objects() if type(thing).__name__ in ("NavigationEnv", "Renderer")]
        return {
            "name": "Peeping",
            "argv": sys.argv,
            "simulators": len(simulators),
            "main": getattr(sys.modules["__main__"], "__file__", ""),
            "modules": sorted(name for name in sys.modules if name.startswith(("wiw.envs", "wiw.tasks", "wiw.runs"))),
        }

    def rollout(self, observations, controls, seeds):
        return imagine(observations, controls)
