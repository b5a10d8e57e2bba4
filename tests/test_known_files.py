"""What only a file names is not run: the user has to have named it, here, once."""

import compileall
import os
import stat
import subprocess
import sys

import pytest
from for_each import for_each

from torchrl_loco import known_files, registry
from torchrl_loco.known_files import UnnamedFileError

TASK = """
import beside, torchrl_loco

beside.runs()

class Task(torchrl_loco.WalkerWalk):
    pass
"""
BESIDE = """
def runs():
    with open({log!r}, "a") as log:
        log.write("x")
"""


@pytest.fixture
def log(tmp_path):
    return tmp_path / "log"


@pytest.fixture
def file(tmp_path, log, monkeypatch):
    """A task and a module beside it, which write into a log when they run; nothing is known."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(sys, "path", sys.path.copy())
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    monkeypatch.setattr(registry, "_folders", set())
    path = tmp_path / "task.py"
    path.write_text(TASK)
    path.with_name("beside.py").write_text(BESIDE.format(log=str(log)))
    forget(monkeypatch)
    return path


def forget(monkeypatch):
    """Continues as another process would."""
    monkeypatch.setattr(known_files, "_added", set())
    monkeypatch.setattr(registry, "_named", {})
    for name in [name for name in sys.modules if name.startswith(("task_", "beside", "evil"))]:
        monkeypatch.delitem(sys.modules, name)


def test_a_file_runs_once_the_user_has_named_it(file, log, monkeypatch):
    """The message has the line to type. What is known is known to other processes, also after an edit."""
    monkeypatch.chdir(file.parent)
    for place in (f"{file}:Task", "task.py:Task", "./task.py:Task", "task.py"):
        for ask in (registry.resolve, registry.task_name):
            with pytest.raises(UnnamedFileError, match=f"{file} was not run.*--task {file}:"):
                ask(place)
    assert not log.exists()
    assert not known_files.store().exists()
    assert registry.task_name("task.py:Task", by_user=True) == f"{file}:Task"
    found = known_files.store().read_text().splitlines()
    assert {line.split("  ")[1] for line in found} == {str(file), str(file.with_name("beside.py"))}
    assert subprocess.run(["sha256sum", "--check", "--quiet", known_files.store()], check=False).returncode == 0
    assert stat.S_IMODE(known_files.store().stat().st_mode) == 0o600
    for text in (TASK, TASK + "# edited"):
        file.write_text(text)
        forget(monkeypatch)
        assert registry.resolve(f"{file}:Task").__name__ == "Task"
    assert len(log.read_text()) == 3


@for_each("change", ["task", "beside", "new", "bytecode", "link", "nothing"])
def test_a_copy_in_a_run_folder_runs_if_all_of_it_is_known(change, file, log, monkeypatch):
    file.write_text(TASK)
    file.with_name("beside.py").write_text(BESIDE.format(log=str(log)))
    forget(monkeypatch)
    registry.resolve(f"{file}:Task", by_user=True)
    kept = file.parent / f"run-{change}" / known_files.KEPT
    kept.mkdir(parents=True)
    (kept.parent / "config.json").write_text("{}")
    for each in (file, file.with_name("beside.py")):
        each.rename(kept / each.name)
    log.unlink()
    forget(monkeypatch)
    if change in ("task", "beside"):
        changed = kept / f"{change}.py"
        changed.write_text(changed.read_text() + "\n")
    elif change == "new":
        (kept / "numpy.py").touch()
    elif change == "bytecode":
        compileall.compile_dir(kept, quiet=1)
    elif change == "link":
        (kept / "package").symlink_to(file.parent)
    place = known_files.place_of(f"{file}:Task", kept.parent)
    assert place == f"{kept / file.name}:Task"
    if change != "nothing":
        with pytest.raises(UnnamedFileError, match=f"--task {place}"):
            registry.resolve(place)
        assert not log.exists()
        return
    for _ in range(2):  # nothing is left there that would not be known
        forget(monkeypatch)
        assert registry.resolve(place).__name__ == "Task"
    assert sorted(path.name for path in kept.iterdir()) == ["beside.py", "task.py"]
    file.write_text(TASK)  # the file itself comes first
    assert known_files.place_of(f"{file}:Task", kept.parent) == f"{file}:Task"


def test_modules_are_asked_for_too(file, log, monkeypatch):
    """Finding one imports no package around it."""
    monkeypatch.syspath_prepend(file.parent)
    package = file.parent / "evil"
    package.mkdir()
    for name in ("__init__.py", "task.py"):
        (package / name).write_text(TASK)
    for place in ("evil:Task", "evil.task:Task", "evil.no.task:Task", "no_such:Task", "antigravity:Task"):
        with pytest.raises(UnnamedFileError, match=f"--task {place}"):
            registry.resolve(place)
    assert not log.exists()
    assert registry.resolve("evil.task:Task", by_user=True).__name__ == "Task"
    forget(monkeypatch)
    assert registry.resolve("evil.task:Task").__name__ == "Task"
    assert registry.resolve("torchrl_loco:WalkerWalk") is registry.resolve("walker_walk")  # loaded already


def test_where_nothing_can_be_remembered(file, monkeypatch):
    """This process knows what the user named; a line that was cut, or a folder that is relative, tells nothing."""
    store = known_files.store()
    store.parent.parent.mkdir()
    store.parent.write_text("in the way")
    with pytest.warns(UserWarning, match=f"other processes will not know that {file} is yours"):
        registry.resolve(f"{file}:Task", by_user=True)
    assert known_files.is_known(file)
    forget(monkeypatch)
    assert not known_files.is_known(file)
    store.parent.unlink()
    store.parent.mkdir()
    store.write_text(f"{'0' * 64}  {file}")
    assert not known_files.is_known(file)
    monkeypatch.chdir(file.parent)
    monkeypatch.setenv("XDG_STATE_HOME", "state")
    monkeypatch.setenv("HOME", str(file.parent / "home"))
    assert known_files.store() == file.parent / "home/.local/state/torchrl_loco/known_files"
    assert os.environ["HOME"] in str(known_files.store())
