"""Killed at any moment: whatever a training, a recording or a cache leaves behind under its own name can be loaded."""

import os
import resource
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch as th

import sb3_dtfm.zoo.resuming as resuming
from sb3_dtfm import DTFM
from sb3_dtfm.cli.main import main
from sb3_dtfm.data import load_dataset
from sb3_dtfm.files import replacing
from sb3_dtfm.files.replacing import MACHINE
from sb3_dtfm.recording.demonstrations import record_demonstrations
from tests.algorithms.small import make_model
from tests.recorded import DATASET_ID, tiny_training

N_KILLS = 20  # of each
NOBODY = 65534  # a user without rights
RUN = Path("logs/dtfm/HalfCheetah-v5_1")


def start(work: Callable[[], object]) -> int:
    """Do some work in a process of its own, which says nothing."""
    child = os.fork()
    if child == 0:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        work()
        os._exit(0)
    return child


def kill_after(seconds: float, work: Callable[[], object]) -> bool:
    """Whether the work was killed; False if it was done before."""
    child = start(work)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def finishes(work: Callable[[], object]) -> bool:
    """Whether the work comes to its end where nobody kills it."""
    return os.waitpid(start(work), 0)[1] == 0


def kill_often(work: Callable[[], object], check: Callable[[], object], seed: int) -> None:
    """Kill at random moments of the time that the work takes, and look at what is left each time."""
    begin = time.perf_counter()
    assert finishes(work)
    whole = time.perf_counter() - begin
    random = np.random.default_rng(seed)
    n_killed = 0
    for _ in range(N_KILLS):
        n_killed += kill_after(float(random.uniform(0.0, whole)), work)
        check()
    assert n_killed >= N_KILLS // 2
    assert finishes(work)
    check()


@pytest.mark.slow
def test_a_killed_training_leaves_models_that_load(workplace, monkeypatch):
    """A checkpoint, a best model, a numbered one and the last one, all the time over those of the runs before."""
    monkeypatch.setattr(resuming, "CHECKPOINT_INTERVAL", 0.0)
    settings = ["--dataset", DATASET_ID, "--eval-freq", "3", "--eval-episodes", "1", "--seed", "0"]

    def train() -> None:
        resume = ["--resume", str(RUN)] if (RUN / resuming.START).is_file() else []
        main([*tiny_training("dtfm", *settings, "--save-freq", "2"), "-n", "30", "--num-threads", "1", *resume])

    def check() -> None:
        for path in Path("logs").rglob("*.zip"):
            DTFM.load(path)
        for path in Path("logs").rglob("*.json"):
            resuming.Start.read(path.parent)
        for path in Path("logs").rglob("evaluations.npz"):
            with np.load(path) as evaluations:
                assert len(evaluations["results"]) == len(evaluations["timesteps"])

    kill_often(train, check, seed=0)
    assert not list(RUN.glob(".*.part"))
    assert th.isfinite(DTFM.load(RUN / "HalfCheetah-v5.zip").policy.state_dict()["noise_table"]).all()


@pytest.mark.slow
def test_a_killed_recording_leaves_the_one_before(workplace, minari_folder):
    agent = str(minari_folder / "agent.zip")
    name = "tests/halfcheetah/killed-v0"
    record = ["record", "--algo", "ppo", "--model", agent, "--env", "HalfCheetah-v5", "--dataset-id", name, "--overwrite"]

    def check() -> None:
        if (minari_folder / name).exists():
            assert load_dataset(name).n_episodes == 2

    kill_often(lambda: main([*record, "--episodes", "2", "--n-envs", "2"]), check, seed=1)
    assert load_dataset(name).n_episodes == 2
    assert not list(minari_folder.glob(".*.part"))


