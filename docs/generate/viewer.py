"""The moving picture of the viewer, from a real browser: ``make viewer`` needs Chromium with its chromedriver."""

import contextlib
import io
import shutil
import sys
import tempfile
import time
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import torchrl_loco
from generate.tasks import save_moving
from torchrl_loco.training.environments import make_for
from torchrl_loco.viewer import viewer as module

PICTURE = Path(__file__).parent.parent / "_static" / "viewer.webp"
WORLDS, SECONDS, RATE = 6, 7.0, 8
"""Worlds side by side, time that passes in the picture (s), and frames a second."""
DRAWN = 0.4
"""Time that a browser gets to draw a picture (s)."""


@contextlib.contextmanager
def chrome(profile: Path, width: int, height: int) -> Iterator[Any]:
    """Opens a headless Chromium without a GPU, and closes it at the end.

    Args:
        profile: a folder for its own use.
        width: of its window, in pixels.
        height: of its window, in pixels.

    Yields:
        Selenium's browser.

    Raises:
        FileNotFoundError: Chromium or its chromedriver is not there.
    """
    from selenium import webdriver

    binary, driver = (shutil.which(name) for name in ("chromium", "chromedriver"))
    if binary is None or driver is None:
        raise FileNotFoundError("there is no chromium with its chromedriver here")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for argument in (
        *("headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-background-networking"),
        *("disable-component-update", "disable-sync", f"user-data-dir={profile}", f"window-size={width},{height}"),
        *("use-gl=angle", "use-angle=swiftshader", "enable-unsafe-swiftshader"),  # WebGL without a GPU
    ):
        options.add_argument(f"--{argument}")
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    browser.set_page_load_timeout(60)
    try:
        yield browser
    finally:
        browser.quit()


class Clock:
    """Stands in for the viewer's clock, which goes on by a picture's time for each picture, however long that takes."""

    def __init__(self) -> None:
        self.now = 0.0

    def perf_counter(self) -> float:
        """Returns the time of the picture (s)."""
        return self.now


def draw(path: Path, task: str) -> None:
    """Draws the page while a shipped policy plays and a person does something to the controls.

    Raises:
        ValueError: the task has no policy.
        FileNotFoundError: there is no browser.
    """
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    clock, real = Clock(), module.time
    policy = torchrl_loco.load_policy(task, "cpu")
    env = make_for(policy, WORLDS, "cpu", 0, reward_terms=True, play=True)
    module.time = types.SimpleNamespace(perf_counter=clock.perf_counter, process_time=time.process_time)
    try:
        with tempfile.TemporaryDirectory() as profile, chrome(Path(profile), 1000, 700) as browser:
            viewer = module.Viewer(env, policy)
            browser.get(viewer.url)
            while not viewer.page.watched:
                viewer.tick()
            while "Terms of the reward" not in browser.find_element(By.TAG_NAME, "body").text:
                time.sleep(DRAWN)
            time.sleep(10 * DRAWN)
            notice = "//*[contains(text(), 'Software WebGL')]/following::button[1]"
            for button in browser.find_elements(By.XPATH, notice):
                button.click()

            def press(label: str, key: str, times: int) -> None:
                xpath = f"//label[.='{label}']/following::*[@role='slider'][1]"
                browser.find_element(By.XPATH, xpath).send_keys(key * times)

            def check(label: str) -> None:
                browser.find_element(By.XPATH, f"//label[.='{label}']/following::input[@type='checkbox'][1]").send_keys(
                    " "
                )

            done = {0.25: lambda: check("Contacts and forces"), 0.75: lambda: press("World", Keys.ARROW_RIGHT, 1)}
            if type(env).command_ranges:
                first, *_, last = next(iter(type(env).command_ranges.values()))
                done[0.1] = lambda: press(first, Keys.ARROW_RIGHT, 10)
                done[0.5] = lambda: press(last, Keys.ARROW_RIGHT, 30)
            pictures = []
            for i in range(round(SECONDS * RATE)):
                for share in [share for share in done if i >= share * SECONDS * RATE]:
                    done.pop(share)()
                    time.sleep(DRAWN)
                clock.now += 1 / RATE
                viewer.tick()
                time.sleep(DRAWN)
                shot = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
                shot = shot.resize((shot.width * 3 // 4, shot.height * 3 // 4), Image.Resampling.LANCZOS)
                pictures.append(torch.from_numpy(np.array(shot)))
            viewer.close()
    finally:
        module.time = real
    save_moving(path, pictures, RATE)


if __name__ == "__main__":
    draw(PICTURE, *sys.argv[1:])
