"""Which episodes succeeded: what each kind of data tells, and a choice by it."""

import warnings
from pathlib import Path

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from stable_baselines3 import SAC

from sb3_dtfm.cli.main import main
from sb3_dtfm.data import DatasetError, TrajectoryBuffer, load_dataset
from sb3_dtfm.recording.agent import record_agent
from sb3_dtfm.recording.demonstrations import record_demonstrations
from tests.data.small import ACTION_SPACE, make_trajectory

STOPS, SUCCESSES = np.array([2, 5, 9]), [1, 0, 1]
N = 9
STEPS = np.isin(np.arange(N), [1, 3, 8])  # of the second one not the last step's


def arrays(**changes):
    rng = np.random.default_rng(0)
    found = {"observations": rng.normal(size=(N, 3)), "actions": rng.uniform(-1, 1, (N, 2)), "rewards": np.arange(N)}
    return {**found, "episode_ends": STOPS, **changes}


@pytest.mark.parametrize(
    "told",
    [{"success": np.array(SUCCESSES)}, {"successes": np.array([SUCCESSES]).T}, {"is_success": STEPS}, {"success": STEPS}],
    ids=["episodes", "column", "steps", "the other name"],
)
def test_arrays_tell_of_each_episode_or_of_each_step(told):
    buffer = load_dataset(arrays(**told))
    assert buffer.successes.tolist() == SUCCESSES
    chosen = load_dataset(arrays(**told), success_only=True)
    assert chosen.episode_lengths.tolist() == [2, 4]
    assert load_dataset(arrays(**told), success_only=True, best_share=0.5).episode_lengths.tolist() == [4]


def test_d4rls_infos_tell(tmp_path):
    with h5py.File(tmp_path / "some.hdf5", "w") as file:
        for name, array in {**arrays(), "infos/success": STEPS, "infos/qpos": np.zeros((N, 2))}.items():
            file[name] = array
    assert load_dataset(tmp_path / "some.hdf5").successes.tolist() == SUCCESSES


def test_without_rewards_a_success_is_what_is_rewarded():
    unrewarded = {name: array for name, array in arrays(success=np.array(SUCCESSES)).items() if name != "rewards"}
    buffer = load_dataset(unrewarded)
    assert buffer.episode_returns.tolist() == SUCCESSES
    assert buffer.terminated.tolist() == [True, False, True]
    stops = [0, *STOPS]
    episodes = [
        {"obs": unrewarded["observations"][i:j], "acts": unrewarded["actions"][i:j], "success": success}
        for i, j, success in zip(stops, stops[1:], SUCCESSES, strict=False)
    ]
    buffer = load_dataset(episodes)
    assert buffer.episode_returns.tolist() == buffer.successes.tolist() == SUCCESSES
    assert buffer.terminated.tolist() == [True, False, True]


def test_infos_of_steps_and_episodes_tell():
    def steps(*successes):
        infos = ({} if success is None else {"is_success": success} for success in successes)
        return [(np.zeros(3), np.zeros(2), 0.0, False, False, info) for info in infos]

    buffer = load_dataset(
        [steps(False, True), steps(True, False), make_trajectory(3, actions=np.zeros((3, 2)), success=True)]
    )
    assert buffer.successes.tolist() == [1, 0, 1]
    silent = [[step[:5] for step in steps(True)], [(*step[:5], np.zeros(3)) for step in steps(True)]]
    buffer = load_dataset([steps(True), steps(None), *silent])
    assert np.isnan(buffer.successes).tolist() == [False, True, True, True]


