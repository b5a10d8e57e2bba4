"""The campaign: what is trained when and where, that stopping it loses nothing, and what is made of its results."""

import csv
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import time
from types import SimpleNamespace

import pytest
from generate import benchmarks as page
from torch import nn

from benchmarks import campaign, marks, pack, plot
from benchmarks.campaign_folder import TABLES, CampaignFolder, Job
from benchmarks.marks import read
from torchrl_loco.policy import ObservationNorm, Policy
from torchrl_loco.training import RunFolder, preset

SMALL = {
    **{"num_envs": "8", "num_steps": "8", "minibatch_size": "32", "epochs": "1", "hidden": "16 16"},
    **{"total_frames": "16384", "eval_interval": "2048", "eval_episodes": "2"},
}
FIRST, SECOND = (Job("walker_stand", "playground", seed) for seed in (0, 1))


def statuses(folder):
    return {int(row["seed"]): row["status"] for row in read(folder, "jobs.csv")}


def until(what, seconds=200):
    end = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return found


# Which process runs where and when: with processes that do not train.


@pytest.fixture
def process(monkeypatch):
    """Lets jobs run this code instead of training; it finds task, seed and folder in its arguments."""

    def runs(code):
        def command(task, settings):
            return [sys.executable, "-c", code, task, str(settings["seed"]), str(settings["out"])]

        monkeypatch.setattr(campaign, "train_command", command)

    return runs


def run(folder, tasks=("walker_stand",), seeds=(0,), devices=("cpu",), minutes=None, archive=None):
    """Runs a campaign in one protocol; returns the jobs that were begun."""
    campaign.campaign(folder, tasks, ["playground"], seeds, {}, devices, minutes, archive)
    return read(folder, "jobs.csv")


REPORT = """
import os, pathlib, sys, time
task, seed, out = sys.argv[1:]
apart = os.getpgrp() != os.getpgid(os.getppid())
held = any(os.path.realpath(f"/proc/self/fd/{n}").endswith("/lock") for n in os.listdir("/proc/self/fd"))
report = open(pathlib.Path(out).parents[1] / "report", "a")
for what in ("begins", "ends"):
    print(os.environ["CUDA_VISIBLE_DEVICES"] or "none", what, task, seed, held, apart, file=report, flush=True)
    time.sleep(0.2)
sys.exit("first line\\nof task " + task)
"""


@pytest.mark.slow
def test_jobs_begin_in_order_and_failures_are_recorded_and_tried_again(tmp_path, process, capsys):
    process(REPORT)
    for processes in "12":
        found = run(tmp_path, ["walker_run", "hopper_hop"], [5, 3])
        assert {(row["status"], row["processes"]) for row in found} == {("failed", processes)}
    lines = [line.split() for line in (tmp_path / "report").read_text().splitlines()]
    order = [("walker_run", "5"), ("hopper_hop", "5"), ("walker_run", "3"), ("hopper_hop", "3")]
    assert [(task, seed) for _, what, task, seed, *_ in lines if what == "begins"] == 2 * order
    assert {held for *_, held, _ in lines} == {"True"}  # else a campaign could begin beside what another left behind
    assert {apart for *_, apart in lines} == {"True"}  # else Ctrl-C would be the first of two signals, which kill it
    errors = [(row["task"], row["error"]) for row in found]
    assert sorted(set(errors)) == [("hopper_hop", "of task hopper_hop"), ("walker_run", "of task walker_run")]
    assert "walker_run-playground-5: failed of task walker_run" in capsys.readouterr().out


