"""The viewer: what it steps, shows and lets a person do, over the page's own connection; and in a real browser."""

import io
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
import torch
from for_each import for_each

import torchrl_loco as loco
from torchrl_loco import cli

pytest.importorskip("mjviser", reason="the extra viewer is not installed")

from browser_client import open_page
from generate.viewer import chrome
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from torchrl_loco.viewer.player import Player
from torchrl_loco.viewer.settings import is_foreign
from torchrl_loco.viewer.viewer import Viewer, cores


class Led(loco.WalkerStand):
    """Leans as it is told, by a command that is drawn anew at every step."""

    memory = {"command": 2}
    command_ranges = {"command": {"lean (rad)": (-1.0, 1.0), "height (m)": (0.5, 1.5)}}

    def reward(self, s):
        return {"lean": -(s.qpos[:, 2] - s.command[:, 0]).abs(), "height": s.xpos("torso")[:, 2] * s.command[:, 1]}

    def events(self, s):
        return {"command": s.uniform(0.5, 1.0, 2)}

    def observation(self, s):
        return torch.cat([s.qpos[:, 1:], s.qvel, s.command], dim=-1)

    def begin(self, s):
        return {"command": s.uniform(0.5, 1.0, 2)}


def still(td):
    return td.set("action", torch.zeros(*td.batch_size, 6))


@pytest.fixture(scope="module")
def led():
    return Led(3, "cpu", 0, play=True, reward_terms=True)


@pytest.fixture
def viewer(led):
    led.set_command(None)
    with Viewer(led, still) as viewer:
        yield viewer


def played(viewer, steps):
    """Steps a viewer on its own clock until so many steps were taken."""
    before, ends = viewer.player.steps, time.monotonic() + 60
    while viewer.player.steps < before + steps:
        assert time.monotonic() < ends
        viewer.tick()


# What is stepped.


def test_a_player_does_what_a_rollout_does_and_remembers_it(shared):
    policy = loco.load_policy("walker_walk", "cpu")
    env = shared("walker_walk", 2, copy="viewer", reward_terms=True, episode_length=7)
    expected = env.rollout(10, policy, break_when_any_done=False)["next"]
    env.set_seed(0)
    player = Player(env, policy)
    for _ in range(10):
        player.step()
    times, returns, terms = player.curves(world=1)
    np.testing.assert_allclose(times, 0.025 * np.arange(1, 11))
    reward = expected["reward"][..., 0].numpy()
    begun = np.concatenate([reward[:, :7].cumsum(1), reward[:, 7:].cumsum(1)], axis=1)  # a new episode after 7 steps
    np.testing.assert_allclose(returns, np.stack([begun[1], begun.mean(0)], axis=1), rtol=1e-5)
    for name, column in zip(env.term_names, terms.T, strict=True):
        np.testing.assert_allclose(column, expected["reward_terms", name][1, :, 0], rtol=1e-5)


def test_actions_are_held_and_curves_keep_the_last_20_seconds_in_few_points(led):
    asked = []
    player = Player(led, lambda td: still(td).set("x", asked.append(1) or td["done"]), action_repeat=4)
    asked.clear()  # it was tried once
    for _ in range(10):
        player.step()
    assert len(asked) == 3
    player.steps = 10_000 * 800 + 3  # as after many hours
    times, returns, _ = player.curves(0, points=100)
    assert len(times) == len(returns) == 100
    assert 19.5 < times[-1] - times[0] <= 20.0


def test_worlds_stand_still_while_nobody_looks_and_move_in_real_time_when_somebody_does(viewer):
    viewer.tick()
    assert viewer.player.steps == 0
    with open_page(viewer):
        played(viewer, 8)
        shown = viewer.page.scene
        viewer.page.show_worlds()
        chosen = viewer.player.env.sim.xpos[:, 1].numpy()
        (torso,) = (group for group in shown._mesh_groups if 1 in group.body_ids)
        places = np.reshape(torso.handle.batched_positions, (3, -1, 3))[:, list(torso.body_ids).index(1)]
    np.testing.assert_allclose(places[0], 0.0, atol=1e-6)  # it is followed
    apart = (places - places[0]) - (chosen - chosen[0])  # beside their own places in their worlds
    assert np.linalg.norm(apart[1]) == pytest.approx(np.linalg.norm(apart[2]), rel=1e-4)
    assert np.linalg.norm(apart[1]) > 2


