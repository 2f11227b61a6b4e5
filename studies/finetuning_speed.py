"""
Steps a second that environments make alone, and behind what `sb3-dtfm finetune` puts around them; and where the time goes.

    OMP_NUM_THREADS=1 python studies/finetuning_speed.py --env robosuite/Lift-v0 --n-envs 1 2 --vec-env subproc -o rows.jsonl

`rollouts` are those of a DTFM that learns from them, `wrapped` chooses at random what an algorithm would, `learning` is
the algorithm itself with its packaged settings. One thread for each process. The model has the packaged sizes and no
training: what it computes is the same.
"""

import argparse
import functools
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
import yaml
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.provenance import commit, hardware, versions
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.finetuning import NoiseActionVecEnv, ResidualActionVecEnv
from sb3_dtfm.finetuning.frozen_env import FrozenPolicyVecEnv
from sb3_dtfm.zoo.finetuning import keep_one_action
from sb3_dtfm.zoo.registration import finetuning_config, packaged_config

# Beside those of the Transformer and the head, what the settings of a task say about a model.
OF_THE_MODEL = ("context_length", "ema_decay", "policy_kwargs")
VEC_ENVS: dict[str, type[VecEnv]] = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}
WAYS = {"sac": (SAC, NoiseActionVecEnv), "ppo": (PPO, ResidualActionVecEnv)}


def settings_of(path: Path, env_id: str) -> dict[str, Any]:
    """Return the settings of a task, in a packaged file."""
    settings = yaml.safe_load(path.read_text())
    return settings.get(env_id, settings["default"])


def make_model(env_id: str) -> DTFM:
    """A model of the packaged size, of two random episodes."""
    env = gym.make(env_id)
    rng = np.random.default_rng(0)
    space = env.observation_space
    sizes = (20, gym.spaces.flatdim(space))
    actions = rng.uniform(env.action_space.low, env.action_space.high, (20, *env.action_space.shape))
    episodes = [dict(observations=rng.normal(size=sizes), actions=actions, rewards=np.ones(20)) for _ in range(2)]
    env.close()
    settings = settings_of(packaged_config("dtfm"), env_id)
    settings = {name: value for name, value in settings.items() if name in OF_THE_MODEL}
    chunk_size = 8 if env_id.startswith("robosuite/") else 1  # as their recordings decide
    policy_kwargs = {"chunk_size": chunk_size, **settings.pop("policy_kwargs", {})}
    return DTFM("MultiInputPolicy", dataset=episodes, seed=0, device="cpu", policy_kwargs=policy_kwargs, **settings)


def make_envs(env_id: str, n_envs: int, vec_env: str) -> VecEnv:
    """Make environments as `sb3-dtfm finetune` does."""
    wrapper = functools.partial(ReturnToGoWrapper, target_return=1.0)
    return make_vec_env(env_id, n_envs, seed=0, wrapper_class=wrapper, vec_env_cls=VEC_ENVS[vec_env])


def steps_per_second(step: Callable[[], int], seconds: float) -> float:
    """
    :param step: makes one step of all environments, and tells how many environment steps these were
    :param seconds: to measure for, after a tenth of it
    """
    for length in (seconds / 10, seconds):
        start, n_steps = time.perf_counter(), 0
        while time.perf_counter() - start < length:
            n_steps += step()
    return n_steps / (time.perf_counter() - start)


