"""
Record the data sets of the suite, which `studies/suite.yml` lists.

    python studies/suite/record.py --shared SHARED               # all of them, about an hour on two cores
    python studies/suite/record.py --shared SHARED --only Hopper # those whose command or name holds a word

SHARED is a folder with `agents/` (trained agents) and `data/` (demonstrations by people). Other agents are trained here
first, by Stable-Baselines3. A data set that is there already is left alone. Minari writes where MINARI_DATASETS_PATH says,
everything else goes to `datasets/`.
"""

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

DATASETS = Path("datasets")
AGENTS = DATASETS / "agents"
CLI = [sys.executable, "-m", "sb3_dtfm"]


class Agent(NamedTuple):
    """
    An agent that is trained here.

    :param algo: of Stable-Baselines3
    :param env_id: Gymnasium id
    :param n_steps: environment steps
    :param settings: of its constructor
    :param kept_at: environment steps after which a copy is kept, under the name `<name>-<steps>`
    """

    algo: str
    env_id: str
    n_steps: int
    settings: Mapping[str, Any] = MappingProxyType({})
    kept_at: tuple[int, ...] = ()


TRAINED = {
    "sac-Pendulum": Agent("sac", "Pendulum-v1", 5_000),
    "sac-Hopper": Agent("sac", "Hopper-v5", 40_000, kept_at=(10_000, 20_000)),
    "sac-Reacher": Agent("sac", "Reacher-v5", 15_000),
    "sac-InvertedDoublePendulum": Agent("sac", "InvertedDoublePendulum-v5", 15_000, {"gamma": 0.98}),
    "ppo-Swimmer": Agent("ppo", "Swimmer-v5", 400_000, {"gamma": 0.9999, "n_envs": 4, "batch_size": 256}),
    "sac-Pusher": Agent("sac", "Pusher-v5", 30_000),
    "sac-MountainCarContinuous": Agent(
        "sac",
        "MountainCarContinuous-v0",
        30_000,
        {"use_sde": True, "ent_coef": 0.1, "gamma": 0.9999, "tau": 0.01, "train_freq": 32, "gradient_steps": 32,
         "learning_rate": 3e-4, "batch_size": 256, "policy_kwargs": {"log_std_init": -3.67, "net_arch": [64, 64]}},
    ),  # RL-Zoo's settings
    "dqn-CartPole": Agent(
        "dqn",
        "CartPole-v1",
        50_000,
        {"learning_rate": 2.3e-3, "batch_size": 64, "buffer_size": 100_000, "learning_starts": 1_000, "gamma": 0.99,
         "target_update_interval": 10, "train_freq": 256, "gradient_steps": 128, "exploration_fraction": 0.16,
         "exploration_final_eps": 0.04, "policy_kwargs": {"net_arch": [256, 256]}},
        kept_at=(10_000, 20_000),
    ),  # RL-Zoo's settings
}  # fmt: skip


def train(name: str) -> None:
    """Train an agent of the table."""
    import stable_baselines3 as sb3
    import torch as th
    from stable_baselines3.common.env_util import make_vec_env

    th.set_num_threads(1)
    agent = TRAINED[name]
    settings = dict(agent.settings)
    env = make_vec_env(agent.env_id, n_envs=settings.pop("n_envs", 1), seed=0)
    model = getattr(sb3, agent.algo.upper())("MlpPolicy", env, seed=0, device="cpu", **settings)
    AGENTS.mkdir(parents=True, exist_ok=True)
    for stop in (*agent.kept_at, agent.n_steps):
        model.learn(stop - model.num_timesteps, reset_num_timesteps=model.num_timesteps == 0)
        if stop != agent.n_steps:
            model.save(AGENTS / f"{name}-{stop}.zip")
    model.save(AGENTS / f"{name}.zip")


