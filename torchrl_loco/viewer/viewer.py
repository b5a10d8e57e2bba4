"""Worlds and their page together: in real time, in a loop or beside a notebook."""

import atexit
import os
import queue
import threading
import time
from collections.abc import Callable
from typing import Any

from torchrl_loco.checks import check_float, check_int
from torchrl_loco.viewer.player import Player
from torchrl_loco.viewer.settings import LOOPBACK, PORT, PORTS, SHARE, WORLDS, check_host, check_viewer, url_of

SPEEDS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0)  # of the simulation, by real time
PICTURE, CURVES, LOOK_FOR_POLICY, IDLE = 1 / 30, 0.25, 1.0, 0.1
"""Time between two pictures, two updates of curves, two looks for a newer policy, and two looks for a page (s)."""


def cores() -> int:
    """Returns the number of cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Viewer:
    """Shows 1 to 64 worlds in the browser, live, under a policy; the page serves to steer and understand them.

    :meth:`run` plays them until it is interrupted, :meth:`start` in a thread of its own, as in a notebook, where the
    viewer shows its page as the result of a cell. The worlds stand still while no browser shows the page.

    Args:
        env: the worlds. Nobody else may step them meanwhile. With ``reward_terms=True`` there are curves of the terms,
            with ``play=True`` sliders for the commands that the task declares. Arrows of forces are of the model's
            nominal numbers, where worlds differ in them.
        policy: reads ``observation`` and writes ``action``; ``None`` waits for ``newer``.
        action_repeat: control steps for which an action is held; ``None`` takes that of ``policy.info``, else 1.
        newer: called now and then, returns another policy to go on with, or ``None``.
        cpu_share: how much of the machine's CPU time this process may take; pictures come slower when it takes more.
        host: address that the server listens on, or ``localhost``. There is no password: whoever reaches it can steer
            the worlds. Requests of other sites' pages are refused.
        port: its port; the next free one if it is taken.

    Raises:
        ImportError: the extra ``viewer`` is not installed.
        ValueError: there are more than 64 worlds, or ``host`` is no address.
        OSError: ``host`` is none of this machine.
    """

    def __init__(
        self,
        env: Any,
        policy: Callable[[Any], Any] | None,
        action_repeat: int | None = None,
        *,
        newer: Callable[[], Callable[[Any], Any] | None] | None = None,
        cpu_share: float = 1.0,
        host: str = LOOPBACK,
        port: int = PORT,
    ) -> None:
        check_viewer()
        check_int("num_envs", env.num_envs, WORLDS)
        check_float("cpu_share", cpu_share, SHARE)
        check_int("port", port, PORTS)
        if action_repeat is not None:
            check_int("action_repeat", action_repeat)
        from torchrl_loco.viewer.page import Page

        self._requests: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._newer, self._host = newer, check_host(host)
        self._allowed = cpu_share * cores()
        self.player = Player(env, policy, action_repeat)
        self.page = Page(self.player, self._host, port, type(env).__name__, self._requests.put)
        clock = {"Play/Pause": self._pause, "Step": self._step_once, "Reset": self._reset}
        self.page.on_click(self.page.clock, lambda name: clock[name]())
        self.page.on_click(self.page.speed, self._change_speed)
        self.paused, self.speed = False, 1.0
        self._thread: threading.Thread | None = None
        self._ends = threading.Event()
        self._due = {"picture": 0.0, "curves": 0.0, "policy": 0.0}
        self._last, self._owed, self._measured = time.perf_counter(), 0.0, (time.perf_counter(), 0)
        self._real_speed = 0.0
        self.page.show_worlds()
        self._show_numbers()
        self._spent, self._awake = time.process_time(), time.perf_counter()

    @property
    def url(self) -> str:
        """Address of the page on this machine."""
        return url_of(self._host, self.page.server.get_port())

    # Playing.

    def run(self) -> None:
        """Plays until :meth:`close` is called, or it is interrupted."""
        try:
            while not self._ends.is_set():
                self.tick()
        finally:
            self.page.server.stop()

    def start(self) -> "Viewer":
        """Returns itself; it plays in a thread of its own until :meth:`close` is called."""
        self._thread = threading.Thread(target=self.run, name="torchrl-loco viewer", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # before the worlds are, which the thread would step on
        return self

    def close(self) -> None:
        """Ends :meth:`run` or what :meth:`start` began, and the page with it; the worlds stay."""
        self._ends.set()
        atexit.unregister(self.close)
        if self._thread is None:
            self.page.server.stop()
        else:
            self._thread.join()

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" width="100%" height="640" style="border: 0"></iframe>'

    def tick(self) -> None:
        """Does what was clicked and what is due, and waits until something is due again."""
        now = time.perf_counter()
        while not self._requests.empty():
            self._requests.get()()
            self._due["picture"] = self._due["curves"] = 0.0
        if self._newer is not None and self._is_due("policy", now, LOOK_FOR_POLICY):
            if (policy := self._newer()) is not None:
                self.player.policy, self._due["curves"] = policy, 0.0
        elapsed, self._last = now - self._last, now
        if not self.page.watched:
            self._rest(IDLE)
            return
        if not self.paused and self.player.policy is not None:
            self._owed += elapsed * self.speed
            until = now + PICTURE
            while self._owed >= self.player.dt and time.perf_counter() < until:
                self.step()
                self._owed -= self.player.dt
            self._owed = min(self._owed, self.player.dt)  # what the machine cannot keep up with is not made up for
        if self._is_due("picture", now, PICTURE):
            self.page.show_worlds()
        if self._is_due("curves", now, CURVES):
            self._show_numbers()
        self._rest(min(self._due["picture"], now + self.player.dt) - time.perf_counter())

    def _rest(self, seconds: float) -> None:
        """Waits, and longer if this process has taken more of the CPU since the last time than it may."""
        spent = time.process_time()
        owed = (spent - self._spent) / self._allowed - (time.perf_counter() - self._awake)
        self._spent = spent
        self._ends.wait(max(0.001, seconds, owed))
        self._awake = time.perf_counter()

    def _is_due(self, what: str, now: float, every: float) -> bool:
        if now < self._due[what]:
            return False
        self._due[what] = max(now, self._due[what] + every)
        return True

    def step(self) -> None:
        """Takes a control step in every world, if there is a policy."""
        if self.player.policy is not None:
            self.player.step()

    # What is clicked.

    def _pause(self) -> None:
        self.paused, self._owed = not self.paused, 0.0

    def _step_once(self) -> None:
        self.paused = True
        self.step()

    def _reset(self) -> None:
        self.player.reset()
        self._measured = time.perf_counter(), 0

    def _change_speed(self, to: str) -> None:
        at = SPEEDS.index(self.speed) + {"Slower": -1, "Real time": 0, "Faster": 1}[to]
        self.speed = 1.0 if to == "Real time" else SPEEDS[min(max(at, 0), len(SPEEDS) - 1)]

    # What is shown.

    def _show_numbers(self) -> None:
        player, now = self.player, time.perf_counter()
        since, steps = self._measured
        if now - since >= 1.0:
            self._real_speed = (player.steps - steps) * player.dt / (now - since)
            self._measured = now, player.steps
        self.page.show_curves()
        policy, info = "no policy yet", getattr(player.policy, "info", {})
        if player.policy is not None:
            policy = f"policy of {info['frames']:,} frames" if "frames" in info else "policy"
        pace = "paused" if self.paused else f"speed {self.speed:g}, reached {self._real_speed:.2f}"
        self.page.show_status(f"{policy} · {player.steps * player.dt:.1f} s · {pace}")
