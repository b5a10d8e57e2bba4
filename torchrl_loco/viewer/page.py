"""The page of the viewer: scene, buttons, sliders and curves. What is clicked is passed on, not done here."""

import contextlib
import functools
import http
import io
import itertools
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
import viser
import websockets.asyncio.server
from mjviser import ViserMujocoScene
from viser import uplot

from torchrl_loco.config import CONVERGED
from torchrl_loco.motion import poses
from torchrl_loco.viewer.player import Player
from torchrl_loco.viewer.settings import is_foreign

SPACING = 1.5  # distance between worlds, by the size of the model
ELEVATION, AZIMUTH = np.deg2rad(20.0), np.deg2rad(120.0)  # where the camera is at first, seen from the chosen world
COLORS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf")
"""Of the lines of a plot, again from the first after the last."""
OVER_TIME = {"x": uplot.Scale(time=False, auto=True)}  # a plot's axis of seconds, which are no dates


_SERVING = threading.Lock()


@contextlib.contextmanager
def _for_own_page() -> Iterator[None]:
    """Lets the server that viser starts meanwhile refuse requests of other sites' pages: viser has no such setting."""
    module: Any = websockets.asyncio.server
    serve, served = module.serve, list[int]()

    def serve_own(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if is_foreign(host, request.headers.get("Host"), request.headers.get("Origin")):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "this page is for its own host only\n")
            return process_request(connection, request)

        served.append(port)
        return serve(handler, host, port, process_request=process, **options)

    with _SERVING:
        module.serve = serve_own
        try:
            yield
        finally:
            module.serve = serve
    if not served:
        raise RuntimeError("this version of viser starts its server in another way: install viser 1.1")


