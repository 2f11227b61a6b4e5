"""The packaged hyperparameters: every task's model can be built, and DT and DTFM differ in the head only."""

import copy
import inspect

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
from rl_zoo3.utils import get_wrapper_class

from sb3_dtfm.algorithms import ALGORITHMS
from sb3_dtfm.data import Trajectory, TrajectoryBuffer
from sb3_dtfm.heads import FlowHead
from sb3_dtfm.policies.options import PolicyOptions
from sb3_dtfm.zoo.registration import packaged_config, policy_of, register
from sb3_dtfm.zoo_configs import paper_settings

# The paper's target returns.
TARGETS = {
    "HalfCheetah-v5": 20000,
    "Walker2d-v5": 10000,
    "Ant-v5": 10000,
    "Humanoid-v5": 12000,
    "robosuite/Lift-v0": 1,
    "robosuite/Can-v0": 1,
    "robosuite/Square-v0": 1,
}
NOT_SEARCHED = {"flow_solver", "one_step_policy", "return_scaling", "return_conditioning", "regression_coef"}
NOT_SEARCHED |= {"expected_return_steps", "flow_draws"}  # the data decide these
HEAD_KEYS = set(FlowHead.options_class.defaults())
SETTINGS = [None, "paper"]


def load(algo: str, settings: str | None) -> dict:
    return yaml.safe_load(packaged_config(algo, settings).read_text())


def record_three_steps(env: gym.Env) -> TrajectoryBuffer:
    observations, actions, rewards = [env.reset(seed=0)[0]], [], []
    for _ in range(3):
        actions.append(env.action_space.sample())
        observation, reward, *_ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(reward)
    trajectory = Trajectory(np.array(observations[:-1]), np.array(actions), np.array(rewards))
    return TrajectoryBuffer.from_trajectories([trajectory], env.action_space)


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("env_id", TARGETS)
def test_every_task_builds_its_model(env_id, settings):
    env = gym.make(env_id)
    buffer = record_three_steps(env)
    for algo, algorithm in ALGORITHMS.items():
        hyperparams = load(algo, settings)[env_id]
        wrapped = env  # which the class wraps, with a target return from the data
        if settings == "paper":
            wrapped = get_wrapper_class(hyperparams)(env)
            assert wrapped.get_wrapper_attr("target_return") == TARGETS[env_id]
            del hyperparams["env_wrapper"]
        n_steps = hyperparams.pop("n_timesteps")
        assert n_steps == 150_000 if settings == "paper" else n_steps <= 8000
        assert isinstance(hyperparams.pop("dataset"), str)
        model = algorithm(env=wrapped, dataset=buffer, device="cpu", **hyperparams)
        assert isinstance(model.learning_rate, float)
        assert model.batch_size == (256 if settings == "paper" else 64), "three steps are few"
    env.close()


@pytest.mark.parametrize("settings", SETTINGS)
def test_dt_and_dtfm_differ_in_the_head_only(settings):
    dt, dtfm = load("dt", settings), copy.deepcopy(load("dtfm", settings))
    assert set(dt) == {"default", *TARGETS}
    for hyperparams in dtfm.values():
        for key in HEAD_KEYS & set(hyperparams.get("policy_kwargs", {})):
            del hyperparams["policy_kwargs"][key]
    assert dt == dtfm


def test_the_papers_settings():
    default = load("dtfm", "paper")["default"]
    assert default["policy_kwargs"] == {
        "embed_dim": 256,
        "n_layers": 10,
        "n_heads": 2,
        "dropout": 0.1,
        "tokens_per_step": 3,
        "timestep_embedding": True,
        "chunk_size": 1,
        "return_conditioning": True,
        "return_scaling": "max",
        "clip_return_to_go": False,
        "film_return_to_go": False,
        "expected_return_steps": 0,
        "observation_scaling": "std",
        "flow_hidden_dim": 512,
        "flow_n_layers": 3,
        "flow_prediction": "velocity",
        "flow_tau_exponent": 1.0,
        "flow_draws": 1,
        "regression_coef": 0.0,
        "one_step_policy": True,
        "flow_solver": "euler",
        "flow_steps": 50,
    }
    del default["policy_kwargs"]
    assert default == {
        "policy": "MultiInputPolicy",
        "n_timesteps": 150000,
        "context_length": 20,
        "batch_size": 256,
        "learning_rate": 1e-4,
        "learning_rate_schedule": "constant",
        "warmup_steps": 0,
        "weight_decay": 1e-3,
        "ema_decay": 0.0,
        "return_weighting": 0.0,
        "precision": "auto",
        "env_wrapper": [{"sb3_dtfm.envs.ReturnToGoWrapper": {"bound_return_to_go": False}}],
    }
    for settings in load("dtfm", "paper").values():
        (wrapper,) = settings["env_wrapper"]
        assert wrapper["sb3_dtfm.envs.ReturnToGoWrapper"]["bound_return_to_go"] is False


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_papers_settings_are_arguments_of_the_class(algo):
    env = gym.make("HalfCheetah-v5")
    given, settings = paper_settings(algo), load(algo, "paper")["default"]
    assert set(settings) - set(given) == {"n_timesteps", "env_wrapper"}
    model = ALGORITHMS[algo](env=env, dataset=record_three_steps(env), device="cpu", **given)
    assert (model.context_length, model.policy.options.n_layers) == (20, 10)
    env.close()


def test_the_packaged_settings_name_data_and_steps_only():
    """All else is the class's default, or decided from the data."""
    for entry in load("dtfm", None).values():
        assert set(entry) <= {"policy", "n_timesteps", "dataset"}


@pytest.mark.filterwarnings("error")  # Optuna only warns of a value outside of the range
@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_search_can_find_the_packaged_settings(algo, settings):
    """A trial's `policy_kwargs` replace the YAML's, so what the search leaves out there would be lost."""
    register()
    policy, algorithm = policy_of(algo), ALGORITHMS[algo]
    defaults = {
        name: parameter.default
        for each in (algorithm, policy)
        for name, parameter in inspect.signature(each).parameters.items()
    }
    defaults.update({**PolicyOptions.defaults(), **policy.head_class.options_class.defaults()})
    for hyperparams in load(algo, settings).values():
        policy_kwargs = copy.copy(hyperparams.get("policy_kwargs", {}))
        for key in NOT_SEARCHED & set(policy_kwargs):
            del policy_kwargs[key]
        packaged = {**defaults, "batch_size": 256, **hyperparams, **policy_kwargs}  # which the data decide by default
        powers = {f"{key}_pow": int(np.log2(value)) for key, value in packaged.items() if type(value) is int and value > 0}
        sampled = HYPERPARAMS_SAMPLER[algo](optuna.trial.FixedTrial({**packaged, **powers}), 0, 1, {})
        assert sampled.pop("policy_kwargs").items() >= policy_kwargs.items()
        assert sampled.items() <= packaged.items()
