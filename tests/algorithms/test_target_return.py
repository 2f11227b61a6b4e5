"""A model's target return, which its environments take, however they come."""

import json
import zipfile

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_dtfm import DT, DTFM
from sb3_dtfm.data.inspection import inspect_buffer
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.files import ModelFileError
from sb3_dtfm.finetuning import NoiseActionVecEnv
from tests.algorithms.small import make_model
from tests.conftest import EPISODE_LENGTH, make_env

CHEETAH = "HalfCheetah-v5"


def make_bare_env() -> gym.Env:
    return gym.make(CHEETAH, max_episode_steps=EPISODE_LENGTH)


def make_env_without_target() -> ReturnToGoWrapper:
    return ReturnToGoWrapper(make_bare_env())


def targets(env) -> list[float | None]:
    return env.get_attr("target_return")


@pytest.mark.parametrize("env", [CHEETAH, make_bare_env, lambda: Monitor(make_bare_env()), make_env_without_target])
def test_any_environment_takes_the_target_that_inspect_suggests(env, cheetah_buffer, capsys):
    suggested = inspect_buffer(cheetah_buffer).target_return
    model = make_model(DTFM, cheetah_buffer, env=env if isinstance(env, str) else env(), verbose=1)
    assert (model.target_return, targets(model.get_env())) == (suggested, [suggested])
    said = capsys.readouterr().out
    assert f"has target_return={suggested:g}, as `sb3-dtfm inspect` suggests of the recorded returns." in said
    assert ("Wrapping the env in a ReturnToGoWrapper." in said) is (env is not make_env_without_target)
    assert model.get_env().reset()["return_to_go"] == np.float32(suggested)


def test_the_best_tenth_are_the_episodes_that_are_learned_from(cheetah_buffer):
    half = make_model(DT, cheetah_buffer, dataset_kwargs=dict(fraction=0.5))
    assert half.target_return == float(f"{half.buffer.episode_returns.max():.4g}")


def test_a_target_of_the_environment_comes_before_the_datas(cheetah_buffer, capsys):
    model = make_model(DT, cheetah_buffer, env=make_env(), verbose=1)
    assert (model.target_return, targets(model.get_env())) == (5.0, [5.0])
    assert "ReturnToGoWrapper" not in capsys.readouterr().out
    several = DummyVecEnv([make_env_without_target, make_env, make_env_without_target])
    assert make_model(DT, cheetah_buffer, env=several).target_return == 5.0
    assert targets(several) == [5.0, 5.0, 5.0]


def test_environments_in_their_own_processes_get_the_target_too(cheetah_buffer):
    env = SubprocVecEnv([make_env_without_target] * 2, start_method="fork")  # another method imports all anew
    model = make_model(DT, cheetah_buffer, env=env)
    assert targets(env) == [model.target_return] * 2
    env.close()


def test_vectorised_environments_without_the_wrapper_are_refused_with_the_line_to_write(cheetah_buffer):
    with pytest.raises(ValueError, match=r"write make_vec_env\(env_id, n_envs, wrapper_class=ReturnToGoWrapper\)"):
        make_model(DT, cheetah_buffer, env=DummyVecEnv([make_bare_env]))
    make_model(DT, cheetah_buffer, env=make_vec_env(CHEETAH, 2, wrapper_class=ReturnToGoWrapper))


@pytest.mark.parametrize("algorithm", [DT, DTFM])
def test_the_target_is_saved_and_given_to_new_environments(algorithm, cheetah_buffer, tmp_path):
    make_model(algorithm, cheetah_buffer).save(tmp_path / "model")
    suggested = inspect_buffer(cheetah_buffer).target_return
    assert algorithm.load(tmp_path / "model").target_return == suggested
    loaded = algorithm.load(tmp_path / "model", env=make_bare_env())
    assert targets(loaded.get_env()) == [suggested]
    loaded.set_env(make_env_without_target())
    assert targets(loaded.get_env()) == [suggested]
    loaded.set_env(make_env())
    assert (targets(loaded.get_env()), loaded.target_return) == ([5.0], suggested)
    mean, _ = evaluate_policy(loaded, make_vec_env(CHEETAH, 1, wrapper_class=lambda env: ReturnToGoWrapper(env, 5.0)), 1)
    assert np.isfinite(mean)