class Timed:
    """
    Adds up the seconds that some methods take.

    :param methods: owner and name by what they are called in the result
    """

    def __init__(self, methods: dict[str, tuple[Any, str]]) -> None:
        self.seconds = dict.fromkeys(methods, 0.0)
        for part, (owner, name) in methods.items():
            setattr(owner, name, self._timing(part, getattr(owner, name)))

    def _timing(self, part: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return method(*args, **kwargs)
            finally:
                self.seconds[part] += time.perf_counter() - start

        return timed

    def shares(self, wall: float) -> dict[str, Any]:
        """:param wall: seconds of all"""
        return {"shares": {part: round(each / wall, 3) for part, each in self.seconds.items()}}


def measure(env_id: str, n_envs: int, vec_env: str, algo: str, seconds: float) -> Iterator[dict[str, Any]]:
    """Rows: environments alone, rollouts of a DTFM, what an algorithm learns in, and itself."""
    about = {"task": env_id, "n_envs": n_envs, "vec_env": vec_env}
    envs = make_envs(env_id, n_envs, vec_env)
    envs.reset()
    rng = np.random.default_rng(0)
    low, high = envs.action_space.low, envs.action_space.high

    def step_bare() -> int:
        envs.step(rng.uniform(low, high, (n_envs, len(low))).astype(np.float32))
        return n_envs

    yield {**about, "what": "bare", "steps_per_s": round(steps_per_second(step_bare, seconds), 1)}
    model = make_model(env_id)
    timed = Timed({"environment": (envs, "step_wait"), "model": (model, "predict")})
    acting = Acting(model, envs)
    start = time.perf_counter()
    found = steps_per_second(acting.step, seconds)
    yield {**about, "what": "rollouts", "steps_per_s": round(found, 1), **timed.shares(time.perf_counter() - start)}
    envs.close()
    yield from ({**about, "algo": algo, **row} for row in measure_algorithm(algo, env_id, n_envs, vec_env, seconds))


class Acting:
    """A model that makes rollouts, as it does to learn from them."""

    def __init__(self, model: DTFM, envs: VecEnv) -> None:
        self.model, self.envs = model, envs
        self.observations, self.state, self.starts = envs.reset(), None, np.ones(envs.num_envs, bool)

    def step(self) -> int:
        """:return: environment steps"""
        actions, self.state = self.model.predict(self.observations, self.state, self.starts)
        self.observations, _, self.starts, _ = self.envs.step(actions)
        return self.envs.num_envs


def measure_algorithm(algo: str, env_id: str, n_envs: int, vec_env: str, seconds: float) -> Iterator[dict[str, Any]]:
    """Rows of one algorithm."""
    algorithm_class, wrapper_class = WAYS[algo]
    settings = settings_of(finetuning_config(algo), env_id)
    ((path, arguments),) = settings["vec_env_wrapper"][0].items()
    if not path.endswith(wrapper_class.__name__):
        raise SystemExit(f"--algo {algo} --env {env_id}: packaged settings name {path}, not {wrapper_class.__name__}.")
    for what in ("wrapped", "learning"):
        model = make_model(env_id)
        keep_one_action(model.policy, wrapper_class is ResidualActionVecEnv)
        envs: FrozenPolicyVecEnv = wrapper_class(make_envs(env_id, n_envs, vec_env), model, **arguments)
        row = {"what": what, "n_action_steps": model.policy.options.n_action_steps}
        if what == "wrapped":
            yield {**row, **measure_wrapped(envs, seconds)}
        else:
            yield {**row, **measure_learning(algorithm_class, settings, envs, seconds)}
        envs.close()


def measure_wrapped(envs: FrozenPolicyVecEnv, seconds: float) -> dict[str, Any]:
    """Random choices."""
    envs.reset()

    def step() -> int:
        before = envs.n_environment_steps
        envs.step(np.array([envs.action_space.sample() for _ in range(envs.num_envs)]))
        return envs.n_environment_steps - before

    timed = Timed(
        {
            "environment": (envs.venv, "step_wait"),
            "Transformer and context": (envs.policy, "encode"),
            "head": (envs.policy, "decode"),
            "steps of a chunk": (envs, "_pass"),
        }
    )
    start = time.perf_counter()
    found = steps_per_second(step, seconds)
    return {"steps_per_s": round(found, 1), **timed.shares(time.perf_counter() - start)}


def measure_learning(
    algorithm_class: type[PPO] | type[SAC], settings: dict[str, Any], envs: FrozenPolicyVecEnv, seconds: float
) -> dict[str, Any]:
    """An algorithm; off-policy ones learn from the first step on."""
    settings = {name: value for name, value in settings.items() if name not in ("n_timesteps", "n_envs", "vec_env_wrapper")}
    if "learning_starts" in settings:
        settings["learning_starts"] = envs.num_envs
    agent = algorithm_class(env=envs, device="cpu", seed=0, **settings)
    timed = Timed({"environment": (envs.venv, "step_wait"), "wrapper": (envs, "step"), "gradient steps": (agent, "train")})
    start = time.perf_counter()
    agent.learn(10**9, callback=lambda *_: time.perf_counter() - start < seconds)
    wall = time.perf_counter() - start
    timed.seconds["wrapper"] -= timed.seconds["environment"]
    return {"steps_per_s": round(envs.n_environment_steps / wall, 1), **timed.shares(wall)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="robosuite/Lift-v0", metavar="TASK")
    parser.add_argument("--algo", choices=WAYS, default="sac", help="what learns; sac by default")
    parser.add_argument("--n-envs", nargs="+", type=int, default=[1], metavar="N")
    parser.add_argument("--vec-env", choices=VEC_ENVS, default="dummy")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement")
    parser.add_argument("-o", "--output", type=Path, help="JSONL file to append to")
    options = parser.parse_args()
    th.set_num_threads(1)
    origin = {"commit": commit(), "versions": versions(), "hardware": hardware(th.device("cpu"))}
    for n_envs in options.n_envs:
        for row in measure(options.env, n_envs, options.vec_env, options.algo, options.seconds):
            line = json.dumps({**row, **origin})
            print(line, flush=True)
            if options.output:
                with options.output.open("a") as file:
                    file.write(line + "\n")


if __name__ == "__main__":
    main()
