"""Recording demonstrations: the successes, in the order of attempts, to the bit, in any number of processes."""

import h5py
import numpy as np
import pytest

from sb3_dtfm.cli.main import main
from sb3_dtfm.data.robomimic import load_robomimic
from sb3_dtfm.envs.robosuite import TASKS, RobosuiteEnv
from sb3_dtfm.recording import demonstrations
from sb3_dtfm.recording.demonstrations import RecordingSummary, record_demonstrations


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "lift.hdf5"
    return path, record_demonstrations("lift", 3, path, seed=3, n_workers=1, progress=False)


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


def test_recording_is_the_same_with_any_number_of_workers(recording, tmp_path):
    path, summary = recording
    parallel = tmp_path / "parallel.hdf5"
    other = record_demonstrations("lift", 3, parallel, seed=3, n_workers=2, progress=False)
    assert_same_file(path, parallel)
    assert other[1:4] == summary[1:4]


def test_summary_and_file_agree(recording):
    path, summary = recording
    buffer = load_robomimic(path)
    assert isinstance(summary, RecordingSummary)
    assert summary.n_episodes == buffer.n_episodes == 3
    assert summary.mean_length == buffer.episode_lengths.mean()
    assert summary.success_rate == 3 / summary.n_attempts
    assert str(path) in str(summary)
    assert buffer.terminated.all()
    assert not buffer.truncated.any()
    np.testing.assert_array_equal(buffer.episode_returns, 1.0)
    assert buffer.observation_space.shape == (19,)


def test_recorded_actions_replay_to_the_recorded_observations(recording):
    path, _ = recording
    buffer = load_robomimic(path)
    lift = RobosuiteEnv("Lift")
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
    lift.close()


def test_noise_has_the_stated_size_and_is_recorded(tmp_path):
    path = tmp_path / "noisy.hdf5"
    summary = record_demonstrations("lift", 2, path, seed=3, n_workers=1, progress=False, noise=0.05)
    assert summary.success_rate == 1.0  # so that the second episode is the second attempt
    buffer = load_robomimic(path)
    rows = slice(buffer.episode_lengths[0], None)
    demonstrator = TASKS["Lift"].demonstrator(int(np.random.SeedSequence((3, 1)).generate_state(2)[1]), 0.0)
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


def test_existing_recording_is_kept_unless_told_otherwise(recording):
    path, _ = recording
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="exists already; pass overwrite=True"):
        record_demonstrations("lift", 1, path, progress=False)
    assert path.read_bytes() == before


@pytest.fixture
def hurried(monkeypatch):
    """Gives demonstrators fewer steps than many an episode takes."""

    def limit(horizon):
        env = RobosuiteEnv("Lift", horizon=horizon)
        monkeypatch.setattr(demonstrations, "_environment", lambda *scene: env)

    return limit


@pytest.mark.parametrize("n_workers", [1, 2])
def test_failed_episodes_are_left_out_and_none_is_simulated_in_vain(n_workers, hurried, tmp_path, monkeypatch):
    hurried(55)
    environment = demonstrations._environment

    def counted(*scene):
        with (tmp_path / "simulated").open("a") as file:
            file.write(".")
        return environment(*scene)

    monkeypatch.setattr(demonstrations, "_environment", counted)
    summary = record_demonstrations("lift", 3, tmp_path / "lift.hdf5", n_workers=n_workers, progress=False)
    buffer = load_robomimic(tmp_path / "lift.hdf5")
    assert summary.n_attempts > 3
    assert len((tmp_path / "simulated").read_text()) == 1 + summary.n_attempts, "each episode, and the file's own arguments"
    assert buffer.n_episodes == 3
    assert buffer.terminated.all()


def test_failed_recording_leaves_nothing(hurried, tmp_path):
    hurried(5)
    with pytest.raises(ValueError, match="Only 0 of 15 demonstrations of lift succeeded"):
        record_demonstrations("lift", 1, tmp_path / "lift.hdf5", n_workers=1, progress=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "door"}, "task must be one of 'lift', .*'can', got 'door'"),
        ({"n_episodes": 0}, "n_episodes must be at least 1"),
        ({"seed": -1}, "seed must be 0 or more, got -1"),
        ({"n_workers": -3}, "n_workers must be at least 1, got -3"),
        ({"noise": -0.1}, "noise must be a share of the action range, 0 or more, got -0.1"),
        ({"pause": float("nan")}, "pause must be a number of steps, 0 or more, got nan"),
    ],
)
def test_wrong_arguments_are_named(arguments, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        record_demonstrations(**{"task": "lift", "n_episodes": 1, "output": tmp_path / "out.hdf5", **arguments})