@pytest.mark.parametrize(
    ("data_format", "extra"),
    [("hdf5", 0), ("hdf5", 1), ("arrow", 1), ("parquet", 1)],
    ids=["of steps alone", "hdf5", "arrow", "parquet"],
)
def test_minaris_infos_tell(data_format, extra, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes = [
        EpisodeBuffer(
            observations=np.zeros((n + 1, 3)),
            actions=np.zeros((n, 2), np.float32),
            rewards=np.zeros(n),
            terminations=np.zeros(n, bool),
            truncations=np.ones(n, bool),
            infos={"success": np.arange(1, n + 1 + extra) == n + extra - (not success), "position": np.zeros(n + extra)},
        )
        for n, success in zip(np.diff(STOPS, prepend=0), SUCCESSES, strict=True)
    ]
    observation_space = spaces.Box(-1.0, 1.0, (3,), np.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        minari.create_dataset_from_buffers(
            "test/told-v0", episodes, observation_space=observation_space, action_space=ACTION_SPACE, data_format=data_format
        )
    assert load_dataset("test/told-v0").successes.tolist() == SUCCESSES
    for _ in range(2):  # written, and read again
        cached = load_dataset("test/told-v0", cache_dir=tmp_path / "cache", success_only=True)
        assert cached.episode_lengths.tolist() == [2, 4]


def test_what_is_saved_tells_as_much(tmp_path):
    load_dataset(arrays(success=np.array(SUCCESSES))).save(tmp_path / "told")
    assert load_dataset(tmp_path / "told.npz").successes.tolist() == SUCCESSES
    load_dataset(arrays()).save(tmp_path / "silent")
    assert np.isnan(load_dataset(tmp_path / "silent.npz").successes).all()
    some = [SUCCESSES[0], np.nan, *SUCCESSES[2:]]
    load_dataset(arrays(success=np.array(some))).save(tmp_path / "some")
    np.testing.assert_array_equal(load_dataset(tmp_path / "some.npz").successes, some)


def test_robomimic_files_tell(tmp_path):
    record_demonstrations("lift", 2, tmp_path / "lift.hdf5", progress=False)
    assert load_dataset(tmp_path / "lift.hdf5").successes.tolist() == [1, 1]


def test_a_choice_that_cannot_be_made_is_refused():
    silent = "success_only, but of 3 of 3 episodes the data do not tell whether they succeeded; min_return chooses"
    with pytest.raises(DatasetError, match=silent):
        load_dataset(arrays(), success_only=True)
    with pytest.raises(DatasetError, match="success_only, but none of 3 episodes is a success"):
        load_dataset(arrays(success=np.zeros(3)), success_only=True)
    with pytest.raises(DatasetError, match=r"arrays: success have shape \(4,\), expected \(9,\)"):
        load_dataset(arrays(success=np.zeros(4)))
    with pytest.raises(DatasetError, match=r"arrays: success hold 2.* 0 and 1 are accepted"):
        load_dataset(arrays(success=np.full(3, 2)))
    episode = {"obs": np.zeros((4, 3)), "acts": np.zeros((4, 2)), "rews": np.zeros(4)}
    for told, message in ((np.ones(3), r"success have shape \(3,\), expected \(4,\)"), (0.5, "success hold 0.5")):
        with pytest.raises(DatasetError, match=f"episode 0: {message}"):
            load_dataset([{**episode, "success": told}])
    halves = [make_trajectory(3, success=True), make_trajectory(4)]
    with pytest.raises(DatasetError, match="of 1 of 2 episodes the data do not tell"):
        TrajectoryBuffer.from_trajectories(halves, ACTION_SPACE).best(success_only=True)


class Told(gym.Env):
    """Three steps, whose success is drawn at the start and seen from then on, and told at the last step."""

    observation_space = spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.drawn, self.n_steps = np.float32(self.np_random.integers(2, size=1)), 0
        return self.drawn.copy(), {}

    def step(self, action):
        self.n_steps += 1
        done = self.n_steps == 3
        return self.drawn.copy(), 0.0, done, False, {"is_success": self.drawn[0] == 1.0} if done else {}


gym.register("Told-v0", entry_point=Told)


@pytest.mark.filterwarnings("ignore:The environment cannot be recovered")
def test_what_a_task_says_of_success_is_recorded_and_shown(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    SAC("MlpPolicy", "Told-v0", buffer_size=1).save("agent")
    record_agent("sac", Path("agent.zip"), "Told-v0", 6, "test/told-v0", progress=False)
    buffer = load_dataset("test/told-v0")
    drawn = buffer.observations[buffer.episodes.starts, 0]
    assert 0 < drawn.sum() < 6
    assert buffer.successes.tolist() == drawn.tolist()
    assert main(["inspect", "test/told-v0"]) == 0
    assert f"| successes | {int(drawn.sum())} of 6 |" in capsys.readouterr().out
    assert main(["inspect", "test/told-v0", "--dataset-kwargs", "success_only:True"]) == 0
    shown = capsys.readouterr().out
    assert f"| successes | {int(drawn.sum())} of {int(drawn.sum())} |" in shown
    assert "dataset_kwargs:dict(success_only=True)" in shown