@pytest.mark.slow
def test_a_killed_cache_is_built_again(workplace):
    """Also one that takes the place of an outdated one: the dataset is written anew before each."""
    random = np.random.default_rng(0)
    n_steps = 300_000
    steps = {name: random.uniform(-1, 1, (n_steps, *shape)) for name, shape in (("observations", (17,)), ("actions", (3,)))}
    lengths = np.full(n_steps // 1000, 1000)
    np.savez("data.npz", **steps, rewards=np.arange(n_steps), episode_lengths=lengths)

    def build() -> None:
        os.utime("data.npz")
        load_dataset("data.npz", cache_dir="cache")

    def check() -> None:
        if random.uniform() < 0.3:
            assert load_dataset("data.npz", cache_dir="cache").rewards[-1] == n_steps - 1

    kill_often(build, check, seed=2)
    assert load_dataset("data.npz", cache_dir="cache").rewards[-1] == n_steps - 1
    assert len([path for path in Path("cache").iterdir() if path.is_dir()]) == 1


def test_a_file_is_whole_or_as_before(tmp_path):
    """The file written beside takes its place at the end, and only if nothing was raised."""

    def write(value: int, fail: bool = False) -> None:
        with replacing(path) as beside, h5py.File(beside, "w") as file:
            file.attrs["value"] = value
            if fail:
                raise RuntimeError

    path = tmp_path / "file.hdf5"
    write(1)
    write(2)
    with pytest.raises(RuntimeError):
        write(3, fail=True)
    with h5py.File(path) as file:
        assert file.attrs["value"] == 2
    assert [each.name for each in tmp_path.iterdir()] == ["file.hdf5"]


def test_leftovers_of_killed_processes_alone_are_removed(tmp_path):
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    dead, alive, elsewhere = (f".file.{machine}.{process}.0a.part" for machine, process in (
        (MACHINE, child), (MACHINE, os.getpid()), ("elsewhere", child)
    ))  # fmt: skip
    for name in (dead, alive, elsewhere, ".others.part"):
        (tmp_path / name).touch()
    with replacing(tmp_path / "new") as beside:
        beside.touch()
    assert {each.name for each in tmp_path.iterdir()} == {alive, elsewhere, ".others.part", "new"}


def on_a_full_disk(size: int, work: Callable[[], object]) -> str:
    """Error of work that may write no file of more than `size` bytes."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        work()

    return said_by(limited)


def said_by(work: Callable[[], object]) -> str:
    """Error of work in a process of its own."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            work()
        except Exception as error:
            os.write(writing, f"{type(error).__name__}: {error}".encode())
        os._exit(0)
    os.close(writing)
    with open(reading) as said:
        text = said.read()
    assert os.waitpid(child, 0)[1] == 0
    return text


@pytest.mark.parametrize("size", [1_000, 100_000])
def test_a_full_disk_is_one_line_with_the_path_and_loses_nothing(size, cheetah_buffer, tmp_path):
    model = make_model(DTFM, cheetah_buffer)
    writers: dict[str, Callable[[Path], object]] = {
        "model.zip": model.save,
        "lift.hdf5": lambda path: record_demonstrations("lift", 2, path, n_workers=1, overwrite=True, progress=False),
    }
    for name, write in writers.items():
        write(tmp_path / name)
        before = (tmp_path / name).read_bytes()
        said = on_a_full_disk(size, lambda write=write, name=name: write(tmp_path / name))
        assert said == f"OSError: [Errno 27] File too large: '{tmp_path / name}'"
        assert (tmp_path / name).read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == writers.keys()


@pytest.fixture
def small_disk(tmp_path):
    """A file system of its own with two megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(folder)], capture_output=True).returncode:
        pytest.skip("mounting a file system takes the rights of root")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_recording_leaves_a_full_disk_before_hdf5_breaks(small_disk, minari_folder, monkeypatch, capsys):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(small_disk))
    record = [
        "record",
        "--algo",
        "ppo",
        "--model",
        str(minari_folder / "agent.zip"),
        "--env",
        "HalfCheetah-v5",
        "--n-envs",
        "2",
    ]
    assert main([*record, "--dataset-id", "tests/full-v0", "--episodes", "2"]) == 0
    assert main([*record, "--dataset-id", "tests/full-v0", "--episodes", "8", "--overwrite"]) == 2
    assert f"{small_disk}: No space left on device" in capsys.readouterr().err
    assert load_dataset("tests/full-v0").n_episodes == 2
    assert not list(small_disk.glob(".*"))


@pytest.mark.parametrize("folder", ["a folder of that name", "missing/parent"])
def test_what_cannot_be_written_is_named(folder, tmp_path):
    (tmp_path / "missing").write_text("a file where a folder would be")
    path = tmp_path / folder / "model.zip"
    if folder == "a folder of that name":
        path.mkdir(parents=True)
    with pytest.raises(OSError, match=r"model\.zip") as error, replacing(path) as beside:
        beside.touch()
    assert error.value.filename == str(path)
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("name", ["model.zip", "lift.hdf5"])
def test_a_read_only_folder_is_one_line_with_the_path(name, cheetah_buffer):
    """As a user without root's rights."""
    model = make_model(DTFM, cheetah_buffer)
    with tempfile.TemporaryDirectory() as top:  # pytest's own folders are closed to others
        Path(top).chmod(0o755)
        folder = Path(top) / "shared"
        folder.mkdir()
        path = folder / name
        path.write_text("what was there before")
        folder.chmod(0o555)

        def write() -> None:
            if os.geteuid() == 0:
                os.setgid(NOBODY)
                os.setuid(NOBODY)
            assert os.access(path, os.R_OK)  # so that writing is all that is forbidden
            assert not os.access(folder, os.W_OK)
            if name == "model.zip":
                model.save(path)
            else:
                record_demonstrations("lift", 2, path, n_workers=1, overwrite=True, progress=False)

        assert said_by(write) == f"PermissionError: [Errno 13] Permission denied: '{path}'"
        assert path.read_text() == "what was there before"
        assert list(folder.iterdir()) == [path]
        folder.chmod(0o755)
