"""Stable-Baselines3's callbacks, loggers and wrappers, as docs/compatibility.md lists them; what other tests do not show."""

import csv
import json

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.figure import Figure as MatplotlibFigure
from rl_zoo3.callbacks import RawStatisticsCallback
from rl_zoo3.wrappers import ActionNoiseWrapper, ActionSmoothingWrapper, DelayedRewardWrapper, FrameSkip
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    LogEveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Figure, HParam, Image, configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecExtractDictObs,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_dtfm import DT, DTFM
from sb3_dtfm.envs import ReturnToGoWrapper
from tests.algorithms.small import TINY, make_model, record_curves
from tests.conftest import EPISODE_LENGTH, make_env


class HParams(BaseCallback):
    """Hyperparameters and what they come to, as SB3's documentation writes them down for TensorBoard."""

    def _on_training_start(self) -> None:
        names = ("learning_rate", "batch_size", "context_length")
        hyperparams = {"algorithm": type(self.model).__name__, **{name: getattr(self.model, name) for name in names}}
        metrics = {"eval/mean_reward": 0.0, "train/loss": 0.0}
        self.logger.record("hparams", HParam(hyperparams, metrics), exclude=("stdout", "log", "json", "csv"))

    def _on_step(self) -> bool:
        return True


class Media(BaseCallback):
    """Pictures of several kinds."""

    def _on_step(self) -> bool:
        figure = MatplotlibFigure()
        figure.subplots().plot([self.num_timesteps])
        excluded = ("stdout", "log", "json", "csv")
        self.logger.record("media/figure", Figure(figure, close=False), exclude=excluded)
        self.logger.record("media/image", Image(np.zeros((8, 8, 3), np.uint8), "HWC"), exclude=excluded)
        return True


def test_hparams_of_a_callback_stand_in_tensorboard_beside_their_metrics(cheetah_buffer, tmp_path):
    evaluation = EvalCallback(Monitor(make_env()), eval_freq=2, n_eval_episodes=1, verbose=0)
    model = make_model(DTFM, cheetah_buffer, tensorboard_log=str(tmp_path))
    model.learn(4, callback=[HParams(), evaluation], log_interval=2)
    events = EventAccumulator(str(tmp_path / "DTFM_1")).Reload()
    plugin = events.PluginTagToContent("hparams")
    start = plugin["_hparams_/session_start_info"]
    for known in (b"batch_size", b"DTFM", b"context_length"):
        assert known in start
    assert b"eval/mean_reward" in plugin["_hparams_/experiment"]
    assert {"eval/mean_reward", "train/loss"} <= set(events.Tags()["scalars"])


def test_pictures_of_a_callback_stand_in_tensorboard(cheetah_buffer, tmp_path):
    make_model(DT, cheetah_buffer, tensorboard_log=str(tmp_path)).learn(3, callback=Media(), log_interval=1)
    assert set(EventAccumulator(str(tmp_path / "DT_1")).Reload().Tags()["images"]) == {"media/figure", "media/image"}


def test_every_output_of_the_logger_has_the_curves(cheetah_buffer, tmp_path, capsys):
    model = make_model(DT, cheetah_buffer)
    model.set_logger(configure(str(tmp_path), ["stdout", "log", "csv", "json", "tensorboard"]))
    model.learn(4, log_interval=2)
    model.logger.close()
    with (tmp_path / "progress.csv").open() as file:
        losses = [float(row["train/loss"]) for row in csv.DictReader(file)]
    assert len(losses) == 2
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert [row["train/loss"] for row in rows] == pytest.approx(losses)
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [event.value for event in events.Scalars("train/loss")] == pytest.approx(losses)
    for text in (capsys.readouterr().out, next(tmp_path.glob("log.txt")).read_text()):
        assert text.count("total_timesteps") == 2


def test_logs_come_as_often_as_a_callback_asks(cheetah_buffer):
    model = make_model(DT, cheetah_buffer)
    curves = record_curves(model)
    model.learn(7, callback=LogEveryNTimesteps(3), log_interval=None)
    assert [step for step, _ in curves.points["train/loss"]] == [3, 6]