# What a person can do.


def test_the_clock_is_stopped_stepped_set_and_begun_anew(viewer):
    with open_page(viewer) as page:
        page.set(viewer.page.clock, "Play/Pause")
        viewer.tick()
        stopped = viewer.player.steps
        for _ in range(3):
            viewer.tick()
        assert (viewer.paused, viewer.player.steps) == (True, stopped)
        page.set(viewer.page.clock, "Step")
        viewer.tick()
        assert viewer.player.steps == stopped + 1
        for click, speed in (("Slower", 0.5), ("Slower", 0.25), ("Real time", 1.0), ("Faster", 2.0)):
            page.set(viewer.page.speed, click)
            viewer.tick()
            assert viewer.speed == speed
        page.set(viewer.page.clock, "Play/Pause")
        played(viewer, 3)
        page.set(viewer.page.clock, "Reset")
        page.set(viewer.page.clock, "Play/Pause")
        viewer.tick()
        assert viewer.player.steps == 0
        assert (viewer.player.env.world.elapsed_steps.torch == 0).all()


def test_a_slider_sets_the_command_of_all_worlds_until_they_draw_it_again(viewer):
    by_hand, lean, height = viewer.page._sliders["command"]
    memory = viewer.player.env.world.memory["command"]
    assert (lean.min, lean.max, height.min, height.max) == (-1.0, 1.0, 0.5, 1.5)
    with open_page(viewer) as page:
        played(viewer, 2)
        assert len(memory.unique(dim=0)) == 3
        viewer.page.show_curves()
        assert lean.value == pytest.approx(memory[0, 0].item(), abs=0.006)
        page.set(lean, -0.4)
        played(viewer, 2)
        assert by_hand.value
        torch.testing.assert_close(memory, torch.tensor([[-0.4, height.value]]).expand(3, 2))
        page.set(by_hand, False)
        played(viewer, 2)
        assert (memory > 0).all()
        assert len(memory.unique(dim=0)) == 3


def test_another_world_is_chosen_with_its_contacts(viewer):
    with open_page(viewer) as page:
        page.set(viewer.page.choice, 2)
        page.set(viewer.page.forces, True)
        for _ in range(200):  # it falls, and comes to rest
            viewer.step()
        viewer.tick()
        assert viewer.page.world == 2
        assert viewer.page.scene.mj_data.ncon > 0
        qpos = viewer.player.env.sim.qpos[2].numpy()
        np.testing.assert_allclose(viewer.page.scene.mj_data.qpos, qpos)
        assert viewer.page.scene._decor_handles
        assert all(handle.visible for handle in viewer.page.scene._decor_handles.values())


def test_a_newer_policy_goes_on_where_the_last_one_was(led):
    policies = [None, lambda td: still(td).set("action", torch.ones(3, 6))]
    with Viewer(led, None, newer=lambda: policies.pop(0) if policies else None) as viewer, open_page(viewer):
        viewer.tick()
        assert viewer.player.steps == 0  # there is no policy yet
        viewer._due["policy"] = 0.0
        played(viewer, 2)
        assert (led.sim.ctrl == 1).all()


@pytest.mark.slow
def test_it_takes_no_more_of_the_cpu_than_it_may(led):
    share = 0.02 / cores()
    with Viewer(led, still, cpu_share=share) as viewer, open_page(viewer):
        played(viewer, 1)
        spent, began = time.process_time(), time.monotonic()
        played(viewer, 15)
        assert time.process_time() - spent < 0.03 * (time.monotonic() - began)


def test_no_tunnel_is_opened_and_other_machines_do_not_reach_it(viewer):
    assert viewer.page.server.get_host() == "127.0.0.1"
    with open_page(viewer) as page:
        page.ask_for_a_tunnel()
        assert viewer.page.server._share_tunnel is None