class Recorder:
    """
    Makers of each data set, by its name: functions that leave alone what is there.

    :param shared: folder of `agents/` and `data/`
    """

    def __init__(self, shared: Path) -> None:
        self.agents, self.data = shared / "agents", shared / "data"
        self.minari = Path(os.environ.get("MINARI_DATASETS_PATH", Path.home() / ".minari/datasets"))

    def adroit(self, dataset_id: str, task: str, episodes: int, *options: str) -> None:
        """Sampled episodes of a hand's agent with the published reward."""
        self.agent(
            dataset_id, "ppo", f"{task}Published-v1", episodes, "--stochastic", "--gym-packages", "adroit_tasks", *options
        )

    def agent(self, dataset_id: str, model: str, env_id: str, episodes: int, *options: str) -> None:
        """Episodes of an agent, one of `agents/` or one that is trained here first."""
        if (self.minari / dataset_id).exists():
            return
        path = self.agents / f"{model}-{env_id.replace('Published', '')}.zip"
        if not path.exists():
            base = next(name for name in TRAINED if model.startswith(name))
            path = AGENTS / f"{model}.zip"
            if not path.exists():
                run([sys.executable, __file__, "--train", base])
        algo = model.split("-")[0]
        given = ["--algo", algo, "--model", str(path), "--env", env_id, "--episodes", str(episodes)]
        run([*CLI, "record", *given, "--dataset-id", dataset_id, *options])

    def combine(self, dataset_id: str, parts: list[str]) -> None:
        """One Minari data set of several."""
        if not (self.minari / dataset_id).exists():
            minari = Path(sys.executable).with_name("minari")
            run([str(minari), "combine", "--dataset-id", dataset_id, *parts])

    def several_agents(self, dataset_id: str, env_id: str, models: list[str], episodes: int, *options: str) -> None:
        """Record as many episodes of each of several agents."""
        parts = [f"{dataset_id.rsplit('-', 1)[0]}-{model}-v0" for model in models]
        for part, model in zip(parts, models, strict=True):
            self.agent(part, model, env_id, episodes, "--stochastic", *options)
        self.combine(dataset_id, parts)

    def demonstrations(self, name: str, task: str, episodes: int, *options: str) -> None:
        """Scripted demonstrations of robosuite."""
        output = DATASETS / f"{name}.hdf5"
        if not output.exists():
            run([*CLI, "record", "--demonstrator", task, "--episodes", str(episodes), "--output", str(output), *options])

    def dropped(self) -> None:
        """Can, every second one dropped."""
        output = DATASETS / "can_dropped.hdf5"
        if not output.exists():
            run([sys.executable, "studies/dropping.py", "--episodes", "100", "--output", str(output)])

    def walks(self) -> None:
        """A maze, walked at random."""
        if not (self.minari / "local/pointmaze/random-walks-v0").exists():
            run([sys.executable, "studies/random_walks.py", "record"])

    def planned(self) -> None:
        """A maze, by a planner."""
        if not (self.minari / "local/pointmaze/planned-v0").exists():
            run([sys.executable, "studies/suite/planned.py"])

    def pusht(self) -> None:
        """Push-T by people, as recorded and mirrored."""
        output, source = DATASETS / "pusht.npz", self.data / "pusht/pusht_cchi_v7_lowdim.npz"
        if not output.exists():
            run([sys.executable, "studies/pusht.py", str(source), str(output)])

    def door(self) -> None:
        """Adroit's door by people, alone and with ten episodes of a noisy agent."""
        human, mixed = DATASETS / "door_human.npz", DATASETS / "door_mixed_published.npz"
        if not human.exists():
            human.write_bytes((self.data / "adroit-door/door_human.npz").read_bytes())
        part = "local/adroit/door-noisy-v1"
        self.adroit(part, "AdroitHandDoor", 10, "--noise", "0.1")
        if not mixed.exists():
            from sb3_dtfm.data import load_dataset

            load_dataset([{"dataset": str(human), "clip_actions": True}, part]).save(mixed)