@pytest.mark.slow
def test_devices_work_side_by_side_on_one_job_each(tmp_path, process, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7,9")
    process(REPORT)
    monkeypatch.setattr(campaign, "available_devices", lambda: ["cuda:0", "cuda:1", "cuda:2", "cpu"])
    monkeypatch.setattr(campaign, "circumstances", lambda device: {})
    run(tmp_path, seeds=range(4), devices=["cuda:0", "cuda:2"])
    lines = [line.split() for line in (tmp_path / "report").read_text().splitlines()]
    for device in ("4", "9"):
        assert [what for at, what, *_ in lines if at == device] == ["begins", "ends"] * 2
    assert {line[3] for line in lines} == {"0", "1", "2", "3"}
    assert json.loads((tmp_path / "about.json").read_text()) == [{"devices": 2}]
    assert campaign.child_environment("cpu")["CUDA_VISIBLE_DEVICES"] == ""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert campaign.child_environment("cuda:3")["CUDA_VISIBLE_DEVICES"] == "3"


MEET = """
import pathlib, sys, time
_, seed, out = sys.argv[1:]
together = pathlib.Path(out).parents[1]
(together / f"here-{seed}").touch()
deadline = time.monotonic() + 30
while len(list(together.glob("here-*"))) < 2 and time.monotonic() < deadline:
    time.sleep(0.02)
sys.exit(f"{len(list(together.glob('here-*')))} met")
"""


def test_a_device_that_is_named_twice_trains_two_jobs_at_a_time_and_that_is_noted(tmp_path, process):
    process(MEET)
    assert [row["error"] for row in run(tmp_path, seeds=[0, 1], devices=["cpu", "cpu"])] == ["2 met", "2 met"]
    (about,) = json.loads((tmp_path / "about.json").read_text())
    assert about["devices"] == 1
    assert "shared a device" in about["note"]


WAIT = """
import pathlib, signal, sys, time
out = pathlib.Path(sys.argv[3])
told = []
signal.signal(signal.SIGTERM, lambda *_: told.append(1))
(out / "ready").touch()
deadline = time.monotonic() + 60
while time.monotonic() < deadline and not (told and DOES_STOP):
    time.sleep(0.02)
time.sleep(0.5)
(out / "told").write_text(str(len(told)))
sys.exit(130 if told else "was not told to stop")
"""


@pytest.mark.parametrize("stops", [True, False])
def test_jobs_are_told_to_stop_before_the_time_is_over_and_then_killed(tmp_path, process, monkeypatch, stops):
    process(WAIT.replace("DOES_STOP", str(stops)))
    home = tmp_path / "jobs" / str(FIRST)
    late = 1000.0 - (campaign.STOPPING if stops else campaign.WRITING) + 1.0
    clock = SimpleNamespace(monotonic=lambda: late if (home / "ready").exists() else 400.0, sleep=time.sleep)
    monkeypatch.setattr(campaign, "time", clock)
    monkeypatch.setattr(campaign, "STARTED", 400.0)
    (begun,) = run(tmp_path, seeds=[0, 1], minutes=10)
    assert (begun["seed"], begun["status"]) == ("0", "stopped")
    told = home / "told"
    assert (told.read_text() == "1") if stops else not told.exists()  # a second signal would stop it at once


LOOK = """
import pathlib, sys, time
archive = pathlib.Path(sys.argv[3]).parents[2] / "all.tgz"
deadline = time.monotonic() + 30
while time.monotonic() < deadline and not archive.exists():
    time.sleep(0.02)
sys.exit("it is there" if archive.exists() else "it is not there")
"""


def test_the_archive_is_written_while_jobs_run(tmp_path, process, monkeypatch):
    monkeypatch.setattr(campaign, "PACKING", 0.3)
    process(LOOK)
    (job,) = run(tmp_path / "folder", archive=tmp_path / "all.tgz")
    assert job["error"] == "it is there"


def test_a_job_that_is_stopped_before_it_listens_has_not_failed(tmp_path):
    with CampaignFolder(tmp_path) as folder:
        campaigning = campaign.Campaign(folder, [FIRST], {})
        campaigning._stop.set()  # before its process has imported anything
        campaigning._train(FIRST, "cpu")
        assert folder.record(FIRST).status == "stopped"


def test_a_process_that_sees_one_gpu_is_told_of_no_other(tmp_path, monkeypatch):
    seen, command = [], [sys.executable, "-c", ""]
    monkeypatch.setattr(campaign, "train_command", lambda task, settings: seen.append(settings["device"]) or command)
    with CampaignFolder(tmp_path) as folder:
        campaign.Campaign(folder, [FIRST], {})._train(FIRST, "cuda:1")
    assert seen == ["cuda"]


def test_the_result_of_a_finished_run(tmp_path):
    with CampaignFolder(tmp_path) as folder:
        folder.update(FIRST, status="running")
        run = RunFolder.create(preset("walker_stand", "cpu", out=folder.home(FIRST)))
        run.append_metrics({"iteration": 1, "frames": 3000, "seconds": 10.0, "return": 1.0})
        for frames, seconds, mean in ((1000, 4.0, 949.0), (2000, 7.0, 951.0), (3000, 10.0, 970.0)):
            run.append_evaluation({"frames": frames, "seconds": seconds, "mean": mean})
            folder.note_evaluations(FIRST, wall=2 * seconds)
        info = {"episodes": 2, "mean": 960.0, "std": 1.0, "min": 959.0, "max": 961.0, "trained_on": "CPU"}
        Policy(nn.Sequential(ObservationNorm(24), nn.Linear(24, 6), nn.Tanh()), info).save(run.policy)
        assert folder.finish(FIRST, wall=25.0)
    (row,) = read(tmp_path, "results.csv")
    expected = {"frames": 3000, "seconds": 10, "wall": 25, "frames_per_second": 300, "threshold": 950}
    expected |= {"seconds_to_threshold": 7, "wall_to_threshold": 14, "mean": 960}
    assert {name: float(row[name]) for name in expected} == expected


def test_of_what_is_packed_the_longest_training_comes_first(tmp_path):
    with CampaignFolder(tmp_path) as folder:
        for job, wall in ((FIRST, 5.0), (SECOND, 9.0)):
            folder.update(job, status="stopped", wall=wall)
            (folder.home(job) / "run").mkdir()
            for name in ("checkpoint.pt", "checkpoint.pt.part"):
                (folder.home(job) / "run" / name).write_bytes(b"x")
        files, checkpoints = folder.contents()
    assert list(checkpoints) == [f"jobs/{job}/run/checkpoint.pt" for job in (SECOND, FIRST)]
    assert not any(name.endswith((".pt", ".part")) for name in files)


def test_no_two_campaigns_in_a_folder(tmp_path):
    with CampaignFolder(tmp_path), pytest.raises(BlockingIOError, match="is at work in"):
        CampaignFolder(tmp_path)
    with CampaignFolder(tmp_path):
        pass


def test_settings_and_errors_in_words(tmp_path):
    assert campaign.parse_setting("hidden=16 16") == ("hidden", "16 16")
    with pytest.raises(ValueError, match="NAME=VALUE, such as total_frames=20_000_000, got 'frames'"):
        campaign.parse_setting("frames")
    with pytest.raises(ValueError, match="seed is set for each job: choose tasks, protocols, seeds"):
        campaign.parse_setting("seed=3")
    command = campaign.train_command("walker_run", {"hidden": "16 8", "lr": 1e-3})
    assert command[3:] == ["train", "walker_run", "--hidden", "16", "8", "--lr=0.001"]
    assert campaign.last_error("bar\rTraceback\nValueError: wrong\n\n") == "ValueError: wrong"
    frame = "x\n╭─ Value error ─╮\n│ lr is wrong  │\n│ ──── │\n│ see --help │\n╰────╯\n"
    assert campaign.last_error(frame) == "lr is wrong"
    one = {"tasks": ["walker_run"], "protocols": ["playground"], "seeds": [0], "settings": {}}
    with pytest.raises(ValueError, match=r"unknown device 'cuda:99'.*cpu"):
        campaign.campaign(tmp_path, **one, devices=["cuda:99"])
    with pytest.raises(ValueError, match=r"minutes must be more than 0\.5"):
        campaign.campaign(tmp_path, **one, minutes=0.5)
    with pytest.raises(ValueError, match="must lie outside of the folder that it packs"):
        campaign.campaign(tmp_path, **one, archive=tmp_path / "a.tgz")
    assert not list(tmp_path.iterdir())


# A real campaign, stopped in the middle and continued.


def arguments(folder, **options):
    words = {"tasks": ["walker_stand"], "protocols": ["playground"], "seeds": [0, 1], "devices": ["cpu"], **options}
    settings = [f"{name}={value}" for name, value in {**SMALL, **words.pop("settings", {})}.items()]
    words = {"folder": [folder], **words, "set": settings}
    flat = [str(word) for name, values in words.items() for word in (f"--{name}", *values)]
    return [sys.executable, "-m", "benchmarks", "campaign", *flat]


def call(folder, **options):
    return subprocess.run(arguments(folder, **options), capture_output=True, text=True, timeout=300, check=False)


def unpacked(archive, target):
    parts = sorted(archive.parent.glob(f"{archive.name}*"))
    with tarfile.open(fileobj=io.BytesIO(b"".join(part.read_bytes() for part in parts))) as tar:
        tar.extractall(target, filter="data")
    return target


@pytest.mark.ci
def test_a_stopped_campaign_is_continued(tmp_path):
    folder, archive = tmp_path / "first", tmp_path / "out" / "all.tgz"
    process = subprocess.Popen(arguments(folder, pack=[archive]), stdout=subprocess.PIPE, text=True)
    table = folder / "evaluations.csv"
    until(lambda: process.poll() is not None or (table.exists() and read(folder, table.name)))
    process.send_signal(signal.SIGTERM)
    said, _ = process.communicate(timeout=200)
    assert process.returncode == 0, said
    assert "2 jobs: 1 stopped, 1 waiting" in said
    assert statuses(folder) == {0: "stopped"}
    assert read(folder, "results.csv") == []
    before = read(folder, "evaluations.csv")
    assert before
    assert {row["status"] for row in before} == {"stopped"}

    # On another machine, from the archive alone.
    moved = unpacked(archive, tmp_path / "second")
    (checkpoint,) = moved.glob("jobs/*/*/checkpoint.pt")
    metrics = (checkpoint.parent / "metrics.csv").read_text()
    with CampaignFolder(shutil.copytree(moved, tmp_path / "damaged")) as damaged:
        with pytest.raises(ValueError, match=r"begun with .*frames=16384, now it is --set \(nothing\)"):
            campaign.Campaign(damaged, [FIRST], {})
        (damaged.run(FIRST).path / "checkpoint.pt").write_bytes(b"damaged")
        assert damaged.run_to_resume(FIRST) is None  # it is begun again
        assert damaged.run(FIRST) is None

    done = call(moved, pack=[archive])
    assert done.returncode == 0, done.stderr
    assert "2 jobs: 2 finished" in done.stdout
    assert done.stdout.splitlines()[-1].split()[:3] == ["walker_stand", "playground", "2"]  # the table
    assert checkpoint.is_file()
    assert (checkpoint.parent / "metrics.csv").read_text().startswith(metrics)  # resumed, not begun again
    jobs = read(moved, "jobs.csv")
    assert [(row["seed"], row["status"], row["processes"]) for row in jobs] == [
        ("0", "finished", "2"),
        ("1", "finished", "1"),
    ]
    evaluations = read(moved, "evaluations.csv")
    assert [{**row, "status": "stopped"} for row in evaluations[: len(before)]] == before
    for seed in "01":
        rows = [row for row in evaluations if row["seed"] == seed]
        assert [int(row["frames"]) for row in rows] == list(range(2048, 16384 + 1, 2048))
        walls = [float(row["wall"]) for row in rows]
        assert walls == sorted(walls)
        assert all(float(row["wall"]) > float(row["seconds"]) > 0 for row in rows)
    for row in read(moved, "results.csv"):
        assert int(row["frames"]) == 16384
        assert int(row["episodes"]) == 2
        assert 0 < float(row["min"]) <= float(row["mean"]) <= float(row["max"]) < 1000
        assert float(row["threshold"]) == 950
        assert row["wall_to_threshold"] == ""
        assert float(row["wall"]) > float(row["seconds"])
    assert {path.name for path in (moved / "policies").iterdir()} == {f"{FIRST}.safetensors", f"{SECOND}.safetensors"}
    assert len(json.loads((moved / "about.json").read_text())) == 2
    plot.plot(moved, tmp_path / "returns.png")
    assert (tmp_path / "returns.png").stat().st_size > 10_000

    # What is finished stays as it is, in its folder and in what was packed of it.
    last = unpacked(archive, tmp_path / "third")
    assert not list(last.rglob("checkpoint.pt"))
    assert len(list(last.rglob("*.safetensors"))) == 2
    for place in (moved, last):
        logs = {path: path.read_bytes() for path in place.rglob("log.txt")}
        results, evaluations = read(place, "results.csv"), read(place, "evaluations.csv")
        record = place / "jobs" / str(SECOND) / "job.json"
        if place == moved:  # the script was killed after the run's end, and did not see it
            values = json.loads(record.read_text())
            values["record"] |= {"status": "running", "result": None}
            values["record"]["evaluations"].pop()
            record.write_text(json.dumps(values))
            for row in (results[1], evaluations[-1]):
                row["wall"] = ""  # when they were written is not known
        assert not campaign.campaign(place, ["walker_stand"], ["playground"], [0, 1], SMALL, ["cpu"])
        assert len(logs) == 2
        assert {path: path.read_bytes() for path in place.rglob("log.txt")} == logs
        assert read(place, "results.csv") == results
        assert read(place, "evaluations.csv") == evaluations


@pytest.mark.ci
def test_a_job_that_fails_stops_no_other(tmp_path):
    """It is tried again, here with settings that are valid."""
    short = {"total_frames": "128", "eval_interval": "0"}
    bad = call(tmp_path, seeds=[2**32, 0], settings=short)
    assert bad.returncode == 1, bad.stderr
    assert "2 jobs: 1 failed, 1 finished" in bad.stdout
    assert statuses(tmp_path) == {2**32: "failed", 0: "finished"}
    (error,) = [row["error"] for row in read(tmp_path, "jobs.csv") if row["status"] == "failed"]
    assert "4294967296" in error
    worse = call(tmp_path / "set", settings={**short, "lr": "fast"})
    assert worse.returncode == 1
    assert statuses(tmp_path / "set") == {0: "failed", 1: "failed"}
    assert all("fast" in row["error"] for row in read(tmp_path / "set", "jobs.csv"))
    good = call(tmp_path / "set", settings=short)
    assert good.returncode == 0, good.stderr
    assert statuses(tmp_path / "set") == {0: "finished", 1: "finished"}


@pytest.mark.ci
def test_minutes_end_a_campaign(tmp_path):
    done = call(tmp_path, minutes=[0.7], settings={"total_frames": "1e6"})
    assert done.returncode == 0, done.stderr
    assert set(statuses(tmp_path).values()) <= {"stopped"}  # unless even its process had no time to begin


# What is made of results.


def write(path, columns, rows):
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture
def results(tmp_path):
    """The tables of a campaign of two tasks, one without a mark."""
    folder = tmp_path / "benchmarks" / "results" / "2027-01-02-toaster" / "campaign"
    folder.mkdir(parents=True)
    walk = {"task": "walker_walk", "protocol": "playground"}
    times = ("seconds", "seconds_to_threshold", "wall_to_threshold", "mean")
    rows = [
        {**walk, "seed": seed, **dict(zip(times, values, strict=True))}
        for seed, *values in ((0, 30, 5, 15, 984), (1, 32, 8, 18, 981), (2, 34, 7, 16, 976))
    ]
    rows.append({"task": "snail_crawl", "protocol": "dm_control", "seed": 0, "seconds": 9, "mean": 12.5})
    write(folder / "results.csv", TABLES["results.csv"], rows)
    evaluations = [
        {**{name: row[name] for name in ("task", "protocol", "seed")}, "seconds": seconds, "mean": row["mean"] / 2}
        for row in rows
        for seconds in (3, 9)
    ]
    write(folder / "evaluations.csv", TABLES["evaluations.csv"], evaluations)
    about = {"command": "python -m benchmarks campaign", "date": "2027-01-02", "device": "toaster", "devices": 2}
    (folder / "about.json").write_text(json.dumps([about, {**about, "note": "Hot."}]))
    return folder


def test_results_beside_marks(results):
    walk, snail = marks.learning(results)
    assert walk["mean"] == pytest.approx((984 + 981 + 976) / 3)
    expected = {"seeds": 3, "mark": 984, "worst": 976, "worst: mark": 980, "training: mark (s)": 30, "by": "FastTD3"}
    assert {**walk, **expected} == walk
    times = {"training (s)": 32, "threshold": 950, "passed after (s)": 8, "from start (s)": 18}  # the slowest seed's
    assert {**walk, **times} == walk
    assert snail["mean"] == 12.5
    assert snail["mark"] is None
    rows = read(results, "results.csv")
    write(results / "results.csv", TABLES["results.csv"], [*rows, {**rows[0], "seed": 3, "seconds_to_threshold": ""}])
    assert marks.learning(results)[0]["passed after (s)"] is None  # not by all
    assert marks.threshold("humanoid_run", "playground") == 900
    with pytest.raises(FileNotFoundError, match=r"is not the folder of a campaign: it has no results\.csv"):
        marks.learning(results.parent)


def test_a_campaign_on_the_page(results, tmp_path):
    text = page.all_results(results.parents[1], tmp_path / "docs" / "pictures")
    row = "| walker_walk | playground | 3 | 980.3 | 984 | 976.0 | 980 | 32 | 30 | 950 | 8 | 18 | 982.9 | FastTD3 |"
    assert row in text
    assert "| snail_crawl | dm_control | 1 | 12.5 |  |" in text
    assert "`python -m benchmarks campaign`: 2 x toaster, 2027-01-02" in text
    assert text.count("Hot.") == 1
    picture = "pictures/2027-01-02-toaster-campaign.png"
    assert f"]({picture})" in text
    assert (tmp_path / "docs" / picture).stat().st_size > 10_000
    assert "### campaign, results" not in text  # linked, without a table of their own
    assert "[results.csv](../benchmarks/results/2027-01-02-toaster/campaign/results.csv)" in text


def test_archives_in_parts(tmp_path, monkeypatch):
    monkeypatch.setattr(pack, "PART", 3000)
    monkeypatch.setattr(pack, "PARTS", 3)
    archive = tmp_path / "out" / "a.tgz"
    files, more = {"x.csv": b"x", "folder/y": os.urandom(5000)}, {"one": os.urandom(9000), "two": os.urandom(2000)}
    assert pack.pack(archive, files, more) == ["one"]
    assert sorted(path.name for path in archive.parent.iterdir()) == ["a.tgz", "a.tgz.1", "a.tgz.2"]
    assert all(path.stat().st_size <= 3000 for path in archive.parent.iterdir())
    target = unpacked(archive, tmp_path / "target")
    found = {str(path.relative_to(target)): path.read_bytes() for path in target.rglob("*") if path.is_file()}
    assert found == {**files, "two": more["two"]}
    assert pack.pack(archive, {"x.csv": b"y"}, {}) == []
    assert [path.name for path in archive.parent.iterdir()] == ["a.tgz"]