@for_each(
    ("host", "named", "origin", "foreign"),
    [
        ("127.0.0.1", "127.0.0.1:8080", None, False),
        ("127.0.0.1", "127.0.0.1:8080", "http://127.0.0.1:8080", False),
        ("127.0.0.1", "localhost:9000", "http://localhost:9000", False),  # through ssh
        ("::1", "[::1]:8080", "http://[::1]:8080", False),
        ("127.0.0.1", "127.0.0.1:8080", "https://evil.example", True),
        ("127.0.0.1", "127.0.0.1:8080", "http://127.0.0.1:3000", True),
        ("127.0.0.1", "127.0.0.1:8080", "null", True),
        ("127.0.0.1", "evil.example:8080", "http://evil.example:8080", True),  # whose name leads here
        ("127.0.0.1", None, None, True),
        ("0.0.0.0", "lab.example:8080", "http://lab.example:8080", False),
        ("0.0.0.0", "lab.example:8080", "http://evil.example:8080", True),
    ],
)
def test_requests_of_other_sites_are_foreign(host, named, origin, foreign):
    assert is_foreign(host, named, origin) == foreign


def test_a_page_of_another_site_is_refused(viewer):
    with pytest.raises(InvalidStatus, match="403"):
        connect(viewer.url.replace("http", "ws"), origin="https://evil.example")
    with pytest.raises(HTTPError, match="403"):
        urlopen(Request(viewer.url, headers={"Origin": "https://evil.example"}))
    with urlopen(viewer.url) as page:
        assert page.status == 200


def test_hosts(led):
    for host, start in {
        "localhost": "http://127.0.0.1:",
        "::1": "http://[::1]:",
        "0.0.0.0": "http://127.0.0.1:",
    }.items():
        if host == "::1" and not Path("/proc/net/if_inet6").exists():
            continue
        with Viewer(led, still, host=host) as viewer, open_page(viewer):
            assert viewer.url.startswith(start)
    with pytest.raises(ValueError, match="does not appear to be an IPv4 or IPv6 address"):
        Viewer(led, still, host="nowhere")
    with pytest.raises(OSError, match="assign requested address"):
        Viewer(led, still, host="192.0.2.1")


def test_what_no_control_could_send_is_refused(viewer):
    by_hand, lean, _ = viewer.page._sliders["command"]
    with open_page(viewer) as page:
        played(viewer, 2)
        for control, value in (
            *((lean, number) for number in (np.nan, np.inf, -9.0)),
            *((viewer.page.choice, number) for number in (-1, 3)),
            *((buttons, "Warp") for buttons in (viewer.page.clock, viewer.page.speed)),
        ):
            page.set(control, value)
            played(viewer, 2)
        page.look_from(np.nan)
        for follow in (False, True):
            page.set(viewer.page.follow, follow)
            viewer.tick()
    assert (by_hand.value, viewer.page.world, viewer.page.choice.value) == (False, 0, 0)
    assert -1 <= lean.value <= 1
    with pytest.raises(ValueError, match="finite"):
        viewer.player.env.set_command([np.nan, 1.0])


ENDS = """
import sys, quickly, torchrl_loco
env = torchrl_loco.make("walker_walk", 2, "cpu", 0)
viewer = env.view(torchrl_loco.load_policy("walker_walk", "cpu"))
print(viewer.url, flush=True)
sys.stdin.readline()
"""


@pytest.mark.ci
def test_a_process_ends_quietly_while_a_page_is_open():
    for i in range(50):
        assert_it_ends_quietly(0.2 + 0.0137 * i)


def assert_it_ends_quietly(wait):
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    quiet = {**os.environ, "TQDM_DISABLE": "1"}  # its kernels may have to be compiled first
    with (
        subprocess.Popen(
            [sys.executable, "-c", ENDS], text=True, env=quiet, cwd=Path(__file__).parent, **pipes
        ) as process,
        open_page(process.stdout.readline().strip()),
    ):
        time.sleep(wait)
        assert process.communicate("\n", timeout=60) == ("", ""), wait
    assert process.returncode == 0, wait


def test_in_a_notebook_it_plays_beside_the_cells(led):
    viewer = led.view(still)
    try:
        assert f'src="{viewer.url}"' in viewer._repr_html_()
        with open_page(viewer):
            ends = time.monotonic() + 60
            while viewer.player.steps < 3 and time.monotonic() < ends:
                time.sleep(0.01)
            assert viewer.player.steps >= 3
    finally:
        viewer.close()
    steps = viewer.player.steps
    led.rollout(2)  # the worlds are the caller's again
    assert viewer.player.steps == steps