def test_training_ends_where_no_evaluation_is_better(cheetah_buffer):
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1, min_evals=1)
    evaluation = EvalCallback(Monitor(make_env(seed=0)), callback_after_eval=stop, eval_freq=2, n_eval_episodes=1, verbose=0)
    evaluation.best_mean_reward = np.inf  # nothing can be better
    assert make_model(DT, cheetah_buffer).learn(40, callback=evaluation).num_timesteps == 6


def test_callbacks_in_a_list_or_as_a_function(cheetah_buffer, tmp_path):
    steps: list[int] = []
    both = CallbackList([CheckpointCallback(2, str(tmp_path), save_replay_buffer=True), HParams()])
    make_model(DT, cheetah_buffer).learn(3, callback=both)
    assert [path.name for path in tmp_path.iterdir()] == ["rl_model_2_steps.zip"], "there is no replay buffer to save"
    make_model(DT, cheetah_buffer).learn(3, callback=lambda local, _: steps.append(local["self"].num_timesteps) is None)
    assert steps == [1, 2, 3]


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_mlp_policy_is_another_name_of_the_policy(algorithm, cheetah_buffer, tmp_path):
    settings = dict(dataset=cheetah_buffer, seed=0, device="cpu", policy_kwargs=TINY[algorithm])
    models = [algorithm(name, make_env(), **settings) for name in ("MlpPolicy", "MultiInputPolicy")]
    assert type(models[0].policy) is type(models[1].policy)
    models[0].save(tmp_path / "model")
    assert type(algorithm.load(tmp_path / "model").policy) is type(models[1].policy)


def test_a_policy_of_another_name_is_refused_with_the_names_there_are(cheetah_buffer):
    message = r"policy must be 'MultiInputPolicy' \(or 'MlpPolicy', 'CnnPolicy'\), got 'RnnPolicy'"
    with pytest.raises(ValueError, match=message):
        DT("RnnPolicy", make_env(), cheetah_buffer)


def test_a_progress_bar_counts_gradient_steps(cheetah_buffer, capsys):
    model = make_model(DT, cheetah_buffer, env=make_env())
    bar = ProgressBarCallback()
    model.learn(3, callback=bar)
    assert bar.pbar.n == 3
    model.learn(3, progress_bar=True)


@pytest.mark.parametrize(
    ("callback", "missing"), [(StopTrainingOnMaxEpisodes(1), "dones"), (RawStatisticsCallback(), "infos")]
)
def test_what_asks_for_training_episodes_says_that_there_are_none(callback, missing, cheetah_buffer, tmp_path):
    model = make_model(DT, cheetah_buffer, env=make_env(), tensorboard_log=str(tmp_path))
    with pytest.raises((AssertionError, KeyError), match=missing):
        model.learn(3, callback=callback)


def test_vectorised_wrappers_that_leave_observations_alone(cheetah_buffer):
    env = VecCheckNan(VecMonitor(VecTransposeImage(DummyVecEnv([make_env] * 2))), raise_exception=True)
    env = VecNormalize(env, norm_obs=False)
    model = make_model(DTFM, cheetah_buffer, env=env).learn(2)
    rewards, lengths = evaluate_policy(model, env, 2, return_episode_rewards=True)
    assert np.isfinite(rewards).all()
    assert lengths == [EPISODE_LENGTH] * 2


def test_a_wrapper_that_takes_the_return_to_go_away_is_refused(cheetah_buffer):
    env = VecExtractDictObs(DummyVecEnv([make_env]), "observation")
    with pytest.raises(ValueError, match=r"must be wrapped in sb3_dtfm\.envs\.ReturnToGoWrapper"):
        make_model(DT, cheetah_buffer, env=env)


def test_rl_zoos_wrappers_stand_within_ours(cheetah_buffer):
    env: gym.Env = gym.make("HalfCheetah-v5", max_episode_steps=EPISODE_LENGTH)
    env = FrameSkip(DelayedRewardWrapper(ActionSmoothingWrapper(ActionNoiseWrapper(env)), delay=3), skip=2)
    model = make_model(DT, cheetah_buffer)
    _, lengths = evaluate_policy(model, Monitor(ReturnToGoWrapper(env, 5.0)), 1, return_episode_rewards=True)
    assert lengths == [EPISODE_LENGTH // 2]
