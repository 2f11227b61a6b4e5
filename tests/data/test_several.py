"""The better episodes of a dataset, and several datasets as one."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_dtfm import DT
from sb3_dtfm.data import DatasetError, load_dataset

LENGTHS = [2, 3, 4]


def arrays(first, n_observations=3):
    """Three episodes; observations tell episode and step, rewards add up to `first`, `first` + 1 and `first` + 2."""
    episodes = np.repeat(np.arange(3), LENGTHS)
    rewards = np.zeros(9)
    rewards[np.cumsum(LENGTHS) - 1] = first + np.arange(3)
    observations = np.tile((first + episodes)[:, None], n_observations)
    return {"obs": observations, "acts": np.zeros((9, 2)), "rews": rewards, "episode_lengths": LENGTHS}


@pytest.mark.parametrize(
    ("options", "returns"),
    [
        ({"min_return": 1.0}, [1, 2]),
        ({"best_share": 0.3}, [2]),
        ({"best_share": 1.0, "min_return": -5}, [0, 1, 2]),
        ({"min_return": 1.0, "best_share": 0.01}, [2]),
    ],
)
def test_the_better_episodes(options, returns):
    buffer = load_dataset(arrays(0.0), **options)
    assert buffer.episode_returns.tolist() == returns
    ends = th.arange(len(buffer))
    np.testing.assert_array_equal(buffer.windows(ends, 1).observations[:, 0, 0], np.repeat(returns, np.add(returns, 2)))


def test_what_leaves_nothing_is_refused():
    with pytest.raises(DatasetError, match="arrays: no episode has min_return 7; the largest return is 2"):
        load_dataset(arrays(0.0), min_return=7)
    with pytest.raises(ValueError, match=r"best_share must be a number in \(0, 1\], or None, got 0"):
        load_dataset(arrays(0.0), best_share=0)


def test_keys_and_clipping_count_for_all_of_several(tmp_path):
    path = tmp_path / "some.npz"
    given = {**arrays(0.0), "acts": np.full((9, 2), 9.0), "speed": np.arange(9.0)}
    np.savez(path, **given)
    buffer = load_dataset([path, given], observation_keys=["speed"], clip_actions=True)
    assert buffer.observations.shape == (18, 1)
    assert buffer.actions.max() == 1.0
    own = load_dataset(
        [path, {"dataset": given, "observation_keys": ["rews"]}], observation_keys=["speed"], clip_actions=True
    )
    assert own.observations[9:].flatten().tolist() == given["rews"].tolist()


def test_several_are_one_and_each_is_drawn_by_its_weight(tmp_path):
    path = tmp_path / "some.npz"
    np.savez(path, **arrays(0.0))
    other = load_dataset(arrays(10.0)).select(np.array([2, 1]))
    buffer = load_dataset([{"dataset": str(path), "weight": 3.0, "min_return": 1.0}, other])
    assert buffer.episode_returns.tolist() == [1, 2, 12, 11]
    assert buffer.episode_lengths.tolist() == [3, 4, 4, 3]
    assert buffer.weights.tolist() == [3, 3, 1, 1]
    assert buffer.source == f"{path} + arrays"
    ends = th.arange(len(buffer))
    np.testing.assert_array_equal(buffer.windows(ends, 2).observations[:, 1, 0], np.repeat([1, 2, 12, 11], [3, 4, 4, 3]))
    expected = {1: 9, 2: 12, 12: 4, 11: 3}  # steps times weight
    drawn = next(buffer.batches(28_000, 1, th.Generator().manual_seed(0))).observations[:, 0, 0].numpy()
    for value, share in expected.items():
        assert np.mean(drawn == value) == pytest.approx(share / 28, rel=0.05)
    statistics = load_dataset([path, other]).statistics()
    joined = np.concatenate([np.repeat([0, 1, 2], LENGTHS), np.repeat([12, 11], [4, 3])])
    assert statistics.observation_mean[0] == pytest.approx(joined.mean())
    assert statistics.observation_std[0] == pytest.approx(joined.std())
    part = buffer.select(np.array([3, 0]))
    assert part.weights.tolist() == [1, 3]
    assert DT("MultiInputPolicy", dataset=[path, path], device="cpu").buffer.n_episodes == 6


def test_only_data_of_one_task_are_joined():
    with pytest.raises(DatasetError, match=r"arrays \+ arrays: other observations .* arrays holds \(3,\).* holds \(4,\)"):
        load_dataset([{"dataset": arrays(0.0)}, {"dataset": arrays(0.0, 4)}])
    with pytest.raises(DatasetError, match=r"recorded in Hopper-v5, and the environment is Ant-v5"):
        load_dataset([{"dataset": arrays(0.0), "env_id": task} for task in ("Hopper-v5", "Ant-v5")])
    same = load_dataset([{"dataset": arrays(0.0), "env_id": "Ant-v5"}, {"dataset": arrays(0.0)}])
    assert same.env_id == "Ant-v5"
    recorded = [load_dataset(arrays(0.0), env_id=task) for task in ("Hopper-v5", "Ant-v5")]
    assert load_dataset(recorded, env_id="Ant-v5").env_id == "Ant-v5", "as the refusal recommends"
    assert load_dataset([{"dataset": arrays(0.0), "weight": np.int64(2)}]).weights.tolist() == [2.0] * 3
    for weight in (0, -1.0, "much", np.inf):
        with pytest.raises(DatasetError, match=r"weight is .*; a positive number is accepted"):
            load_dataset([{"dataset": load_dataset(arrays(0.0)), "weight": weight}])
    with pytest.raises(TypeError, match=r"unknown option best_shade \(did you mean best_share\?\); accepted"):
        load_dataset([{"dataset": arrays(0.0), "best_shade": 1}])


def test_precision_is_no_other_range_of_actions(tmp_path):
    double = load_dataset(arrays(0.0), action_space=spaces.Box(-1.0, 1.0, (2,), np.float64))
    double.save(tmp_path / "single.npz")
    assert load_dataset([double, tmp_path / "single.npz"]).n_episodes == 6


def test_the_best_of_each_are_chosen_by_what_lies_within_the_time_limit():
    """The last episode of each dataset returns most, but only behind its third step."""
    with pytest.warns(UserWarning, match="1 of 3 episodes have more than 3 steps"):
        buffer = load_dataset([{"dataset": arrays(5.0), "min_return": 1.0}, {"dataset": arrays(0.0)}], max_episode_steps=3)
    assert buffer.episode_lengths.tolist() == [2, 3, 2, 3, 3]
    assert buffer.episode_returns.tolist() == [5, 6, 0, 1, 0]


def test_what_each_has_left_out_is_counted_together():
    bad = {"obs": np.full((2, 3), np.nan), "acts": np.zeros((2, 2)), "rews": np.zeros(2)}
    good = {"obs": np.zeros((2, 3)), "acts": np.zeros((2, 2)), "rews": np.zeros(2)}
    with pytest.warns(UserWarning, match="dropped"):
        buffer = load_dataset([{"dataset": each, "on_invalid": "drop"} for each in ([good, bad], [bad, good, bad])])
    assert (buffer.n_episodes, buffer.n_dropped) == (2, 3)