class _Server(viser.ViserServer):
    """A quiet server that opens no tunnel: any client could ask for one, and the page would be public."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Does nothing."""

    def stop(self) -> None:
        """Stops the server."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()


class Page:
    """The page of some worlds, under a title; the next free port serves it if its own is taken.

    ``act`` takes what a click asks for, a function to be called by whoever steps the worlds. ``world`` is the index of
    the chosen world; clicks on the buttons ``clock`` and ``speed`` are for the caller.
    """

    def __init__(
        self, player: Player, host: str, port: int, title: str, act: Callable[[Callable[[], None]], None]
    ) -> None:
        self._player, self._act, self.world = player, act, 0
        with contextlib.redirect_stdout(io.StringIO()), _for_own_page():  # without viser's banner
            self.server = _Server(host, port, verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        has_ghost = player.env.ghost() is not None
        self._model = player.env.model_with_ghost if has_ghost else player.env.mujoco_model()
        for name in ("iterations", "ls_iterations"):  # for the forces that arrows show, whatever the worlds' own are
            setattr(self._model.opt, name, CONVERGED[name])
        self.scene = ViserMujocoScene(self.server, self._model, player.env.num_envs)
        side = int(np.ceil(np.sqrt(player.env.num_envs)))
        self._spacing = SPACING * self._model.stat.extent
        rows, columns = np.divmod(np.arange(player.env.num_envs), side)
        self._places = self._spacing * np.stack([-rows, columns, 0 * rows], axis=1)
        distance = 1.6 * self._model.stat.extent + 0.4 * (side - 1) * self._spacing
        away = [-np.cos(ELEVATION) * np.cos(AZIMUTH), -np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)]
        self.server.initial_camera.position = tuple(distance * np.array(away))
        self.server.initial_camera.look_at = (0.0, 0.0, 0.0)  # the chosen world is kept there
        gui = self.server.gui
        gui.add_markdown(f"**{title}**")
        self._status = gui.add_markdown("")
        self.clock = gui.add_button_group("Clock", ("Play/Pause", "Step", "Reset"))
        self.speed = gui.add_button_group("Speed", ("Slower", "Real time", "Faster"))
        self._make_choice()
        self._sliders: dict[str, list[Any]] = {}
        for entry, ranges in player.env.command_ranges.items() if player.env.play else ():
            self._make_command(entry, ranges)
        self._make_curves()

    @property
    def watched(self) -> bool:
        """Whether the page is open in a browser."""
        return bool(self.server.get_clients())

    # Controls. What a page sends is taken only if its controls could have sent it.

    def on_click(self, buttons: Any, do: Callable[[str], None]) -> None:
        """Has whoever steps the worlds call ``do`` with the name of the button that is clicked."""

        def clicked(event: Any) -> None:
            name = event.target.value
            if name in event.target.options:
                self._act(lambda: do(name))

        buttons.on_click(clicked)

    def _make_choice(self) -> None:
        gui, n = self.server.gui, self._player.env.num_envs
        self.choice = gui.add_slider("World", 0, max(1, n - 1), 1, 0, visible=n > 1)
        self.follow = gui.add_checkbox("Follow", True, hint="Keep the chosen world in the middle of the picture.")
        self.alone = gui.add_checkbox("Hide other worlds", False, visible=n > 1)
        self.forces = gui.add_checkbox("Contacts and forces", False, hint="Of the chosen world, by C MuJoCo.")
        for control in (self.choice, self.follow, self.alone, self.forces):
            control.on_update(lambda _: self._act(self._choose))

    def _choose(self) -> None:
        if not self.follow.value and self.scene.camera_tracking_enabled:
            self._move_cameras(self._followed)  # the scene goes back to its own coordinates
        if self.follow.value and not self.scene.camera_tracking_enabled:
            self._move_cameras(-self._followed)
        if _in_range(self.choice):
            self.world = int(self.choice.value)
        else:
            self.choice.value = self.world
        self.scene.camera_tracking_enabled = self.follow.value
        self.scene.show_only_selected = self.alone.value
        self.scene.show_contact_points = self.scene.show_contact_forces = self.forces.value

    def _move_cameras(self, by: np.ndarray) -> None:
        for client in self.server.get_clients().values():
            if np.isfinite([client.camera.position, client.camera.look_at]).all():
                client.camera.position = client.camera.position + by  # which takes what it looks at along

    @property
    def _followed(self) -> np.ndarray:
        """Place of the first body that moves, of the chosen world (m)."""
        body = int(np.flatnonzero(self._model.body_weldid)[0])
        return self._player.env.sim.xpos[self.world, body].cpu().numpy().astype(float)

    def _make_command(self, entry: str, ranges: Any) -> None:
        gui = self.server.gui
        with gui.add_folder(entry.replace("_", " ").capitalize()):
            by_hand = gui.add_checkbox("Set by hand", False, hint="In all worlds; else each draws its own.")
            start = self._player.command(entry, self.world)
            sliders = []
            for (name, (low, high)), value in zip(ranges.items(), start, strict=True):
                step = (high - low) / 100
                sliders.append(gui.add_slider(name, low, high, step, min(max(value, low), high)))
        self._sliders[entry] = [by_hand, *sliders]

        numbers = [slider.value for slider in sliders]  # the last that were in range

        def set_command() -> None:
            env = self._player.env
            row = torch.tensor(numbers).reshape(env.world.memory[entry].shape[1:])
            env.set_command(row if by_hand.value else None, entry)

        def moved(k: int, event: Any) -> None:
            if not _in_range(event.target):
                event.target.value = numbers[k]
                return
            numbers[k] = event.target.value
            if event.client is not None:  # by a person, not by show()
                by_hand.value = True
                self._act(set_command)

        by_hand.on_update(lambda event: self._act(set_command))
        for k, slider in enumerate(sliders):
            slider.on_update(functools.partial(moved, k))

    def _make_curves(self) -> None:
        gui, names = self.server.gui, self._player.term_names
        returns = ("this world", "mean of all")[: self._player.env.num_envs]
        with gui.add_folder("Return of the episode"):
            self._return = gui.add_uplot(*_plot(returns), scales=OVER_TIME, height=180)
        self._terms = None
        if names:
            with gui.add_folder("Terms of the reward"):
                self._terms = gui.add_uplot(*_plot(names), scales=OVER_TIME, height=240)

    # What is shown.

    def show_worlds(self) -> None:
        """Shows the present state of all worlds; the chosen one stands in its own place, the others beside it."""
        sim, chosen = self._player.env.sim, self.world
        shift = self._places - self._places[chosen]
        names = ("qpos", "qvel", "ctrl") if self.forces.value else ()
        of_forces = {name: getattr(sim, name).cpu().numpy() for name in names}
        pos, mat = sim.xpos.cpu().numpy(), sim.xmat.cpu().numpy().copy()
        if (ghost := self._player.env.ghost()) is not None:
            qpos = torch.cat([sim.qpos, ghost], dim=-1).cpu().numpy()
            pos, mat = (each.astype(np.float32) for each in poses(self._model, qpos))
            if of_forces:
                of_forces |= {"qpos": qpos, "qvel": np.pad(of_forces["qvel"], ((0, 0), (0, sim.qvel.shape[1])))}
        self.scene.update_from_arrays(pos + shift[:, None].astype(np.float32), mat, env_idx=chosen, **of_forces)

    def show_curves(self) -> None:
        """Shows curves and command of the chosen world."""
        times, returns, terms = self._player.curves(self.world)
        if len(times) > 1:
            self._return.data = (times, *np.ascontiguousarray(returns.T)[: self._player.env.num_envs])
            if self._terms is not None:
                self._terms.data = (times, *np.ascontiguousarray(terms.T))
        for entry, (by_hand, *sliders) in self._sliders.items():
            if not by_hand.value:
                for slider, value in zip(sliders, self._player.command(entry, self.world), strict=True):
                    slider.value = round(min(max(value, slider.min), slider.max), 2)

    def show_status(self, text: str) -> None:
        """Shows a line of Markdown above the controls."""
        if self._status.content != text:
            self._status.content = text


def _in_range(slider: Any) -> bool:
    """Returns whether a slider is where a person can move it, and so not NaN."""
    return slider.min <= slider.value <= slider.max


def _plot(names: tuple[str, ...]) -> tuple[tuple[np.ndarray, ...], tuple[uplot.Series, ...]]:
    """Returns data, as yet none, and lines of a plot over time."""
    colors = zip(names, itertools.cycle(COLORS), strict=False)
    lines = [uplot.Series(label=name, stroke=color, width=1.5, show=True) for name, color in colors]
    return tuple(np.zeros(1) for _ in range(1 + len(names))), (uplot.Series(label="time (s)"), *lines)
