"""Memory-mapped caches: the same data as from memory, made anew when the dataset changes, refused when damaged."""

import concurrent.futures
import contextlib
import itertools
import json
import mmap
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import h5py
import minari
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer

from sb3_dtfm.data import DatasetError, ScoreReference, TrajectoryBuffer, cache, load_dataset
from sb3_dtfm.data.cache import FORMAT, Fingerprint, files_below, load_cached
from sb3_dtfm.data.storage import CAN_ADVISE, STEP_ARRAYS, FileStorage, step_file
from tests.data.small import ACTION_SPACE, OBSERVATION_SPACE, make_buffer, make_trajectory


@pytest.fixture(autouse=True)
def datasets_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


@pytest.fixture
def robomimic_file(tmp_path: Path) -> Path:
    path = tmp_path / "lift.hdf5"
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = json.dumps({"env_name": "Lift"})
        for number in range(4):
            demo = file.create_group(f"data/demo_{number}")
            demo["actions"] = rng.uniform(-1.0, 1.0, (9, 7))
            demo["rewards"] = demo["dones"] = np.arange(9) == 8
            demo["obs/object"] = rng.normal(size=(9, 10))
        file["mask/train"] = np.array([b"demo_1", b"demo_3"])
    return path


def load(path: Path, cache: Path | None, **kwargs: object) -> TrajectoryBuffer:
    return load_dataset(path, cache_dir=cache, observation_keys=["object"], **kwargs)


def folders(cache: Path) -> list[str]:
    """Everything in a folder of caches except its lock files."""
    return sorted(path.name for path in cache.iterdir() if path.suffix != ".lock")


def only_folder(cache: Path) -> Path:
    [name] = folders(cache)
    return cache / name


def assert_same(ours: TrajectoryBuffer, theirs: TrajectoryBuffer) -> None:
    for name in STEP_ARRAYS:
        assert th.equal(getattr(ours, name), getattr(theirs, name)), name
    for name, column in theirs.episodes._asdict().items():
        np.testing.assert_array_equal(getattr(ours.episodes, name), column, err_msg=name)
        assert getattr(ours.episodes, name).dtype == column.dtype, name
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.score_reference == theirs.score_reference
    assert ours.env_id == theirs.env_id


def forbid_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    def append(self: FileStorage, steps: object) -> None:
        raise AssertionError("the dataset is read again")

    monkeypatch.setattr(FileStorage, "append", append)


