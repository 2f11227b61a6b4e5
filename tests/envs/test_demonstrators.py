"""The scripted demonstrators: success, variety, repetition, recovery, and what recording makes of them."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from sb3_dtfm.cli.main import main
from sb3_dtfm.data.robomimic import load_robomimic
from sb3_dtfm.envs.demonstrators import DEMONSTRATORS, DOWNWARD, LiftDemonstrator, _rotation_between
from sb3_dtfm.envs.robosuite import RobosuiteEnv
from sb3_dtfm.recording.demonstrations import RecordingSummary, record_demonstrations


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "lift.hdf5"
    return path, record_demonstrations("lift", 4, path, seed=3, n_workers=1, progress=False)


def demonstrate(env, seed, demonstrator_seed=None):
    observation, _ = env.reset(seed=seed)
    demonstrator = DEMONSTRATORS[env.task](seed if demonstrator_seed is None else demonstrator_seed)
    actions, terminated, truncated = [], False, False
    while not (terminated or truncated):
        actions.append(demonstrator.act(observation))
        observation, _, terminated, truncated, _ = env.step(actions[-1])
    return np.stack(actions), terminated


def contents(path):
    """Every array and attribute of a file, by name."""
    found = {}

    def visit(name, node):
        found.update({f"{name}@{key}": value for key, value in node.attrs.items()})
        if isinstance(node, h5py.Dataset):
            found[name] = node[()]

    with h5py.File(path) as file:
        file.visititems(visit)
    return found


def assert_same_file(first, second):
    first, second = contents(first), contents(second)
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


def test_lift_succeeds(lift):
    runs = [demonstrate(lift, seed) for seed in range(5)]
    assert all(success for _, success in runs)
    assert np.mean([len(actions) for actions, _ in runs]) < 73


def test_can_succeeds():
    env = RobosuiteEnv("Can")
    runs = [demonstrate(env, seed) for seed in range(2)]
    env.close()
    assert all(success for _, success in runs)
    assert np.mean([len(actions) for actions, _ in runs]) < 167


def test_actions_are_smooth_and_within_bounds(lift):
    actions, _ = demonstrate(lift, 0)
    assert actions.dtype == np.float32
    assert np.abs(actions).max() <= 1.0
    assert np.abs(np.diff(actions[:, :3], axis=0)).mean() < 0.15
    assert set(actions[:, 6]) == {-1.0, 1.0}


def test_seed_decides_and_another_seed_does_otherwise(lift):
    first, _ = demonstrate(lift, 2, demonstrator_seed=5)
    again, _ = demonstrate(lift, 2, demonstrator_seed=5)
    other, _ = demonstrate(lift, 2, demonstrator_seed=6)
    np.testing.assert_array_equal(first, again)
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_each_episode_of_one_demonstrator_has_its_own_manner():
    demonstrator = LiftDemonstrator(0)
    first = demonstrator.manner
    demonstrator.reset()
    assert demonstrator.manner.speed != first.speed


def test_cube_pushed_away_from_the_fingers_is_fetched(lift):
    observation, _ = lift.reset(seed=4)
    demonstrator = LiftDemonstrator(4)
    stages, pushed, terminated, truncated = [], False, False, False
    while not (terminated or truncated):
        action = demonstrator.act(observation)
        stages.append(demonstrator.stage)
        if demonstrator.stage == "grasp" and not pushed:
            pushed = True
            sim = lift._env.sim
            position = sim.data.get_joint_qpos("cube_joint0").copy()
            sim.data.set_joint_qpos("cube_joint0", position + np.array([0.08, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        observation, _, terminated, truncated, _ = lift.step(action)
    assert terminated
    assert "hover" in stages[stages.index("grasp") :]


def test_rotation_between_orientations_is_the_world_rotation():
    half = 0.15  # of a turn of 0.3 rad around z, which leaves "downward" short by as much
    turn = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
    turned = np.array([turn[3], turn[2], 0.0, 0.0])  # turn * DOWNWARD, as quaternions
    np.testing.assert_allclose(_rotation_between(turned, DOWNWARD), [0.0, 0.0, -0.3], atol=1e-12)
    np.testing.assert_allclose(_rotation_between(-turned, DOWNWARD), [0.0, 0.0, -0.3], atol=1e-12)
    np.testing.assert_allclose(_rotation_between(DOWNWARD, DOWNWARD), np.zeros(3), atol=1e-12)


def test_recording_is_the_same_with_any_number_of_workers(recording, tmp_path):
    path, summary = recording
    parallel = tmp_path / "parallel.hdf5"
    other = record_demonstrations("lift", 4, parallel, seed=3, n_workers=2, progress=False)
    assert_same_file(path, parallel)
    assert other[1:4] == summary[1:4]


def test_summary_and_file_agree(recording):
    path, summary = recording
    buffer = load_robomimic(path)
    assert isinstance(summary, RecordingSummary)
    assert summary.n_episodes == buffer.n_episodes == 4
    assert summary.mean_length == buffer.episode_lengths.mean()
    assert summary.success_rate == 4 / summary.n_attempts
    assert str(path) in str(summary)
    assert buffer.terminated.all()
    assert not buffer.truncated.any()
    np.testing.assert_array_equal(buffer.episode_returns, 1.0)
    assert buffer.observation_space.shape == (19,)


def test_recorded_actions_replay_to_the_recorded_observations(recording, lift):
    path, _ = recording
    buffer = load_robomimic(path)
    ends = np.cumsum(buffer.episode_lengths)
    with h5py.File(path) as file:
        for episode in range(2):
            demo = file[f"data/demo_{episode}"]
            options = {"state": demo["states"][0], "model_file": demo.attrs["model_file"]}
            observation, _ = lift.reset(options=options)
            rows = range(ends[episode] - buffer.episode_lengths[episode], ends[episode])
            for row in rows:
                np.testing.assert_array_equal(observation, buffer.observations[row].numpy())
                observation, reward, terminated, _, _ = lift.step(buffer.actions[row].numpy())
                assert reward == buffer.rewards[row]
            assert terminated


def test_noise_has_the_stated_size_and_is_recorded(tmp_path):
    path = tmp_path / "noisy.hdf5"
    summary = record_demonstrations("lift", 2, path, seed=3, n_workers=1, progress=False, noise=0.05)
    assert summary.success_rate == 1.0  # so that the second episode is the second attempt
    buffer = load_robomimic(path)
    rows = slice(buffer.episode_lengths[0], None)
    demonstrator = LiftDemonstrator(int(np.random.SeedSequence((3, 1)).generate_state(2)[1]))
    own = np.stack([demonstrator.act(observation) for observation in buffer.observations[rows].numpy()])
    recorded = buffer.actions[rows].numpy()
    inside = np.abs(recorded) < 1.0
    assert np.std((recorded - own)[inside]) == pytest.approx(0.1, rel=0.15)
    assert np.abs(recorded).max() <= 1.0


def test_noise_and_pause_reach_the_recording_from_the_command_line(tmp_path):
    options = ["--demonstrator", "lift", "--episodes", "1", "--noise", "0.05", "--pause", "15", "--workers", "1"]
    assert main(["record", *options, "--output", str(tmp_path / "first.hdf5")]) == 0
    record_demonstrations("lift", 1, tmp_path / "second.hdf5", n_workers=1, progress=False, noise=0.05, pause=15.0)
    assert_same_file(tmp_path / "first.hdf5", tmp_path / "second.hdf5")
    record_demonstrations("lift", 1, tmp_path / "plain.hdf5", n_workers=1, progress=False)
    with pytest.raises(AssertionError):
        assert_same_file(tmp_path / "first.hdf5", tmp_path / "plain.hdf5")


def test_the_hand_pauses_as_long_as_stated():
    at_the_cube = np.zeros(19)
    at_the_cube[3:7], at_the_cube[7:9] = DOWNWARD, (0.04, -0.04)
    pauses = []
    for seed in range(400):
        demonstrator = LiftDemonstrator(seed, pause=20.0)
        demonstrator.stage = "descend"
        demonstrator.manner = replace(demonstrator.manner, grasp_offset=np.zeros(3))
        demonstrator._misjudged_height = 0.0
        pauses.append(0)
        while demonstrator.act(at_the_cube)[6] < 0:
            pauses[-1] += 1
    # Geometric, from 1 on as the first step only begins the pause: mean 21, standard deviation 20.5
    assert np.mean(pauses) == pytest.approx(21.0, abs=3 * 20.5 / 20)
    assert np.std(pauses) == pytest.approx(20.5, rel=0.2)


def test_existing_recording_is_kept_unless_told_otherwise(recording):
    path, _ = recording
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="exists already; pass overwrite=True"):
        record_demonstrations("lift", 1, path, progress=False)
    assert path.read_bytes() == before


def test_failed_recording_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(RobosuiteEnv, "step", lambda self, action: (np.zeros(19, np.float32), 0.0, False, True, {}))
    with pytest.raises(RuntimeError, match="Only 0 of 15 demonstrations of lift succeeded"):
        record_demonstrations("lift", 1, tmp_path / "lift.hdf5", n_workers=1, progress=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "stack"}, "task must be one of 'lift', 'can', got 'stack'"),
        ({"n_episodes": 0}, "n_episodes must be at least 1"),
        ({"noise": -0.1}, "noise must be a share of the action range, 0 or more, got -0.1"),
        ({"pause": float("nan")}, "pause must be a number of steps, 0 or more, got nan"),
    ],
)
def test_wrong_arguments_are_named(arguments, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        record_demonstrations(**{"task": "lift", "n_episodes": 1, "output": tmp_path / "out.hdf5", **arguments})