def steps(recorder: Recorder) -> dict[str, Callable[[], None]]:
    """Return what makes each data set."""
    r = recorder
    everyone = ["tqc", "sac", "ppo", "a2c", "trpo"]
    noisy = ("--noise", "0.1")
    sampled = "--stochastic"
    return {
        "hopper-expert": lambda: r.agent("local/hopper/expert-v0", "ppo", "Hopper-v5", 20),
        "pendulum": lambda: r.agent("local/pendulum/sac-v0", "sac-Pendulum", "Pendulum-v1", 30),
        "halfcheetah-mixed-quality": lambda: r.several_agents(
            "local/halfcheetah/mixed-quality-v0", "HalfCheetah-v5", everyone, 15
        ),
        "walker2d-mixed-quality": lambda: r.several_agents("local/walker2d/mixed-quality-v0", "Walker2d-v5", everyone, 15),
        "halfcheetah-mediocre-noisy": lambda: r.several_agents(
            "local/halfcheetah/mediocre-noisy-v0", "HalfCheetah-v5", ["trpo", "a2c", "ppo"], 50, *noisy
        ),
        "walker2d-mediocre-noisy": lambda: r.several_agents(
            "local/walker2d/mediocre-noisy-v0", "Walker2d-v5", ["a2c", "trpo", "sac"], 50, *noisy
        ),
        "pusht": r.pusht,
        "can": lambda: r.demonstrations("can", "can", 200),
        "lift-paused": lambda: r.demonstrations("lift_paused", "lift", 200, "--pause", "20"),
        "hopper-mixed-quality": lambda: r.several_agents(
            "local/hopper/mixed-quality-v0", "Hopper-v5", ["sac-Hopper-10000", "sac-Hopper-20000", "sac-Hopper", "ppo"], 15
        ),
        "can-dropped": r.dropped,
        "lift": lambda: r.demonstrations("lift", "lift", 200),
        "door": r.door,
        "walker2d-expert": lambda: r.agent("local/walker2d/expert-v0", "ppo", "Walker2d-v5", 100, sampled),
        "halfcheetah-expert": lambda: r.agent("local/halfcheetah/expert-v0", "tqc", "HalfCheetah-v5", 100, sampled),
        "ant-expert": lambda: r.agent("local/ant/expert-v0", "ppo", "Ant-v5", 100, sampled),
        "humanoid-expert": lambda: r.agent("local/humanoid/expert-v0", "ppo", "Humanoid-v5", 100, sampled),
        "reacher": lambda: r.agent("local/reacher/sac-v0", "sac-Reacher", "Reacher-v5", 50, sampled),
        "inverted-double-pendulum": lambda: r.agent(
            "local/idp/sac-v0", "sac-InvertedDoublePendulum", "InvertedDoublePendulum-v5", 20, sampled
        ),
        "cartpole": lambda: r.several_agents(
            "local/cartpole/mixed-quality-v0",
            "CartPole-v1",
            ["dqn-CartPole-10000", "dqn-CartPole-20000", "dqn-CartPole"],
            15,
        ),
        "mountain-car": lambda: r.agent(
            "local/mountaincar/sac-v0", "sac-MountainCarContinuous", "MountainCarContinuous-v0", 30, sampled
        ),
        "swimmer": lambda: r.agent("local/swimmer/ppo-v0", "ppo-Swimmer", "Swimmer-v5", 30, sampled),
        "pusher": lambda: r.agent("local/pusher/sac-v0", "sac-Pusher", "Pusher-v5", 50, sampled),
        "maze-walks": r.walks,
        "maze-planned": r.planned,
        "stack": lambda: r.demonstrations("stack", "stack", 50),
        "square": lambda: r.demonstrations("square", "square", 200),
        "adroit-hammer": lambda: r.adroit("local/adroit/hammer-v1", "AdroitHandHammer", 25),
        "adroit-pen": lambda: r.agent("local/adroit/pen-v0", "ppo", "AdroitHandPen-v1", 50, sampled),
        "adroit-relocate": lambda: r.adroit("local/adroit/relocate-v1", "AdroitHandRelocate", 25),
    }


def run(command: list[str]) -> None:
    print(" ".join(command), flush=True)
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": f"studies{os.pathsep}{os.environ.get('PYTHONPATH', '')}",
    }
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)


def main() -> None:
    """See the top."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, help="folder of agents/ and data/")
    parser.add_argument("--only", nargs="+", default=[""], metavar="WORD")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--train", metavar="AGENT", help="train one agent, and record nothing")
    arguments = parser.parse_args()
    if arguments.train:
        train(arguments.train)
        return
    if arguments.shared is None:
        parser.error("--shared is needed")
    DATASETS.mkdir(exist_ok=True)
    made = steps(Recorder(arguments.shared))
    chosen = {name: step for name, step in made.items() if any(word in name for word in arguments.only)}
    with ThreadPoolExecutor(arguments.jobs) as pool:
        started = {name: pool.submit(step) for name, step in chosen.items()}
        for name, future in started.items():
            error = future.exception()
            print(f"{name}: {'there' if error is None else error}", flush=True)


if __name__ == "__main__":
    main()