# Errors.


def test_errors(led, tmp_path, capsys):
    with pytest.raises(ValueError, match=r"num_envs must lie in \[1, 64\]"):
        Viewer(loco.make("walker_walk", 65, "cpu"), still)
    for wrong, match in (({"port": 70_000}, "port must lie in"), ({"action_repeat": 0}, "action_repeat must lie in")):
        with pytest.raises(ValueError, match=match):
            Viewer(led, still, **wrong)
    with pytest.raises(ValueError, match="was it trained for another body"):
        Viewer(led, loco.load_policy("hopper_hop", "cpu"))
    with pytest.raises(OSError, match=r"host 1\.2\.3\.4 is no address of this machine"):
        Viewer(led, still, host="1.2.3.4")
    for command, message in {
        "play walker_walk --viewer browser --num_envs 65": "num_envs must lie in [1, 64], got 65",
        "play walker_walk --viewer browser --port 0": "port must lie in [1, 65536)",
        "play walker_walk --viewer browser --host nowhere": "'nowhere' does not appear to be an IPv4 or IPv6 address",
        f"watch {tmp_path}": "is not a run folder",
    }.items():
        with pytest.raises(SystemExit, match="2"):
            cli.main(command.split())
        assert message in capsys.readouterr().err


# In a real browser.


@pytest.fixture
def browser(tmp_path):
    pytest.importorskip("selenium", reason="selenium is not installed")
    if not all(map(shutil.which, ("chromium", "chromedriver"))):
        pytest.skip("there is no chromium with its chromedriver here")
    with chrome(tmp_path / "profile", 1000, 700) as browser:
        yield browser


def picture(browser):
    """The part of the screen where the worlds are."""
    from PIL import Image

    pixels = np.asarray(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")).astype(int)
    return pixels[200:, :600]


def changed(one, other):
    return (np.abs(one - other).max(-1) > 30).mean()


@pytest.mark.ci
def test_in_a_browser_worlds_move_and_a_slider_steers_them(browser):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import WebDriverWait

    class Posed(Led):
        """Its torso is turned by the command, so that one sees it."""

        def events(self, s):
            turned = torch.cat([s.qpos[:, :2], s.command[:, :1], s.qpos[:, 3:]], dim=-1)
            return {"qpos": torch.where(s.command[:, :1] < 0, turned, s.qpos)}

    def text():
        return browser.find_element(By.TAG_NAME, "body").text

    def until(happened):
        WebDriverWait(browser, 60).until(lambda _: happened())

    def click(name):
        browser.find_element(By.XPATH, f"//button[contains(., '{name}')]").click()

    viewer = Posed(4, "cpu", 0, play=True, reward_terms=True).view(still)
    try:
        browser.get(viewer.url)
        until(lambda: "Posed" in text() and "lean (rad)" in text() and viewer.player.steps > 10)
        time.sleep(2)
        first = picture(browser)
        assert len(np.unique(first.reshape(-1, 3), axis=0)) > 20  # there is something to see
        until(lambda: changed(first, picture(browser)) > 0.001)

        click("Play/Pause")
        until(lambda: "paused" in text())
        time.sleep(1)
        stopped, steps = picture(browser), viewer.player.steps
        time.sleep(1)
        assert (changed(stopped, picture(browser)), viewer.player.steps) == (0.0, steps)
        click("Step")
        until(lambda: viewer.player.steps == steps + 1)

        lean = viewer.page._sliders["command"][1]
        xpath = "//*[text()='lean (rad)']/following::*[@role='slider'][1]"
        browser.find_element(By.XPATH, xpath).send_keys(Keys.HOME)
        until(lambda: lean.value == -1.0)
        click("Step")
        click("Step")
        command = viewer.player.env.world.memory["command"]
        until(lambda: (command[:, 0] == -1.0).all() and (viewer.player.env.sim.qpos[:, 2] < -0.9).all())
        until(lambda: changed(stopped, picture(browser)) > 0.002)
    finally:
        viewer.close()