def test_a_file_without_a_target_loads_and_takes_that_of_its_environment(cheetah_buffer, tmp_path):
    make_model(DT, cheetah_buffer).save(tmp_path / "model", exclude=["target_return"])
    loaded = DT.load(tmp_path / "model")
    assert loaded.target_return is None
    loaded.set_env(make_env_without_target())
    loaded.set_dataset(cheetah_buffer)
    assert targets(loaded.get_env()) == [inspect_buffer(cheetah_buffer).target_return]
    assert DT.load(tmp_path / "model", env=make_env()).target_return == 5.0


@pytest.mark.parametrize("target", ["much", True, [1.0]])
def test_a_target_in_a_file_is_a_finite_number(target, cheetah_buffer, tmp_path):
    path = tmp_path / "model.zip"
    make_model(DT, cheetah_buffer).save(path)
    with zipfile.ZipFile(path) as file:
        members = {name: file.read(name) for name in file.namelist()}
    configuration = json.loads(members["model.json"])
    configuration["attributes"]["target_return"] = target
    with zipfile.ZipFile(path, "w") as file:
        for name, content in {**members, "model.json": json.dumps(configuration)}.items():
            file.writestr(name, content)
    with pytest.raises(ModelFileError, match="target_return must be a finite number, or None, got"):
        DT.load(path)


def test_a_changed_target_is_a_finite_number(cheetah_buffer, tmp_path):
    make_model(DT, cheetah_buffer).save(tmp_path / "model")
    assert DT.load(tmp_path / "model", target_return=7).target_return == 7
    with pytest.raises(ValueError, match="target_return must be a finite number"):
        DT.load(tmp_path / "model", target_return=float("nan"))


def test_an_exported_model_knows_the_target(cheetah_buffer, tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr("sb3_dtfm.algorithms.model.write_onnx", lambda *arguments: written.append(arguments[-1]))
    model = make_model(DT, cheetah_buffer)
    model.export(tmp_path / "policy.onnx")
    assert written[0]["target_return"] == model.target_return


def test_a_wrapper_without_a_target_says_what_to_write():
    with pytest.raises(ValueError, match=r"write ReturnToGoWrapper\(env, target_return=model\.target_return\)"):
        make_env_without_target().reset()


@pytest.mark.parametrize(
    "nest", [lambda each: each, lambda each: CallbackList([each]), lambda each: EveryNTimesteps(1, each)]
)
@pytest.mark.parametrize("env", [None, make_env])
def test_evaluations_ask_for_the_models_target(nest, env, cheetah_buffer):
    evaluation = EvalCallback(Monitor(make_env_without_target()), eval_freq=1, n_eval_episodes=1, verbose=0)
    model = make_model(DT, cheetah_buffer, env=env and env()).learn(1, callback=nest(evaluation))
    assert targets(evaluation.eval_env) == [model.target_return]
    assert np.isfinite(evaluation.last_mean_reward)


@pytest.mark.parametrize("env", [None, make_env])
def test_an_evaluation_without_the_wrapper_is_refused_before_the_first_step(env, cheetah_buffer):
    model = make_model(DT, cheetah_buffer, env=env and env())
    evaluation = EvalCallback(Monitor(make_bare_env()), eval_freq=1000, verbose=0)
    message = r"evaluation environment of EvalCallback .* write EvalCallback\(ReturnToGoWrapper\(eval_env\), \.\.\.\)"
    with pytest.raises(ValueError, match=message):
        model.learn(1, callback=[evaluation])
    assert model.num_timesteps == 0


def test_evaluate_policy_without_the_wrapper_says_what_to_write(cheetah_buffer):
    model = make_model(DT, cheetah_buffer, env=make_bare_env())
    with pytest.raises(
        ValueError, match=r"write ReturnToGoWrapper\(env, target_return=model\.target_return\), or take model"
    ):
        evaluate_policy(model, Monitor(make_bare_env()), 1)
    assert np.isfinite(evaluate_policy(model, model.get_env(), 1)[0])


def test_an_online_algorithms_environment_takes_the_frozen_models_target(cheetah_buffer):
    model = make_model(DTFM, cheetah_buffer)
    env = NoiseActionVecEnv(DummyVecEnv([make_env_without_target]), model)
    env.reset()
    assert targets(env) == [model.target_return]
