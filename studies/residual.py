"""
What an algorithm makes of a gait that may correct the actions themselves, where steering only chooses the flow's noise.

    python studies/residual.py logs/dtfm/HalfCheetah-v5_1/HalfCheetah-v5.zip --target-return 11480

SAC adds up to `--bound` (of actions between -1 and 1) to what the frozen DTFM does by one Euler step, and is evaluated with
20 episodes every 10,000 steps of the environment; the first two lines are of no correction and of random ones.
"""

import argparse
from collections.abc import Callable

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_dtfm import DTFM
from sb3_dtfm.envs import ReturnToGoWrapper
from sb3_dtfm.policies.normalization import OBSERVATION_CLIP
from sb3_dtfm.windows import Context

EVERY, N_EPISODES, N_EVAL_ENVS = 10_000, 20, 10


class CorrectionVecEnv(VecEnvWrapper):
    """
    Acts with a frozen DTFM of single actions, and adds what somebody else chooses.

    What is observed is what a steering algorithm observes, and the DTFM's action.

    :param venv: environments wrapped in :class:`~sb3_dtfm.envs.ReturnToGoWrapper`, with actions between -1 and 1
    :param model: a DTFM
    :param bound: largest correction
    """

    def __init__(self, venv: VecEnv, model: DTFM, bound: float) -> None:
        self.policy, self.bound = model.policy, bound
        n_actions = self.policy.action_dim
        shown = spaces.Box(-OBSERVATION_CLIP, OBSERVATION_CLIP, (self.policy.observation_dim + 2 + n_actions,), np.float32)
        super().__init__(venv, shown, spaces.Box(-1.0, 1.0, (n_actions,), np.float32))

    def reset(self) -> np.ndarray:
        known = self.policy.look(self.venv.reset(), episode_start=np.ones(self.num_envs, bool))  # type: ignore[arg-type]
        shown, self._chosen, self._acted = self._act(*known)
        return shown

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(np.clip(self._chosen + self.bound * actions, -1.0, 1.0))

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        for row in np.flatnonzero(dones):
            last = {key: value[None] for key, value in infos[row]["terminal_observation"].items()}
            known = self.policy.look(last, Context(*(each[[row]] for each in self._acted)))
            infos[row]["terminal_observation"] = self._act(*known)[0][0]
        known = self.policy.look(observations, self._acted, dones)  # type: ignore[arg-type]
        shown, self._chosen, self._acted = self._act(*known)
        return shown, rewards, dones, infos

    def _act(self, context: Context, hidden: th.Tensor) -> tuple[np.ndarray, np.ndarray, Context]:
        noise = np.zeros((len(hidden), self.policy.check_steerable()), np.float32)
        actions, acted = self.policy.act_from_noise(context, hidden, noise)
        with th.inference_mode():
            shown = self.policy.steering_observation(context.windows, None).cpu().numpy()
        return np.concatenate([shown, actions[:, 0]], axis=1), actions[:, 0], acted


def evaluate(envs: CorrectionVecEnv, act: Callable[[np.ndarray], np.ndarray]) -> str:
    """Mean and smallest return of `N_EPISODES` episodes."""
    observations, running = envs.reset(), np.zeros(envs.num_envs)
    returns: list[float] = []
    while len(returns) < N_EPISODES:
        observations, rewards, dones, _ = envs.step(act(observations))  # type: ignore[assignment]
        running += rewards
        returns.extend(running[dones])
        running[dones] = 0.0
    return f"{np.mean(returns):,.0f}, smallest {np.min(returns):,.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--target-return", type=float, required=True)
    parser.add_argument("--bound", type=float, default=0.1)
    parser.add_argument("--gradient-steps", type=int, default=2, help="for each step of the four environments")
    parser.add_argument("-n", "--n-timesteps", type=int, default=80_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    th.set_num_threads(1)
    model = DTFM.load(options.model, device="cpu")

    def make(n_envs: int, seed: int) -> CorrectionVecEnv:
        wrapper = dict(wrapper_class=ReturnToGoWrapper, wrapper_kwargs=dict(target_return=options.target_return))
        return CorrectionVecEnv(make_vec_env(options.env, n_envs, seed=seed, **wrapper), model, options.bound)

    envs, rng = make(N_EVAL_ENVS, 1000 + options.seed), np.random.default_rng(options.seed)
    shape = (N_EVAL_ENVS, model.policy.action_dim)
    print("none:", evaluate(envs, lambda seen: np.zeros(shape, np.float32)), flush=True)
    print("random:", evaluate(envs, lambda seen: rng.uniform(-1.0, 1.0, shape).astype(np.float32)), flush=True)
    agent = SAC(
        "MlpPolicy",
        make(4, options.seed),
        learning_starts=10_000,
        gradient_steps=options.gradient_steps,
        ent_coef="auto_0.1",
        policy_kwargs=dict(net_arch=[256, 256]),
        seed=options.seed,
        device="cpu",
    )
    for start in range(0, options.n_timesteps, EVERY):
        agent.learn(EVERY, reset_num_timesteps=start == 0)
        found = evaluate(envs, lambda seen: agent.predict(seen, deterministic=True)[0])
        print(f"{start + EVERY:,} steps: {found}", flush=True)


if __name__ == "__main__":
    main()