def test_a_cache_holds_what_the_file_holds_and_is_opened_without_reading_it(
    robomimic_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    from_memory = load(robomimic_file, None)
    built = load(robomimic_file, tmp_path / "cache")
    forbid_reading(monkeypatch)
    opened = load(robomimic_file, tmp_path / "cache")
    for buffer in (built, opened):
        assert_same(buffer, from_memory)
        assert buffer.memory_mapped
        assert str(robomimic_file) in buffer.source
        assert str(only_folder(tmp_path / "cache")) in buffer.source
    assert not from_memory.memory_mapped


def test_a_minari_dataset_is_cached_with_its_score_scale_and_choice_of_episodes(tmp_path: Path):
    rng = np.random.default_rng(0)
    episodes = [
        EpisodeBuffer(
            observations=rng.normal(size=(n + 1, 3)),
            actions=rng.uniform(-1, 1, (n, 1)),
            rewards=rng.normal(size=n),
            terminations=np.zeros(n, bool),
            truncations=np.arange(n) == n - 1,
        )
        for n in (4, 7, 5)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset = minari.create_dataset_from_buffers(
            "test/set-v0", episodes, env="Pendulum-v1", ref_min_score=-10.0, ref_max_score=30.0,
            action_space=spaces.Box(-1.0, 1.0, (1,), np.float32),
        )  # fmt: skip
    cached = load_dataset("test/set-v0", cache_dir=tmp_path / "cache")
    assert isinstance(cached.score_reference, ScoreReference)
    assert cached.env_id == "Pendulum-v1"
    assert_same(cached, load_dataset("test/set-v0"))
    chosen = dataset.filter_episodes(lambda episode: len(episode.rewards) > 4)
    assert load_dataset(chosen, cache_dir=tmp_path / "cache").episode_lengths.tolist() == [7, 5]
    assert load_dataset(dataset, cache_dir=tmp_path / "cache").episode_lengths.tolist() == [4, 7, 5]
    assert len(folders(tmp_path / "cache")) == 2


@pytest.mark.parametrize("n_ahead", [0, 7])
def test_windows_fractions_and_statistics_of_a_cache_are_those_from_memory(
    n_ahead: int, robomimic_file: Path, tmp_path: Path
):
    buffers = [load(robomimic_file, cache).random_fraction(0.5, 1) for cache in (None, tmp_path / "cache")]
    batches = [buffer.batches(20, 5, th.Generator().manual_seed(0), n_ahead) for buffer in buffers]
    for from_memory, cached in itertools.islice(zip(*batches, strict=True), 3):
        assert all(th.equal(ours, theirs) for ours, theirs in zip(cached, from_memory, strict=True))
    for ours, theirs in zip(*(buffer.statistics() for buffer in buffers), strict=True):
        np.testing.assert_array_equal(ours, theirs)


class RecordedAdvice:
    """Stands before a memory map and remembers which bytes the system was asked to read."""

    def __init__(self, map_: mmap.mmap) -> None:
        self._map, self.asked = map_, []

    def madvise(self, option: int, start: int, length: int) -> None:
        self._map.madvise(option, start, length)  # refuses what lies outside of the file
        assert option == mmap.MADV_WILLNEED
        self.asked.append((start, start + length))


@pytest.mark.skipif(not CAN_ADVISE, reason="needs madvise")
@pytest.mark.parametrize("context_length", [1, 5, 300, 2000])
def test_the_next_batch_is_asked_for_before_the_present_one_is_handed_out(context_length: int, tmp_path: Path):
    """All of its windows, also the first one, which starts before the file does, and the one that stops where it ends."""
    n_steps, batch_size = 1501, 5000
    buffer = load_cached(tmp_path, Fingerprint("set", "", "", ""), fill([700, 1, 800]))
    for steps in buffer._maps:
        steps._map = RecordedAdvice(steps._map)
    next(buffer.batches(batch_size, context_length, th.Generator().manual_seed(0)))
    generator = th.Generator().manual_seed(0)
    drawn = [end for _ in range(2) for end in th.randint(n_steps, (batch_size,), generator=generator).tolist()]
    assert {0, n_steps - 1} <= set(drawn[batch_size:])
    tensors = {steps.tensor.data_ptr(): steps for steps in buffer._maps}
    for name in ("observations", "actions", "returns_to_go"):
        values = getattr(buffer, name)
        row_bytes = values.nbytes // n_steps
        offset = step_file(only_folder(tmp_path), name).stat().st_size - values.nbytes
        asked = tensors[values.data_ptr()]._map.asked
        for (start, stop), end in zip(asked, drawn, strict=True):
            assert start <= offset + max(0, end + 1 - context_length) * row_bytes < start + mmap.PAGESIZE
            assert stop == offset + (end + 1) * row_bytes


def test_what_is_written_to_a_buffer_does_not_reach_the_cache(robomimic_file: Path, tmp_path: Path):
    load(robomimic_file, tmp_path / "cache").observations.fill_(7.0)
    assert load(robomimic_file, tmp_path / "cache").observations.max() < 7.0


def test_other_arguments_have_a_cache_of_their_own(robomimic_file: Path, tmp_path: Path):
    assert load(robomimic_file, tmp_path / "cache").n_episodes == 4
    assert load(robomimic_file, tmp_path / "cache", filter_key="train").n_episodes == 2
    assert len(folders(tmp_path / "cache")) == 2


def test_a_changed_file_replaces_its_cache(robomimic_file: Path, tmp_path: Path):
    load(robomimic_file, tmp_path / "cache")
    before = folders(tmp_path / "cache")
    with h5py.File(robomimic_file, "a") as file:
        file["data/demo_2/actions"][3] = 0.25
    os.utime(robomimic_file, ns=(0, 12345))
    buffer = load(robomimic_file, tmp_path / "cache")
    assert buffer.actions[21].tolist() == [0.25] * 7
    assert folders(tmp_path / "cache") == before


def test_a_cache_of_an_older_format_is_made_anew(robomimic_file: Path, tmp_path: Path):
    load(robomimic_file, tmp_path / "cache")
    description = only_folder(tmp_path / "cache") / "cache.json"
    description.write_text(json.dumps({**json.loads(description.read_text()), "format": FORMAT - 1}))
    forged = only_folder(tmp_path / "cache") / "rewards.npy"
    forged.write_bytes(b"of an older format")
    assert_same(load(robomimic_file, tmp_path / "cache"), load(robomimic_file, None))
    assert json.loads(description.read_text())["format"] == FORMAT


def test_a_dataset_that_is_refused_leaves_no_cache(robomimic_file: Path, tmp_path: Path):
    with h5py.File(robomimic_file, "a") as file:
        file["data/demo_2/actions"][3] = np.nan
    with pytest.raises(DatasetError, match=r"lift.hdf5, demo_2, step 3: actions hold nan"):
        load(robomimic_file, tmp_path / "cache")
    assert folders(tmp_path / "cache") == []


def test_a_killed_build_leaves_no_cache_and_nothing_that_disturbs_the_next_one(tmp_path: Path):
    script = f"""
import os, pathlib
from sb3_dtfm.data import TrajectoryBuffer
from sb3_dtfm.data.cache import Fingerprint, load_cached
from tests.data.small import ACTION_SPACE, make_trajectory
def episodes():
    yield make_trajectory(5)
    os.kill(os.getpid(), 9)
load_cached(pathlib.Path(r"{tmp_path}"), Fingerprint("set", "", "", ""),
    lambda storage: TrajectoryBuffer.from_trajectories(episodes(), ACTION_SPACE, storage=storage))
"""
    root = Path(__file__).parents[2]
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    assert subprocess.run([sys.executable, "-c", script], env=environment, cwd=root, check=False).returncode == -9
    [left] = folders(tmp_path)
    assert left.endswith(".part")
    buffer = load_cached(tmp_path, Fingerprint("set", "", "", ""), fill([5, 3]))
    assert_same(buffer, make_buffer([5, 3]))
    assert not only_folder(tmp_path).name.endswith(".part")


def fill(lengths: list[int]) -> Callable[[FileStorage], TrajectoryBuffer]:
    trajectories = [make_trajectory(length, seed) for seed, length in enumerate(lengths)]
    return lambda storage: TrajectoryBuffer.from_trajectories(trajectories, ACTION_SPACE, OBSERVATION_SPACE, storage=storage)


@pytest.mark.parametrize("name", ["observations.npy", "returns_to_go.npy", "episodes.npz", "cache.json"])
@pytest.mark.parametrize("damage", ["missing", "empty", "cut off", "other"])
def test_a_damaged_cache_is_refused_with_what_to_do(name: str, damage: str, robomimic_file: Path, tmp_path: Path):
    load(robomimic_file, tmp_path / "cache")
    file = only_folder(tmp_path / "cache") / name
    content = file.read_bytes()
    if damage == "missing":
        file.unlink()
    elif damage == "other":
        np.save(file.with_suffix(".npy"), np.zeros(3))
        os.replace(file.with_suffix(".npy"), file)
    else:
        file.write_bytes(content[: len(content) - 4 if damage == "cut off" else 0])
    with pytest.raises(DatasetError, match=rf"{name} is damaged .*; delete this folder to have it built anew"):
        load(robomimic_file, tmp_path / "cache")


N_FLIPPED = 60


def test_no_flipped_byte_of_a_cache_is_learned_from(robomimic_file: Path, tmp_path: Path):
    """Refused, or built anew where the cache no longer says what it is of."""
    right = load(robomimic_file, None)
    load(robomimic_file, tmp_path / "cache")
    rng, refused = np.random.default_rng(0), 0
    for _ in range(N_FLIPPED):
        file = rng.choice(sorted(only_folder(tmp_path / "cache").iterdir()))
        content = bytearray(file.read_bytes())
        content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
        file.write_bytes(content)
        try:
            assert_same(load(robomimic_file, tmp_path / "cache"), right)
        except DatasetError as error:
            assert f"{file.name} is damaged" in str(error)  # noqa: PT017
            refused += 1
        shutil.rmtree(tmp_path / "cache")
        load(robomimic_file, tmp_path / "cache")
    assert refused > 40


def test_files_are_checked_once_in_a_process(robomimic_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    load(robomimic_file, tmp_path / "cache")
    monkeypatch.setattr(cache, "_file_digest", forbidden)
    load(robomimic_file, tmp_path / "cache")


def forbidden(*args: object) -> None:
    raise AssertionError("looked at again")


def test_a_large_file_is_checked_in_the_background_and_told_of_by_the_batch_after(
    robomimic_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    load(robomimic_file, tmp_path / "cache")
    file = only_folder(tmp_path / "cache") / "rewards.npy"
    file.write_bytes(file.read_bytes()[:-1] + b"\x01")
    monkeypatch.setattr(cache, "LARGE", 0)
    buffer = load(robomimic_file, tmp_path / "cache")
    concurrent.futures.wait([buffer._maps[0].check], timeout=10)
    with pytest.raises(DatasetError, match=r"rewards.npy is damaged .not as it was written.; delete this folder"):
        next(buffer.batches(2, 2, th.Generator().manual_seed(0)))


@pytest.mark.parametrize("killed_at", range(12))
def test_a_build_that_is_killed_anywhere_leaves_nothing_that_disturbs_the_next_one(
    killed_at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """It ends in turn before each rename, removal and write that replaces an outdated cache."""
    fingerprints = [Fingerprint("set", "", "", state) for state in ("old", "new")]
    load_cached(tmp_path, fingerprints[0], fill([4]))
    count = itertools.count()

    def mortal(act: Callable[..., object]) -> Callable[..., object]:
        def wrapper(*args: object, **kwargs: object) -> object:
            if next(count) >= killed_at:  # nothing tidies up after it
                raise Killed
            return act(*args, **kwargs)

        return wrapper

    with monkeypatch.context() as patch:
        for owner, name in (
            (os, "unlink"),
            (os, "rmdir"),
            (Path, "rename"),
            (Path, "mkdir"),
            (np, "savez"),
            (Path, "write_text"),
        ):
            patch.setattr(owner, name, mortal(getattr(owner, name)))
        patch.setattr(cache.contextlib, "closing", contextlib.nullcontext)
        with contextlib.suppress(Killed):
            load_cached(tmp_path, fingerprints[1], fill([5, 3]))
    assert_same(load_cached(tmp_path, fingerprints[1], fill([5, 3])), make_buffer([5, 3]))
    assert not [name for name in folders(tmp_path) if name.startswith(".")]


class Killed(BaseException):
    pass


def test_a_current_cache_is_opened_from_a_folder_that_cannot_be_written(
    robomimic_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    load(robomimic_file, tmp_path / "cache")
    monkeypatch.setattr(cache, "FileLock", forbidden)
    load(robomimic_file, tmp_path / "cache")


def test_a_disk_that_is_full_at_the_end_is_told_in_one_line_and_leaves_no_cache(
    robomimic_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def full(*args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(FileStorage, "_write_header", full)
    with pytest.raises(DatasetError, match=r"^cache .*lift.hdf5.* cannot be written: .*No space left on device$"):
        load(robomimic_file, tmp_path / "cache")
    assert folders(tmp_path / "cache") == []


def test_a_cache_that_cannot_be_written_is_named(robomimic_file: Path, tmp_path: Path):
    (tmp_path / "cache").write_text("a file")
    with pytest.raises(DatasetError, match=r"cache .*lift.hdf5.* cannot be written"):
        load(robomimic_file, tmp_path / "cache")


@pytest.mark.parametrize("env_id", [None, "Pendulum-v1"])
def test_a_cache_keeps_the_spaces_with_their_precision_and_the_environment(env_id: str | None, tmp_path: Path):
    boxes = [spaces.Box(-0.1, 0.1, (2,), np.float64), spaces.Box(-np.inf, np.inf, (3,), np.float64)]
    trajectories = [make_trajectory(4, actions=np.full((4, 2), 0.1))]

    def read(storage: FileStorage | None) -> TrajectoryBuffer:
        return TrajectoryBuffer.from_trajectories(trajectories, *boxes, env_id=env_id, storage=storage)

    cached = load_cached(tmp_path, Fingerprint("set", "", "", ""), read)
    assert_same(cached, read(None))
    assert (cached.action_space.dtype, cached.env_id) == (np.float64, env_id)


def test_an_environment_of_one_s_own_choice_stays_out_of_the_cache(robomimic_file: Path, tmp_path: Path):
    env_ids = ["Walker2d-v5", None, "Walker2d-v5"]
    found = [load(robomimic_file, tmp_path / "cache", env_id=env_id).env_id for env_id in env_ids]
    assert found == ["Walker2d-v5", "robosuite/Lift-v0", "Walker2d-v5"]
    assert len(folders(tmp_path / "cache")) == 1


@pytest.mark.parametrize("problem", ["does not exist", "is a folder"])
def test_a_missing_file_leaves_no_cache(problem: str, tmp_path: Path):
    path = tmp_path / "lift.hdf5"
    if problem == "is a folder":
        path.mkdir()
    with pytest.raises(DatasetError, match=f"lift.hdf5 {problem}"):
        load(path, tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


def test_a_full_disk_is_no_fault_of_the_dataset(tmp_path: Path):
    (tmp_path / "observations.npy").symlink_to("/dev/full")
    storage = FileStorage(tmp_path, "test")
    with pytest.raises(DatasetError, match=r"cannot be written: .*No space left"):
        storage.append({"observations": np.zeros((2**19, 1))})


def test_a_buffer_has_no_cache(tmp_path: Path):
    with pytest.raises(
        TypeError, match=r"TrajectoryBuffer\(trajectories: 1 episodes, 2 steps\): unknown option cache_dir; accepted: env_id"
    ):
        load_dataset(make_buffer([2]), cache_dir=tmp_path)


def test_bounds_that_are_given_and_the_environments_have_caches_of_their_own(tmp_path: Path):
    """The environment's count less than the file's, those that are given more."""
    make_buffer([3, 4]).save(tmp_path / "a.npz")
    wide = spaces.Box(-9.0, 9.0, make_buffer([3]).action_space.shape)
    cached = dict(cache_dir=tmp_path / "caches")
    assert load_dataset(tmp_path / "a.npz", action_space=wide, **cached).action_space.high.max() < 9.0
    assert load_dataset(tmp_path / "a.npz", action_bounds=(wide.low, wide.high), **cached).action_space.high.min() == 9.0


def test_files_behind_a_linked_folder_are_known_and_a_circle_is_not_walked_for_ever(tmp_path: Path):
    data, disk = tmp_path / "data", tmp_path / "data" / "disk"
    disk.mkdir(parents=True)
    (disk / "a.bin").write_text("1")
    (data / "b.bin").symlink_to(disk / "a.bin")
    (disk / "back").symlink_to(data)
    (tmp_path / "linked").symlink_to(data)
    assert files_below(tmp_path / "linked") == [tmp_path / "linked" / "b.bin", tmp_path / "linked" / "disk" / "a.bin"]
    before = Fingerprint.of("data", data, {})
    (disk / "a.bin").write_text("12")
    assert Fingerprint.of("data", data, {}).state != before.state


@pytest.mark.parametrize("link", ["data", "data/x", "data/x.bin"])
def test_a_link_that_leads_out_of_a_dataset_is_not_followed(link: str, tmp_path: Path):
    """A hub's snapshot links to the hub's blobs."""
    snapshot, blob = tmp_path / "snapshots" / "1", tmp_path / "blobs" / "a"
    for file in (blob, tmp_path / "other" / "a", snapshot / "data" / "a.bin"):
        file.parent.mkdir(parents=True)
        file.write_text("1")
    (snapshot / "data" / "b.bin").symlink_to("../../../blobs/a")
    assert len(files_below(snapshot, "data")) == 2
    if link == "data":
        shutil.rmtree(snapshot / "data")
    (snapshot / link).symlink_to(tmp_path / "other" / ("a" if link.endswith("bin") else ""))
    for part in ("", "data"):
        with pytest.raises(DatasetError, match=f"{link} leads to .*other.*; links within .*snapshots/1 are accepted"):
            files_below(snapshot, part)
