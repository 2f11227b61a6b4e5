"""Behaviour cloning as a run of the grid: what it learns, from which episodes, and the rows that it leaves."""

import numpy as np
import pytest
import torch as th
import yaml
from gymnasium import spaces
from stable_baselines3.common.callbacks import CallbackList

from sb3_dtfm.benchmark import cloning
from sb3_dtfm.benchmark.evaluation import EvaluationCallback
from sb3_dtfm.benchmark.rows import BASELINES, RunKey, read_rows
from sb3_dtfm.benchmark.runner import CALLBACK
from sb3_dtfm.benchmark.settings import Task, cloning_settings, task_settings
from sb3_dtfm.data import load_dataset

N_EPISODES, N_STEPS = 10, 12


def write_pendulum(path) -> None:
    """Ten episodes, of which the best one pushes to the right, the others to the left."""
    rng = np.random.default_rng(0)
    pushes = np.where(np.arange(N_EPISODES) == 7, 1.5, -1.5)
    arrays = dict(
        observations=rng.normal(size=(N_EPISODES * N_STEPS, 3)),
        actions=np.repeat(pushes, N_STEPS)[:, None],
        rewards=np.repeat(np.where(pushes > 0, -1.0, -9.0), N_STEPS),
        episode_lengths=np.full(N_EPISODES, N_STEPS),
    )
    np.savez(path, **arrays)


def clone(buffer, n_steps: int) -> cloning.Cloning:
    model = cloning.Cloning(buffer, hidden_sizes=[32, 32], learning_rate=3e-3, seed=0)
    model.learn(n_steps, 32, CallbackList([]))
    return model


def test_it_learns_what_was_done_in_the_units_of_the_environment():
    observations = np.random.default_rng(0).uniform(-1, 1, size=(400, 2))
    actions = 3.0 + 2.0 * observations[:, :1] * np.sign(observations[:, 1:])
    space = spaces.Box(0.0, 6.0, (1,), np.float32)
    arrays = dict(observations=observations, actions=actions, rewards=np.ones(400), episode_lengths=np.full(4, 100))
    model = clone(load_dataset(arrays, action_space=space), 500)
    predicted, state = model.predict({"observation": observations.astype(np.float32)})
    assert (predicted.dtype, predicted.shape, state) == (np.float32, (400, 1), None)
    assert np.abs(predicted - actions).mean() < 0.2


def test_it_chooses_discrete_actions_as_they_were_chosen():
    observations = np.random.default_rng(0).uniform(-1, 1, size=(300, 2))
    actions = 5 + (observations[:, 0] > 0) + (observations[:, 1] > 0)
    arrays = dict(observations=observations, actions=actions, rewards=np.ones(300), episode_lengths=np.full(3, 100))
    model = clone(load_dataset(arrays, action_space=spaces.Discrete(3, start=5)), 300)
    predicted, _ = model.predict({"observation": observations.astype(np.float32)})
    assert (predicted == actions).mean() > 0.95


@pytest.mark.parametrize(("algo", "push"), [("bc", -1.5), ("bc-best", 1.5)])
def test_a_run_learns_from_all_episodes_or_the_best_tenth_and_leaves_the_rows_of_any_run(
    algo, push, tmp_path, monkeypatch, capsys
):
    models = []

    class Remembered(EvaluationCallback):
        def _on_training_end(self) -> None:
            models.append(self.model)
            super()._on_training_end()

    monkeypatch.setattr(cloning, "EvaluationCallback", Remembered)
    write_pendulum(tmp_path / "data.npz")
    task = Task("pushed", str(tmp_path / "data.npz"), -5.0, task="Pendulum-v1", env_kwargs={"max_episode_steps": 8})
    settings = cloning_settings(algo, task_settings("default", "dt", task, 1.0, None, {}), 200)
    assert (settings["n_timesteps"], settings["best_share"]) == (200, BASELINES[algo])
    row = {**RunKey("pushed", 1.0, algo, 3, "default")._asdict(), "env_id": "Pendulum-v1", "settings": settings, "data": {}}
    arguments = dict(rows=str(tmp_path / "rows.jsonl"), row=row, eval_freq=100, n_episodes=2, n_final_episodes=3)
    (tmp_path / "settings.yml").write_text(
        yaml.safe_dump({"Pendulum-v1": {**settings, "callback": [{CALLBACK: arguments}]}})
    )
    with pytest.warns(UserWarning, match="10 of 10 episodes have more than 8 steps"):
        cloning.main([str(tmp_path / "settings.yml")])
    (model,) = models
    assert np.median(model.predict({"observation": th.randn(50, 3).numpy()})[0]) == pytest.approx(push, abs=0.2)
    rows = read_rows(tmp_path / "rows.jsonl")
    assert [(each["step"], each["final"]) for each in rows] == [(0, False), (100, False), (200, False), (200, True)]
    assert {each: rows[0][each] for each in row} == row
    assert rows[-1]["lengths"] == [8, 8, 8]
    assert (rows[-1]["flow_solver"], rows[-1]["action_ms"] > 0) == (None, True)
    assert rows[-1]["data"]["random_return"] < 0
    assert capsys.readouterr().out.startswith("step 0 of 200: evaluation 0/2\n")
