"""
How many steps a second an environment makes alone, and behind `NoiseActionVecEnv`; and where the time goes.

    OMP_NUM_THREADS=1 python studies/finetuning_speed.py --env robosuite/Lift-v0 HalfCheetah-v5 --n-envs 1 2 -o rows.jsonl

One thread for each process, environments of more than one in `SubprocVecEnv`. The model has the small profile's sizes and no
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
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_dtfm import DTFM
from sb3_dtfm.benchmark.provenance import commit, hardware, versions
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.finetuning import NoiseActionVecEnv
from sb3_dtfm.zoo.registration import finetuning_config, packaged_config

# Beside those of the trunk and the head, what the settings of a task say about a model.
OF_THE_MODEL = ("context_length", "ema_decay", "policy_kwargs")


def settings_of(env_id: str) -> dict[str, Any]:
    """Of the small profile."""
    settings = yaml.safe_load(packaged_config("dtfm", "small").read_text())
    return settings.get(env_id, settings["default"])


def make_model(env_id: str) -> DTFM:
    """A model of the small profile, of two random episodes."""
    env = gym.make(env_id)
    rng = np.random.default_rng(0)
    space = env.observation_space
    sizes = (20, gym.spaces.flatdim(space))
    actions = rng.uniform(env.action_space.low, env.action_space.high, (20, *env.action_space.shape))
    episodes = [dict(observations=rng.normal(size=sizes), actions=actions, rewards=np.ones(20)) for _ in range(2)]
    env.close()
    settings = {name: value for name, value in settings_of(env_id).items() if name in OF_THE_MODEL}
    return DTFM("MultiInputPolicy", dataset=episodes, seed=0, device="cpu", **settings)


def make_envs(env_id: str, n_envs: int) -> VecEnv:
    """As `sb3-dtfm finetune` makes them."""
    wrapper = functools.partial(ReturnToGoWrapper, target_return=1.0)
    return make_vec_env(
        env_id, n_envs, seed=0, wrapper_class=wrapper, vec_env_cls=DummyVecEnv if n_envs == 1 else SubprocVecEnv
    )


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


def measure(env_id: str, n_envs: int, seconds: float) -> Iterator[dict[str, Any]]:
    """Rows: the bare environments, behind the wrapper with random noise, and with SAC that learns."""
    model = make_model(env_id)
    about = {"task": env_id, "n_envs": n_envs, "n_action_steps": model.policy.n_action_steps}

    bare = make_envs(env_id, n_envs)
    bare.reset()
    rng = np.random.default_rng(0)
    low, high = bare.action_space.low, bare.action_space.high

    def step_bare() -> int:
        bare.step(rng.uniform(low, high, (n_envs, len(low))).astype(np.float32))
        return n_envs

    alone = steps_per_second(step_bare, seconds)
    bare.close()
    yield {**about, "what": "bare", "steps_per_s": round(alone, 1)}

    wrapped = NoiseActionVecEnv(make_envs(env_id, n_envs), model)
    wrapped.reset()

    def step_wrapped() -> int:
        before = wrapped.n_environment_steps
        wrapped.step(np.array([wrapped.action_space.sample() for _ in range(n_envs)]))
        return wrapped.n_environment_steps - before

    timed = Timed(
        {
            "environment": (wrapped.venv, "step_wait"),
            "environment, asked": (wrapped.venv, "step_async"),
            "trunk and context": (model.policy, "look"),
            "head": (model.policy, "act_from_noise"),
            "steps of a chunk": (wrapped, "_pass"),
        }
    )
    start = time.perf_counter()
    found = steps_per_second(step_wrapped, seconds)
    yield {**about, "what": "wrapped", "steps_per_s": round(found, 1), **_shares(timed.seconds, time.perf_counter() - start)}
    wrapped.close()

    settings = yaml.safe_load(finetuning_config("sac").read_text())["default"]
    for name in ("n_timesteps", "n_envs", "vec_env_wrapper", "learning_starts"):
        settings.pop(name)
    learning = NoiseActionVecEnv(make_envs(env_id, n_envs), model)
    agent = SAC(env=learning, device="cpu", seed=0, learning_starts=n_envs, **settings)
    timed = Timed({"environment and policy": (learning, "step"), "gradient steps": (agent, "train")})
    start = time.perf_counter()
    agent.learn(10**9, callback=lambda *_: time.perf_counter() - start < seconds)
    wall = time.perf_counter() - start
    found = learning.n_environment_steps / wall
    yield {**about, "what": "sac", "steps_per_s": round(found, 1), **_shares(timed.seconds, wall)}
    learning.close()


def _shares(seconds: dict[str, float], wall: float) -> dict[str, Any]:
    return {"shares": {part: round(each / wall, 3) for part, each in seconds.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["robosuite/Lift-v0", "HalfCheetah-v5"], metavar="TASK")
    parser.add_argument("--n-envs", nargs="+", type=int, default=[1, 2], metavar="N")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement")
    parser.add_argument("-o", "--output", type=Path, help="JSONL file to write")
    options = parser.parse_args()
    th.set_num_threads(1)
    origin = {"commit": commit(), "versions": versions(), "hardware": hardware(th.device("cpu"))}
    rows = []
    for env_id in options.env:
        for n_envs in options.n_envs:
            for row in measure(env_id, n_envs, options.seconds):
                rows.append({**row, **origin})
                print(json.dumps(row), flush=True)
    if options.output:
        options.output.write_text("".join(json.dumps(row) + "\n" for row in rows))


if __name__ == "__main__":
    main()
